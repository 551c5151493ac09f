"""What samples show of cameras: the recorded points, a part of them, or the markings abreast of the vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from probe2road.errors import OptionError
from probe2road.fleet.contract import POINT_KINDS
from probe2road.training.cameras import CameraOptions, Points, abreast_markings, seen_points

MARKING = POINT_KINDS.index("lane_marking")
EAST = np.column_stack([np.arange(0.0, 2000.0, 25.0), np.zeros(80)]).astype(np.float32)
BREAKS = np.arange(80) % 40 == 0  # two drives of 975 m
RECORDED = Points(np.tile(EAST, (2, 1)), np.repeat(np.arange(2), 80))


def seen(*, seed: int = 0, camera: bool = True, **options: float) -> Points:
    return seen_points(
        RECORDED, EAST, BREAKS, np.full(80, camera), np.random.default_rng(seed), CameraOptions(**options)
    )


def test_all_points_are_seen_by_default():
    assert seen() is RECORDED


def test_nothing_is_seen_without_a_camera():
    assert len(seen(without_points=1.0).kind) == 0


def test_boundaries_may_not_be_seen():
    poor = seen(markings_only=1.0)
    assert np.array_equal(poor.xy, RECORDED.xy[RECORDED.kind == MARKING])
    assert (poor.kind == MARKING).all()


def test_shares_are_kept():
    shares = {"without_points": 0.2, "markings_only": 0.3, "abreast_only": 0.1}
    found = [len(seen(seed=seed, **shares).kind) for seed in range(400)]
    assert np.mean([n == 0 for n in found]) == pytest.approx(0.2, abs=0.06)
    assert np.mean([n == 80 for n in found]) == pytest.approx(0.3, abs=0.07)
    assert np.mean([n == 160 for n in found]) == pytest.approx(0.4, abs=0.07)


def test_markings_abreast_lie_on_both_sides_half_a_lane_away():
    points = abreast_markings(EAST, BREAKS, np.random.default_rng(1))
    assert (points.kind == MARKING).all()
    assert 0.5 < len(points.kind) / (2 * 1950) < 0.9  # a pair every metre, of which some sides are lost
    usual = np.abs(points.xy[:, 1]) < 3.0
    assert np.abs(np.abs(points.xy[usual, 1]).mean() - 1.75) < 0.2
    assert usual.mean() > 0.8


def test_no_marking_lies_in_a_break():
    points = abreast_markings(EAST, BREAKS, np.random.default_rng(1))
    assert not ((points.xy[:, 0] > 976.0) & (points.xy[:, 0] < 999.0)).any()


def test_a_side_is_lost_for_a_whole_stretch():
    long = np.column_stack([np.arange(0.0, 20000.0, 25.0), np.zeros(800)]).astype(np.float32)
    points = abreast_markings(long, np.arange(800) == 0, np.random.default_rng(1))
    left = np.bincount((points.xy[points.xy[:, 1] > 0, 0] // 25).astype(int), minlength=800)  # of each segment
    assert set(left) == {0, 25}
    assert 20 < np.count_nonzero(np.diff(left)) < 60  # 100 stretches of 200 m, 3 in 10 of them lost


def test_drives_without_a_camera_see_nothing_abreast():
    assert len(seen(abreast_only=1.0, camera=False).kind) == 0
    assert len(abreast_markings(EAST[:1], np.ones(1, bool), np.random.default_rng(1)).kind) == 0


def test_more_samples_than_there_are_is_refused():
    with pytest.raises(OptionError, match=r"shares add up to 1\.2"):
        CameraOptions(without_points=0.6, markings_only=0.6)
