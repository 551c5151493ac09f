"""Matched fleets in the coordinates of edges: how far along and beside its edge every fix is, and what was driven.

Strategy
--------
All edges lie one behind the other in one array of vertices, so that a place ``(edge, along)`` is found for all fixes
at once by bisection in one ascending distance. Fixes are dealt out to the traversals of their trace in a single pass;
a traversal then covers an edge from where it was entered, or its first fix, to where it was left, or its last fix.

Legend of array shapes: E edges, P vertices, T traversals, n matched fixes, S stations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import shapely
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from probe2road.errors import InputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import Matches
from probe2road.matching.tables import step_rows

__all__ = [
    "EdgeLines",
    "FramedFixes",
    "Stations",
    "Traversals",
    "courses",
    "edge_lines",
    "frame",
    "robust_sigma",
    "smooth_stations",
    "stations_along",
]

_SIGMA_OF_MAD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_SAME_PLACE = 0.01  # m


@dataclass(frozen=True)
class EdgeLines:
    """The vertices of all edges, edge after edge."""

    xyz: NDArray[np.float64]  # (P, 3) m, z NaN where unknown
    first: NDArray[np.int64]  # (E + 1,)
    along: NDArray[np.float64]  # (P,) m from the start of all edges laid end to end, in plan
    length: NDArray[np.float64]  # (E,) m, in plan

    def at(self, edge: NDArray[np.int64], along: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return positions ``(n, 3)`` and unit directions ``(n, 2)`` at distances along edges (rows, m from u)."""
        along = self.along[self.first[edge]] + np.clip(along, 0.0, self.length[edge])
        # A vertex shared by two edges occurs twice at one distance: stay between the first and last piece of the edge.
        piece = np.searchsorted(self.along, along, side="right") - 1
        piece = np.clip(piece, self.first[edge], self.first[edge + 1] - 2)
        step = self.xyz[piece + 1] - self.xyz[piece]
        size = self.along[piece + 1] - self.along[piece]
        share = np.divide(along - self.along[piece], size, out=np.zeros(len(along)), where=size > 0)
        norm = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        return self.xyz[piece] + share[:, None] * step, step[:, :2] / norm[:, None]


@dataclass(frozen=True)
class Traversals:
    """T traversals of an edge by a drive, in the order of the traces."""

    trace: NDArray[np.int64]  # (T,) number of the trace
    edge: NDArray[np.int64]  # (T,) row of the edge
    forward: NDArray[np.bool_]  # (T,) from u to v
    low: NDArray[np.float64]  # (T,) m from the start of the edge; where what was covered begins
    high: NDArray[np.float64]  # (T,) the same for its end; not above low where nothing was covered


@dataclass(frozen=True)
class FramedFixes:
    """n matched fixes, in the order of the traces."""

    row: NDArray[np.int64]  # (n,) of the table of fixes
    traversal: NDArray[np.int64]  # (n,)
    along: NDArray[np.float64]  # (n,) m from the start of the edge
    left: NDArray[np.float64]  # (n,) m to the left of the edge, seen from its start


