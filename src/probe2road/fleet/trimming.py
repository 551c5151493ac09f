"""Trimming: the ends of drives, which show where somebody lives and works, are left out."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pandas as pd

from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import Fleet

__all__ = ["trim_ends"]

logger = logging.getLogger(__name__)


def trim_ends(fleet: Fleet, metres: float) -> Fleet:
    """Leave out the first and last metres of every trace, and the semantic points that were seen there.

    A trace that is not longer than both ends goes altogether. Metres are counted along the trace, in plan.

    Parameters
    ----------
    fleet
        The fleet.
    metres
        Length of each end, m; 0 returns the fleet.

    Returns
    -------
    Fleet

    Raises
    ------
    OptionError
        If the length is negative.
    InputError
        If nothing would be left.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(5), "x": [0.0, 50, 100, 150, 200], "y": 0.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> trim_ends(fleet, 60.0).traces["x"].tolist()
    [100.0]
    """
    if not metres >= 0:
        raise OptionError(f"trim_ends is {metres}", where="trim_ends", fix="use metres, 0 or more")
    if metres == 0 or fleet.traces.empty:
        return fleet
    place = fleet.traces[["x", "y"]].to_numpy()
    step = np.hypot(*np.diff(place, axis=0, prepend=place[:1]).T)
    step[fleet.starts[:-1]] = 0.0
    driven = np.cumsum(step)
    from_start = driven - driven[fleet.starts[:-1]][fleet.owner]
    to_end = driven[fleet.starts[1:] - 1][fleet.owner] - driven
    kept = (from_start >= metres) & (to_end >= metres)
    if not kept.any():
        raise InputError("no trace is longer than both its ends", where="trim_ends", fix="trim less")
    traces = fleet.traces[kept].reset_index(drop=True)
    points = fleet.points[_seen_between(fleet, traces, metres)].reset_index(drop=True)
    trimmed = replace(fleet, traces=traces, points=points)
    logger.info(
        "trimmed %d fixes and %d semantic points off the ends of %d traces; %d traces are left",
        int((~kept).sum()), len(fleet.points) - len(points), fleet.n_traces, trimmed.n_traces,
    )  # fmt: skip
    return trimmed


def _seen_between(fleet: Fleet, traces: pd.DataFrame, metres: float) -> np.ndarray:
    """Mark the points of the kept part: by their time, or without times by their distance from the ends."""
    if fleet.points.empty:
        return np.zeros(0, bool)
    owner = fleet.points["trace_id"]
    times = traces.groupby("trace_id")["t"].agg(["min", "max"]).reindex(owner)
    t = fleet.points["t"].reset_index(drop=True)
    first, last = (times[name].reset_index(drop=True) for name in ("min", "max"))
    timed = (t.notna() & first.notna()).to_numpy()
    between = ((t >= first) & (t <= last)).to_numpy()
    ends = pd.DataFrame(
        fleet.traces[["x", "y"]]
        .to_numpy()[np.r_[fleet.starts[:-1], fleet.starts[1:] - 1]]
        .reshape(2, -1, 2)
        .transpose(1, 0, 2)
        .reshape(-1, 4),
        index=fleet.ids,
    )
    near = ends.reindex(owner).to_numpy()
    place = np.tile(fleet.points[["x", "y"]].to_numpy(), 2)
    apart = np.hypot(*(place - near).reshape(-1, 2, 2).transpose(2, 0, 1)).min(axis=1)
    left = owner.isin(traces["trace_id"]).to_numpy()
    return left & np.where(timed, between, apart >= metres)
