"""Places where a predicted mask breaks the connectivity of its reference, and every pixel's nearness to them.

Strategy
--------
The weights of the connectivity-preserving loss need, for every image of every training step, a skeleton of the
prediction, one of the reference, and two exact Euclidean distance transforms. The distances come from two passes.
Along columns the distance to the nearest set pixel is a running count, downwards and then upwards. Along a row a
set pixel ``g`` away from column ``s`` is at ``g^2 + (c - s)^2`` from column ``c``; the minimum over ``s`` of
``(g^2 + s^2) - 2 c s`` is the lower convex hull of the points ``(s, g^2 + s^2)`` touched by a line of slope
``2 c``, so that whole numbers and no division are needed (Felzenszwalb and Huttenlocher, "Distance transforms of
sampled functions", 2012, draw the same envelope as parabolas).

Nothing here holds Python's global lock while it computes, so that a pool of threads works on all images of a
batch at once: first the skeletons of every image, then all distance transforms, two an image.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.errors import InputError, OptionError
from probe2road.vectorize.skeleton import Method, skeletonize

__all__ = ["Buffer", "WrongSkeletons", "connectivity_weights", "dilate", "distances", "proximity", "wrong_skeletons"]

Buffer = Literal["2x2", "3x3"]


@dataclass(frozen=True)
class WrongSkeletons:
    """The parts of the skeletons of a prediction and a reference that contradict each other.

    Attributes
    ----------
    missed
        Reference skeleton outside the buffer of the predicted one: SkelfG of METHOD 2. Shape ``(rows, cols)``.
    ghost
        Predicted skeleton outside the buffer of the reference: SkelfP. Shape ``(rows, cols)``.
    """

    missed: NDArray[np.bool_]
    ghost: NDArray[np.bool_]


def dilate(mask: NDArray[np.bool_], buffer: Buffer) -> NDArray[np.bool_]:
    """Dilate a mask by the structuring element of the buffer; pixels beyond the array are lost.

    Parameters
    ----------
    mask
        Shape ``(rows, cols)``.
    buffer
        ``2x2`` grows towards low rows and columns only, the convention of scipy and scikit-image; ``3x3`` grows by
        one pixel all around.

    Returns
    -------
    ndarray of bool, shape (rows, cols)

    Raises
    ------
    OptionError
        If the buffer is unknown.

    Examples
    --------
    >>> mask = np.zeros((3, 4), bool)
    >>> mask[1, 2] = True
    >>> dilate(mask, "2x2").astype(int)
    array([[0, 1, 1, 0],
           [0, 1, 1, 0],
           [0, 0, 0, 0]])
    """
    if buffer not in get_args(Buffer):
        raise OptionError(f"buffer is {buffer!r}", where="dilate", fix=f"use one of {', '.join(get_args(Buffer))}")
    grown = mask.copy()
    grown[:-1] |= mask[1:]
    if buffer == "3x3":
        grown[1:] |= mask[:-1]
    tall = grown.copy()
    grown[:, :-1] |= tall[:, 1:]
    if buffer == "3x3":
        grown[:, 1:] |= tall[:, :-1]
    return grown


def wrong_skeletons(
    prediction: NDArray[Any], reference: NDArray[Any], *, buffer: Buffer = "2x2", thinning: Method = "zhang_suen"
) -> WrongSkeletons:
    """Find the missed parts of a reference's skeleton, and the ghosts: wrong parts of a prediction's skeleton.

    Both masks are thinned, so that a reference may be a line of any width. Where one of them is empty, the whole
    skeleton of the other is wrong.

    Parameters
    ----------
    prediction, reference
        Masks of shape ``(rows, cols)``; everything that is not zero is road.
    buffer
        What a skeleton may deviate, see `dilate`. With ``2x2``, the paper's, a line that is off by one pixel
        contradicts in one of the two sets, depending on the side; with ``3x3`` it does not.
    thinning
        The source thins with ``zhang_suen``; with ``guo_hall``, thinning for the road graph is imitated instead.

    Returns
    -------
    WrongSkeletons

    Raises
    ------
    InputError
        If the shapes differ or are not those of one image.
    OptionError
        If the buffer or the thinning is unknown.

    Notes
    -----
    METHOD 2.1 steps 2 and 3, with the dilation of METHOD 2.4 in place of ``far_region``.

    Examples
    --------
    A hole of three pixels, of which the buffer forgives the ends, and a prediction of nothing:

    >>> reference = np.zeros((5, 9), bool)
    >>> reference[2] = True
    >>> prediction = reference.copy()
    >>> prediction[2, 3:6] = False
    >>> wrong_skeletons(prediction, reference, buffer="3x3").missed[2].astype(int)
    array([0, 0, 0, 0, 1, 0, 0, 0, 0])
    >>> bool(wrong_skeletons(np.zeros_like(reference), reference).missed[2].all())
    True
    """
    if np.shape(prediction) != np.shape(reference):
        shapes = f"the prediction has shape {np.shape(prediction)}, the reference {np.shape(reference)}"
        raise InputError(shapes, where="wrong_skeletons", fix="use one grid for both")
    predicted = skeletonize(prediction, method=thinning)
    wanted = skeletonize(reference, method=thinning)
    return WrongSkeletons(wanted & ~dilate(predicted, buffer), predicted & ~dilate(wanted, buffer))


def distances(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the exact Euclidean distance of every pixel to the nearest set pixel.

    Parameters
    ----------
    mask
        Shape ``(rows, cols)``.

    Returns
    -------
    ndarray of float32, shape (rows, cols)
        Pixels; infinite everywhere if the mask is empty.

    Examples
    --------
    >>> distances(np.array([[True, False, False], [False, False, False]]))
    array([[0.       , 1.       , 2.       ],
           [1.       , 1.4142135, 2.236068 ]], dtype=float32)
    >>> distances(np.zeros((1, 2), bool))
    array([[inf, inf]], dtype=float32)
    """
    if not mask.any():
        return np.full(mask.shape, np.inf, np.float32)
    far = sum(mask.shape)
    return _distances_along_rows(_distances_along_columns(mask, far), far)


