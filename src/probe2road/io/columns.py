"""Which column of a file is which: the user's map, the usual names, the units of time, the kinds of points.

Nothing here guesses silently. What is taken from a usual name is returned with the rest and logged by the
reader; where two columns would do, the reader asks.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from pyproj import CRS

from probe2road.errors import InputError, OptionError
from probe2road.fleet.tables import (
    POINT_COLUMNS,
    POINT_KINDS,
    POINT_OPTIONAL_COLUMNS,
    TRACE_COLUMNS,
    TRACE_OPTIONAL_COLUMNS,
)
from probe2road.io.formats import ColumnMap

__all__ = [
    "KIND_SYNONYMS",
    "USUAL_NAMES",
    "ColumnChoice",
    "choose_columns",
    "day_numbers",
    "standard_kinds",
    "times_from_numbers",
    "times_of_column",
]

# Usual names per column of ours, in lower case with separators removed. Names before None are specific; those
# behind it are so common for other things that they count only where no specific name is there.
USUAL_NAMES: dict[str, tuple[str | None, ...]] = {
    "trace_id": (
        *("traceid", "trip", "tripid", "drive", "driveid", "track", "trackid", "journey", "journeyid", "trace"),
        *("traj", "trajid", "trajectory", "trajectoryid", "rideid", "sessionid", "routeid", None, "id"),
    ),
    "t": (
        *("t", "timestamp", "time", "ts", "datetime", "gpstime", "gpstimestamp", "timestamputc", "timeutc", "utc"),
        *("epoch", "unixtime", "eventtime", "timems", "timestampms", "timestampns", "tstamp", "datetimeutc"),
        *("utctime", "utcdatetime", "gpsdatetime", "trackedat", "recordedat", "measuredat", "observedat", "sampledat"),
        *("capturedat", "reportedat", "loggedat", "fixtime", "loctime", "locationtime", "positiontime", "recordtime"),
        *("recordedtime", None, "devicetime", "createdat", "servertime", "receivedat", "localtime", "date"),
    ),
    "z": ("z", "alt", "altitude", "ele", "elevation", None, "height"),
    "vehicle_id": (
        *("vehicleid", "vehicle", "vehid", "vin", "deviceid", "taxiid", "taxi", "busid", "bus", "cabid", "truckid"),
        *("userid", "user", "driverid", "imei", "unitid", "agentid", None, "device", "uid"),
    ),
    "heading": ("heading", "bearing", "course", "azimuth", "headingdeg"),
    "speed": ("speed", "velocity", "speedms", "speedmps"),
    "accuracy": ("accuracy", "horizontalaccuracy", "haccuracy", "hacc", "gpsaccuracy", "positionaccuracy"),
    "kind": ("kind", "class", "classname", "featuretype", "objecttype", None, "label", "type", "category"),
}
_NOT_ASKED = ("vehicle_id", "heading", "speed", "accuracy")
_DAY_STEP = 0.01  # days between fixes, at most; also seconds, which no receiver beats
_LON_LAT = (("lon", "lng", "long", "longitude", "gpslon", "gpslongitude"), ("lat", "latitude", "gpslat", "gpslatitude"))
_PROJECTED = (("x", "easting", "east", "utmx", "utmeasting"), ("y", "northing", "north", "utmy", "utmnorthing"))
_GEOMETRY = ("geometry", "geom", "wkbgeometry", "position")

# What else the two kinds of semantic points are called, in lower case with separators removed.
KIND_SYNONYMS: dict[str, tuple[str, ...]] = {
    "lane_marking": (
        *("lanemarking", "lanemarkings", "lanemarker", "lanemark", "marking", "markings", "laneline", "lane"),
        *("roadmarking", "lanedivider", "divider", "1"),
    ),
    "road_boundary": (
        *("roadboundary", "roadboundaries", "boundary", "boundaries", "roadedge", "edge", "kerb", "curb"),
        *("roadborder", "border", "guardrail", "barrier", "2"),
    ),
}


@dataclass(frozen=True)
class ColumnChoice:
    """The columns to read from one file."""

    columns: dict[str, str]  # our name -> the file's; "geometry" stands for x, y and z in one column
    guessed: tuple[str, ...]  # our names that were found under another, usual name
    degrees: bool  # the coordinates are longitude and latitude by name
    by_name: tuple[str, ...] = ()  # our names that the user did not give, whatever they are called in the file


def choose_columns(
    there: Sequence[str],
    given: ColumnMap | None = None,
    *,
    points: bool = False,
    geometry: str | None = None,
    crs: CRS | None = None,
    where: object = None,
) -> ColumnChoice:
    """Decide which columns of a file to read as ours.

    Parameters
    ----------
    there
        Column names of the file.
    given
        Our name to the file's, as the user said; an empty name means that the file has no such column.
    points
        Whether the file holds semantic points rather than traces.
    geometry
        Name of the file's point geometry column, which is preferred to guessed coordinates.
    crs
        CRS the user gave: where a file has both degrees and metres, it says which are meant.
    where
        The file, for messages.

    Returns
    -------
    ColumnChoice
        Columns that were neither given nor found are absent: traces may lack all but the position.

    Raises
    ------
    InputError
        If a given column is not there, if several columns have a usual name of the same one of ours, or if
        none has one that is needed.
    OptionError
        If a given name is none of ours.

    Examples
    --------
    >>> choose_columns(["Trip_ID", "time", "lat", "lon", "temperature"]).columns
    {'trace_id': 'Trip_ID', 't': 'time', 'x': 'lon', 'y': 'lat'}
    >>> choose_columns(["a", "b", "c"], {"trace_id": "a", "x": "b", "y": "c"}).guessed
    ()
    >>> choose_columns(["trip", "ts", "time", "x", "y"], where="drives.csv")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: drives.csv: column 't' could be ts, time; say which, for example columns={"t": "ts"}
    """
    ours = (*POINT_COLUMNS, *POINT_OPTIONAL_COLUMNS) if points else (*TRACE_COLUMNS, *TRACE_OPTIONAL_COLUMNS)
    there = list(dict.fromkeys(there))
    named = _given_columns(there, given or {}, (*ours, "geometry"), where)
    left_out = {name for name, theirs in named.items() if not theirs}
    chosen = {name: theirs for name, theirs in named.items() if theirs}
    argument = "point_columns" if points else "columns"
    faults: list[str] = []
    position, degrees = _position_columns(there, chosen, geometry, crs, argument, faults)
    chosen |= position
    in_geometry = {"x", "y", "z"} if "geometry" in position else set()
    wanted = [name for name in ours if name not in left_out | in_geometry]
    chosen |= _usual_columns(wanted, there, chosen, argument, faults)
    needed = {"x", "y", "trace_id", "kind"} if points else {"x", "y"}
    faults += _missing_faults([name for name in ours if name in needed - in_geometry - set(chosen)], there, argument)
    if faults:
        raise InputError.from_faults(faults, where=where)
    ordered = {name: chosen[name] for name in (*ours, "geometry") if name in chosen}
    guessed = tuple(name for name, theirs in ordered.items() if name not in named and name != theirs)
    return ColumnChoice(ordered, guessed, degrees, tuple(name for name in ordered if name not in named))


def standard_kinds(values: pd.Series) -> pd.Series:
    """Replace what else the kinds of semantic points are called; other values stay as they are.

    Examples
    --------
    >>> standard_kinds(pd.Series(["Lane Line", "kerb", "tree"])).tolist()
    ['lane_marking', 'road_boundary', 'tree']
    """
    known = {synonym: kind for kind, synonyms in KIND_SYNONYMS.items() for synonym in synonyms}
    codes, found = pd.factorize(values, use_na_sentinel=False)
    standard = [kind if kind in POINT_KINDS else known.get(_plain(str(kind)), kind) for kind in found]
    return pd.Series(np.array(standard, object)[codes], name=values.name)


def times_from_numbers(values: pd.Series) -> tuple[pd.Series, str]:
    """Convert times in seconds, milliseconds, microseconds or nanoseconds since 1970, by their magnitude.

    Times before the year 5138 in one unit are smaller than those after 1973 in the next, so that the median
    decides; smaller numbers, such as seconds since midnight, count as seconds.

    Returns
    -------
    (Series, str)
        UTC times (NaT where the number is missing) and the unit found. A column of anything but numbers comes
        back as it is, without unit; numbers too large for a time come back in seconds, to be refused later.

    Examples
    --------
    >>> times, unit = times_from_numbers(pd.Series([1577836800000, 1577836800200]))
    >>> unit, str(times[1])
    ('ms', '2020-01-01 00:00:00.200000+00:00')
    """
    if (dates := _written_dates(values)) is not None:
        return dates
    if pd.api.types.is_bool_dtype(values.dtype) or not pd.api.types.is_numeric_dtype(values.dtype):
        return values, ""
    numbers = values.to_numpy(dtype=np.float64, na_value=np.nan)
    middle = float(np.nanmedian(np.abs(numbers))) if np.isfinite(numbers).any() else 0.0
    unit = "s" if middle < 1e11 else "ms" if middle < 1e14 else "us" if middle < 1e17 else "ns"
    per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    missing = np.isnan(numbers)
    if np.nanmax(np.abs(numbers), initial=0.0) >= 9.2e9 * per_second:
        return pd.Series(numbers / per_second), unit
    if pd.api.types.is_integer_dtype(values.dtype) and not missing.any():
        nanoseconds = values.to_numpy(np.int64) * (10**9 // per_second)
    else:
        # A float64 holds the seconds of this century to a microsecond at best: do not invent nanoseconds.
        nanoseconds = np.round(np.where(missing, 0.0, numbers) * (1e6 / per_second)).astype(np.int64) * 1000
        nanoseconds[missing] = np.iinfo(np.int64).min
    return pd.Series(nanoseconds.view("datetime64[ns]")).dt.tz_localize("UTC"), unit


def times_of_column(values: pd.Series, name: str, *, where: object = None) -> tuple[pd.Series, str]:
    """Return what `times_from_numbers` does for a column of a file.

    Raises
    ------
    InputError
        If the numbers look like days, not seconds.
    """
    if day_numbers(values):
        first = values.dropna().iloc[0]
        fault = (
            f"column {name!r} (t) holds no seconds since 1970: {first:.12g} looks like a day number of a spreadsheet"
        )
        raise InputError(fault, where=where, fix="write times as ISO 8601, such as 2024-05-01T08:00:00Z")
    return times_from_numbers(values)


def _written_dates(values: pd.Series) -> tuple[pd.Series, str] | None:
    """Read numbers such as 20240501080000: dates written without separators. None where any is no such date."""
    if not pd.api.types.is_integer_dtype(values.dtype) or values.dropna().empty:
        return None
    format = {12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}.get(len(str(values.dropna().iloc[0])))
    if format is None:
        return None
    times = pd.to_datetime(values.astype("str"), format=format, errors="coerce", utc=True)
    read = times.notna()
    if not (read | values.isna()).all() or not times[read].dt.year.between(1980, 2099).all():
        return None
    return times, "yyyymmddHHMMSS"[: 12 if len(format) == 10 else 14]


def day_numbers(values: pd.Series) -> bool:
    """Say whether numbers look like days since 1899-12-30 with the time as fraction, as spreadsheets store times.

    Seconds of a day are of the same size, but lie further apart.

    Examples
    --------
    >>> day_numbers(pd.Series([45413.3333333, 45413.3334491])), day_numbers(pd.Series([45413.0, 45423.0]))
    (True, False)
    """
    if not pd.api.types.is_float_dtype(values.dtype):
        return False
    steps = values.diff().abs()
    steps = steps[steps > 0]
    return bool(20_000 < values.median() < 80_000 and len(steps) and steps.median() < _DAY_STEP)


def _given_columns(there: Sequence[str], given: ColumnMap, ours: Sequence[str], where: object) -> dict[str, str]:
    """Check the user's column map against our names and the file's."""
    unknown = [name for name in given if name not in ours]
    if unknown:
        raise OptionError(f"columns names {', '.join(unknown)}", fix=f"the names are {', '.join(ours)}")
    named = {name: "" if theirs is None else str(theirs) for name, theirs in given.items()}
    missing = [f"{theirs!r} ({name})" for name, theirs in named.items() if theirs and theirs not in there]
    if missing:
        raise InputError(
            f"there is no column {', '.join(missing)}", where=where, fix=f"the columns are {', '.join(there)}"
        )
    return named


def _position_columns(
    there: Sequence[str],
    chosen: Mapping[str, str],
    geometry: str | None,
    crs: CRS | None,
    argument: str,
    faults: list[str],
) -> tuple[dict[str, str], bool]:
    """Find the coordinates: given ones, then the geometry column, then lon and lat, then x and y."""
    if "geometry" in chosen:
        return {"geometry": chosen["geometry"]}, False
    if "x" in chosen and "y" in chosen:
        by_name = _plain(chosen["x"]) in _LON_LAT[0] and _plain(chosen["y"]) in _LON_LAT[1]
        return {"x": chosen["x"], "y": chosen["y"]}, by_name
    if geometry is not None and "x" not in chosen and "y" not in chosen:
        return {"geometry": geometry}, False
    degrees_first = crs is None or crs.is_geographic
    partial: dict[str, str] = {}
    for names in (_LON_LAT, _PROJECTED) if degrees_first else (_PROJECTED, _LON_LAT):
        found = {
            axis: [chosen[axis]] if axis in chosen else _best([usual], there)
            for axis, usual in zip("xy", names, strict=True)
        }
        pair = {axis: columns[0] for axis, columns in found.items() if columns}
        if len(pair) == 2:
            faults += [_ambiguous(axis, columns, argument) for axis, columns in found.items() if len(columns) > 1]
            return pair, names is _LON_LAT
        partial = partial or pair
    geometries = _best([_GEOMETRY], there)
    return ({"geometry": geometries[0]} if len(geometries) == 1 else partial), False


def _usual_columns(
    wanted: Sequence[str], there: Sequence[str], taken: Mapping[str, str], argument: str, faults: list[str]
) -> dict[str, str]:
    """Find those of our columns that are not taken by their usual names; a column of the file serves once."""
    found: dict[str, str] = {}
    for name in wanted:
        if name in USUAL_NAMES and name not in taken:
            theirs = _usual(name, there, argument, faults)
            if theirs is not None and theirs not in {*taken.values(), *found.values()}:
                found[name] = theirs
    return found


def _usual(name: str, there: Sequence[str], argument: str, faults: list[str]) -> str | None:
    """Find the one column with a usual name of ours, or say that there are several."""
    if name in there:
        return name
    names = USUAL_NAMES[name]
    split = names.index(None) if None in names else len(names)
    found = _best([names[:split], names[split + 1 :]], there)
    if len(found) > 1 and name in _NOT_ASKED:  # nobody is asked for what may be absent: the likelier name is taken
        return min(found, key=lambda column: names.index(_plain(column)))
    if len(found) > 1:
        faults.append(_ambiguous(name, found, argument))
    return found[0] if found else None


def _missing_faults(missing: Collection[str], there: Sequence[str], argument: str) -> list[str]:
    """Name the columns that are needed and were neither given nor found; no fault where none is missing."""
    if not missing:
        return []
    example = f"{argument}={json.dumps(dict.fromkeys(missing, 'NAME'))}"
    names = f"no column for {', '.join(missing)} (the columns are {', '.join(there)})"
    return [f"{names}; say which, for example {example}"]


def _best(tiers: Sequence[Sequence[str | None]], there: Sequence[str]) -> list[str]:
    """Return the columns whose names are in the first tier that has any."""
    for tier in tiers:
        found = [column for column in there if _plain(column) in tier]
        if found:
            return found
    return []


def _ambiguous(name: str, found: Sequence[str], argument: str) -> str:
    example = f"{argument}={json.dumps({name: found[0]}, ensure_ascii=False)}"
    return f"column {name!r} could be {', '.join(found)}; say which, for example {example}"


def _plain(name: str) -> str:
    """Bring a name to lower case without separators, a namespace prefix, and a unit in brackets."""
    without_unit = re.sub(r"[\[(][^\])]*[\])]\s*$", "", name) or name
    return "".join(letter for letter in without_unit.lower().strip() if letter.isalnum())
