"""Cleaning of fleet data: impossible values become unknown, bad fixes are left out, joined traces are cut."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin

if TYPE_CHECKING:
    from probe2road.fleet.contract import Fleet

__all__ = ["BY_VEHICLE", "ENTERS", "accurate_fixes", "cut_traces", "plausible_headings", "tidied"]

logger = logging.getLogger(__name__)

ENTERS = "enters"  # column of the fixes whose trace was outside of the bounding box just before
BY_VEHICLE = "by_vehicle"  # column of the fixes whose trace is all that a vehicle drove
_PAUSE = 300.0  # s; a vehicle whose next fix is later has begun another drive
_MOVING = 3.0  # m; shorter steps have no direction
_FEW_STEPS = 5  # moving steps, below which headings are not judged
_MANY_STEPS = 20  # moving steps, below which the unit of speeds is not judged
_LONGEST_STEP = 10.0  # s; in longer ones a vehicle turns and stops, so that its speed tells nothing of the step
_LIKE = 0.06  # share by which speeds may differ from those in a unit; knots and miles per hour are 0.14 apart
_SPREAD = 0.3  # share by which half of the ratios of speed to movement may differ from the median
_IMPLAUSIBLE = 2.0  # ratio of speed to movement, above which or below whose inverse a unit is wrong
_OTHER_UNITS = {"km/h": 1 / 3.6, "mph": 0.44704, "knots": 1852 / 3600}  # m/s
_CONTRADICTION = 60.0  # degrees between heading and movement, in the median of a trace


def plausible_headings(table: pd.DataFrame, origin: TableOrigin, *, where: object = None) -> pd.DataFrame:
    """Set headings and speeds to unknown that stand for "not available": -1, 511, and values out of range.

    Headings are 0 to 360 degrees, or -180 to 180 where there are negative ones other than -1.

    Examples
    --------
    >>> table = pd.DataFrame({"heading": [-1.0, 90.0, 511.0], "speed": [-1.0, 9.0, 9.0]})
    >>> plausible_headings(table, TableOrigin())["heading"].tolist()
    [nan, 90.0, nan]
    """
    changed = {}
    with np.errstate(invalid="ignore"):
        if "heading" in table:
            heading = table["heading"].to_numpy()
            bad = (heading > 360) | (heading < -180)
            if ((heading < 0) <= (heading == -1)).all():  # no negative one but -1
                bad |= heading == -1
            changed["heading"] = heading, bad
        for name in ("speed", "accuracy"):
            if name in table:
                changed[name] = table[name].to_numpy(), (table[name] < 0).to_numpy()
    for name, (values, bad) in changed.items():
        if bad.any():
            rows = origin.rows(bad, values)
            logger.warning("%s: column %s cannot be true in %s: unknown", where, origin.column(name), rows)
            table = table.assign(**{name: np.where(bad, np.nan, values)})
    return table


def accurate_fixes(table: pd.DataFrame, max_accuracy: float, *, where: object = None) -> pd.DataFrame:
    """Leave out fixes with a recorded accuracy worse than a limit, in metres; unknown accuracies are kept.

    Raises
    ------
    InputError
        If no fix is left.
    """
    if "accuracy" not in table:
        logger.warning("%s: max_accuracy has no effect: there is no column of accuracies", where)
        return table
    bad = (table["accuracy"] > max_accuracy).to_numpy(bool)
    if not bad.any():
        return table
    if bad.all():
        fix = f"the best is {table['accuracy'].min():g} m: use a larger max_accuracy"
        raise InputError(f"no fix is accurate to {max_accuracy:g} m", where=where, fix=fix)
    logger.warning("left out %d of %d fixes less accurate than %g m", int(bad.sum()), len(bad), max_accuracy)
    return table[~bad].reset_index(drop=True)


def tidied(fleet: Fleet, *, max_speed: float | None = None) -> Fleet:
    """Return a fleet without jumps, false headings and speeds, cut where traces left the box or vehicles paused.

    Parameters
    ----------
    fleet
        As read, maybe with columns `ENTERS` and `BY_VEHICLE`.
    max_speed
        m/s; None keeps all fixes.
    """
    traces, points = fleet.traces, fleet.points
    starts = np.zeros(len(traces), bool)
    if ENTERS in traces:
        starts |= traces[ENTERS].eq(True).to_numpy(bool)
    if BY_VEHICLE in traces:
        pause = traces["t"].diff() > pd.Timedelta(_PAUSE, "s")
        starts |= (pause & traces[BY_VEHICLE].eq(True)).to_numpy(bool)
    if marks := [mark for mark in (ENTERS, BY_VEHICLE) if mark in traces]:
        traces, points = cut_traces(traces.drop(columns=marks), points, starts)
    if max_speed is not None:
        traces = _without_jumps(traces, max_speed)
    if "heading" in traces:
        traces = _with_true_headings(traces)
    if "speed" in traces:
        traces = _with_true_speeds(traces)
    if traces is fleet.traces and points is fleet.points:
        return fleet
    return type(fleet)(traces, points, fleet.crs)


def cut_traces(
    traces: pd.DataFrame, points: pd.DataFrame, starts: NDArray[np.bool_]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Cut traces at fixes that start a new one; the pieces of trace 7 are called 7/0, 7/1 and so on.

    Parameters
    ----------
    traces, points
        Tables of a fleet; a point goes with the piece of its time, without time with the first.
    starts
        Fixes that a new trace begins with, shape ``(n_fixes,)``.

    Returns
    -------
    (DataFrame, DataFrame)
        Traces that are not cut keep their ids, which become text if any trace is cut.

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": [7, 7, 8], "t": pd.to_datetime([0, 9, 0], unit="s", utc=True)})
    >>> cut_traces(table, table.iloc[:0], np.array([False, True, False]))[0]["trace_id"].tolist()
    ['7/0', '7/1', '8']
    """
    ids = traces["trace_id"]
    first = np.ones(len(traces), bool)
    first[1:] = ids.array[1:] != ids.array[:-1]
    starts = starts & ~first
    if not starts.any():
        return traces, points
    owner = np.cumsum(first) - 1
    total = np.cumsum(starts)
    piece = total - total[np.flatnonzero(first)][owner]
    is_cut = np.bincount(owner, starts)[owner] > 0
    words = ids.astype(str)
    named = words.where(~is_cut, words + "/" + pd.Series(piece.astype(str), index=words.index))
    logger.info("cut %d traces into %d more", int(np.unique(owner[starts]).size), int(starts.sum()))
    names = points["trace_id"].astype(str)
    for name, rows in traces.assign(piece=named)[is_cut].groupby(words[is_cut], sort=False):
        mine = np.flatnonzero((names == name).to_numpy(bool))
        at = rows["t"].searchsorted(points["t"].iloc[mine], side="right") - 1 if len(mine) else []
        names.iloc[mine] = rows["piece"].to_numpy()[np.clip(at, 0, len(rows) - 1)] if len(mine) else []
    return traces.assign(trace_id=named.astype("str")), points.assign(trace_id=names.astype("str"))


