"""What samples show of the cameras of a fleet: all that was recorded, a part of it, or what a poorer camera sees.

The simulator's cameras look far ahead and see markings and boundaries. Many cameras do not: a phone behind the
windscreen sees the two markings of its own lane abreast of the vehicle and no boundary, takes the next lane for its
own at times, and half of a fleet has no camera at all. A network that shall serve them all learns from samples of
each kind, and a channel of the input that is empty is one that it has seen empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe2road.bounds import Share
from probe2road.errors import OptionError
from probe2road.fleet.contract import POINT_KINDS
from probe2road.options import checked

__all__ = ["CameraOptions", "Points", "abreast_markings", "seen_points"]

_MARKING = POINT_KINDS.index("lane_marking")
_LANE = 3.5  # m, width of the lane that a camera sees abreast of its vehicle
_STRETCH = 200.0  # m of a drive over which it sees the same sides, with the same error
_LOST = 0.3  # share of these stretches on which it does not see a side
_WRONG = 0.04  # share of them on which it takes a neighbouring lane for its own
_DRIFT, _NOISE = 0.2, 0.15  # m, 1 sigma of the error of a stretch, and of a single marking


@dataclass(frozen=True)
@checked
class CameraOptions:
    """What is seen in samples; the shares are of the samples, and those left have all that was recorded."""

    without_points: Share = 0.0  # as if no vehicle had a camera
    markings_only: Share = 0.0  # as if cameras did not see boundaries
    abreast_only: Share = 0.0  # as if cameras saw nothing but the markings of their own lane, abreast of the vehicle
    least_drives: Share = 1.0  # share of the drives with a camera in the poorest sample

    def __post_init__(self) -> None:
        """Refuse more samples than there are."""
        total = self.without_points + self.markings_only + self.abreast_only
        if total > 1:
            raise OptionError(f"the shares add up to {total:g}", where="CameraOptions", fix="use shares of 1 in all")


@dataclass(frozen=True)
class Points:
    """Semantic points: p of them."""

    xy: NDArray[np.float32]  # (p, 2) m from the scene's origin
    kind: NDArray[np.int64]  # (p,) position in POINT_KINDS

    def chosen(self, which: NDArray[np.bool_]) -> Points:
        """Return some of the points."""
        return Points(self.xy[which], self.kind[which])


def seen_points(
    recorded: Points,
    xy: NDArray[np.float32],
    breaks: NDArray[np.bool_],
    camera: NDArray[np.bool_],
    rng: np.random.Generator,
    options: CameraOptions,
) -> Points:
    """Choose at random what the cameras of a sample see.

    Parameters
    ----------
    recorded
        The points of the drives that have a camera in this sample.
    xy, breaks
        The fixes of all drives in driving order, ``(f, 2)`` and ``(f,)``: places, and where no segment leads from the
        fix before.
    camera
        Which fixes are of drives with a camera: ``(f,)``.
    rng
        Decides everything that is random.
    options
        How often is what.

    Returns
    -------
    Points
    """
    draw = rng.random() - options.without_points
    if draw < 0:
        return recorded.chosen(np.zeros(len(recorded.kind), bool))
    if draw < options.markings_only:
        return recorded.chosen(recorded.kind == _MARKING)
    if draw < options.markings_only + options.abreast_only:
        return abreast_markings(xy, breaks | ~camera, rng)
    return recorded


def abreast_markings(xy: NDArray[np.float32], breaks: NDArray[np.bool_], rng: np.random.Generator) -> Points:
    """Place lane markings to the left and right of drives, a pair every metre, as a simple camera would see them.

    Over a stretch of a drive the camera loses a side, or is wrong by a lane.

    Parameters
    ----------
    xy, breaks
        Fixes ``(f, 2)`` (m) in driving order, and where no segment leads from the fix before ``(f,)``.
    rng
        Decides everything that is random.

    Returns
    -------
    Points
        Lane markings only; none without a segment.

    Examples
    --------
    >>> straight = np.array([[0, 0], [30, 0]], np.float32)
    >>> seen = abreast_markings(straight, np.array([True, False]), np.random.default_rng(3))
    >>> len(seen.kind), np.unique(np.sign(seen.xy[:, 1])).tolist()
    (60, [-1.0, 1.0])
    """
    end = np.flatnonzero(~breaks)
    step = xy[end] - xy[end - 1]
    length = np.hypot(*step.T)
    end, step, length = end[length > 0], step[length > 0], length[length > 0]
    count = np.ceil(length).astype(np.int64)
    segment = np.repeat(np.arange(len(end)), count)
    along = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    place = xy[end - 1][segment] + (along / length[segment])[:, None] * step[segment]
    left = np.column_stack([-step[:, 1], step[:, 0]])[segment] / length[segment, None]
    stretch = _stretches(end, length)[segment]
    n = int(stretch.max(initial=-1)) + 1
    side = np.array([0.5, -0.5]) * _LANE
    error = rng.normal(0.0, _DRIFT, n) + rng.choice([-_LANE, 0.0, _LANE], n, p=[_WRONG / 2, 1 - _WRONG, _WRONG / 2])
    seen = (rng.random((n, 2)) >= _LOST)[stretch]
    aside = side + error[stretch, None] + rng.normal(0.0, _NOISE, seen.shape)
    marking = place[:, None] + aside[..., None] * left[:, None]
    return Points(marking[seen].astype(np.float32), np.full(int(seen.sum()), _MARKING, np.int64))


def _stretches(end: NDArray[np.int64], length: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the number of the stretch to which each segment belongs, by the fix it ends at and its length."""
    number = np.floor(np.cumsum(length) / _STRETCH)
    begins = (np.diff(end, prepend=-2) != 1) | (np.diff(number, prepend=-1.0) != 0)
    return np.asarray(np.cumsum(begins) - 1, np.int64)
