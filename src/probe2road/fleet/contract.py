"""The fleet-data contract: what every stage may assume about traces and semantic points."""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.bounds import NotNegative, Positive
from probe2road.crs import WGS84, is_true_to_scale, local_crs, parse_crs, require_metric, transform, turn_headings
from probe2road.errors import CRSError, InputError, OptionError
from probe2road.fleet.columns import POINT_KINDS
from probe2road.fleet.outliers import OutlierOptions, main_area, without_impossible_fixes, without_impossible_points
from probe2road.fleet.tables import check_points, check_traces, empty_points, run_starts, sort_fixes
from probe2road.notebook import figures_table
from probe2road.options import checked

__all__ = [
    "POINT_KINDS",
    "Fleet",
    "TraceGaps",
    "fix_intervals",
    "fleet_from_checked",
    "fleet_from_tables",
    "step_seconds",
    "times_left",
    "trace_breaks",
]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Fleet:
    """Traces and semantic points of a vehicle fleet, in one metric CRS.

    Build it with `fleet_from_tables` or `probe2road.read_fleet`, which validate; the constructor trusts you. A fleet
    equals itself only; compare the tables where their content counts.

    Attributes
    ----------
    traces
        One row per fix, sorted by ``(trace_id, t)``: ``trace_id``, ``t`` (UTC; NaT throughout a trace that
        has no clock, whose rows are then in driving order), ``x``, ``y``, ``z`` (metres; ``z`` may be NaN);
        optional ``vehicle_id``, ``heading`` (degrees clockwise from grid north), ``speed`` (m/s), ``accuracy``
        (1 sigma, metres).
    points
        One row per semantic point: ``trace_id``, ``t``, ``x``, ``y``, ``z``, ``kind`` (one of
        `POINT_KINDS`); optional ``accuracy``. Empty where the fleet has no camera.
    crs
        Metric CRS of both tables.

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": ["a", "a", "b"], "x": [446000.0, 446009, 446000], "y": 4636000.0})
    >>> fleet_from_tables(table, crs="EPSG:32616")
    Fleet(2 traces, 3 fixes, 0 points, WGS 84 / UTM zone 16N)
    """

    traces: pd.DataFrame
    points: pd.DataFrame
    crs: CRS

    @property
    def starts(self) -> NDArray[np.int64]:
        """Return the row at which each trace starts, then the number of rows: shape ``(n_traces + 1,)``."""
        return run_starts(self.traces["trace_id"])

    @property
    def n_traces(self) -> int:
        """Return the number of traces."""
        return len(self.starts) - 1

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """Return the number of the trace of every fix, from 0: shape ``(n_fixes,)``, read-only."""
        starts = self.starts
        owner = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        owner.setflags(write=False)
        return owner

    @cached_property
    def ids(self) -> pd.Index:
        """Return the id of every trace: ``fleet.ids[fleet.owner]`` are the ids of the fixes."""
        return pd.Index(self.traces["trace_id"].iloc[self.starts[:-1]])

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return the bounding box ``(left, bottom, right, top)`` of the traces, metres.

        Semantic points do not enlarge it: a point far from every trace is noise.
        """
        x, y = self.traces["x"].to_numpy(), self.traces["y"].to_numpy()
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    def __repr__(self) -> str:
        return f"Fleet({self.n_traces} traces, {len(self.traces)} fixes, {len(self.points)} points, {self.crs.name})"

    def _repr_html_(self) -> str:
        """Show figures in a notebook, without any ids."""
        kinds = self.points["kind"].value_counts()
        figures = {"traces": self.n_traces, "fixes": len(self.traces), **{str(kind): n for kind, n in kinds.items()}}
        return figures_table("Fleet", {**figures, "CRS": self.crs.name})

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

    def __getstate__(self) -> dict[str, Any]:
        """Return the tables alone for pickling and copying, because derived values are quickly computed again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True)