def _steps(traces: pd.DataFrame) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the step to every fix, east and north, and whether the fix before belongs to the same trace."""
    same = np.zeros(len(traces), bool)
    same[1:] = traces["trace_id"].array[1:] == traces["trace_id"].array[:-1]
    east, north = (np.diff(traces[axis].to_numpy(), prepend=np.nan) for axis in "xy")
    return east, north, same


def _without_jumps(traces: pd.DataFrame, max_speed: float) -> pd.DataFrame:
    """Leave out fixes with an impossible step before and after them, in a few rounds for neighbours."""
    n = len(traces)
    for _ in range(10):
        east, north, same = _steps(traces)
        seconds = traces["t"].diff().dt.total_seconds().to_numpy()
        with np.errstate(invalid="ignore", divide="ignore"):
            fast = same & (np.hypot(east, north) > max_speed * seconds)
        behind = np.append(same[1:], False)
        fast_behind = np.append(fast[1:], False)
        jump = (fast | ~same) & (fast_behind | ~behind) & (fast | fast_behind)
        if not jump.any():
            break
        traces = traces[~jump].reset_index(drop=True)
    if len(traces) < n:
        logger.warning(
            "left out %d of %d fixes faster than %g m/s from their neighbours", n - len(traces), n, max_speed
        )
    return traces


def _with_true_headings(traces: pd.DataFrame) -> pd.DataFrame:
    """Set the headings of a trace to unknown that contradict its movement: constants, radians, other zeros."""
    east, north, same = _steps(traces)
    heading: Any = traces["heading"].to_numpy()
    moving = same & (np.hypot(east, north) > _MOVING) & np.isfinite(heading)
    off = np.abs((heading - np.degrees(np.arctan2(east, north)) + 180.0) % 360.0 - 180.0)
    by_trace = pd.Series(off, traces.index)[moving].groupby(traces["trace_id"][moving])
    judged = by_trace.median()[by_trace.size() >= _FEW_STEPS]
    false = judged.index[judged > _CONTRADICTION]
    if len(false) == 0:
        return traces
    shown = ", ".join(map(str, false[:3])) + (", ..." if len(false) > 3 else "")
    logger.warning(
        "headings of %d of %d traces contradict their movement (%s): unknown; they are to be degrees from north",
        *(len(false), len(judged), shown),
    )
    return traces.assign(heading=np.where(traces["trace_id"].isin(false), np.nan, heading))


def _with_true_speeds(traces: pd.DataFrame) -> pd.DataFrame:
    """Convert speeds that are those of the movement in another unit, and warn of those that cannot be in any."""
    east, north, same = _steps(traces)
    step = np.hypot(east, north)
    seconds = traces["t"].diff().dt.total_seconds().to_numpy()
    speed: Any = traces["speed"].to_numpy()
    with np.errstate(invalid="ignore", divide="ignore"):
        usable = same & (step > _MOVING) & (seconds > 0) & (seconds <= _LONGEST_STEP) & (speed > 0)
        ratio = (speed * seconds / step)[usable]
    if len(ratio) < _MANY_STEPS:
        return traces
    low, middle, high = np.quantile(ratio, [0.25, 0.5, 0.75])
    if high - low > 2 * _SPREAD * middle:
        return traces
    for unit, factor in _OTHER_UNITS.items():
        if abs(middle * factor - 1) <= _LIKE:
            logger.warning(
                "speeds are %.2f times those of the movement: taken as %s; say the unit in the name of the column",
                *(middle, unit),
            )
            return traces.assign(speed=speed * factor)
    if not 1 / _IMPLAUSIBLE <= middle <= _IMPLAUSIBLE:
        logger.warning("speeds are %.2f times those of the movement: check their unit", middle)
    return traces
