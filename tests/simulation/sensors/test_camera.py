"""What the camera sees, and above all what it does not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probe2road.errors import OptionError
from probe2road.simulation.presets import PRESETS
from probe2road.simulation.sensors.camera import LANE_MARKING, ROAD_BOUNDARY, feature_index, see

EXACT = replace(
    PRESETS["mixed"].camera,
    pixel_noise=0.0,
    lateral_noise=0.0,
    height_noise=0.0,
    pitch_noise=0.0,
    yaw_bias=0.0,
    outage_length=1e-6,
    traffic_share=0.0,
    false_rate=0.0,
    boundary_lost=1e-6,
)
SPACING = 2.5


def lines_at(*places, length=2000.0, kind=LANE_MARKING, model=EXACT):
    """Index solid lines along the x axis at (y, z)."""
    vertices = np.array([[x, y, z] for y, z in places for x in (0.0, length)])
    return feature_index(vertices, 2 * np.arange(len(places) + 1), np.full(len(places), kind, np.int8), model)


def look(index, model=EXACT, *, length=2000.0, heading=np.pi / 2, seed=1, speed=20.0):
    s = np.arange(0.0, length, SPACING)
    xyz = np.stack([s, np.zeros_like(s), np.zeros_like(s)], axis=1)
    streams = {"rng": np.random.default_rng(seed), "vehicle_rng": np.random.default_rng(2)}
    return xyz, see(xyz, np.full(len(s), heading), s / speed, s, index, model, **streams)


def world(xyz, seen):
    """Points of an eastbound vehicle without pose error."""
    return xyz[seen.keyframe] + seen.body * [1.0, -1.0, 1.0] @ np.eye(3)


def test_without_noise_points_lie_on_the_line():
    xyz, seen = look(lines_at((-1.8, 0.0)))
    points = world(xyz, seen)
    assert len(points) > 500
    assert np.abs(points[:, 1] + 1.8).max() < 1e-3
    assert seen.body[:, 1] == pytest.approx(1.8, abs=1e-3)  # to the right of an eastbound vehicle


def test_points_lie_in_the_field_of_view():
    _, seen = look(lines_at((-1.8, 0.0), (8.0, 0.0)))
    forward, right = seen.body[:, 0], seen.body[:, 1]
    assert forward.min() >= EXACT.near
    assert forward.max() <= EXACT.far
    assert (np.abs(right) <= np.tan(np.radians(EXACT.half_angle)) * forward + 1e-9).all()


def test_near_lines_yield_more_points_than_far_ones():
    _, seen = look(lines_at((-1.8, 0.0), (6.0, 0.0)))
    own, next_but_one = np.bincount(seen.feature, minlength=2)
    assert own > 3 * next_but_one
    near = (seen.body[:, 0] < 15).sum()
    assert near > 0.5 * len(seen.body)


def test_the_road_above_and_the_road_below_are_not_seen():
    _, seen = look(lines_at((1.8, 6.0), (-1.8, -6.0)))
    assert len(seen.body) == 0


@pytest.mark.parametrize("dash", [2.0, 3.05, 6.0])
def test_a_dash_yields_five_to_ten_points_whatever_its_length(dash):
    starts = np.arange(0.0, 4000.0, 12.2)
    vertices = np.array([[x, 1.8, 0.0] for start in starts for x in (start, start + dash)])
    kinds = np.zeros(len(starts), np.int8)
    model = PRESETS["mixed"].camera
    index = feature_index(vertices, 2 * np.arange(len(starts) + 1), kinds, model)
    _, seen = look(index, model, length=4000.0)
    counts = np.bincount(seen.feature[seen.feature >= 0], minlength=len(starts))[4:-4]
    assert 6.0 < counts.mean() < 9.0
    assert ((counts >= 5) & (counts <= 10)).mean() > 0.65


def test_boundaries_are_often_missed():
    model = replace(EXACT, boundary_lost=50.0)
    index = lines_at((-5.0, 0.0), length=20000.0, kind=ROAD_BOUNDARY)
    xyz, seen = look(index, model, length=20000.0)
    found = np.unique((world(xyz, seen)[:, 0] // 10).astype(int))
    share = len(found) / 2000
    assert 0.4 < share < 0.8
    assert set(seen.kind) == {ROAD_BOUNDARY}


def test_noise_grows_with_the_square_of_the_range():
    noisy = replace(EXACT, pixel_noise=1.0)
    index = lines_at((-1.8, 0.0), length=20000.0)
    _, exact = look(index, length=20000.0)
    _, seen = look(index, noisy, length=20000.0)  # the same points: the same random numbers are drawn
    error, forward = (seen.body - exact.body)[:, 0], exact.body[:, 0]
    near, far = (forward > 8) & (forward < 10), (forward > 34) & (forward < 40)
    expected = EXACT.pixel * forward**2 / EXACT.height
    assert error[near].std() == pytest.approx(expected[near].mean(), rel=0.2)
    assert error[far].std() == pytest.approx(expected[far].mean(), rel=0.2)


def test_traffic_hides_what_lies_behind_it():
    index = lines_at((-1.8, 0.0), (1.8, 0.0), (-5.4, 0.0))
    _, clear = look(index)
    _, busy = look(index, replace(EXACT, traffic_share=0.9))
    lost = 1 - np.bincount(busy.feature, minlength=3) / np.bincount(clear.feature, minlength=3)
    assert lost[2] > 0.2  # the far side of the next lane
    assert lost[2] > 2 * lost[:2].max()


def test_false_points_and_outages():
    _, seen = look(lines_at((-50.0, 0.0)), replace(EXACT, false_rate=0.1))
    assert len(seen.body) == pytest.approx(200, abs=60)
    assert (seen.feature == -1).all()
    _, dark = look(lines_at((1.8, 0.0)), replace(EXACT, outage_every=1.0, outage_length=1e9))
    assert len(dark.body) == 0


def test_a_standing_vehicle_sees_nothing_new():
    index = lines_at((1.8, 0.0))
    still = np.tile([500.0, 0.0, 0.0], (100, 1))
    rng = np.random.default_rng(1)
    seen = see(still, np.full(100, np.pi / 2), np.arange(100.0), np.zeros(100), index, EXACT, rng=rng, vehicle_rng=rng)
    assert len(seen.body) == 0


def test_a_network_without_lines_shows_nothing():
    index = feature_index(np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int8), EXACT)
    _, seen = look(index)
    assert len(seen.body) == 0


def test_a_camera_that_looks_nowhere_is_refused():
    with pytest.raises(OptionError, match=r"near is 50\.0, far is 40\.0; use near < far"):
        replace(EXACT, near=50.0)
