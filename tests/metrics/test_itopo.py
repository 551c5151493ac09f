from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np
import pytest
import shapely

from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.metrics import ItopoOptions, comparable, itopo
from probe2road.metrics.itopo import itopo_pairs, project_nodes
from probe2road.metrics.matching import candidate_pairs, match_one_to_one
from probe2road.metrics.network import Network, network_from_graph
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.sampling import Centres, sample_around
from sketches import UTM, graph_of

Streets = Callable[..., RoadGraph]
ARM = 200.0  # m
EAST, NORTH, WEST, SOUTH = (ARM, 0.0), (0.0, ARM), (-ARM, 0.0), (0.0, -ARM)


def star(*tips: tuple[float, float], centre: tuple[float, float] = (0.0, 0.0)) -> RoadGraph:
    """Straight arms of 200 m that meet in a centre."""
    return graph_of(*([centre, (centre[0] + x, centre[1] + y)] for x, y in tips))


def centre_pair(
    proposal: RoadGraph, reference: RoadGraph, *, around: str, centre: Any = "projection"
) -> tuple[int, int, int]:
    """Counts of the pair around the node nearest to the origin."""
    networks = comparable_networks(proposal, reference)
    sides = itopo_pairs(*networks, ItopoOptions(centre=centre))
    side, network = (sides[0], networks[0]) if around == "proposal" else (sides[1], networks[1])
    k = int(np.argmin(np.hypot(*network.node_xy[side.node].T)))
    return int(side.matched[k]), int(side.proposal[k]), int(side.reference[k])


def test_a_false_crossing_on_one_of_two_stacked_roads() -> None:
    pair = centre_pair(star(EAST, NORTH, WEST, SOUTH), star(EAST, WEST), around="proposal")
    assert pair == (7, 13, 7)


def test_a_missed_crossing() -> None:
    assert centre_pair(star(EAST, WEST), star(EAST, NORTH, WEST, SOUTH), around="reference") == (7, 7, 13)


def test_a_dead_end_in_the_middle_of_a_road() -> None:
    assert centre_pair(star(EAST), star(EAST, WEST), around="proposal") == (4, 4, 7)


@pytest.mark.parametrize("around", ["proposal", "reference"])
@pytest.mark.parametrize(("centre", "matched"), [("node", 13), ("projection", 12)])
def test_a_correct_crossing_a_little_off(around: str, centre: str, matched: int) -> None:
    """The projection slips 4 m along the crossing road, which costs the end of one arm; the node does not slip."""
    proposal, reference = star(EAST, NORTH, WEST, SOUTH, centre=(4.0, 4.0)), star(EAST, NORTH, WEST, SOUTH)
    assert centre_pair(proposal, reference, around=around, centre=centre) == (matched, 13, 13)


def test_four_arms_against_the_same_arms_a_little_off_match_in_full() -> None:
    arms = [network_from_graph(star(EAST, NORTH, WEST, SOUTH, centre=at)) for at in ((4.0, 4.0), (0.0, 0.0))]
    own, there = (sample_around(arm, Centres.from_nodes(np.array([0])), radius=30.0, spacing=11.0) for arm in arms)
    partner = match_one_to_one(candidate_pairs(own.xy, there.xy, radius=6.0), (13, 13))
    assert (partner >= 0).all()


def test_a_crossing_too_far_off_pairs_with_nothing() -> None:
    proposal = star(EAST, NORTH, WEST, SOUTH, centre=(6.5, 6.5))
    assert centre_pair(proposal, star(EAST, NORTH, WEST, SOUTH), around="proposal") == (0, 13, 0)
    assert centre_pair(proposal, star(EAST, NORTH, WEST, SOUTH), around="reference") == (0, 0, 13)


def test_micro_macro_and_strict_of_one_false_crossing() -> None:
    proposal, reference = star(EAST, NORTH, WEST, SOUTH), star(EAST, WEST)
    # Pairs: the crossing 7/13/7; the proposal's tips east and west 4/4/4 each, north and south 0/4/0 each; the
    # reference's tips 4/4/4 each.
    micro = itopo(proposal, reference)
    assert (micro.matched_proposal, micro.proposal, micro.reference) == (23, 37, 23)
    macro = itopo(proposal, reference, options=ItopoOptions(average="macro"))
    assert (macro.precision, macro.recall) == pytest.approx(((7 / 13 + 4) / 7, 1.0))
    strict = itopo(proposal, reference, options=ItopoOptions(strict=True))
    assert (strict.matched_proposal, strict.proposal) == (15, 29)
    assert (strict.matched_reference, strict.reference) == (8, 8)
    assert (strict.details["proposal_nodes"], strict.details["reference_nodes"]) == (5, 2)


def test_more_nodes_raise_recall_but_not_strictly() -> None:
    """The known flaw of the metric: stubs on a road that is right make up for a crossing that is missed."""
    reference = star(EAST, NORTH, WEST, SOUTH)
    plain = graph_of([WEST, EAST])
    stubs = [[(x, 0.0), (x, 1.0)] for x in (-150.0, -100.0, 100.0, 150.0)]
    road = [[(a, 0.0), (b, 0.0)] for a, b in pairwise((-ARM, -150.0, -100.0, 100.0, 150.0, ARM))]
    stubby = graph_of(*road, *stubs)
    assert itopo(stubby, reference).recall > itopo(plain, reference).recall
    strict = ItopoOptions(strict=True)
    assert itopo(stubby, reference, options=strict).recall == pytest.approx(
        itopo(plain, reference, options=strict).recall
    )


