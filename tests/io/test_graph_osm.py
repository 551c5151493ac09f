from __future__ import annotations

import os
from pathlib import Path

import pytest
import shapely

from probe2road.errors import InputError
from probe2road.graph.check import check_graph
from probe2road.io.graph_files import read_graph
from probe2road.io.osm import read_osm

DATA = Path(os.environ.get("PROBE2ROAD_DATA", "../shared/data"))

# A street (1-2-3) that a side street (2-4) joins, a motorway above them (5-6), a footway and a way cut off.
EXTRACT = """<?xml version='1.0' encoding='UTF-8'?>
<osm version="0.6" generator="by hand">
  <node id="1" lat="48.0000" lon="9.0000"/> <node id="2" lat="48.0000" lon="9.0010"/>
  <node id="3" lat="48.0000" lon="9.0020"/> <node id="4" lat="48.0010" lon="9.0010"/>
  <node id="5" lat="47.9990" lon="9.0015"/> <node id="6" lat="48.0010" lon="9.0015"/>
  <way id="10"><nd ref="1"/><nd ref="2"/><nd ref="3"/>
    <tag k="highway" v="residential"/><tag k="name" v="Seeweg"/><tag k="oneway" v="-1"/></way>
  <way id="11"><nd ref="2"/><nd ref="4"/><tag k="highway" v="service"/></way>
  <way id="12"><nd ref="5"/><nd ref="6"/>
    <tag k="highway" v="motorway"/><tag k="bridge" v="yes"/><tag k="layer" v="1"/><tag k="lanes" v="3"/></way>
  <way id="13"><nd ref="3"/><nd ref="4"/><tag k="highway" v="footway"/></way>
  <way id="14"><nd ref="3"/><nd ref="99"/><tag k="highway" v="primary"/></way>
  <way id="15"><nd ref="1"/><nd ref="4"/><tag k="waterway" v="river"/></way>
</osm>
"""


@pytest.fixture
def extract(tmp_path: Path) -> Path:
    path = tmp_path / "lake.osm"
    path.write_text(EXTRACT)
    return path


def test_ways_are_split_where_they_share_a_node_and_bridges_pass_over(extract: Path) -> None:
    graph = read_graph(extract)
    check_graph(graph)
    assert graph.crs.to_epsg() == 32632
    assert graph.edges["osmid"].tolist() == [10, 10, 11, 12]
    assert sorted(graph.degrees()) == [1, 1, 1, 1, 1, 3]
    assert graph.edges["highway"].tolist() == ["residential", "residential", "service", "motorway"]
    assert graph.edges["name"].fillna("").tolist() == ["Seeweg", "Seeweg", "", ""]
    assert graph.edges["oneway"].fillna("").tolist() == ["yes", "yes", "", "yes"]
    drawn = [shapely.get_coordinates(line)[:, 0] for line in graph.edges.geometry]
    assert [x[0] > x[-1] for x in drawn[:2]] == [True, True]  # the street is driven to the west
    assert graph.edges.loc[3, ["bridge", "layer", "lanes"]].tolist() == ["yes", "1", "3"]


def test_ways_that_reach_beyond_the_extract_are_counted(extract: Path, caplog: pytest.LogCaptureFixture) -> None:
    read_graph(extract)
    assert "1 ways reach beyond the extract; the parts inside are kept, 1 have none" in caplog.text


def test_the_classes_to_keep_can_be_chosen(extract: Path) -> None:
    assert read_osm(extract, highways={"footway"}).edges["osmid"].tolist() == [13]
    assert set(read_osm(extract, highways=None).edges["osmid"]) == {10, 11, 12, 13}
    with pytest.raises(InputError, match="holds no way with highway = bridleway"):
        read_osm(extract, highways={"bridleway"})


def test_a_closed_way_is_a_loop_and_a_way_may_visit_a_node_twice(tmp_path: Path) -> None:
    nodes = "".join(f'<node id="{n}" lat="{48 + n % 3 / 1000}" lon="{9 + n // 3 / 1000}"/>' for n in range(1, 7))
    refs = [1, 2, 4, 3, 2, 6]  # an arm, a round trip back to node 2, another arm
    way = "".join(f'<nd ref="{ref}"/>' for ref in refs)
    ring = "".join(f'<nd ref="{ref}"/>' for ref in (5, 6, 1, 5))
    document = f"<osm version='0.6'>{nodes}<way id='1'>{way}<tag k='highway' v='road'/></way>"
    path = tmp_path / "loop.osm"
    path.write_text(
        f"{document}<way id='2'>{ring}<tag k='highway' v='road'/><tag k='junction' v='roundabout'/></way></osm>"
    )
    graph = read_graph(path)
    check_graph(graph)
    assert (graph.edges["u"] == graph.edges["v"]).sum() == 1
    assert graph.edges["osmid"].tolist() == [1, 1, 1, 2, 2, 2]
    assert graph.edges["oneway"].isna().tolist() == [True, True, True, False, False, False]


@pytest.mark.skipif(not (DATA / "osm").is_dir(), reason=f"needs the shared OSM extracts in {DATA / 'osm'}")
def test_a_real_extract_is_a_sound_graph() -> None:
    graph = read_graph(DATA / "osm" / "columbus.osm.pbf")
    check_graph(graph)
    assert graph.crs.to_epsg() == 32617
    assert set(graph.edges["highway"].unique()) >= {"motorway", "primary"}
    # Nearly every end of a way in an extract of main roads is where another begins.
    assert (graph.degrees() == 1).mean() < 0.5


@pytest.mark.skipif(not (DATA / "traces").is_dir(), reason=f"needs the shared reference maps in {DATA / 'traces'}")
@pytest.mark.parametrize(("city", "epsg"), [("chicago_shuttle", 32616), ("athens_small", 2100)])
@pytest.mark.parametrize("name", ["gt_osm_full", "gt_traversed_graph", "gt_traversed_tang"])
def test_the_published_reference_maps_are_sound_graphs(city: str, epsg: int, name: str) -> None:
    graph = read_graph(DATA / "traces" / city / f"{name}.geojson")
    check_graph(graph)
    assert graph.crs.to_epsg() == epsg
    assert (graph.edges["origin"] == "reference").all()
    assert ("trips_near" in graph.edges) == (name == "gt_traversed_graph")
