from __future__ import annotations

import logging
import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from pyproj import CRS

from probe2road.errors import CRSError, InputError, OptionError
from probe2road.fleet.contract import TraceGaps, fleet_from_tables, trace_breaks
from probe2road.fleet.jumps import position_jumps
from sketches import UTM


def drives(**columns: object) -> pd.DataFrame:
    """Two drives in Chicago: three fixes and two, one a second, nine metres apart."""
    table = pd.DataFrame(
        {
            "trace_id": [1, 1, 1, 2, 2],
            "t": [0, 1, 2, 0, 1],
            "x": [446000.0, 446009.0, 446018.0, 446000.0, 446009.0],
            "y": [4636000.0, 4636000.0, 4636000.0, 4636500.0, 4636500.0],
        }
    )
    return table.assign(**columns)


def refusal(table: pd.DataFrame, points: pd.DataFrame | None = None, crs: str = UTM) -> str:
    with pytest.raises(InputError) as caught:
        fleet_from_tables(table, points, crs=crs)
    return str(caught.value)


def test_a_good_table_becomes_a_fleet_in_canonical_types() -> None:
    table = drives(speed=9, vehicle_id="v")
    fleet = fleet_from_tables(table, crs=UTM)
    assert list(fleet.traces) == ["trace_id", "t", "x", "y", "z", "vehicle_id", "speed"]
    assert str(fleet.traces["t"].dtype) == "datetime64[ns, UTC]"
    assert fleet.traces["speed"].dtype == np.float64
    assert fleet.starts.tolist() == [0, 3, 5]
    assert fleet.n_traces == 2
    assert fleet.bounds == (446000.0, 4636000.0, 446018.0, 4636500.0)
    assert list(fleet.points) == ["trace_id", "t", "x", "y", "z", "kind"]
    assert len(fleet.points) == 0


def test_the_input_is_not_changed() -> None:
    table = drives().iloc[::-1]
    before = table.copy(deep=True)
    fleet_from_tables(table, crs=UTM)
    pd.testing.assert_frame_equal(table, before)


def test_rows_are_sorted_and_times_that_go_backwards_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        fleet = fleet_from_tables(drives().iloc[[4, 2, 0, 1, 3]], crs=UTM)
    pd.testing.assert_frame_equal(fleet.traces, fleet_from_tables(drives(), crs=UTM).traces)
    assert "times go backwards within 1 traces" in caplog.text


def test_repeated_fixes_are_dropped_and_disagreeing_ones_refused(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert len(fleet_from_tables(pd.concat([drives(), drives().iloc[:2]]), crs=UTM).traces) == 5
    assert "dropped 2 repeated fixes" in caplog.text
    message = refusal(pd.concat([drives(), drives().iloc[:1].assign(x=446300.0)]))
    assert "1 fixes repeat the time of the fix before at another place (trace 1)" in message


def test_traces_without_clock_keep_their_order() -> None:
    table = drives().drop(columns="t").iloc[[2, 0, 1, 3, 4]]
    fleet = fleet_from_tables(table, crs=UTM)
    assert fleet.traces["t"].isna().all()
    assert fleet.traces["x"].tolist() == table["x"].tolist()
    assert trace_breaks(fleet).tolist() == [True, False, False, True, False]


def test_a_trace_with_a_clock_on_some_fixes_only_is_refused() -> None:
    assert "some fixes of 1 traces have no time (1)" in refusal(drives(t=[0, None, 2, 0, 1]))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": [446000.0, np.nan, 1, 1, 1]}, "column 'x' is empty or not finite in 1 of 5 rows (row 1: nan)"),
        ({"y": [4636000.0, np.inf, 1, 1, 1]}, "column 'y' is empty or not finite in 1 of 5 rows (row 1: inf)"),
        ({"x": ["446000", "446009", "abc", "1", "1"]}, "column 'x' is not a number in 1 of 5 rows (row 2: abc)"),
        ({"x": ["1,5", "1,6", "1,7", "1,8", "1,9"]}, "decimal commas are not read, use points"),
        ({"speed": ["9", "fast", "9", "9", "9"]}, "column 'speed' is not a number in 1 of 5 rows (row 1: fast)"),
        ({"t": ["2024-05-01", "noon", "2024-05-01", "", None]}, "column 't' is not a time in 1 of 5 rows (row 1: noon"),
        ({"t": [0, 1, 2, 0, 1e15]}, "column 't' is not in seconds since 1970"),
        ({"trace_id": [1, 1, None, 2, 2]}, "column 'trace_id' is empty in 1 of 5 rows"),
    ],
)
def test_bad_cells_are_named(columns: dict[str, object], message: str) -> None:
    assert message in refusal(drives(**columns))


def test_numbers_typed_as_text_are_read() -> None:
    fleet = fleet_from_tables(drives(x=drives()["x"].astype(str)), crs=UTM)
    assert fleet.traces["x"].tolist() == drives()["x"].tolist()


