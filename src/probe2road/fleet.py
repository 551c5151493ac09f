"""The fleet-data contract: what every stage may assume about traces and semantic points.

One validator looks at everything before it speaks, so that a user fixes a bad file once, not fault by fault.
What it can repair without losing information (row order, exact duplicates) it repairs and logs.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import WGS84, local_crs, parse_crs, require_metric, transform
from probe2road.errors import InputError, OptionError

__all__ = ["POINT_KINDS", "Fleet", "TraceGaps", "fleet_from_tables", "trace_breaks"]

logger = logging.getLogger(__name__)

POINT_KINDS = ("lane_marking", "road_boundary")
TRACE_COLUMNS = ("trace_id", "t", "x", "y", "z")
TRACE_OPTIONAL_COLUMNS = ("vehicle_id", "heading", "speed", "accuracy")
POINT_COLUMNS = ("trace_id", "t", "x", "y", "z", "kind")
POINT_OPTIONAL_COLUMNS = ("accuracy",)

_TIME_DTYPE = "datetime64[ns, UTC]"
_EXAMPLES_SHOWN = 3  # offending rows named in a fault
_SAME_PLACE = 0.01  # m; repeated fixes at one instant nearer than this are one fix


@dataclass(frozen=True)
class Fleet:
    """Traces and semantic points of a vehicle fleet, in one metric CRS.

    Build it with `fleet_from_tables` or `probe2road.read_fleet`, which validate; the constructor trusts you.

    Attributes
    ----------
    traces
        One row per fix, sorted by ``(trace_id, t)``: ``trace_id``, ``t`` (UTC; NaT throughout a trace that
        has no clock, whose rows are then in driving order), ``x``, ``y``, ``z`` (metres; ``z`` may be NaN);
        optional ``vehicle_id``, ``heading`` (degrees clockwise from north), ``speed`` (m/s), ``accuracy``
        (1 sigma, metres).
    points
        One row per semantic point: ``trace_id``, ``t``, ``x``, ``y``, ``z``, ``kind`` (one of
        `POINT_KINDS`); optional ``accuracy``. Empty where the fleet has no camera.
    crs
        Metric CRS of both tables.
    """

    traces: pd.DataFrame
    points: pd.DataFrame
    crs: CRS

    @property
    def starts(self) -> NDArray[np.int64]:
        """Row at which each trace starts, then the number of rows: shape ``(n_traces + 1,)``."""
        return _run_starts(self.traces["trace_id"])

    @property
    def n_traces(self) -> int:
        """Number of traces."""
        return len(self.starts) - 1

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box ``(left, bottom, right, top)`` of the traces, metres.

        Semantic points do not enlarge it: a point far from every trace is noise.
        """
        x, y = self.traces["x"].to_numpy(), self.traces["y"].to_numpy()
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    def to_crs(self, crs: Any) -> Fleet:
        """Return the same data in another metric CRS.

        Raises
        ------
        CRSError
            If the target is not metric.
        """
        target = require_metric(parse_crs(crs))
        return replace(
            self,
            traces=_projected(self.traces, self.crs, target),
            points=_projected(self.points, self.crs, target),
            crs=target,
        )


@dataclass(frozen=True)
class TraceGaps:
    """Where a trace is broken: no vehicle is known to have driven straight across (METHOD 0.1 row 3).

    The fixed limits are for dense data; both grow with the trace's own sampling interval, because a feed
    with a fix every ten seconds has a gap when three are missing, not between any two.
    """

    max_interval: float = 5.0  # s, between consecutive fixes
    max_step: float = 150.0  # m, between consecutive fixes
    interval_factor: float = 3.0  # x the trace's median interval, where that is more than max_interval
    step_factor: float = 3.0  # x the trace's median moving step, where that is more than max_step
    max_speed: float = 70.0  # m/s; a faster step is a jump of the position, not driving

    def __post_init__(self) -> None:
        """Refuse limits that would break every trace everywhere."""
        for name in ("max_interval", "max_step", "max_speed"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} is {getattr(self, name)}", where="TraceGaps", fix="use a positive number")


