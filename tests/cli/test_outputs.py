"""Where and as what the verbs write: decided by the suffix, and before the work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.cli.main import main
from probe2road.io.graph_files import read_graph

Call = Callable[..., tuple[int, str]]

FIXES = ["trace_id", "t", "edge", "offset", "at", "distance", "forward", "reason"]
READ = ("--columns", "trace_id=trip,t=clock,x=e,y=n", "--crs", "EPSG:32616")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two trips along a street and round a corner, one of which starts off the road, and a map with ids of ways."""
    at = np.arange(0.0, 200, 10)
    corner = pd.DataFrame({"e": np.r_[at, np.full(10, 200.0)], "n": np.r_[np.zeros(20), np.arange(0.0, 100, 10)]})
    back = corner[::-1].reset_index(drop=True)
    back.loc[0, "n"] = 900.0
    drives = [
        table.assign(trip=trip, clock=1714550400 + np.arange(30)) for trip, table in enumerate((corner, back), start=1)
    ]
    table = pd.concat(drives)
    table.assign(e=446000 + table["e"], n=4636000 + table["n"]).to_csv(tmp_path / "drives.csv", index=False)
    streets = [[(446000, 4636000), (446200, 4636000)], [(446200, 4636000), (446200, 4636100)]]
    lines = [shapely.LineString(street) for street in streets]
    gpd.GeoDataFrame({"osmid": [71, 72]}, geometry=lines, crs="EPSG:32616").to_file(tmp_path / "streets.gpkg")
    return tmp_path


