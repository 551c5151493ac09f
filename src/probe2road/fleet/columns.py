"""The columns of fleet data: their names, their types, and values that are none.

A column is converted as a whole, and what is wrong with it is added to the checks of its table. Nothing is raised
here, so that all faults of a file are told at once.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.fleet.faults import TableChecks, few, may_leave_out

__all__ = [
    "MISSING_WORDS",
    "POINT_COLUMNS",
    "POINT_KINDS",
    "POINT_OPTIONAL_COLUMNS",
    "TIME_DTYPE",
    "TRACE_COLUMNS",
    "TRACE_OPTIONAL_COLUMNS",
    "coordinates",
    "identifiers",
    "measured",
    "point_kinds",
    "timestamps",
    "unknown_times",
]

logger = logging.getLogger(__name__)

POINT_KINDS = ("lane_marking", "road_boundary")
TRACE_COLUMNS = ("trace_id", "t", "x", "y", "z")
TRACE_OPTIONAL_COLUMNS = ("vehicle_id", "heading", "speed", "accuracy")
POINT_COLUMNS = ("trace_id", "t", "x", "y", "z", "kind")
POINT_OPTIONAL_COLUMNS = ("accuracy",)
TIME_DTYPE = "datetime64[ns, UTC]"

# What databases and spreadsheets write where there is nothing, in lower case.
MISSING_WORDS = ("", "nan", "null", "none", "na", "n/a", "nat", "<na>", "\\n", "-", "--", "?")

_MOST_SECONDS = 9.2e9  # since 1970; a time in nanoseconds holds no more
_FIRST_TIME, _LAST_TIME = (limit.tz_localize("UTC") for limit in (pd.Timestamp(1678, 1, 1), pd.Timestamp(2262, 1, 1)))


def identifiers(ids: pd.Series, checks: TableChecks) -> Any:
    """Check trace ids for missing values, and convert mixed types and bytes to text, so that they can be sorted.

    Examples
    --------
    >>> from probe2road.fleet.faults import TableOrigin
    >>> list(identifiers(pd.Series([b"AB", 7]), TableChecks(TableOrigin(), [])))
    ['4142', '7']
    """
    name = checks.name("trace_id")
    empty = ids.isna().to_numpy()
    if pd.api.types.is_string_dtype(ids.dtype) and not pd.api.types.is_object_dtype(ids.dtype):
        empty = empty | (ids == "").to_numpy(bool, na_value=False)
    if empty.any():
        checks.row_fault(f"{name} is empty in {int(empty.sum())} of {len(ids)} rows", empty)
    if isinstance(ids.dtype, pd.CategoricalDtype) and not empty.any():
        ids = ids.astype(ids.cat.categories.dtype)
    if not pd.api.types.is_object_dtype(ids.dtype):
        return ids.array
    try:
        codes, found = pd.factorize(ids)
    except TypeError:  # lists and the like
        checks.fault(f"{name} holds neither text nor numbers")
        return ids.array
    words = [value.hex() if isinstance(value, bytes) else str(value) for value in found]
    return pd.array([*words, None], dtype="str").take(codes)


def coordinates(values: pd.Series, checks: TableChecks) -> NDArray[np.float64]:
    """Convert a column of coordinates to float64; rows without one are bad.

    Examples
    --------
    >>> from probe2road.fleet.faults import TableOrigin
    >>> checks = TableChecks(TableOrigin(), [])
    >>> coordinates(pd.Series(["7.5", "9,5"], name="x"), checks).tolist()
    [7.5, nan]
    >>> checks.rows[0][0]
    "traces: column 'x' is not a number in 1 of 2 rows (row 1: 9,5); decimal commas are not read, use points"
    """
    name = checks.name(str(values.name))
    if not _may_hold_numbers(values):
        checks.fault(f"{name} holds {values.dtype}, not numbers")
        return np.full(len(values), np.nan)
    numbers, words, unreadable = _numbers(values)
    if unreadable.any():
        comma = words[unreadable].str.fullmatch(r"[+-]?\d+,\d+").all()
        hint = "; decimal commas are not read, use points" if comma else ""
        checks.row_fault(f"{name} is not a number in {checks.origin.rows(unreadable, words)}{hint}", unreadable)
    missing = ~np.isfinite(numbers) & ~unreadable
    if missing.any():
        checks.row_fault(f"{name} is empty or not finite in {checks.origin.rows(missing, numbers)}", missing)
    return numbers


def measured(values: pd.Series, checks: TableChecks, invalid: str | None) -> NDArray[np.float64] | None:
    """Convert a column that may be absent to float64; unreadable cells are unknown, None if it is to be left out.

    Examples
    --------
    >>> from probe2road.fleet.faults import TableOrigin
    >>> checks = TableChecks(TableOrigin(), [])
    >>> measured(pd.Series(["7.5", "n/a"], name="speed"), checks, "refuse").tolist()
    [7.5, nan]
    """
    ours = str(values.name)
    name, by_name = checks.name(ours), ours in checks.origin.by_name
    remedy = f'leave the column out with {"point_" * (checks.origin.name == "points")}columns={{"{ours}": ""}}'
    if not _may_hold_numbers(values):
        fault = f"{name} holds {values.dtype}, not numbers"
    else:
        numbers, words, unreadable = _numbers(values)
        if not unreadable.any():
            return numbers
        fault = f"{name} is not a number in {checks.origin.rows(unreadable, words)}"
        if may_leave_out(int(unreadable.sum()), len(values), invalid):
            logger.warning("%s: taken as unknown", fault)
            return numbers
    if by_name:
        logger.warning("%s: the column is left out", fault)
    else:
        checks.fault(f"{fault}; {remedy}")
    return None


def timestamps(values: pd.Series, checks: TableChecks) -> pd.Series:
    """Convert a column to UTC timestamps: numbers are seconds since 1970, text is ISO 8601, naive is UTC.

    Examples
    --------
    >>> from probe2road.fleet.faults import TableOrigin
    >>> timestamps(pd.Series(["1970-01-01T01:00+01:00", "-"]), TableChecks(TableOrigin(), [])).tolist()
    [Timestamp('1970-01-01 00:00:00+0000', tz='UTC'), NaT]
    """
    name = checks.name("t")
    if values.dtype.kind in "bm":
        checks.fault(f"{name} holds {values.dtype}, not times")
        return unknown_times(len(values))
    if _is_plain_numeric(values):
        return _times_of_seconds(values, checks)
    is_time = pd.api.types.is_datetime64_any_dtype(values.dtype)
    if not is_time and not isinstance(values.dtype, pd.CategoricalDtype):
        missing = values.isin([*MISSING_WORDS, "NULL", "\\N", "NaN", "None", "NA", "N/A"]).to_numpy(bool)
        values = values.mask(missing) if missing.any() else values
    times = pd.to_datetime(values, utc=True, errors="coerce", format=None if is_time else "ISO8601")
    unreadable = (times.isna() & values.notna()).to_numpy()
    if unreadable.any():
        rows = checks.origin.rows(unreadable, values)
        checks.row_fault(f"{name} is not a time in {rows}; use ISO 8601 or seconds since 1970", unreadable)
    times = times.reset_index(drop=True)
    beyond = ((times < _FIRST_TIME) | (times > _LAST_TIME)).to_numpy(bool)
    if beyond.any():
        rows = checks.origin.rows(beyond, values)
        checks.row_fault(f"{name} is outside the years {_FIRST_TIME.year}..{_LAST_TIME.year} in {rows}", beyond)
        times = times.mask(beyond)
    return times.astype(TIME_DTYPE)


def unknown_times(n: int) -> pd.Series:
    """Return an array of n missing times."""
    return pd.Series(np.full(n, np.datetime64("NaT", "ns"))).dt.tz_localize("UTC")


def point_kinds(values: pd.Series, checks: TableChecks) -> pd.Categorical:
    """Convert a column to the categories of semantic points, or report the values that are no category.

    Examples
    --------
    >>> from probe2road.fleet.faults import TableOrigin
    >>> checks = TableChecks(TableOrigin("points"), [])
    >>> point_kinds(pd.Series(["road_boundary", "kerb"]), checks).codes.tolist(), checks.faults
    ([1, -1], ["points: column 'kind' is one of lane_marking, road_boundary, not kerb"])
    """
    codes, found = pd.factorize(values, use_na_sentinel=False)
    unknown = [str(kind) for kind in found if kind not in POINT_KINDS]
    if unknown:
        checks.fault(f"{checks.name('kind')} is one of {', '.join(POINT_KINDS)}, not {few(unknown)}")
    position = np.array([POINT_KINDS.index(kind) if kind in POINT_KINDS else -1 for kind in found], np.int8)
    return pd.Categorical.from_codes(position[codes], categories=POINT_KINDS)


def _times_of_seconds(values: pd.Series, checks: TableChecks) -> pd.Series:
    """Convert seconds since 1970 to UTC timestamps; numbers too large for one are bad."""
    seconds = values.to_numpy(dtype=np.float64, na_value=np.nan)
    beyond = np.abs(seconds) >= _MOST_SECONDS
    if beyond.any():
        largest = float(np.nanmax(np.abs(seconds)))
        name = f"{checks.name('t')} is not in seconds since 1970 (largest value {largest:.6g})"
        checks.row_fault(f"{name} in {checks.origin.rows(beyond, seconds)}", beyond)
        seconds = np.where(beyond, np.nan, seconds)
    # A float64 holds the seconds of this century to a microsecond at best: do not invent nanoseconds.
    microseconds = np.round(np.nan_to_num(seconds) * 1e6).astype(np.int64)
    nanoseconds = np.where(np.isnan(seconds), np.iinfo(np.int64).min, microseconds * 1000)
    return pd.Series(nanoseconds.view("datetime64[ns]")).dt.tz_localize("UTC")


def _may_hold_numbers(values: pd.Series) -> bool:
    """Tell whether a column has a type in which numbers can be written."""
    return _is_plain_numeric(values) or values.dtype.kind not in "bmM"


def _numbers(values: pd.Series) -> tuple[NDArray[np.float64], pd.Series, NDArray[np.bool_]]:
    """Convert a column to float64: the numbers, the column as text, and where that is neither empty nor a number."""
    if _is_plain_numeric(values):
        return values.to_numpy(dtype=np.float64, na_value=np.nan), values, np.zeros(len(values), bool)
    words = values.astype(object).map(str, na_action="ignore").str.strip()
    numbers = pd.to_numeric(words, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    missing = (words.isna() | words.str.lower().isin(MISSING_WORDS)).to_numpy(bool)
    return numbers, words, np.isnan(numbers) & ~missing


def _is_plain_numeric(values: pd.Series) -> bool:
    return bool(pd.api.types.is_numeric_dtype(values.dtype) and values.dtype.kind != "b")
