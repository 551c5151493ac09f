"""The check of one table of fleet data: its columns, their types, and all possible faults.

The checks look at the whole table before they speak, so that a user fixes a bad file once, not fault by
fault. What can be repaired without losing information (row order, exact duplicates) is repaired and logged.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import WGS84, transform
from probe2road.fleet.columns import (
    POINT_COLUMNS,
    POINT_KINDS,
    POINT_OPTIONAL_COLUMNS,
    TIME_DTYPE,
    TRACE_COLUMNS,
    TRACE_OPTIONAL_COLUMNS,
    coordinates,
    identifiers,
    measured,
    point_kinds,
    timestamps,
    unknown_times,
)
from probe2road.fleet.faults import TableChecks, TableOrigin, few, may_leave_out

__all__ = ["check_points", "check_traces", "empty_points", "run_starts", "sort_fixes"]

logger = logging.getLogger(__name__)


_MAY_BE_ABSENT = ("t", "z")  # data without clock, 2-D data
_SAME_PLACE = 0.01  # m; repeated fixes at one instant nearer than this are one fix
_DEGREES_PER_METRE = 1e-5  # of latitude, rounded up
_POLAR = 80.0  # degrees of latitude beyond which swapped columns are likelier than roads
_SWAPPED = "; longitude and latitude look swapped"
_SPREAD_OF_DEGREES = 5.0  # a projected data set that spans less than this near the origin is in degrees
_FAR_FROM_CRS = 20.0  # degrees outside the area of use of a CRS, beyond which the CRS is wrong


def check_traces(
    table: pd.DataFrame,
    crs: CRS,
    faults: list[str],
    *,
    origin: TableOrigin | None = None,
    invalid: str | None = "refuse",
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
    invalid
        What happens to rows without position, trace id or readable time: ``"drop"`` leaves them out with a warning,
        ``"refuse"`` makes them faults, None leaves out up to 5 % of the rows.

    Returns
    -------
    DataFrame
        `TRACE_COLUMNS`, then those of `TRACE_OPTIONAL_COLUMNS` that the table has, in the same row order. The index
        has the row numbers of the table given.

    Examples
    --------
    >>> faults = []
    >>> _ = check_traces(pd.DataFrame({"x": ["a"], "y": [95.0]}), WGS84, faults)
    >>> faults
    ["traces: column 'trace_id' is missing (there are: x, y)"]
    """
    origin = origin or TableOrigin("traces")
    return _checked(table, origin, (TRACE_COLUMNS, TRACE_OPTIONAL_COLUMNS), crs, faults, invalid)


def check_points(
    table: pd.DataFrame,
    crs: CRS,
    faults: list[str],
    *,
    origin: TableOrigin | None = None,
    invalid: str | None = "refuse",
) -> pd.DataFrame:
    """Return the semantic points' known columns in canonical types; see `check_traces`."""
    origin = origin or TableOrigin("points")
    return _checked(table, origin, (POINT_COLUMNS, POINT_OPTIONAL_COLUMNS), crs, faults, invalid)


def empty_points(trace_ids: pd.Series) -> pd.DataFrame:
    """Return the table of semantic points of a fleet without camera, its ids of the type of the given ones."""
    columns = {column: pd.Series(dtype="float64") for column in ("x", "y", "z")}
    kind = pd.Categorical([], categories=POINT_KINDS)
    return pd.DataFrame({"trace_id": trace_ids.iloc[:0], "t": pd.Series(dtype=TIME_DTYPE), **columns, "kind": kind})