def test_all_faults_of_both_tables_are_reported_at_once() -> None:
    points = pd.DataFrame({"trace_id": [1], "x": [np.nan], "y": [1.0], "kind": ["tree"]})
    message = refusal(drives(x="a", t="noon"), points)
    for fault in ("4 faults", "column 'x' is not a number", "'t' is not a time", "'x' is empty", "not tree"):
        assert fault in message


def test_missing_columns_and_empty_tables() -> None:
    assert "column 'y' is missing (there are: trace_id, t, x)" in refusal(drives().drop(columns="y"))
    assert "traces: no rows" in refusal(drives().iloc[:0])
    with pytest.raises(CRSError, match="no CRS"):
        fleet_from_tables(drives(), crs=None)


LON, LAT = [-87.65, -87.6499], [41.87, 41.8701]


@pytest.mark.parametrize(
    ("x", "y", "crs", "message"),
    [
        (LON, [41.87, 95.0], "EPSG:4326", "latitudes are outside -90..90 in 1 of 2 rows (row 1: 95.0)"),
        ([200.0, -87.65], LAT, "EPSG:4326", "longitudes are outside -180..180 in 1 of 2 rows (row 0: 200.0)"),
        ([37.7, 37.8], [-122.4, -122.5], "EPSG:4326", "longitude and latitude look swapped"),
        (LAT, LON, "EPSG:4326", "longitude and latitude look swapped"),
        (
            [446000.0, 446009.0],
            [4636000.0, 4636000.0],
            "EPSG:4326",
            "the values look projected: pass their CRS, for example crs=",
        ),
        (LON, LAT, UTM, 'the CRS is WGS 84 / UTM zone 16N; pass crs="EPSG:4326" if so'),
        ([4636000.0, 4636000.0], [446000.0, 446009.0], UTM, "x and y look swapped"),
        ([9e8, 9e8], [4636000.0, 4636000.0], UTM, "far from where WGS 84 / UTM zone 16N is used; check the CRS"),
    ],
)
def test_positions_that_contradict_the_crs(x: list[float], y: list[float], crs: str, message: str) -> None:
    assert message in refusal(pd.DataFrame({"trace_id": 1, "t": [0, 1], "x": x, "y": y}), crs=crs)


def test_one_bad_latitude_is_not_called_swapped() -> None:
    table = pd.DataFrame({"trace_id": 1, "t": [0, 1, 2], "x": [-87.65] * 3, "y": [41.87, 95.0, 41.87]})
    assert "swapped" not in refusal(table, crs="EPSG:4326")


def test_the_crs_of_the_run() -> None:
    degrees = pd.DataFrame({"trace_id": 1, "t": [0, 1], "x": LON, "y": LAT})
    fleet = fleet_from_tables(degrees, crs="EPSG:4326")
    assert fleet.crs.to_epsg() == 32616
    assert fleet_from_tables(drives(), crs=UTM).crs.to_epsg() == 32616
    x, y = 2_645_000.0, 4_600_000.0  # Athens in Web Mercator, whose metre is too short to work in
    mercator = pd.DataFrame({"trace_id": 1, "t": [0, 1], "x": [x, x + 9], "y": y})
    assert fleet_from_tables(mercator, crs="EPSG:3857").crs.to_epsg() == 32634
    assert fleet_from_tables(mercator, crs="EPSG:3857", target_crs="EPSG:2100").crs.to_epsg() == 2100
    with pytest.raises(CRSError, match="degrees"):
        fleet_from_tables(degrees, crs="EPSG:4326", target_crs="EPSG:4326")
    with pytest.raises(CRSError, match="degrees"):
        fleet.to_crs("EPSG:4326")
    there_and_back = fleet.to_crs("EPSG:32615").to_crs("EPSG:32616")
    np.testing.assert_allclose(there_and_back.traces[["x", "y"]], fleet.traces[["x", "y"]], atol=1e-3)
    assert fleet.to_crs(CRS.from_epsg(32616)).traces.equals(fleet.traces)


def test_points_share_the_type_of_ids_with_the_traces() -> None:
    points = pd.DataFrame({"trace_id": ["1", "2"], "x": 446000.0, "y": 4636000.0, "kind": "lane_marking"})
    fleet = fleet_from_tables(drives(), points, crs=UTM)
    assert set(fleet.points["trace_id"]) == set(fleet.traces["trace_id"]) == {"1", "2"}
    assert fleet.points["kind"].cat.categories.tolist() == ["lane_marking", "road_boundary"]


def breaks_of(t: list[float] | None, x: list[float], gaps: TraceGaps | None = None) -> list[int]:
    table = pd.DataFrame({"trace_id": 1, "x": np.add(x, 446000.0), "y": 4636000.0})
    fleet = fleet_from_tables(table if t is None else table.assign(t=t), crs=UTM)
    return np.flatnonzero(trace_breaks(fleet, gaps)).tolist()


