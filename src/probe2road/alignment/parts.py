"""The parts of drives that belong together: starts without a position left out, and drives cut where they jump.

Strategy
--------
A receiver that is switched on reports where its network thinks that it is, or where it was last, for a second or two,
and then jumps to where it is. What lies before such a jump and does not move is no part of the drive. A jump later on
parts the drive: both sides may be good, but nothing says how they lie to each other. Reflections jump as well, and
dead reckoning takes them out, so the former is looked for before and the latter after positions are steadied.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.fleet.cleaning import cut_traces
from probe2road.fleet.contract import Fleet
from probe2road.fleet.jumps import position_jumps

__all__ = ["cut_at_jumps", "without_false_starts"]

logger = logging.getLogger(__name__)

_STANDS = 30.0  # m from end to end; a shorter start has not moved


def without_false_starts(fleet: Fleet, trimmed: NDArray[np.bool_]) -> Fleet:
    """Leave out the starts of drives at which the receiver had no position, and the points that were seen until then.

    Parameters
    ----------
    fleet
        The fleet. Not changed.
    trimmed
        Drives that may be trimmed, shape ``(n_traces,)``.

    Returns
    -------
    Fleet
        The same fleet where there is nothing to leave out. Every drive keeps its last fix.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(5), "x": [446e3, 446e3, 446400, 446410, 446420], "y": 4636e3})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616")
    >>> without_false_starts(fleet, np.array([True])).traces["x"].tolist()
    [446400.0, 446410.0, 446420.0]
    """
    first = position_jumps(fleet) & trimmed[fleet.owner]
    if not first.any():
        return fleet
    first[fleet.starts[:-1]] = True
    piece, owner = np.cumsum(first) - 1, fleet.owner[first]
    box = fleet.traces.groupby(piece)[["x", "y"]]
    stands = np.hypot(*(box.max() - box.min()).to_numpy().T) < _STANDS
    stands &= np.append(owner[1:] == owner[:-1], False)  # a jump follows
    begins = pd.Series(stands).groupby(owner).cummin().to_numpy(bool)  # so do all pieces before
    left_out = begins[piece]
    if not left_out.any():
        return fleet
    traces = fleet.traces[~left_out].reset_index(drop=True)
    drives = fleet.ids[np.unique(fleet.owner[left_out])]
    begun = traces.groupby("trace_id", sort=False)["t"].first()[drives]
    seen = (fleet.points["t"] < fleet.points["trace_id"].map(begun)).to_numpy()
    logger.info(
        "trimmed %d of %d drives: %d fixes before the receiver had a position, and %d points seen until then",
        *(len(drives), fleet.n_traces, int(left_out.sum()), int(seen.sum())),
    )
    return replace(fleet, traces=traces, points=fleet.points[~seen].reset_index(drop=True))


def cut_at_jumps(fleet: Fleet, cut: NDArray[np.bool_]) -> tuple[Fleet, NDArray[np.int64]]:
    """Cut drives where their positions jump; the parts of drive 7 are called 7/0, 7/1 and so on.

    Parameters
    ----------
    fleet
        The fleet. Not changed.
    cut
        Drives that may be cut, shape ``(n_traces,)``.

    Returns
    -------
    (Fleet, ndarray of int64)
        The same rows, with other ids where a drive was cut, and the drive that each new one was a part of, shape
        ``(n_parts,)``.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 7, "t": range(4), "x": [446e3, 446010, 446400, 446410], "y": 4636e3})
    >>> parts, drive = cut_at_jumps(fleet_from_tables(table, crs="EPSG:32616"), np.array([True]))
    >>> parts.ids.tolist(), drive.tolist()
    (['7/0', '7/1'], [0, 0])
    """
    jumps = position_jumps(fleet) & cut[fleet.owner]
    traces, points = cut_traces(fleet.traces, fleet.points, jumps)
    parts = replace(fleet, traces=traces, points=points)
    return parts, fleet.owner[parts.starts[:-1]]
