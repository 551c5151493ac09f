from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.io.clocks import times_of_column
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.formats import FleetFormat
from probe2road.options import options_from_table


def read(*cells: Any, dates: list[Any] | None = None, **said: Any) -> list[pd.Timestamp]:
    values, _ = times_of_column(pd.Series(cells), "time", dates=None if dates is None else pd.Series(dates), **said)
    return pd.to_datetime(values, utc=True, format="ISO8601").tolist()


MORNING = pd.Timestamp("2024-05-13T08:00:00Z")


@pytest.mark.parametrize(
    "cell",
    [
        "13.05.2024 08:00:00",
        "13.05.2024 8:00",
        "5/13/2024 8:00 AM",
        "13/05/2024 08:00:00",
        "2024-05-13 08:00:00 UTC",
        "2024-05-13 08:00:00 +0000 UTC",
        "13-May-2024 08:00:00.000",
        "Mon May 13 10:00:00 GMT+02:00 2024",
        "Mon, 13 May 2024 08:00:00 GMT",
        "May 13, 2024, 8:00:00 AM",
        "20240513080000",
        20240513080000,
        "1715587200",
        1715587200000,
    ],
)
def test_times_as_programs_write_them(cell: Any) -> None:
    assert read(cell) == [MORNING]


def test_a_later_cell_tells_the_day_from_the_month() -> None:
    assert read("5/1/2024 8:00", "5/13/2024 8:00")[1] == MORNING
    assert read("1/5/2024 8:00", "13/5/2024 8:00")[1] == MORNING
    with pytest.raises(InputError, match=r"day/month or month/day .* time_format=.* or time_format="):
        read("5/1/2024 8:00", "5/2/2024 8:00")


@pytest.mark.parametrize(
    ("clock", "date"),
    [
        ("08:00:00", "2024-05-13"),
        ("8:00", "13.05.2024"),
        ("8:00:00 AM", "5/13/2024"),
        (80000, 20240513),
        ("080000.00", "20240513"),
        ("08:00", "2024-05-13 00:00:00"),
        ("2024-05-13T08:00:00Z", "2024-05-13"),
        (1715587200, "2024-05-13"),
    ],
)
def test_a_date_beside_a_time_of_day(clock: Any, date: Any) -> None:
    assert read(clock, dates=[date]) == [MORNING]


def test_times_of_day_alone_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    assert read("08:00:00")[0] == pd.Timestamp("1970-01-01T08:00:00Z")
    assert "times of day without date" in caplog.text


def test_the_users_format() -> None:
    assert read("13.5.24 08h00", time_format="%d.%m.%y %Hh%M") == [MORNING]
    assert read("080000", dates=["130524"], time_format="%d%m%y %H%M%S") == [MORNING]
    values, _ = times_of_column(pd.Series(["13.05.24", "never"]), "time", time_format="%d.%m.%y")
    assert values.tolist() == ["2024-05-13T00:00:00.000000+00:00", "never"]  # which is a fault of that row later
    with pytest.raises(InputError, match=r"no time in column 'time' \(t\) has the format %Y \(the first is x\)"):
        read("x", time_format="%Y")


def test_the_header_names_the_unit_of_a_clock_that_starts_at_zero() -> None:
    zero = pd.Timestamp("1970-01-01T00:00:00Z")
    assert (read(0, 200, unit="ms")[1] - zero).total_seconds() == 0.2
    assert (read(0, 200)[1] - zero).total_seconds() == 200.0
    assert read(1715587200, unit="ms") == [MORNING]  # nobody has driven 20 days after 1970


def test_a_format_of_times_in_files(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "drives.csv"
    path.write_text("trip,day,clock,lon,lat\n1,010524,0800,11.5,48.1\n1,010524,0801,11.501,48.1\n")
    fleet = read_fleet(path, columns={"t": "day+clock"}, time_format="%d%m%y %H%M")
    assert fleet.traces["t"].dt.minute.tolist() == [0, 1]
    path.write_text("trip,time,lon,lat\n1,01.05.2024 08:00,11.5,48.1\n1,01.05.2024 08:01,11.501,48.1\n")
    with caplog.at_level(logging.INFO):
        assert read_fleet(path).traces["t"].dt.month.tolist() == [5, 5]
    assert "t as %d.%m.%Y %H:%M" in caplog.text
    path.write_text("trip,Date,Time,lon,lat\n1,2024-05-01,08:00:00,11.5,48.1\n1,2024-05-01,08:00:05,11.501,48.1\n")
    assert read_fleet(path).traces["t"].dt.second.tolist() == [0, 5]


def test_a_format_is_checked_where_it_is_said() -> None:
    assert options_from_table({"time_format": "%H:%M"}, FleetFormat).time_format == "%H:%M"
    with pytest.raises(OptionError, match="names no part of a time"):
        FleetFormat(time_format="hh:mm")
    with pytest.raises(OptionError, match="interval"):
        FleetFormat(interval=-1.0)