def trace_breaks(fleet: Fleet, gaps: TraceGaps | None = None) -> NDArray[np.bool_]:
    """Mark the fixes that no segment may reach from the fix before.

    Parameters
    ----------
    fleet
        The fleet.
    gaps
        The limits; a trace without clock is broken by distance only.

    Returns
    -------
    ndarray of bool, shape (n_fixes,)
        True at the first fix of every trace and behind every gap.

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": 1, "t": [0, 1, 2, 60], "x": [0.0, 9, 18, 27], "y": 0.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", target_crs="EPSG:32616")
    >>> trace_breaks(fleet).tolist()
    [True, False, False, True]
    """
    gaps = gaps or TraceGaps()
    n = len(fleet.traces)
    breaks = np.zeros(n, bool)
    if n == 0:
        return breaks
    starts = fleet.starts
    breaks[starts[:-1]] = True
    step = np.hypot(*(np.diff(fleet.traces[axis].to_numpy(), prepend=np.nan) for axis in "xy"))
    interval = _intervals(fleet.traces["t"])
    within = ~breaks
    owner = np.repeat(np.arange(len(starts) - 1), np.diff(starts))

    interval_limit = _grown_limit(interval, within, owner, gaps.max_interval, gaps.interval_factor)
    step_limit = _grown_limit(step, within & (step > 1.0), owner, gaps.max_step, gaps.step_factor)
    with np.errstate(invalid="ignore"):
        breaks |= within & ((interval > interval_limit[owner]) | (step > step_limit[owner]))
        breaks |= within & (step > gaps.max_speed * np.maximum(interval, 1.0))
    return breaks


def fleet_from_tables(
    traces: pd.DataFrame,
    points: pd.DataFrame | None = None,
    *,
    crs: Any,
    target_crs: Any = None,
    where: object = None,
) -> Fleet:
    """Validate two tables and bring them into one local metric CRS.

    Parameters
    ----------
    traces
        Table with at least ``trace_id``, ``x``, ``y``, in any row order; ``t`` (timestamps, or numbers read
        as seconds since 1970) may be missing where the data has no clock, ``z`` where it is 2-D.
    points
        Semantic points with at least ``trace_id``, ``x``, ``y``, ``kind``, or None.
    crs
        CRS of the coordinates of both tables; for a geographic one ``x`` is longitude, ``y`` latitude.
    target_crs
        Metric CRS to work in; chosen from the data by `probe2road.crs.local_crs` where it is None.
    where
        What the tables were read from, for error messages.

    Returns
    -------
    Fleet
        Sorted, deduplicated, projected. The inputs are not changed.

    Raises
    ------
    InputError
        Naming every fault found: missing or non-numeric columns, no rows, values that are not finite,
        latitudes beyond 90 degrees (and whether longitude and latitude look swapped), coordinates that
        contradict the CRS, fixes of one trace at one instant that disagree, unknown kinds of points.
    CRSError
        If there is no CRS or the target is not metric.

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": [1, 1], "t": [0, 1], "x": [-87.65, -87.65], "y": [41.87, 41.8701]})
    >>> fleet = fleet_from_tables(table, crs="EPSG:4326")
    >>> fleet.crs.to_epsg(), len(fleet.traces)
    (32616, 2)

    >>> fleet_from_tables(table.assign(y=-87.65, x=410.87), crs="EPSG:4326", where="drives.csv")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: drives.csv: traces: 2 of 2 longitudes are outside -180..180 ...
    """
    source = parse_crs(crs, where=where) if crs is not None else require_metric(None, where=where)
    faults: list[str] = []
    traces = _checked(traces, "traces", TRACE_COLUMNS, TRACE_OPTIONAL_COLUMNS, source, faults)
    if points is None:
        points = pd.DataFrame({"trace_id": traces.get("trace_id", pd.Series(dtype="int64")).iloc[:0]})
        points = points.assign(t=pd.Series(dtype=_TIME_DTYPE), x=0.0, y=0.0, z=0.0, kind=_kinds([]))
    else:
        points = _checked(points, "points", POINT_COLUMNS, POINT_OPTIONAL_COLUMNS, source, faults)
    if not faults:
        faults += _clock_faults(traces)
    if faults:
        raise InputError.from_faults(faults, where=where)

    traces = _sorted_without_duplicates(traces, faults)
    if faults:
        raise InputError.from_faults(faults, where=where)
    target = _metric_target(traces, source, target_crs, where)
    fleet = Fleet(_projected(traces, source, target), _projected(points, source, target), target)
    if not np.isfinite(fleet.traces[["x", "y"]].to_numpy()).all():
        raise InputError(f"positions cannot be projected to {target.name}", where=where, fix="check the CRS")
    return fleet


