"""The ends of drives, left out."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.fleet.trimming import trim_ends


@pytest.fixture
def fleet() -> Fleet:
    """A long and a short drive, each with a marking seen at every fix."""
    long = pd.DataFrame({"trace_id": "a", "t": np.arange(11), "x": np.arange(0.0, 1001, 100), "y": 0.0})
    short = pd.DataFrame({"trace_id": "b", "t": np.arange(3), "x": np.arange(0.0, 201, 100), "y": 50.0})
    traces = pd.concat([long, short], ignore_index=True)
    points = traces.assign(y=traces["y"] + 3, kind="lane_marking")
    return fleet_from_tables(traces, points, crs="EPSG:32616", keep_crs=True)


def test_both_ends_go_with_the_points_seen_there(fleet: Fleet) -> None:
    trimmed = trim_ends(fleet, 150.0)
    assert trimmed.traces["x"].tolist() == [200, 300, 400, 500, 600, 700, 800]
    assert trimmed.points["x"].tolist() == trimmed.traces["x"].tolist()
    assert set(trimmed.traces["trace_id"]) == {"a"}


def test_points_without_time_go_by_their_distance(fleet: Fleet) -> None:
    untimed = fleet_from_tables(fleet.traces, fleet.points.drop(columns="t"), crs="EPSG:32616", keep_crs=True)
    assert trim_ends(untimed, 150.0).points["x"].tolist() == [200, 300, 400, 500, 600, 700, 800]


def test_nothing_left_and_less_than_nothing_are_refused(fleet: Fleet) -> None:
    with pytest.raises(InputError, match="no trace is longer than both its ends; trim less"):
        trim_ends(fleet, 600.0)
    with pytest.raises(OptionError, match="trim_ends is -1"):
        trim_ends(fleet, -1.0)
    assert trim_ends(fleet, 0.0) is fleet