@dataclass(frozen=True)
class Stations:
    """S stations on edges, at equal distances from end to end of each edge."""

    first: NDArray[np.int64]  # (E + 1,)
    edge: NDArray[np.int64]  # (S,) row of the edge
    along: NDArray[np.float64]  # (S,) m from its start
    spacing: NDArray[np.float64]  # (E,) m

    def interpolate(
        self, values: NDArray[np.float64], edge: NDArray[np.int64], along: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Interpolate values ``(S,)`` or ``(S, d)`` linearly at places on edges."""
        number = np.clip(along / np.maximum(self.spacing[edge], 1e-9), 0.0, np.diff(self.first)[edge] - 1.0)
        before = np.minimum(number.astype(np.int64), np.diff(self.first)[edge] - 2)
        share = (number - before).reshape((-1,) + (1,) * (values.ndim - 1))
        before = before + self.first[edge]
        return (1 - share) * values[before] + share * values[before + 1]

    def bends(self, values: NDArray[np.float64], tolerance: float) -> NDArray[np.bool_]:
        """Tell at which stations values ``(S,)`` bend: lines between these stay within a tolerance of all values."""
        drawn = shapely.linestrings(np.column_stack([self.along, values]), indices=self.edge)
        kept, edge = shapely.get_coordinates(shapely.simplify(drawn, tolerance), return_index=True)
        needed = np.zeros(len(values), bool)
        needed[self.nearest(edge, kept[:, 0])] = True
        return needed

    def nearest(self, edge: NDArray[np.int64], along: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the nearest station to places on edges."""
        number = np.rint(along / np.maximum(self.spacing[edge], 1e-9)).astype(np.int64)
        return self.first[edge] + np.clip(number, 0, np.diff(self.first)[edge] - 1)


def edge_lines(graph: RoadGraph) -> EdgeLines:
    """Concatenate the vertices of all edges.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = edge_lines(graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 8)]], crs="EPSG:32616"))
    >>> place, direction = lines.at(np.array([0, 1, 1]), np.array([3.0, 0.0, 99.0]))
    >>> place[:, :2].tolist(), direction.tolist()
    ([[3.0, 0.0], [9.0, 0.0], [9.0, 8.0]], [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    """
    xyz, owner = shapely.get_coordinates(graph.edges.geometry.to_numpy(), include_z=True, return_index=True)
    first = np.searchsorted(owner, np.arange(len(graph.edges) + 1)).astype(np.int64)
    step = np.hypot(*np.diff(xyz[:, :2], axis=0, prepend=xyz[:1, :2]).T)
    step[first[:-1]] = 0.0
    along = np.cumsum(step)
    return EdgeLines(xyz, first, along, along[first[1:] - 1] - along[first[:-1]])


def stations_along(length: NDArray[np.float64], spacing: float) -> Stations:
    """Place stations on edges of given lengths (m): at most ``spacing`` (m) apart, and always at both ends.

    Examples
    --------
    >>> stations_along(np.array([25.0, 3.0]), 10.0).along.round(1).tolist()
    [0.0, 8.3, 16.7, 25.0, 0.0, 3.0]
    """
    count = np.maximum(np.ceil(length / spacing).astype(np.int64), 1) + 1
    first = np.concatenate([[0], np.cumsum(count)])
    edge = np.repeat(np.arange(len(length)), count)
    step = length / (count - 1)
    return Stations(first, edge, (np.arange(len(edge)) - first[edge]) * step[edge], step)


def courses(
    lines: EdgeLines, stations: Stations, needed: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the vertices of edges and the stations: rows of edges, m from the start ``(n,)``, positions ``(n, 3)``.

    Parameters
    ----------
    lines
        The edges.
    stations
        Stations on them.
    needed
        Shape (S,): which to add. None is added at a vertex.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = edge_lines(graph_from_lines([[(0, 0), (14, 0), (20, 0)]], crs="EPSG:32616"))
    >>> courses(lines, stations_along(lines.length, 10.0), np.array([True, True, True]))[1].tolist()
    [0.0, 10.0, 14.0, 20.0]
    """
    old = np.repeat(np.arange(len(lines.length)), np.diff(lines.first))
    edge = np.concatenate([old, stations.edge[needed]])
    along = np.concatenate([lines.along - lines.along[lines.first[:-1]][old], stations.along[needed]])
    xyz = np.concatenate([lines.xyz, lines.at(edge[len(old) :], along[len(old) :])[0]])
    is_added = np.arange(len(edge)) >= len(old)
    order = np.lexsort([is_added, along, edge])
    close = (np.diff(along[order]) < _SAME_PLACE) & (np.diff(edge[order]) == 0)
    order = order[~(is_added[order] & (np.append(False, close) | np.append(close, False)))]
    return edge[order], along[order], xyz[order]


def frame(graph: RoadGraph, fleet: Fleet, matches: Matches) -> tuple[Traversals, FramedFixes]:
    """Return a matched fleet in the coordinates of the edges.

    A trace that was lost on an edge and found again on it, in the same direction, traversed it once.

    Parameters
    ----------
    graph
        The graph that was matched on. Its edges may have more vertices by now, but not another course.
    fleet
        The fleet that was matched.
    matches
        The result.

    Returns
    -------
    Traversals, FramedFixes

    Raises
    ------
    InputError
        If the matches belong to another fleet or graph.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.matching.match import match
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (200, 0)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(3), "x": [40.0, 90, 140], "y": [2.0, 1, -1]})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> driven, fixes = frame(graph, fleet, match(graph, fleet))
    >>> driven.low.tolist(), driven.high.tolist(), fixes.left.tolist()
    ([40.0, 0.0], [100.0, 40.0], [2.0, 1.0, -1.0])
    """
    table = matches.fixes
    if len(table) != len(fleet.traces):
        fault = f"the matches are of {len(table)} fixes, the fleet has {len(fleet.traces)}"
        raise InputError(fault, where="frame", fix="pass the fleet that was matched")
    trace, edge, forward, entered, left = _steps(graph, fleet, matches)
    row = np.flatnonzero(table["edge"].notna().to_numpy())
    of_fix = graph.edges.index.get_indexer(table["edge"].to_numpy(np.int64, na_value=-1)[row]).astype(np.int64)
    way = table["forward"].to_numpy(bool, na_value=False)[row]
    first = np.searchsorted(trace, np.arange(fleet.n_traces + 1))
    traversal = _dealt_out(fleet.owner[row], of_fix, way, first, edge, forward)
    row, traversal = row[traversal >= 0], traversal[traversal >= 0]

    lines = edge_lines(graph)
    along = table["offset"].to_numpy(np.float64)[row]
    place, direction = lines.at(edge[traversal], along)
    away = fleet.traces[["x", "y"]].to_numpy(np.float64)[row] - place[:, :2]
    fixes = FramedFixes(row, traversal, along, direction[:, 0] * away[:, 1] - direction[:, 1] * away[:, 0])
    low, high = _covered(fixes, lines.length[edge], forward, entered, left)
    return Traversals(trace, edge, forward, low, high), fixes


def _steps(graph: RoadGraph, fleet: Fleet, matches: Matches) -> tuple[NDArray[Any], ...]:
    """Return trace, edge, forward, entered and left of every traversal, shape (T,); broken steps are joined."""
    steps = matches.steps
    edge = step_rows(graph, steps, where="frame")
    trace = fleet.ids.get_indexer(steps["trace_id"]).astype(np.int64)
    forward, entered, left = (steps[name].to_numpy(bool) for name in ("forward", "entered", "left"))
    again = np.zeros(len(edge), bool)
    again[1:] = ~entered[1:] & (trace[1:] == trace[:-1]) & (edge[1:] == edge[:-1]) & (forward[1:] == forward[:-1])
    head = np.flatnonzero(~again)
    tail = np.append(head[1:], len(edge)) - 1 if len(head) else head
    return trace[head], edge[head], forward[head], entered[head], left[tail]


@njit(cache=True)
def _dealt_out(
    owner: NDArray[np.int64],
    edge: NDArray[np.int64],
    forward: NDArray[np.bool_],
    first: NDArray[np.int64],
    step_edge: NDArray[np.int64],
    step_forward: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Assign a traversal to every fix: that of the fix before if it fits, else the next of the trace that fits."""
    out = np.full(len(edge), -1)
    trace, here = -1, 0
    for fix in range(len(edge)):
        if owner[fix] != trace:
            trace = owner[fix]
            here = first[trace]
        step = here
        while step < first[trace + 1] and (step_edge[step] != edge[fix] or step_forward[step] != forward[fix]):
            step += 1
        if step < first[trace + 1]:
            out[fix] = here = step
    return out


