"""From a mask to a skeleton of one pixel width, in one piece or window by window.

Strategy
--------
Thinning peels pixels off a mask in parallel sub-iterations; whether a pixel goes depends on its eight
neighbours only. Those eight bits index a table of 256 answers, and after the first round only pixels whose
neighbourhood has changed are asked again, so that the work follows the number of removed pixels. A
sub-iteration looks one pixel far, hence a window with a halo of ``2 n`` pixels knows the result of ``n``
iterations without error.
"""

from __future__ import annotations

import logging
from functools import cache
from typing import Any, Literal, get_args, overload

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.errors import InputError, OptionError
from probe2road.raster.blocks import Blocks
from probe2road.raster.grid import sparse_zeros

__all__ = ["FIXED", "METHODS", "SET", "Method", "skeleton_pixels", "skeletonize", "skeletonize_windows", "thin_state"]

logger = logging.getLogger(__name__)

Method = Literal["guo_hall", "zhang_suen"]
METHODS: tuple[Method, ...] = get_args(Method)

_NO_LIMIT = 2**62  # iterations
# Bits of a pixel's state. A fixed pixel is set, too.
_SET, _QUEUED_FIRST, _QUEUED_SECOND, _FIXED = np.uint8(1), np.uint8(2), np.uint8(4), np.uint8(8)
SET, FIXED = _SET, _SET | _FIXED


def skeletonize(mask: NDArray[Any], *, method: Method = "guo_hall") -> NDArray[np.bool_]:
    """Thin a mask to lines one pixel wide.

    With Guo-Hall connected parts stay connected, holes stay holes, and ends of lines are kept. Outside the mask
    is background, so a road that runs off the mask is thinned up to the border as any other. An empty mask
    gives an empty skeleton.

    Parameters
    ----------
    mask
        Shape ``(rows, cols)``; everything that is not zero is road.
    method
        ``guo_hall``, or ``zhang_suen``, which can wear away diagonals and squares two pixels wide.

    Returns
    -------
    ndarray of bool, shape (rows, cols)

    Raises
    ------
    InputError
        If the mask does not have two dimensions.
    OptionError
        If the method is unknown.

    Notes
    -----
    Guo and Hall, "Parallel thinning with two-subiteration algorithms", CACM 1989, algorithm A1 with the condition
    on the eastern neighbour first, as in ``skimage.morphology.thin`` (METHOD 7.1); Zhang and Suen, "A fast
    parallel algorithm for thinning digital patterns", CACM 1984 (METHOD 7.2).

    Examples
    --------
    >>> mask = np.array([[1, 1, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1, 1]])
    >>> skeletonize(mask).astype(int)
    array([[0, 0, 0, 0, 0, 0, 0],
           [0, 1, 1, 1, 1, 1, 0],
           [0, 0, 0, 0, 0, 0, 0]])
    """
    state = _padded_state(mask, 0, 0, *_shape_of(mask), halo=0)
    iterations = _thin(state, _deletion_table(method), _NO_LIMIT, 0)
    skeleton = (state[1:-1, 1:-1] & _SET).astype(bool)
    logger.debug("thinned a mask of %d x %d pixels in %d iterations", *skeleton.shape, iterations)
    return skeleton


@overload
def skeletonize_windows(
    mask: NDArray[Any],
    out: NDArray[np.bool_] | None = None,
    *,
    window: int = 4096,
    halo: int = 64,
    method: Method = "guo_hall",
) -> NDArray[np.bool_]: ...


@overload
def skeletonize_windows(
    mask: Blocks, out: Blocks | None = None, *, window: int = 4096, halo: int = 64, method: Method = "guo_hall"
) -> Blocks: ...


def skeletonize_windows(
    mask: NDArray[Any] | Blocks,
    out: NDArray[np.bool_] | Blocks | None = None,
    *,
    window: int = 4096,
    halo: int = 64,
    method: Method = "guo_hall",
) -> NDArray[np.bool_] | Blocks:
    """Thin a mask window by window; the result is the same, pixel for pixel, as `skeletonize` of the whole mask.

    Every window runs at most half its halo in iterations, so that what it says about its own pixels is exact.
    Where a removal still happens in the last of them the halo is doubled and all windows are done again, once
    for each doubling of the widest part of the mask.

    Parameters
    ----------
    mask
        Shape ``(rows, cols)``, an array, a memory map, or blocks; it is read window by window.
    out
        Boolean array, memory map or blocks of the same shape to write to; a new array, or blocks where the mask is
        in blocks, if it is None. It must not share memory with the mask.
    window
        Side of a window, pixels.
    halo
        Context on every side of a window to begin with, pixels; roads up to about this wide need no second go.
    method
        As for `skeletonize`.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        ``out``.

    Raises
    ------
    InputError
        If the mask does not have two dimensions, or ``out`` has another shape.
    OptionError
        If the window or the halo is too small, or the method is unknown.

    Examples
    --------
    >>> mask = np.ones((9, 30), bool)
    >>> bool((skeletonize_windows(mask, window=8, halo=4) == skeletonize(mask)).all())
    True
    """
    rows, cols = _shape_of(mask)
    if window < 1 or halo < 2:
        raise OptionError(f"window is {window} and halo is {halo}", fix="use at least 1 and 2 pixels")
    if out is None:
        out = Blocks((rows, cols), bool) if isinstance(mask, Blocks) else sparse_zeros((rows, cols), bool)
    if out.shape != (rows, cols):
        raise InputError(f"out has shape {out.shape}, the mask {(rows, cols)}", fix="use the mask's shape")
    while not _thin_windows(mask, out, window, halo, _deletion_table(method)):
        halo *= 2
        logger.info("the mask is wide: thinning again with a halo of %d pixels", halo)
    return out


