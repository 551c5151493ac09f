"""Floors: which roads lie above each other, so that alignment never draws stacked roads together.

Strategy
--------
Raw heights have errors of metres, as much as two decks of a bridge are apart. Drives that are certainly on one road
are moved to one height first (`probe2road.alignment.routes`). Then heights at each place are joined, the nearest first,
until the remaining groups lie further apart than the errors of so many drives explain: every group is a floor. Groups
are compared by their means: if only gaps counted, a few drives between two decks would join them. All later stages
work on floors; a spine with two decks has two floors at each of its cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.alignment.heights import VERTICAL
from probe2road.alignment.keyframes import Keyframes
from probe2road.alignment.options import AlignOptions
from probe2road.alignment.profiles import RoadPlaces
from probe2road.alignment.spines import OnSpines, Spines

__all__ = ["Floors", "find_floors", "floor_of", "middles"]

_LOOK_AHEAD = 4  # cells ahead of a keyframe in which it sees things, and one behind
_FAR = 10_000.0  # m, more than any height
_BIN = 0.25  # m; heights that are nearer are not told apart
_DOUBT = 2.0  # sigmas of the difference of two groups, up to which they are one floor


@dataclass(frozen=True)
class Floors:
    """F floors, sorted by cell and height."""

    cell: NDArray[np.int64]  # (f,)
    height: NDArray[np.float64]  # (f,) m above the spine
    places: RoadPlaces  # the floors behind and ahead that a vehicle drives to

    @property
    def patch(self) -> NDArray[np.int64]:
        """Return the floor that stands for each floor and the next one: shape ``(f,)``."""
        own = np.arange(len(self.cell))
        return np.where((self.cell % 2 == 1) & (self.places.before >= 0), self.places.before, own)


def find_floors(
    frames: Keyframes, on: OnSpines, height: NDArray[np.float64], spines: Spines, options: AlignOptions
) -> Floors:
    """Group the heights at every cell into floors.

    Parameters
    ----------
    frames
        The keyframes.
    on
        Where they are on the spines.
    height
        Of each keyframe above its spine, m; NaN where unknown. Shape ``(k,)``.
    spines
        The spines.
    options
        Groups further apart than the altitude gate are different floors, unless so few drives may be wrong by that.

    Returns
    -------
    Floors
    """
    cell, at, information = _heights_of_passes(frames, on, height, spines)
    bins = np.round(at / _BIN).astype(np.int64)
    order = np.lexsort((bins, cell))
    cell, bins, at, information = cell[order], bins[order], at[order], information[order]
    group = np.cumsum((np.diff(cell, prepend=-1) != 0) | (np.diff(bins, prepend=0) != 0)) - 1
    weight = np.bincount(group, information).astype(np.float64)  # integers where there is nothing to count
    middle = np.bincount(group, information * at) / weight
    cells = cell[np.flatnonzero(np.diff(group, prepend=-1))]
    starts = np.append(np.flatnonzero(np.diff(cells, prepend=-1)), len(cells))
    floor = _joined(starts, middle, weight, options.altitude_gate)
    middle = np.bincount(floor, weight * middle) / np.bincount(floor, weight)
    cells = cells[np.flatnonzero(np.diff(floor, prepend=-1))]
    floors = Floors(cells, middle, RoadPlaces(np.full(len(cells), -1), np.full(len(cells), -1)))
    linked = {}
    for name, step in (("before", -1), ("after", 1)):
        neighbour = np.clip(cells + step, 0, spines.n_cells - 1)
        same = spines.cell_spine[neighbour] == spines.cell_spine[cells] if len(cells) else np.zeros(0, bool)
        found = floor_of(floors, neighbour, middle, options)
        linked[name] = np.where(same & (neighbour != cells), found, -1)
    return Floors(cells, middle, RoadPlaces(**linked))


def _heights_of_passes(
    frames: Keyframes, on: OnSpines, height: NDArray[np.float64], spines: Spines
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean height of each pass at each cell that it crosses or sees: cells, heights, and information.

    A pass is the part of a drive between entering and leaving a spine. Its information is the inverse variance of its
    own height, 1/m2.
    """
    spine = spines.spine_of(on.cell)
    passes = np.cumsum((np.diff(spine, prepend=-2) != 0) | frames.first)
    usable = np.flatnonzero((on.cell >= 0) & np.isfinite(height))
    reach = np.arange(-1, _LOOK_AHEAD + 1)
    cell = (on.cell[usable][:, None] + reach).ravel()
    frame = np.repeat(usable, len(reach))
    inside = (cell >= 0) & (cell < spines.n_cells)
    inside[inside] &= spines.cell_spine[cell[inside]] == spine[frame[inside]]
    cell, frame = cell[inside], frame[inside]
    span = int(passes.max(initial=0)) + 1
    key, index = np.unique(cell * span + passes[frame], return_inverse=True)
    n = np.bincount(index)
    sigma = VERTICAL * np.bincount(index, frames.sigma[frame]) / n
    return key // span, np.bincount(index, height[frame]) / n, sigma**-2.0