@checked
class TraceGaps:
    """Where a trace is broken: no vehicle is known to have driven straight across (METHOD 0.1 row 3).

    The fixed limits are for dense data; both grow with the trace's own sampling interval, because a feed
    with a fix every ten seconds has a gap when three are missing, not between any two.
    """

    max_interval: Positive[float] = 5.0  # s, between consecutive fixes
    max_step: Positive[float] = 150.0  # m, between consecutive fixes
    standing_step: Positive[float] = 30.0  # m; over a shorter step time alone is no gap: vehicles wait, or send rarely
    interval_factor: NotNegative[float] = 3.0  # x the trace's median interval, where that is more than max_interval
    step_factor: NotNegative[float] = 3.0  # x the trace's median moving step, where that is more than max_step
    max_speed: Positive[float] = 70.0  # m/s; a faster step is a jump of the position, not driving

    def too_fast(self, step: NDArray[np.float64], seconds: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which steps (m) no vehicle drives in so many seconds; clocks are true to a second. NaN says nothing.

        Examples
        --------
        >>> TraceGaps().too_fast(np.array([60.0, 90.0, 90.0]), np.array([0.1, 0.1, np.nan])).tolist()
        [False, True, False]
        """
        with np.errstate(invalid="ignore"):
            return np.asarray(step > self.max_speed * np.maximum(seconds, 1.0), bool)


def trace_breaks(fleet: Fleet, gaps: TraceGaps | None = None) -> NDArray[np.bool_]:
    """Mark the fixes that are not connected to the fix before.

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
    >>> table = pd.DataFrame({"trace_id": 1, "t": [0, 1, 2, 60, 61, 99], "x": [0.0, 9, 18, 98, 107, 107], "y": 0.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> trace_breaks(fleet).tolist()
    [True, False, False, True, False, False]
    """
    gaps = gaps or TraceGaps()
    n = len(fleet.traces)
    breaks = np.zeros(n, bool)
    if n == 0:
        return breaks
    starts = fleet.starts
    breaks[starts[:-1]] = True
    step = np.hypot(*(np.diff(fleet.traces[axis].to_numpy(), prepend=np.nan) for axis in "xy"))
    interval = fix_intervals(fleet.traces["t"])
    within = ~breaks
    owner = fleet.owner
    # Only traces with a fix beyond a fixed limit need their medians: few, where the data is dense.
    suspect = np.zeros(len(starts) - 1, bool)
    with np.errstate(invalid="ignore"):
        suspect[owner[within & ((interval > gaps.max_interval) | (step > gaps.max_step))]] = True
    counted = within & suspect[owner]

    interval_limit = _grown_limit(interval, counted, owner, gaps.max_interval, gaps.interval_factor)
    step_limit = _grown_limit(step, counted & (step > 1.0), owner, gaps.max_step, gaps.step_factor)
    with np.errstate(invalid="ignore"):
        late = (interval > interval_limit[owner]) & (step > gaps.standing_step)
        breaks |= within & (late | (step > step_limit[owner]))
    return breaks | (within & gaps.too_fast(step, step_seconds(fleet, gaps)))


def times_left(fleet: Fleet, gaps: TraceGaps) -> NDArray[np.datetime64]:
    """Return when the vehicle was last known to be where each fix has it: shape ``(n_fixes,)``, NaT without clock.

    A receiver that has no new position repeats the last one, and the next step covers the time of both. What is
    repeated for longer than ``max_interval`` stands, and leaves when it was reported last.
    """
    x, y = (fleet.traces[axis].to_numpy() for axis in "xy")
    time = fleet.traces["t"].to_numpy(dtype="datetime64[ns]")
    new = np.ones(len(x), bool)
    new[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1])
    new[fleet.starts[:-1]] = True
    reported = time[np.maximum.accumulate(np.where(new, np.arange(len(x)), 0))]
    return np.where((time - reported) / np.timedelta64(1, "s") <= gaps.max_interval, reported, time)


def step_seconds(fleet: Fleet, gaps: TraceGaps) -> NDArray[np.float64]:
    """Return the seconds in which each step was driven, also across traces; NaN for the first row or without clock.

    See `times_left` for how they differ from `fix_intervals`.
    """
    time, left = fleet.traces["t"].to_numpy(dtype="datetime64[ns]"), times_left(fleet, gaps)
    seconds = np.full(len(time), np.nan)
    seconds[1:] = (time[1:] - left[:-1]) / np.timedelta64(1, "s")
    return seconds


def fleet_from_tables(
    traces: pd.DataFrame,
    points: pd.DataFrame | None = None,
    *,
    crs: Any,
    target_crs: Any = None,
    keep_crs: bool = False,
    outliers: OutlierOptions | None = None,
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
        Metric CRS to work in. Where it is None: ``crs`` itself if that is metric and true to scale over the
        data (UTM is, Web Mercator is not), else the choice of `probe2road.crs.local_crs`.
    keep_crs
        Whether to stay in ``crs``, which must then be metric, even where it is not true to scale over the data: for
        drawn or simulated coordinates near the origin of a CRS.
    outliers
        Which fixes and points are left out, with a warning, because no vehicle can have been there; the defaults
        where it is None.

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
    OptionError
        If a target is given and the CRS shall be kept.

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": [1, 1], "t": [0, 1], "x": [-87.65, -87.65], "y": [41.87, 41.8701]})
    >>> fleet = fleet_from_tables(table, crs="EPSG:4326")
    >>> fleet.crs.to_epsg(), len(fleet.traces)
    (32616, 2)

    >>> fleet_from_tables(table.assign(y=-87.65, x=410.87), crs="EPSG:4326")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: traces: longitudes are outside -180..180 in 2 of 2 rows ...

    A street of 100 m, drawn at the origin:

    >>> street = pd.DataFrame({"trace_id": 1, "t": range(11), "x": np.arange(0.0, 101, 10), "y": 0.0})
    >>> fleet_from_tables(street, crs="EPSG:32616", keep_crs=True).bounds
    (0.0, 0.0, 100.0, 0.0)
    """
    if keep_crs and target_crs is not None:
        raise OptionError("keep_crs contradicts target_crs", where="fleet_from_tables", fix="give one of them")
    source = require_metric(None) if crs is None else parse_crs(crs)
    faults: list[str] = []
    traces = check_traces(traces, source, faults)
    if points is not None:
        points = check_points(points, source, faults)
    if faults:
        raise InputError.from_faults(faults)
    target = source if keep_crs else target_crs
    return fleet_from_checked(traces, points, crs=source, points_crs=source, target_crs=target, outliers=outliers)


def fleet_from_checked(
    traces: pd.DataFrame,
    points: pd.DataFrame | None,
    *,
    crs: CRS,
    points_crs: CRS,
    target_crs: Any = None,
    outliers: OutlierOptions | None = None,
    invalid: str | None = "refuse",
    where: object = None,
) -> Fleet:
    """Sort and project tables that `check_traces` and `check_points` have passed; see `fleet_from_tables`.

    For readers, which check file by file so that a fault names its file.
    """
    faults: list[str] = []
    traces = sort_fixes(traces, crs, faults, invalid=invalid)
    if faults:
        raise InputError.from_faults(faults, where=where)
    traces = without_impossible_fixes(traces, crs, options=outliers, where=where)
    if points is None:
        points = empty_points(traces["trace_id"])
    elif points["trace_id"].dtype != traces["trace_id"].dtype:
        traces = traces.assign(trace_id=traces["trace_id"].astype(str))
        points = points.assign(trace_id=points["trace_id"].astype(str))
    points = without_impossible_points(points, points_crs, traces, crs, options=outliers)
    target = _metric_target(traces, crs, target_crs, where)
    fleet = Fleet(_projected(traces, crs, target), _projected(points, points_crs, target), target)
    for name, table in (("traces", fleet.traces), ("points", fleet.points)):
        if not all(np.isfinite(table[axis].to_numpy()).all() for axis in "xy"):
            fault = f"{name}: positions cannot be projected to {target.name}"
            raise InputError(fault, where=where, fix="check the CRS")
    return fleet


def _metric_target(traces: pd.DataFrame, source: CRS, target_crs: Any, where: object) -> CRS:
    """Return the CRS to work in: the given one, the data's own if it is metric and true to scale, or a local one."""
    if target_crs is not None:
        return require_metric(parse_crs(target_crs, where=where), where=where)
    deciding = main_area(traces, source)
    if not deciding.all():
        left = len(deciding) - int(deciding.sum())
        logger.warning("%d of %d fixes, far away from the others, do not decide the local CRS", left, len(deciding))
    x, y = traces["x"].to_numpy()[deciding], traces["y"].to_numpy()[deciding]
    extremes = np.array([x.argmin(), x.argmax(), y.argmin(), y.argmax()])
    lon, lat = transform(x[extremes], y[extremes], source, WGS84)
    crs = source if _is_metric(source) and is_true_to_scale(source, lon, lat) else local_crs(lon, lat)
    logger.info("working in %s", crs.name)
    return crs


def _is_metric(crs: CRS) -> bool:
    """Tell whether `require_metric` accepts a CRS."""
    try:
        require_metric(crs)
    except CRSError:
        return False
    return True


def _projected(table: pd.DataFrame, source: CRS, target: CRS) -> pd.DataFrame:
    """Return the table with x and y, and headings where there are any, in the target CRS."""
    if source == target or table.empty:
        return table
    old = table["x"].to_numpy(), table["y"].to_numpy()
    x, y = transform(*old, source, target)
    if "heading" in table:
        table = table.assign(heading=turn_headings(table["heading"].to_numpy(), *old, source, target))
    return table.assign(x=x, y=y)


def fix_intervals(times: pd.Series) -> NDArray[np.float64]:
    """Return the seconds since the row before, also across traces; NaN for the first row or without a clock."""
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
    """Return, for each trace, the larger of the fixed limit and a multiple of the median value of the trace."""
    counted = counted & np.isfinite(values)
    medians = pd.Series(values[counted]).groupby(owner[counted]).median()
    limits = np.full(owner[-1] + 1, limit)
    limits[medians.index.to_numpy(np.int64)] = np.maximum(limit, factor * medians.to_numpy())
    return limits
