"""Stretches that few traces passed go, where the roads of the graph are passed by more."""

from __future__ import annotations

import pytest

from probe2road.fleet.contract import Fleet
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import match
from probe2road.refinement.faint import FaintOptions, drop_faint
from sketches import fleet_of, graph_of, spaced

THROUGH, ASIDE = ((0, 0), (90, 0), (180, 0)), ((0, 0), (90, 0), (90, 80))


def clear(graph: RoadGraph, fleet: Fleet, **options: float) -> RoadGraph:
    left = drop_faint(graph, fleet, match(graph, fleet), options=FaintOptions(**options))
    check_graph(left)
    return left


@pytest.mark.parametrize(
    ("usual", "aside", "kept"), [(20, 3, False), (20, 4, True), (15, 3, True), (10, 1, False), (4, 1, True)]
)
def test_faint_is_what_few_traces_drove_beside_the_usual(usual: int, aside: int, kept: bool) -> None:
    graph = graph_of([(0, 0), (90, 0)], [(90, 0), (180, 0)], [(90, 0), (90, 80)])
    fleet = fleet_of(*[spaced(*THROUGH)] * (usual - aside), *[spaced(*ASIDE)] * aside)
    assert (2 in clear(graph, fleet).edges.index) == kept
    assert len(clear(graph, fleet, min_traces=0).edges) == 3


def test_an_edge_is_cut_where_its_traffic_ends() -> None:
    long, part = spaced((0, 0), (1500, 0)), spaced((0, 0), (400, 0))
    rejoin = spaced((1000, 0), (1500, 0))
    left = clear(graph_of([(0, 0), (1500, 0)]), fleet_of(*[long] * 2, *[part] * 18, *[rejoin] * 18))
    assert left.edges["length"].round(-1).tolist() == [410.0, 510.0]
    assert (left.degrees() == 1).all()


def test_short_stretches_go_with_what_they_lie_between() -> None:
    long = spaced((0, 0), (1500, 0))
    hole = [spaced((0, 0), (700, 0)), spaced((760, 0), (1500, 0))]  # lost under a bridge
    whole = clear(graph_of([(0, 0), (1500, 0)]), fleet_of(*[long] * 2, *hole * 18))
    assert whole.edges["length"].tolist() == [1500.0]


def test_a_short_edge_is_judged_by_its_middle() -> None:
    graph = graph_of([(0, 0), (300, 0)], [(300, 0), (450, 20)], [(300, 0), (600, 0)])
    astray = spaced((0, 0), (300, 0), (330, 4))  # matched to the beginning of the branch, if anywhere
    fleet = fleet_of(*[spaced((0, 0), (600, 0))] * 20, *[astray] * 5, *[spaced((0, 0), (300, 0), (450, 20))] * 2)
    assert clear(graph, fleet).edges.index.tolist() == [0, 2]


def test_a_trace_that_comes_twice_counts_once() -> None:
    graph = graph_of([(0, 0), (500, 0)], [(500, 0), (500, 400)])
    to_and_fro = spaced((0, 0), (500, 0), (500, 400), (500, 0), (0, 0))
    fleet = fleet_of(*[spaced((0, 0), (500, 0))] * 20, *[to_and_fro] * 3)
    assert clear(graph, fleet).edges.index.tolist() == [0]


def test_columns_of_edges_stay() -> None:
    graph = graph_of([(0, 0), (1500, 0)])
    long, part = spaced((0, 0), (1500, 0)), spaced((0, 0), (400, 0))
    assert list(clear(graph, fleet_of(long, *[part] * 20)).edges) == list(graph.edges)


@pytest.mark.parametrize("lines", [[], [[(0, 0), (90, 0)]]], ids=["empty", "undriven"])
def test_nothing_is_faint_where_nothing_was_driven(lines: list[list[tuple[float, float]]]) -> None:
    graph = graph_of(*lines)
    fleet = fleet_of(*[spaced((0, 5000), (90, 5000))] * 5)
    assert drop_faint(graph, fleet, match(graph, fleet)) is graph
