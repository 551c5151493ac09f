"""Networks as people have them: read as the roads that they mean."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.crs import CRS, working_crs
from probe2road.errors import CRSError, InputError
from probe2road.graph.check import check_graph
from probe2road.graph.lines import cut_at_ends, one_line_each
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.graph_files import read_graph

EAST, NORTH = 500000.0, 5316000.0
UTM = "EPSG:32632"


def line(*places: tuple[float, ...]) -> shapely.LineString:
    return shapely.LineString([(EAST + x, NORTH + y, *z) for x, y, *z in places])


def graph_through_file(
    path: Path, lines: list[shapely.LineString], crs: str = UTM, **columns: list[object]
) -> RoadGraph:
    """Write lines to a GIS file and read them."""
    gpd.GeoDataFrame(columns, geometry=lines, crs=UTM).to_crs(crs).to_file(path)
    graph = read_graph(path)
    check_graph(graph)
    return graph


@pytest.mark.parametrize("name", ["city.geojson", "city.gpkg", "city.fgb", "city.shp"])
def test_a_line_for_each_direction_is_one_edge(tmp_path: Path, name: str) -> None:
    street, lane = line((0, 0), (50, 4), (100, 0)), line((100, 0), (100, 80))
    crs = "EPSG:4326" if name.endswith("geojson") else UTM
    graph = graph_through_file(tmp_path / name, [street, street.reverse(), lane, lane.reverse()], crs=crs)
    assert len(graph.edges) == 2
    assert sorted(graph.degrees()) == [1, 1, 2]


@pytest.mark.parametrize(
    ("told", "kept"),
    [
        (("yes", "yes"), "no"),
        (("yes", "-1"), "yes"),
        ((None, None), None),
        (("no", "yes"), "no"),
        (("yes", "no"), "no"),
    ],
)
def test_two_lines_are_open_where_either_is(told: tuple[str, str], kept: str | None) -> None:
    street = line((0, 0), (100, 0))
    lines, rows = one_line_each(np.array([street, street.reverse()]), pd.DataFrame({"oneway": list(told)}))
    assert len(lines) == 1
    assert [None if pd.isna(word) else word for word in rows["oneway"]] == [kept]


def test_a_line_that_is_there_twice_is_not_a_street_of_two_directions() -> None:
    street, ring = line((0, 0), (100, 0)), line((0, 0), (9, 0), (9, 9), (0, 0))
    lines = np.array([street, street, street.reverse(), ring, line((0, 0), (0, 50))])
    kept, rows = one_line_each(lines, pd.DataFrame({"n": range(5)}))
    assert rows["n"].tolist() == [0, 1, 3, 4]
    assert len(kept) == 4


def test_a_side_street_that_ends_on_an_inner_vertex_meets_the_road(tmp_path: Path) -> None:
    main, side = line((0, 0), (400, 0), (800, 0)), line((400, 0), (400, 300))
    over = line((200, -50), (200, 50))
    graph = graph_through_file(
        tmp_path / "city.geojson", [main, side, over], "EPSG:4326", name=["main", "side", "over"]
    )
    assert graph.edges["name"].tolist() == ["main", "main", "side", "over"]
    assert sorted(graph.degrees()) == [1, 1, 1, 1, 1, 3]
    apart = read_graph(tmp_path / "city.geojson", inner_junctions=False)
    assert len(apart.edges) == 3
    assert (apart.degrees() == 1).all()


def test_an_end_on_another_level_meets_nothing() -> None:
    main, ramp = line((0, 0, 10), (50, 0, 10), (100, 0, 10)), line((50, 0, 4), (50, 40, 4))
    assert len(cut_at_ends(np.array([main, ramp]), snap=0.01)[0]) == 2
    assert len(cut_at_ends(np.array([main, line((50, 0, 9), (50, 40, 9))]), snap=0.01)[0]) == 3
    parts, _ = cut_at_ends(np.array([main, line((50, 0), (50, 40))]), snap=0.01)
    assert shapely.has_z(parts).tolist() == [True, True, False]


def test_a_line_that_ends_on_itself_becomes_a_stem_and_a_loop() -> None:
    lasso = line((0, 0), (50, 0), (90, 40), (90, -40), (50, 0))
    parts, row = cut_at_ends(np.array([lasso]), snap=0.01)
    assert row.tolist() == [0, 0]
    assert parts[0].length == pytest.approx(50)


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:3395", "EPSG:6933"])
def test_what_is_not_true_to_scale_is_projected(tmp_path: Path, crs: str) -> None:
    graph = graph_through_file(tmp_path / "city.gpkg", [line((0, 0), (1000, 0)), line((0, 50), (0, 2050))], crs)
    assert graph.crs.to_epsg() == 32632
    assert graph.length == pytest.approx(3000, abs=0.1)


def test_a_crs_that_is_not_true_to_scale_cannot_be_asked_for(tmp_path: Path) -> None:
    graph_through_file(tmp_path / "city.gpkg", [line((0, 0), (1000, 0))])
    with pytest.raises(CRSError, match=r"city\.gpkg: a metre of .* is no metre .* target_crs=.EPSG:32632"):
        read_graph(tmp_path / "city.gpkg", target_crs="EPSG:3857")
    assert working_crs(CRS.from_epsg(3857), [1e6], [6e6], own=True).to_epsg() == 3857


NODES = {1: (9.0, 48.0), 2: (9.003, 48.0), 3: (9.003, 48.002)}


def graphml(edges: str) -> str:
    nodes = "".join(
        f'<node id="{n}"><data key="y">{lat}</data><data key="x">{lon}</data></node>' for n, (lon, lat) in NODES.items()
    )
    keys = "".join(
        f'<key id="{name}" for="{of}" attr.name="{name}" attr.type="string"/>'
        for name, of in (("crs", "graph"), ("x", "node"), ("y", "node"), ("oneway", "edge"), ("geometry", "edge"))
    )
    head = '<graphml xmlns="http://graphml.graphdrawing.org/xmlns">'
    return f'{head}{keys}<graph edgedefault="directed"><data key="crs">epsg:4326</data>{nodes}{edges}</graph></graphml>'


def test_graphml_in_which_only_bent_edges_have_geometry(tmp_path: Path) -> None:
    edges = (
        '<edge source="1" target="2" id="0"><data key="oneway">False</data></edge>'
        '<edge source="2" target="1" id="0"><data key="oneway">False</data></edge>'
        '<edge source="2" target="3" id="0"><data key="oneway">True</data>'
        '<data key="geometry">LINESTRING (9.003 48.0, 9.0031 48.001, 9.003 48.002)</data></edge>'
    )
    path = tmp_path / "net.graphml"
    path.write_text(graphml(edges))
    graph = read_graph(path)
    check_graph(graph)
    assert sorted(graph.degrees()) == [1, 1, 2]
    assert graph.edges["oneway"].astype(str).tolist() == ["False", "True"]


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda text: text.replace('<data key="crs">epsg:4326</data>', ""), "has no CRS; write it with a CRS"),
        (lambda text: text.replace("epsg:4326", "here"), "'here' is not a coordinate reference system"),
        (lambda text: text.replace(">48.0<", ">north<"), "x and y of the nodes are not numbers"),
        (lambda text: text.replace(">48.0<", ">inf<"), "some nodes have no x and y"),
        (lambda text: text.replace('id="3"', 'id="three"'), "cannot be read as GraphML"),
        (lambda text: f"<?xml version='1.0' encoding='{'A' * 900}'?>{text}", "cannot be read as GraphML"),
    ],
)
def test_faults_of_graphml_name_the_file(tmp_path: Path, damage: object, told: str) -> None:
    path = tmp_path / "net.graphml"
    path.write_text(damage(graphml('<edge source="1" target="2" id="0"/>')))  # type: ignore[operator]
    with pytest.raises((InputError, CRSError)) as caught:
        read_graph(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert told in str(caught.value)
    assert len(str(caught.value)) < 600


def osm(way_10: str = "", way_11: str = "", nodes: bool = True, inline: bool = False) -> str:
    """Return a street 1-2 and a street 2-3, with further attributes."""
    placed = {n: f'lat="{lat}" lon="{lon}"' for n, (lon, lat) in NODES.items()}
    content = "".join(f'<node id="{n}" {place}/>' for n, place in placed.items()) if nodes else ""
    for name, refs, more in ((10, (1, 2), way_10), (11, (2, 3), way_11)):
        vertices = "".join(f'<nd ref="{n}" {placed[n] if inline else ""}/>' for n in refs)
        content += f'<way id="{name}" {more}>{vertices}<tag k="highway" v="residential"/></way>'
    return f'<osm version="0.6">{content}</osm>'


@pytest.mark.parametrize("mark", ["action='delete'", 'version="2" action="delete"', 'visible="false" version="2"'])
def test_a_deleted_way_is_no_road(tmp_path: Path, mark: str) -> None:
    (tmp_path / "edited.osm").write_text(osm(way_11=mark))
    assert read_graph(tmp_path / "edited.osm").edges["osmid"].tolist() == [10]
    (tmp_path / "edited.osm").write_text(osm(way_11='action="modify" visible="true"'))
    assert len(read_graph(tmp_path / "edited.osm").edges) == 2


def test_positions_may_stand_inside_of_ways(tmp_path: Path) -> None:
    (tmp_path / "inline.osm").write_text(osm(nodes=False, inline=True))
    (tmp_path / "beside.osm").write_text(osm())
    inline, beside = (read_graph(tmp_path / name) for name in ("inline.osm", "beside.osm"))
    assert inline.edges.geometry.geom_equals_exact(beside.edges.geometry, 1e-6).all()
    assert sorted(inline.degrees()) == [1, 1, 2]


def test_an_answer_of_overpass_without_positions_names_file_and_remedy(tmp_path: Path) -> None:
    (tmp_path / "bare.osm").write_text(osm(nodes=False))
    with pytest.raises(InputError, match=r"bare\.osm: no way has its nodes in the file; .*out geom"):
        read_graph(tmp_path / "bare.osm")


@pytest.mark.parametrize("refs", [True, False])
def test_answers_of_overpass_in_json(tmp_path: Path, refs: bool) -> None:
    ways = []
    for name, nodes in ((10, (1, 2)), (11, (2, 3))):
        places = [{"lon": NODES[n][0], "lat": NODES[n][1]} for n in nodes]
        way = {"type": "way", "id": name, "tags": {"highway": "residential", "oneway": "yes"}, "geometry": places}
        ways.append({**way, "nodes": list(nodes)} if refs else way)
    ways.append({"type": "way", "id": 12, "tags": {"highway": "footway"}, "geometry": places})
    (tmp_path / "roads.json").write_text(json.dumps({"version": 0.6, "elements": ways}))
    graph = read_graph(tmp_path / "roads.json")
    check_graph(graph)
    assert graph.edges["osmid"].tolist() == [10, 11]
    assert sorted(graph.degrees()) == [1, 1, 2]


def test_ways_keep_the_parts_inside_of_an_extract(tmp_path: Path) -> None:
    places = {n: (9 + n / 1000, 48.0) for n in range(1, 8)}
    inside = (1, 2, 4, 5, 7)
    nodes = "".join(f'<node id="{n}" lat="{places[n][1]}" lon="{places[n][0]:.3f}"/>' for n in inside)
    refs = "".join(f'<nd ref="{n}"/>' for n in places)
    (tmp_path / "cut.osm").write_text(
        f'<osm version="0.6">{nodes}<way id="7">{refs}<tag k="highway" v="service"/></way></osm>'
    )
    graph = read_graph(tmp_path / "cut.osm")
    check_graph(graph)
    assert graph.edges["osmid"].tolist() == [7, 7]  # no chord from 2 to 4
    assert graph.length == pytest.approx(2 * 74.6, abs=1)
