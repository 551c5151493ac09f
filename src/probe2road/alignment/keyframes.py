"""From traces to keyframes: the poses that the factor graph moves, the motion between them, and their sightings.

Strategy
--------
Distance and direction are worked out for every fix at once. A keyframe is the first fix in each stretch of so many
metres; a chain is the keyframes of one drive without a gap. There is no odometry in the data, so the motion between
two keyframes is taken twice: from the positions, which follow the filter of the vehicle, and by dead reckoning from
heading and speed. The mean is used, and where the two disagree, as in a multipath burst or a queue, the motion is
trusted by no more than half their difference. Points are fixed to the nearest keyframe of their chain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe2road.alignment.options import AlignOptions
from probe2road.alignment.reckoning import fixes_course, reckoned_steps, wrapped
from probe2road.alignment.screening import rows_of_points
from probe2road.fleet.contract import POINT_KINDS, Fleet, fix_intervals, trace_breaks

__all__ = [
    "Keyframes",
    "Sightings",
    "keyframes",
    "moved_aside",
    "recorded_aside",
    "sightings",
]

_UNKNOWN_SHARE = 0.02  # share of the distance, 1 sigma of the motion without dead reckoning
_TURN_SHARE = 0.15  # share of distance times turn (radians), 1 sigma of the unknown path between sparse fixes
_FIRST_SIGMA = 0.02  # m, least 1 sigma of a motion
_UNSEEN = 0.3  # m/s2, 1 sigma of the unseen acceleration between two fixes, for dead reckoning


@dataclass(frozen=True)
class Keyframes:
    """K keyframes of the fixes of a fleet, in the order of the fixes.

    Angles are radians counter-clockwise from east. A motion belongs to the keyframe that it ends at; it means nothing
    at the first of a chain.
    """

    row: NDArray[np.int64]  # (k,) fix
    drive: NDArray[np.int64]  # (k,) ordinal of the trace
    chain: NDArray[np.int64]  # (k,) ordinal of the unbroken piece
    distance: NDArray[np.float64]  # (k,) m driven; ascending over all drives
    pose: NDArray[np.float64]  # (k, 3) m, m, radians, as recorded
    z: NDArray[np.float64]  # (k,) m, NaN where unknown
    sigma: NDArray[np.float64]  # (k,) m, 1 sigma of the recorded position along one horizontal axis
    motion: NDArray[np.float64]  # (k, 3) m forward, m to the left, radians: from the keyframe before
    motion_sigma: NDArray[np.float64]  # (k, 3)
    fix_distance: NDArray[np.float64]  # (n,) m driven, of every fix

    @property
    def starts(self) -> NDArray[np.int64]:
        """Return the first keyframe of each chain, then the number of keyframes: shape ``(chains + 1,)``."""
        first = np.flatnonzero(np.diff(self.chain, prepend=-1))
        return np.append(first, len(self.chain))

    def inflation(self, options: AlignOptions) -> NDArray[np.float64]:
        """Return the factor on sigmas by which observations with shared errors count as one: shape ``(k,)``."""
        # A keyframe represents the road to the next one. Sparse fixes share less error; a short chain counts as one.
        step = np.diff(self.distance, append=self.distance[-1:])
        starts = self.starts
        length = np.add.reduceat(np.where(np.append(self.first[1:], True), 0.0, step), starts[:-1])
        shared = np.clip(length, options.keyframe_spacing, options.gnss_length)[np.cumsum(self.first) - 1]
        return np.sqrt(shared / np.clip(step, np.minimum(options.keyframe_spacing / 2.0, shared), shared))

    @property
    def first(self) -> NDArray[np.bool_]:
        """Tell which keyframes are the first of their chain: shape ``(k,)``."""
        return np.diff(self.chain, prepend=-1) > 0


@dataclass(frozen=True)
class Sightings:
    """P points attached to keyframes, in the order of the keyframes."""

    keyframe: NDArray[np.int64]  # (p,)
    body: NDArray[np.float64]  # (p, 2) m forward and to the left of the keyframe
    kind: NDArray[np.int8]  # (p,) index into POINT_KINDS


def recorded_aside(frames: Keyframes, pose: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far left of its pose each keyframe was recorded, m, given the directions of roads (radians)."""
    east, north = (frames.pose[:, :2] - pose[:, :2]).T
    return np.asarray(np.cos(angle) * north - np.sin(angle) * east)


