from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import networkx as nx
import numpy as np
import osmnx as ox
import pandas as pd
import pytest
import shapely

from probe2road.errors import CRSError, InputError, OptionError, OutputError
from probe2road.graph.direction import driving_direction, in_driving_direction
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.io.graph_files import WRITABLE, read_graph, write_graph
from probe2road.io.graph_networkx import from_networkx, to_networkx
from sketches import EAST, NORTH, UTM, graph_of


@pytest.fixture
def block() -> RoadGraph:
    """A two-way street, a one-way street parallel to it, and a loop at its end."""
    lines = [
        [(EAST, NORTH), (EAST + 100, NORTH)],
        [(EAST, NORTH), (EAST + 50, NORTH + 30), (EAST + 100, NORTH)],
        [(EAST + 100, NORTH), (EAST + 130, NORTH + 20), (EAST + 130, NORTH - 20), (EAST + 100, NORTH)],
    ]
    graph = graph_of(*lines)
    counts = {"forward": [9, 0, 3], "backward": [8, 12, 0], "support": [17, 12, 3]}
    return replace(graph, edges=graph.edges.assign(**counts).astype(dict.fromkeys(counts, "Int64")))


def test_networkx_has_both_directions_unless_the_counts_say_otherwise(block: RoadGraph) -> None:
    directed = block.to_networkx()
    ox.convert.validate_graph(directed)
    pairs = sorted((u, v, data["edge"], data["reversed"], data["oneway"]) for u, v, data in directed.edges(data=True))
    assert pairs == [
        (0, 1, 0, False, False),
        (1, 0, 0, True, False),
        (1, 0, 1, False, True),
        (1, 1, 2, False, False),
        (1, 1, 2, True, False),
    ]
    back = directed.edges[1, 0, 1]
    assert (back["forward"], back["backward"]) == (12, 0)
    assert back["geometry"].coords[0] == (EAST + 100, NORTH)


def test_osmnx_can_work_with_the_networkx_graph(block: RoadGraph) -> None:
    nodes, edges = ox.convert.graph_to_gdfs(block.to_networkx())
    assert nodes.crs.to_epsg() == 32616
    assert edges["length"].sum() == pytest.approx(2 * block.length - block.edges["length"].loc[1])
    assert nodes["street_count"].tolist() == [2, 4]


def test_a_foreign_osmnx_graph_becomes_one_edge_per_road() -> None:
    foreign = nx.MultiDiGraph(crs="EPSG:4326")
    foreign.add_nodes_from(
        [(10, {"x": -87.65, "y": 41.87}), (11, {"x": -87.64, "y": 41.87}), (12, {"x": -87.64, "y": 41.88})]
    )
    bend = shapely.LineString([(-87.64, 41.87), (-87.641, 41.875), (-87.64, 41.88)])
    foreign.add_edge(10, 11, osmid=[1, 2], highway="primary", oneway=False, length=830.0)
    foreign.add_edge(11, 10, osmid=[2, 1], highway="primary", oneway=False, length=830.0)
    foreign.add_edge(11, 12, osmid=3, highway="residential", oneway=True, length=1100.0, geometry=bend)
    graph = from_networkx(foreign)
    assert graph.crs.to_epsg() == 32616
    assert graph.edges[["u", "v", "osmid", "oneway", "origin"]].to_numpy().tolist() == [
        [10, 11, "1;2", False, "reference"],
        [11, 12, 3, True, "reference"],
    ]
    assert graph.edges["length"].tolist() == pytest.approx([830, 1124], rel=0.01)


def test_undirected_graphs_may_hold_their_geometry_either_way_round() -> None:
    undirected = nx.MultiGraph(crs=UTM)
    undirected.add_nodes_from([(0, {"x": EAST, "y": NORTH}), (1, {"x": EAST + 60, "y": NORTH + 80})])
    undirected.add_edge(0, 1, geometry=shapely.LineString([(EAST + 60, NORTH + 80), (EAST, NORTH + 80), (EAST, NORTH)]))
    graph = from_networkx(undirected)
    assert graph.edges["length"].tolist() == pytest.approx([140.0])


def test_networkx_graphs_without_crs_or_coordinates_are_refused() -> None:
    with pytest.raises(CRSError, match="has no CRS"):
        from_networkx(nx.MultiDiGraph())
    bare = nx.MultiDiGraph(crs=UTM)
    bare.add_node(1)
    with pytest.raises(InputError, match="nodes have no x and y"):
        from_networkx(bare)
    named = nx.MultiDiGraph(crs=UTM)
    named.add_node("A", x=0.0, y=0.0)
    with pytest.raises(InputError, match="node ids are not integers"):
        from_networkx(named)


