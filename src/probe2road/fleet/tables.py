"""One table of fleet data: its columns, their types, and everything that can be wrong with them.

The checks look at the whole table before they speak, so that a user fixes a bad file once, not fault by
fault. What can be repaired without losing information (row order, exact duplicates) is repaired and logged.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import WGS84, transform

__all__ = [
    "POINT_COLUMNS",
    "POINT_KINDS",
    "POINT_OPTIONAL_COLUMNS",
    "TIME_DTYPE",
    "TRACE_COLUMNS",
    "TRACE_OPTIONAL_COLUMNS",
    "TableOrigin",
    "check_points",
    "check_traces",
    "clock_faults",
    "empty_points",
    "run_starts",
    "sort_fixes",
]

logger = logging.getLogger(__name__)

POINT_KINDS = ("lane_marking", "road_boundary")
TRACE_COLUMNS = ("trace_id", "t", "x", "y", "z")
TRACE_OPTIONAL_COLUMNS = ("vehicle_id", "heading", "speed", "accuracy")
POINT_COLUMNS = ("trace_id", "t", "x", "y", "z", "kind")
POINT_OPTIONAL_COLUMNS = ("accuracy",)
TIME_DTYPE = "datetime64[ns, UTC]"

_MAY_BE_ABSENT = ("t", "z")  # data without clock, 2-D data
_EXAMPLES_SHOWN = 3  # offending rows named in a fault
_SAME_PLACE = 0.01  # m; repeated fixes at one instant nearer than this are one fix
_DEGREES_PER_METRE = 1e-5  # of latitude, rounded up
_POLAR = 80.0  # degrees of latitude beyond which swapped columns are likelier than roads
_SPREAD_OF_DEGREES = 5.0  # a projected data set that spans less than this near the origin is in degrees
_FAR_FROM_CRS = 20.0  # degrees outside the area of use of a CRS, beyond which the CRS is wrong


@dataclass(frozen=True)
class TableOrigin:
    """Where a table came from, in the words its author knows, for messages."""

    name: str = "traces"  # what is in the table
    row_word: str = "row"  # "line" for text files
    first_row: int = 0  # number of the table's first row in those words
    columns: Mapping[str, str] = field(default_factory=dict)  # our column name -> the author's

    def column(self, ours: str) -> str:
        """Return how to call one of our columns in a message."""
        theirs = self.columns.get(ours, ours)
        return repr(ours) if theirs == ours else f"{theirs!r} ({ours})"

    def rows(self, mask: NDArray[np.bool_], values: Any) -> str:
        """Say how many rows the mask means, and show the first few."""
        rows = np.flatnonzero(mask)
        values = np.asarray(pd.Series(values).iloc[rows[:_EXAMPLES_SHOWN]])
        shown = ", ".join(
            f"{self.row_word} {row + self.first_row}: {value}" for row, value in zip(rows, values, strict=False)
        )
        return f"{len(rows)} of {len(mask)} rows ({shown}{', ...' if len(rows) > _EXAMPLES_SHOWN else ''})"


def check_traces(
    table: pd.DataFrame, crs: CRS, faults: list[str], *, origin: TableOrigin | None = None
) -> pd.DataFrame:
    """Return the traces' known columns in canonical types, adding what is wrong with them to the faults.

    Parameters
    ----------
    table
        At least ``trace_id``, ``x``, ``y``; further columns are ignored. Not changed.
    crs
        CRS of ``x`` and ``y``.
    faults
        List that the faults are appended to; if any are, the table returned is not to be used.
    origin
        Names for the messages.

    Returns
    -------
    DataFrame
        `TRACE_COLUMNS`, then those of `TRACE_OPTIONAL_COLUMNS` that the table has, in the same row order.

    Examples
    --------
    >>> faults = []
    >>> _ = check_traces(pd.DataFrame({"x": ["a"], "y": [95.0]}), WGS84, faults)
    >>> faults
    ["traces: column 'trace_id' is missing (there are: x, y)"]
    """
    origin = origin or TableOrigin("traces")
    return _checked(table, origin, (TRACE_COLUMNS, TRACE_OPTIONAL_COLUMNS), crs, faults)


def check_points(
    table: pd.DataFrame, crs: CRS, faults: list[str], *, origin: TableOrigin | None = None
) -> pd.DataFrame:
    """Return the semantic points' known columns in canonical types; see `check_traces`."""
    origin = origin or TableOrigin("points")
    return _checked(table, origin, (POINT_COLUMNS, POINT_OPTIONAL_COLUMNS), crs, faults)


