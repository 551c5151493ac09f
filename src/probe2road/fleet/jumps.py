"""Jumps of the position: steps that no vehicle drives, and the fixes between two of them that lie aside."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.fleet.contract import Fleet, TraceGaps, step_seconds, times_left, trace_breaks

__all__ = ["position_jumps", "stray_fixes", "without_strays"]

logger = logging.getLogger(__name__)

_MOST_STRAYS = 3  # fixes in a row that a trace goes past


def position_jumps(fleet: Fleet, gaps: TraceGaps | None = None) -> NDArray[np.bool_]:
    """Mark the fixes to which no vehicle can have driven from the fix before.

    A gap need not be a jump: behind a tunnel, the drive goes on where it may be by then.

    Parameters
    ----------
    fleet
        The fleet.
    gaps
        What is a jump: a step faster than ``max_speed``, or without clock one that is a gap.

    Returns
    -------
    ndarray of bool, shape (n_fixes,)
        False at the first fix of every trace.

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": [0, 1, 2, 60, 61], "x": [0.0, 9, 409, 809, 818], "y": 0.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> position_jumps(fleet).tolist(), trace_breaks(fleet).tolist()
    ([False, False, True, False, False], [True, False, True, True, False])
    """
    gaps = gaps or TraceGaps()
    step = np.hypot(*(np.diff(fleet.traces[axis].to_numpy(), prepend=np.nan) for axis in "xy"))
    seconds = step_seconds(fleet, gaps)
    within = np.ones(len(step), bool)
    within[fleet.starts[:-1]] = False
    jumps, clockless = within & gaps.too_fast(step, seconds), within & np.isnan(seconds)
    return jumps | (clockless & trace_breaks(fleet, gaps)) if clockless.any() else jumps


def stray_fixes(fleet: Fleet, gaps: TraceGaps | None = None) -> NDArray[np.bool_]:
    """Mark fixes inside a trace that no vehicle can have driven to and back from, between fixes that agree.

    A receiver that sees a reflection jumps aside for a fix or two and comes back. The trace goes on from before to
    behind as if they were not there. At most a third of a trace is marked; where it would be more, its id stands for
    two vehicles, and none is.

    Parameters
    ----------
    fleet
        The fleet.
    gaps
        What is a jump: a step faster than ``max_speed``, or without clock longer than the trace's longest step.

    Returns
    -------
    ndarray of bool, shape (n_fixes,)

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(5), "x": [0.0, 9, 18, 27, 36], "y": [0.0, 0, 400, 0, 0]})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> stray_fixes(fleet).tolist()
    [False, False, True, False, False]
    """
    gaps = gaps or TraceGaps()
    stray = np.zeros(len(fleet.traces), bool)
    x, y = (fleet.traces[axis].to_numpy() for axis in "xy")
    time = fleet.traces["t"].to_numpy(dtype="datetime64[ns]")
    left = times_left(fleet, gaps)
    starts = fleet.starts

    def is_jump(first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell whether no vehicle can have driven from the one fix to the other."""
        step = np.hypot(x[second] - x[first], y[second] - y[first])
        seconds = (time[second] - left[first]) / np.timedelta64(1, "s")
        return np.where(np.isnan(seconds), step > gaps.max_step, gaps.too_fast(step, seconds))

    inside = np.arange(1, len(x))
    inside = inside[fleet.owner[1:] == fleet.owner[:-1]]
    jumps = np.zeros(len(x) + 1, bool)
    jumps[inside] = is_jump(inside - 1, inside)
    owners = fleet.owner[np.flatnonzero(jumps)]
    for trace in np.unique(owners):
        first, stop = int(starts[trace]), int(starts[trace + 1])
        found = _strays_of_trace(jumps, first, stop, is_jump)
        if 3 * len(found) <= stop - first and not _is_coarse(x, y, time, first, stop, gaps):
            stray[found] = True
    return stray


def without_strays(fleet: Fleet, gaps: TraceGaps | None = None, *, silent: bool = False) -> Fleet:
    """Return the fleet without its `stray_fixes`, with a warning; the same fleet where there are none."""
    stray = stray_fixes(fleet, gaps)
    if not stray.any():
        return fleet
    if not silent:
        logger.warning("left out %d of %d fixes that jump aside and back", int(stray.sum()), len(stray))
    return replace(fleet, traces=fleet.traces[~stray].reset_index(drop=True))


def _strays_of_trace(
    jumps: NDArray[np.bool_],
    first: int,
    stop: int,
    is_jump: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.bool_]],
) -> list[int]:
    """Return the fixes of short runs between two jumps whose ends could have been driven past them."""
    found: list[int] = []
    here = first
    while here + 1 < stop:
        behind = here + 1
        if jumps[here + 1]:
            for back in range(here + 2, min(here + 2 + _MOST_STRAYS, stop)):
                if jumps[back]:
                    if not is_jump(np.array([here]), np.array([back]))[0]:
                        found += range(here + 1, back)
                        behind = back
                    break
        here = behind
    return found


def _is_coarse(
    x: NDArray[np.float64], y: NDArray[np.float64], time: NDArray[Any], first: int, stop: int, gaps: TraceGaps
) -> bool:
    """Tell whether a trace without a clock has so long steps that a long step is not a jump."""
    step = np.hypot(np.diff(x[first:stop]), np.diff(y[first:stop]))
    return bool(np.isnat(time[first]) and gaps.step_factor * np.median(step) > gaps.max_step)
