"""Floors at one place, from drives of which each has a height there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probe2road.alignment.floors import Floors, find_floors, floor_of
from probe2road.alignment.keyframes import Keyframes
from probe2road.alignment.options import AlignOptions
from probe2road.alignment.spines import OnSpines, Spines

OPTIONS = AlignOptions()
HEIGHTS = st.lists(st.floats(-30.0, 30.0), min_size=1, max_size=40)


def floors_of(heights: Sequence[float], *, sigma: float = 1.5) -> tuple[Floors, OnSpines]:
    """Floors where drives with GNSS of some accuracy pass a spine of ten cells, in the third."""
    n, none, cells = len(heights), np.zeros(0, np.int64), np.zeros(10, np.int64)
    drives, zero = np.arange(n), np.zeros((n, 3))
    frames = Keyframes(
        drives, drives, drives, np.zeros(n), zero, np.asarray(heights), np.full(n, sigma), zero, zero, np.zeros(n)
    )
    spines = Spines(np.zeros((1, 3)), np.zeros(1), np.zeros(1), np.zeros(1, np.int64), (none, none), none, cells)
    on = OnSpines(np.zeros(n, np.int64), np.zeros(n), np.zeros(n), np.full(n, 2))
    return find_floors(frames, on, np.asarray(heights), spines, OPTIONS), on


def test_drives_between_two_decks_do_not_weld_them() -> None:
    floors, on = floors_of([0.0] * 20 + [1.5, 2.5, 3.5] + [5.0] * 20)
    assert np.bincount(floors.cell).tolist() == [0, 2, 2, 2, 2, 2, 2]
    assert floors.height[floors.cell == 2] == pytest.approx([0.1, 4.8], abs=0.2)
    home = floor_of(floors, on.cell, np.array([0.0] * 20 + [1.5, 2.5, 3.5] + [5.0] * 20), OPTIONS)
    assert len(np.unique(home[:20])) == len(np.unique(home[-20:])) == 1
    assert home[0] != home[-1]


@pytest.mark.parametrize(("drives", "decks"), [(1, 1), (2, 1), (20, 2)])
def test_groups_are_told_apart_if_their_drives_are_not_likely_to_be_wrong(drives: int, decks: int) -> None:
    floors, _ = floors_of([0.0] * drives + [4.0] * drives)
    assert (floors.cell == 2).sum() == decks


def test_better_receivers_tell_more_apart() -> None:
    assert (floors_of([0.0, 4.0], sigma=0.5)[0].cell == 2).sum() == 2


def test_floors_know_those_behind_and_ahead() -> None:
    floors, _ = floors_of([0.0] * 20 + [5.0] * 20)
    assert floors.places.before.tolist() == [-1, -1, *range(10)]
    assert floors.places.after.tolist() == [*range(2, 12), -1, -1]


def test_unknown_heights_make_no_floor() -> None:
    assert len(floors_of([np.nan, np.nan])[0].cell) == 0
    assert floors_of([np.nan, 1.0])[0].height.tolist() == [1.0] * 6


@given(HEIGHTS)
def test_floors_of_a_place_are_a_gate_apart_in_any_order_of_drives(heights: list[float]) -> None:
    one, other = floors_of(heights)[0], floors_of(heights[::-1])[0]
    assert one.height == pytest.approx(other.height)
    at = one.height[one.cell == 2]
    assert (np.diff(at) > OPTIONS.altitude_gate).all()
    assert min(heights) - 1e-9 <= at[0] <= at[-1] <= max(heights) + 1e-9


def test_spines_carry_the_errors_of_their_drives() -> None:
    none = np.zeros(0, np.int64)
    spines = Spines(np.zeros((2, 3)), np.array([0.0, 4.0]), np.zeros(2), np.arange(2), (none, none), none, np.arange(2))
    assert spines.above(np.array([0, 1]), np.array([5.0, 5.0])).tolist() == [5.0, 1.0]
