"""Feeds as they are: rows that cannot be right, ids that are none, headers and numbers in every form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.formats import FleetFormat
from sketches import UTM


def drive(n: int = 40, **columns: object) -> pd.DataFrame:
    """A drive due east, 10 m a second."""
    times = pd.date_range("2024-05-01T08:00:00Z", periods=n, freq="s").strftime("%Y-%m-%dT%H:%M:%SZ")
    table = pd.DataFrame({"trip": 1, "time": times, "x": 446e3 + 10.0 * np.arange(n), "y": 4636e3})
    return table.assign(**columns).astype(object)


def read(folder: Path, table: pd.DataFrame, *, suffix: str = "csv", **options: object) -> Fleet:
    path = folder / f"drive.{suffix}"
    if suffix == "csv":
        table.to_csv(path, index=False)
    else:
        table.infer_objects().to_parquet(path)
    return read_fleet(path, **{"crs": UTM, **options})  # type: ignore[arg-type]


def written(folder: Path, text: str, **options: object) -> Fleet:
    (folder / "drive.csv").write_text(text)
    return read_fleet(folder / "drive.csv", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("x", None),
        ("x", "NULL"),
        ("x", "\\N"),
        ("y", "north"),
        ("time", "noon"),
        ("time", None),
        ("time", "0001-01-01T00:00:00Z"),
        ("time", "9999-12-31T23:59:59Z"),
        ("time", "2024-05-01T08:00:09Z"),  # the time of the fix before
        ("trip", None),
    ],
)
def test_a_bad_row_is_left_out_or_refused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, column: str, value: object
) -> None:
    table = drive()
    table.loc[10, column] = value
    assert len(read(tmp_path, table).traces) == 39
    assert "left out" in caplog.text
    with pytest.raises(InputError, match=r'invalid="drop"'):
        read(tmp_path, table, invalid="refuse")
    short = table.iloc[8:13]
    with pytest.raises(InputError, match=r'invalid="drop"'):
        read(tmp_path, short)
    assert len(read(tmp_path, short, invalid="drop").traces) == 4


def test_positions_that_are_not_available(tmp_path: Path) -> None:
    table = drive().rename(columns={"x": "lon", "y": "lat"}).assign(lon=13.4, lat=[52.5 + i * 1e-4 for i in range(40)])
    table.loc[[5, 6], ["lon", "lat"]] = [181.0, 91.0]
    assert len(read(tmp_path, table, crs=None).traces) == 38


def test_a_short_line_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = drive().to_csv(index=False)
    assert len(written(tmp_path, text + "1,2024-05-01T08:0", crs=UTM).traces) == 40
    assert "1 lines do not have 4 fields (line 42: 2): left out" in caplog.text


def test_all_rows_bad_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is empty or not finite in 40 of 40"):
        read(tmp_path, drive(x=None), invalid="drop")


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_headings_that_cannot_be_true(tmp_path: Path, caplog: pytest.LogCaptureFixture, suffix: str) -> None:
    for heading in (-1.0, 511.0, 9000.0, np.pi / 2, 0.0):
        caplog.clear()
        assert read(tmp_path, drive(heading=heading), suffix=suffix).traces["heading"].isna().all()
        assert "unknown" in caplog.text
    for heading in (90.0, -270.0 + 360.0, 95.0):
        assert read(tmp_path, drive(heading=heading), suffix=suffix).traces["heading"].notna().all()
    west = drive(heading=-90.0).assign(x=446e3 - 10.0 * np.arange(40))
    assert read(tmp_path, west).traces["heading"].notna().all()


def test_an_optional_column_of_words_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert "speed" not in read(tmp_path, drive(Speed="23.5 or so")).traces
    assert "the column is left out" in caplog.text
    with pytest.raises(InputError, match=r'columns=\{"speed": ""\}'):
        read(tmp_path, drive(Speed="23.5 or so"), columns={"speed": "Speed"})


def test_limits_of_accuracy_and_speed(tmp_path: Path) -> None:
    table = drive(accuracy=[5.0] * 39 + [80.0])
    table.loc[20, "y"] = 4636e3 + 900.0
    assert len(read(tmp_path, table).traces) == 40
    assert len(read(tmp_path, table, max_accuracy=20).traces) == 39
    assert read(tmp_path, table, max_speed=60).traces["y"].max() < 4636e3 + 100
    with pytest.raises(InputError, match="no fix is accurate to 1 m"):
        read(tmp_path, table, max_accuracy=1)
    for wrong in ({"invalid": "ignore"}, {"max_speed": -1}, {"max_accuracy": "fine"}):
        with pytest.raises(OptionError):
            FleetFormat(**wrong)  # type: ignore[arg-type]


def test_row_numbers_are_no_trace_ids(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    table = drive().rename(columns={"time": "tracked_at"}).assign(trip=range(40)).rename(columns={"trip": "id"})
    fleet = read(tmp_path, table.assign(user_id=7))
    assert (fleet.n_traces, fleet.traces["t"].notna().all()) == (1, True)
    assert "numbers the rows" in caplog.text
    assert read(tmp_path, table).traces["trace_id"].unique().tolist() == ["drive"]
    assert read(tmp_path, table, columns={"trace_id": "id"}).n_traces == 40
    assert "every trace is one fix" in caplog.text or "no column of trace ids" in caplog.text


def test_a_missing_clock_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    read(tmp_path, drive().drop(columns="time"))
    assert "no column of times found" in caplog.text


def test_vehicles_are_told_apart_and_cut_at_pauses(tmp_path: Path) -> None:
    table = drive().rename(columns={"trip": "vehicle_id"})
    table["vehicle_id"] = ["bus1", "bus2"] * 20
    assert read(tmp_path, table).traces["trace_id"].unique().tolist() == ["bus1", "bus2"]
    late = table.assign(time=table["time"].where(table.index < 30, table["time"].str.replace("T08", "T18")))
    assert sorted(read(tmp_path, late).traces["trace_id"].unique()) == ["bus1/0", "bus1/1", "bus2/0", "bus2/1"]


@pytest.mark.parametrize("rows", [None, 10])
def test_a_trace_that_leaves_the_box_is_two(tmp_path: Path, rows: int | None) -> None:
    table = drive().infer_objects()
    table.loc[15:24, "y"] = 4637e3
    path = tmp_path / "drive.parquet"
    table.to_parquet(path, row_group_size=rows)
    box = (445000.0, 4635000.0, 447000.0, 4636500.0)
    fleet = read_fleet(path, crs=UTM, bbox=box)
    assert fleet.traces["trace_id"].value_counts().to_dict() == {"1/0": 15, "1/1": 15}
    table.assign(y=np.where(table.index // 10 == 2, 4637e3, 4636e3)).to_parquet(path, row_group_size=rows)
    assert read_fleet(path, crs=UTM, bbox=box).n_traces == 2
    points = table.iloc[[0, 39]][["trip", "time", "x", "y"]].assign(kind="lane_marking")
    points.to_csv(tmp_path / "seen.csv", index=False)
    seen = read_fleet(path, tmp_path / "seen.csv", crs=UTM, bbox=box).points
    assert seen["trace_id"].tolist() == ["1/0", "1/1"]


@pytest.mark.parametrize(
    "text",
    [
        "Trip Id,Time Stamp,GPS Latitude,GPS Longitude,No of Sat in View\n1,T0,52.5,13.4,9\n1,T1,52.501,13.4,9\n",
        "sep=;\ntrip;time;Latitude [deg];Longitude [deg]\n1;T0;52.5;13.4\n1;T1;52.501;13.4\n",
        "# made by a logger, version 2\n// x, y\ntrip|time|lat|lon\n1|T0|52.5|13.4\n1|T1|52.501|13.4\n",
        "trip,time,geometry\n1,T0,POINT (13.4 52.5)\n1,T1,POINT (13.4 52.501)\n",
        "trip,time,geom\n1,T0,SRID=4326;POINT (13.4 52.5)\n1,T1,SRID=4326;POINT (13.4 52.501)\n",
    ],
)
def test_headers_and_points_of_every_form(tmp_path: Path, text: str) -> None:
    text = text.replace("T0", "2024-05-01T08:00:00Z").replace("T1", "2024-05-01T08:00:10Z")
    fleet = written(tmp_path, text, crs="EPSG:4326")
    assert (fleet.n_traces, len(fleet.traces)) == (1, 2)
    assert np.hypot(*np.ptp(fleet.traces[["x", "y"]].to_numpy(), axis=0)) == pytest.approx(111, abs=1)


def test_lines_in_text_are_no_fixes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="lines have no times"):
        written(tmp_path, 'trip,geometry\n1,"LINESTRING (0 0, 1 1)"\n', crs="EPSG:4326")


def test_a_first_line_of_data_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        written(tmp_path, "1,2008-02-02 15:36:08,116.51172,39.92123\n1,2008-02-02 15:36:18,116.51172,39.92213\n")
    assert "(header=False)" in str(caught.value)
    assert 'columns={"trace_id": "0", "t": "1", "x": "2", "y": "3"} crs="EPSG:4326"' in str(caught.value)


def test_numbers_that_are_no_seconds(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    days = 45413.3333333 + np.arange(40) / 86400
    for suffix in ("csv", "parquet"):
        with pytest.raises(InputError, match=r"column 'time' .* looks like a day number"):
            read(tmp_path, drive(time=days), suffix=suffix)
    written_out = [int(f"2024050108{minute:02d}") for minute in range(40)]
    assert read(tmp_path, drive(time=written_out)).traces["t"].iloc[1] == pd.Timestamp("2024-05-01T08:01Z")
    read(tmp_path, drive(time=range(80000, 80040)))
    assert "in the year 1970 are no such drives" in caplog.text


def test_semantic_points_of_nobody_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    points = pd.DataFrame({"trip": [77, 1], "x": [446e3, 546e3], "y": 4636e3, "kind": "lane_marking"})
    points.to_csv(tmp_path / "seen.csv", index=False)
    read(tmp_path, drive(), points=tmp_path / "seen.csv")
    assert "1 of 2 semantic points are of traces that are not there" in caplog.text
    assert "left out 1 of 2 semantic points, which are more than 5 km from their traces" in caplog.text


def test_messages_are_some_lines(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        written(tmp_path, ",".join(f"c{i}" for i in range(9000)) + "\n" + ",".join(["1"] * 9000) + "\n")
    assert len(str(caught.value)) < 1500
    table = drive()
    table.loc[:, "x"] = "far" * 9000
    with pytest.raises(InputError) as caught:
        read(tmp_path, table)
    assert len(str(caught.value)) < 1500


@pytest.mark.parametrize(("factor", "unit"), [(3.6, "km/h"), (1.944, "knots"), (2.237, "mph")])
def test_speeds_of_another_unit_are_told_by_the_movement(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, factor: float, unit: str
) -> None:
    noise = np.random.default_rng(0).normal(1.0, 0.05, 40)
    speeds = read(tmp_path, drive(speed=10.0 * factor * noise)).traces["speed"]
    assert speeds.median() == pytest.approx(10.0, rel=0.03)
    assert f"taken as {unit}; say the unit in the name of the column" in caplog.text


@pytest.mark.parametrize(("speed", "warned"), [(10.0, False), (15.0, False), (50.0, True), (2.8, True), (0.0, False)])
def test_speeds_of_no_unit_stay_as_they_are(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, speed: float, warned: bool
) -> None:
    assert read(tmp_path, drive(speed=speed)).traces["speed"].tolist() == [speed] * 40
    assert read(tmp_path, drive(10, speed=36.0)).traces["speed"].tolist() == [36.0] * 10  # too few to say
    assert ("check their unit" in caplog.text) == warned


ROWS = range(6)


@pytest.mark.parametrize("number", ["id", "fid", "index", "Unnamed: 0", "objectid", "OBJECTID", "row", ""])
@pytest.mark.parametrize(
    "clock", ["created_at", "datetime", "gps_time", "recorded", "epoch_ms", "Time Stamp", "fixTime"]
)
def test_row_numbers_are_no_traces_and_clocks_are_found(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, number: str, clock: str
) -> None:
    times = [1714550400000 + 1000 * row if clock == "epoch_ms" else f"2024-05-01 08:00:0{row}" for row in ROWS]
    lines = "".join(f"{row},{4 + row // 3},{times[row]},11.5{row},48.1\n" for row in ROWS)
    traces = written(tmp_path, f"{number},taxi_id,{clock},lon,lat\n{lines}").traces
    assert traces["trace_id"].tolist() == [4, 4, 4, 5, 5, 5]
    assert traces["t"].dt.second.tolist() == list(ROWS)
    assert "traces are told apart by 'taxi_id'" in caplog.text


def test_a_vehicle_that_pauses_is_on_another_drive(tmp_path: Path) -> None:
    hours = (8, 8, 9, 9)
    lines = "".join(f"4,2024-05-01T0{hour}:00:0{row}Z,11.5{row},48.1\n" for row, hour in enumerate(hours))
    assert written(tmp_path, f"taxi_id,tracked_at,lon,lat\n{lines}").traces["trace_id"].tolist() == [
        *("4/0", "4/0", "4/1", "4/1")
    ]


def test_the_title_of_a_report_is_passed_over(tmp_path: Path) -> None:
    title = "Report: Route\nDevice: Van 3\n\nPeriod: May 2024\n"
    lines = "".join(f"2024-05-01 08:00:0{row},48.1,11.50{row},north\n" for row in ROWS)
    table = f"{title}Time,Latitude,Longitude,z\n{lines}"
    with pytest.raises(InputError, match=r"line 6: north"):
        written(tmp_path, table, columns={"t": "Time", "z": "z"})
    assert len(written(tmp_path, table.replace("north", "500"), header=True).traces) == 6


@pytest.mark.parametrize(
    ("line", "columns"),
    [
        ("37.75134 -122.39488 0 1213084687", '{"t": "3", "x": "1", "y": "0"}'),
        (
            "6a0c,9f8b,1475277482,104.04392,30.67518",
            '{"vehicle_id": "0", "trace_id": "1", "t": "2", "x": "3", "y": "4"}',
        ),
    ],
)
def test_a_first_line_of_data_shows_the_columns(tmp_path: Path, line: str, columns: str) -> None:
    with pytest.raises(InputError) as caught:
        written(tmp_path, f"{line}\n{line}\n")
    assert f'columns={columns} crs="EPSG:4326"' in str(caught.value)


def test_rows_may_end_with_a_delimiter(tmp_path: Path) -> None:
    lines = "".join(f"1,2024-05-01 08:00:0{row},48.1,11.50{row},\n" for row in ROWS)
    assert len(written(tmp_path, f"trip,time,lat,lon\n{lines}").traces) == 6
