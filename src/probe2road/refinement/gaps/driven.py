"""Roads that the mask does not show although traces drove them: bundles of traces that leave the graph together.

Strategy
--------
Where few cross a busy road, the crossing is lost in the counts of the busy one: the arcs of a roundabout over a
motorway are a typical case. The traces know it. Each is laid down in points some metres apart, and a point is explained
if an edge of about its direction lies beside it, so that the motorway explains nobody who passes over it. What is left
are runs of unexplained points between two explained ones. The longest run that enough traces accompanied on all of its
way becomes a road, drawn through the middle of its company; then the next of those that no road has taken up.

Legend of array shapes: P points, R runs, B bundles.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from probe2road.bounds import NotNegative, Positive, Share
from probe2road.crs import require_same_crs
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import split_edges
from probe2road.graph.topology import shortest_arcs
from probe2road.matching.beside import edge_beside
from probe2road.options import checked
from probe2road.refinement.gaps.added import with_gap_edges

__all__ = ["DrivenOptions", "add_driven_roads"]

logger = logging.getLogger(__name__)

_SPACING = 4.0  # m between the points of a trace
_LONGEST_STEP = 40.0  # m between two fixes; what lies between two that are farther apart is not known
_MARGIN = 8  # points before and behind a run that still accompany others
_HOLE = 3  # explained points in a row that a run passes over, as where it crosses a road at a flat angle
_COMPANY = 0.9  # share of the points of a run that a trace must have passed to have driven along with it
_TAKEN = 0.5  # share of the points of a run in the company of others, from which it is no road of its own
_LOOK = 10_000.0  # m over the graph, up to which a way round is looked for
_SMOOTHING = 5  # points over which the middle of a bundle is averaged
_NEW_NODE = 5.0  # m; roads that end on an edge within this of each other share a node


@dataclass(frozen=True)
@checked
class DrivenOptions:
    """Which traces off the graph are a road."""

    min_traces: NotNegative[int] = 4  # that drove all along it; 0 adds no road
    min_share: Share = 0.05  # of the traces at the quieter of its ends, that drive along it; fewer are errors
    radius: Positive[float] = 4.0  # m to an edge that explains a point, and to the points of traces in company
    max_angle: Positive[float] = 20.0  # degrees between the two, as undirected lines
    min_length: Positive[float] = 12.0  # m
    detour: Positive[float] = 1.5  # the way over the graph must be this many times as long ...
    slack: NotNegative[float] = 20.0  # m, and longer by this
    beside: NotNegative[float] = 15.0  # m to an edge of about the same direction: a lane of a road that is there
    max_beside: NotNegative[float] = 60.0  # m; a road longer than this is left out if most of it runs so
    snap: NotNegative[float] = 12.0  # m along an edge to its end, up to which a road starts at the node there


@dataclass(frozen=True)
class _Points:
    """P points on traces, in the order of the traces."""

    trace: NDArray[np.int64]  # (P,) number of the trace
    xy: NDArray[np.float64]  # (P, 2) m
    direction: NDArray[np.float64]  # (P, 2) unit vector
    edge: NDArray[np.int64]  # (P,) row of the edge that explains the point, or -1


@dataclass(frozen=True)
class _Cloud:
    """Some of the points, to look for near ones."""

    row: NDArray[np.int64]  # (n,) rows of the points
    tree: cKDTree

    @classmethod
    def of(cls, points: _Points, row: NDArray[np.int64]) -> _Cloud:
        return cls(row, cKDTree(points.xy[row]))


@dataclass(frozen=True)
class _Bundles:
    """B roads that traces drove: their courses, and the explained points before and behind each."""

    course: list[NDArray[np.float64]]  # B arrays (k, 2) m
    ends: NDArray[np.int64]  # (B, 2) rows of points


def add_driven_roads(graph: RoadGraph, fleet: Fleet, *, options: DrivenOptions | None = None) -> RoadGraph:
    """Add edges of origin ``gap`` where traces leave the graph together and come back to it elsewhere.

    A road is added only if the way over the graph between its ends is much longer, so that the lanes of a wide road and
    the corners of crossings are none. It starts and ends at a node or on an edge, which is split there, and meets no
    edge that it crosses. Traces with long steps between their fixes say nothing about the course of a road.

    Parameters
    ----------
    graph
        Any road graph.
    fleet
        The fleet, in the graph's CRS.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        The same object where there is nothing to add.

    Raises
    ------
    CRSError
        If fleet and graph are in different CRS.

    Notes
    -----
    The paper does not have this rule: it fills gaps by geometry and lets traces confirm them.

    Examples
    --------
    Four drives pass over a motorway between two roads that end beside it:

    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(-200, 0), (200, 0)], [(0, -90), (0, -20)], [(0, 20), (0, 90)]]
    >>> graph = graph_from_lines(lines, crs="EPSG:32616")
    >>> fixes = [(n, t, 0.5 * n, 8.0 * t - 80.0) for n in range(4) for t in range(21)]
    >>> table = pd.DataFrame(fixes, columns=["trace_id", "t", "x", "y"])
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> add_driven_roads(graph, fleet).edges[["u", "v", "length"]].round().to_numpy().tolist()[-1]
    [3.0, 4.0, 40.0]
    """
    options = options or DrivenOptions()
    require_same_crs(fleet.crs, graph.crs, where="add_driven_roads")
    if not options.min_traces or graph.edges.empty or fleet.traces.empty:
        return graph
    points = _laid_down(fleet)
    edge = edge_beside(graph, points.xy, points.direction, radius=options.radius, max_angle=options.max_angle)
    if (edge >= 0).all():
        return graph
    points = replace(points, edge=edge)
    first, last, size = _runs(points, options.min_length)
    new = _are_new(graph, points, first, last, size, options)
    bundles = _bundles(points, first[new], last[new], options)
    return _with_roads(graph, points, bundles, options) if bundles.course else graph


def _laid_down(fleet: Fleet) -> _Points:
    """Keep the fixes of every trace that are about as far apart as points should be, and their directions."""
    xy, owner = fleet.traces[["x", "y"]].to_numpy(np.float64), fleet.owner
    begins = np.diff(owner, prepend=-1) != 0
    step = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    passed = np.floor(np.cumsum(np.where(begins, 0.0, step)) / _SPACING)
    kept = begins | (np.diff(passed, prepend=-1.0) != 0)
    xy, owner = xy[kept], owner[kept]
    ahead = np.where((owner[1:] == owner[:-1])[:, None], np.diff(xy, axis=0), 0.0)
    course = np.vstack([ahead, np.zeros((1, 2))]) + np.vstack([np.zeros((1, 2)), ahead])
    return _Points(owner, xy, course / np.maximum(np.hypot(*course.T), 1e-9)[:, None], np.full(len(xy), -1))


def _runs(points: _Points, min_length: float) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the first and the last unexplained point, and the length (m), of every run that explained ones enclose."""
    off = points.edge < 0
    step = np.hypot(*np.diff(points.xy, axis=0).T)
    known = (points.trace[1:] == points.trace[:-1]) & (step <= _LONGEST_STEP)
    first = np.flatnonzero(off & ~np.append(False, off[:-1] & known))
    last = np.flatnonzero(off & ~np.append(off[1:] & known, False))
    stretch = np.append(0, np.cumsum(~known))  # points between which nothing is unknown share a number
    joined = (first[1:] - last[:-1] <= _HOLE + 1) & (stretch[first[1:]] == stretch[last[:-1]])
    first, last = first[np.append(True, ~joined)], last[np.append(~joined, True)]
    inner = (first > 0) & (last < len(off) - 1)
    first, last = first[inner], last[inner]
    enclosed = (stretch[first - 1] == stretch[first]) & (stretch[last + 1] == stretch[last])
    path = np.append(0.0, np.cumsum(np.where(known, step, 0.0)))
    size = path[last] - path[first]
    kept = enclosed & (size >= min_length)
    return first[kept], last[kept], size[kept]