def _checked(
    table: pd.DataFrame,
    name: str,
    columns: Sequence[str],
    optional: Sequence[str],
    crs: CRS,
    faults: list[str],
) -> pd.DataFrame:
    """Return the table's known columns in canonical types, adding what is wrong with it to the faults."""
    known = len(faults)
    missing = [column for column in columns if column not in table and column not in ("t", "z")]
    faults += [f"{name}: column {column!r} is missing (there are: {', '.join(map(str, table))})" for column in missing]
    if table.empty:
        faults.append(f"{name}: no rows")
    if len(faults) > known:
        return table
    result = pd.DataFrame(index=pd.RangeIndex(len(table)))
    result["trace_id"] = _identifiers(table["trace_id"], name, faults)
    result["t"] = (
        _timestamps(table["t"], name, faults) if "t" in table else pd.Series(pd.NaT, result.index, _TIME_DTYPE)
    )
    for column in ("x", "y", "z", *optional):
        if column == "vehicle_id" and column in table:
            result[column] = table[column].to_numpy()
        elif column in table:
            result[column] = _numbers(table[column], name, faults, must_be_finite=column in ("x", "y"))
        elif column == "z":
            result[column] = np.nan
    if "kind" in columns:
        result["kind"] = _kinds(table["kind"])
        unknown = sorted(set(table["kind"].astype(str)) - set(POINT_KINDS))
        if unknown:
            faults.append(f"{name}: kind is one of {', '.join(POINT_KINDS)}, not {', '.join(unknown[:5])}")
    if len(faults) == known:
        faults += [f"{name}: {fault}" for fault in _position_faults(result, crs)]
    return result


def _identifiers(ids: pd.Series, name: str, faults: list[str]) -> NDArray[Any] | pd.Series:
    """Check trace ids for holes and bring mixed types to text, so that they sort."""
    if ids.isna().any():
        faults.append(f"{name}: column 'trace_id' is empty in {int(ids.isna().sum())} of {len(ids)} rows")
    if pd.api.types.is_object_dtype(ids.dtype):
        return ids.astype(str).array
    return ids.array


