from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import networkx as nx
import numpy as np
import pytest
import shapely
import shapely.affinity

from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.metrics import JunctionOptions, comparable, junction_pairs, junctions
from probe2road.metrics.network import network_from_graph
from probe2road.metrics.normalise import comparable_networks
from probe2road.simulation.drawn.generate import generate_interchange
from sketches import UTM, graph_of

Streets = Callable[..., RoadGraph]
EAST, NORTH, WEST, SOUTH, HERE = (200.0, 0.0), (0.0, 200.0), (-200.0, 0.0), (0.0, -200.0), (0.0, 0.0)
CROSSROADS = [[HERE, EAST], [HERE, NORTH], [HERE, WEST], [HERE, SOUTH]]
BRIDGE = [[WEST, EAST], [SOUTH, NORTH]]


def counts(
    proposal: RoadGraph, reference: RoadGraph, options: JunctionOptions | None = None
) -> tuple[int, int, int, int]:
    """True and false positives, false negatives, arms that are not found."""
    score = junctions(proposal, reference, options=options)
    both = int(score.matched_proposal)
    return both, int(score.proposal) - both, int(score.reference) - both, score.details["arms_not_found"]


def test_a_bridge_joined_by_mistake() -> None:
    assert counts(graph_of(*CROSSROADS), graph_of(*BRIDGE)) == (2, 4, 0, 0)


def test_a_junction_taken_for_a_bridge() -> None:
    assert counts(graph_of(*BRIDGE), graph_of(*CROSSROADS)) == (2, 0, 4, 0)


def test_a_ramp_left_out() -> None:
    """The road goes on, and the ramp connects to neither side of it."""
    road = [[WEST, HERE], [HERE, EAST]]
    ramp = [HERE, (150.0, 80.0)]
    assert counts(graph_of([WEST, EAST]), graph_of(*road, ramp)) == (1, 0, 2, 1)


def test_one_arm_left_out() -> None:
    assert counts(graph_of(*CROSSROADS[:3]), graph_of(*CROSSROADS)) == (3, 0, 3, 1)


@pytest.mark.parametrize(
    ("kind", "of_three", "of_four", "crossings"),
    [
        ("diamond", 4, 2, 2),
        ("cloverleaf", 16, 0, 4),
        ("stack", 16, 0, 24),
        ("trumpet", 6, 0, 4),
        ("merge_beside_bridge", 1, 0, 3),
    ],
)
def test_no_bridge_of_an_interchange_connects(kind: str, of_three: int, of_four: int, crossings: int) -> None:
    """Junctions of three and four arms have three and six pairs, a bridge two: the ways by its ramps are too long."""
    reference = generate_interchange(kind, rng=np.random.default_rng(1)).reference_graph()
    score = junctions(reference, reference)
    assert (score.details["junctions"], score.details["crossings"]) == (of_three + of_four, crossings)
    assert score.matched_proposal == score.proposal == score.reference == 3 * of_three + 6 * of_four + 2 * crossings


@pytest.mark.parametrize(("away", "connected"), [(20.0, True), (100.0, False)])
def test_a_short_ramp_at_a_bridge_connects_two_of_its_arms(away: float, connected: bool) -> None:
    """20 m away: spots 10 m out, a way of 10 + 28 + 10 m, limit 1.5 x 20 + 20 m. 100 m: 65 + 141 + 65 m, limit 125."""
    east, north = (away, 0.0), (0.0, away)
    reference = graph_of([WEST, east], [east, EAST], [SOUTH, north], [north, NORTH], [east, north])
    pairs = junction_pairs(*comparable_networks(reference, reference), JunctionOptions())
    at_bridge = np.hypot(*pairs.xy.T) < 1.0
    assert (np.count_nonzero(at_bridge), np.count_nonzero(pairs.true[at_bridge])) == (6, 2 + connected)
    assert (pairs.true == pairs.said).all()
    assert (pairs.junctions, pairs.crossings) == (2, 1)
    without = counts(graph_of(*BRIDGE), reference)
    # Each ramp end has 3 pairs, of which the road's own is right; a diagonal ramp of 28 m is within 10 m of nothing.
    assert without == (2 + 2, 0, 4 + connected, 2)


