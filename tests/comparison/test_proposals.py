"""Files for mappers: what JOSM and MapRoulette read."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from xml.etree import ElementTree

import geopandas as gpd
import osmium
import pandas as pd
import pytest

from probe2road.comparison.diff import diff
from probe2road.comparison.proposals import osm_change, task_lines, write_diff
from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from sketches import EAST, NORTH, UTM

LINES = [[(0, 0, 1), (400, 0, 1)], [(400, 0, 1), (400, 300, 2)], [(400, 0, 1), (800, 0, 1)]]


def at_place(lines: list[list[tuple[float, ...]]], **columns: object) -> RoadGraph:
    moved = [[(EAST + x, NORTH + y, *z) for x, y, *z in line] for line in lines]
    return graph_from_lines(moved, crs=UTM, attributes=pd.DataFrame(columns, index=range(len(lines))))


@pytest.fixture(scope="module")
def found() -> gpd.GeoDataFrame:
    ours = at_place(LINES, forward=[40, 30, 40], backward=[0, 30, 30], support=[40, 60, 70], oneway=["yes", "no", "no"])
    base = at_place([LINES[0], LINES[2]], osmid=[77, 78], oneway=["-1", "no"])
    return diff(ours, base)


class Reader(osmium.SimpleHandler):
    """Collects what osmium finds in a file."""

    def __init__(self) -> None:
        super().__init__()
        self.nodes: dict[int, dict[str, str]] = {}
        self.ways: dict[int, tuple[list[int], dict[str, str]]] = {}

    def node(self, node: osmium.osm.Node) -> None:
        assert node.location.valid()
        self.nodes[node.id] = dict(node.tags)

    def way(self, way: osmium.osm.Way) -> None:
        self.ways[way.id] = ([node.ref for node in way.nodes], dict(way.tags))


def test_osmium_reads_the_file_for_josm(found: gpd.GeoDataFrame, tmp_path: Path) -> None:
    assert set(found["change"]) == {"confirmed", "added", "direction_changed"}
    write_diff(found, tmp_path / "todo.osc")
    reader = Reader()
    reader.apply_file(tmp_path / "todo.osc")
    ((refs, tags),) = reader.ways.values()
    assert all(node < 0 for node in reader.nodes)
    assert set(refs) <= set(reader.nodes)
    assert tags["highway"] == "road"
    assert tags["probe2road:change"] == "added"
    assert tags["probe2road:support"] == "60"
    (note,) = [node for node in reader.nodes.values() if node]
    assert note["fixme"] == "Driven 0 times along the way and 40 times against it: oneway=-1?"
    assert note["probe2road:way"] == "77"


def test_every_line_is_a_cooperative_task(found: gpd.GeoDataFrame, tmp_path: Path) -> None:
    write_diff(found, tmp_path / "tasks.geojsons")
    text = (tmp_path / "tasks.geojsons").read_text(encoding="utf-8")
    lines = text.split("\n")[:-1]  # splitlines would split at the separator, too
    assert len(lines) == 2
    assert text.endswith("\n")
    for line in lines:
        assert line[0] == "\x1e"
        task = json.loads(line[1:])
        assert task["type"] == "FeatureCollection"
        (feature,) = task["features"]
        assert all(len(place) == 2 for place in feature["geometry"]["coordinates"])
        assert task["cooperativeWork"]["meta"] == {"version": 2, "type": 2}
        file = task["cooperativeWork"]["file"]
        assert (file["type"], file["format"], file["encoding"]) == ("xml", "osc", "base64")
        change = ElementTree.fromstring(base64.b64decode(file["content"]))
        assert change.tag == "osmChange"
    named = [json.loads(line[1:])["features"][0]["properties"].get("@id") for line in lines]
    assert set(named) == {"way/77", None}


def test_the_most_probable_comes_first(found: gpd.GeoDataFrame) -> None:
    probability = [json.loads(line)["features"][0]["properties"]["probability"] for line in task_lines(found)]
    assert probability == sorted(probability, reverse=True)


def test_nothing_to_do_is_an_empty_change(found: gpd.GeoDataFrame) -> None:
    nothing = found[found["change"] == "confirmed"]
    assert len(list(ElementTree.fromstring(osm_change(nothing).split("\n", 1)[1])[0])) == 0
    assert task_lines(nothing) == []


@pytest.mark.parametrize("name", ["all.gpkg", "all.geoparquet"])
def test_the_layer_has_every_row(found: gpd.GeoDataFrame, tmp_path: Path, name: str) -> None:
    write_diff(found, tmp_path / name)
    read = gpd.read_parquet if name.endswith("parquet") else gpd.read_file
    again = read(tmp_path / name)
    assert again["change"].tolist() == found["change"].tolist()
    assert again.crs == found.crs


def test_another_suffix_is_refused(found: gpd.GeoDataFrame, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"no table is written to \.xlsx"):
        write_diff(found, tmp_path / "all.xlsx")
