"""The ends of edges, and that a graph keeps what it has measured of them without showing it."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import shapely

from probe2road.graph.ends import line_ends
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from sketches import UTM, graph_of


@pytest.fixture
def bent() -> RoadGraph:
    """A road of 40 m that turns left after 30 m, and a loop of 40 m at its end."""
    graph = graph_of([(0, 0), (30, 0), (30, 10)], [(30, 10), (40, 10), (40, 20), (30, 20), (30, 10)])
    return replace(
        graph, nodes=graph.nodes.set_axis([7, 3]), edges=graph.edges.replace({"u": {0: 7, 1: 3}, "v": {1: 3}})
    )


def test_ends_are_numbered_by_edge_and_name_rows_of_nodes(bent: RoadGraph) -> None:
    assert bent.end_rows.tolist() == [[0, 1], [1, 1]]
    ends = bent.ends(reach=5.0)
    assert ends.node.tolist() == [0, 1, 1, 1]
    assert ends.position.tolist() == [[0, 0], [30, 10], [30, 10], [30, 10]]
    assert ends.ahead.tolist() == [[1, 0], [0, -1], [1, 0], [0, 1]]


@pytest.mark.parametrize(
    ("lengths", "vectors"),
    [
        ({"reach": 20.0}, [[20, 0], [-10, -10]]),
        ({"reach": 99.0}, [[30, 10], [-30, -10]]),
        ({"reach": 99.0, "share": 0.5}, [[20, 0], [-10, -10]]),
        ({"reach": 20.0, "skip": 5.0}, [[15, 0], [-10, -5]]),
        ({"reach": 20.0, "skip": 15.0}, [[10, 0], [-10, 0]]),
    ],
)
def test_what_directions_are_measured_over(lengths: dict[str, float], vectors: list[list[float]]) -> None:
    line = np.array([shapely.LineString([(0, 0, 5), (30, 0, 5), (30, 10, np.nan)])])
    position, vector = line_ends(line, **lengths)
    assert position.tolist() == [[0, 0], [30, 10]]
    assert vector.tolist() == vectors


def test_an_edge_that_comes_back_to_its_end_has_no_direction(bent: RoadGraph) -> None:
    assert bent.ends(reach=40.0).ahead[2:].tolist() == [[0, 0], [0, 0]]


def test_a_graph_without_edges_has_no_ends() -> None:
    ends = empty_graph(UTM).ends(reach=20.0)
    assert (ends.node.shape, ends.position.shape, ends.ahead.shape) == ((0,), (0, 2), (0, 2))


def test_ends_are_measured_once_for_each_choice_of_lengths_and_cannot_be_changed(bent: RoadGraph) -> None:
    assert bent.ends(reach=20.0) is bent.ends(reach=20.0)
    assert bent.ends(reach=20.0) is not bent.ends(reach=20.0, share=0.5)
    for array in (bent.end_rows, bent.ends(reach=20.0).node, bent.ends(reach=20.0).ahead):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_what_was_measured_does_not_travel_with_the_graph(bent: RoadGraph) -> None:
    bent.ends(reach=20.0)
    turned = replace(bent, edges=bent.edges.set_geometry(shapely.reverse(bent.edges.geometry.to_numpy()), crs=UTM))
    assert turned.ends(reach=5.0).ahead[0].tolist() == [0, -1]
    for other in (copy.copy(bent), pickle.loads(pickle.dumps(bent))):
        assert set(vars(other)) == {"nodes", "edges", "turns"}
        assert other.end_rows.tolist() == bent.end_rows.tolist()
