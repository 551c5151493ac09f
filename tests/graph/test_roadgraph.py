from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import CRSError, InputError
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.graph.tables import TURN_DTYPES
from sketches import UTM


@pytest.fixture
def tee() -> RoadGraph:
    """Three edges that meet in one junction at (100, 0)."""
    return graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (200, 0)], [(100, 0), (100, 80)]], crs=UTM)


def test_nodes_are_junctions_and_dead_ends(tee: RoadGraph) -> None:
    check_graph(tee)
    assert tee.degrees().tolist() == [1, 3, 1, 1]
    assert tee.length == 280.0
    assert tee.bounds == (0.0, 0.0, 200.0, 80.0)


def test_lines_that_cross_stay_apart() -> None:
    graph = graph_from_lines([[(0, 0), (100, 0)], [(50, -50), (50, 50)]], crs=UTM)
    assert len(graph.nodes) == 4


def test_ends_within_the_snapping_distance_are_one_node_even_across_a_rounding_boundary() -> None:
    graph = graph_from_lines([[(0, 0), (100.0049, 0)], [(100.0051, 0), (200, 0)]], crs=UTM, snap=0.001)
    assert graph.edges[["u", "v"]].to_numpy().tolist() == [[0, 1], [1, 2]]
    check_graph(graph)
    apart = graph_from_lines([[(0, 0), (100, 0)], [(100.02, 0), (200, 0)]], crs=UTM)
    assert len(apart.nodes) == 4


def test_lines_no_longer_than_the_snapping_distance_are_left_out() -> None:
    graph = graph_from_lines([[(0, 0), (0.005, 0)], [(0, 0), (9, 0)]], crs=UTM)
    assert graph.edges["length"].tolist() == [9.0]
    check_graph(graph)


def test_a_line_between_chained_ends_is_swallowed_whole() -> None:
    ends = [(0.0, 0.0), (0.008, 0.0), (0.016, 0.0)]
    lines = [[end, (50, 50 * number)] for number, end in enumerate(ends)]
    graph = graph_from_lines([*lines, [ends[0], ends[2]]], crs=UTM)
    check_graph(graph)
    assert len(graph.edges) == 3


def test_attributes_follow_the_parts_of_their_line() -> None:
    lines = [
        shapely.MultiLineString([[(0, 0), (9, 0)], [(20, 0), (29, 0)]]),
        shapely.Point(0, 0),
        None,
        [(9, 0), (20, 0)],
    ]
    attributes = pd.DataFrame(
        {"name": ["A", "point", "nothing", "B"], "u": 99, "support": [1, 2, 3, 4]}, index=list("wxyz")
    )
    graph = graph_from_lines(lines, crs=UTM, attributes=attributes)
    assert graph.edges["name"].tolist() == ["A", "A", "B"]
    assert graph.edges["support"].tolist() == [1, 1, 4]
    assert graph.edges["u"].tolist() == [0, 2, 1]


def test_heights_stay_with_their_lines() -> None:
    graph = graph_from_lines([[(0, 0, 5), (9, 0, 6)], [(9, 0), (18, 0)]], crs=UTM)
    assert shapely.has_z(graph.edges.geometry.to_numpy()).tolist() == [True, False]
    assert graph.edges.geometry.iloc[0].wkt == "LINESTRING Z (0 0 5, 9 0 6)"


def test_the_empty_graph_has_every_column_in_its_type() -> None:
    graph = empty_graph(UTM)
    check_graph(graph)
    filled = graph_from_lines([[(0, 0), (1, 0)]], crs=UTM)
    pd.testing.assert_series_equal(graph.edges.dtypes, filled.edges.dtypes)
    assert graph.length == 0.0
    assert np.isnan(graph.bounds).all()


def test_degrees_are_refused() -> None:
    with pytest.raises(CRSError, match="in degrees"):
        graph_from_lines([[(8, 48), (9, 48)]], crs="EPSG:4326")
    with pytest.raises(CRSError, match="no CRS"):
        graph_from_lines([], crs=None)


def test_another_crs_measures_lengths_anew(tee: RoadGraph) -> None:
    moved = replace(tee, nodes=tee.nodes.translate(500000, 4e6).to_frame("geometry"), edges=tee.edges.copy())
    moved.edges["geometry"] = tee.edges.geometry.translate(500000, 4e6)
    mercator = moved.to_crs("EPSG:3857")
    check_graph(mercator)
    assert mercator.length == pytest.approx(tee.length / np.cos(np.radians(36.1)), rel=0.01)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"v": [1, 2, 9]}, r"edge 2 ends at a node that does not exist \(v = 9\)"),
        ({"u": [0, 1, 0]}, "edge 2 does not touch its node u"),
        ({"length": [100.0, 99.0, 80.0]}, "edge 1 has a length that differs from its geometry"),
        ({"origin": ["gap", "gap", "dream"]}, "edge 2 has an unknown origin"),
    ],
)
def test_broken_invariants_are_named(tee: RoadGraph, damage: dict[str, list[object]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_graph(replace(tee, edges=tee.edges.assign(**damage)))


def test_repeated_ids_and_keys_are_named(tee: RoadGraph) -> None:
    twice = pd.concat([tee.edges, tee.edges.iloc[:1]])
    with pytest.raises(InputError, match="edge ids are not unique"):
        check_graph(replace(tee, edges=twice))
    with pytest.raises(InputError, match=r"edge 3 repeats the \(u, v, key\) of another"):
        check_graph(replace(tee, edges=twice.set_axis([0, 1, 2, 3])))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ((0, 1, 7, 2), "1 turns are between edges that do not exist"),
        ((0, 0, 1, 2), "1 turns are at a node that is not"),
    ],
)
def test_turns_must_be_possible(tee: RoadGraph, row: tuple[int, ...], message: str) -> None:
    turns = pd.DataFrame([(0, 1, 2, 5), row], columns=list(TURN_DTYPES))
    check_graph(replace(tee, turns=turns.iloc[:1]))
    with pytest.raises(InputError, match=message):
        check_graph(replace(tee, turns=turns))