def test_an_arm_is_looked_up_half_way_to_the_next_place() -> None:
    """Two bridges 40 m apart: the piece between them is looked up in its middle, where the proposal has a gap."""
    second = [(40.0, -200.0), (40.0, 200.0)]
    gap = [[WEST, (8.0, 0.0)], [(32.0, 0.0), EAST], [SOUTH, NORTH], second]
    assert counts(graph_of(*gap), graph_of(*BRIDGE, second)) == (2, 0, 2, 2)


def test_a_proposal_a_little_off_and_at_another_angle_is_found() -> None:
    turned = shapely.affinity.rotate(shapely.MultiLineString(CROSSROADS), 10.0, origin=HERE)
    off = [shapely.get_coordinates(line) + np.array([3.0, -3.0]) for line in turned.geoms]
    assert counts(graph_of(*off), graph_of(*CROSSROADS)) == (6, 0, 0, 0)
    assert counts(graph_of(*off), graph_of(*CROSSROADS), JunctionOptions(max_angle=5.0)) == (0, 0, 6, 4)


def test_a_long_way_round_does_not_connect() -> None:
    """The missing crossroads has a ring road around it."""
    around = [[EAST, NORTH, WEST, SOUTH, EAST], *BRIDGE]
    assert counts(graph_of(*around), graph_of(*CROSSROADS)) == (2, 0, 4, 0)


def test_edges_that_cross_beside_a_node_they_share_do_not_cross() -> None:
    wobble = graph_of([HERE, (1.0, 1.0), (3.0, -1.0), EAST], [HERE, (2.0, 0.5), (150.0, 60.0)], [HERE, WEST])
    assert junctions(wobble, wobble).details["crossings"] == 0


def test_roads_above_each_other_do_not_cross() -> None:
    lines = [[(-200.0, -50.0), (-50.0, 0.0), (50.0, 0.0), (200.0, 50.0)], [(-90.0, 0.0), (90.0, 0.0)]]
    score = junctions(graph_of(*lines), graph_of(*lines))
    assert (score.details["crossings"], score.proposal, score.f1) == (0, 0, 0.0)


@pytest.mark.parametrize("empty_side", [0, 1])
def test_an_empty_graph_scores_zero(empty_side: int) -> None:
    sides = [graph_of(*CROSSROADS), graph_of(*CROSSROADS)]
    sides[empty_side] = empty_graph(UTM)
    score = junctions(*sides)
    assert (score.precision, score.recall, score.f1) == (0.0, 0.0, 0.0)
    assert [score.reference, score.proposal][empty_side] == [6, 0][empty_side]


@pytest.mark.parametrize("name", ["arm", "radius", "max_angle", "detour"])
def test_options_out_of_range_are_refused(name: str) -> None:
    with pytest.raises(OptionError, match=name):
        JunctionOptions(**{name: 0.0})


@pytest.mark.parametrize("seed", range(6))
def test_ways_equal_those_of_a_graph_cut_at_the_spots(seed: int, streets: Streets) -> None:
    """Arms looked up half way: the spots are the middles of edges, and a proposal lacks some of these edges."""
    whole, _ = comparable(streets(seed, block=80.0), streets(seed, block=80.0))
    kept = np.random.default_rng(seed).random(len(whole.edges)) < 0.8
    network, own = (network_from_graph(part) for part in (whole, replace(whole, edges=whole.edges[kept])))
    pairs = junction_pairs(own, network, options=JunctionOptions(arm=1000.0, radius=0.01, max_angle=5.0))

    halves = nx.Graph()
    for e in np.flatnonzero(kept):
        for end in (network.u[e], network.v[e]):
            halves.add_edge(("edge", e), ("node", end), weight=network.length[e] / 2)
    way = dict(nx.all_pairs_dijkstra_path_length(halves))
    expected = []
    for node in np.flatnonzero(network.degree > 2):
        arms = network.incident_edge[network.incident_first[node] : network.incident_first[node + 1]]
        for a, b in combinations(arms, 2):
            limit = 1.5 * (network.length[a] + network.length[b]) / 2 + 20.0
            expected.append(way.get(("edge", a), {}).get(("edge", b), np.inf) <= limit)
    assert np.count_nonzero(pairs.said) == sum(expected)
    assert 0 < sum(expected) < len(expected) == np.count_nonzero(pairs.true) == len(pairs.true)
