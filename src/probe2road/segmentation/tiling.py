"""Segmenters on areas of any size: window by window, overlapping windows merged.

Strategy
--------
An area is cut into windows with a halo around each, the same windows whatever is in them. What a segmenter does not
blend counts in the window alone. What it blends counts in the halo as well: a pixel gets the weighted mean of all
windows that looked at it, where the weight of a window falls linearly from 1 at its centre to 0.5 at the border of
its halo, by Chebyshev distance. With a halo of half a window, tiles overlap by half.

A window that is blended and that nobody drove in is never looked at, and has no say in the halo: every road lies
inside another window. What was not looked at has no road.

Sums are of integers, so that windows can come in any order and the result is the same to the last digit. Pages of
memory that are far from any trace are never touched.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.raster.blocks import Blocks
from probe2road.raster.grid import Grid, Window
from probe2road.segmentation.segmenter import Segmenter

__all__ = ["Merger", "is_empty", "predict_window", "raster_windows", "segment_raster"]

_STEPS = 2**16  # of the probability between 0 and 1
_WEIGHTS = 128  # of the weight between 0 and 1: a hundred windows on one pixel stay within 32 bits


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
    merger = Merger(segmenter, grid.shape)
    for window, part in raster_windows(counts, grid, size=segmenter.window, halo=segmenter.halo):
        if not is_empty(segmenter, window, part):
            merger.add(window, predict_window(segmenter, window, part, grid))
    return np.asarray(merger.probability())


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


def is_empty(segmenter: Segmenter, window: Window, counts: NDArray[Any]) -> bool:
    """Return whether a window need not be looked at, because all there is lies inside other windows.

    Parameters
    ----------
    segmenter, window, counts
        As for `predict_window`.
    """
    return not (counts[:, *window.inner] if segmenter.blend else counts).any()


def predict_window(segmenter: Segmenter, window: Window, counts: NDArray[Any], grid: Grid) -> NDArray[np.float32]:
    """Return what a segmenter says about a window: its pixels, or with blending those of the halo too.

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
    probability = segmenter.predict(counts, window.grid(grid))
    return probability if segmenter.blend else probability[window.inner]


class Merger:
    """The probability of a whole area while its windows come in, in any order and each of them once.

    Parameters
    ----------
    segmenter
        Whose windows they are.
    shape
        Rows and columns of the area.

    Examples
    --------
    >>> from probe2road.raster.grid import Grid
    >>> def certain(counts, grid): return np.ones(counts.shape[1:], np.float32)
    >>> segmenter = Segmenter("certain", certain, window=4, halo=1, blend=True, threshold=0.5, seed_threshold=0.5,
    ...                       parameters={})
    >>> merger = Merger(segmenter, (4, 8))
    >>> left, right = Grid(446000.0, 4636000.0, 1.0, 4, 8, "EPSG:32616").windows(4, halo=1)
    >>> merger.add(left, np.full((6, 6), 0.5, np.float32))
    >>> np.asarray(merger.probability())[0].tolist()
    [0.5, 0.5, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0]
    """

    def __init__(self, segmenter: Segmenter, shape: tuple[int, int]) -> None:
        self._segmenter = segmenter
        self._sum, self._weight = Blocks(shape, np.uint32), Blocks(shape, np.uint16)

    def add(self, window: Window, part: NDArray[np.float32]) -> None:
        """Take in what `predict_window` returned for a window."""
        steps = np.rint(part * np.float32(_STEPS)).astype(np.uint32)
        if not self._segmenter.blend:
            self._sum[window.core], self._weight[window.core] = steps, 1
            return
        target, source = _overlap(window, self._sum.shape)
        weight = _weights(self._segmenter.window + 2 * self._segmenter.halo)[: part.shape[0], : part.shape[1]]
        self._sum[target] += (steps * weight)[source]
        self._weight[target] += weight[source]

    def probability(self) -> Blocks:
        """Return the mean of the windows so far; 0 where none has looked."""
        merged = Blocks(self._sum.shape, np.float32)
        for block, total in self._sum.filled.items():
            mean = total / np.maximum(self._weight.filled[block], 1) / _STEPS
            merged.filled[block] = mean.astype(np.float32)
        return merged


def _overlap(window: Window, shape: tuple[int, int]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the pixels of a window and its halo that an area has: in the area, and in the window's own array."""
    target, source = [], []
    for first, count, length in zip((window.row, window.col), (window.rows, window.cols), shape, strict=True):
        start = first - window.halo
        low, high = max(0, start), min(length, first + count + window.halo)
        target.append(slice(low, high))
        source.append(slice(low - start, high - start))
    return (target[0], target[1]), (source[0], source[1])


@lru_cache(maxsize=32)
def _weights(side: int) -> NDArray[np.uint16]:
    """Return the weights of the pixels of a tile, from _WEIGHTS at the centre to half of that at the border."""
    offset = np.abs(2 * np.arange(side) + 1 - side) / side  # from the centre, in half sides
    weight = np.rint(_WEIGHTS * (1 - np.maximum.outer(offset, offset) / 2)).astype(np.uint16)
    weight.flags.writeable = False  # it is shared between calls
    return weight