def _are_new(
    graph: RoadGraph,
    points: _Points,
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    size: NDArray[np.float64],
    options: DrivenOptions,
) -> NDArray[np.bool_]:
    """Tell which runs shorten the way over the graph, and are no lane beside an edge, shape ``(R,)``."""
    edge, along = _places(graph, points, np.stack([first - 1, last + 1], axis=1))
    new = _ways(graph, edge, along) > options.detour * size + options.slack
    long = np.flatnonzero(new & (size > options.max_beside))
    count = last[long] - first[long] + 1
    owner = np.repeat(np.arange(len(long)), count)
    row = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count) + first[long][owner]
    found = edge_beside(
        graph, points.xy[row], points.direction[row], radius=options.beside, max_angle=options.max_angle
    )
    new[long[np.bincount(owner, found >= 0, len(long)) > 0.5 * count]] = False
    return new


def _places(graph: RoadGraph, points: _Points, row: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the edges (rows) that explain points, and how far along them (m) these lie; shapes as that of ``row``."""
    edge = points.edge[row]
    lines = shapely.force_2d(graph.edges.geometry.to_numpy())[edge]
    return edge, shapely.line_locate_point(lines, shapely.points(points.xy[row]))


def _bundles(points: _Points, first: NDArray[np.int64], last: NDArray[np.int64], options: DrivenOptions) -> _Bundles:
    """Find the runs that enough traces accompanied, the longest first, and draw each through their middle."""
    near = np.zeros(len(points.trace) + 1, np.int64)
    np.add.at(near, np.maximum(first - _MARGIN, 0), 1)
    np.add.at(near, np.minimum(last + _MARGIN + 1, len(points.trace)), -1)
    off = _Cloud.of(points, np.flatnonzero(np.cumsum(near)[:-1] > 0))
    on = _Cloud.of(points, np.flatnonzero(points.edge >= 0))
    # Runs without enough points of traces near their middle are left out; the place settles the order of equal ones.
    middle = points.xy[(first + last) // 2]
    crowded = off.tree.query_ball_point(middle, options.radius, return_length=True) >= options.min_traces
    order = np.lexsort([*points.xy[first].T, first - last])
    taken, beside = np.zeros(len(points.trace), bool), np.zeros(len(points.trace), bool)
    course, ends = [], []
    for begin, stop in zip(first[order[crowded[order]]], last[order[crowded[order]]], strict=True):
        own = np.arange(begin, stop + 1)
        is_lane = len(own) * _SPACING > options.max_beside and beside[own].mean() > _TAKEN
        if is_lane or taken[own].mean() > _TAKEN:
            continue
        at, other = _company(points, own, *_alike(points, off, own, options.radius, options.max_angle))
        traces = pd.unique(points.trace[other]).size
        passing = min(_passing(points, on, end, options.radius) for end in (begin - 1, stop + 1))
        if traces < max(options.min_traces, options.min_share * passing):
            continue
        course.append(_middle(points, own, at, other))
        ends.append((begin - 1, stop + 1))
        taken[other] = True
        beside[_alike(points, off, own, options.beside, options.max_angle)[1]] = True
    return _Bundles(course, np.array(ends, np.int64).reshape(-1, 2))


def _alike(
    points: _Points, cloud: _Cloud, own: NDArray[np.int64], radius: float, max_angle: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of a point of a run, by its number in it, and a near point of a cloud of about its direction."""
    near = cKDTree(points.xy[own]).sparse_distance_matrix(cloud.tree, radius, output_type="coo_matrix")
    at, other = near.row.astype(np.int64), cloud.row[near.col]
    cosine = np.abs((points.direction[own[at]] * points.direction[other]).sum(axis=1))
    alike = cosine >= np.cos(np.radians(max_angle))
    return at[alike], other[alike]


def _company(
    points: _Points, own: NDArray[np.int64], at: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keep the pairs with traces that drove all along with a run."""
    passed = pd.DataFrame({"trace": points.trace[other], "at": at}).drop_duplicates()["trace"].value_counts()
    along = np.isin(points.trace[other], passed.index[passed >= _COMPANY * len(own)])
    return at[along], other[along]


def _passing(points: _Points, on: _Cloud, end: int, radius: float) -> int:
    """Count the traces that passed an explained point on its edge, given all that are explained."""
    near = on.row[on.tree.query_ball_point(points.xy[end], 2 * radius)]
    return pd.unique(points.trace[near[points.edge[near] == points.edge[end]]]).size


def _middle(
    points: _Points, own: NDArray[np.int64], at: NDArray[np.int64], other: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Move the points of a run to the middle of its company, shape ``(k, 2)``."""
    direction = points.direction[own]
    left = np.column_stack([-direction[:, 1], direction[:, 0]])
    offset = ((points.xy[other] - points.xy[own[at]]) * left[at]).sum(axis=1)
    middle = pd.Series(offset).groupby(at).median().reindex(np.arange(len(own)))
    smooth = middle.rolling(_SMOOTHING, center=True, min_periods=1).mean().to_numpy()
    return points.xy[own] + smooth[:, None] * left


def _with_roads(graph: RoadGraph, points: _Points, bundles: _Bundles, options: DrivenOptions) -> RoadGraph:
    """Add the bundles as edges, and split the edges on which they end."""
    edge, along = _places(graph, points, bundles.ends)  # (B, 2)
    to_end = np.stack([along, graph.edges["length"].to_numpy()[edge] - along])
    at_node = to_end.min(axis=0) <= options.snap
    node = graph.nodes.index.to_numpy()[np.where(to_end[0] <= to_end[1], *np.moveaxis(graph.end_rows[edge], -1, 0))]
    split, node[~at_node] = split_edges(
        graph, graph.edges.index.to_numpy()[edge[~at_node]], along[~at_node], merge=_NEW_NODE
    )
    kept = np.flatnonzero(node[:, 0] != node[:, 1])
    logger.info("added %d roads that traces drove off the graph", len(kept))
    if not len(kept):
        return graph
    return with_gap_edges(split, node[kept, 0], node[kept, 1], [bundles.course[row] for row in kept])


def _ways(graph: RoadGraph, edge: NDArray[np.int64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the way over the graph between pairs of places ``(B, 2)``, m; infinite where there is none in reach."""
    rows, length = graph.end_rows, graph.edges["length"].to_numpy()
    sources, source = np.unique(rows[edge[:, 0]], return_inverse=True)
    arcs = shortest_arcs(rows[:, 0], rows[:, 1], length, len(graph.nodes))
    between = dijkstra(arcs, directed=False, indices=sources, limit=_LOOK)
    to_ends = np.stack([along, length[edge] - along], axis=2)  # (B, 2, 2): place, end of its edge
    way = np.where(edge[:, 0] == edge[:, 1], np.abs(np.diff(along)[:, 0]), np.inf)
    for out in (0, 1):
        for back in (0, 1):
            reached = between[source.reshape(-1, 2)[:, out], rows[edge[:, 1], back]]
            way = np.minimum(way, to_ends[:, 0, out] + reached + to_ends[:, 1, back])
    return way
