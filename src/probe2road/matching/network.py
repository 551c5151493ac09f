"""The states of map matching: directed edges, their successors, and a spatial index of their pieces.

Legend of array shapes: N nodes, E edges, D = 2 E directed edges, P straight pieces of all edges one after
another, F pairs of directed edges that follow each other. Directed edge ``2 e`` is edge row ``e`` driven from u
to v, ``2 e + 1`` the same driven from v to u, so that ``d ^ 1`` is the reverse of ``d``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
import shapely
from numba import njit
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.graph.direction import driving_direction
from probe2road.graph.roadgraph import RoadGraph

__all__ = ["CellIndex", "Follow", "States", "build_follow", "build_states", "edge_weight_array"]

_MIN_CELL = 50.0  # m
_CELLS_PER_PIECE = 4.0


class CellIndex(NamedTuple):
    """Square cells and the pieces that may touch each; the pieces of cell c are ``piece[first[c]:first[c + 1]]``."""

    left: float
    bottom: float
    cell: float  # m
    columns: int
    rows: int
    first: NDArray[np.int64]
    piece: NDArray[np.int32]


class States(NamedTuple):
    """Arrays of a road graph for numba, which takes named tuples but no dataclasses.

    Attributes
    ----------
    tail, head
        Shape (D,), rows of nodes: where a directed edge starts and ends.
    allowed
        Shape (D,), bool. May be driven this way.
    length
        Shape (E,), m, in plan.
    out_first, out
        Shapes (N + 1,) and (D,): directed edges leaving each node, ascending, driven that way or not.
    piece_first
        Shape (E + 1,): the pieces of edge e are ``piece_first[e]`` to ``piece_first[e + 1]``.
    edge, along, size
        Shape (P,): edge of a piece, distance (m) of its start from u, its length (m).
    x, y, dx, dy
        Shape (P,): start of a piece, and step to its end, m.
    z, dz
        The same for heights; NaN where unknown.
    grid
        Index of the pieces.
    """

    tail: NDArray[np.int64]
    head: NDArray[np.int64]
    allowed: NDArray[np.bool_]
    length: NDArray[np.float64]
    out_first: NDArray[np.int64]
    out: NDArray[np.int64]
    piece_first: NDArray[np.int64]
    edge: NDArray[np.int64]
    along: NDArray[np.float64]
    size: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    dx: NDArray[np.float64]
    dy: NDArray[np.float64]
    z: NDArray[np.float64]
    dz: NDArray[np.float64]
    grid: CellIndex


class Follow(NamedTuple):
    """The successors of directed edge d: ``state[first[d]:first[d + 1]]``, each with a cost (shape (F,))."""

    first: NDArray[np.int64]
    state: NDArray[np.int64]
    cost: NDArray[np.float64]


class _EndDirections(NamedTuple):
    """Unit directions of directed edges at their start (first) and end (last), shape (D,) each; 0 without length."""

    first_dx: NDArray[np.float64]
    first_dy: NDArray[np.float64]
    last_dx: NDArray[np.float64]
    last_dy: NDArray[np.float64]


def build_states(graph: RoadGraph, *, respect_oneway: bool = True) -> States:
    """Turn a road graph into the states of map matching.

    Edges without length are kept: they are passed at no cost. With ``respect_oneway`` the directions that
    `probe2road.graph.direction.driving_direction` closes are no states.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> states = build_states(graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 4), (5, 4)]], crs="EPSG:32616"))
    >>> states.tail.tolist(), states.head.tolist(), states.along.tolist()
    ([0, 1, 1, 2], [1, 0, 2, 1], [0.0, 0.0, 4.0])
    """
    edges = graph.edges
    tail, head = graph.end_rows.flatten(), graph.end_rows[:, ::-1].flatten()
    allowed = np.ones(len(tail), bool)
    if respect_oneway and len(edges):
        direction = driving_direction(edges).to_numpy()
        allowed[0::2], allowed[1::2] = direction >= 0, direction <= 0
    order = np.argsort(tail, kind="stable").astype(np.int64)
    xyz, owner = shapely.get_coordinates(edges.geometry.to_numpy(), include_z=True, return_index=True)
    starts = np.flatnonzero(owner[1:] == owner[:-1]) if len(owner) else np.zeros(0, np.int64)
    step = xyz[starts + 1] - xyz[starts]
    size = np.hypot(step[:, 0], step[:, 1])
    edge = owner[starts].astype(np.int64)
    piece_first = np.searchsorted(edge, np.arange(len(edges) + 1)).astype(np.int64)
    total = np.concatenate([[0.0], np.cumsum(size)])
    x, y, z = (np.ascontiguousarray(xyz[starts, axis]) for axis in range(3))
    dx, dy, dz = (np.ascontiguousarray(step[:, axis]) for axis in range(3))
    return States(
        tail=tail,
        head=head,
        allowed=allowed,
        length=total[piece_first[1:]] - total[piece_first[:-1]],
        out_first=np.searchsorted(tail[order], np.arange(len(graph.nodes) + 1)).astype(np.int64),
        out=order,
        piece_first=piece_first,
        edge=edge,
        along=total[:-1] - total[piece_first[:-1]][edge],
        size=size,
        x=x, y=y, dx=dx, dy=dy, z=z, dz=dz,
        grid=_build_grid(x, y, dx, dy),
    )  # fmt: skip


def edge_weight_array(graph: RoadGraph, weights: pd.Series | None) -> NDArray[np.float64]:
    """Return the weights of edges in the order of the edges; all are 1 if no weights are given.

    Raises
    ------
    InputError
        If an edge has no weight, or one that is not positive and finite.
    """
    if weights is None:
        return np.ones(len(graph.edges))
    values = weights.reindex(graph.edges.index).to_numpy(np.float64, na_value=np.nan)
    bad = ~(np.isfinite(values) & (values > 0))
    if bad.any():
        edge = graph.edges.index[bad][0]
        fault = f"{int(bad.sum())} of {len(bad)} edges have no positive weight (edge {edge}: {values[bad][0]})"
        raise InputError(fault, where="edge_weights", fix="give every edge a weight above 0")
    return values


def build_follow(states: States, weight: NDArray[np.float64], *, uturn_cost: float, turn_cost: float) -> Follow:
    """List the successors of every directed edge, with the cost of continuing on each.

    The cost is that of the turn, and the negative log of the weight of the edge entered over the largest weight
    at the node. This is equation 1 of the paper up to the number of edges at the node, which would make a
    route pay for every node that it passes (METHOD 0.1 row 20).

    Parameters
    ----------
    states
        The states.
    weight
        Shape (E,), the alphas of equation 1.
    uturn_cost, turn_cost
        See `probe2road.matching.models.RouteModel`.
    """
    n_nodes = len(states.out_first) - 1
    largest = np.zeros(n_nodes)
    np.maximum.at(largest, states.tail, np.repeat(weight, 2))
    entry = -np.log(np.repeat(weight, 2) / largest[states.tail])
    return _follow(states, entry, _end_directions(states), uturn_cost, turn_cost)


def _end_directions(states: States) -> _EndDirections:
    """Return the unit directions of directed edges at their start and end; 0 for edges without length.

    Those of their first and last piece, however short: the costs of turns are fitted to these, not to `RoadGraph.ends`.
    """
    solid = np.flatnonzero(states.size > 0)
    n_edges = len(states.length)
    result = [np.zeros(2 * n_edges) for _ in range(4)]
    if not len(solid):
        return _EndDirections(*result)
    lows = np.searchsorted(solid, states.piece_first[:-1])
    highs = np.searchsorted(solid, states.piece_first[1:])
    has = highs > lows
    first, last = solid[np.minimum(lows, len(solid) - 1)], solid[np.maximum(highs - 1, 0)]
    for axis, step in enumerate((states.dx, states.dy)):
        begin = np.where(has, step[first] / states.size[first], 0.0)
        end = np.where(has, step[last] / states.size[last], 0.0)
        result[axis][0::2], result[axis][1::2] = begin, -end
        result[axis + 2][0::2], result[axis + 2][1::2] = end, -begin
    return _EndDirections(*result)


@njit(cache=True)
def _follow(
    states: States, entry: NDArray[np.float64], directions: _EndDirections, uturn_cost: float, turn_cost: float
) -> Follow:
    """List successors; ``entry``, shape (D,), is the cost of entering a directed edge, without the cost of the turn."""
    head, allowed, out_first, out = states.head, states.allowed, states.out_first, states.out
    first_dx, first_dy, last_dx, last_dy = directions
    n_states = len(head)
    first = np.zeros(n_states + 1, np.int64)
    for directed in range(n_states):
        count = 0
        if allowed[directed]:
            for k in range(out_first[head[directed]], out_first[head[directed] + 1]):
                count += allowed[out[k]]
        first[directed + 1] = first[directed] + count
    state, cost = np.empty(first[-1], np.int64), np.empty(first[-1])
    for directed in range(n_states):
        if not allowed[directed]:
            continue
        place = first[directed]
        low, high = out_first[head[directed]], out_first[head[directed] + 1]
        for k in range(low, high):
            other = out[k]
            if not allowed[other]:
                continue
            state[place] = other
            cosine = last_dx[directed] * first_dx[other] + last_dy[directed] * first_dy[other]
            cost[place] = entry[other] + turn_cost * (1.0 - cosine) / 2.0
            if other == directed ^ 1:
                cost[place] += uturn_cost if high - low > 1 else uturn_cost / 2.0
            place += 1
    return Follow(first, state, cost)


def _build_grid(
    x: NDArray[np.float64], y: NDArray[np.float64], dx: NDArray[np.float64], dy: NDArray[np.float64]
) -> CellIndex:
    """Cover the pieces with a grid: about four cells for each piece, and no cell smaller than 50 m."""
    if not len(x):
        return CellIndex(0.0, 0.0, _MIN_CELL, 1, 1, np.zeros(2, np.int64), np.zeros(0, np.int32))
    left, bottom = float(np.minimum(x, x + dx).min()), float(np.minimum(y, y + dy).min())
    width = float(np.maximum(x, x + dx).max()) - left
    height = float(np.maximum(y, y + dy).max()) - bottom
    cell = max(_MIN_CELL, np.sqrt(width * height / (_CELLS_PER_PIECE * len(x))))
    columns, rows = int(width / cell) + 1, int(height / cell) + 1
    first, piece = _fill_grid(x, y, dx, dy, left, bottom, cell, columns, rows)
    return CellIndex(left, bottom, float(cell), columns, rows, first, piece)


@njit(cache=True)
def _fill_grid(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    left: float,
    bottom: float,
    cell: float,
    columns: int,
    rows: int,
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """List every piece in the cells that it may touch: row by row, in the columns between its ends within the row.

    Two passes: the first counts, the second fills.
    """
    first = np.zeros(columns * rows + 1, np.int64)
    piece = np.empty(0, np.int32)
    filled = np.empty(0, np.int64)
    for fill in range(2):
        if fill:
            first = np.cumsum(first)
            piece, filled = np.empty(first[-1], np.int32), first.copy()
        for p in range(len(x)):
            x0, x1 = (x[p] - left) / cell, (x[p] + dx[p] - left) / cell
            y0, y1 = (y[p] - bottom) / cell, (y[p] + dy[p] - bottom) / cell
            for row in range(int(min(y0, y1)), min(int(max(y0, y1)), rows - 1) + 1):
                low, high = min(x0, x1), max(x0, x1)
                if y1 != y0:
                    at_bottom = x0 + (x1 - x0) * (row - y0) / (y1 - y0)
                    at_top = x0 + (x1 - x0) * (row + 1 - y0) / (y1 - y0)
                    low, high = max(low, min(at_bottom, at_top)), min(high, max(at_bottom, at_top))
                for column in range(max(int(low - 1e-9), 0), min(int(high + 1e-9), columns - 1) + 1):
                    c = row * columns + column
                    if fill:
                        piece[filled[c]] = p
                        filled[c] += 1
                    else:
                        first[c + 1] += 1
    return first, piece
