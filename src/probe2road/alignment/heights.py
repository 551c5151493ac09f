"""Heights of aligned drives: a linear problem, solved after the plan because nothing in the plan depends on it.

Strategy: roll and pitch are not in the data, so a point says nothing about the height of its keyframe that the drive
does not say itself. Each keyframe has one unknown, each floor another (the road's height there above the spine).
Motion ties keyframes of a drive, floors tie drives, GNSS pulls weakly. A drive's error about its floors, like that of
GNSS, counts once in each kilometre, so that one wrong floor does not bend all of a drive. The sparse normal equations
are solved three times, with weights that let bursts and wrong floors go.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

from probe2road.alignment.keyframes import Keyframes
from probe2road.alignment.options import AlignOptions

__all__ = ["VERTICAL", "solve_heights"]

VERTICAL = 1.6  # vertical over horizontal error of GNSS under open sky
_FLOOR_SIGMA = 0.1  # m, 1 sigma of a drive about the heights of its floors
_FLOOR_KERNEL = 1.0  # sigmas beyond which a floor counts less
_CHANGE_SIGMA = 0.05  # m, least 1 sigma of the change of height between keyframes
_KERNEL = 2.0  # sigmas of one fix beyond which GNSS counts less (Cauchy)
_ROUNDS = 3


def solve_heights(
    frames: Keyframes,
    floor: NDArray[np.int64],
    ground: NDArray[np.float64],
    options: AlignOptions,
    *,
    held: NDArray[np.bool_],
    start: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Find heights on which the drives of each floor agree.

    Parameters
    ----------
    frames
        Keyframes with recorded heights.
    floor
        Of each keyframe, or any other place whose keyframes have one height; -1 where it has none: shape ``(k,)``.
    ground
        Height of the spine at each keyframe, m, shape ``(k,)``.
    options
        The sigmas.
    held
        Keyframes whose height does not change, shape ``(k,)``.
    start
        Heights that are nearly right, m, shape ``(k,)``: what contradicts them counts less from the first round on.

    Returns
    -------
    ndarray, shape (k,)
        Metres; NaN where the keyframe had none.
    """
    known = np.flatnonzero(np.isfinite(frames.z))
    if len(known) == 0:
        return frames.z.copy()
    column = np.full(len(frames.z), -1)
    column[known] = np.arange(len(known))
    pair = np.flatnonzero(~frames.first & np.isfinite(frames.z) & np.isfinite(np.roll(frames.z, 1)))
    step = frames.distance[pair] - frames.distance[pair - 1]
    on = known[floor[known] >= 0]
    floors, floor_index = np.unique(floor[on], return_inverse=True)
    n = len(known) + len(floors)

    rows = [
        _difference(column[pair], column[pair - 1], n),
        _difference(column[on], len(known) + floor_index, n),
        csr_matrix((np.ones(len(known)), (np.arange(len(known)), column[known])), (len(known), n)),
    ]
    wanted = [frames.z[pair] - frames.z[pair - 1], ground[on], frames.z[known]]
    inflation = frames.inflation(options)
    gnss = VERTICAL * frames.sigma[known] * inflation[known]
    gnss[held[known]] = 0.01
    motion = np.hypot(_CHANGE_SIGMA, options.height_share * step)
    sigmas = [motion, _FLOOR_SIGMA * inflation[on], gnss]
    guess = frames.z if start is None else start
    solution = np.concatenate([guess[known], np.bincount(floor_index, (guess - ground)[on]) / np.bincount(floor_index)])
    kernels = (3.0, _FLOOR_KERNEL, _KERNEL / inflation[known])
    for turn in range(_ROUNDS):
        normal, right = csr_matrix((n, n)), np.zeros(n)
        for matrix, target, sigma, kernel in zip(rows, wanted, sigmas, kernels, strict=True):
            off = (matrix @ solution - target) / sigma / kernel
            weight = sigma**-2.0 / (1.0 + (off**2 if turn or start is not None else 0.0))
            normal = normal + matrix.T @ diags(weight) @ matrix
            right += matrix.T @ (weight * target)
        solution = spsolve((normal + diags(np.full(n, 1e-9))).tocsc(), right)
    heights = frames.z.copy()
    heights[known] = np.where(held[known], frames.z[known], solution[: len(known)])
    return heights


def _difference(one: NDArray[np.int64], other: NDArray[np.int64], n: int) -> csr_matrix:
    """Return the matrix whose rows give unknown ``one`` minus unknown ``other``."""
    row = np.arange(len(one))
    values = np.concatenate([np.ones(len(one)), -np.ones(len(one))])
    return csr_matrix((values, (np.concatenate([row, row]), np.concatenate([one, other]))), (len(one), n))
