from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from probe2road.errors import CRSError, OptionError
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.metrics import HE_BALAKRISHNAN_2022, GeoOptions, comparable, geo, scores_table
from probe2road.metrics.geo import geo_networks, geo_samples
from probe2road.metrics.matching import Matching, match_one_to_one
from probe2road.metrics.network import network_from_graph
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.sampling import sample_edges
from sketches import UTM, graph_of

Streets = Callable[..., RoadGraph]


def quarter_circle(radius: float) -> RoadGraph:
    angle = np.linspace(0.0, np.pi / 2, 20_001)
    return graph_of(radius * np.column_stack([np.cos(angle), np.sin(angle)]))


def counts(proposal: RoadGraph, reference: RoadGraph, options: GeoOptions | None = None) -> tuple[int, int, int]:
    score = geo(proposal, reference, options=options)
    return int(score.matched_proposal), int(score.proposal), int(score.reference)


@pytest.mark.parametrize(
    ("length", "spacing", "expected"),
    [
        (10, 5, [0, 5, 10]),
        (9, 3, [0, 3, 6, 9]),
        (12, 5, [0, 5, 10, 12]),
        (10, 10, [0, 10]),
        (10, 11, [0, 10]),
        (10, 0, []),
        (10, -1, []),
    ],
)
def test_sampling_of_a_straight_line(length: float, spacing: float, expected: list[float]) -> None:
    samples = sample_edges(network_from_graph(graph_of([(0, 0), (length, 0)])), spacing)
    assert samples.xy[:, 0].tolist() == expected


def test_sampling_goes_round_corners_and_keeps_no_vertices() -> None:
    samples = sample_edges(network_from_graph(graph_of([(0, 0), (4.5, 0), (4.5, 4.5)])), 3.0)
    assert samples.xy.tolist() == [[0, 0], [3, 0], [4.5, 1.5], [4.5, 4.5]]


def test_a_shared_node_is_sampled_once() -> None:
    samples = sample_edges(network_from_graph(graph_of([(0, 0), (5, 0)], [(0, 0), (0, 5)], [(0, 0), (-5, 0)])), 11.0)
    assert samples.xy.tolist() == [[0, 0], [5, 0], [0, 5], [-5, 0]]


def test_noise_in_the_length_makes_no_sample() -> None:
    far = 4_600_000.1  # m; coordinates as large as this carry noise of a nanometre
    samples = sample_edges(network_from_graph(graph_of([(far, far), (far + 33.0 + 1e-9, far)])), 11.0)
    assert len(samples.edge) == 4


def test_identical_lines_are_perfect() -> None:
    score = geo(graph_of([(0, 0), (100, 40)]), graph_of([(0, 0), (100, 40)]))
    assert (score.precision, score.recall, score.f1) == (1.0, 1.0, 1.0)


def test_worked_example_of_a_line_half_as_long() -> None:
    score = geo(graph_of([(0, 0), (6, 0)]), graph_of([(0, 0), (6, 0), (12, 0)]))
    assert (score.precision, score.recall, score.f1) == pytest.approx((1.0, 2 / 3, 0.8))


@pytest.mark.parametrize(
    ("radius", "expected"), [(300, (44, 44, 44)), (302, (44, 45, 44)), (304, (32, 45, 44)), (305, (21, 45, 44))]
)
def test_concentric_quarter_circles(radius: float, expected: tuple[int, int, int]) -> None:
    assert counts(quarter_circle(radius), quarter_circle(300)) == expected


def test_the_radius_is_inclusive() -> None:
    reference = graph_of([(0, 0), (100, 0)])
    assert geo(graph_of([(0, 6), (100, 6)]), reference).f1 == 1.0
    assert geo(graph_of([(0, 6.001), (100, 6.001)]), reference).f1 == 0.0


def test_duplicates_cost_precision_only() -> None:
    score = geo(graph_of([(0, 0), (100, 0)], [(0, 2), (100, 2)]), graph_of([(0, 1), (100, 1)]))
    assert (score.precision, score.recall) == (0.5, 1.0)


def test_roads_along_and_across_are_told_apart_on_request() -> None:
    proposal, reference = graph_of([(0, -5), (0, 5)]), graph_of([(-5, 0), (5, 0)])
    assert geo(proposal, reference, options=GeoOptions(radius=8.0)).f1 == 1.0
    assert geo(proposal, reference, options=GeoOptions(radius=8.0, max_angle=60.0)).f1 == 0.0


