"""Candidates: the points on edges near a fix.

Strategy
--------
The pieces near a fix come from the grid, in ascending order whatever the cells. Pieces within the radius that
follow each other on one edge are one run, and a run gives its nearest point as candidate. An edge that passes
the fix twice, as a hairpin does, thus has two candidates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.matching.network import States

__all__ = ["Scratch", "altitude_at", "nearest_on_edge", "nearest_points", "new_scratch"]


class Scratch(NamedTuple):
    """Work arrays of `nearest_points`, shape (P,) each; ``seen`` holds the last query that reached each piece."""

    seen: NDArray[np.int64]
    near: NDArray[np.int64]
    point: NDArray[np.int64]  # piece of each nearest point
    along: NDArray[np.float64]  # m from u
    distance: NDArray[np.float64]  # m


@njit(cache=True)
def new_scratch(n_pieces: int) -> Scratch:
    """Return work arrays for a network with the given number of pieces."""
    return Scratch(
        np.full(n_pieces, -1, np.int64),
        np.empty(n_pieces, np.int64),
        np.empty(n_pieces, np.int64),
        np.empty(n_pieces),
        np.empty(n_pieces),
    )


@njit(cache=True)
def nearest_points(states: States, x: float, y: float, radius: float, query: int, scratch: Scratch) -> int:
    """Find the nearest point on every run of consecutive pieces within the radius, in the order of the pieces.

    Parameters
    ----------
    states
        The network.
    x, y, radius
        Place of the fix and search radius, metres.
    query
        A number that no earlier call with this work space had.
    scratch
        Work space; the result is in ``point``, ``along`` and ``distance``.

    Returns
    -------
    int
        Number of points.
    """
    near = _pieces_near(states, x, y, radius, query, scratch)
    count = 0
    before = -2
    for k in range(near):
        piece = scratch.near[k]
        share, squared = _project(states, piece, x, y)
        distance = np.sqrt(squared)
        new = piece != before + 1 or states.edge[piece] != states.edge[before]
        if new or distance < scratch.distance[count - 1]:
            if new:
                count += 1
            scratch.point[count - 1] = piece
            scratch.along[count - 1] = states.along[piece] + share * states.size[piece]
            scratch.distance[count - 1] = distance
        before = piece
    return count


@njit(cache=True)
def _pieces_near(states: States, x: float, y: float, radius: float, query: int, scratch: Scratch) -> int:
    """List the pieces within the radius in ascending order; return how many."""
    grid = states.grid
    left, right = (x - radius - grid.left) / grid.cell, (x + radius - grid.left) / grid.cell
    low, high = (y - radius - grid.bottom) / grid.cell, (y + radius - grid.bottom) / grid.cell
    if right < 0 or high < 0 or left >= grid.columns or low >= grid.rows or len(states.x) == 0:
        return 0
    count = 0
    for row in range(max(int(low), 0), min(int(high), grid.rows - 1) + 1):
        for column in range(max(int(left), 0), min(int(right), grid.columns - 1) + 1):
            c = row * grid.columns + column
            for k in range(grid.first[c], grid.first[c + 1]):
                p = int(grid.piece[k])
                if scratch.seen[p] == query:
                    continue
                scratch.seen[p] = query
                _, squared = _project(states, p, x, y)
                if squared <= radius * radius:
                    scratch.near[count] = p
                    count += 1
    _sort(scratch.near, count)
    return count


@njit(cache=True)
def _sort(values: NDArray[np.int64], count: int) -> None:
    """Sort the first values in place; most lists here are short."""
    if count > 40:
        values[:count] = np.sort(values[:count])
        return
    for k in range(1, count):
        value, place = values[k], k
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value


@njit(cache=True, inline="always")
def _project(states: States, p: int, x: float, y: float) -> tuple[float, float]:
    """Return the nearest point of a piece as a share of its length, and its squared distance."""
    to_x, to_y = x - states.x[p], y - states.y[p]
    dx, dy = states.dx[p], states.dy[p]
    squared = dx * dx + dy * dy
    share = (to_x * dx + to_y * dy) / squared if squared > 0 else 0.0
    share = min(max(share, 0.0), 1.0)
    to_x -= share * dx
    to_y -= share * dy
    return share, to_x * to_x + to_y * to_y


@njit(cache=True, inline="always")
def nearest_on_edge(states: States, edge: int, x: float, y: float, low: float, high: float) -> tuple[float, float]:
    """Return the nearest point on an edge between two offsets from u, and its distance."""
    best_along, best = low, np.inf
    for p in range(states.piece_first[edge], states.piece_first[edge + 1]):
        if states.along[p] > high or states.along[p] + states.size[p] < low:
            continue
        share, _ = _project(states, p, x, y)
        along = min(max(states.along[p] + share * states.size[p], low), high)
        share = (along - states.along[p]) / states.size[p] if states.size[p] > 0 else 0.0
        distance = np.hypot(states.x[p] + share * states.dx[p] - x, states.y[p] + share * states.dy[p] - y)
        if distance < best:
            best_along, best = along, distance
    return best_along, best


@njit(cache=True)
def altitude_at(states: States, p: int, along: float) -> float:
    """Return the height of a piece at an offset of its edge; NaN where unknown."""
    share = (along - states.along[p]) / states.size[p] if states.size[p] > 0 else 0.0
    return states.z[p] + share * states.dz[p]
