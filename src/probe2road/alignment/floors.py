"""Floors: which roads lie above each other, so that stacked roads never attract each other.

Strategy
--------
Raw heights are off by metres, as much as two decks of a bridge are apart. Once drives that surely are on one road
agree on its height (`probe2road.alignment.routes`), the heights at each place fall into groups with a gap between them,
and every group is a floor. All later stages work on floors; a spine with two decks has two at each of its cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe2road.alignment.options import AlignOptions
from probe2road.alignment.profiles import Places
from probe2road.alignment.spines import OnSpines, Spines

__all__ = ["Floors", "find_floors", "floor_of", "middles"]

_LOOK_AHEAD = 4  # cells ahead of a keyframe in which it sees things, and one behind
_FAR = 10_000.0  # m, more than any height


@dataclass(frozen=True)
class Floors:
    """F floors, sorted by cell and height."""

    cell: NDArray[np.int64]  # (f,)
    height: NDArray[np.float64]  # (f,) m above the spine
    places: Places  # the floors behind and ahead that a vehicle drives to

    @property
    def patch(self) -> NDArray[np.int64]:
        """Floor that stands for each floor and the next: shape ``(f,)``."""
        own = np.arange(len(self.cell))
        return np.where((self.cell % 2 == 1) & (self.places.before >= 0), self.places.before, own)


def find_floors(on: OnSpines, height: NDArray[np.float64], spines: Spines, options: AlignOptions) -> Floors:
    """Group the heights at every cell.

    Parameters
    ----------
    on
        Keyframes on the spines.
    height
        Of each keyframe above its spine, m; NaN where unknown. Shape ``(k,)``.
    spines
        The spines.
    options
        Heights with a gap of more than the altitude gate between them are different floors.

    Returns
    -------
    Floors
    """
    usable = np.flatnonzero((on.cell >= 0) & np.isfinite(height))
    reach = np.arange(-1, _LOOK_AHEAD + 1)
    cell = (on.cell[usable][:, None] + reach).ravel()
    road = np.repeat(spines.cell_spine[on.cell[usable]], len(reach))
    inside = (cell >= 0) & (cell < spines.n_cells)
    inside[inside] &= spines.cell_spine[cell[inside]] == road[inside]
    cell, at = cell[inside], np.repeat(height[usable], len(reach))[inside]
    order = np.lexsort((at, cell))
    cell, at = cell[order], at[order]
    new = (np.diff(cell, prepend=-1) != 0) | (np.diff(at, prepend=-_FAR) > options.altitude_gate)
    group = np.cumsum(new) - 1
    middle = np.bincount(group, weights=at) / np.bincount(group) if len(group) else np.zeros(0)
    cells = cell[new]
    floors = Floors(cells, middle, Places(np.full(len(cells), -1), np.full(len(cells), -1)))
    linked = {}
    for name, step in (("before", -1), ("after", 1)):
        neighbour = np.clip(cells + step, 0, spines.n_cells - 1)
        same = spines.cell_spine[neighbour] == spines.cell_spine[cells] if len(cells) else np.zeros(0, bool)
        found = floor_of(floors, neighbour, middle, options)
        linked[name] = np.where(same & (neighbour != cells), found, -1)
    return Floors(cells, middle, Places(**linked))


def floor_of(
    floors: Floors, cell: NDArray[np.int64], height: NDArray[np.float64], options: AlignOptions
) -> NDArray[np.int64]:
    """Find the floor of positions by cell and height.

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
    """Return the median offset of the paths on each of n floors, and how many drives there are, shape ``(n,)`` each."""
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
