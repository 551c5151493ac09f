"""Segmenters on areas of any size: window by window, with overlapping windows merged.

Strategy
--------
An area is cut into windows with a halo around each, the same windows whatever is in them. What a segmenter does not
blend counts in the window alone. What it blends counts in the halo as well, with a weight that falls linearly from 1
at the centre to 0.5 at the border, by Chebyshev distance, and is divided by the weights of all windows that reach the
pixel: with a halo of half a window, tiles that overlap by half.

Windows are merged into one array by addition, in any order. Each addend is rounded down to a multiple of 2^-24, and
sums of such numbers up to 1 are exact in single precision: the order cannot show, and no second array has to hold the
weights. A window that nothing touches has no road and is never looked at, but its weight counts. Pages of the array
that are far from any trace are never touched either.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.raster.blocks import Blocks
from probe2road.raster.grid import Grid, Window, sparse_zeros
from probe2road.segmentation.segmenter import Segmenter

__all__ = ["add_window", "predict_window", "raster_windows", "segment_raster"]

_STEPS = 2.0**24  # of the probability between 0 and 1: single precision can represent all of them


def segment_raster(segmenter: Segmenter, counts: NDArray[Any], grid: Grid) -> NDArray[np.float32]:
    """Return the centreline probability of a whole raster of counts.

    Parameters
    ----------
    segmenter
        How counts become probability.
    counts
        Shape ``(channels, rows, cols)``, the channels that the segmenter wants; 0 or more, not NaN.
    grid
        Its grid.

    Returns
    -------
    ndarray of float32, shape (rows, cols)
        0 throughout where there are no counts.

    Raises
    ------
    InputError
        If the counts are not counts or do not fit the grid.

    Notes
    -----
    Paper, section III-B; METHOD 0.1 rows 12 and 13.

    Examples
    --------
    >>> from probe2road.segmentation.density import DensityOptions, density_segmenter
    >>> from probe2road.demo import demo_fleet
    >>> from probe2road.raster.counts import fleet_grid, rasterize
    >>> fleet = demo_fleet(n_drives=5)
    >>> grid = fleet_grid(fleet)
    >>> segmenter = density_segmenter(fleet, grid, options=DensityOptions(bandwidth=4.0))
    >>> bool((segment_raster(segmenter, rasterize(fleet, grid), grid) > 0.5).any())
    True
    """
    if counts.ndim != 3 or counts.shape[1:] != grid.shape:
        raise InputError(f"counts of shape {counts.shape} do not fit a grid of {grid.shape}", where="raster")
    faulty = int((~np.isfinite(counts) | (counts < 0)).sum())
    if faulty:
        raise InputError(
            f"{faulty} values are negative, NaN or infinite", where="raster", fix="give counts, with 0 for no data"
        )
    probability = sparse_zeros(grid.shape, np.float32)
    for window, part in raster_windows(counts, grid, size=segmenter.window, halo=segmenter.halo):
        add_window(probability, predict_window(segmenter, window, part, grid), window, segmenter)
    return probability


def raster_windows(counts: NDArray[Any], grid: Grid, *, size: int, halo: int) -> Iterator[tuple[Window, NDArray[Any]]]:
    """Cut a raster into windows as `probe2road.raster.counts.rasterize_windows` does, with zeros beyond its border.

    Yields
    ------
    Window, ndarray
        A window and its counts ``(channels, rows + 2 halo, cols + 2 halo)``; windows without counts are skipped.
    """
    for window in grid.windows(size, halo=halo):
        target, source = _overlap(window, grid.shape)
        if not counts[:, *target].any():
            continue
        part = np.zeros((len(counts), window.rows + 2 * halo, window.cols + 2 * halo), counts.dtype)
        part[:, *source] = counts[:, *target]
        yield window, part


def predict_window(segmenter: Segmenter, window: Window, counts: NDArray[Any], grid: Grid) -> NDArray[np.float32]:
    """Return the output of a segmenter for a window: its own pixels or, with blending, the pixels of the halo, too.

    Parameters
    ----------
    segmenter
        How counts become probability.
    window
        One of the grid's, with the segmenter's size and halo.
    counts
        Of the window and its halo.
    grid
        Grid of the whole area.
    """
    if not counts.any():
        probability = np.zeros(counts.shape[1:], np.float32)
    else:
        probability = segmenter.predict(counts, window.grid(grid))
    return probability if segmenter.blend else probability[window.inner]


def add_window(
    probability: NDArray[np.float32] | Blocks, part: NDArray[np.float32], window: Window, segmenter: Segmenter
) -> None:
    """Merge what `predict_window` returned into the probability of the whole area.

    Every window must be merged once. The order has no influence on the result, not even in the last digit.

    Parameters
    ----------
    probability
        Shape ``(rows, cols)``, zeros at first; changed in place.
    part
        Of one window.
    window
        Which one.
    segmenter
        Which said so.
    """
    if not segmenter.blend:
        probability[window.core] = part
        return
    target, source = _overlap(window, probability.shape)
    neighbours = (
        _neighbours(first, length, segmenter)
        for first, length in zip((window.row, window.col), probability.shape, strict=True)
    )
    share = _share(segmenter.window, segmenter.halo, *neighbours)[: part.shape[0], : part.shape[1]]
    probability[target] += (np.floor(part * share * _STEPS) / _STEPS).astype(np.float32)[source]


def _overlap(window: Window, shape: tuple[int, int]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return which pixels of a window and its halo lie in an area: rows and columns in the area and in the window."""
    target, source = [], []
    for first, count, length in zip((window.row, window.col), (window.rows, window.cols), shape, strict=True):
        start = first - window.halo
        low, high = max(0, start), min(length, first + count + window.halo)
        target.append(slice(low, high))
        source.append(slice(low - start, high - start))
    return (target[0], target[1]), (source[0], source[1])


def _neighbours(first: int, length: int, segmenter: Segmenter) -> tuple[int, int]:
    """Return how many windows before and after the one at ``first`` overlap with it, along an axis."""
    size = segmenter.window
    reach = -(-2 * segmenter.halo // size)
    return min(first // size, reach), min(-(-(length - first) // size) - 1, reach)


@lru_cache(maxsize=32)
def _share(size: int, halo: int, rows: tuple[int, int], cols: tuple[int, int]) -> NDArray[np.float64]:
    """Return the weight of a window in each of its pixels and those of its halo; weights of all windows sum to 1.

    ``rows`` and ``cols`` are how many windows before and after overlap with it along the axes.
    """
    side = size + 2 * halo
    offset = np.abs(2 * np.arange(side) + 1 - side)  # from the centre, half pixels
    weight = 2 * side - np.maximum.outer(offset, offset)  # 1 at the centre to 0.5 at the border, times 2 side
    total = np.zeros((side, side), np.int64)
    for row in range(-rows[0], rows[1] + 1):
        for col in range(-cols[0], cols[1] + 1):
            own, other = zip(*(_shifted(step * size, side) for step in (row, col)), strict=True)
            total[own] += weight[other]
    share: NDArray[np.float64] = weight / total
    share.flags.writeable = False  # it is shared between calls
    return share


def _shifted(shift: int, side: int) -> tuple[slice, slice]:
    """Return where two tiles overlap along an axis, in the pixels of each; the second is ``shift`` pixels ahead."""
    return slice(max(0, shift), side + min(0, shift)), slice(max(0, -shift), side - max(0, shift))