def _numbers(values: pd.Series, name: str, faults: list[str], *, must_be_finite: bool) -> NDArray[np.float64]:
    """Convert a column to float64, or name the cells that prevent it."""
    numbers = pd.to_numeric(values, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    not_numeric = np.isnan(numbers) & values.notna().to_numpy() & ~_is_float(values)
    if not_numeric.any():
        faults.append(f"{name}: column {values.name!r} is not a number in {_rows(not_numeric, values)}")
    elif must_be_finite and not np.isfinite(numbers).all():
        faults.append(f"{name}: column {values.name!r} is not finite in {_rows(~np.isfinite(numbers), values)}")
    return numbers


def _is_float(values: pd.Series) -> bool:
    return bool(pd.api.types.is_float_dtype(values.dtype))


def _timestamps(values: pd.Series, name: str, faults: list[str]) -> pd.Series:
    """Convert a column to UTC timestamps: numbers are seconds since 1970, text is ISO 8601, naive is UTC."""
    if pd.api.types.is_numeric_dtype(values.dtype):
        seconds = values.to_numpy(dtype=np.float64, na_value=np.nan)
        if np.isinf(seconds).any() or np.nanmax(np.abs(seconds), initial=0.0) > 9.2e9:
            faults.append(f"{name}: column 't' is not in seconds since 1970 (largest value {np.nanmax(seconds):.6g})")
            return pd.Series(pd.NaT, pd.RangeIndex(len(values)), _TIME_DTYPE)
        nanoseconds = np.where(np.isnan(seconds), np.iinfo(np.int64).min, np.round(np.nan_to_num(seconds) * 1e9))
        return pd.Series(nanoseconds.astype(np.int64).view("datetime64[ns]")).dt.tz_localize("UTC")
    times = pd.to_datetime(values, utc=True, errors="coerce", format=None if _is_time(values) else "ISO8601")
    unreadable = (times.isna() & values.notna()).to_numpy()
    if unreadable.any():
        faults.append(f"{name}: column 't' is not a time in {_rows(unreadable, values)}")
    return times.astype(_TIME_DTYPE).reset_index(drop=True)


def _is_time(values: pd.Series) -> bool:
    return bool(pd.api.types.is_datetime64_any_dtype(values.dtype))


def _kinds(values: Any) -> pd.Categorical:
    return pd.Categorical(values, categories=POINT_KINDS)


def _position_faults(table: pd.DataFrame, crs: CRS) -> list[str]:
    """Name positions that contradict the CRS, and say so where longitude and latitude look swapped."""
    x, y = table["x"].to_numpy(), table["y"].to_numpy()
    n = len(table)
    looks_like_degrees = np.abs(x).max() <= 180 and np.abs(y).max() <= 180
    if not crs.is_geographic:
        if looks_like_degrees and n > 1 and np.ptp(x) + np.ptp(y) > 0 and np.hypot(np.ptp(x), np.ptp(y)) < 5:
            return [
                f"the coordinates look like degrees (x {x.min():.5g}..{x.max():.5g}, y {y.min():.5g}..{y.max():.5g}) "
                f"but the CRS is {crs.name}; pass --crs EPSG:4326 if they are"
            ]
        return []
    bad_lon, bad_lat = np.abs(x) > 180, np.abs(y) > 90
    swapped = "; longitude and latitude look swapped" if bad_lat.any() and np.abs(x).max() <= 90 else ""
    projected = "; the values look projected: pass their --crs" if max(np.abs(x).max(), np.abs(y).max()) > 1000 else ""
    faults = []
    if bad_lon.any():
        faults.append(
            f"{bad_lon.sum()} of {n} longitudes are outside -180..180 ({_rows(bad_lon, table['x'])}){projected}"
        )
    if bad_lat.any():
        faults.append(
            f"{bad_lat.sum()} of {n} latitudes are outside -90..90 ({_rows(bad_lat, table['y'])}){swapped}{projected}"
        )
    return faults


def _clock_faults(traces: pd.DataFrame) -> list[str]:
    """Name traces in which some fixes have a time and others have none."""
    untimed = traces["t"].isna()
    if not untimed.any() or untimed.all():
        return []
    partly = untimed.groupby(traces["trace_id"], sort=False).mean()
    partly = partly[(partly > 0) & (partly < 1)]
    if partly.empty:
        return []
    names = ", ".join(map(str, partly.index[:_EXAMPLES_SHOWN]))
    return [f"traces: some fixes of {len(partly)} traces have no time ({names}); drop those fixes or the traces"]


def _sorted_without_duplicates(traces: pd.DataFrame, faults: list[str]) -> pd.DataFrame:
    """Sort by trace and time and drop repeated fixes; repeated fixes that disagree are a fault."""
    codes = _codes(traces["trace_id"])
    time = traces["t"].to_numpy(dtype="datetime64[ns]").view(np.int64)  # NaT sorts first, all alike: order is kept
    grouped, ordered = np.diff(codes), np.diff(time)
    if (grouped < 0).any() or (ordered[grouped == 0] < 0).any():
        backwards = np.unique(codes[1:][(grouped == 0) & (ordered < 0)]).size
        if backwards:
            logger.warning("times go backwards within %d traces: sorted", backwards)
        order = np.lexsort((time, codes))
        traces, codes, time = traces.iloc[order].reset_index(drop=True), codes[order], time[order]
    repeated = np.zeros(len(traces), bool)
    repeated[1:] = (np.diff(codes) == 0) & (np.diff(time) == 0) & traces["t"].notna().to_numpy()[1:]
    if not repeated.any():
        return traces
    apart = np.hypot(*(np.diff(traces[axis].to_numpy(), prepend=np.nan) for axis in "xy"))
    tolerance = _SAME_PLACE if np.abs(traces["y"]).max() > 180 else _SAME_PLACE * 1e-5
    disagree = repeated & (apart > tolerance)
    if disagree.any():
        ids = traces["trace_id"][disagree].unique()
        faults.append(
            f"traces: {int(disagree.sum())} fixes repeat the time of the fix before at another place "
            f"(trace {', '.join(map(str, ids[:_EXAMPLES_SHOWN]))}); use finer time stamps, or one trace_id per drive"
        )
        return traces
    logger.warning("dropped %d repeated fixes", int(repeated.sum()))
    return traces[~repeated].reset_index(drop=True)


def _metric_target(traces: pd.DataFrame, source: CRS, target_crs: Any, where: object) -> CRS:
    """Return the CRS to work in: the given one, or the local one of the data's extent."""
    if target_crs is not None:
        return require_metric(parse_crs(target_crs, where=where), where=where)
    x, y = traces["x"].to_numpy(), traces["y"].to_numpy()
    extremes = np.array([x.argmin(), x.argmax(), y.argmin(), y.argmax()])
    lon, lat = transform(x[extremes], y[extremes], source, WGS84)
    crs = local_crs(lon, lat)
    logger.info("working in %s", crs.name)
    return crs


def _projected(table: pd.DataFrame, source: CRS, target: CRS) -> pd.DataFrame:
    """Return the table with x and y in the target CRS."""
    if source == target or table.empty:
        return table
    x, y = transform(table["x"].to_numpy(), table["y"].to_numpy(), source, target)
    return table.assign(x=x, y=y)


def _run_starts(ids: pd.Series) -> NDArray[np.int64]:
    """Offsets of the runs of equal values, and the length at the end."""
    codes = _codes(ids)
    changes = np.flatnonzero(np.diff(codes)) + 1
    return np.concatenate([[0], changes, [len(codes)]]) if len(codes) else np.zeros(1, np.int64)


def _codes(ids: pd.Series) -> NDArray[np.int64]:
    """Integers that order and separate like the ids."""
    if pd.api.types.is_integer_dtype(ids.dtype) and not ids.hasnans:
        return ids.to_numpy(np.int64)
    codes, _ = pd.factorize(ids, sort=True)
    return codes.astype(np.int64)


def _intervals(times: pd.Series) -> NDArray[np.float64]:
    """Seconds since the fix before, NaN where there is none or no clock."""
    time = times.to_numpy(dtype="datetime64[ns]")
    seconds = np.diff(time, prepend=np.datetime64("NaT", "ns")) / np.timedelta64(1, "s")
    return np.asarray(seconds, np.float64)


def _grown_limit(
    values: NDArray[np.float64],
    counted: NDArray[np.bool_],
    owner: NDArray[np.int64],
    limit: float,
    factor: float,
) -> NDArray[np.float64]:
    """Per trace, the larger of the fixed limit and a multiple of the trace's own median value."""
    counted = counted & np.isfinite(values)
    medians = pd.Series(values[counted]).groupby(owner[counted]).median()
    limits = np.full(owner[-1] + 1, limit)
    limits[medians.index.to_numpy(np.int64)] = np.maximum(limit, factor * medians.to_numpy())
    return limits


def _rows(mask: NDArray[np.bool_], values: pd.Series) -> str:
    """Say how many rows are meant and show the first few."""
    rows = np.flatnonzero(mask)
    shown = ", ".join(f"row {row}: {values.iloc[row]}" for row in rows[:_EXAMPLES_SHOWN])
    return f"{len(rows)} of {len(mask)} rows ({shown}{', ...' if len(rows) > _EXAMPLES_SHOWN else ''})"
