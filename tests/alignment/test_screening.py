from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe2road.alignment.screening import rows_of_points, screen_drives


def still(traces: pd.DataFrame) -> pd.DataFrame:
    return traces.assign(x=traces["x"].iloc[0], y=traces["y"].iloc[0])


def mirrored(traces: pd.DataFrame) -> pd.DataFrame:
    return traces.assign(x=2.0 * traces["x"].mean() - traces["x"])


def slow_clock(traces: pd.DataFrame) -> pd.DataFrame:
    first = traces["t"].iloc[0]
    return traces.assign(t=first + (traces["t"] - first) * 3)


def two_in_one(traces: pd.DataFrame) -> pd.DataFrame:
    other = traces.assign(t=traces["t"] + pd.Timedelta("100ms"), y=traces["y"] + 2000.0)
    return pd.concat([traces, other])


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (still, "does not move"),
        (mirrored, "heading contradicts the course"),
        (slow_clock, "time and speed contradict the distance"),
        (two_in_one, "jumps to and fro: two drives with one id?"),
    ],
)
def test_bad_drive_is_rejected_and_the_others_are_not(
    road: Any, spoil: Callable[[pd.DataFrame], pd.DataFrame], reason: str
) -> None:
    rng = np.random.default_rng(1)
    drives = [road.drive(k, rng) for k in range(3)]
    drives[1] = (spoil(drives[1][0]), drives[1][1].iloc[:0])
    assert screen_drives(road.fleet(drives)).tolist() == ["", reason, ""]


def test_points_of_another_time_reject_the_drive(road: Any) -> None:
    rng = np.random.default_rng(1)
    traces, points = road.drive(0, rng)
    late = points.assign(t=points["t"] + pd.Timedelta("1h"))
    assert screen_drives(road.fleet([(traces, late)])).tolist() == ["points do not belong to the fixes"]


def test_drives_without_points_heights_or_optional_columns_pass(road: Any) -> None:
    traces, points = road.drive(0, np.random.default_rng(1))
    bare = traces[["trace_id", "t", "x", "y"]]
    assert screen_drives(road.fleet([(bare, points.iloc[:0])])).tolist() == [""]


def test_points_go_to_the_nearest_fix_in_time_of_their_own_drive(road: Any) -> None:
    rng = np.random.default_rng(1)
    fleet = road.fleet([road.drive(k, rng) for k in range(2)])
    rows = rows_of_points(fleet)
    assert (rows >= 0).all()
    for column in ("trace_id", "t"):
        assert (fleet.traces[column].to_numpy()[rows] == fleet.points[column].to_numpy()).all()
