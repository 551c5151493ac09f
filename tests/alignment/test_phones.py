"""Phones behind the windscreen: a fix a second, markings of the own lane, no boundaries, positions that jump."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe2road.alignment.align import align
from probe2road.alignment.parts import cut_at_jumps, without_false_starts
from probe2road.alignment.screening import rows_of_points, screen_drives
from probe2road.fleet.contract import Fleet
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.networks.network import network_from_sections
from sketches import UTM

SPOILT = 3  # the drive that jumps


@pytest.fixture(scope="module")
def phones() -> Fleet:
    """Nine drives along a straight secondary road of 1.5 km with a lane for each direction, all in one direction."""
    network = network_from_sections([[(0, 0), (1500, 0)]], crs=UTM, highway=["secondary"], lanes_forward=[1])
    made = simulate(network, preset="open_sky", n_drives=9, seed=3).fleet
    second = made.traces["t"].dt.floor("s")
    once = ~made.traces.assign(t=second).duplicated(["trace_id", "t"]).to_numpy()
    sparse = replace(made, traces=made.traces[once].reset_index(drop=True))
    rows = rows_of_points(sparse)
    aside = made.points["y"].to_numpy() - sparse.traces["y"].to_numpy()[rows]
    own_lane = (rows >= 0) & (np.abs(aside) < 2.5) & (made.points["kind"] == "lane_marking").to_numpy()
    return replace(sparse, points=made.points[own_lane].reset_index(drop=True))


def stale_start(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two seconds at one place, 400 m aside."""
    y[:2], x[:2] = y[0] + 400.0, x[0]
    return x, y


def two_stale_starts(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A second at each of two places."""
    y[0] += 900.0
    y[1] -= 300.0
    return x, y


def zero_start(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Three seconds at a position that stands for none."""
    y[:3], x[:3] = -4e6, -4e5
    return x, y


def middle(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From half way on, 300 m aside."""
    y[len(y) // 2 :] += 300.0
    return x, y


def moving_start(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A start that was driven, 300 m aside."""
    y[:30] += 300.0
    return x, y


def spoilt(fleet: Fleet, spoil: Callable[..., tuple[np.ndarray, np.ndarray]]) -> Fleet:
    traces = fleet.traces.copy()
    rows = np.flatnonzero(fleet.owner == SPOILT)
    x, y = spoil(*(traces[axis].to_numpy()[rows].copy() for axis in "yx"))
    traces.loc[rows, "x"], traces.loc[rows, "y"] = x, y
    return replace(fleet, traces=traces)


@pytest.mark.parametrize(("spoil", "fixes"), [(stale_start, 2), (two_stale_starts, 2), (zero_start, 3)])
def test_a_start_without_position_is_trimmed(
    phones: Fleet, spoil: Callable[..., Any], fixes: int, caplog: pytest.LogCaptureFixture
) -> None:
    fleet = spoilt(phones, spoil)
    with caplog.at_level(logging.INFO):
        trimmed = without_false_starts(fleet, np.ones(9, bool))
    first = int(fleet.starts[SPOILT])
    kept = np.ones(len(fleet.traces), bool)
    kept[first : first + fixes] = False
    pd.testing.assert_frame_equal(trimmed.traces, fleet.traces[kept].reset_index(drop=True))
    gone = (fleet.points["trace_id"] == SPOILT) & (fleet.points["t"] < fleet.traces["t"].iloc[first + fixes])
    pd.testing.assert_frame_equal(trimmed.points, fleet.points[~gone].reset_index(drop=True))
    assert f"trimmed 1 of 9 drives: {fixes} fixes" in caplog.text
    assert f"{int(gone.sum())} points" in caplog.text
    assert (screen_drives(trimmed) == "").all()


@pytest.mark.parametrize("spoil", [middle, moving_start])
def test_a_drive_that_jumps_is_cut_and_both_parts_are_kept(phones: Fleet, spoil: Callable[..., Any]) -> None:
    fleet = spoilt(phones, spoil)
    assert without_false_starts(fleet, np.ones(9, bool)) is fleet
    parts, drive = cut_at_jumps(fleet, np.ones(9, bool))
    assert parts.ids.tolist() == ["0", "1", "2", "3/0", "3/1", "4", "5", "6", "7", "8"]
    assert drive.tolist() == [0, 1, 2, 3, 3, 4, 5, 6, 7, 8]
    pd.testing.assert_frame_equal(parts.traces.drop(columns="trace_id"), fleet.traces.drop(columns="trace_id"))
    assert (rows_of_points(parts) >= 0).mean() > 0.95
    assert (screen_drives(fleet) == "").all()


def test_drives_that_are_held_are_neither_trimmed_nor_cut(phones: Fleet) -> None:
    nobody = np.zeros(9, bool)
    assert len(without_false_starts(spoilt(phones, stale_start), nobody).traces) == len(phones.traces)
    assert cut_at_jumps(spoilt(phones, middle), nobody)[0].n_traces == 9


@pytest.mark.parametrize("known", [["speed", "heading"], []])
def test_markings_of_the_own_lane_bring_phones_together(phones: Fleet, known: list[str]) -> None:
    """All drives use one lane: none may come to lie beside it, where nobody else looked."""
    pytest.importorskip("gtsam", reason="alignment needs the extra 'align'")
    rng = np.random.default_rng(2)
    bias = 2.0 * rng.standard_normal(9)
    shifted = [
        table.assign(y=table["y"] + bias[phones.ids.get_indexer(table["trace_id"])])
        for table in (phones.traces, phones.points)
    ]
    unknown = [name for name in ("speed", "heading") if name not in known]
    fleet = spoilt(replace(phones, traces=shifted[0].drop(columns=unknown), points=shifted[1]), middle)
    result = align(fleet)
    status = result.report.drives.set_index("trace_id")["status"]
    assert (status.drop("3/1") == "aligned").all()
    assert "rejected" not in status.to_numpy()
    y = result.fleet.traces.groupby("trace_id")["y"].median().drop("3/1")
    assert np.ptp(y) < 1.75  # m, half a lane
    assert len(result.fleet.traces) == len(fleet.traces)
