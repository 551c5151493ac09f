from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import shapely

from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.metrics import LateralOptions, comparable, lateral, lateral_gaps
from probe2road.metrics.network import network_from_graph
from probe2road.metrics.projection import project_along
from sketches import UTM, graph_of

Streets = Callable[..., RoadGraph]
ERRORS = ("median_m", "p95_m", "rms_m")


def errors(proposal: RoadGraph, reference: RoadGraph) -> list[float]:
    return [lateral(proposal, reference).details[name] for name in ERRORS]


@pytest.mark.parametrize("shift", [0.0, 1.5, 5.9])
def test_a_shifted_line_is_off_by_its_shift(shift: float) -> None:
    proposal, reference = graph_of([(0, shift), (300, shift)]), graph_of([(0, 0), (300, 0)])
    assert errors(proposal, reference) == pytest.approx([shift] * 3)
    assert lateral(proposal, reference).f1 == 1.0


def test_a_line_beyond_the_radius_has_no_error() -> None:
    score = lateral(graph_of([(0, 6.1), (300, 6.1)]), graph_of([(0, 0), (300, 0)]))
    assert (score.precision, score.recall) == (0.0, 0.0)
    assert [score.details[name] for name in ERRORS] == [None] * 3


def test_half_of_a_road_farther_off() -> None:
    """As many samples at 1 m as at 3 m: the root of the mean square is the root of 5."""
    proposal = graph_of([(0, 1), (100, 1)], [(200, 3), (300, 3)])
    median, p95, rms = errors(proposal, graph_of([(0, 0), (300, 0)]))
    assert (median, p95, rms) == pytest.approx((2.0, 3.0, np.sqrt(5)), abs=1e-3)


def test_a_road_that_is_too_long_is_not_off_for_that() -> None:
    proposal, reference = graph_of([(-5, 2), (300, 2)]), graph_of([(0, 0), (300, 0)])
    assert errors(proposal, reference) == pytest.approx([2.0] * 3)
    assert lateral(proposal, reference).precision == 1.0


def test_concentric_arcs() -> None:
    angle = np.linspace(0.0, np.pi / 2, 2001)
    arcs = [radius * np.column_stack([np.cos(angle), np.sin(angle)]) for radius in (503.0, 500.0)]
    assert errors(graph_of(arcs[0]), graph_of(arcs[1])) == pytest.approx([3.0] * 3, abs=1e-3)


def test_a_road_across_is_no_road_beside() -> None:
    score = lateral(graph_of([(0, -50), (0, 50)]), graph_of([(-50, 0), (50, 0)]))
    assert (score.precision, score.recall) == (0.0, 0.0)


def test_the_shares_are_those_of_the_lengths() -> None:
    score = lateral(graph_of([(0, 1), (100, 1)]), graph_of([(0, 0), (400, 0)]), options=LateralOptions(spacing=0.5))
    assert score.precision == 1.0
    assert score.recall == pytest.approx((100 + np.sqrt(6**2 - 1)) / 400, abs=0.002)


def test_steps_of_a_pixel_do_not_hide_a_direction() -> None:
    """A traced line climbs in steps of 0.5 m, each at 45 degrees."""
    x = np.arange(0.0, 301.0, 0.5)
    proposal = graph_of(np.column_stack([x, 1.0 + 0.5 * (np.arange(len(x)) // 6 % 2)]))
    assert lateral(proposal, graph_of([(0, 0), (300, 0)])).precision == 1.0


@pytest.mark.parametrize("empty_side", [0, 1])
def test_an_empty_graph_scores_zero(empty_side: int, streets: Streets) -> None:
    sides = [streets(1), streets(1)]
    sides[empty_side] = empty_graph(UTM)
    score = lateral(*sides)
    assert (score.precision, score.recall, score.details["rms_m"]) == (0.0, 0.0, None)


@pytest.mark.parametrize("seed", range(3))
def test_gaps_are_distances_to_the_roads(seed: int, streets: Streets) -> None:
    """Where any direction will do, a gap is the distance to the whole map, but beyond dead ends."""
    own, other = (network_from_graph(side) for side in comparable(streets(seed), streets(seed + 100)))
    xy, gap = lateral_gaps(own, other, options=LateralOptions(max_angle=90.0))
    distance = shapely.distance(shapely.union_all(other.lines), shapely.points(xy))
    assert (np.isfinite(gap) == (distance <= 6.0)).all()
    near = np.isfinite(gap)
    same = np.isclose(gap[near], distance[near], atol=1e-5)
    assert same.mean() > 0.8
    assert (gap[near] <= distance[near] + 1e-5).all()


def test_the_lowest_of_equally_near_edges_is_taken() -> None:
    network = network_from_graph(graph_of([(0, 2), (50, 2)], [(0, -2), (50, -2)], [(20, -50), (20, 50)]))
    place, east = np.array([[20.0, 0.0], [20.0, 9.0]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    edge, offset = project_along(place, east, network, radius=6.0, max_angle=30.0)
    assert (edge.tolist(), offset.tolist()) == ([0, -1], [20.0, 0.0])


@pytest.mark.parametrize("name", ["spacing", "radius", "max_angle", "span"])
def test_options_out_of_range_are_refused(name: str) -> None:
    with pytest.raises(OptionError, match=name):
        LateralOptions(**{name: 0.0})
