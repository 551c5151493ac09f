"""Routes and decks, on keyframes whose spines are given and on whole fleets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from probe2road.alignment.align import AlignOptions, align
from probe2road.alignment.keyframes import keyframes
from probe2road.alignment.routes import routes, split_decks
from probe2road.alignment.spines import OnSpines, Spines

N = 40  # drives
GATE = 3.0  # m


def on_spines(spine: np.ndarray) -> tuple[OnSpines, Spines]:
    """Keyframes on given spines of one cell each."""
    n, none = len(spine), np.zeros(0, np.int64)
    cells = np.arange(spine.max() + 1)
    spines = Spines(np.zeros((len(cells), 3)), np.zeros(len(cells)), 10.0 * cells, cells, (none, none), none, cells)
    return OnSpines(spine, np.zeros(n), np.zeros(n), spine), spines


def test_drives_that_part_are_on_different_routes_also_where_they_are_together(road: Any) -> None:
    fleet = road.biased([0.0] * 3, sigma=0.0, length=105.0)
    frames = keyframes(fleet, AlignOptions())
    drives = np.array([[0, 0, 0, 0, 1, 1], [0, 0, 0, 0, 1, 1], [0, 0, 0, 0, 2, 2]])
    assert len(frames.row) == drives.size
    found = routes(frames, *on_spines(drives.ravel())).reshape(drives.shape)
    assert (found[0] == found[1]).all()
    assert not (found[0] == found[2]).any()


def test_one_keyframe_on_a_neighbouring_spine_does_not_make_a_route(road: Any) -> None:
    frames = keyframes(road.biased([0.0] * 2, sigma=0.0, length=105.0), AlignOptions())
    found = routes(frames, *on_spines(np.array([0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0])))
    assert len(np.unique(found)) == 1


def test_keyframes_off_all_spines_have_no_route(road: Any) -> None:
    frames = keyframes(road.biased([0.0], sigma=0.0, length=105.0), AlignOptions())
    found = routes(frames, *on_spines(np.array([0, 0, 0, -1, -1, -1])))
    assert (found[:3] == found[0]).all()
    assert found[0] >= 0
    assert (found[3:] == -1).all()


@pytest.mark.parametrize("seed", range(20))
def test_errors_of_single_drives_are_not_taken_for_decks(seed: int) -> None:
    sigma = np.full(N, 2.0)
    off = 2.0 * np.random.default_rng(seed).standard_normal(N)
    assert (split_decks(np.zeros(N, int), np.arange(N), off, sigma, GATE) == 0).all()


@pytest.mark.parametrize("seed", range(20))
def test_decks_three_errors_apart_are_told_apart(seed: int) -> None:
    deck = np.arange(N) % 2
    off = 2.0 * np.random.default_rng(seed).standard_normal(N) + 6.0 * deck
    found = split_decks(np.zeros(N, int), np.arange(N), off, np.full(N, 2.0), GATE)
    assert (found == deck).mean() > 0.8


def test_a_drive_is_on_one_deck_and_unknown_heights_change_nothing() -> None:
    drive = np.repeat(np.arange(8), 2)
    off = np.repeat([-3.0, 3.0], 8)
    off[[1, 15]] = np.nan
    found = split_decks(np.zeros(16, int), drive, off, np.ones(16), GATE)
    assert found.tolist() == [0] * 8 + [1] * 7 + [0]


def test_decks_nearer_than_the_errors_of_heights_stay_apart(road: Any) -> None:
    """Thirty drives, heights off by 2 m, on decks 6 m apart: a drive on the wrong one must not join them."""
    rng = np.random.default_rng(8)
    deck = np.arange(30) % 2
    drives = [
        road.drive(k, rng, level=6.0 * deck[k], bias=(0.0, 0.5 * rng.standard_normal(), 2.0 * rng.standard_normal()),
                   markings=np.array((-3.6, 0.0, 3.6)) + 1.5 * deck[k], lane=-1.8 + 1.5 * deck[k])
        for k in range(30)
    ]  # fmt: skip
    height = align(road.fleet(drives)).fleet.traces.groupby("trace_id")["z"].median().to_numpy()
    error = height - 6.0 * deck
    assert (np.abs(error) < 2.0).mean() > 0.8
    for k in (0, 1):
        assert abs(np.median(error[deck == k])) < 1.5
