"""From traces to a volume: voxel counts, their smoothed density, and the voxels above a threshold, as pillars.

Strategy
--------
A city's volume is almost empty, so nothing of its size is ever allocated. Traces become a sorted list of voxel
keys and counts. Density is computed in windows seen from above, each as deep as the heights in it, and only the
voxels above the threshold are kept. They are stored as pillars: one pixel seen from above, and its voxels as the
bits of one integer, which makes the neighbours of a voxel a matter of shifts.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from probe2road.fleet.contract import Fleet, TraceGaps, trace_breaks
from probe2road.raster.grid import Grid, Window

__all__ = ["Pillars", "VoxelCounts", "count_voxels", "dense_pillars", "pillars_from_voxels"]

logger = logging.getLogger(__name__)

_WINDOW = 512  # pixels
_TRUNCATE = 3.0  # kernel half-width, sigmas
_BITS = 62  # layers of a pillar; one more is left free above and below


@dataclass(frozen=True)
class VoxelCounts:
    """How many traces cross each voxel of a grid with layers; only the K voxels that are not empty.

    Attributes
    ----------
    grid
        The grid seen from above.
    floor, height
        Metres: lower side of layer 0, and height of a layer.
    layers
        Number of layers.
    key
        Shape (K,), ascending: ``(row * cols + col) * layers + layer``.
    count
        Shape (K,).
    """

    grid: Grid
    floor: float
    height: float
    layers: int
    key: NDArray[np.int64]
    count: NDArray[np.int64]


@dataclass(frozen=True)
class Pillars:
    """The voxels of a volume, grouped by their P places in plan.

    Attributes
    ----------
    row, col
        Shape (P,), sorted by row and then column.
    base
        Shape (P,). Layer of bit 1; bits 0 and 63 are never set.
    bits
        Shape (P,), uint64. The voxels.
    """

    row: NDArray[np.int64]
    col: NDArray[np.int64]
    base: NDArray[np.int64]
    bits: NDArray[np.uint64]

    def voxels(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """List row, column and layer of all voxels, sorted in this order."""
        bit = np.arange(64, dtype=np.uint64)
        pillar, place = np.nonzero((self.bits[:, None] >> bit) & np.uint64(1))
        return self.row[pillar], self.col[pillar], self.base[pillar] + place - 1


def count_voxels(fleet: Fleet, grid: Grid, *, height: float, gaps: TraceGaps | None = None) -> VoxelCounts:
    """Count how often traces cross each voxel.

    A trace counts one in every voxel that it traverses, the voxel that two of its segments share once. Fixes without
    altitude are left out, unless none has one: then all are at 0.

    Parameters
    ----------
    fleet
        The fleet, in the grid's CRS and inside it.
    grid
        The grid seen from above.
    height
        Of a layer, m.
    gaps
        Where traces are broken.

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": [0, 1], "x": [900.5, 903.5], "y": 0.5, "z": [1.0, 4.0]})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> counts = count_voxels(fleet, Grid.from_bounds(fleet.bounds, crs=fleet.crs), height=3.0)
    >>> counts.layers, counts.key.tolist(), counts.count.tolist()
    (2, [0, 2, 5, 7], [1, 1, 1, 1])
    """
    known = fleet.traces["z"].notna().to_numpy()
    if known.any():
        fleet = replace(fleet, traces=fleet.traces[known])
    z = fleet.traces["z"].fillna(0.0).to_numpy(np.float64)
    floor = float(np.floor(z.min() / height) * height)
    layer = np.floor((z - floor) / height).astype(np.int64)
    row, col = grid.rowcol(fleet.traces["x"], fleet.traces["y"])
    layers = int(layer.max()) + 1
    keys = _traversed(row, col, layer, trace_breaks(fleet, gaps), grid.cols, layers)
    key, count = np.unique(keys, return_counts=True)
    logger.info("%d traversals of %d voxels in %d layers", len(keys), len(key), layers)
    return VoxelCounts(grid, floor, height, layers, key, count)


def dense_pillars(counts: VoxelCounts, *, sigma: float, sigma_vertical: float, threshold: float) -> Pillars:
    """Smooth the counts with a Gaussian and keep the voxels whose density reaches a threshold.

    Parameters
    ----------
    counts
        From `count_voxels`.
    sigma, sigma_vertical
        Of the Gaussian in plan and in height, m.
    threshold
        In traces: a single straight and level one has density 1 on its line, n on one line have n.

    Returns
    -------
    Pillars
        Of a place with voxels more than 62 layers apart, only the lower ones.
    """
    width, depth = sigma / counts.grid.resolution, sigma_vertical / counts.height
    scale = 2.0 * np.pi * width * depth
    halo, margin = int(np.ceil(_TRUNCATE * width)), int(np.ceil(_TRUNCATE * depth))
    found = [np.zeros((0, 3), np.int64)]
    for window, low, block in _blocks(counts, halo, margin):
        density = ndimage.gaussian_filter(
            block * np.float32(scale), (width, width, depth), mode="constant", truncate=_TRUNCATE
        )
        voxel = np.argwhere(density[window.inner] >= threshold)
        found.append(voxel + np.array([window.row, window.col, low]))
    row, col, layer = np.concatenate(found).T
    logger.info("%d voxels reach a density of %g traces", len(row), threshold)
    return pillars_from_voxels(row, col, layer)


def pillars_from_voxels(row: NDArray[np.int64], col: NDArray[np.int64], layer: NDArray[np.int64]) -> Pillars:
    """Group voxels by place; each voxel is given once, in any order.

    Examples
    --------
    >>> pillars = pillars_from_voxels(np.array([4, 4, 4]), np.array([7, 7, 7]), np.array([2, 1, 4]))
    >>> bin(pillars.bits[0]), [part.tolist() for part in pillars.voxels()]
    ('0b10110', [[4, 4, 4], [7, 7, 7], [1, 2, 4]])
    """
    order = np.lexsort([layer, col, row])
    row, col, layer = row[order], col[order], layer[order]
    first = np.flatnonzero((np.diff(row, prepend=-1) != 0) | (np.diff(col, prepend=-1) != 0))
    pillar = np.repeat(np.arange(len(first)), np.diff(first, append=len(row)))
    base = layer[first]
    bit = layer - base[pillar] + 1
    high = bit > _BITS
    if high.any():
        logger.warning("%d voxels lie more than %d layers above others and are left out", high.sum(), _BITS)
    bits = np.zeros(len(first), np.uint64)
    np.bitwise_or.at(bits, pillar[~high], np.uint64(1) << bit[~high].astype(np.uint64))
    return Pillars(row[first], col[first], base, bits)


def _blocks(counts: VoxelCounts, halo: int, margin: int) -> Iterator[tuple[Window, int, NDArray[np.float32]]]:
    """Yield windows with their counts, shape ``(rows, cols, layers)`` with a halo in plan, and their lowest layer.

    The layers are those with counts, and a margin on either side. Windows without counts in them are skipped.
    """
    grid = counts.grid
    per_row = grid.cols * counts.layers
    for window in grid.windows(_WINDOW, halo=halo):
        band = (max(window.row - halo, 0) * per_row, (window.row + window.rows + halo) * per_row)
        first, last = np.searchsorted(counts.key, band)
        place, layer = np.divmod(counts.key[first:last], counts.layers)
        row, col = np.divmod(place, grid.cols)
        row, col = row - window.row + halo, col - window.col + halo
        inside = (col >= 0) & (col < window.cols + 2 * halo)
        if not inside.any():
            continue
        low = int(layer[inside].min()) - margin
        depth = int(layer[inside].max()) + margin + 1 - low
        block = np.zeros((window.rows + 2 * halo, window.cols + 2 * halo, depth), np.float32)
        block[row[inside], col[inside], layer[inside] - low] = counts.count[first:last][inside]
        yield window, low, block


@njit(cache=True)
def _traversed(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    layer: NDArray[np.int64],
    breaks: NDArray[np.bool_],
    cols: int,
    layers: int,
) -> NDArray[np.int64]:
    """List the keys of all voxels that segments cross, with one step at a time along the longest axis."""
    total = 0
    for fix in range(len(row)):
        total += 1 if breaks[fix] else _steps(row, col, layer, fix)
    keys = np.empty(total, np.int64)
    filled = 0
    for fix in range(len(row)):
        steps = 0 if breaks[fix] else _steps(row, col, layer, fix)
        if breaks[fix]:
            keys[filled] = (row[fix] * cols + col[fix]) * layers + layer[fix]
            filled += 1
        for k in range(1, steps + 1):
            r = row[fix - 1] + int(np.floor((row[fix] - row[fix - 1]) * k / steps + 0.5))
            c = col[fix - 1] + int(np.floor((col[fix] - col[fix - 1]) * k / steps + 0.5))
            z = layer[fix - 1] + int(np.floor((layer[fix] - layer[fix - 1]) * k / steps + 0.5))
            keys[filled] = (r * cols + c) * layers + z
            filled += 1
    return keys


@njit(cache=True)
def _steps(row: NDArray[np.int64], col: NDArray[np.int64], layer: NDArray[np.int64], fix: int) -> int:
    """Count the voxels from one fix to the next, without the first."""
    step = max(abs(row[fix] - row[fix - 1]), abs(col[fix] - col[fix - 1]))
    return max(step, abs(layer[fix] - layer[fix - 1]))
