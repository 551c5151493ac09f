import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe2road.cli.main import main
from probe2road.io.graph_files import read_graph, write_graph


def run(*arguments, cwd):
    """Run the command line in a process of its own, as a user does."""
    program = Path(sys.executable).with_name("probe2road")
    return subprocess.run([program, *map(str, arguments)], cwd=cwd, capture_output=True, text=True, check=False)


@pytest.fixture
def call(folder, monkeypatch, capsys):
    """Run the command line in this process, which is quicker: exit code, standard output, standard error."""

    def run_here(*arguments):
        monkeypatch.chdir(folder)
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            main(list(map(str, arguments)))
        return stop.value.code, *capsys.readouterr()

    return run_here


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the drives of six vehicles along two crossing roads, under odd column names."""
    rng = np.random.default_rng(0)
    at = np.arange(0, 600, 15.0)
    drives = []
    for trip in range(12):
        east, north = (at, np.full_like(at, 300.0)) if trip % 2 else (np.full_like(at, 300.0), at)
        table = {
            "trip": trip,
            "clock": 1714550400 + np.arange(len(at)),
            "e": 446000 + east,
            "n": 4636000 + north + rng.normal(),
        }
        drives.append(pd.DataFrame(table))
    path = tmp_path_factory.mktemp("cli")
    pd.concat(drives).to_csv(path / "drives.csv", index=False)
    return path


COLUMNS = ("--columns", "trace_id=trip,t=clock,x=e,y=n", "--crs", "EPSG:32616")


@pytest.fixture(scope="module")
def built(folder):
    result = run("build", "drives.csv", *COLUMNS, "-o", "roads.gpkg", "-o", "roads.geojson", cwd=folder)
    assert result.returncode == 0, result.stderr
    return result


def test_build_writes_every_output_and_leaves_nothing_else(folder, built):
    assert len(read_graph(folder / "roads.gpkg").edges) == len(read_graph(folder / "roads.geojson").edges) == 2
    assert not list(folder.glob(".*"))
    assert "segmented" in built.stderr


def test_evaluate_prints_scores_with_their_parameters(folder, built, call):
    code, out, _ = call("evaluate", "roads.gpkg", "roads.geojson", "--metrics", "geo,itopo", "-o", "scores.csv")
    assert code == 0
    assert "1.000" in out
    assert "radius" in out
    assert pd.read_csv(folder / "scores.csv")["metric"].tolist() == ["geo", "itopo"]


def test_info_tells_fleet_data_from_a_graph(built, call):
    fleet, graph = (json.loads(call("info", *words)[1]) for words in (("drives.csv", *COLUMNS), ("roads.gpkg",)))
    assert (fleet["content"], fleet["traces"]) == ("fleet data", 12)
    assert (graph["content"], graph["dead_ends"]) == ("road graph", 4)


def test_match_tells_the_edge_of_every_fix(folder, built, call):
    words = ("drives.csv", "roads.gpkg", *COLUMNS, "-o", "matches.parquet", "--steps", "steps.parquet")
    code, _, err = call("match", *words)
    assert code == 0, err
    matches, steps = (pd.read_parquet(folder / name) for name in ("matches.parquet", "steps.parquet"))
    assert len(matches) == 12 * 40
    assert matches["edge"].notna().mean() > 0.9
    assert steps["trace_id"].nunique() == 12


@pytest.mark.parametrize("name", ["roads.html", "roads.png"])
def test_view_draws_a_page_or_a_picture(folder, built, call, name):
    code, _, err = call("view", "roads.gpkg", "--traces", "drives.csv", *COLUMNS, "-o", name)
    assert code == 0, err
    assert (folder / name).stat().st_size > 10_000


def test_view_compares_with_a_reference_in_a_picture_only(folder, built, call):
    compared = ("view", "roads.gpkg", "--reference", "roads.gpkg", "-o")
    assert call(*compared, "compared.png")[0] == 0
    code, _, err = call(*compared, "compared.html")
    assert code == 2
    assert "a page shows no reference; use .png" in err


def test_intermediate_stages_are_kept_on_request(folder, call):
    options = ("--keep-intermediate", "stages", "--segmenter", "density", "--resolution", "2", "-q")
    assert call("build", "drives.csv", *COLUMNS, *options, "-o", "coarse.gpkg") == (0, "", "")
    names = {path.name for path in (folder / "stages").iterdir()}
    assert names >= {"1-probability.tif", "2-mask.tif", "3-skeleton.tif", "4-vectorized.gpkg", "7-roads.gpkg"}
    assert "stages.png" in names


def test_a_build_takes_over_the_ids_of_an_earlier_one(folder, built, call):
    graph = read_graph(folder / "roads.gpkg")
    renamed = graph.edges.set_axis(graph.edges.index + 700).rename_axis("edge")
    turns = graph.turns.assign(from_edge=graph.turns["from_edge"] + 700, to_edge=graph.turns["to_edge"] + 700)
    write_graph(replace(graph, edges=renamed, turns=turns), folder / "earlier.gpkg")
    options = ["--ids-from", "earlier.gpkg", "--id-changes", "ids.csv"]
    assert call("build", "drives.csv", *COLUMNS, *options, "-o", "later.gpkg")[0] == 0
    assert read_graph(folder / "later.gpkg").edges.index.tolist() == (graph.edges.index + 700).tolist()
    assert pd.read_csv(folder / "ids.csv")["change"].tolist() == ["kept"] * len(graph.edges)


def test_diff_lists_what_a_map_lacks(folder, built, call):
    graph = read_graph(folder / "roads.gpkg")
    graph.edges.iloc[:1][["geometry"]].to_file(folder / "one-road.gpkg")
    code, out, _ = call("diff", "roads.gpkg", "one-road.gpkg", "-o", "changes.csv", "-o", "changes.osc")
    assert code == 0
    changes = pd.read_csv(folder / "changes.csv")
    assert set(changes["change"]) == {"confirmed", "added"}
    printed = dict(line.split()[:2] for line in out.splitlines())
    assert printed["added"] == str((changes["change"] == "added").sum())
    assert printed["undriven"] == "0"
    assert "osmChange" in (folder / "changes.osc").read_text()


def test_options_come_from_toml(folder, call):
    (folder / "build.toml").write_text("[segmentation.density]\nbandwidth = 6\n[clean]\ndead_end = 400\n")
    code, _, err = call("build", "drives.csv", *COLUMNS, "--config", "build.toml", "-o", "toml.gpkg", "--no-refine")
    assert code == 0, err
    assert len(read_graph(folder / "toml.gpkg").edges) < 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["build", "absent.csv", "-o", "x.gpkg"], "absent.csv: there is no such file"),
        (["build", "drives.csv", "-o", "x.gpkg"], "column"),
        (["build", "drives.csv", *COLUMNS[:2], "-o", "x.gpkg"], "no CRS"),
        (["build", "drives.csv", *COLUMNS, "--id-changes", "a.csv", "-o", "x.gpkg"], "there are no earlier ids"),
        (["diff", "roads.gpkg", "roads.gpkg", "-o", "x.dxf"], "no table is written to .dxf"),
        (["diff", "roads.gpkg", "roads.gpkg", "--min-probability", "2", "-o", "x.gpkg"], "min_probability is 2"),
        (["build", "drives.csv", *COLUMNS, "-o", "x.dxf"], "suffix is of no known format"),
        (["build", "drives.csv", *COLUMNS, "-o", "absent/x.gpkg"], "does not exist; create it first"),
        (["build", "drives.csv", *COLUMNS, "--bbox", "1,2,3", "-o", "x.gpkg"], "left,bottom,right,top"),
        (["build", "drives.csv", "--columns", "trip", "-o", "x.gpkg"], "ours=theirs"),
        (["build", "drives.csv", *COLUMNS, "--segmenter", "magic", "-o", "x.gpkg"], "use network or density"),
        (
            ["build", "drives.csv", *COLUMNS, "--weights", "absent.onnx", "-o", "x.gpkg"],
            "absent.onnx: weights cannot be",
        ),
        (
            ["build", "drives.csv", *COLUMNS, "--weights", "x.onnx", "--segmenter", "density", "-o", "x.gpkg"],
            "--weights: segmenter density runs no network; use --segmenter network",
        ),
        (["build", "drives.csv", *COLUMNS, "--config", "wrong.toml", "-o", "x.gpkg"], "there is no option 'bandwith'"),
        (
            ["build", "drives.csv", *COLUMNS, "--config", "type.toml", "-o", "x.gpkg"],
            "type.toml: segmentation: resolution is 'fine'; use a number",
        ),
        (["evaluate", "absent.gpkg", "absent.gpkg"], "absent.gpkg: no such file"),
        (["view", "absent.gpkg", "-o", "roads.pdf"], "use .html or .png"),
        (["info", "absent.parquet"], "absent.parquet: there is no such file"),
    ],
)
def test_bad_input_is_one_clear_error_and_no_output(folder, call, arguments, message):
    (folder / "wrong.toml").write_text("[segmentation.density]\nbandwith = 5\n")
    (folder / "type.toml").write_text("[segmentation]\nresolution = 'fine'\n")
    code, _, err = call(*arguments)
    assert code == 2
    assert err.count("error: ") == 1
    assert message in err
    assert "Traceback" not in err
    assert not [*folder.glob("x.*"), *folder.glob(".x*")]


ROADS = """<osm version="0.6">
<node id="1" lat="52.0" lon="9.0"/><node id="2" lat="52.0" lon="9.03"/><node id="3" lat="52.002" lon="9.05"/>
<way id="9"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="motorway"/></way></osm>"""


def test_simulate_writes_fleet_data_that_build_reads_and_the_truth(folder, call):
    (folder / "roads.osm").write_text(ROADS)
    code, _, err = call("simulate", "roads.osm", "--drives", 4, "--seed", 1, "--modelled", "-o", "fleet")
    assert code == 0, err
    assert {path.name for path in (folder / "fleet").iterdir()} == {
        *("drives.parquet", "drives.points.parquet", "modelled.parquet", "modelled.points.parquet", "poses.parquet"),
        *("routes.parquet", "reference.gpkg", "run.json"),
    }
    assert read_graph(folder / "fleet" / "reference.gpkg").edges["support"].tolist() == [4]
    code, _, err = call("build", "fleet/drives.parquet", "--points", "fleet/drives.points.parquet", "-o", "made.gpkg")
    assert code == 0, err
    assert read_graph(folder / "made.gpkg").length == pytest.approx(3450, abs=150)


def test_simulate_follows_the_seed(folder, call):
    (folder / "roads.osm").write_text(ROADS)
    for name, seed in (("first", 1), ("again", 1), ("other", 2)):
        assert call("simulate", "roads.osm", "--kilometres", 5, "--seed", seed, "-q", "-o", name)[0] == 0
    first, again, other = ((folder / name / "drives.parquet").read_bytes() for name in ("first", "again", "other"))
    assert first == again
    assert first != other


def test_benchmark_prepare_makes_a_data_set_of_generated_roads(folder, call, monkeypatch):
    from dataclasses import replace

    from probe2road.benchmark.sets import datasets

    tiny = replace(datasets.find_dataset("corridor-1"), drive_km=8.0)
    monkeypatch.setattr(datasets, "DATASETS", {"corridor-1": tiny})
    code, out, err = call("benchmark", "prepare", "corridor-1", "-o", "sets")
    assert code == 0, err
    assert out.split() == ["sets/corridor-1"]
    assert (folder / "sets" / "corridor-1" / "manifest.json").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulate", "roads.osm", "-o", "x"], "pass --drives or --kilometres"),
        (["simulate", "roads.osm", "--drives", 1, "--kilometres", 1, "-o", "x"], "pass --drives or --kilometres"),
        (["simulate", "roads.osm", "--drives", 0, "-o", "x"], "give one, above 0"),
        (["simulate", "roads.osm", "--drives", 1, "--preset", "sunny", "-o", "x"], "preset 'sunny' is unknown"),
        (["simulate", "roads.osm", "--drives", 1, "--preset", "phone", "--modelled", "-o", "x"], "no camera"),
        (["simulate", "absent.osm", "--drives", 1, "-o", "x"], "no such file"),
        (["simulate", "roads.osm", "--drives", 1, "-o", "."], "not empty and not a recording"),
        (["benchmark", "prepare", "atlantis", "-o", "x"], "there is no data set 'atlantis'"),
        (["benchmark", "prepare", "boston", "--data", "absent", "-o", "x"], "there is no such extract"),
    ],
)
def test_bad_simulations_are_one_clear_error(folder, call, arguments, message):
    (folder / "roads.osm").write_text(ROADS)
    code, _, err = call(*arguments)
    assert code == 2
    assert err.count("error: ") == 1
    assert message in err