def empty_points(trace_ids: pd.Series) -> pd.DataFrame:
    """Return the table of semantic points of a fleet without camera, its ids of the type of the given ones."""
    columns = {column: pd.Series(dtype="float64") for column in ("x", "y", "z")}
    kind = pd.Categorical([], categories=POINT_KINDS)
    return pd.DataFrame({"trace_id": trace_ids.iloc[:0], "t": pd.Series(dtype=TIME_DTYPE), **columns, "kind": kind})


def clock_faults(traces: pd.DataFrame) -> list[str]:
    """Name traces in which some fixes have a time and others have none."""
    untimed = traces["t"].isna()
    if not untimed.any() or untimed.all():
        return []
    partly = untimed.groupby(traces["trace_id"], sort=False).mean()
    partly = partly[(partly > 0) & (partly < 1)]
    if partly.empty:
        return []
    return [f"traces: some fixes of {len(partly)} traces have no time ({_few(partly.index)}); drop those fixes"]


def sort_fixes(traces: pd.DataFrame, crs: CRS, faults: list[str]) -> pd.DataFrame:
    """Sort by trace and time and drop repeated fixes; repeated fixes that disagree are a fault.

    Rows without time keep their order. A table that is in order already is returned as it is.

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": [1, 1], "t": pd.to_datetime([2, 1], unit="s", utc=True), "x": 0.0, "y": 0.0})
    >>> sort_fixes(table, CRS.from_epsg(32616), [])["t"].dt.second.tolist()
    [1, 2]
    """
    codes = _codes(traces["trace_id"])
    time = traces["t"].to_numpy(dtype="datetime64[ns]").view(np.int64)  # NaT is the smallest integer: all alike
    same_trace, later = np.diff(codes) == 0, np.diff(time) >= 0
    backwards = same_trace & ~later
    if backwards.any() or (np.diff(codes) < 0).any():
        if backwards.any():
            logger.warning("times go backwards within %d traces: sorted", np.unique(codes[1:][backwards]).size)
        order = np.lexsort((time, codes))
        traces, codes, time = traces.take(order).reset_index(drop=True), codes[order], time[order]
    repeated = np.zeros(len(traces), bool)
    repeated[1:] = (np.diff(codes) == 0) & (np.diff(time) == 0) & (time[1:] != np.iinfo(np.int64).min)
    if not repeated.any():
        return traces
    apart = np.hypot(*(np.diff(traces[axis].to_numpy(), prepend=np.nan) for axis in "xy"))
    disagree = repeated & (apart > _SAME_PLACE * (_DEGREES_PER_METRE if crs.is_geographic else 1.0))
    if disagree.any():
        faults.append(
            f"traces: {int(disagree.sum())} fixes repeat the time of the fix before at another place "
            f"(trace {_few(traces['trace_id'][disagree].unique())}); use finer time stamps, or one trace_id per drive"
        )
        return traces
    logger.warning("dropped %d repeated fixes", int(repeated.sum()))
    return traces[~repeated].reset_index(drop=True)


def run_starts(ids: pd.Series) -> NDArray[np.int64]:
    """Offsets of the runs of equal values, and the length at the end.

    Examples
    --------
    >>> run_starts(pd.Series(["a", "a", "b"])).tolist()
    [0, 2, 3]
    >>> run_starts(pd.Series([], dtype="int64")).tolist()
    [0]
    """
    if len(ids) == 0:
        return np.zeros(1, np.int64)
    values = ids.array
    changes = np.flatnonzero(np.asarray(values[1:] != values[:-1], bool)) + 1
    return np.concatenate([[0], changes, [len(ids)]]).astype(np.int64)


def _checked(
    table: pd.DataFrame,
    origin: TableOrigin,
    columns: tuple[Sequence[str], Sequence[str]],
    crs: CRS,
    faults: list[str],
) -> pd.DataFrame:
    """Check one table of the given columns (always present, optional)."""
    needed, optional = columns
    known = len(faults)
    missing = [column for column in needed if column not in table and column not in _MAY_BE_ABSENT]
    there = ", ".join(map(str, table))
    faults += [f"{origin.name}: column {origin.column(name)} is missing (there are: {there})" for name in missing]
    if table.empty:
        faults.append(f"{origin.name}: no rows")
    if len(faults) > known:
        return table
    result: dict[str, Any] = {"trace_id": _identifiers(table["trace_id"], origin, faults)}
    result["t"] = _timestamps(table["t"], origin, faults) if "t" in table else _no_times(len(table))
    for name in ("x", "y", "z", *optional):
        if name not in table:
            if name in needed:
                result[name] = np.full(len(table), np.nan)
        elif name == "vehicle_id":
            result[name] = table[name].array
        else:
            result[name] = _numbers(table[name], origin, faults, must_be_finite=name in ("x", "y"))
    if "kind" in needed:
        result["kind"] = _kinds(table["kind"], origin, faults)
    if len(faults) == known:
        faults += [f"{origin.name}: {fault}" for fault in _position_faults(result["x"], result["y"], crs, origin)]
    return pd.DataFrame(result, copy=False)


