"""Anchoring: roads moved back to their recorded positions where alignment has moved all their drives away.

Registration compares each drive with all others, so it finds a drive that lies a lane aside and not a road whose drives
lie there together, as they may where another road joins: they agree, and none leaves alone. One drive says little about
where the road is, its receiver is off by metres; the median of thirty is known to half a metre.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from probe2road.alignment.floors import middles
from probe2road.alignment.keyframes import Keyframes, moved_aside, recorded_aside
from probe2road.alignment.options import AlignOptions
from probe2road.alignment.profiles import RoadPlaces

__all__ = ["anchored"]

_DOUBT = 3.0  # standard errors of the middle of all recorded positions
_LEAST = 1.5  # m, about half a lane; a road may be wrong by less, because drives share errors of GNSS
_AROUND = 11  # keyframes of a chain over which moves are smoothed


def anchored(
    frames: Keyframes,
    pose: NDArray[np.float64],
    angle: NDArray[np.float64],
    home: NDArray[np.int64],
    places: RoadPlaces,
    options: AlignOptions,
    *,
    held: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Move roads back if they lie further from the median of their recorded positions than GNSS errors explain.

    Parameters
    ----------
    frames
        The keyframes as recorded.
    pose
        Present poses of the keyframes: x, y (m), direction (radians), shape ``(k, 3)``.
    angle
        Direction of the road at each keyframe, radians, shape ``(k,)``.
    home
        Floor of each keyframe, -1 for none, shape ``(k,)``.
    places
        Neighbours of each floor along the road.
    options
        Only ``min_drives`` is used.
    held
        Keyframes that stay, shape ``(k,)``; so do roads that one of them is on.

    Returns
    -------
    ndarray, shape (k, 3)
        Poses; all on one floor have moved by about the same, to the side only.
    """
    on = np.flatnonzero(home >= 0)
    floor, n = home[on], len(places.before)
    middle, drives = middles(floor, recorded_aside(frames, pose, angle)[on], frames.drive[on], n)
    sigma = np.bincount(floor, frames.sigma[on], n) / np.maximum(np.bincount(floor, minlength=n), 1)
    doubt = _DOUBT * sigma / np.sqrt(np.maximum(drives, 1))
    moved_away = (np.abs(middle) > np.maximum(doubt, _LEAST)) & (drives >= options.min_drives)
    wanted, beside_held = np.zeros(len(pose)), np.zeros(len(pose), bool)
    wanted[on] = np.where(moved_away, middle, 0.0)[floor]
    has_held = np.append(np.bincount(floor, held[on], n) > 0, False)  # the last one is no floor
    beside_held[on] = (has_held[:-1] | has_held[places.before] | has_held[places.after])[floor]
    shift = np.where(held, 0.0, _smoothed(wanted, beside_held, frames.starts))
    return moved_aside(pose, angle, shift)


def _smoothed(values: NDArray[np.float64], fixed: NDArray[np.bool_], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the running median, then mean, of the values of each chain; 0 around keyframes that are fixed."""
    smooth = values.copy()
    for begin, end in pairwise(starts):
        part = values[begin:end]
        if part.any():
            free = ~maximum_filter1d(fixed[begin:end], _AROUND, mode="nearest")
            middle = median_filter(part, _AROUND, mode="nearest") * free
            smooth[begin:end] = uniform_filter1d(middle, _AROUND, mode="nearest") * free
    return smooth
