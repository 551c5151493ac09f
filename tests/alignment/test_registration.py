"""Registration, on lines across a road of ten places."""

from __future__ import annotations

import numpy as np
import pytest

from probe2road.alignment.hypotheses import Track, own_rates
from probe2road.alignment.profiles import RoadPlaces, ShiftSearch, Sights, average_view, empty_profiles
from probe2road.alignment.registration import Chains, DriveEvidence, register

PLACES = RoadPlaces.from_roads(np.zeros(10, np.int64))
SEARCH = ShiftSearch(6.0, 0.25, 20.0, 0.3, 0.7, 0.5)
LINES = np.array([-5.6, -1.8, 1.8])  # m; not alike under any shift of a lane


def shifts(off: list[float], *, settled: bool = False, held: list[bool] | None = None) -> list[float]:
    """Median shift of drives that see the lines, each so many metres off."""
    n = len(off)
    keyframe = np.repeat(np.arange(10 * n), len(LINES))
    value = np.tile(LINES, 10 * n) + np.repeat(off, 10 * len(LINES))
    seen = DriveEvidence(keyframe, keyframe % 10, value, np.zeros(len(keyframe), np.int8))
    chains = Chains(10 * np.arange(n + 1), np.arange(n), np.array(held or [False] * n))
    track = Track(
        np.arange(10 * n) % 10, np.repeat(off, 10), np.zeros(10 * n), np.full(10 * n, 0.1), np.full(10 * n, 20.0)
    )
    return np.median(register(seen, PLACES, chains, track, SEARCH, settled=settled).reshape(n, 10), axis=1).tolist()


def test_the_first_drive_decides_where_no_other_says_more() -> None:
    assert shifts([0.0, 3.5, -2.0]) == pytest.approx([0.0, -3.5, 2.0], abs=0.3)


def test_settled_drives_stay() -> None:
    assert shifts([1.0] * 4, settled=True) == [0.0] * 4


def test_among_settled_drives_the_first_follows_the_others_too() -> None:
    assert shifts([3.5, 0.0, 0.0, 0.0, 0.0], settled=True) == pytest.approx([-3.5, 0.0, 0.0, 0.0, 0.0], abs=0.3)


@pytest.mark.parametrize("settled", [False, True])
def test_held_drives_stay_and_the_others_come_to_them(settled: bool) -> None:
    assert shifts([0.0, 0.0, 3.5], settled=settled, held=[False, False, True]) == pytest.approx(
        [3.5, 3.5, 0.0], abs=0.3
    )


@pytest.mark.parametrize(("lines", "new"), [((-1.75, 1.75), False), ((-5.25, -1.75, 1.75, 5.25), True)])
def test_only_who_sees_other_lanes_knows_a_new_one(lines: tuple[float, ...], new: bool) -> None:
    """Beside the road, where nobody looked, a drive expects its own lines only if cameras see more than one lane."""
    search = ShiftSearch(9.0, 0.25, 29.0, 0.3, 0.7, 0.25)
    keyframe = np.repeat(np.arange(20), len(lines))
    value = np.tile(lines, 20)
    sights = Sights(
        np.arange(21) * len(lines), np.zeros(len(value), np.int64), value, np.zeros(len(value), np.int8)
    )  # fmt: skip
    own = np.zeros(20)
    profiles = empty_profiles(
        RoadPlaces.from_roads(np.zeros(1, np.int64)), average_view(sights, keyframe, own, search), search
    )  # fmt: skip
    track = Track(np.zeros(20, np.int64), own, own, np.full(20, 0.1), np.full(20, 10.0))
    rate = own_rates(0, 20, sights, track, profiles, search)[10, 0]
    at_line = rate[round((1.75 + search.half_width) / search.bin)]
    assert (at_line > 2.0) == new
    assert at_line >= 1.0
