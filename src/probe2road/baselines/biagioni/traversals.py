"""Which segments the trips drove, by the published matcher, and which runs are good.

Strategy
--------
Trips are interpolated once; every interpolated position is an observation. The matcher gives each its straight
piece and direction, or nothing. Observations in doubt, half a minute before and after a place without a piece, are
left out. What is left of a trip falls into runs: consecutive observations on one segment in one direction. A
run is good where the observations lie close to the segment, and a segment stays where it has enough good runs.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray

from probe2road.baselines.biagioni.street_map import Pieces
from probe2road.fleet.contract import Fleet, TraceGaps, trace_breaks
from probe2road.matching.models import PublishedModel
from probe2road.matching.network import build_states
from probe2road.matching.published import match_published

__all__ = ["Runs", "TripPositions", "good_runs", "match_pieces", "observe_trips"]

logger = logging.getLogger(__name__)

_NO_STEP = 1e12  # m; the observations need no further interpolation


@dataclass(frozen=True)
class TripPositions:
    """The O positions of all trips, at most as far apart as the matcher requires.

    Attributes
    ----------
    fleet
        One fix for each observation; a trip that is broken is one trace for each part.
    trip
        Shape (O,). Number of the trip.
    seconds
        Shape (O,). Time, NaN where the trip has no clock.
    """

    fleet: Fleet
    trip: NDArray[np.int64]
    seconds: NDArray[np.float64]


@dataclass(frozen=True)
class Runs:
    """R good runs of trips along segments, with V observations.

    Attributes
    ----------
    segment, forward
        Shape (R,): row of the segment, and whether it was driven from u to v.
    offsets
        Shape (R + 1,). The observations of run i are ``offsets[i]`` to ``offsets[i + 1]``.
    xy
        Shape (V, 2), m.
    """

    segment: NDArray[np.int64]
    forward: NDArray[np.bool_]
    offsets: NDArray[np.int64]
    xy: NDArray[np.float64]


def observe_trips(fleet: Fleet, *, step: float, gaps: TraceGaps | None = None) -> TripPositions:
    """Interpolate trips linearly, in position and time, to the fewest equal steps of at most ``step`` m.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": [0, 3, 4], "x": [900.0, 925.0, 930.0], "y": 900.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> found = observe_trips(fleet, step=10.0)
    >>> found.fleet.traces["x"].round(1).tolist(), found.seconds.tolist()
    ([900.0, 908.3, 916.7, 925.0, 930.0], [0.0, 1.0, 2.0, 3.0, 4.0])
    """
    breaks = trace_breaks(fleet, gaps)
    time = fleet.traces["t"].to_numpy(dtype="datetime64[ns]")
    known = ~np.isnat(time)
    origin = time[known].min() if known.any() else np.datetime64(0, "ns")
    values = np.stack([fleet.traces["x"], fleet.traces["y"], (time - origin) / np.timedelta64(1, "s")], axis=1)
    moved = np.diff(values, axis=0, prepend=values[:1])
    count = np.where(breaks, 1, np.maximum(np.ceil(np.hypot(moved[:, 0], moved[:, 1]) / step), 1)).astype(np.int64)
    fix = np.repeat(np.arange(len(values)), count)
    left = np.cumsum(count)[fix] - 1 - np.arange(len(fix))  # steps to go to the fix
    x, y, seconds = (values[fix] - (left / count[fix])[:, None] * moved[fix]).T
    traces = pd.DataFrame({"trace_id": np.cumsum(breaks)[fix], "t": pd.NaT, "x": x, "y": y, "z": np.nan})
    return TripPositions(replace(fleet, traces=traces), fleet.owner[fix], seconds)


def match_pieces(
    observations: TripPositions, pieces: Pieces, weight: NDArray[np.float64], model: PublishedModel
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Match every observation to a straight piece.

    Parameters
    ----------
    observations
        From `observe_trips`.
    pieces
        The map.
    weight
        Of every segment, positive: how likely trips turn into it compared with others at the same node.
    model
        The matcher's numbers.

    Returns
    -------
    way, distance
        Shape (O,): twice the row of the piece, plus one where it is driven against its direction, -1 for unknown; and
        the distance to the piece, m, NaN for unknown.
    """
    states = build_states(pieces.graph, respect_oneway=False)
    paths = match_published(observations.fleet, states, weight[pieces.segment], replace(model, step=_NO_STEP))
    way = np.full(len(paths.step), -1)
    known = paths.step >= 0
    way[known] = paths.state[paths.step[known]]
    logger.info("matched %d of %d observations to %d pieces", known.sum(), len(known), len(pieces.segment))
    return way, paths.distance


def good_runs(
    observations: TripPositions,
    pieces: Pieces,
    way: NDArray[np.int64],
    distance: NDArray[np.float64],
    *,
    blackout: float,
    max_error: float,
    last_runs: bool,
) -> Runs:
    """Collect the runs of trips along segments that lie close to them.

    Parameters
    ----------
    observations, pieces
        What was matched.
    way, distance
        From `match_pieces`.
    blackout
        Seconds before and after an unknown observation that are left out of its trip; without a clock, only the
        unknown observations themselves are.
    max_error
        Largest root mean square distance of a good run, m.
    last_runs
        Whether the last run of every trip counts.

    Returns
    -------
    Runs

    Notes
    -----
    METHOD 4.5.
    """
    kept = np.flatnonzero(~_near_unknown(observations.trip, observations.seconds, way < 0, blackout))
    driven = 2 * pieces.segment[way[kept] >> 1] + (way[kept] & 1)
    trip = observations.trip[kept]
    first = (np.diff(driven, prepend=-1) != 0) | (np.diff(trip, prepend=-1) != 0)
    run = np.cumsum(first) - 1
    size = np.bincount(run)
    good = np.sqrt(np.bincount(run, distance[kept] ** 2) / np.maximum(size, 1)) <= max_error
    if not last_runs:
        good &= np.diff(trip[first], append=-1) == 0
    logger.info("%d of %d runs are good", good.sum(), len(good))
    return Runs(
        segment=driven[first][good] >> 1,
        forward=driven[first][good] & 1 == 0,
        offsets=np.concatenate([[0], np.cumsum(size[good])]),
        xy=observations.fleet.traces[["x", "y"]].to_numpy()[kept][good[run]],
    )


@njit(cache=True)
def _near_unknown(
    trip: NDArray[np.int64], seconds: NDArray[np.float64], unknown: NDArray[np.bool_], blackout: float
) -> NDArray[np.bool_]:
    """Mark unknown observations, and those within ``blackout`` s of an unknown one of the same trip."""
    near = unknown.copy()
    for way in (1, -1):
        last = -1
        for k in range(len(trip)):
            place = k if way > 0 else len(trip) - 1 - k
            if unknown[place]:
                last = place
            elif last >= 0 and trip[last] == trip[place] and abs(seconds[place] - seconds[last]) <= blackout:
                near[place] = True
    return near
