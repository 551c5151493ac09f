"""The reading options of the command line: the same in every verb, and named in its errors."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import geopandas as gpd
import pandas as pd
import pytest
import shapely
import typer.main

from probe2road.cli.main import app, main
from probe2road.cli.reading import spoken

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
FLEET = {
    "--columns",
    "--crs",
    "--target-crs",
    "--bbox",
    "--delimiter",
    "--no-header",
    "--invalid",
    "--max-accuracy",
    "--max-speed",
    "--max-uncompressed",
    "--time-format",
    "--interval",
}
GRAPH = {"--layer", "--graph-crs", "--max-uncompressed"}
REFERENCE = {"--reference-layer", "--reference-crs", "--max-uncompressed"}


@pytest.mark.parametrize(
    ("verb", "offered"),
    [
        ("build", FLEET | {"--point-columns", "--layer"}),
        ("align", FLEET | {"--point-columns", "--layer"}),
        ("match", FLEET | GRAPH | {"--traces-layer"}),
        ("evaluate", GRAPH | REFERENCE),
        ("info", FLEET | {"--layer"}),
        ("view", FLEET | GRAPH | REFERENCE | {"--point-columns", "--traces-layer"}),
    ],
)
def test_every_verb_offers_what_it_reads(verb: str, offered: set[str]) -> None:
    flags = {flag for option in COMMANDS[verb].params for flag in option.opts}
    assert flags & (FLEET | GRAPH | REFERENCE | {"--point-columns", "--traces-layer"}) == offered
    assert all(option.help for option in COMMANDS[verb].params)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ('no CRS; for example crs="EPSG:32616"', "no CRS; for example --crs EPSG:32616"),
        ('use resolution=1.0 or segmenter="density"', "use --resolution 1.0 or --segmenter density"),
        ('say point_columns={"x": "the east", "y": "n"}', "say --point-columns 'x=the east,y=n'"),
        ("no header (header=False); the columns", "no header (--no-header); the columns"),
        ("pass bbox=(1, 2, 3.5, 4)", "pass --bbox 1,2,3.5,4"),
        ('set tile="8" or crs=[', 'set tile="8" or crs=['),
        ("crs=1/columns=2/a.csv: in day=2/crs=5/b.csv", "crs=1/columns=2/a.csv: in day=2/crs=5/b.csv"),
    ],
)
def test_arguments_in_messages_become_flags(message: str, said: str) -> None:
    assert spoken(message) == said


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with one drive without header, and the road below it in the second layer and in a file without CRS."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drives.txt").write_text("".join(f"7;{t};{446000 + 10 * t};4636000\n" for t in range(30)))
    road = gpd.GeoDataFrame(geometry=[shapely.LineString([(445990, 4636000), (446300, 4636000)])], crs="EPSG:32616")
    road.iloc[:0].to_file("city.gpkg", layer="rivers")
    road.to_file("city.gpkg", layer="streets")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        road.set_crs(None, allow_override=True).to_file("bare.fgb")
    return tmp_path


def call(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[object, str, str]:
    with pytest.raises(SystemExit) as stop:
        main(list(words))
    out, err = capsys.readouterr()
    return stop.value.code, out, " ".join(err.split())


COLUMNS = ("--columns", "trace_id=0,t=1,x=2,y=3")
DRIVES = ("drives.txt", "--delimiter", ";", "--no-header", *COLUMNS, "--crs", "EPSG:32616")
FORMAT = """[format]
columns = { trace_id = 0, t = 1, x = 2, y = 3 }
delimiter = ";"
header = false
crs = "EPSG:32616"
"""


def test_a_config_says_how_to_read_and_the_command_line_wins(folder, capsys):
    config = FORMAT.replace('";"', '","')
    (folder / "match.toml").write_text(f'profile = "fleet"\n{config}[graph_format]\nlayer = "rivers"\n')
    words = ("match", "drives.txt", "city.gpkg", "--config", "match.toml", "-o", "matches.parquet")
    code, _, err = call(capsys, *words, "--delimiter", ";", "--layer", "streets")
    assert code == 0, err
    assert pd.read_parquet("matches.parquet")["edge"].notna().all()
    code, _, err = call(capsys, *words, "--layer", "streets")
    assert code == 2
    assert "there is no column '1' (t)" in err
    code, _, err = call(capsys, *words, "--delimiter", ";")
    assert code == 2
    assert "city.gpkg: holds no features" in err


def test_a_build_and_an_alignment_read_by_their_config(folder, capsys):
    (folder / "build.toml").write_text(f'[segmentation]\nsegmenter = "density"\n\n{FORMAT}bbox = [0, 0, 1, 1]\n')
    code, _, err = call(capsys, "build", "drives.txt", "--config", "build.toml", "-o", "roads.gpkg")
    assert code == 2
    assert "no fixes inside bbox (0.0, 0.0, 1.0, 1.0)" in err
    (folder / "align.toml").write_text("[format]\nfield = 1\n")
    code, _, err = call(capsys, "align", "drives.txt", "--config", "align.toml", "-o", "aligned.parquet")
    assert "align.toml: format: there is no option 'field'; use columns, point_columns, crs" in err
    (folder / "align.toml").write_text("format = 3\n")
    code, _, err = call(capsys, "align", "drives.txt", "--config", "align.toml", "-o", "aligned.parquet")
    assert "align.toml: format: 3 is no table" in err


def test_graphs_have_layers_and_a_crs(folder, capsys):
    said = ("--layer", "streets", "--reference-crs", "EPSG:32616", "--metrics", "geo", "-o", "scores.csv")
    code, _, err = call(capsys, "evaluate", "city.gpkg", "bare.fgb", *said)
    assert code == 0, err
    assert pd.read_csv("scores.csv")["f1"].tolist() == [1.0]
    for words in (("city.gpkg", "--layer", "streets"), ("bare.fgb", "--crs", "EPSG:32616")):
        code, out, err = call(capsys, "info", *words)
        assert code == 0, err
        assert json.loads(out)["edges"] == 1
    said = ("--graph-crs", "EPSG:32616", "--reference", "city.gpkg", "--reference-layer", "streets", "-o", "roads.png")
    code, _, err = call(capsys, "view", "bare.fgb", "--traces", *DRIVES, *said)
    assert code == 0, err


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["info", *DRIVES[:-2]], "drives.txt: no CRS; say which one it is, for example --crs EPSG:32616"),
        (["info", "drives.txt", "--crs", "EPSG:32616"], "there is no header (--no-header)"),
        (["info", "drives.txt", "--no-header", "--crs", "EPSG:32616"], "for example --columns x=NAME,y=NAME"),
        (["info", *DRIVES[:-1], "EPSG:4326"], "pass their CRS, for example --crs EPSG:32616"),
        (["info", "bare.fgb"], "bare.fgb: no CRS; say which one it is, for example --crs EPSG:32616"),
        (["match", "drives.txt", "bare.fgb", "-o", "m.parquet"], "for example --graph-crs EPSG:32616"),
        (["match", "drives.txt", "city.gpkg", "-o", "m.parquet"], "for example --layer rivers"),
        (["evaluate", "bare.fgb", "bare.fgb", "--reference-crs", "EPSG:32616"], "for example --graph-crs EPSG:32616"),
        (["evaluate", "bare.fgb", "bare.fgb", "--graph-crs", "EPSG:32616"], "for example --reference-crs EPSG:32616"),
        (["evaluate", "bare.fgb", "city.gpkg"], "for example --reference-layer rivers"),
        (["view", "bare.fgb", "-o", "roads.html"], "for example --graph-crs EPSG:32616"),
        (["build", *DRIVES, "--points", "drives.txt", "-o", "x.gpkg"], "--point-columns trace_id=NAME,x=NAME,y=NAME"),
    ],
)
def test_errors_name_the_flag_that_helps(folder, capsys, words, hint):
    code, _, err = call(capsys, *words)
    assert code == 2
    assert hint in err


def test_the_layer_of_the_traces_beside_that_of_the_graph(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fixes = gpd.GeoDataFrame(
        {"trip": 1, "time": range(30)}, geometry=[shapely.Point(446000 + 10 * t, 4636000) for t in range(30)], crs=32616
    )
    for layer in ("monday", "tuesday"):
        fixes.to_file(folder / "week.gpkg", layer=layer)
    words = ("match", "week.gpkg", "city.gpkg", "--layer", "streets", "-o", "m.parquet")
    code, _, err = call(capsys, *words)
    assert (code, "--traces-layer monday" in err) == (2, True)
    assert call(capsys, *words, "--traces-layer", "tuesday")[0] == 0