def test_scores_do_not_depend_on_how_edges_are_cut() -> None:
    whole = graph_of([(0, 0), (100, 0)])
    cut = graph_of([(0, 0), (31, 0)], [(77, 0), (31, 0)], [(77, 0), (100, 0)])
    assert counts(cut, whole) == counts(whole, whole) == (11, 11, 11)


@pytest.mark.parametrize("empty_side", ["proposal", "reference", "both"])
def test_an_empty_graph_scores_zero(empty_side: str) -> None:
    road, nothing = graph_of([(0, 0), (100, 0)]), empty_graph(UTM)
    score = geo(*{"proposal": (nothing, road), "reference": (road, nothing), "both": (nothing, nothing)}[empty_side])
    assert (score.precision, score.recall, score.f1) == (0.0, 0.0, 0.0)


def test_the_proposal_is_reprojected_to_the_reference() -> None:
    reference = graph_of([(440_000, 4_635_000), (440_900, 4_635_300)])
    assert geo(reference.to_crs("EPSG:32615"), reference).f1 == 1.0


def test_degrees_are_refused() -> None:
    road = graph_of([(440_000, 4_635_000), (440_900, 4_635_300)])
    degrees = RoadGraph(road.nodes.to_crs(4326), road.edges.to_crs(4326), road.turns)
    with pytest.raises(CRSError, match="reference: coordinates are in degrees"):
        geo(road, degrees)


def test_phases_even_out_an_offset_that_is_all_or_nothing() -> None:
    reference = graph_of([(0, 0), (5000, 0)])
    lucky, unlucky = graph_of([(0, 4.0), (5000, 4.0)]), graph_of([(-5.5, 4.0), (4994.5, 4.0)])
    assert geo(lucky, reference).precision == 1.0
    assert geo(unlucky, reference).precision < 0.01
    smooth = [geo(proposal, reference, options=GeoOptions(phases=11)).precision for proposal in (lucky, unlucky)]
    expected = 2 * np.sqrt(36 - 16) / 11  # METHOD 6.1: the share of phases that match at 4 m
    assert smooth == pytest.approx([expected, expected], abs=0.09)


def brute_force_geo(proposal: RoadGraph, reference: RoadGraph, radius: float) -> int:
    samples, targets = (sample_edges(network_from_graph(side), 11.0).xy for side in (proposal, reference))
    used: set[int] = set()
    for point in samples:
        gaps = np.hypot(*(targets - point).T)
        free = [int(j) for j in np.argsort(gaps, kind="stable") if gaps[j] <= radius and j not in used]
        used.update(free[:1])
    return len(used)


@pytest.mark.parametrize("seed", range(6))
def test_greedy_matching_equals_brute_force(seed: int, streets: Streets) -> None:
    proposal, reference = streets(seed), streets(seed + 100)
    options = GeoOptions(radius=8.0)
    assert counts(proposal, reference, options)[0] == brute_force_geo(*comparable(proposal, reference), 8.0)


@pytest.mark.parametrize("seed", range(4))
def test_optimal_matching_equals_an_assignment(seed: int, streets: Streets) -> None:
    first, second = comparable(streets(seed), streets(seed + 100))
    samples, targets = (sample_edges(network_from_graph(side), 11.0).xy for side in (first, second))
    near = np.hypot(*(samples[:, None] - targets[None]).transpose(2, 0, 1)) <= 8.0
    rows, columns = linear_sum_assignment(near, maximize=True)
    matched = {how: counts(first, second, GeoOptions(radius=8.0, matching=how))[0] for how in ("greedy", "optimal")}
    assert matched["optimal"] == near[rows, columns].sum() >= matched["greedy"]


def test_the_variant_of_he_and_balakrishnan() -> None:
    reference = graph_of([(0, 0), (100, 0)])
    assert geo(graph_of([(0, 0.9), (100, 0.9)]), reference, options=HE_BALAKRISHNAN_2022).f1 == 1.0
    assert geo(graph_of([(0, 1.1), (100, 1.1)]), reference, options=HE_BALAKRISHNAN_2022).f1 == 0.0


def test_parameters_stand_in_the_row() -> None:
    row = scores_table([geo(graph_of([(0, 0), (100, 0)]), graph_of([(0, 0), (100, 0)]))]).iloc[0]
    assert json.loads(row["parameters"]) == {
        "spacing": 11.0,
        "radius": 6.0,
        "matching": "greedy",
        "max_angle": None,
        "phases": 1,
    }
    assert json.loads(row["details"]) == {"proposal_km": 0.1, "reference_km": 0.1}


