"""The gray-scale skeleton: a density thinned level by level, from the busiest roads to the quietest."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from probe2road.skeleton import skeletonize

__all__ = ["gray_skeleton"]

logger = logging.getLogger(__name__)

_POOL = 6  # neighbours; a pixel with more is inside an area that thinning could not empty


def gray_skeleton(ranks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Thin the areas above every level, from the highest level down, keeping what higher levels have left.

    Busy roads are thinned first and keep their place; lower levels attach the quieter roads to them.

    Parameters
    ----------
    ranks
        Rank of the highest level that each pixel reaches, shape ``(rows, cols)``; 0 for none.

    Returns
    -------
    ndarray of uint8, shape (rows, cols)
        On the skeleton, the rank of the level at which the pixel appeared; 0 elsewhere.

    Notes
    -----
    METHOD 4.2: Zhang-Suen thinning of what is new at a level; then new pixels with more than six neighbours go, all
    at once. The published program counts in how many levels a pixel is in, which is the same number.

    Examples
    --------
    A busy road of rank 2 along the upper side of an area of rank 1: thinned at once, the area would have its line
    in the middle.

    >>> ranks = np.zeros((9, 9), np.uint8)
    >>> ranks[1:8] = 1
    >>> ranks[1:4] = 2
    >>> gray_skeleton(ranks)[:, 4]
    array([0, 0, 2, 0, 0, 0, 0, 0, 0], dtype=uint8)
    >>> gray_skeleton(np.minimum(ranks, 1))[:, 4]
    array([0, 0, 0, 0, 1, 0, 0, 0, 0], dtype=uint8)
    """
    skeleton = np.zeros(ranks.shape, np.uint8)
    for rank in range(int(ranks.max(initial=0)), 0, -1):
        fixed = skeleton > 0
        thinned = skeletonize(ranks >= rank, method="zhang_suen", fixed=fixed)
        row, col = np.nonzero(thinned & ~fixed)
        new = _neighbours(thinned, row, col) <= _POOL
        skeleton[row[new], col[new]] = rank
    logger.info("gray-scale skeleton of %d pixels", np.count_nonzero(skeleton))
    return skeleton


def _neighbours(mask: NDArray[np.bool_], row: NDArray[np.int64], col: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the set neighbours of pixels."""
    padded = np.pad(mask, 1)
    count = np.zeros(len(row), np.int64)
    for down in range(3):
        for right in range(3):
            if down != 1 or right != 1:
                count += padded[row + down, col + right]
    return count
