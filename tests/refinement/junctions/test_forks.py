from __future__ import annotations

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import match
from probe2road.refinement.junctions.forks import ForkOptions, find_forks, move_forks
from sketches import fleet_of, graph_of

PARTS = 100.0  # m, where the ramp leaves
SEEN = 150.0  # m, where the mask saw it leave
# The common road, the road that goes on, the ramp as it was traced.
LATE = [[(0, 0), (SEEN, 0)], [(SEEN, 0), (400, 0)], [(SEEN, 0), (160, -6), (400, -30)]]


def ramp(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.minimum(0.0, (PARTS - x) / 10.0)


def drives(
    n: int = 6, *, lane: float = 0.0, noise: float = 0.0, backwards: bool = False, leaves: float = PARTS
) -> Fleet:
    """Every second drive leaves at `leaves`; those that do keep `lane` metres right of the others before."""
    rng = np.random.default_rng(5)
    x = np.arange(4.0, 400.0, 8.0)
    ways = [np.zeros(len(x)), ramp(x - leaves + PARTS) - lane] * n
    driven = [np.stack([x, y + rng.normal(0.0, noise, len(x))], axis=1) for y in ways]
    return fleet_of(*(way[:: -1 if backwards else 1] for way in driven))


def moved(graph: RoadGraph, fleet: Fleet, **options: float) -> RoadGraph:
    result = move_forks(graph, fleet, match(graph, fleet), options=ForkOptions(**options))
    check_graph(result)
    return result


def fork_of(graph: RoadGraph) -> tuple[float, float]:
    place = graph.nodes.geometry[graph.degrees() == 3].iloc[0]
    return place.x, place.y


@pytest.mark.parametrize("lane", [0.0, 3.5])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_fork_goes_where_its_traces_part_whatever_the_lanes_and_the_direction(lane: float, backwards: bool) -> None:
    result = moved(graph_of(*LATE), drives(lane=lane, backwards=backwards))
    x, y = fork_of(result)
    assert x == pytest.approx(PARTS, abs=6.0)
    assert y == pytest.approx(0.0)


def test_the_branches_lead_straight_from_there_and_end_as_before() -> None:
    graph = graph_of(*LATE)
    result = moved(graph, drives())
    x, _ = fork_of(result)
    stem, through, leaving = result.edges.geometry
    assert stem.length == pytest.approx(x)
    assert through.length == pytest.approx(400.0 - x)
    assert leaving.coords[0] == stem.coords[-1] == through.coords[0]
    assert leaving.coords[-1] == graph.edges.geometry.iloc[2].coords[-1]
    along = np.array([120.0, 140.0, 170.0])
    there = shapely.intersection(leaving, shapely.linestrings([[(at, -50.0), (at, 50.0)] for at in along]))
    assert shapely.get_y(there) == pytest.approx(ramp(along), abs=1.0)
    assert result.edges["length"].tolist() == pytest.approx([line.length for line in result.edges.geometry])


@pytest.mark.parametrize("on_lane", [80.0, 96.0])
def test_a_lane_that_leads_to_a_ramp_is_not_the_ramp(on_lane: float) -> None:
    """Those who leave change lanes from 0 m on, have one of their own for 40 or 24 m, and the ramp leaves at 120 m."""
    x = np.arange(-194.0, 400.0, 4.0)
    away = np.interp(x, [0.0, on_lane, 120.0, 400.0], [0.0, -3.5, -3.5, -31.5])
    fleet = fleet_of(*[np.stack([x, 0 * x], axis=1), np.stack([x, away], axis=1)] * 6)
    graph = graph_of([(-200, 0), (SEEN, 0)], *LATE[1:])
    assert fork_of(moved(graph, fleet))[0] == pytest.approx(120.0, abs=8.0)
    assert fork_of(moved(graph, fleet, min_level=60.0, min_lane=4.0))[0] < 20.0


def test_traces_that_swing_towards_a_ramp_which_begins_in_the_middle_of_the_road_part_where_they_begin_to() -> None:
    """They keep a lane of 3.5 m on the right up to 100 m, cross to the middle, where the ramp is drawn, and leave."""
    x = np.arange(2.0, 400.0, 4.0)
    away = np.interp(x, [100.0, 125.0, 400.0], [-3.5, -1.0, -40.0])
    fleet = fleet_of(*[np.stack([x, 0 * x], axis=1), np.stack([x, away], axis=1)] * 6)
    assert fork_of(moved(graph_of(*LATE), fleet))[0] == pytest.approx(PARTS, abs=6.0)


def test_a_change_of_lanes_far_before_the_fork_does_not_matter() -> None:
    x = np.arange(-196.0, 400.0, 4.0)
    away = np.interp(x, [-100.0, -60.0, PARTS, 400.0], [3.5, 0.0, 0.0, -30.0])
    fleet = fleet_of(*[np.stack([x, 0 * x], axis=1), np.stack([x, away], axis=1)] * 6)
    graph = graph_of([(-200, 0), (SEEN, 0)], *LATE[1:])
    assert fork_of(moved(graph, fleet))[0] == pytest.approx(PARTS, abs=6.0)


def test_noise_alone_moves_nothing() -> None:
    # The traces part where the mask has it: before, they differ by noise and lane only.
    graph = graph_of(*LATE)
    for noise in (0.5, 3.0):
        assert fork_of(moved(graph, drives(n=20, lane=3.0, noise=noise, leaves=SEEN)))[0] >= SEEN - 10.0


def test_noisy_traces_still_part_where_they_do() -> None:
    assert fork_of(moved(graph_of(*LATE), drives(n=20, noise=0.5)))[0] == pytest.approx(PARTS, abs=12.0)
    assert fork_of(moved(graph_of(*LATE), drives(n=20, noise=1.0)))[0] == pytest.approx(PARTS, abs=20.0)


def test_few_traces_and_no_reach_leave_the_graph_as_it_is() -> None:
    graph = graph_of(*LATE)
    assert fork_of(moved(graph, drives(n=2))) == (SEEN, 0.0)
    assert moved(graph, drives(), reach=0.0) is graph


def test_the_two_forks_of_a_short_road_share_it() -> None:
    # A weaving section: roads merge at 0 and part at 40, and traces say -30 and 70 the other way round.
    lines = [[(-200, 8), (-8, 4), (0, 0)], [(-200, -8), (-8, -4), (0, 0)], [(0, 0), (40, 0)]]
    lines += [[(40, 0), (48, 4), (240, 8)], [(40, 0), (48, -4), (240, -8)]]
    graph = graph_of(*lines)
    x = np.arange(-196.0, 240.0, 4.0)
    ways = [np.stack([x, side * np.abs(x - 20.0) / 8.0], axis=1) for side in (-1, 1)]
    result = moved(graph, fleet_of(*ways * 6))
    assert len(find_forks(graph).node) == 2
    assert 10.0 <= result.edges["length"].iloc[2] <= 40.0


def test_a_crossroads_a_right_angle_and_a_loop_are_no_forks() -> None:
    cross = [[(0, 0), (90, 0)], [(0, 0), (-90, 0)], [(0, 0), (0, 90)], [(0, 0), (0, -90)]]
    assert not len(find_forks(graph_of(*cross)).node)
    assert not len(find_forks(graph_of(*cross[:3])).node)
    loop = [[(0, 0), (90, 0)], [(0, 0), (-60, 10), (-60, -10), (0, 0)]]
    assert not len(find_forks(graph_of(*loop)).node)


def test_heights_stay() -> None:
    lines = [[(*place, 7.0) for place in line] for line in LATE]
    result = moved(graph_of(*lines), drives())
    assert fork_of(result)[0] < SEEN - 20.0
    assert shapely.get_coordinates(result.edges.geometry.to_numpy(), include_z=True)[:, 2] == pytest.approx(7.0)
    assert not shapely.has_z(result.nodes.geometry.to_numpy()).any()  # nodes of these had none


def test_negative_options_are_refused() -> None:
    with pytest.raises(OptionError, match="reach is -1"):
        ForkOptions(reach=-1.0)