def _identifiers(ids: pd.Series, origin: TableOrigin, faults: list[str]) -> Any:
    """Check trace ids for holes, and bring mixed types and bytes to text, so that they sort."""
    name = f"{origin.name}: column {origin.column('trace_id')}"
    empty = ids.isna().to_numpy()
    if pd.api.types.is_string_dtype(ids.dtype) and not pd.api.types.is_object_dtype(ids.dtype):
        empty = empty | (ids == "").to_numpy(bool, na_value=False)
    if empty.any():
        faults.append(f"{name} is empty in {int(empty.sum())} of {len(ids)} rows")
    if isinstance(ids.dtype, pd.CategoricalDtype) and not empty.any():
        ids = ids.astype(ids.cat.categories.dtype)
    if not pd.api.types.is_object_dtype(ids.dtype):
        return ids.array
    try:
        codes, found = pd.factorize(ids)
    except TypeError:  # lists and the like
        faults.append(f"{name} holds neither text nor numbers")
        return ids.array
    words = [value.hex() if isinstance(value, bytes) else str(value) for value in found]
    return pd.array([*words, None], dtype="str").take(codes)


def _numbers(values: pd.Series, origin: TableOrigin, faults: list[str], *, must_be_finite: bool) -> NDArray[np.float64]:
    """Convert a column to float64, or name the cells that prevent it."""
    name = f"{origin.name}: column {origin.column(str(values.name))}"
    if _is_plain_numeric(values):
        numbers = values.to_numpy(dtype=np.float64, na_value=np.nan)
    elif values.dtype.kind in "bmM":
        faults.append(f"{name} holds {values.dtype}, not numbers")
        return np.full(len(values), np.nan)
    else:
        words = values.astype(object).map(str, na_action="ignore").str.strip()
        numbers = pd.to_numeric(words, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
        not_numeric = np.isnan(numbers) & ~(words.isna() | words.str.lower().isin(["", "nan"])).to_numpy(bool)
        if not_numeric.any():
            comma = words[not_numeric].str.fullmatch(r"[+-]?\d+,\d+").all()
            hint = "; decimal commas are not read, use points" if comma else ""
            faults.append(f"{name} is not a number in {origin.rows(not_numeric, words)}{hint}")
            return numbers
    if must_be_finite and not np.isfinite(numbers).all():
        faults.append(f"{name} is empty or not finite in {origin.rows(~np.isfinite(numbers), numbers)}")
    return numbers


def _is_plain_numeric(values: pd.Series) -> bool:
    return bool(pd.api.types.is_numeric_dtype(values.dtype) and values.dtype.kind != "b")


def _timestamps(values: pd.Series, origin: TableOrigin, faults: list[str]) -> pd.Series:
    """Convert a column to UTC timestamps: numbers are seconds since 1970, text is ISO 8601, naive is UTC."""
    name = f"{origin.name}: column {origin.column('t')}"
    if values.dtype.kind in "bm":
        faults.append(f"{name} holds {values.dtype}, not times")
        return _no_times(len(values))
    if _is_plain_numeric(values):
        seconds = values.to_numpy(dtype=np.float64, na_value=np.nan)
        largest = float(np.nanmax(np.abs(seconds), initial=0.0))
        if not largest < 9.2e9:
            faults.append(f"{name} is not in seconds since 1970 (largest value {largest:.6g})")
            return _no_times(len(values))
        # A float64 holds the seconds of this century to a microsecond at best: do not invent nanoseconds.
        microseconds = np.round(np.nan_to_num(seconds) * 1e6).astype(np.int64)
        nanoseconds = np.where(np.isnan(seconds), np.iinfo(np.int64).min, microseconds * 1000)
        return pd.Series(nanoseconds.view("datetime64[ns]")).dt.tz_localize("UTC")
    is_time = pd.api.types.is_datetime64_any_dtype(values.dtype)
    times = pd.to_datetime(values, utc=True, errors="coerce", format=None if is_time else "ISO8601")
    unreadable = (times.isna() & values.notna()).to_numpy()
    if unreadable.any():
        faults.append(f"{name} is not a time in {origin.rows(unreadable, values)}; use ISO 8601 or seconds since 1970")
    return times.astype(TIME_DTYPE).reset_index(drop=True)


def _no_times(n: int) -> pd.Series:
    """Return n missing times."""
    return pd.Series(np.full(n, np.datetime64("NaT", "ns"))).dt.tz_localize("UTC")


def _kinds(values: pd.Series, origin: TableOrigin, faults: list[str]) -> pd.Categorical:
    """Convert a column to the categories of semantic points, or name the values that are none."""
    codes, found = pd.factorize(values, use_na_sentinel=False)
    unknown = [str(kind) for kind in found if kind not in POINT_KINDS]
    if unknown:
        name = f"{origin.name}: column {origin.column('kind')}"
        faults.append(f"{name} is one of {', '.join(POINT_KINDS)}, not {_few(unknown)}")
    position = np.array([POINT_KINDS.index(kind) if kind in POINT_KINDS else -1 for kind in found], np.int8)
    return pd.Categorical.from_codes(position[codes], categories=POINT_KINDS)


def _position_faults(x: NDArray[np.float64], y: NDArray[np.float64], crs: CRS, origin: TableOrigin) -> list[str]:
    """Name positions that contradict the CRS, and say so where the two axes look swapped."""
    return _degree_faults(x, y, origin) if crs.is_geographic else _metre_faults(x, y, crs)


def _degree_faults(lon: NDArray[np.float64], lat: NDArray[np.float64], origin: TableOrigin) -> list[str]:
    """Name longitudes and latitudes that are out of range or at a pole."""
    bad_lon, bad_lat = np.abs(lon) > 180, np.abs(lat) > 90
    middle = float(np.median(np.abs(lat)))
    swapped = "; longitude and latitude look swapped" if middle > _POLAR and np.abs(lon).max() <= 90 else ""
    projected = (
        '; the values look projected: pass their CRS, for example crs="EPSG:32616"'
        if max(np.abs(lon).max(), middle) > 1000
        else ""
    )
    faults = []
    for name, bad, limit, values in (("longitudes", bad_lon, 180, lon), ("latitudes", bad_lat, 90, lat)):
        if bad.any():
            hint = projected or (swapped if name == "latitudes" else "")
            faults.append(f"{name} are outside -{limit}..{limit} in {origin.rows(bad, values)}{hint}")
    if not faults and middle > _POLAR:
        faults.append(
            f"half of the latitudes are nearer to a pole than {_POLAR:.0f} degrees{swapped}; "
            "if these drives are at a pole, pass them in a polar projection"
        )
    return faults


def _metre_faults(x: NDArray[np.float64], y: NDArray[np.float64], crs: CRS) -> list[str]:
    """Name projected coordinates that are degrees, or far from where the CRS is used."""
    extent = f"x {x.min():.6g}..{x.max():.6g}, y {y.min():.6g}..{y.max():.6g}"
    spread = float(np.hypot(np.ptp(x), np.ptp(y)))
    if max(np.abs(x).max(), np.abs(y).max()) <= 180 and 0 < spread < _SPREAD_OF_DEGREES:
        return [f'the coordinates look like degrees ({extent}) but the CRS is {crs.name}; pass crs="EPSG:4326" if so']
    if _in_area_of_use(x, y, crs):
        return []
    swapped = "; x and y look swapped" if _in_area_of_use(y, x, crs) else "; check the CRS"
    return [f"the coordinates ({extent}) are far from where {crs.name} is used{swapped}"]


def _in_area_of_use(x: NDArray[np.float64], y: NDArray[np.float64], crs: CRS) -> bool:
    """Say whether the extremes lie in or near the area of use of the CRS; True where it names none."""
    extremes = np.array([x.argmin(), x.argmax(), y.argmin(), y.argmax()])
    lon, lat = (np.asarray(axis) for axis in transform(x[extremes], y[extremes], crs, WGS84))
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
        return False
    area = crs.area_of_use
    if area is None:
        return True
    width = (area.east - area.west) % 360.0 or 360.0
    off_lon = np.abs((lon - area.west - width / 2 + 180.0) % 360.0 - 180.0) - width / 2  # about the area's meridian
    off_lat = np.maximum(area.south - lat, lat - area.north)
    return bool((off_lon <= _FAR_FROM_CRS).all() and (off_lat <= _FAR_FROM_CRS).all())


def _codes(ids: pd.Series) -> NDArray[np.int64]:
    """Integers that order and separate like the ids; only one id of a run is looked at."""
    if pd.api.types.is_integer_dtype(ids.dtype) and not ids.hasnans:
        return ids.to_numpy(np.int64)
    starts = run_starts(ids)
    codes, _ = pd.factorize(ids.iloc[starts[:-1]], sort=True)
    return np.repeat(codes.astype(np.int64), np.diff(starts))


def _few(values: Any) -> str:
    """List the first few values."""
    values = list(values)
    return ", ".join(map(str, values[:_EXAMPLES_SHOWN])) + (", ..." if len(values) > _EXAMPLES_SHOWN else "")
