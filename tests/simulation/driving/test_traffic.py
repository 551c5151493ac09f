"""Routes, lanes, paths and speeds of single drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.simulation.driving.lane_choice import choose_lanes, link_lanes
from probe2road.simulation.driving.routes import DemandModel, draw_route, link_graph, route_moves
from probe2road.simulation.driving.speeds import DriverModel, drive_along, lane_wander
from probe2road.simulation.driving.traffic import drive, traffic_world
from probe2road.simulation.networks.network import network_from_sections
from sketches import UTM

DEMAND = DemandModel(min_trip_time=1.0)
STEADY = DriverModel(lane_bias=0.0, wander_sigma=0.0, signal_stop=0.0, yield_stop=0.0)


def crossing(**columns):
    """A four-armed junction of two-way streets at the origin, arms of 300 m: east, north, west, south."""
    arms = [[(0, 0), (300, 0)], [(0, 0), (0, 300)], [(0, 0), (-300, 0)], [(0, 0), (0, -300)]]
    return network_from_sections(arms, crs=UTM, highway="secondary", lanes_backward=1, lane_width=3.5, **columns)


def motorway_with_exit():
    """Three lanes eastbound; a ramp leaves to the right at 2 km."""
    lines = [[(0, 0), (2000, 0)], [(2000, 0), (4000, 0)], [(2000, 0), (2300, -30), (2600, -150)]]
    highway = ["motorway", "motorway", "motorway_link"]
    return network_from_sections(lines, crs=UTM, highway=highway, lanes_forward=[3, 3, 1])


def drives(network, n, *, driver=STEADY, demand=DEMAND):
    world = traffic_world(network, demand, rng=np.random.default_rng(0))
    made = [
        drive(world, demand, driver, pose_spacing=2.5, standing_interval=1.0, rng=np.random.default_rng(seed))
        for seed in range(n)
    ]
    return world, made


@pytest.mark.parametrize("side", ["right", "left"])
def test_everybody_keeps_to_the_side(side):
    _, made = drives(crossing(driving_side=side), 30)
    sign = 1.0 if side == "right" else -1.0
    for poses in made:
        away = np.hypot(*poses.xyz[:, :2].T) > 40  # from the junction
        along_x = np.abs(poses.xyz[:, 0]) > np.abs(poses.xyz[:, 1])
        right = np.where(along_x, -np.sin(poses.heading) * poses.xyz[:, 1], np.cos(poses.heading) * poses.xyz[:, 0])
        assert right[away] * sign == pytest.approx(1.75, abs=0.1)


def test_corners_are_driven_on_arcs():
    _, made = drives(crossing(), 30)
    turned = 0
    for poses in made:
        step = np.hypot(*np.diff(poses.xyz[:, :2], axis=0).T)
        assert step.max() < 2.6  # never a jump
        change = np.abs(np.diff(poses.heading))
        assert change.max() < 2.6 / 5.0  # no radius below 5 m
        total = abs(poses.heading[-1] - poses.heading[0])
        turned += total > 1.0
        assert min(abs(total - k * np.pi / 2) for k in range(2)) < 0.02
    assert turned > 5


def test_nobody_turns_back():
    world, made = drives(crossing(), 30)
    for poses in made:
        assert len(set(world.graph.section[poses.route])) == len(poses.route)


def test_restricted_turns_are_not_driven():
    network = crossing()
    only = {"from_section": [0, 0], "via_node": [int(network.sections.loc[0, "u"])] * 2, "to_section": [1, 3]}
    forbidden = replace(network, restrictions=pd.DataFrame(only))
    world, made = drives(forbidden, 40)
    moves = {tuple(world.graph.section[poses.route]) for poses in made}
    assert (0, 1) not in moves
    assert (0, 3) not in moves
    assert (0, 2) in moves


def test_who_takes_the_exit_is_in_the_lane_beside_it():
    _, made = drives(motorway_with_exit(), 40)
    exits = [poses for poses in made if poses.section[-1] == 2]
    stays = [poses for poses in made if poses.section[-1] == 1]
    assert exits
    assert stays
    for poses in exits:
        before = np.flatnonzero(poses.section == 0)[-1]
        assert poses.lane[before] == 2  # the rightmost
        lateral = np.diff(poses.xyz[before - 10 : before + 10, 1])
        assert np.abs(lateral).max() < 0.5  # into the ramp without a jump
    assert {int(lane) for poses in stays for lane in poses.lane[:10]} >= {0, 1, 2}


def test_lane_choice_reaches_the_exit_lane_within_the_link_before():
    network = motorway_with_exit()
    graph = link_graph(network, DEMAND, rng=np.random.default_rng(0))
    lanes = link_lanes(network, graph)
    route = np.array([0, 2])
    turns = graph.turn[route_moves(graph, route)]
    entered, left = choose_lanes(route, turns, np.array([2000.0, 620.0]), lanes, np.array([0.0, 0.0]))
    assert left[0] == 2
    assert entered[1] == left[1] == 0


def test_demand_has_a_heavy_tail():
    grid = [[(x, y), (x + 200, y)] for x in range(0, 1000, 200) for y in range(0, 1001, 200)]
    grid += [[(y, x), (y, x + 200)] for x in range(0, 1000, 200) for y in range(0, 1001, 200)]
    network = network_from_sections(grid, crs=UTM, highway="secondary", lanes_backward=1)
    demand = DemandModel(min_trip_time=20.0)
    graph = link_graph(network, demand, rng=np.random.default_rng(5))
    counts = np.zeros(graph.n)
    for seed in range(400):
        counts[draw_route(graph, demand, rng=np.random.default_rng(seed))] += 1
    assert counts.max() > 5 * np.median(counts)
    assert graph.origin.sum() == pytest.approx(1.0)


def test_speed_follows_limit_curvature_and_stops():
    n = 2000
    limit = np.where(np.arange(n) < 1000, 30.0, 15.0)
    curvature, wait = np.zeros(n), np.zeros(n)
    curvature[1500:1550] = 1 / 20.0
    wait[500] = 12.0
    model = DriverModel(speed_spread=0.0, flow_spread=0.0, jam_share=0.0)
    journey = drive_along(curvature, limit, wait, model, spacing=1.0, rng=np.random.default_rng(0))
    assert (journey.speed <= limit + 1e-9).all()
    assert journey.speed[1500:1550].max() <= np.sqrt(model.lateral_acceleration * 20.0) + 1e-9
    assert journey.speed[500] < 1.0
    assert journey.time[500] - journey.time[499] > 12.0
    gained = np.diff(journey.speed**2) / 2.0
    assert gained.max() <= model.acceleration + 1e-9
    assert gained.min() >= -model.deceleration - 1e-9


def test_poses_of_a_stop_stand_still_at_the_given_interval():
    waiting = replace(STEADY, signal_stop=1.0, signal_wait=20.0, yield_stop=1.0, yield_wait=20.0)
    _, made = drives(crossing(), 10, driver=waiting)
    stood = 0
    for poses in made:
        assert (np.diff(poses.t) > 0).all()
        standing = np.flatnonzero(np.diff(poses.distance) == 0)
        stood += len(standing)
        assert np.diff(poses.t).max() < 4.0
        assert np.abs(np.diff(poses.xyz, axis=0)[standing]).max(initial=0.0) < 1e-6
    assert stood > 50


def test_wander_has_the_spread_and_smoothness_asked_for():
    steps = np.full(300, 0.1)
    runs = np.array([lane_wander(steps, DriverModel(lane_bias=0.0), rng=np.random.default_rng(k)) for k in range(300)])
    assert runs.std() == pytest.approx(0.22, rel=0.1)
    assert np.abs(np.diff(runs, axis=1)).max() < 0.12  # m in 0.1 s
    assert np.corrcoef(runs[:, 0], runs[:, 20])[0, 1] == pytest.approx((1 + 1.7) * np.exp(-1.7), abs=0.12)


def test_heights_follow_the_road():
    line = [(0, 0, 0.0), (1000, 0, 40.0), (2000, 0, 0.0)]
    _, made = drives(network_from_sections([line], crs=UTM), 1)
    expected = np.interp(made[0].xyz[:, 0], [0, 1000, 2000], [0, 40, 0])
    assert np.abs(made[0].xyz[:, 2] - expected).max() < 0.15


def test_an_empty_network_and_impossible_models_are_refused():
    with pytest.raises(InputError, match="no section"):
        traffic_world(network_from_sections([], crs=UTM), DEMAND, rng=np.random.default_rng(0))
    with pytest.raises(OptionError, match="mean_trip_time"):
        DemandModel(mean_trip_time=0.0)
    with pytest.raises(OptionError, match="acceleration"):
        DriverModel(acceleration=0.0)