def _covered(
    fixes: FramedFixes,
    length: NDArray[np.float64],
    forward: NDArray[np.bool_],
    entered: NDArray[np.bool_],
    left: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the stretch of its edge that each traversal covers; all arguments but the fixes have shape (T,)."""
    low, high = np.full(len(length), np.inf), np.full(len(length), -np.inf)
    np.minimum.at(low, fixes.traversal, fixes.along)
    np.maximum.at(high, fixes.traversal, fixes.along)
    from_start, to_end = np.where(forward, entered, left), np.where(forward, left, entered)
    low, high = np.where(from_start, 0.0, low), np.where(to_end, length, high)
    # An edge that was entered or left between two fixes, but not both: no stretch of it was covered.
    open_ended = ~np.isfinite(low) | ~np.isfinite(high)
    return np.where(open_ended, 0.0, low), np.where(open_ended, 0.0, high)


def robust_sigma(values: NDArray[np.float64], group: NDArray[np.int64], n_groups: int) -> NDArray[np.float64]:
    """Return the spread (1 sigma, from the median absolute deviation) of each group; NaN for fewer than two values.

    Examples
    --------
    >>> robust_sigma(np.array([1.0, 2.0, 3.0, 7.0]), np.array([0, 0, 0, 1]), 3).round(2).tolist()
    [1.48, nan, nan]
    """
    series = pd.Series(np.asarray(values, np.float64))
    away = (series - series.groupby(group).transform("median")).abs()
    found = away.groupby(group).agg(["median", "count"])
    sigma = np.full(n_groups, np.nan)
    enough = found[found["count"] > 1]
    sigma[enough.index.to_numpy(np.int64)] = _SIGMA_OF_MAD * enough["median"].to_numpy()
    return sigma


def smooth_stations(
    value: NDArray[np.float64], weight: NDArray[np.float64], stations: Stations, *, reach: float, pull: float
) -> NDArray[np.float64]:
    """Smooth values along every edge: penalised least squares with second differences.

    Minimises, edge by edge, the weighted squares of the deviations from the values, plus ``pull`` times the squares
    of the result, plus the squares of its second differences at a weight with which features shorter than ``reach``
    are levelled. Stations without a value have weight 0.

    Parameters
    ----------
    value, weight
        Shape (S,); the value of a station with weight 0 does not matter.
    stations
        Where they are.
    reach
        m.
    pull
        Weight of zero, above 0.

    Returns
    -------
    ndarray, shape (S,)

    Examples
    --------
    >>> stations = stations_along(np.array([40.0]), 10.0)
    >>> flat = smooth_stations(np.array([2.0, 0, 2, 0, 2]), np.array([1.0, 0, 1, 0, 1]), stations, reach=30, pull=1e-9)
    >>> flat.round(3).tolist()
    [2.0, 2.0, 2.0, 2.0, 2.0]
    """
    n = len(value)
    if n == 0:
        return np.zeros(0)
    mean_weight = np.bincount(stations.edge, weight, len(stations.spacing)) / np.maximum(np.diff(stations.first), 1)
    spacing = np.maximum(stations.spacing, 1e-3)
    stiffness = (np.maximum(mean_weight, pull) * (reach / (2 * np.pi * spacing)) ** 4)[stations.edge]
    inner = np.flatnonzero(stations.edge[2:] == stations.edge[:-2]) if n > 2 else np.zeros(0, np.int64)
    band = np.zeros((3, n))  # upper form: row 2 is the diagonal, row 0 the second one above it
    band[2] = weight + pull
    for k, factor in enumerate((1.0, -2.0, 1.0)):
        for j, other in enumerate((1.0, -2.0, 1.0)[k:], start=k):
            np.add.at(band[2 - (j - k)], inner + j, factor * other * stiffness[inner])
    return solveh_banded(band, np.where(weight > 0, weight * value, 0.0), check_finite=False)
