"""Fixes and points that no vehicle can have been at."""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
import pytest
from pyproj import CRS

from probe2road.errors import InputError
from probe2road.fleet.contract import fleet_from_tables
from probe2road.fleet.jumps import stray_fixes
from probe2road.fleet.outliers import OutlierOptions, impossible_fixes, main_area
from probe2road.io.describe import describe_fleet

DEGREES, METRES = CRS.from_epsg(4326), "EPSG:32633"


def drive(lon: float = 13.378, *, trace: str = "d0", n: int = 20) -> pd.DataFrame:
    """Draw a drive eastwards through Berlin, a fix a second."""
    return pd.DataFrame({"trace_id": trace, "t": np.arange(n), "x": lon + 1.5e-4 * np.arange(n), "y": 52.519})


def test_a_fix_at_null_island_decides_neither_extent_nor_crs(caplog: pytest.LogCaptureFixture) -> None:
    table = drive()
    table.loc[0, ["x", "y"]] = 0.0
    with caplog.at_level(logging.WARNING):
        fleet = fleet_from_tables(table, crs=DEGREES)
    assert fleet.crs.to_epsg() == 32633
    pd.testing.assert_frame_equal(fleet.traces, fleet_from_tables(drive().iloc[1:], crs=DEGREES).traces)
    assert "left out 1 of 20 fixes, because no vehicle can have been there: trace d0, fix 0 at 0, 0" in caplog.text


@pytest.mark.parametrize("places", [[0], [7], [19], [4, 5, 6], [3, 9, 15]])
@pytest.mark.parametrize("clock", [True, False])
def test_a_handful_of_fixes_far_from_their_trace_is_left_out(places: list[int], clock: bool) -> None:
    table = drive()
    table.loc[places, "y"] += 1.0
    fleet = fleet_from_tables(table if clock else table.drop(columns="t"), crs=DEGREES)
    assert len(fleet.traces) == 20 - len(places)


def test_half_a_trace_in_another_city_stays() -> None:
    table = pd.concat([drive(), drive(16.0).assign(t=np.arange(20, 40))])
    assert len(fleet_from_tables(table, crs=DEGREES).traces) == 40


def test_what_can_be_driven_stays() -> None:
    table = drive()
    table.loc[19, ["t", "x"]] = [19 + 3600, table["x"][18] + 1.0]  # 68 km in an hour
    assert len(fleet_from_tables(table, crs=DEGREES).traces) == 20
    sparse = pd.DataFrame({"trace_id": 1, "x": 400000.0 + 8000 * np.arange(9), "y": 5800000.0})
    assert not impossible_fixes(sparse.assign(t=pd.NaT), CRS.from_user_input(METRES)).any()


def test_nothing_is_left_out_where_the_user_says_so() -> None:
    table = drive()
    table.loc[7, "y"] += 1.0
    fleet = fleet_from_tables(table, crs=DEGREES, outliers=OutlierOptions(drop=False))
    assert len(fleet.traces) == 20


def test_a_fleet_at_null_island_alone_is_refused() -> None:
    with pytest.raises(InputError, match="no vehicle can have been at any of its fixes"):
        fleet_from_tables(drive().assign(x=0.0, y=0.0), crs=DEGREES)


def test_points_far_from_their_trace_or_without_one_are_told(caplog: pytest.LogCaptureFixture) -> None:
    points = pd.DataFrame({"trace_id": ["d0", "d0", "alien"], "x": [13.378, 0.0, 13.3781], "y": [52.519, 0.0, 52.519]})
    with caplog.at_level(logging.WARNING):
        fleet = fleet_from_tables(drive(), points.assign(kind="lane_marking"), crs=DEGREES)
    assert len(fleet.points) == 2
    assert "1 of 3 semantic points are of traces that are not there (alien)" in caplog.text
    assert (
        "left out 1 of 3 semantic points, which are more than 5 km from their traces: trace d0 at 0, 0" in caplog.text
    )


@pytest.mark.parametrize(
    ("places", "expected"), [([5], [5]), ([5, 6], [5, 6]), ([3, 9], [3, 9]), ([0], []), ([19], [])]
)
def test_strays_are_fixes_that_were_not_driven_to_and_back_from(places: list[int], expected: list[int]) -> None:
    x = 400000.0 + 10 * np.arange(20)
    table = pd.DataFrame({"trace_id": 1, "t": np.arange(20), "x": x, "y": 5800000.0})
    table.loc[places, "y"] += 320.0
    assert np.flatnonzero(stray_fixes(fleet_from_tables(table, crs=METRES))).tolist() == expected


def test_two_vehicles_under_one_id_are_no_strays() -> None:
    table = pd.DataFrame({"trace_id": 1, "t": np.arange(20), "x": 400000.0 + 10 * np.arange(20), "y": 5800000.0})
    table.loc[::2, "y"] += 900.0
    assert not stray_fixes(fleet_from_tables(table, crs=METRES)).any()


def test_a_trace_of_its_own_far_away_does_not_choose_the_crs(caplog: pytest.LogCaptureFixture) -> None:
    drives = [drive(trace=f"d{number}") for number in range(5)]
    stray = drive(lon=2.35, trace="paris")
    with caplog.at_level(logging.WARNING):
        fleet = fleet_from_tables(pd.concat([*drives, stray]), crs=DEGREES)
    assert fleet.crs.to_epsg() == 32633
    assert fleet.n_traces == 6
    assert "20 of 120 fixes, far away from the others, do not decide the local CRS" in caplog.text


def test_fixes_that_are_kept_do_not_choose_the_crs() -> None:
    table = drive()
    table.loc[3, "x"] = -150.0
    fleet = fleet_from_tables(table, crs=DEGREES, outliers=OutlierOptions(drop=False))
    assert fleet.crs.to_epsg() == 32633
    assert len(fleet.traces) == 20


def test_cities_of_one_size_choose_the_crs_together() -> None:
    table = pd.DataFrame({"x": np.repeat([0.0, 500e3, 900e3], 5), "y": 6e6})
    assert main_area(table, CRS.from_user_input(METRES)).all()


@pytest.mark.parametrize("clock", [True, False])
def test_a_stray_fix_does_not_refuse_a_table_in_metres(clock: bool) -> None:
    table = pd.DataFrame({"trace_id": 1, "t": range(20), "x": 500e3 + 10.0 * np.arange(20), "y": 5.8e6})
    table.loc[7, "x"] = 9e8
    fleet = fleet_from_tables(table if clock else table.drop(columns="t"), crs=METRES)
    assert len(fleet.traces) == 19


def test_figures_are_those_without_fixes_that_jump_aside(caplog: pytest.LogCaptureFixture) -> None:
    table = pd.DataFrame({"trace_id": 1, "t": range(20), "x": 500e3 + 10.0 * np.arange(20), "y": 5.8e6})
    table.loc[7, "y"] += 400.0
    with caplog.at_level(logging.WARNING):
        figures = describe_fleet(fleet_from_tables(table, crs=METRES))
    assert (figures["fixes"], figures["length_km"]) == (19, 0.19)
    assert "left out 1 of 20 fixes that jump aside and back" in caplog.text
