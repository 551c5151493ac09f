"""Drives on arbitrary networks: continuous, on the road, in time."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from probe2road.simulation.driving.routes import DemandModel
from probe2road.simulation.driving.speeds import DriverModel
from probe2road.simulation.driving.traffic import drive, traffic_world
from probe2road.simulation.networks.network import network_from_sections

DEMAND = DemandModel(min_trip_time=1.0)
CALM = DriverModel(lane_bias=0.1, wander_sigma=0.1)


@st.composite
def chains(draw):
    """A road of several sections that bends at its nodes, lanes appearing and vanishing."""
    n = draw(st.integers(1, 5))
    bends = draw(st.lists(st.floats(-100, 100), min_size=n, max_size=n))
    lengths = draw(st.lists(st.floats(1.0, 400.0), min_size=n, max_size=n))
    lanes = draw(st.lists(st.integers(1, 4), min_size=n, max_size=n))
    heading, place, lines = 0.0, np.zeros(2), []
    for bend, length in zip(bends, lengths, strict=True):
        heading += np.radians(bend) if lines else 0.0
        end = place + length * np.array([np.sin(heading), np.cos(heading)])
        lines.append([tuple(place), tuple(end)])
        place = end
    side = draw(st.sampled_from(["right", "left"]))
    backward = draw(st.booleans())
    return network_from_sections(
        lines, crs="EPSG:32616", highway="primary", lanes_forward=lanes, lanes_backward=int(backward), driving_side=side
    )


@given(network=chains(), seed=st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_a_drive_is_continuous_and_on_the_road(network, seed):
    rng = np.random.default_rng(seed)
    world = traffic_world(network, DEMAND, rng=rng)
    poses = drive(world, DEMAND, CALM, pose_spacing=2.5, standing_interval=1.0, rng=rng)
    assert np.isfinite(poses.xyz).all()
    assert (np.diff(poses.t) > 0).all()
    assert (np.diff(poses.distance) >= 0).all()
    step = np.hypot(*np.diff(poses.xyz[:, :2], axis=0).T)
    assert step.max(initial=0.0) < 3.5
    # Corners are cut and gaps closed on the carriageway, never further out than the widest road.
    widest = (network.sections["lanes_forward"] + network.sections["lanes_backward"]).max() * 3.4
    away = shapely.distance(shapely.points(poses.xyz[:, :2]), network.sections.geometry.union_all())
    assert away.max() < widest / 2 + 6.0
    assert poses.speed.max() < 40.0