def thin_state(state: NDArray[np.uint8], *, method: Method = "guo_hall") -> None:
    """Thin an image in place around fixed pixels, for skeletons that grow level by level.

    Parameters
    ----------
    state
        Shape ``(rows, cols)``, C order: 0, `SET`, or `FIXED` for pixels that stay whatever is around them. The
        outermost rows and columns have to be 0. Where large parts are 0, memory that was never written to stays so.
    method
        As for `skeletonize`.

    Examples
    --------
    A road of three pixels is thinned onto its lower side, where a line is fixed:

    >>> state = np.zeros((5, 6), np.uint8)
    >>> state[1:4, 1:5] = SET
    >>> state[3, 1:5] = FIXED
    >>> thin_state(state)
    >>> (state > 0).astype(int)
    array([[0, 0, 0, 0, 0, 0],
           [0, 0, 0, 0, 0, 0],
           [0, 0, 0, 0, 0, 0],
           [0, 1, 1, 1, 1, 0],
           [0, 0, 0, 0, 0, 0]])
    """
    _thin(state, _deletion_table(method), _NO_LIMIT, 0)


def skeleton_pixels(
    skeleton: NDArray[Any] | Blocks, *, strip: int = 4096
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the rows and columns of a skeleton's pixels, sorted; a memory map is read in strips of ``strip`` rows.

    Raises
    ------
    InputError
        If the skeleton does not have two dimensions.

    Examples
    --------
    >>> skeleton_pixels(np.array([[0, 1], [1, 0]]))
    (array([0, 1]), array([1, 0]))
    """
    rows, _ = _shape_of(skeleton)
    if isinstance(skeleton, Blocks):
        return skeleton.nonzero()
    parts = [np.nonzero(np.asarray(skeleton[top : top + strip])) for top in range(0, max(rows, 1), strip)]
    row = np.concatenate([part[0] + number * strip for number, part in enumerate(parts)])
    return row, np.concatenate([part[1] for part in parts])


def _thin_windows(
    mask: NDArray[Any] | Blocks, out: NDArray[np.bool_] | Blocks, window: int, halo: int, table: NDArray[np.bool_]
) -> bool:
    """Thin all windows; return False if the halo is too small for one of them."""
    rows, cols = mask.shape
    if isinstance(mask, Blocks):
        corners = mask.squares(window)
    else:
        corners = [(top, left) for top in range(0, rows, window) for left in range(0, cols, window)]
    for top, left in corners:
        height, width = min(window, rows - top), min(window, cols - left)
        core = slice(top, top + height), slice(left, left + width)
        if not np.asarray(mask[core]).any():
            out[core] = False
            continue
        state = _padded_state(mask, top, left, height, width, halo=halo)
        if _thin(state, table, halo // 2, halo) >= halo // 2:
            return False
        inner = state[halo + 1 : halo + 1 + height, halo + 1 : halo + 1 + width]
        out[core] = inner & _SET
    return True


def _shape_of(mask: NDArray[Any] | Blocks) -> tuple[int, int]:
    if not isinstance(mask, Blocks) and np.ndim(mask) != 2:
        raise InputError(f"the mask has {np.ndim(mask)} dimensions", fix="pass an array of shape (rows, cols)")
    rows, cols = mask.shape if isinstance(mask, Blocks) else np.shape(mask)
    return rows, cols


def _padded_state(
    mask: NDArray[Any] | Blocks, top: int, left: int, rows: int, cols: int, *, halo: int
) -> NDArray[np.uint8]:
    """Copy a window and its halo out of a mask, with a frame of one background pixel around it."""
    margin = halo + 1
    state = np.zeros((rows + 2 * margin, cols + 2 * margin), np.uint8)
    above, before = max(top - halo, 0), max(left - halo, 0)
    part = np.asarray(mask[above : top + rows + halo, before : left + cols + halo]) != 0
    at_row, at_col = above - top + margin, before - left + margin
    state[at_row : at_row + part.shape[0], at_col : at_col + part.shape[1]] = part
    return state


@cache
def _deletion_table(method: Method) -> NDArray[np.bool_]:
    """Return whether a pixel is deleted, for each sub-iteration and neighbourhood; shape ``(2, 256)``.

    Bit k of a neighbourhood is p(k + 2) of METHOD 7: clockwise from north.
    """
    n, ne, e, se, s, sw, w, nw = ((np.arange(256) >> bit) & 1 for bit in range(8))
    if method == "guo_hall":
        turns = (1 - n) * (ne | e) + (1 - e) * (se | s) + (1 - s) * (sw | w) + (1 - w) * (nw | n)
        pairs = np.minimum((nw | n) + (ne | e) + (se | s) + (sw | w), (n | ne) + (e | se) + (s | sw) + (w | nw))
        goes = (turns == 1) & (pairs >= 2) & (pairs <= 3)
        return np.stack([goes & ((n | ne | (1 - se)) & e == 0), goes & ((s | sw | (1 - nw)) & w == 0)])
    if method == "zhang_suen":
        ring = np.stack([n, ne, e, se, s, sw, w, nw])
        rises = ((1 - ring) & np.roll(ring, -1, axis=0)).sum(axis=0)
        goes = (rises == 1) & (ring.sum(axis=0) >= 2) & (ring.sum(axis=0) <= 6)
        return np.stack([goes & (n * e * s + e * s * w == 0), goes & (n * e * w + n * s * w == 0)])
    raise OptionError(f"method is {method!r}", where="skeletonize", fix="use 'guo_hall' or 'zhang_suen'")


@njit(cache=True, nogil=True)  # threads can thin several masks at once
def _thin(state: NDArray[np.uint8], table: NDArray[np.bool_], limit: int, margin: int) -> int:
    """Thin a padded state in place, in at most ``limit`` iterations.

    Returns the number of the last iteration that removed a pixel more than ``margin`` from the border.

    A pixel is queued for a sub-iteration when it has lost a neighbour since that sub-iteration last asked it.
    Fixed pixels are asked, too, and stay.
    """
    rows, cols = state.shape
    pixels = state.reshape(-1)
    around = np.array([-cols, 1 - cols, 1, cols + 1, cols, cols - 1, -1, -cols - 1])  # clockwise from north
    queue = _boundary(pixels, around)
    queues = [queue, queue.copy()]
    size = np.array([len(queue), len(queue)])
    flags = (_QUEUED_FIRST, _QUEUED_SECOND)
    removed = np.empty(len(queue), np.int64)
    last = 0
    for iteration in range(1, limit + 1):
        if size[0] == 0 and size[1] == 0:
            break
        for step in range(2):
            n_removed = 0
            if len(removed) < size[step]:
                removed = np.empty(2 * size[step], np.int64)
            for place in range(size[step]):
                pixel = queues[step][place]
                pixels[pixel] &= ~flags[step]
                if pixels[pixel] & (_SET | _FIXED) == _SET and table[step, _neighbourhood(pixels, pixel, around)]:
                    removed[n_removed] = pixel
                    n_removed += 1
            size[step] = 0
            for place in range(n_removed):
                pixels[removed[place]] &= ~_SET
            for place in range(n_removed):
                pixel = removed[place]
                row, col = pixel // cols, pixel % cols
                if margin < row < rows - 1 - margin and margin < col < cols - 1 - margin:
                    last = iteration
                for other in range(2):
                    queues[other] = _queue_neighbours(pixels, pixel, around, flags[other], queues[other], size, other)
    return last


@njit(cache=True)
def _boundary(pixels: NDArray[np.uint8], around: NDArray[np.int64]) -> NDArray[np.int64]:
    """List the set pixels next to background, and mark them as queued for both sub-iterations."""
    found = np.flatnonzero(pixels)  # the frame is background, so that every neighbourhood lies inside
    count = 0
    for pixel in found:
        if _neighbourhood(pixels, int(pixel), around) != 255:
            found[count] = pixel
            pixels[pixel] |= _QUEUED_FIRST | _QUEUED_SECOND
            count += 1
    return found[:count].copy()


@njit(cache=True)
def _neighbourhood(pixels: NDArray[np.uint8], pixel: int, around: NDArray[np.int64]) -> int:
    """Return the eight neighbours of a pixel as bits, clockwise from north."""
    code = 0
    for bit in range(8):
        code |= (pixels[pixel + around[bit]] & 1) << bit
    return code


@njit(cache=True)
def _queue_neighbours(
    pixels: NDArray[np.uint8],
    pixel: int,
    around: NDArray[np.int64],
    flag: np.uint8,
    queue: NDArray[np.int64],
    size: NDArray[np.int64],
    which: int,
) -> NDArray[np.int64]:
    """Queue the set neighbours of a removed pixel that are not queued yet; the queue grows if necessary."""
    if size[which] + 8 > len(queue):
        queue = np.append(queue, np.empty(len(queue) + 8, np.int64))
    for step in around:
        if pixels[pixel + step] & _SET and not pixels[pixel + step] & flag:
            pixels[pixel + step] |= flag
            queue[size[which]] = pixel + step
            size[which] += 1
    return queue
