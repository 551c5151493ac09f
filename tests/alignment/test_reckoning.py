from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from probe2road.alignment.align import align
from probe2road.alignment.reckoning import steadying
from probe2road.fleet.contract import Fleet, fleet_from_tables
from sketches import UTM


def city_drive(rng: np.random.Generator, *, stretch: float = 1.0, turned: float = 0.0) -> tuple[Fleet, NDArray[Any]]:
    """Five minutes through blocks of 200 m at 1 Hz, stops included, and the true positions, shape (n, 2).

    The speedometer is off by a factor, the compass by some degrees.
    """
    t = np.arange(300.0)
    speed = np.where(t % 60 < 12, 0.0, 10.0)
    heading = np.radians(np.select([(t // 60) % 2 == 0], [0.0], 90.0))
    step = speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    true = np.array([446e3, 4636e3]) + np.cumsum((step + np.roll(step, 1, axis=0)) / 2.0, axis=0)
    table = pd.DataFrame(
        {"trace_id": 1, "t": t, "x": true[:, 0], "y": true[:, 1], "accuracy": 3.0}
        | {"speed": speed * stretch, "heading": (90.0 - np.degrees(heading) + turned) % 360.0}
    )
    table[["x", "y"]] += rng.normal(0.0, 1.0, true.shape)
    return fleet_from_tables(table, crs=UTM, keep_crs=True), true


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def away(fleet: Fleet, true: NDArray[Any], move: NDArray[Any] | float = 0.0) -> NDArray[Any]:
    """Distance of each fix to where it truly was, m."""
    return np.asarray(np.hypot(*(fleet.traces[["x", "y"]].to_numpy() + move - true).T))


def with_burst(fleet: Fleet, fixes: slice, by: float) -> Fleet:
    traces = fleet.traces.copy()
    traces.loc[traces.index[fixes], "y"] += by
    return Fleet(traces, fleet.points, fleet.crs)


def test_bursts_are_taken_out_and_the_rest_gets_smoother(rng: np.random.Generator) -> None:
    fleet, true = city_drive(rng)
    fleet = with_burst(with_burst(fleet, slice(100, 108), 80.0), slice(200, 201), -250.0)
    before, after = away(fleet, true), away(fleet, true, steadying(fleet))
    assert before.max() > 200.0
    assert after.max() < 8.0
    assert np.median(after) < 0.6 * np.median(before)


def test_a_speedometer_and_a_compass_that_are_off_do_no_harm(rng: np.random.Generator) -> None:
    fleet, true = city_drive(rng, stretch=1.05, turned=3.0)
    assert np.percentile(away(fleet, true, steadying(fleet)), 95) < np.percentile(away(fleet, true), 95)


def test_a_bias_that_stays_is_kept(rng: np.random.Generator) -> None:
    fleet, true = city_drive(rng)
    moved = with_burst(fleet, slice(0, None), 7.0)
    np.testing.assert_allclose(steadying(moved), steadying(fleet), atol=1e-6)
    assert np.median(away(moved, true, steadying(moved))) == pytest.approx(7.0, abs=0.5)


@pytest.mark.parametrize("missing", ["speed", "heading"])
def test_without_speed_or_heading_nothing_moves(rng: np.random.Generator, missing: str) -> None:
    fleet, _ = city_drive(rng)
    assert not steadying(Fleet(fleet.traces.drop(columns=missing), fleet.points, fleet.crs)).any()


def test_drives_and_gaps_are_kept_apart(rng: np.random.Generator) -> None:
    fleet, _ = city_drive(rng)
    traces = fleet.traces
    later = traces.assign(trace_id=2, y=traces["y"] + 500.0)
    cut = traces["t"] >= traces["t"].iloc[150]
    gap = traces.assign(t=traces["t"] + pd.to_timedelta(np.where(cut, 60.0, 0.0), unit="s"))
    both = steadying(Fleet(pd.concat([traces, later], ignore_index=True), fleet.points, fleet.crs))
    np.testing.assert_allclose(both[:300], both[300:], atol=1e-6)
    halves = [steadying(Fleet(half.reset_index(drop=True), fleet.points, fleet.crs)) for half in (gap[~cut], gap[cut])]
    # Scale and direction are fitted to the whole drive, so the halves agree to some centimetres.
    np.testing.assert_allclose(steadying(Fleet(gap, fleet.points, fleet.crs)), np.vstack(halves), atol=0.5)


def test_a_drive_through_reflections_is_aligned_nearer_to_the_truth(rng: np.random.Generator) -> None:
    fleet, true = city_drive(rng)
    fleet = with_burst(fleet, slice(100, 108), 80.0)
    result = align(fleet)
    assert result.report.drives["status"].tolist() == ["by path"]
    moved = np.hypot(*(result.fleet.traces[["x", "y"]].to_numpy() - fleet.traces[["x", "y"]].to_numpy()).T)
    assert result.report.drives["shift"].iloc[0] == pytest.approx(np.median(moved))
    assert away(result.fleet, true).max() < 8.0
    assert np.median(away(result.fleet, true)) < np.median(away(fleet, true))