@pytest.mark.parametrize("options", [{"spacing": 0.0}, {"radius": -1.0}, {"matching": "best"}, {"phases": 0}])
def test_options_out_of_range_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(OptionError, match="GeoOptions"):
        GeoOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("matching", ["greedy", "global", "optimal"])
@pytest.mark.parametrize("seed", range(3))
def test_samples_add_up_to_the_counts(seed: int, matching: Matching, streets: Streets) -> None:
    sides = comparable_networks(streets(seed), streets(seed + 100))
    options = GeoOptions(matching=matching)
    score, samples = geo_networks(*sides, options), geo_samples(*sides, options)
    assert (samples.proposal_matched.sum(), len(samples.proposal_xy)) == (score.matched_proposal, score.proposal)
    assert (samples.reference_matched.sum(), len(samples.reference_xy)) == (score.matched_reference, score.reference)


def test_samples_say_where_a_road_is_missing() -> None:
    reference = graph_of([(0, 0), (22, 0)], [(0, 0), (0, 22)])
    samples = geo_samples(*comparable_networks(graph_of([(0, 0), (22, 0)]), reference), GeoOptions())
    assert samples.proposal_matched.all()
    missed = samples.reference_xy[~samples.reference_matched]
    assert sorted(missed.tolist()) == [[0.0, 11.0], [0.0, 22.0]]


@pytest.mark.parametrize("empty_side", [0, 1])
def test_an_empty_network_has_no_samples(empty_side: int, streets: Streets) -> None:
    sides = [streets(1), streets(1)]
    sides[empty_side] = empty_graph(UTM)
    samples = geo_samples(*comparable_networks(*sides), GeoOptions())
    assert not samples.proposal_matched.any()
    assert not samples.reference_matched.any()
    assert [samples.proposal_xy, samples.reference_xy][empty_side].shape == (0, 2)


@pytest.mark.parametrize("seed", range(20))
def test_optimal_matching_has_as_many_pairs_as_scipy_finds(seed):
    rng = np.random.default_rng(seed)
    shape = tuple(int(size) for size in rng.integers(1, 40, 2))
    linked = np.unique(rng.integers(0, shape[0] * shape[1], int(rng.integers(0, 120))))
    a, b = linked // shape[1], linked % shape[1]
    partner = match_one_to_one((a, b, np.zeros(len(a))), shape, how="optimal")
    matched = np.flatnonzero(partner >= 0)
    assert {(k, int(partner[k])) for k in matched} <= set(zip(a.tolist(), b.tolist(), strict=True))
    assert len(set(partner[matched])) == len(matched)
    links = csr_array((np.ones(len(a)), (a, b)), shape=shape)
    assert len(matched) == (maximum_bipartite_matching(links, perm_type="column") >= 0).sum()


@pytest.mark.parametrize("order", ["up", "down", "shuffled"])
@pytest.mark.parametrize("last", ["kept", "missing"])
def test_optimal_matching_of_a_long_chain_is_found_and_takes_no_minutes(order: str, last: str) -> None:
    """Each ``a`` is linked to two neighbours; in some orders the last one moves all others on, in others nothing can.

    Without its last ``b``, the chain is short of one partner.
    """
    n = 100_000
    rng = np.random.default_rng(0)
    step = {"up": np.arange(n), "down": np.arange(n)[::-1], "shuffled": rng.permutation(n)}[order]
    a, b = np.concatenate([np.arange(n), np.arange(1, n)]), np.concatenate([np.arange(n), np.arange(n - 1)])
    kept = b < n - 1 if last == "missing" else np.ones(len(b), bool)
    a, b = step[a[kept]], b[kept]
    rows = np.lexsort((b, a))
    partner = match_one_to_one((a[rows], b[rows], np.zeros(len(rows))), (n, n), how="optimal")
    matched = np.flatnonzero(partner >= 0)
    assert len(matched) == n - (last == "missing")
    assert len(np.unique(partner[matched])) == len(matched)
    assert np.isin(n * matched + partner[matched], n * a + b).all()


def test_optimal_matching_moves_a_whole_chain_on() -> None:
    """Every ``a`` but the last can take its own ``b`` or the next; the last can take the first only."""
    n = 100_000
    a = np.append(np.repeat(np.arange(n - 1), 2), n - 1)
    b = np.append((np.repeat(np.arange(n - 1), 2) + np.tile([0, 1], n - 1)), 0)
    partner = match_one_to_one((a, b, np.zeros(len(a))), (n, n), how="optimal")
    assert partner.tolist() == [*range(1, n), 0]
