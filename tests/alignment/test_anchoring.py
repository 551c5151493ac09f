"""Anchoring, on a straight road whose drives were all put aside together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from probe2road.alignment.align import AlignOptions
from probe2road.alignment.anchoring import anchored
from probe2road.alignment.keyframes import Keyframes, keyframes
from probe2road.alignment.profiles import RoadPlaces

N = 16  # drives


@pytest.fixture(scope="module")
def frames(road: Any) -> Keyframes:
    return keyframes(road.biased([0.0] * N, sigma=1.5), AlignOptions())


def moved_back(frames: Keyframes, off: float, *, drives: int = N, held: int = 0) -> np.ndarray:
    """How far each keyframe goes back to the right after all drives were put to the left, m."""
    pose = frames.pose + np.array([0.0, off, 0.0])
    floor = (frames.pose[:, 0] // 10.0).astype(np.int64)
    home = np.where(frames.drive < drives, floor - floor.min(), -1)
    places = RoadPlaces.from_roads(np.zeros(home.max() + 1, np.int64))
    there = anchored(frames, pose, np.zeros(len(pose)), home, places, AlignOptions(), held=frames.drive < held)
    assert (there[:, [0, 2]] == pose[:, [0, 2]]).all()
    return pose[:, 1] - there[:, 1]


@pytest.mark.parametrize("off", [-4.0, 4.0])
def test_a_road_goes_back_as_a_whole(frames: Keyframes, off: float) -> None:
    back = moved_back(frames, off)
    assert np.abs(back - off).max() < 1.5  # three standard errors of the mean of all drives
    assert np.ptp(back) < 0.5


def test_a_road_where_gnss_may_be_stays(frames: Keyframes) -> None:
    assert (moved_back(frames, 0.5) == 0.0).all()


def test_two_drives_are_no_proof_of_three_metres(frames: Keyframes) -> None:
    assert (moved_back(frames, 3.0, drives=2) == 0.0).all()


def test_drives_on_no_road_stay(frames: Keyframes) -> None:
    back = moved_back(frames, 4.0, drives=14)
    assert (back[frames.drive >= 14] == 0.0).all()
    assert (back[frames.drive < 14] > 2.0).all()


def test_a_road_with_a_held_drive_stays(frames: Keyframes) -> None:
    assert (moved_back(frames, 4.0, held=1) == 0.0).all()