def sort_fixes(traces: pd.DataFrame, crs: CRS, faults: list[str], *, invalid: str | None = "refuse") -> pd.DataFrame:
    """Sort fixes by trace and time and drop repeated ones; fixes that cannot be sorted are a fault, or left out.

    Those are fixes that repeat the time of the fix before at another place, and fixes without time in a trace that
    has times. Rows without time keep their order. A table that is in order already is returned as it is.

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": [1, 1], "t": pd.to_datetime([2, 1], unit="s", utc=True), "x": 0.0, "y": 0.0})
    >>> sort_fixes(table, CRS.from_epsg(32616), [])["t"].dt.second.tolist()
    [1, 2]
    """
    traces = _with_whole_clocks(traces, faults, invalid)
    if faults:
        return traces
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
        what = (
            f"{int(disagree.sum())} fixes repeat the time of the fix before at another place "
            f"(trace {few(traces['trace_id'][disagree].unique())})"
        )
        if not may_leave_out(int(disagree.sum()), len(traces), invalid):
            fix = 'use finer time stamps, or one trace_id per drive, or leave the later ones out with invalid="drop"'
            faults.append(f"traces: {what}; {fix}")
            return traces
        logger.warning("%s: left out", what)
    if n_same := int(repeated.sum() - disagree.sum()):
        logger.warning("dropped %d repeated fixes", n_same)
    return traces[~repeated].reset_index(drop=True)


