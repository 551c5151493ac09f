from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from probe2road.alignment.keyframes import keyframes, sightings
from probe2road.alignment.options import AlignOptions

OPTIONS = AlignOptions(keyframe_spacing=20.0)


def test_motion_is_that_between_keyframes(road: Any) -> None:
    frames = keyframes(road.fleet([road.drive(k, np.random.default_rng(k), turn=0.7) for k in range(2)]), OPTIONS)
    moving = ~frames.first
    assert frames.first.sum() == 2
    assert np.median(frames.motion[moving, 0]) == pytest.approx(20.0)
    assert (frames.motion[moving, 0] > 0).all()
    assert np.allclose(frames.motion[:, 1:], 0.0, atol=1e-6)


def test_where_positions_and_wheels_disagree_the_motion_is_trusted_less(road: Any) -> None:
    traces, points = road.drive(0, np.random.default_rng(1))
    burst = 4.0 * np.exp(-0.5 * ((np.arange(len(traces)) - 45) / 8.0) ** 2)
    frames = keyframes(road.fleet([(traces.assign(y=traces["y"] + burst), points)]), OPTIONS)
    sideways = frames.motion_sigma[:, 1]
    assert sideways.max() > 3.0 * np.median(sideways)


def test_course_stands_in_for_a_missing_heading(road: Any) -> None:
    traces, points = road.drive(0, np.random.default_rng(1), turn=-2.0)
    frames = keyframes(road.fleet([(traces.drop(columns=["heading", "speed"]), points)]), OPTIONS)
    assert np.allclose(frames.pose[:, 2], -2.0, atol=1e-6)
    assert (frames.motion_sigma[~frames.first] > 0).all()


def test_a_gap_begins_a_new_chain(road: Any) -> None:
    traces, points = road.drive(0, np.random.default_rng(1))
    cut = traces[(traces.index < 40) | (traces.index >= 75)]
    frames = keyframes(road.fleet([(cut, points)]), OPTIONS)
    assert np.unique(frames.chain).tolist() == [0, 1]
    assert np.unique(frames.drive).tolist() == [0]


def test_points_keep_their_place_in_the_frame_of_the_vehicle(road: Any) -> None:
    fleet = road.fleet([road.drive(0, np.random.default_rng(1), lane=1.8, turn=1.1)])
    seen = sightings(fleet, keyframes(fleet, OPTIONS))
    assert len(seen.kind) == len(fleet.points)
    # The nearest line is that between the lanes, 1.8 m to the right.
    right = seen.body[np.abs(seen.body[:, 1] + 1.8) < 0.5]
    assert len(right) > 100
    assert abs(np.median(right[:, 1]) + 1.8) < 0.05
