"""Dead ends beside a busy road, within the errors of its fixes, are strays; other dead ends are roads."""

from __future__ import annotations

import numpy as np
import pytest

from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import match
from probe2road.refinement.strays import StrayOptions, drop_strays
from sketches import fleet_of, graph_of, spaced

STREET = [[(0, 0), (60, 0)], [(60, 0), (400, 0)]]
EVENLY = np.linspace(-1.5, 1.5, 40)  # so that no drive along the street is nearer to a branch 18 m beside it


def kept(branch: list[tuple[float, float]], *, sigma: float = 5.0, on_branch: int = 1, **options: float) -> list[int]:
    """Return the edges left of a street with a branch, 40 drives along the street and a few on the branch."""
    graph, fleet = drives(branch, sigma, on_branch)
    return drop_strays(graph, fleet, match(graph, fleet), options=StrayOptions(**options)).edges.index.tolist()


def drives(branch: list[tuple[float, float]], sigma: float, on_branch: int) -> tuple[RoadGraph, Fleet]:
    along = [spaced((0, y), (400, y)) for y in sigma * EVENLY]
    aside = [spaced((0, 0), *branch)] * on_branch
    return graph_of(*STREET, branch), fleet_of(*along, *aside)


BESIDE = [(60, 0), (90, 18), (300, 18)]


def test_a_dead_end_within_the_errors_of_a_busy_road_is_a_stray():
    assert kept(BESIDE) == [0, 1]


def test_where_positions_are_good_it_is_a_road():
    assert kept(BESIDE, sigma=1.0) == [0, 1, 2]


def test_what_as_many_drove_as_one_in_twenty_is_a_road():
    assert kept(BESIDE, on_branch=3) == [0, 1, 2]
    assert kept(BESIDE, on_branch=3, ratio=10.0) == [0, 1]


def test_a_side_street_is_a_road():
    assert kept([(60, 0), (60, 15), (62, 120)]) == [0, 1, 2]


def test_a_road_that_leaves_the_busy_one_is_a_road():
    assert kept([(60, 0), (90, 14), (150, 40), (300, 80)]) == [0, 1, 2]


def test_what_leads_on_is_no_dead_end():
    lines = [*STREET, [(60, 0), (90, 18), (300, 18)], [(300, 18), (400, 0)], [(400, 0), (500, 0)]]
    fleet = fleet_of(*[spaced((0, y), (500, y)) for y in 5.0 * EVENLY], spaced((0, 0), *BESIDE, (400, 0)))
    graph = graph_of(*lines)
    assert drop_strays(graph, fleet, match(graph, fleet)) is graph


@pytest.mark.parametrize("graph", [graph_of(), graph_of(*STREET)], ids=["empty", "street"])
def test_a_graph_without_strays_comes_back_as_it_is(graph: RoadGraph):
    fleet = fleet_of(*[spaced((0, 0), (400, 0))] * 3)
    assert drop_strays(graph, fleet, match(graph, fleet)) is graph
