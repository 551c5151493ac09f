"""Routes: drives that are certainly on one road, whose heights are averaged before decks are separated.

Strategy
--------
One drive's height from GNSS is off by as much as two decks lie apart, the mean of ten is not. Drives that came from one
road and leave for one road are on one road in between; drives that part sideways somewhere may be on different ones. So
the drives on a spine are divided by the spine that they come from and the one that they go to. Where two decks lie
above each other all along there is nothing to divide by but height itself: a class is split in two where its heights
fall into two groups that are further apart than the errors of single drives explain.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from probe2road.alignment.heights import VERTICAL, solve_heights
from probe2road.alignment.keyframes import Keyframes
from probe2road.alignment.options import AlignOptions
from probe2road.alignment.spines import OnSpines, Spines

__all__ = ["route_heights", "routes", "split_decks"]

_LEAST_GAIN = 0.65, 4.0  # gain in log-likelihood that two groups need over one: for each drive, and in total
_LEAST_DRIVES = 3  # in the smaller group


def route_heights(
    frames: Keyframes, on: OnSpines, spines: Spines, options: AlignOptions, *, held: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Move the heights of the drives on each route to their common mean.

    Parameters
    ----------
    frames
        The keyframes.
    on
        Where they are on the spines.
    spines
        The spines.
    options
        Sigmas, and the gate beyond which heights are of different decks.
    held
        Keyframes whose height does not change, shape ``(k,)``.

    Returns
    -------
    ndarray, shape (k,)
        Metres, as recorded heights are; NaN where the height or the spine is not known, 0 where no drive has heights.
    """
    if not np.isfinite(frames.z).any():
        return np.zeros(len(frames.z))
    ground = spines.z[np.maximum(on.station, 0)]
    route = routes(frames, on, spines)
    height = solve_heights(frames, _places(on, route), ground, options, held=held)
    route = split_decks(route, frames.drive, frames.z - height, VERTICAL * frames.sigma, options.altitude_gate)
    height = solve_heights(frames, _places(on, route), ground, options, held=held)
    return np.where(on.station >= 0, height, np.nan)


def _places(on: OnSpines, route: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the piece of a route, two cells long, that each keyframe is on: shape ``(k,)``, -1 for none."""
    _, place = np.unique(np.column_stack([on.cell // 2, route]), axis=0, return_inverse=True)
    return np.where(route >= 0, place.ravel(), -1)


def routes(frames: Keyframes, on: OnSpines, spines: Spines) -> NDArray[np.int64]:
    """Return the route of each keyframe: a route is one spine, with the same spine before and the same one after.

    Parameters
    ----------
    frames
        The keyframes.
    on
        Where they are on the spines.
    spines
        The spines.

    Returns
    -------
    ndarray of int64, shape (k,)
        0 or more; -1 where a keyframe is on no spine.
    """
    spine = spines.spine_of(on.cell)
    spine = _without_flickers(spine, frames.chain)
    new = (np.diff(spine, prepend=-2) != 0) | frames.first
    run = np.cumsum(new) - 1
    of_run, chain = spine[new], frames.chain[new]
    before = np.where(np.diff(chain, prepend=-1) == 0, np.roll(of_run, 1), -1)
    after = np.where(np.diff(chain, append=-1) == 0, np.roll(of_run, -1), -1)
    _, route = np.unique(np.column_stack([of_run, before, after]), axis=0, return_inverse=True)
    return np.where(spine >= 0, route.ravel()[run], -1)


def _without_flickers(spine: NDArray[np.int64], chain: NDArray[np.int64]) -> NDArray[np.int64]:
    """Replace the spine of a keyframe by that of its two neighbours, if these have the same one."""
    before, after = np.roll(spine, 1), np.roll(spine, -1)
    same = (np.roll(chain, 1) == chain) & (np.roll(chain, -1) == chain)
    return np.where(same & (before == after), before, spine)


def split_decks(
    route: NDArray[np.int64],
    drive: NDArray[np.int64],
    residual: NDArray[np.float64],
    sigma: NDArray[np.float64],
    gate: float,
) -> NDArray[np.int64]:
    """Split routes whose drives form two groups by height.

    Parameters
    ----------
    route
        Of each keyframe, -1 where there is none, shape ``(k,)``.
    drive
        Of each keyframe, shape ``(k,)``.
    residual
        Recorded height less the mean height of the route at the place, m, shape ``(k,)``; NaN where unknown.
    sigma
        Error of a drive's mean height over the route, m, shape ``(k,)``.
    gate
        Groups that are nearer than this are not split, m.

    Returns
    -------
    ndarray of int64, shape (k,)
        The routes; of one that was split, the upper deck has a number of its own.

    Examples
    --------
    Eight drives with errors of 1 m, on two decks that lie 5 m apart:

    >>> off = np.array([-3.1, -2.5, -1.6, -2.8, 2.4, 3.3, 1.9, 2.7])
    >>> split_decks(np.zeros(8, int), np.arange(8), off, np.ones(8), 3.0).tolist()
    [0, 0, 0, 0, 1, 1, 1, 1]
    >>> split_decks(np.zeros(8, int), np.arange(8), off, np.full(8, 3.0), 3.0).tolist()
    [0, 0, 0, 0, 0, 0, 0, 0]
    """
    known = np.flatnonzero((route >= 0) & np.isfinite(residual))
    pairs, index = np.unique(np.column_stack([route[known], drive[known]]), axis=0, return_inverse=True)
    index = index.ravel()
    n = np.bincount(index)
    off, error = np.bincount(index, residual[known]) / n, np.bincount(index, sigma[known]) / n
    upper = np.zeros(len(pairs), bool)
    starts = np.append(np.flatnonzero(np.diff(pairs[:, 0], prepend=-1)), len(pairs))
    for begin, end in pairwise(starts):
        upper[begin:end] = off[begin:end] > _threshold(off[begin:end], error[begin:end], gate)
    split = route.copy()
    split[known] = np.where(upper[index], route.max(initial=-1) + 1 + route[known], route[known])
    return split


def _threshold(off: NDArray[np.float64], sigma: NDArray[np.float64], gate: float) -> float:
    """Return the height that separates values into two groups, infinity if one group explains them."""
    order = np.argsort(off)
    values, weight = off[order], 1.0 / sigma[order] ** 2
    if len(values) < 2 * _LEAST_DRIVES:
        return np.inf
    total, mass = np.cumsum(weight * values), np.cumsum(weight)
    low, high = total[:-1] / mass[:-1], (total[-1] - total[:-1]) / (mass[-1] - mass[:-1])
    gain = 0.5 * (high - low) ** 2 * mass[:-1] * (mass[-1] - mass[:-1]) / mass[-1]
    size = np.arange(1, len(values))
    allowed = (size >= _LEAST_DRIVES) & (len(values) - size >= _LEAST_DRIVES) & (high - low > gate)
    gain = np.where(allowed, gain, 0.0)
    best = int(np.argmax(gain))
    enough = gain[best] > _LEAST_GAIN[0] * len(values) + _LEAST_GAIN[1]
    return float((values[best] + values[best + 1]) / 2.0) if enough else np.inf
