"""Spines: curves along the roads, made from the drives themselves, that give all drives common coordinates.

Strategy
--------
To compare drives one needs to say "so far along this road, so far to its left" before there is a road. Drive after
drive is walked through; where no curve with a like heading is near, that part of the drive becomes a new curve, a
spine, a sequence of stations a few metres apart. It need not lie well: it only carries coordinates, and it is the
same for all. Positions are projected to the nearest station of like heading through a grid of cells that grows with
the stations. A spine is flat: what lies at which height is sorted out afterwards, because heights of raw drives are
too poor to do it first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.alignment.keyframes import Keyframes
from probe2road.alignment.options import AlignOptions

__all__ = ["CELL", "OnSpines", "Spines", "find_spines", "project"]

CELL = 10.0  # m, length of the cells into which spines are divided
_STATION = 4.0  # m between stations
_OVERLAP = 40.0  # m, by which a spine overlaps the area of another
_SQUARE = 32.0  # m, side of the squares through which stations are found


@dataclass(frozen=True)
class Spines:
    """S stations on r spines, divided into c cells along them."""

    station: NDArray[np.float64]  # (s, 3) x, y (m), direction (radians)
    z: NDArray[np.float64]  # (s,) m, as the drive recorded it; 0 where no drive has heights
    along: NDArray[np.float64]  # (s,) m from the first station of the first spine; grows by a cell between spines
    spine: NDArray[np.int64]  # (s,)
    squares: tuple[NDArray[np.int64], NDArray[np.int64]]  # first station of each square (rows, cols), next of each (s,)
    origin: NDArray[np.float64]  # (2,) m, lower left corner of the squares
    cell_spine: NDArray[np.int64]  # (c,)

    @property
    def n_cells(self) -> int:
        """Return the number of cells."""
        return len(self.cell_spine)

    def spine_of(self, cell: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the spine of each cell, -1 for a cell of -1: shape ``(n,)``."""
        return np.where(cell >= 0, self.cell_spine[np.maximum(cell, 0)], -1)

    def above(self, station: NDArray[np.int64], level: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far above their stations heights are, m, shape ``(n,)``; meaningless where there is no station.

        Each spine lies as high as one drive said, so this changes by metres from one spine to the next.
        """
        return level - self.z[np.maximum(station, 0)]


@dataclass(frozen=True)
class OnSpines:
    """Positions in the coordinates of spines, n of them."""

    station: NDArray[np.int64]  # (n,) the nearest; -1 where none of like heading is near
    along: NDArray[np.float64]  # (n,) m
    left: NDArray[np.float64]  # (n,) m to the left of the spine
    cell: NDArray[np.int64]  # (n,) -1 where there is no station


def find_spines(frames: Keyframes, order: NDArray[np.int64], options: AlignOptions) -> Spines:
    """Choose spines so that every keyframe is within reach of one.

    Parameters
    ----------
    frames
        The keyframes.
    order
        Chains in the order in which they may become spines; the first one does.
    options
        Reach and heading gate.

    Returns
    -------
    Spines
    """
    path, heights, starts = _stations(frames)
    low = path[:, :2].min(axis=0) - 2.0 * _SQUARE
    shape = np.ceil((path[:, :2].max(axis=0) - low) / _SQUARE).astype(np.int64) + 3
    kept, spine, squares, following = _cover(
        path, starts, order, low, (int(shape[1]), int(shape[0])), options.reach, np.radians(options.heading_gate)
    )
    station = path[kept]
    step = np.hypot(*np.diff(station[:, :2], axis=0, prepend=station[:1, :2]).T)
    new = np.diff(spine, prepend=-1) != 0
    step[new] = 0.0
    # Every spine begins at the border of a cell, with a cell free before it.
    length = np.bincount(spine, weights=step)
    cells = np.ceil(length / CELL).astype(np.int64) + 1
    base = (np.cumsum(cells) - cells) * CELL
    along = np.cumsum(step)
    along = along - along[new][spine] + base[spine] + CELL / 2.0
    return Spines(
        station, heights[kept], along, spine, (squares, following), low, np.repeat(np.arange(len(cells)), cells)
    )


def project(spines: Spines, pose: NDArray[np.float64], options: AlignOptions, *, reach: float = 25.0) -> OnSpines:
    """Return the coordinates of positions on the spines.

    Parameters
    ----------
    spines
        The spines.
    pose
        x, y (m) and direction of travel (radians), shape ``(n, 3)``.
    options
        The heading gate.
    reach
        Distance from a station beyond which there is none, m; at most 32.

    Returns
    -------
    OnSpines
    """
    gate = np.cos(np.radians(options.heading_gate))
    found = _nearest(np.ascontiguousarray(pose), spines.station, *spines.squares, spines.origin, gate, reach)
    near = np.maximum(found, 0)
    x, y, theta = spines.station[near].T
    east, north, cos, sin = pose[:, 0] - x, pose[:, 1] - y, np.cos(theta), np.sin(theta)
    along = spines.along[near] + cos * east + sin * north
    cell = np.clip((along / CELL).astype(np.int64), 0, spines.n_cells - 1)
    # Positions beyond the end of a spine belong to its last cell.
    own = spines.cell_spine[(spines.along[near] / CELL).astype(np.int64)]
    first = np.searchsorted(spines.cell_spine, own)
    last = np.searchsorted(spines.cell_spine, own, side="right") - 1
    cell = np.where(found >= 0, np.clip(cell, first, last), -1)
    return OnSpines(found, along, cos * north - sin * east, cell)


def _stations(frames: Keyframes) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Return poses every few metres on all chains (m, 3), their heights (m,), and chain starts (chains + 1,)."""
    starts = frames.starts
    first, last = starts[:-1], starts[1:] - 1
    length = frames.distance[last] - frames.distance[first]
    count = np.floor(length / _STATION).astype(np.int64) + 1
    offsets = np.concatenate([[0], np.cumsum(count)])
    chain = np.repeat(np.arange(len(count)), count)
    ahead = (np.arange(offsets[-1]) - offsets[chain]) * _STATION
    # A chain begins where the one before ends: a gap of a metre keeps the distance of all chains ascending.
    abscissa = frames.distance + np.cumsum(frames.first)
    at = abscissa[first][chain] + ahead
    x, y = (np.interp(at, abscissa, frames.pose[:, axis]) for axis in (0, 1))
    direction = np.interp(at, abscissa, np.unwrap(frames.pose[:, 2]))
    known = np.isfinite(frames.z)
    z = np.interp(at, abscissa[known], frames.z[known]) if known.any() else np.zeros(len(at))
    return np.column_stack([x, y, direction]), z, offsets


@njit(cache=True)
def _cover(
    path: NDArray[np.float64],
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    origin: NDArray[np.float64],
    shape: tuple[int, int],
    reach: float,
    heading_gate: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Choose the stations: return rows of the path, their spines, and the squares that serve to find them."""
    squares = np.full(shape, -1, np.int64)
    kept = np.empty(len(path) + 1, np.int64)
    spine = np.empty(len(path) + 1, np.int64)
    following = np.full(len(path) + 1, -1, np.int64)
    station = np.empty((len(path) + 1, 3))
    gate = np.cos(heading_gate)
    overlap = int(_OVERLAP / _STATION)
    n, spines = 0, 0
    for chain in order:
        begin, end = starts[chain], starts[chain + 1]
        wanted = np.zeros(end - begin, np.bool_)
        bare = _nearest(path[begin:end], station, squares, following, origin, gate, reach) < 0
        for i in range(end - begin):
            if bare[i]:
                wanted[max(i - overlap, 0) : i + overlap + 1] = True
        for i in range(end - begin):
            if not wanted[i]:
                continue
            if i == 0 or not wanted[i - 1]:
                spines += 1
            kept[n], spine[n], station[n] = begin + i, spines - 1, path[begin + i]
            row = int((station[n, 1] - origin[1]) / _SQUARE)
            col = int((station[n, 0] - origin[0]) / _SQUARE)
            following[n] = squares[row, col]
            squares[row, col] = n
            n += 1
    return kept[:n], spine[:n], squares, following[:n]


@njit(cache=True)
def _nearest(
    pose: NDArray[np.float64],
    station: NDArray[np.float64],
    squares: NDArray[np.int64],
    following: NDArray[np.int64],
    origin: NDArray[np.float64],
    gate: float,
    reach: float,
) -> NDArray[np.int64]:
    """Return the nearest station with a similar heading within reach of each position, -1 for none: shape ``(n,)``."""
    found = np.full(len(pose), -1, np.int64)
    rows, cols = squares.shape
    for i in range(len(pose)):
        best = reach * reach
        row = int((pose[i, 1] - origin[1]) / _SQUARE)
        col = int((pose[i, 0] - origin[0]) / _SQUARE)
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(col - 1, 0), min(col + 2, cols)):
                k = squares[r, c]
                while k >= 0:
                    away = (station[k, 0] - pose[i, 0]) ** 2 + (station[k, 1] - pose[i, 1]) ** 2
                    if away < best and np.cos(station[k, 2] - pose[i, 2]) > gate:
                        best, found[i] = away, k
                    k = following[k]
    return found