@pytest.fixture
def call(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    def run(*arguments: str) -> tuple[int, str]:
        monkeypatch.chdir(folder)
        with pytest.raises(SystemExit) as stop:
            main(["-q", *arguments])
        return int(stop.value.code or 0), capsys.readouterr().err

    return run


def test_matches_as_text_have_a_line_of_names_and_a_row_for_each_fix(folder: Path, call: Call) -> None:
    words = ("match", "drives.csv", "streets.gpkg", *READ, "-o", "matches.csv", "--steps", "steps.csv")
    assert call(*words) == (0, "")
    assert (folder / "matches.csv").read_text().splitlines()[0] == ",".join(FIXES)
    fixes, steps = pd.read_csv(folder / "matches.csv"), pd.read_csv(folder / "steps.csv")
    assert len(fixes) == 60
    assert steps["osmid"].tolist() == [71, 72, 72, 71]
    assert steps["forward"].tolist() == [True, True, False, False]


@pytest.mark.parametrize("suffix", [".geoparquet", ".gpkg", ".geojson"])
def test_matches_on_the_map_lie_on_their_edges_and_a_trip_is_one_line(folder: Path, call: Call, suffix: str) -> None:
    outputs = {option: f"{option[2:]}{suffix}" for option in ("--output", "--steps", "--trips")}
    words = [word for pair in outputs.items() for word in pair]
    assert call("match", "drives.csv", "streets.gpkg", *READ, *words, "--roads", "roads.parquet") == (0, "")
    read = gpd.read_parquet if suffix == ".geoparquet" else gpd.read_file
    fixes, steps, trips = (read(folder / name).to_crs("EPSG:32616") for name in outputs.values())
    assert sorted(fixes) == sorted([*FIXES, "osmid", "geometry"])
    on = fixes["edge"].notna()
    assert (len(fixes), int((~on).sum())) == (60, 1)
    assert fixes.geometry[~on].isna().all()
    roads = read_graph(folder / "roads.parquet")
    lines = roads.edges.geometry.loc[fixes["edge"][on].astype(int)].to_numpy()
    assert shapely.distance(fixes.geometry[on].to_numpy(), lines).max() < 0.01
    assert steps["osmid"].tolist() == [71, 72, 72, 71]
    assert trips["trace_id"].tolist() == [1, 2]
    assert trips.length.round().tolist() == [290, 280]
    start = [shapely.get_coordinates(line)[0].round().tolist() for line in trips.geometry]
    assert start == [[446000, 4636000], [446200, 4636080]]


@pytest.mark.parametrize("option", ["--output", "--steps", "--trips", "--roads"])
def test_an_unknown_suffix_is_refused_before_the_work(call: Call, option: str) -> None:
    words = {"--output": "matches.csv", option: "table.xlsx"}
    code, said = call("match", "absent.csv", "absent.osm", *(word for pair in words.items() for word in pair))
    assert code == 2
    assert "table.xlsx" in said
    assert "use one of" in said


@pytest.mark.parametrize(
    "words",
    [
        ("build", "absent.csv", "-o", "{}.gpkg"),
        ("build", "absent.csv", "-o", "roads.gpkg", "-o", "{}.parquet"),
        ("align", "absent.csv", "-o", "{}.parquet"),
        ("match", "absent.csv", "absent.osm", "-o", "{}.csv"),
        ("match", "absent.csv", "absent.osm", "-o", "x.csv", "--steps", "{}.csv"),
        ("evaluate", "absent.gpkg", "absent.gpkg", "-o", "{}.csv"),
        ("view", "absent.gpkg", "-o", "{}.html"),
    ],
)
def test_an_output_that_is_a_folder_or_in_none_is_refused_before_the_work(
    folder: Path, call: Call, words: tuple[str, ...]
) -> None:
    for suffix in ("gpkg", "parquet", "csv", "html"):
        (folder / f"taken.{suffix}").mkdir()
    code, said = call(*(word.format("taken") for word in words))
    assert code == 2
    assert "is a folder, and a file would replace it" in " ".join(said.split())
    code, said = call(*(word.format("none/roads") for word in words))
    assert code == 2
    assert "does not exist; create it first" in " ".join(said.split())


def test_two_outputs_of_one_name_are_refused(call: Call) -> None:
    code, said = call("match", "absent.csv", "absent.osm", "-o", "x.csv", "--steps", "x.csv")
    assert code == 2
    assert "named twice" in said


@pytest.mark.parametrize("words", [("simulate", "absent.osm", "--drives", "1"), ("train", "gnss", "--sets", ".")])
def test_a_file_in_the_place_of_a_folder_is_refused(call: Call, words: tuple[str, ...]) -> None:
    code, said = call(*words, "-o", "drives.csv")
    assert code == 2
    assert "is a file, and a folder would be written" in " ".join(said.split())


def write_roads(path: Path, north: float) -> None:
    lines = [shapely.LineString([(446000, north), (446200, north)])]
    gpd.GeoDataFrame(geometry=lines, crs="EPSG:32616").to_file(path)


def test_matches_with_a_graph_somewhere_else_are_written_and_warned_of(folder: Path, call: Call) -> None:
    write_roads(folder / "away.gpkg", 5636000)
    code, said = call("match", "drives.csv", "away.gpkg", *READ, "-o", "matches.csv")
    assert code == 3
    assert "no fix of 60 is matched" in said
    assert pd.read_csv(folder / "matches.csv")["edge"].isna().all()


@pytest.mark.parametrize(
    ("north", "reason"),
    [(5636000, "the proposal is at -87.65"), (4636050, "no metric finds a road that both have")],
)
def test_scores_of_graphs_with_nothing_in_common_are_warned_of(
    folder: Path, call: Call, north: float, reason: str
) -> None:
    write_roads(folder / "street.gpkg", 4636000)
    write_roads(folder / "other.gpkg", north)
    code, said = call("evaluate", "street.gpkg", "other.gpkg", "--metrics", "geo", "-o", "scores.csv")
    assert code == 3
    assert reason in " ".join(said.split())
    assert pd.read_csv(folder / "scores.csv")["f1"].tolist() == [0.0]
    assert call("evaluate", "street.gpkg", "street.gpkg", "--metrics", "geo") == (0, "")


def test_a_build_without_a_road_is_written_and_warned_of(folder: Path, call: Call) -> None:
    code, said = call(
        *("build", "drives.csv", *READ, "--segmenter", "density", "--min-drives", "9", "-o", "roads.geojson")
    )
    assert code == 3
    assert said
    assert len(read_graph(folder / "roads.geojson").edges) == 0


def test_a_view_of_traces_and_a_reference_somewhere_else_is_warned_of(folder: Path, call: Call) -> None:
    write_roads(folder / "away.gpkg", 4836000)
    code, said = call(
        "view", "away.gpkg", "--traces", "drives.csv", *READ, "--reference", "streets.gpkg", "-o", "v.png"
    )
    said = " ".join(said.split())
    assert code == 0
    assert "but the traces are at -87.65" in said
    assert "but the reference is at -87.65" in said
