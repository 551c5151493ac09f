"""The gray-scale skeleton: a density thinned level by level, from the busiest roads to the quietest.

Strategy
--------
One image is thinned again and again. The pixels with any density are listed once, from the highest rank down, so that
those of a level are the first of the list: they are set, thinned, and what is left is fixed. Nothing but the
thinning itself looks at the whole image, and that writes to no pixel that was never set.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from probe2road.vectorize.skeleton import FIXED, SET, skeleton_pixels, thin_state

__all__ = ["gray_skeleton"]

logger = logging.getLogger(__name__)

_POOL = 6  # neighbours; a pixel with more is inside an area that thinning could not empty


def gray_skeleton(ranks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Thin the areas above every density level, from the highest level down, and keep the skeletons of higher levels.

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
    state = np.zeros((ranks.shape[0] + 2, ranks.shape[1] + 2), np.uint8)
    pixels = state.reshape(-1)
    row, col = skeleton_pixels(ranks)
    order = np.argsort(ranks[row, col], kind="stable")[::-1]
    row, col = row[order], col[order]
    place, rank_of = (row + 1) * state.shape[1] + col + 1, ranks[row, col]
    skeleton = np.zeros(ranks.shape, np.uint8)
    for rank in range(int(ranks.max(initial=0)), 0, -1):
        above = int(np.searchsorted(-rank_of.astype(np.int64), -rank, side="right"))  # descending, hence the signs
        pixels[place[:above]] |= SET
        thin_state(state, method="zhang_suen")
        new = np.flatnonzero(pixels[place[:above]] == SET)
        pool = _neighbours(pixels, place[new], state.shape[1]) > _POOL
        pixels[place[new[pool]]] = 0
        new = new[~pool]
        pixels[place[new]] = FIXED
        skeleton[row[new], col[new]] = rank
    logger.info("gray-scale skeleton of %d pixels", np.count_nonzero(skeleton))
    return skeleton


def _neighbours(pixels: NDArray[np.uint8], place: NDArray[np.int64], cols: int) -> NDArray[np.int64]:
    """Count the set neighbours of pixels in an image with a given number of columns."""
    count = np.zeros(len(place), np.int64)
    for step in (-cols - 1, -cols, -cols + 1, -1, 1, cols - 1, cols, cols + 1):
        count += pixels[place + step] > 0
    return count
