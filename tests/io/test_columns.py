from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from pyproj import CRS

from probe2road.errors import InputError, OptionError
from probe2road.io.clocks import times_from_numbers
from probe2road.io.columns import KIND_SYNONYMS, USUAL_NAMES, choose_columns, standard_kinds


@pytest.mark.parametrize(
    ("there", "chosen"),
    [
        (["trip", "t", "x", "y"], {"trace_id": "trip", "t": "t", "x": "x", "y": "y"}),
        (
            ["ID", "GPS_Time", "Longitude", "Latitude", "Altitude", "Bearing"],
            {
                "trace_id": "ID",
                "t": "GPS_Time",
                "x": "Longitude",
                "y": "Latitude",
                "z": "Altitude",
                "heading": "Bearing",
            },
        ),
        (["id", "journey-id", "lng", "lat"], {"trace_id": "journey-id", "x": "lng", "y": "lat"}),
        (["trace_id", "trip", "x", "y"], {"trace_id": "trace_id", "x": "x", "y": "y"}),  # our own name wins
        (["easting", "northing", "height"], {"x": "easting", "y": "northing", "z": "height"}),
        (["trip", "lon", "lat", "geom"], {"trace_id": "trip", "x": "lon", "y": "lat"}),
        (["trip", "geom"], {"trace_id": "trip", "geometry": "geom"}),
    ],
)
def test_usual_names_are_found(there: list[str], chosen: dict[str, str]) -> None:
    assert choose_columns(there).columns == chosen


def test_degrees_or_metres_follow_the_crs() -> None:
    there = ["trip", "lon", "lat", "x", "y"]
    assert choose_columns(there).columns["x"] == "lon"
    assert choose_columns(there).degrees
    metres = choose_columns(there, crs=CRS.from_epsg(32616))
    assert metres.columns["x"] == "x"
    assert not metres.degrees


def test_a_geometry_is_preferred_to_guesses_but_not_to_the_user() -> None:
    there = ["trip", "lon", "lat", "z", "geometry"]
    assert choose_columns(there, geometry="geometry").columns == {"trace_id": "trip", "geometry": "geometry"}
    named = choose_columns(there, {"x": "lon", "y": "lat"}, geometry="geometry")
    assert named.columns == {"trace_id": "trip", "x": "lon", "y": "lat", "z": "z"}
    assert named.degrees


def test_given_names_are_taken_and_empty_ones_leave_out() -> None:
    choice = choose_columns(["a", "b", "c", "time", "speed"], {"trace_id": "a", "x": "b", "y": "c", "speed": ""})
    assert choice.columns == {"trace_id": "a", "t": "time", "x": "b", "y": "c"}
    assert choice.guessed == ("t",)


@pytest.mark.parametrize(
    ("there", "given", "error", "message"),
    [
        (["trip", "trip_id", "x", "y"], {}, InputError, "column 'trace_id' could be trip, trip_id; say which"),
        (["lon", "longitude", "lat"], {}, InputError, "column 'x' could be lon, longitude"),
        (["a", "b"], {}, InputError, "no column for x, y (the columns are a, b); say which"),
        (["x", "y"], {"x": "east"}, InputError, "there is no column 'east' (x); the columns are x, y"),
        (["x", "y"], {"colour": "x"}, OptionError, "columns names colour; the names are trace_id, t, x"),
        (["trip", "ts", "time", "a"], {}, InputError, "2 faults"),
    ],
)
def test_what_cannot_be_told_is_asked(
    there: list[str], given: dict[str, str], error: type[Exception], message: str
) -> None:
    with pytest.raises(error) as caught:
        choose_columns(there, given, where="drives.csv")
    assert message in str(caught.value)


def test_points_need_ids_and_kinds() -> None:
    with pytest.raises(
        InputError, match=r'no column for trace_id, kind .* point_columns={"trace_id": "NAME", "kind": "NAME"}'
    ):
        choose_columns(["x", "y"], points=True)
    assert choose_columns(["trip", "x", "y", "class", "type"], points=True).columns["kind"] == "class"


def test_names_are_unambiguous_in_the_tables() -> None:
    for table in (USUAL_NAMES, KIND_SYNONYMS):
        names = [name for names in table.values() for name in names if name is not None]
        assert len(names) == len(set(names))
        assert all(name == name.lower() and name.isalnum() for name in names)


def test_kinds_have_synonyms() -> None:
    kinds = standard_kinds(pd.Series([1, 2, "CURB", "lane-line", "road_boundary", "tree", None]))
    assert kinds.tolist()[:6] == [
        "lane_marking",
        "road_boundary",
        "road_boundary",
        "lane_marking",
        "road_boundary",
        "tree",
    ]
    assert pd.isna(kinds.iloc[6])
    assert standard_kinds(pd.Series([1, 2])).tolist() == ["lane_marking", "road_boundary"]


@pytest.mark.parametrize(("unit", "per_second"), [("s", 1), ("ms", 10**3), ("us", 10**6), ("ns", 10**9)])
@pytest.mark.parametrize("dtype", ["int64", "float64"])
def test_units_of_time_are_told_by_size(unit: str, per_second: int, dtype: str) -> None:
    times, found = times_from_numbers(pd.Series([1_600_000_000, 1_700_000_001]).mul(per_second).astype(dtype))
    assert found == unit
    assert times.tolist() == pd.to_datetime([1_600_000_000, 1_700_000_001], unit="s", utc=True).tolist()


def test_fractions_of_seconds_and_missing_times() -> None:
    times, _ = times_from_numbers(pd.Series([1301806255.123, np.nan]))
    assert str(times[0]) == "2011-04-03 04:50:55.123000+00:00"
    assert pd.isna(times[1])
    assert times_from_numbers(pd.Series([49039, 49069]))[0].dt.hour.tolist() == [13, 13]  # since midnight
    refused, _ = times_from_numbers(pd.Series([1.0, 2.0, 1e300]))
    assert refused.dtype == np.float64