def test_a_trace_is_broken_at_gaps() -> None:
    assert breaks_of([0, 1, 2, 9, 10], [0, 10, 20, 90, 100]) == [0, 3]  # seven seconds without a fix
    assert breaks_of([0, 1, 2, 3, 4], [0, 10, 20, 190, 200]) == [0, 3]  # a jump
    assert breaks_of([0, 1, 2, 3, 4], [0, 10, 20, 110, 120]) == [0, 3]  # 90 m/s
    assert breaks_of(None, [0, 10, 20, 190, 200]) == [0, 3]


def test_standing_still_is_no_gap() -> None:
    assert breaks_of([0, 3, 6, 66, 69], [0, 25, 50, 60, 85]) == [0]


@pytest.mark.parametrize("interval", [1, 3, 5, 10, 30])
def test_a_slow_feed_does_not_fall_apart(interval: int) -> None:
    t = np.arange(20) * interval
    assert breaks_of(t.tolist(), (t * 13.0).tolist()) == [0]
    t = np.delete(t, [8, 9, 10, 11])  # four fixes are missing
    assert breaks_of(t.tolist(), (t * 13.0).tolist()) == ([0, 8] if interval * 5 > 5 else [0])


def test_limits_of_gaps_are_options() -> None:
    assert breaks_of([0, 1, 2, 9, 10], [0, 10, 20, 90, 100], TraceGaps(max_interval=10)) == [0]
    with pytest.raises(OptionError, match="max_step is 0"):
        TraceGaps(max_step=0)


def test_headings_turn_with_the_north_of_the_crs():
    # A drive due east along a parallel, in the east of a UTM zone: there and back its headings are as they were.
    table = pd.DataFrame({"trace_id": 1, "t": [0, 1, 2], "x": [11.8, 11.85, 11.9], "y": 50.0, "heading": 90.0})
    fleet = fleet_from_tables(table, crs="EPSG:4326", target_crs="EPSG:32632")
    xy = fleet.traces[["x", "y"]].to_numpy()
    driven = np.degrees(np.arctan2(*(xy[2] - xy[0]))) % 360
    assert fleet.traces["heading"].to_numpy() == pytest.approx(driven, abs=0.1)
    assert abs(driven - 90.0) > 1.0
    other = fleet.to_crs("EPSG:32633")
    assert other.traces["heading"].iloc[0] > 90.0
    assert other.to_crs("EPSG:32632").traces["heading"].to_numpy() == pytest.approx(fleet.traces["heading"], abs=1e-3)


def test_fixes_know_their_trace_and_traces_their_id() -> None:
    fleet = fleet_from_tables(drives(trace_id=["b", "b", "b", "a", "a"]), crs=UTM)
    assert fleet.owner.tolist() == [0, 0, 1, 1, 1]
    assert fleet.ids.tolist() == ["a", "b"]
    assert fleet.ids.dtype == fleet.traces["trace_id"].dtype
    assert fleet.owner is fleet.owner
    with pytest.raises(ValueError, match="read-only"):
        fleet.owner[0] = 1


def test_what_was_found_in_a_fleet_does_not_travel_with_it() -> None:
    fleet = fleet_from_tables(drives(), crs=UTM)
    assert len(fleet.owner) == len(fleet.traces) == 5
    fewer = replace(fleet, traces=fleet.traces.iloc[3:].reset_index(drop=True))
    assert (fewer.owner.tolist(), fewer.ids.tolist()) == ([0, 0], [2])
    empty = replace(fleet, traces=fleet.traces.iloc[:0])
    assert (empty.owner.tolist(), empty.ids.tolist()) == ([], [])
    assert set(vars(pickle.loads(pickle.dumps(fleet)))) == {"traces", "points", "crs"}


@pytest.mark.parametrize(
    ("repeats", "jumps"),
    [
        (1, []),  # the receiver had no new position once; the next step covers two seconds
        (3, []),
        (10, [11]),  # the vehicle stood
    ],
)
def test_a_repeated_position_is_stale_for_a_while_and_no_jump_follows(repeats: int, jumps: list[int]) -> None:
    x = np.concatenate([[0.0], np.full(repeats, 0.0), 39.0 * np.arange(repeats + 1, repeats + 4)])
    if jumps:
        x[repeats + 1 :] += 100.0 - x[repeats + 1]
    table = pd.DataFrame({"trace_id": 1, "t": range(len(x)), "x": x, "y": 0.0})
    fleet = fleet_from_tables(table, crs=UTM, keep_crs=True)
    assert np.flatnonzero(position_jumps(fleet)).tolist() == jumps
    assert np.flatnonzero(trace_breaks(fleet, TraceGaps(max_step=1e4))).tolist() == [0, *jumps]


def test_without_a_clock_a_long_step_is_a_jump() -> None:
    table = pd.DataFrame({"trace_id": [1, 1, 1, 1, 2], "x": [0.0, 100.0, 200.0, 700.0, 9000.0], "y": 0.0})
    fleet = fleet_from_tables(table, crs=UTM, keep_crs=True)
    assert np.flatnonzero(position_jumps(fleet)).tolist() == [3]
