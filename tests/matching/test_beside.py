"""The nearest edge of about a direction, for places on a road, beside it and across it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.matching.beside import edge_beside
from sketches import UTM, graph_of

EAST = graph_of([(0, 0), (100, 0)], [(0, 6), (100, 6)], [(50, -50), (50, 50)])


def found(*places: ArrayLike, course: float = 0.0, graph: RoadGraph = EAST, radius: float = 4.0) -> list[int]:
    angle = np.radians(course)
    direction = np.tile([np.cos(angle), np.sin(angle)], (len(places), 1))
    return edge_beside(graph, np.array(places, float), direction, radius=radius, max_angle=20.0).tolist()


def test_the_nearest_edge_of_the_direction():
    assert found((20, 2.9), (20, 3.1), (50, 0), (20, -4.0), (20, -4.1)) == [0, 1, 0, 0, -1]


def test_either_way_and_up_to_the_angle():
    assert found((20, 0), course=180.0) == found((20, 0), course=19.9) == [0]
    assert found((20, 0), course=20.1) == [-1]
    assert found((50, 20), course=-90.0) == [2]


def test_the_first_of_two_that_are_as_near():
    assert found((20, 3.0)) == [0]


def test_an_edge_ends_where_it_ends():
    assert found((-4.0, 0), (-4.1, 0)) == [0, -1]


def test_heights_do_not_matter():
    assert found((20, 1.0), graph=graph_of([(0, 0, 50), (100, 0, 60)])) == [0]


def test_nothing_there():
    assert found((20, 0), graph=empty_graph(UTM)) == [-1]
    assert edge_beside(EAST, np.zeros((0, 2)), np.zeros((0, 2)), radius=4.0, max_angle=20.0).tolist() == []
