"""Export and read back is the identity, to the precision that each format documents."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from probe2road.crs import local_crs
from probe2road.graph.check import check_graph
from probe2road.graph.direction import in_driving_direction
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.graph.tables import TURN_DTYPES
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.io.graph_networkx import from_networkx, to_networkx

# Greatest displacement of a vertex, metres. Exact formats are exact to the last bit.
PRECISION = {
    "roads.gpkg": 0.0,
    "roads.parquet": 0.0,
    "roads.fgb": 0.0,
    "roads.graphml": 0.0,
    "roads.geojson": 0.002,
    "roads.osm": 0.012,
    "roads.osm.pbf": 0.012,
}
CRS_CHOICES = ("EPSG:32616", "EPSG:2056", local_crs([8.0, 16.5], [48.0, 48.0]))
ORIGINS = {"EPSG:32616": (446000.0, 4636000.0), "EPSG:2056": (2600000.0, 1200000.0)}


@st.composite
def graphs(draw: st.DrawFn) -> RoadGraph:
    """Networks on a few places 50 m apart: loops, parallel edges, some heights, some attributes missing."""
    crs = draw(st.sampled_from(CRS_CHOICES))
    east, north = ORIGINS.get(crs, (1000.0, 2000.0))
    places = [(east + 50 * column + column / 3, north + 50 * row + row / 7) for column in range(3) for row in range(3)]
    has_z = draw(st.booleans())
    lines, attributes = [], []
    for _ in range(draw(st.integers(0, 6))):
        u, v = draw(st.tuples(st.integers(0, 8), st.integers(0, 8)))
        bulge = draw(st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20)), min_size=2, max_size=4, unique=True))
        inner = [(places[u][0] + x + 25, places[u][1] + y + 25) for x, y in bulge]
        coordinates = np.array([places[u], *inner, places[v]])
        if has_z and draw(st.booleans()):
            coordinates = np.column_stack([coordinates, 100 + np.arange(len(coordinates)) / 4])
            coordinates[[0, -1], 2] = 100.0  # one height per junction, as OSM has it
        lines.append(shapely.LineString(coordinates))
        attributes.append(draw(st.tuples(counts, st.none() | st.floats(0, 1), counts, counts, names)))
    columns = ["support", "score", "forward", "backward", "name"]
    table = pd.DataFrame(attributes, columns=columns).astype({"score": "float64", "name": "str"})
    for column in ("support", "forward", "backward"):
        table[column] = table[column].astype("Int64")
    graph = graph_from_lines(lines, crs=crs, attributes=table)
    return replace(draw(with_other_ids(graph)), turns=pd.DataFrame(columns=TURN_DTYPES).astype(TURN_DTYPES))


counts = st.none() | st.integers(0, 50)
names = st.none() | st.sampled_from(["Main Street", "Südring & <Ring>", 'the "Bend"'])


@st.composite
def with_other_ids(draw: st.DrawFn, graph: RoadGraph) -> RoadGraph:
    """Ids need not be 0, 1, ...: shift them."""
    shift = draw(st.sampled_from([0, 1000, -5]))
    nodes, edges = graph.nodes.copy(), graph.edges.copy()
    nodes.index, edges.index = nodes.index + shift, edges.index + shift
    return replace(graph, nodes=nodes, edges=edges.assign(u=edges["u"] + shift, v=edges["v"] + shift))


def with_turns(graph: RoadGraph) -> RoadGraph:
    """Let every edge that ends where another starts be followed by it."""
    ends = graph.edges[["u", "v"]].reset_index()
    turns = ends.merge(ends, left_on="v", right_on="u", suffixes=("_from", "_to"))
    table = pd.DataFrame(
        {"from_edge": turns["edge_from"], "via_node": turns["v_from"], "to_edge": turns["edge_to"], "count": 3}
    )
    return replace(graph, turns=table.astype(TURN_DTYPES))


def in_their_direction(graph: RoadGraph) -> RoadGraph:
    """Turn what is driven from v to u only, as every file and every NetworkX graph has it."""
    return replace(graph, edges=in_driving_direction(graph.edges))


def assert_same(graph: RoadGraph, expected: RoadGraph, precision: float) -> None:
    check_graph(graph)
    assert graph.crs == expected.crs
    assert graph.nodes.index.tolist() == sorted(expected.nodes.index)
    tables = [pd.DataFrame(table.drop(columns=["geometry", "length"])) for table in (graph.edges, expected.edges)]
    if expected.edges["name"].isna().all():  # records cannot hold a further column that has no value
        tables = [table.drop(columns="name", errors="ignore") for table in tables]
    pd.testing.assert_frame_equal(*tables, check_like=True)
    lines, others = graph.edges.geometry.to_numpy(), expected.edges.geometry.to_numpy()
    assert shapely.has_z(lines).tolist() == shapely.has_z(others).tolist()
    assert shapely.get_num_coordinates(lines).tolist() == shapely.get_num_coordinates(others).tolist()
    if len(lines):
        moved = shapely.get_coordinates(lines) - shapely.get_coordinates(others)
        assert np.hypot(*moved.T).max() <= precision
        heights = [shapely.get_coordinates(shape, include_z=True)[:, 2] for shape in (lines, others)]
        np.testing.assert_allclose(*heights, atol=0.001)
    ordered = [turns.sort_values(list(TURN_DTYPES), ignore_index=True) for turns in (graph.turns, expected.turns)]
    pd.testing.assert_frame_equal(*ordered)


@pytest.mark.parametrize("name", PRECISION)
@settings(max_examples=15, deadline=None)
@given(graph=graphs(), driven=st.booleans())
def test_export_and_read_back_is_the_identity_but_for_turned_edges(name: str, graph: RoadGraph, driven: bool) -> None:
    graph = with_turns(graph) if driven else graph
    with tempfile.TemporaryDirectory() as folder:
        write_graph(graph, Path(folder) / name)
        assert_same(read_graph(Path(folder) / name), in_their_direction(graph), PRECISION[name])


@settings(max_examples=15, deadline=None)
@given(graph=graphs())
def test_networkx_and_back_is_the_identity_but_for_turned_edges(graph: RoadGraph) -> None:
    assert_same(from_networkx(to_networkx(with_turns(graph))), in_their_direction(with_turns(graph)), 0.0)
