from __future__ import annotations

import logging
from pathlib import Path

import pandas as pd
import pytest

from probe2road.io.fleet_reader import read_fleet
from probe2road.io.units import UNITS, unit_of, without_unit

LINES = "".join(f"1,2024-05-01T08:00:{second:02d}Z,{11.5 + second * 1e-4},48.1,36\n" for second in range(5))


@pytest.mark.parametrize(
    ("header", "ours", "unit", "name"),
    [
        ("Speed [km/h]", "speed", "kmh", "speed"),
        ("speed_kmh", "speed", "kmh", "speed"),
        ("speedKmh", "speed", "kmh", "speed"),
        ("speed_km_h", "speed", "kmh", "speed"),
        ("SPEED KNOTS", "speed", "knots", "speed"),
        ("GPS Speed (Meters/second)", "speed", "meterssecond", "gpsspeed"),
        ("speed", "speed", None, "speed"),
        ("altitude (ft)", "z", "ft", "altitude"),
        ("heading (rad)", "heading", "rad", "heading"),
        ("latitudeE7", "y", "e7", "latitude"),
        ("longitude [°]", "x", None, "longitude"),
        ("timestampMs", "t", "ms", "timestamp"),
        ("created_at", "t", None, "createdat"),
    ],
)
def test_units_in_headers(header: str, ours: str, unit: str | None, name: str) -> None:
    assert (unit_of(header, ours), without_unit(header, ours)) == (unit, name)


def test_a_unit_is_glued_to_usual_names_only() -> None:
    assert unit_of("speedmph", "speed", ["speed"]) == "mph"
    assert unit_of("grad", "heading", ["heading"]) is None
    assert unit_of("rpms", "speed", ["speed"]) is None


def test_units_are_written_as_they_are_looked_up() -> None:
    for units in UNITS.values():
        assert all(unit == unit.lower() and unit.isalnum() for unit in units)
        assert 1.0 in units.values()


@pytest.mark.parametrize(
    ("header", "metres_per_second"),
    [
        ("speed (km/h)", 10.0),
        ("speed_kmh", 10.0),
        ("speed [mph]", 16.09344),
        ("speed_knots", 18.52),
        ("speed (ft/s)", 10.9728),
        ("speed (m/s)", 36.0),
        ("speed", 36.0),
    ],
)
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_speeds_are_read_in_the_unit_of_the_header(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, header: str, metres_per_second: float, suffix: str
) -> None:
    path = tmp_path / f"drives.{suffix}"
    (tmp_path / "drives.csv").write_text(f"trip,time,lon,lat,{header}\n{LINES}")
    if suffix == "parquet":
        pd.read_csv(tmp_path / "drives.csv").to_parquet(path)
    with caplog.at_level(logging.INFO):
        assert read_fleet(path).traces["speed"].tolist() == pytest.approx([metres_per_second] * 5)
    assert ("speed in " in caplog.text) == (metres_per_second != 36.0)


def test_columns_that_the_user_names_have_units_too(tmp_path: Path) -> None:
    (tmp_path / "drives.csv").write_text(f"trip,time,lon,lat,v (km/h)\n{LINES}")
    fleet = read_fleet(tmp_path / "drives.csv", columns={"speed": "v (km/h)"})
    assert fleet.traces["speed"].tolist() == pytest.approx([10.0] * 5)


@pytest.mark.parametrize(
    ("column", "cell", "ours", "expected"),
    [
        ("Speed", "36 km/h", "speed", 10.0),
        ("Speed", "19,44 kn", "speed", 10.0),
        ("Course", "90°", "heading", 90.0),
        ("Altitude", "1000 ft", "z", 304.8),
    ],
)
def test_cells_that_name_their_unit_are_read_in_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, column: str, cell: str, ours: str, expected: float
) -> None:
    lines = LINES.replace(",", ";").replace(";36\n", f";{cell}\n")
    (tmp_path / "drives.csv").write_text(f"trip;time;lon;lat;{column}\n{lines}")
    with caplog.at_level(logging.INFO):
        values = read_fleet(tmp_path / "drives.csv").traces[ours]
    assert values.tolist() == pytest.approx([expected] * 5, abs=3.0 if ours == "heading" else 0.01)
    assert f"{ours} in " in caplog.text


def test_an_unknown_unit_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "drives.csv").write_text(f"trip,time,lon,lat,speed (furlongs)\n{LINES}")
    assert read_fleet(tmp_path / "drives.csv").traces["speed"].tolist() == [36.0] * 5
    assert "the unit of column 'speed (furlongs)' (speed) is not known" in caplog.text


def test_headings_in_radians_and_heights_in_feet(tmp_path: Path) -> None:
    lines = LINES.replace(",36\n", ",1.5707963,1000\n")
    (tmp_path / "drives.csv").write_text(f"trip,time,lon,lat,heading (rad),altitude_ft\n{lines}")
    traces = read_fleet(tmp_path / "drives.csv").traces
    assert traces["heading"].tolist() == pytest.approx([90.0] * 5, abs=3.0)  # from grid north
    assert traces["z"].tolist() == pytest.approx([304.8] * 5)