def run_starts(ids: pd.Series) -> NDArray[np.int64]:
    """Return the offsets of the runs of equal values, and the length at the end.

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


def _with_whole_clocks(traces: pd.DataFrame, faults: list[str], invalid: str | None) -> pd.DataFrame:
    """Leave out fixes without a time in traces that have times, or report these traces."""
    untimed = traces["t"].isna()
    if not untimed.any() or untimed.all():
        return traces
    partly = untimed.groupby(traces["trace_id"], sort=False).mean()
    partly = partly[(partly > 0) & (partly < 1)]
    if partly.empty:
        return traces
    bad = (untimed & traces["trace_id"].isin(partly.index)).to_numpy(bool)
    what = f"some fixes of {len(partly)} traces have no time ({few(partly.index)})"
    if not may_leave_out(int(bad.sum()), len(traces), invalid):
        faults.append(f'traces: {what}; drop those fixes, for example with invalid="drop"')
        return traces
    logger.warning("%s: %d fixes left out", what, int(bad.sum()))
    return traces[~bad].reset_index(drop=True)


def _checked(
    table: pd.DataFrame,
    origin: TableOrigin,
    columns: tuple[Sequence[str], Sequence[str]],
    crs: CRS,
    faults: list[str],
    invalid: str | None,
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
    checks = TableChecks(origin, faults)
    result: dict[str, Any] = {"trace_id": identifiers(table["trace_id"], checks)}
    result["t"] = timestamps(table["t"], checks) if "t" in table else unknown_times(len(table))
    for name in ("x", "y", "z", *optional):
        if name not in table:
            if name in needed:
                result[name] = np.full(len(table), np.nan)
        elif name == "vehicle_id":
            result[name] = table[name].array
        elif name in ("x", "y"):
            result[name] = coordinates(table[name], checks)
        else:
            values = measured(table[name], checks, invalid)
            if values is not None or name in needed:
                result[name] = np.full(len(table), np.nan) if values is None else values
    if "kind" in needed:
        result["kind"] = point_kinds(table["kind"], checks)
    if crs.is_geographic and len(faults) == known:
        _degree_faults(result["x"], result["y"], checks)
    keep = _rows_to_keep(len(table), checks, invalid, complain=len(faults) == known)
    checked = pd.DataFrame(result, copy=False)
    if len(faults) == known and not keep.all():
        checked = checked[keep]
    if len(faults) == known:
        x, y = checked["x"].to_numpy(), checked["y"].to_numpy()
        found = _polar_faults(x, y) if crs.is_geographic else _metre_faults(x, y, crs)
        faults += [f"{origin.name}: {fault}" for fault in found]
    return checked


def _rows_to_keep(n: int, checks: TableChecks, invalid: str | None, *, complain: bool) -> NDArray[np.bool_]:
    """Mark the rows that are kept; if too many would be left out, their faults become faults of the table."""
    keep = np.ones(n, bool)
    for _, mask in checks.rows:
        keep &= ~mask
    n_bad = int(n - keep.sum())
    if n_bad == 0:
        return keep
    if n_bad < n and may_leave_out(n_bad, n, invalid):
        if complain:
            for fault, _ in checks.rows:
                logger.warning("%s: left out", fault)
        return keep
    remedy = "" if n_bad == n or not complain else '; leave such rows out with invalid="drop"'
    checks.faults += [f"{fault}{remedy}" for fault, _ in checks.rows]
    return np.ones(n, bool)


def _degree_faults(lon: NDArray[np.float64], lat: NDArray[np.float64], checks: TableChecks) -> None:
    """Report longitudes and latitudes that are out of range, and whether the two axes look swapped."""
    if not (np.isfinite(lon).any() and np.isfinite(lat).any()):
        return
    bad_lon, bad_lat = np.abs(lon) > 180, np.abs(lat) > 90  # such as 181 and 91: "not available" to many receivers
    middle = float(np.nanmedian(np.abs(lat)))
    swapped = _SWAPPED if middle > _POLAR and np.nanmax(np.abs(lon)) <= 90 else ""
    projected = (
        '; the values look projected: pass their CRS, for example crs="EPSG:32616" (integers of 1e-6 or 1e-7 degrees '
        "are read from columns called lat_e6 or lat_e7)"
        if max(np.nanmax(np.abs(lon)), middle) > 1000
        else ""
    )
    for name, bad, limit, values in (("longitudes", bad_lon, 180, lon), ("latitudes", bad_lat, 90, lat)):
        if bad.any():
            hint = projected or (swapped if name == "latitudes" else "")
            rows = checks.origin.rows(bad, values)
            checks.row_fault(f"{checks.origin.name}: {name} are outside -{limit}..{limit} in {rows}{hint}", bad)


def _polar_faults(lon: NDArray[np.float64], lat: NDArray[np.float64]) -> list[str]:
    """Report latitudes at a pole, which are probably swapped axes."""
    if float(np.median(np.abs(lat))) <= _POLAR:
        return []
    swapped = _SWAPPED if np.abs(lon).max() <= 90 else ""
    fault = f"half of the latitudes are nearer to a pole than {_POLAR:.0f} degrees{swapped}; "
    return [fault + "if these drives are at a pole, pass them in a polar projection"]


def _metre_faults(x: NDArray[np.float64], y: NDArray[np.float64], crs: CRS) -> list[str]:
    """Report projected coordinates that are degrees, or far from the area where the CRS is used."""
    extent = f"x {x.min():.6g}..{x.max():.6g}, y {y.min():.6g}..{y.max():.6g}"
    spread = float(np.hypot(np.ptp(x), np.ptp(y)))
    if max(np.abs(x).max(), np.abs(y).max()) <= 180 and 0 < spread < _SPREAD_OF_DEGREES:
        return [f'the coordinates look like degrees ({extent}) but the CRS is {crs.name}; pass crs="EPSG:4326" if so']
    most = _in_middle(x) & _in_middle(y)  # a stray fix says nothing about the CRS
    if most.any():
        x, y = x[most], y[most]
    if _in_area_of_use(x, y, crs):
        return []
    swapped = "; x and y look swapped" if _in_area_of_use(y, x, crs) else "; check the CRS"
    return [f"the coordinates ({extent}) are far from where {crs.name} is used{swapped}"]


def _in_middle(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark all but the twentieth part at both ends."""
    low, high = np.quantile(values, 0.05, method="higher"), np.quantile(values, 0.95, method="lower")
    return np.asarray((low <= values) & (values <= high))


def _in_area_of_use(x: NDArray[np.float64], y: NDArray[np.float64], crs: CRS) -> bool:
    """Tell whether the extremes lie in or near the area of use of the CRS; True if the CRS has no such area."""
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
    """Return integers with the order of the ids, computed from only one id of each run."""
    if pd.api.types.is_integer_dtype(ids.dtype) and not ids.hasnans:
        return ids.to_numpy(np.int64)
    starts = run_starts(ids)
    codes, _ = pd.factorize(ids.iloc[starts[:-1]], sort=True)
    return np.repeat(codes.astype(np.int64), np.diff(starts))