def test_osmnx_reads_our_graphml(block: RoadGraph, tmp_path: Path) -> None:
    write_graph(block, tmp_path / "roads.graphml")
    loaded = ox.io.load_graphml(tmp_path / "roads.graphml")
    ox.convert.validate_graph(loaded)
    expected = block.to_networkx()
    assert set(loaded.edges) == set(expected.edges)
    for edge, data in loaded.edges.items():
        assert data["length"] == expected.edges[edge]["length"]
        assert data["oneway"] is expected.edges[edge]["oneway"]
        assert data["geometry"].equals(expected.edges[edge]["geometry"])


def test_we_read_graphml_of_osmnx(tmp_path: Path) -> None:
    foreign = nx.MultiDiGraph(crs="EPSG:4326")
    foreign.add_nodes_from([(10, {"x": -87.65, "y": 41.87, "street_count": 1}), (11, {"x": -87.64, "y": 41.87})])
    foreign.add_edge(10, 11, osmid=[1, 2], oneway=True, reversed=False, length=830.0)
    ox.io.save_graphml(foreign, tmp_path / "osmnx.graphml")
    graph = read_graph(tmp_path / "osmnx.graphml")
    assert graph.edges["oneway"].tolist() == [True]
    assert graph.length == pytest.approx(830, rel=0.01)


def test_a_tagged_one_way_street_keeps_its_tag(block: RoadGraph) -> None:
    tagged = replace(block, edges=block.edges.assign(oneway=["yes", "no", "-1"]))
    back = from_networkx(to_networkx(tagged))
    turned = in_driving_direction(tagged.edges)
    pd.testing.assert_frame_equal(pd.DataFrame(back.edges), pd.DataFrame(turned), check_like=True)
    assert back.edges["oneway"].tolist() == ["yes", "no", "yes"]


@pytest.mark.parametrize("suffix", sorted(WRITABLE))
def test_what_is_driven_against_its_line_is_written_turned(block: RoadGraph, tmp_path: Path, suffix: str) -> None:
    tagged = replace(block, edges=block.edges.assign(oneway=["-1", "no", "yes"]))
    write_graph(tagged, tmp_path / f"roads{suffix}")
    if suffix == ".geojson":
        assert '"-1"' not in (tmp_path / "roads.geojson").read_text()
    back = read_graph(tmp_path / f"roads{suffix}").edges
    assert back["oneway"].tolist() == ["yes", "no", "yes"]
    assert back[["u", "v", "forward", "backward"]].to_numpy().tolist() == [[1, 0, 8, 9], [0, 1, 0, 12], [1, 1, 3, 0]]
    assert shapely.get_x(shapely.get_point(back.geometry.to_numpy()[0], 0)) == pytest.approx(EAST + 100, abs=0.02)


@pytest.mark.parametrize("name", ["roads.gpkg", "roads.parquet", "roads.fgb", "roads.geojson", "roads.shp"])
@pytest.mark.parametrize(("words", "turned"), [(["-1", "yes"], ["yes", "yes"]), (["TF", "B"], ["FT", "B"])])
def test_lines_from_elsewhere_are_turned_into_their_driving_direction(
    tmp_path: Path, name: str, words: list[str], turned: list[str]
) -> None:
    lines = [shapely.LineString([(9.0, 48.0), (9.01, 48.0)]), shapely.LineString([(9.01, 48.0), (9.02, 48.0)])]
    table = gpd.GeoDataFrame({"oneway": words}, geometry=lines, crs="EPSG:4326")
    table.to_parquet(tmp_path / name) if name.endswith("parquet") else table.to_file(tmp_path / name)
    edges = read_graph(tmp_path / name).edges
    edges = edges.loc[edges.centroid.x.sort_values().index]  # FlatGeobuf has an order of its own
    assert edges["oneway"].tolist() == turned
    assert len(set(edges["u"])) == 1  # both start where they meet
    assert len({line.coords[0] for line in edges["geometry"]}) == 1
    assert driving_direction(edges).tolist() == [1, int(turned[1] == "yes")]


