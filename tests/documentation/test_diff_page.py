"""The commands of the page for mappers run, on a folder of GPX and an extract that lacks a road."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from xml.etree import ElementTree

import geopandas as gpd
import pytest

from probe2road.cli.main import main
from probe2road.comparison.diff import DIFFERENCES
from probe2road.crs import WGS84, transform
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.networks.network import network_from_sections
from sketches import EAST, NORTH, UTM

PAGE = (Path(__file__).parents[2] / "docs" / "guide" / "howto" / "diff-with-a-map.md").read_text(encoding="utf-8")
ROADS = [[(0, 0), (500, 0)], [(500, 0), (1000, 0)], [(500, 0), (500, 500)], [(0, 300), (0, 0)]]
MAPPED = [0, 1, 3]  # the extract lacks the road to the north


def degrees(places: list[tuple[float, float]]) -> list[tuple[float, float]]:
    x, y = zip(*places, strict=True)
    lon, lat = transform([EAST + value for value in x], [NORTH + value for value in y], UTM, WGS84)
    return list(zip(lon, lat, strict=True))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write gpx/ and map.osm, and go there."""
    network = network_from_sections([[(EAST + x, NORTH + y) for x, y in road] for road in ROADS], crs=UTM)
    traces = simulate(network, n_drives=40, seed=3).fleet.traces
    (tmp_path / "gpx").mkdir()
    for number, (_, drive) in enumerate(traces.groupby("trace_id")):
        lon, lat = transform(drive["x"].to_numpy(), drive["y"].to_numpy(), UTM, WGS84)
        fixes = "".join(
            f'<trkpt lat="{y:.7f}" lon="{x:.7f}"><time>{t:%Y-%m-%dT%H:%M:%S.%fZ}</time></trkpt>'
            for x, y, t in zip(lon, lat, drive["t"], strict=True)
        )
        text = f'<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{fixes}</trkseg></trk></gpx>'
        (tmp_path / "gpx" / f"{number}.gpx").write_text(text, encoding="utf-8")
    places = sorted({place for road in ROADS for place in road})
    nodes = "".join(
        f'<node id="{rank}" version="1" lat="{lat:.7f}" lon="{lon:.7f}"/>'
        for rank, (lon, lat) in enumerate(degrees(places), start=1)
    )
    ways = "".join(
        f'<way id="{700 + row}" version="1">'
        + "".join(f'<nd ref="{places.index(place) + 1}"/>' for place in ROADS[row])
        + '<tag k="highway" v="tertiary"/></way>'
        for row in MAPPED
    )
    (tmp_path / "map.osm").write_text(f'<osm version="0.6">{nodes}{ways}</osm>', encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_commands_of_the_page_find_the_road_that_the_map_lacks(folder: Path) -> None:
    (block,) = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines():
        with pytest.raises(SystemExit) as stop:
            main(shlex.split(line)[1:])
        assert stop.value.code == 0, line
    changes = gpd.read_file(folder / "changes.gpkg")
    (added,) = changes[changes["change"] == "added"].itertuples()
    assert added.length == pytest.approx(500, abs=60)
    confirmed = changes[changes["change"] == "confirmed"]
    assert set(confirmed["osmid"]) == {str(700 + row) for row in MAPPED}
    document = ElementTree.parse(folder / "changes.osc").getroot()
    assert "road" in {tag.get("v") for tag in document.iter("tag") if tag.get("k") == "highway"}
    tasks = (folder / "tasks.geojsons").read_text(encoding="utf-8").split("\n")[:-1]
    assert "added" in {json.loads(task[1:])["features"][0]["properties"]["change"] for task in tasks}
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(code, "diff-with-a-map.md", "exec"), {})
    assert (folder / "certain.osc").exists()


def test_the_page_explains_every_change() -> None:
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == ["change", *DIFFERENCES]