@njit(cache=True)
def _joined(
    starts: NDArray[np.int64], middle: NDArray[np.float64], weight: NDArray[np.float64], gate: float
) -> NDArray[np.int64]:
    """Join neighbouring groups within each stretch, the nearest first: return the floor of each group, ascending."""
    floor = np.empty(len(middle), np.int64)
    found = 0
    for stretch in range(len(starts) - 1):
        begin, end = int(starts[stretch]), int(starts[stretch + 1])
        at, mass = middle[begin:end].copy(), weight[begin:end].copy()
        last = np.arange(end - begin)  # group with which each floor ends
        n = end - begin
        while n > 1:
            distance = at[1:n] - at[: n - 1]
            limit = np.maximum(gate, _DOUBT * np.sqrt(1.0 / mass[1:n] + 1.0 / mass[: n - 1]))
            nearest = int(np.argmin(distance / limit))
            if distance[nearest] > limit[nearest]:
                break
            total = mass[nearest] + mass[nearest + 1]
            at[nearest] = (mass[nearest] * at[nearest] + mass[nearest + 1] * at[nearest + 1]) / total
            mass[nearest], last[nearest] = total, last[nearest + 1]
            for values in (at, mass):
                values[nearest + 1 : n - 1] = values[nearest + 2 : n].copy()
            last[nearest + 1 : n - 1] = last[nearest + 2 : n].copy()
            n -= 1
        first = begin
        for k in range(n):
            beyond = begin + int(last[k]) + 1
            floor[first:beyond] = found
            first = beyond
            found += 1
    return floor


def floor_of(
    floors: Floors, cell: NDArray[np.int64], height: NDArray[np.float64], options: AlignOptions
) -> NDArray[np.int64]:
    """Return the floor of positions, given by cell and height.

    Returns
    -------
    ndarray of int64, shape (n,)
        -1 where there is none within twice the altitude gate; an unknown height fits where there is only one.
    """
    if len(floors.cell) == 0:
        return np.full(len(cell), -1, np.int64)
    key = floors.cell * (4.0 * _FAR) + floors.height
    wanted = cell * (4.0 * _FAR) + np.nan_to_num(height)
    after = np.clip(np.searchsorted(key, wanted), 1, max(len(key) - 1, 1)) if len(key) > 1 else np.zeros(len(cell), int)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(key[after] - wanted) < np.abs(key[before] - wanted), after, before)
    fits = floors.cell[nearest] == cell
    unknown = ~np.isfinite(height)
    alone = np.bincount(floors.cell, minlength=int(cell.max(initial=0)) + 1)[np.maximum(cell, 0)] == 1
    near = np.abs(floors.height[nearest] - np.nan_to_num(height)) <= 2.0 * options.altitude_gate
    return np.where((cell >= 0) & fits & np.where(unknown, alone, near), nearest, -1)


def middles(
    floor: NDArray[np.int64], left: NDArray[np.float64], drive: NDArray[np.int64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the median offset of the paths on each of n floors, and the number of drives, shape ``(n,)`` each."""
    order = np.lexsort((left, floor))
    count = np.bincount(floor, minlength=n)
    middle = np.zeros(n)
    start = np.cumsum(count) - count
    there = count > 0
    ranked = left[order]
    low, high = start[there] + (count[there] - 1) // 2, start[there] + count[there] // 2
    middle[there] = (ranked[low] + ranked[high]) / 2.0
    span = int(drive.max(initial=0)) + 1
    return middle, np.bincount(np.unique(floor * span + drive) // span, minlength=n)