def test_a_directed_edge_from_elsewhere_is_driven_as_it_runs_whatever_its_tag() -> None:
    foreign = nx.MultiDiGraph(crs=UTM)
    foreign.add_nodes_from([(7, {"x": EAST, "y": NORTH}), (9, {"x": EAST + 30, "y": NORTH})])
    foreign.add_edge(9, 7, oneway="-1")
    edges = from_networkx(foreign).edges
    assert edges[["u", "v", "oneway"]].to_numpy().tolist() == [[9, 7, True]]


@pytest.mark.parametrize("suffix", sorted(WRITABLE))
@pytest.mark.parametrize(
    "column",
    [
        {"trace_id": 1},
        {"vehicle_id": "A7"},
        {"t": 5.0},
        {"Timestamp": 0},
        {"seen": pd.Timestamp("2026-01-01", tz="UTC")},
    ],
    ids=lambda column: next(iter(column)),
)
def test_ids_and_times_never_leave(block: RoadGraph, tmp_path: Path, suffix: str, column: dict[str, object]) -> None:
    private = replace(block, edges=block.edges.assign(**column))
    with pytest.raises(OutputError, match="may identify drives; drop it before writing"):
        write_graph(private, tmp_path / f"roads{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_private_columns_of_nodes_and_turns_and_attributes_of_tables_stay_too(block: RoadGraph, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="column 'vehicle_id' of the nodes"):
        write_graph(replace(block, nodes=block.nodes.assign(vehicle_id=1)), tmp_path / "roads.gpkg")
    with pytest.raises(OutputError, match="column 'trace_id' of the turns"):
        write_graph(replace(block, turns=block.turns.assign(trace_id=1)), tmp_path / "roads.gpkg")
    block.edges.attrs["source"] = "vehicle A7"
    write_graph(block, tmp_path / "roads.parquet")
    assert b"vehicle A7" not in (tmp_path / "roads.parquet").read_bytes()


def test_values_that_no_format_holds_are_refused(block: RoadGraph, tmp_path: Path) -> None:
    lists = replace(block, edges=block.edges.assign(lanes=[[1, 2], [1], [2]]))
    with pytest.raises(OutputError, match="column 'lanes' of the edges holds values that are not numbers or text"):
        write_graph(lists, tmp_path / "roads.gpkg")


def test_a_broken_graph_is_not_written(block: RoadGraph, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="ends at a node that does not exist"):
        write_graph(replace(block, nodes=block.nodes.iloc[:1]), tmp_path / "roads.gpkg")
    assert list(tmp_path.iterdir()) == []


def test_unknown_suffixes_are_named(block: RoadGraph, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"roads\.dxf: suffix is of no known format; use one of"):
        write_graph(block, tmp_path / "roads.dxf")
    with pytest.raises(OptionError, match="no known format"):
        read_graph(tmp_path / "roads.xyz")


@pytest.mark.parametrize("suffix", sorted(WRITABLE))
def test_absent_empty_and_damaged_files_get_one_clear_error(block: RoadGraph, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"roads{suffix}"
    with pytest.raises(InputError, match="no such file"):
        read_graph(path)
    path.touch()
    with pytest.raises(InputError, match="the file is empty"):
        read_graph(path)
    write_graph(block, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError, match=f"roads{suffix}: "):
        read_graph(path)
    path.write_bytes(b"this is not a graph at all\n" * 10)
    with pytest.raises(InputError, match=f"roads{suffix}: "):
        read_graph(path)


@pytest.mark.parametrize("suffix", sorted(WRITABLE))
def test_the_graph_without_roads_can_be_written_and_read(tmp_path: Path, suffix: str) -> None:
    write_graph(empty_graph(UTM), tmp_path / f"nothing{suffix}")
    graph = read_graph(tmp_path / f"nothing{suffix}")
    assert (len(graph.nodes), len(graph.edges), graph.crs.to_epsg()) == (0, 0, 32616)


@pytest.mark.parametrize("suffix", sorted(WRITABLE))
def test_another_metric_crs_can_be_asked_for(block: RoadGraph, tmp_path: Path, suffix: str) -> None:
    write_graph(block, tmp_path / f"roads{suffix}")
    graph = read_graph(tmp_path / f"roads{suffix}", target_crs="EPSG:32615")
    assert graph.crs.to_epsg() == 32615
    back = graph.to_crs(UTM)
    driven = in_driving_direction(block.edges)
    moved = shapely.get_coordinates(back.edges.geometry) - shapely.get_coordinates(driven.geometry)
    assert np.abs(moved).max() < 0.02
