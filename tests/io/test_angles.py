from __future__ import annotations

import logging
from pathlib import Path

import pandas as pd
import pytest

from probe2road.crs import WGS84, transform
from probe2road.errors import InputError
from probe2road.fleet.contract import Fleet
from probe2road.io.angles import degrees_of_column
from probe2road.io.fleet_reader import read_fleet


@pytest.mark.parametrize(
    ("cell", "degrees"),
    [
        ("48.5N", 48.5),
        ("S48.5", -48.5),
        ("48,5 N", 48.5),
        ("48°30'0.0\"S", -48.5),
        ("48 30 0 N", 48.5),
        ("N 48° 30.0", 48.5),
        ("-48:30:00", -48.5),
        ("48.5°", 48.5),
    ],
)
def test_degrees_in_text(cell: str, degrees: float) -> None:
    assert degrees_of_column(pd.Series([cell, cell]), "y")[0].tolist() == pytest.approx([degrees] * 2)


@pytest.mark.parametrize("cells", [["48.1", "48.2"], ["here", "there"], ["48d30m0s", "1"], []])
def test_other_text_is_left_as_it_is(cells: list[str]) -> None:
    values = pd.Series(cells, dtype="str")
    assert degrees_of_column(values, "y")[0].equals(values)


def place(fleet: Fleet) -> tuple[float, float]:
    """Return longitude and latitude of the first fix."""
    lon, lat = transform(fleet.traces["x"].to_numpy(), fleet.traces["y"].to_numpy(), fleet.crs, WGS84)
    return round(float(lon[0]), 5), round(float(lat[0]), 5)


@pytest.mark.parametrize(
    ("header", "line", "expected"),
    [
        ("lat,lon", "48.1,11.5", (11.5, 48.1)),
        ("latitudeE7,longitudeE7", "481000000,115000000", (11.5, 48.1)),
        ("lat,lon", "481000000,115000000", (11.5, 48.1)),
        ("lat_rad,lon_rad", "0.839503371,0.200712864", (11.5, 48.1)),
        ("lat,lon", "48.1S,11.5W", (-11.5, -48.1)),
        ("lat,N/S,lon,E/W", "48.1,S,11.5,W", (-11.5, -48.1)),
        ("lat,ns,lon,ew", "4806.0,N,01130.0,E", (11.5, 48.1)),
        ("lat,lon", '"48,1","11,5"', (11.5, 48.1)),
        ("lat;lon", "48,1;11,5", (11.5, 48.1)),
        ("rawlat,rawlng", "48.1,11.5", (11.5, 48.1)),
    ],
)
def test_degrees_in_files(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, header: str, line: str, expected: tuple[float, float]
) -> None:
    path = tmp_path / "drives.csv"
    path.write_text(f"{header}\n{line}\n{line}\n{line}\n")
    with caplog.at_level(logging.INFO):
        assert place(read_fleet(path)) == expected
    plain = line.replace(";", ",").replace("48,1", "48.1").replace("11,5", "11.5") == "48.1,11.5"
    assert plain or " y in " in caplog.text


def test_integers_that_could_be_two_things_are_refused(tmp_path: Path) -> None:
    (tmp_path / "drives.csv").write_text("lat,lon\n48100000,11500000\n")
    with pytest.raises(InputError, match=r"latitudes are outside -90\.\.90"):
        read_fleet(tmp_path / "drives.csv")


def test_a_box_in_degrees_holds_for_integers_too(tmp_path: Path) -> None:
    table = pd.DataFrame({"latitudeE7": [481000000, 481000000, 489000000], "longitudeE7": [115000000] * 3})
    table.to_parquet(tmp_path / "drives.parquet", row_group_size=1)
    fleet = read_fleet(tmp_path / "drives.parquet", bbox=(11.0, 48.0, 12.0, 48.5))
    assert len(fleet.traces) == 2