def test_the_end_of_an_edge_that_is_closed_in_is_where_its_branches_meet() -> None:
    """A ring of 40 m at the end of a road: two branches meet 20 m round it."""
    ring = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]
    network = network_from_graph(graph_of([(-100, 0), (0, 0)], ring))
    node = np.array([1])
    samples = sample_around(network, Centres.from_nodes(node), radius=30.0, spacing=11.0)
    assert sorted(map(tuple, samples.xy.tolist())) == [
        (-30.0, 0.0), (-22.0, 0.0), (-11.0, 0.0), (0.0, 0.0), (1.0, 10.0), (10.0, 1.0), (10.0, 10.0),
    ]  # fmt: skip


def test_a_branch_goes_on_through_further_junctions() -> None:
    lines = [[(0, 0), (8, 0)], [(8, 0), (8, 50)], [(8, 0), (50, 0)], [(0, 0), (-50, 0)], [(0, 0), (0, 5)]]
    network = network_from_graph(graph_of(*lines))
    samples = sample_around(network, Centres.from_nodes(np.array([0])), radius=30.0, spacing=11.0)
    assert sorted(map(tuple, samples.xy.round(9).tolist())) == [
        (-30, 0), (-22, 0), (-11, 0), (0, 0), (0, 5), (8, 3), (8, 14), (8, 22), (11, 0), (22, 0), (30, 0),
    ]  # fmt: skip


def test_stacked_roads_are_told_apart_by_direction() -> None:
    """A road's end above another road: both lie at no distance, and the lower number is the wrong one."""
    other = graph_of([(0, -ARM), (0, ARM)], [(-ARM, 0), (ARM, 0)])
    networks = [network_from_graph(side) for side in (star(EAST), other)]
    edge, offset = project_nodes(networks[0], np.array([0]), networks[1], ItopoOptions())
    assert (edge.tolist(), offset.tolist()) == ([1], [ARM])


@pytest.mark.parametrize("empty_side", [0, 1])
def test_an_empty_graph_scores_zero(empty_side: int) -> None:
    sides = [star(EAST, WEST), star(EAST, WEST)]
    sides[empty_side] = empty_graph(UTM)
    score = itopo(*sides)
    assert (score.precision, score.recall, score.f1) == (0.0, 0.0, 0.0)
    assert [score.reference, score.proposal][empty_side] == 8
    assert itopo(empty_graph(UTM), empty_graph(UTM)).f1 == 0.0


def fine_graph(network: Network, step: float) -> tuple[nx.Graph, dict[tuple[int, int], np.ndarray]]:
    """Cut every edge into pieces of about ``step`` metres: an oracle that knows nothing of branches."""
    fine, place = nx.Graph(), {}
    for e, line in enumerate(network.lines):
        count = max(int(np.ceil(network.length[e] / step)), 2)
        names = [(-1, int(network.u[e])), *((e, k) for k in range(1, count)), (-1, int(network.v[e]))]
        for k, name in enumerate(names):
            place[name] = np.array(line.interpolate(network.length[e] * k / count).coords[0])
        nx.add_path(fine, names, weight=network.length[e] / count)
    return fine, place


@pytest.mark.parametrize("seed", range(6))
def test_surroundings_equal_a_finely_cut_graph(seed: int, streets: Streets) -> None:
    """Samples at level 11 and 22 are where the network distance of a finely cut graph passes those values."""
    network = network_from_graph(comparable(streets(seed), streets(seed))[0])
    step = 0.01
    fine, place = fine_graph(network, step)
    for node in np.flatnonzero(network.degree > 2)[:4]:
        samples = sample_around(network, Centres.from_nodes(np.array([node])), radius=30.0, spacing=11.0)
        distance = nx.single_source_dijkstra_path_length(fine, (-1, int(node)), cutoff=30.0 + step)
        expected = [place[(-1, int(node))]]
        for a, b in fine.edges(distance):
            near, far = sorted((distance.get(a, np.inf), distance.get(b, np.inf)))
            expected += [place[a] for level in (11.0, 22.0, 30.0) if near <= level < far < near + 1.5 * step]
        for name in distance:  # ends: no neighbour lies farther out
            out = max((distance.get(other, np.inf) for other in fine[name]), default=0.0)
            if out < distance[name] < 30.0 or (fine.degree(name) == 1 and name != (-1, int(node))):
                expected.append(place[name])
        gaps = np.hypot(*(samples.xy[:, None] - np.array(expected)[None]).transpose(2, 0, 1))
        assert gaps.min(axis=0).max() < 3 * step
        assert gaps.min(axis=1).max() < 3 * step
        assert len(samples.edge) == len(expected)


@pytest.mark.parametrize("seed", range(4))
def test_projections_are_the_closest_positions(seed: int, streets: Streets) -> None:
    first, second = comparable_networks(streets(seed), streets(seed + 100))
    nodes = np.arange(len(first.node_xy))
    edge, offset = project_nodes(first, nodes, second, ItopoOptions(tie=0.0))
    gap = shapely.distance(shapely.points(first.node_xy)[:, None], second.lines[None]).min(axis=1)
    assert ((edge >= 0) == (gap <= 6.0)).all()
    found = edge >= 0
    at = shapely.line_interpolate_point(second.lines[edge[found]], offset[found])
    assert shapely.distance(at, shapely.points(first.node_xy[found])) == pytest.approx(gap[found])