def moved_aside(
    pose: NDArray[np.float64], angle: NDArray[np.float64], shift: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return poses moved to the left (m) of the directions of their roads (radians)."""
    return pose + np.column_stack([-shift * np.sin(angle), shift * np.cos(angle), np.zeros(len(pose))])


def keyframes(fleet: Fleet, options: AlignOptions) -> Keyframes:
    """Choose the keyframes of a fleet and measure the motion between them.

    Parameters
    ----------
    fleet
        The fleet; every trace gives a keyframe or more.
    options
        Says how far apart they are and how well motion is known.

    Returns
    -------
    Keyframes

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(11), "x": 446e3 + 10.0 * np.arange(11), "y": 4636e3})
    >>> frames = keyframes(fleet_from_tables(table, crs="EPSG:32616"), AlignOptions(keyframe_spacing=50.0))
    >>> frames.distance.tolist(), frames.motion[1].tolist()
    ([0.0, 50.0, 100.0], [50.0, 0.0, 0.0])
    """
    traces = fleet.traces
    xy = traces[["x", "y"]].to_numpy(np.float64)
    breaks = trace_breaks(fleet)
    theta = fixes_course(fleet, breaks)
    reckoned = reckoned_steps(fleet, theta, breaks)
    step = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    known = np.isfinite(reckoned).all(axis=1)
    # While a vehicle stands its position wanders; its wheels do not turn.
    step = np.where(known, np.minimum(step, np.hypot(*np.nan_to_num(reckoned).T) + 0.1 * step), step)
    step[breaks] = 0.0
    unseen = np.where(known, _UNSEEN / 2.0 * fix_intervals(traces["t"]) ** 2, 0.0)
    distance = np.cumsum(step)

    chain = np.cumsum(breaks) - 1
    chosen = _chosen(distance, chain, options.keyframe_spacing)
    row = np.flatnonzero(chosen)
    pose = np.column_stack([xy[row], theta[row]])
    motion, sigma = _motions(pose, distance[row], reckoned, unseen, row, chain[row], options)
    accuracy = traces["accuracy"].to_numpy(np.float64) if "accuracy" in traces else np.full(len(traces), np.nan)
    return Keyframes(
        row, fleet.owner[row], chain[row], distance[row], pose, traces["z"].to_numpy(np.float64)[row],
        np.where(accuracy > 0, accuracy, options.gnss_sigma)[row], motion, sigma, distance,
    )  # fmt: skip


def sightings(fleet: Fleet, frames: Keyframes) -> Sightings:
    """Attach the points of a fleet to the nearest keyframes along their drives.

    Points that no fix accounts for are left out.
    """
    rows = rows_of_points(fleet)
    seen = np.flatnonzero(rows >= 0)
    rows = rows[seen]
    frame = _nearest_keyframe(frames, rows)
    order = np.argsort(frame, kind="stable")
    seen, frame = seen[order], frame[order]
    world = fleet.points[["x", "y"]].to_numpy(np.float64)[seen]
    x, y, theta = frames.pose[frame].T
    east, north, cos, sin = world[:, 0] - x, world[:, 1] - y, np.cos(theta), np.sin(theta)
    body = np.column_stack([cos * east + sin * north, cos * north - sin * east])
    kind = fleet.points["kind"].cat.set_categories(POINT_KINDS).cat.codes.to_numpy(np.int8)[seen]
    return Sightings(frame, body, kind)


def _chosen(distance: NDArray[np.float64], chain: NDArray[np.int64], spacing: float) -> NDArray[np.bool_]:
    """Choose as keyframes the first and last fix of each chain, and the first fix in each interval of the spacing."""
    first = np.flatnonzero(np.diff(chain, prepend=-1))
    stretch = np.floor((distance - distance[first][chain]) / spacing + 1e-9)
    chosen = np.diff(stretch, prepend=-1.0) != 0
    chosen[first] = True
    chosen[np.append(first[1:], len(chain)) - 1] = True
    return chosen


def _motions(
    pose: NDArray[np.float64],
    distance: NDArray[np.float64],
    reckoned: NDArray[np.float64],
    unseen: NDArray[np.float64],
    row: NDArray[np.int64],
    chain: NDArray[np.int64],
    options: AlignOptions,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the motion from the keyframe before to each keyframe, in the frame of the former, and sigmas: (k, 3)."""
    total = np.vstack([np.zeros(2), np.cumsum(np.nan_to_num(reckoned), axis=0)])
    unknown = np.concatenate([[0], np.cumsum(~np.isfinite(reckoned).all(axis=1))])
    before = np.maximum(np.arange(len(row)) - 1, 0)
    moved = pose[:, :2] - pose[before, :2]
    integrated = total[row + 1] - total[row[before] + 1]
    has_both = unknown[row + 1] == unknown[row[before] + 1]
    integrated = np.where(has_both[:, None], integrated, moved)
    cos, sin = np.cos(pose[before, 2]), np.sin(pose[before, 2])
    both = [
        np.column_stack([cos * leg[:, 0] + sin * leg[:, 1], cos * leg[:, 1] - sin * leg[:, 0]])
        for leg in (moved, integrated)
    ]
    turn = wrapped(pose[:, 2] - pose[before, 2])
    length = np.abs(distance - distance[before])
    share = np.where(has_both, options.odometry_share, _UNKNOWN_SHARE) + _TURN_SHARE * np.abs(turn) * (length > 50.0)
    apart = np.abs(both[0] - both[1]) / 2.0
    doubt = np.concatenate([[0.0], np.cumsum(unseen**2)])
    between = np.where(has_both, doubt[row + 1] - doubt[row[before] + 1], 0.0)
    sigma = np.sqrt((_FIRST_SIGMA + share * length)[:, None] ** 2 + apart**2 + between[:, None])
    turn_sigma = np.radians(options.odometry_heading) * np.sqrt(1.0 + length / 100.0) + np.where(has_both, 0.0, 0.01)
    motion = np.column_stack([(both[0] + both[1]) / 2.0, turn])
    first = np.diff(chain, prepend=-1) > 0
    motion[first] = 0.0
    return motion, np.column_stack([sigma, turn_sigma])


def _nearest_keyframe(frames: Keyframes, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the nearest keyframe of the same chain along the drive, for each fix."""
    before = np.searchsorted(frames.row, rows, side="right") - 1
    after = np.minimum(before + 1, len(frames.row) - 1)
    at = frames.fix_distance[rows]
    nearer = (frames.distance[after] - at < at - frames.distance[before]) & (
        frames.chain[after] == frames.chain[before]
    )
    return np.where(nearer, after, before)
