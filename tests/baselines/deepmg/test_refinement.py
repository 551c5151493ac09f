"""Traversals by the matcher of DeepMG and what they prune, computed by hand (METHOD 3.7)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probe2road.baselines.deepmg.features import FeatureOptions, Steps, thin_traces
from probe2road.baselines.deepmg.pruning import PruneOptions, prune_graph
from probe2road.baselines.deepmg.traversals import MatcherOptions, count_traversals
from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph
from sketches import fleet_of, graph_of


def steps(*traces: list[tuple[float, float]]) -> Steps:
    return thin_traces(fleet_of(*traces, interval=4.0), FeatureOptions(spacing=1.0))


def with_links(graph: RoadGraph, *links: int) -> RoadGraph:
    origin = graph.edges["origin"].where(~graph.edges.index.isin(links), "gap")
    return replace(graph, edges=graph.edges.assign(origin=origin))


CHAIN = graph_of([(0, 0), (50, 0)], [(50, 0), (100, 0)], [(100, 0), (150, 0)])


def test_each_direction_is_counted_on_its_own() -> None:
    there = [(10.0 + 20 * k, 1.0) for k in range(7)]
    assert count_traversals(steps(there, there, there[::-1]), CHAIN).tolist() == [[2, 1], [2, 1], [2, 1]]


def test_pieces_of_up_to_two_edges_count_for_nothing_as_published() -> None:
    short, long = [(10.0, 0.0), (40.0, 0.0), (70.0, 0.0)], [(10.0, 0.0), (60.0, 0.0), (120.0, 0.0)]
    assert count_traversals(steps(short), CHAIN, min_path=3).sum() == 0
    assert count_traversals(steps(short), CHAIN).tolist() == [[1, 0], [1, 0], [0, 0]]
    assert count_traversals(steps(long), CHAIN, min_path=3).tolist() == [[1, 0], [1, 0], [1, 0]]


def test_a_single_fix_is_no_traversal() -> None:
    assert count_traversals(steps([(25.0, 0.0)]), CHAIN).sum() == 0


def test_a_stretch_off_the_network_breaks_the_trace() -> None:
    trace = [(10.0, 0.0), (40.0, 0.0), (40.0, 70.0), (110.0, 0.0), (140.0, 0.0)]
    assert count_traversals(steps(trace), CHAIN).tolist() == [[1, 0], [0, 0], [1, 0]]


def test_a_fix_cannot_go_back_on_its_edge() -> None:
    """The way on is by the other direction, around the end of the edge: twice as many traversals, all by noise."""
    lonely = graph_of([(0, 0), (50, 0)])
    assert count_traversals(steps([(10.0, 0.0), (30.0, 0.0)]), lonely).tolist() == [[1, 0]]
    assert count_traversals(steps([(10.0, 0.0), (42.0, 0.0), (40.0, 0.0)]), lonely).tolist() == [[1, 1]]


@pytest.mark.parametrize(("height", "by_link"), [(28.0, False), (45.0, True)])
def test_a_link_counts_for_more_than_its_length(height: float, by_link: bool) -> None:
    """A link of 80 m counts for 112 m. The way round has 98 m, which is shorter than that, or 120 m."""
    way_round = [(10, 0), (50, height), (90, 0)]
    lines = [[(-40, 0), (10, 0)], [(90, 0), (140, 0)], [(10, 0), (90, 0)], way_round]
    graph = with_links(graph_of(*lines), 2)
    counts = count_traversals(steps([(-30.0, 0.0), (0.0, 0.0), (100.0, 0.0), (130.0, 0.0)]), graph)
    assert counts.tolist() == [[1, 0], [1, 0], [int(by_link), 0], [int(not by_link), 0]]


def test_no_edges_give_no_counts() -> None:
    assert count_traversals(steps([(0.0, 0.0), (9.0, 0.0)]), graph_of()).shape == (0, 2)


def test_undriven_edges_and_rarely_driven_links_go() -> None:
    graph = with_links(CHAIN, 1)
    pruned = prune_graph(graph, np.array([[1, 0], [4, 5], [0, 0]]))
    assert pruned.edges[["origin", "forward", "backward", "oneway"]].to_numpy().tolist() == [
        ["segmentation", 1, 0, "yes"],
        ["gap", 5, 0, "yes"],  # turned: it was driven from its end
    ]
    assert pruned.nodes.index.tolist() == [0, 1, 2]
    assert prune_graph(graph, np.array([[1, 0], [4, 4], [1, 1]])).edges["oneway"].tolist() == ["yes", "no"]


def test_the_two_shortest_links_of_a_node_stay() -> None:
    spokes = [[(0, 0), (30, 0)], [(0, 0), (0, 20)], [(0, 0), (-40, 0)], [(0, 0), (0, -90)]]
    graph = with_links(graph_of(*spokes), 0, 1, 2)
    pruned = prune_graph(graph, np.full((4, 2), 9))
    assert pruned.edges["length"].tolist() == [30.0, 20.0, 90.0]


def test_links_that_go_anyway_take_no_room() -> None:
    spokes = [[(0, 0), (30, 0)], [(0, 0), (0, 20)], [(0, 0), (-40, 0)]]
    graph = with_links(graph_of(*spokes), 0, 1, 2)
    assert prune_graph(graph, np.array([[9, 9], [0, 0], [9, 9]])).edges["length"].tolist() == [30.0, 40.0]


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(OptionError, match="sigma is 0"):
        MatcherOptions(sigma=0.0)
    with pytest.raises(OptionError, match="max_links is -1"):
        PruneOptions(max_links=-1)