def proximity(mask: NDArray[np.bool_], *, sigma: float = 100.0) -> NDArray[np.float32]:
    """Return ``exp(-distance / sigma)`` to the nearest set pixel: 1 on the mask, 0 everywhere if it is empty.

    Parameters
    ----------
    mask
        Shape ``(rows, cols)``.
    sigma
        Pixels.

    Returns
    -------
    ndarray of float32, shape (rows, cols)

    Raises
    ------
    OptionError
        If sigma is not positive.

    Notes
    -----
    METHOD 2.1 step 4. The source calls it Gaussian, but there is no square in it.

    Examples
    --------
    >>> proximity(np.arange(201)[None] == 0)[0, [0, 10, 50, 100, 200]].round(3)
    array([1.   , 0.905, 0.607, 0.368, 0.135], dtype=float32)
    """
    if not sigma > 0:
        raise OptionError(f"sigma is {sigma} pixels", where="proximity", fix="use pixels above 0")
    near = distances(mask)
    near /= np.float32(-sigma)
    return np.exp(near, out=near)


def connectivity_weights(
    predictions: NDArray[Any],
    references: NDArray[Any],
    *,
    sigma: float = 100.0,
    buffer: Buffer = "2x2",
    thinning: Method = "zhang_suen",
    pool: Executor | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the two weights of the connectivity-preserving loss for a batch of images.

    Parameters
    ----------
    predictions, references
        Masks of shape ``(images, rows, cols)``; everything that is not zero is road.
    sigma
        Reach of a wrong place, pixels.
    buffer, thinning
        As for `wrong_skeletons`.
    pool
        Threads to spread the work over; it is done one by one where None. The result is the same.

    Returns
    -------
    missed, wrong
        Arrays of float32, shape ``(images, rows, cols)``: the proximity to missed reference, and to anything wrong
        (wG and w of METHOD 2). Images without wrong skeletons have weight 0 everywhere.

    Raises
    ------
    InputError
        If the shapes differ or are not those of a batch of images.
    OptionError
        If sigma, buffer or thinning is not possible.

    Examples
    --------
    >>> reference = np.zeros((1, 5, 9), bool)
    >>> reference[0, 2] = True
    >>> missed, wrong = connectivity_weights(np.roll(reference, 2, axis=1), reference)
    >>> missed[0, :, 0].round(2), wrong[0, :, 0].round(2)
    (array([0.98, 0.99, 1.  , 0.99, 0.98], dtype=float32), array([0.98, 0.99, 1.  , 0.99, 1.  ], dtype=float32))
    """
    if np.ndim(predictions) != 3 or np.shape(predictions) != np.shape(references):
        shapes = f"the predictions have shape {np.shape(predictions)}, the references {np.shape(references)}"
        raise InputError(shapes, where="connectivity_weights", fix="pass two arrays of shape (images, rows, cols)")
    spread = map if pool is None else pool.map
    wrong = list(spread(partial(wrong_skeletons, buffer=buffer, thinning=thinning), predictions, references))
    sets = [image.missed for image in wrong] + [image.ghost for image in wrong]
    near = np.empty((2, *np.shape(predictions)), np.float32)
    for number, weight in enumerate(spread(partial(proximity, sigma=sigma), sets)):
        near[divmod(number, len(wrong))] = weight
    np.maximum(near[0], near[1], out=near[1])  # the nearest pixel of both sets is the nearer of their nearest
    return near[0], near[1]


@njit(cache=True, nogil=True)
def _distances_along_columns(mask: NDArray[np.bool_], far: int) -> NDArray[np.int32]:
    """Return the distance to the nearest set pixel of the same column; at least ``far`` if there is none."""
    rows, cols = mask.shape
    gap = np.empty((rows, cols), np.int32)
    for col in range(cols):
        gap[0, col] = 0 if mask[0, col] else far
    for row in range(1, rows):
        for col in range(cols):
            gap[row, col] = 0 if mask[row, col] else gap[row - 1, col] + 1
    for row in range(rows - 2, -1, -1):
        for col in range(cols):
            gap[row, col] = min(gap[row, col], gap[row + 1, col] + 1)
    return gap


@njit(cache=True, nogil=True)
def _distances_along_rows(gap: NDArray[np.int32], far: int) -> NDArray[np.float32]:
    """Return the distance to the nearest set pixel, given the distances along columns; one pixel must be set."""
    rows, cols = gap.shape
    distance = np.empty((rows, cols), np.float32)
    site, height = np.empty(cols, np.int64), np.empty(cols, np.int64)  # vertices of the hull, left to right
    for row in range(rows):
        n = 0
        for col in range(cols):
            if gap[row, col] >= far:
                continue
            new = np.int64(gap[row, col]) ** 2 + col * col
            while n >= 2 and (height[n - 1] - height[n - 2]) * (col - site[n - 1]) >= (new - height[n - 1]) * (
                site[n - 1] - site[n - 2]
            ):
                n -= 1  # the last vertex lies above the line from the one before it to the new one
            site[n], height[n] = col, new
            n += 1
        nearest = 0
        for col in range(cols):
            while nearest + 1 < n and height[nearest + 1] - height[nearest] <= 2 * col * (
                site[nearest + 1] - site[nearest]
            ):
                nearest += 1
            distance[row, col] = np.sqrt(np.float32(height[nearest] - 2 * col * site[nearest] + col * col))
    return distance
