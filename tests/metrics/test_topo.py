from __future__ import annotations

from collections.abc import Callable

import networkx as nx
import numpy as np
import pytest

from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.metrics import TopoOptions, topo
from probe2road.metrics.network import network_from_graph
from probe2road.metrics.sampling import Centres, sample_around
from probe2road.metrics.topo import _matched_marbles
from sketches import UTM, graph_of

Streets = Callable[..., RoadGraph]


def test_identical_graphs_are_perfect(streets: Streets) -> None:
    score = topo(streets(1, block=80.0), streets(1, block=80.0))
    assert (score.precision, score.recall, score.f1) == (1.0, 1.0, 1.0)
    assert score.details["matched_starts"] == score.details["starts"] > 20


def test_a_small_gap_cuts_what_lies_behind_it() -> None:
    reference = graph_of([(0, 0), (1000, 0)])
    whole, cut = graph_of([(0, 1), (1000, 1)]), graph_of([(0, 1), (495, 1)], [(505, 1), (1000, 1)])
    assert topo(whole, reference).f1 > 0.99
    assert topo(cut, reference).precision > 0.99
    assert 0.7 < topo(cut, reference).recall < 0.9


def test_starts_without_a_partner_lower_recall_only() -> None:
    """The proposal lacks a whole component: 21 of 42 starts have no partner."""
    reference = graph_of([(0, 0), (1000, 0)], [(0, 500), (1000, 500)])
    score = topo(graph_of([(0, 0), (1000, 0)]), reference)
    assert (score.precision, score.recall) == pytest.approx((1.0, 0.5))
    assert (score.details["starts"], score.details["matched_starts"]) == (42, 21)


def test_a_partner_runs_along_the_road() -> None:
    """The crossing road is nearer than the parallel one, but is no partner."""
    reference = graph_of([(0, 0), (300, 0)])
    proposal = graph_of([(150, -40), (150, 40)], [(0, 9), (300, 9)])
    assert topo(proposal, reference).details["matched_starts"] == 7


def test_the_margin_leaves_out_starts_at_the_border() -> None:
    road = graph_of([(0, 0), (1000, 0)])
    assert topo(road, road, options=TopoOptions(margin=0.07)).details["starts"] == 17


@pytest.mark.parametrize("empty_side", [0, 1])
def test_an_empty_graph_scores_zero(empty_side: int) -> None:
    sides = [graph_of([(0, 0), (1000, 0)]), graph_of([(0, 0), (1000, 0)])]
    sides[empty_side] = empty_graph(UTM)
    score = topo(*sides)
    assert (score.precision, score.recall, score.f1) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_marbles_match_as_in_networkx(seed: int, streets: Streets) -> None:
    options = TopoOptions(reach=60.0)
    sides = []
    for graph_seed in (seed, seed + 100):
        network = network_from_graph(streets(graph_seed, noise=5.0))
        centres = Centres.from_nodes(np.flatnonzero(network.degree > 0)[:5])
        sides.append(sample_around(network, centres, radius=60.0, spacing=5.5, ends=False))
    matched = _matched_marbles(*sides, options)
    for start in range(5):
        parts = [slice(side.first[start], side.first[start + 1]) for side in sides]
        bipartite = nx.Graph()
        bipartite.add_nodes_from(("a", i) for i in range(parts[0].stop - parts[0].start))
        for i, (at, along) in enumerate(zip(sides[0].xy[parts[0]], sides[0].direction[parts[0]], strict=True)):
            near = np.hypot(*(sides[1].xy[parts[1]] - at).T) <= 11.0
            aligned = np.abs(sides[1].direction[parts[1]] @ along) >= np.cos(np.radians(45.0))
            bipartite.add_edges_from((("a", i), ("b", int(j))) for j in np.flatnonzero(near & aligned))
        top = [node for node in bipartite if node[0] == "a"]
        assert matched[start] == len(nx.bipartite.maximum_matching(bipartite, top)) // 2
