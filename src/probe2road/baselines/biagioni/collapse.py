"""Collapse of short segments where the trips allow it: the topology refinement of Biagioni and Eriksson.

Strategy
--------
Thinning draws one intersection as several with short segments between them. Every short segment, the shortest
first, is tried once: both its nodes move to their middle and the segments that end there with them. The trial
stands if every run that was stored on a segment at the two nodes is still close to one of these segments. Only
what ends at the two nodes is touched, so a trial looks at a handful of segments whatever the size of the map.
"""

from __future__ import annotations

import heapq
import logging
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray
from shapely import LineString

from probe2road.baselines.biagioni.traversals import Runs
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges

__all__ = ["collapse_segments", "run_errors"]

logger = logging.getLogger(__name__)


@dataclass
class _Plan:
    """A map during its changes; one entry for each segment and, for each node, the segments that end there."""

    u: list[int]
    v: list[int]
    lines: list[NDArray[np.float64]]  # m, shape (vertices, 2) each
    length: list[float]  # m
    at_node: list[set[int]]


def collapse_segments(graph: RoadGraph, runs: Runs, *, max_length: float, max_error: float) -> RoadGraph:
    """Collapse short segments to points if all runs stay close to the map.

    Parameters
    ----------
    graph
        The map; segments that are loops are left alone.
    runs
        Good runs, whose segments are rows of its edges.
    max_length
        Longest segment that is tried, m.
    max_error
        Largest root mean square distance of a run from the segments at the two nodes, m.

    Returns
    -------
    RoadGraph
        Without the collapsed segments. The node that stands for two has the id of the first.

    Notes
    -----
    METHOD 4.6.

    Examples
    --------
    Two side roads, one with a run, meet a third road at a distance. Where they are 8 m apart, one crossing serves
    the run as well; where they are 40 m apart, it would be 13 m off:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> drive = np.array([[0.0, 20.0], [0.0, 30.0], [0.0, 40.0]])
    >>> runs = Runs(np.array([3]), np.array([True]), np.array([0, 3]), drive)
    >>> for gap in (8, 40):
    ...     road = [[(-90, 0), (0, 0)], [(0, 0), (gap, 0)], [(gap, 0), (180, 0)]]
    ...     graph = graph_from_lines([*road, [(0, 0), (0, 90)], [(gap, 0), (gap, -90)]], crs="EPSG:32616")
    ...     print(len(collapse_segments(graph, runs, max_length=50.0, max_error=12.0).edges))
    4
    5
    """
    plan = _open(graph)
    stored = [np.flatnonzero(runs.segment == segment) for segment in range(len(plan.lines))]
    queue = [(size, segment) for segment, size in enumerate(plan.length) if size <= max_length]
    heapq.heapify(queue)
    tried: set[int] = set()
    collapsed: list[int] = []
    while queue:
        size, segment = heapq.heappop(queue)
        if segment in tried or size != plan.length[segment] or plan.u[segment] == plan.v[segment]:
            continue  # the length is not that of the entry where the segment was moved since
        tried.add(segment)
        touched = plan.at_node[plan.u[segment]] | plan.at_node[plan.v[segment]]
        moved = _moved_lines(plan, segment, touched)
        errors = run_errors(runs, np.concatenate([stored[other] for other in sorted(touched)]), list(moved.values()))
        if (errors > max_error).any():
            continue
        _collapse(plan, segment, moved)
        collapsed.append(segment)
        for other in moved:
            if plan.length[other] <= max_length:
                heapq.heappush(queue, (plan.length[other], other))
    logger.info("collapsed %d of %d segments up to %g m", len(collapsed), len(tried), max_length)
    return _closed(graph, plan, collapsed)


def run_errors(runs: Runs, chosen: NDArray[np.int64], lines: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the root mean square distance of some runs from the nearest of several lines, m.

    Without lines it is infinite.
    """
    start = np.concatenate([np.zeros((0, 2)), *(line[:-1] for line in lines)])
    stop = np.concatenate([np.zeros((0, 2)), *(line[1:] for line in lines)])
    return _errors(runs.offsets, runs.xy, chosen, start, stop)


def _open(graph: RoadGraph) -> _Plan:
    """Return a map in the form in which it can be changed."""
    u, v = graph.end_rows.T.tolist()
    at_node: list[set[int]] = [set() for _ in graph.nodes.index]
    for segment, nodes in enumerate(zip(u, v, strict=True)):
        for node in nodes:
            at_node[node].add(segment)
    lines = [shapely.get_coordinates(line) for line in graph.edges.geometry]
    return _Plan(u, v, lines, graph.edges["length"].tolist(), at_node)


def _moved_lines(plan: _Plan, segment: int, touched: set[int]) -> dict[int, NDArray[np.float64]]:
    """Connect all touched segments except one to the middle between the ends of that one."""
    nodes = plan.u[segment], plan.v[segment]
    middle = (plan.lines[segment][0] + plan.lines[segment][-1]) / 2.0
    moved = {}
    for other in sorted(touched - {segment}):
        line = plan.lines[other].copy()
        if plan.u[other] in nodes:
            line[0] = middle
        if plan.v[other] in nodes:
            line[-1] = middle
        moved[other] = line
    return moved


def _collapse(plan: _Plan, segment: int, moved: dict[int, NDArray[np.float64]]) -> None:
    """Replace both end nodes of a segment by one of them, and connect the other segments to it."""
    kept, lost = plan.u[segment], plan.v[segment]
    plan.at_node[kept], plan.at_node[lost] = set(moved), set()
    for other, line in moved.items():
        plan.lines[other] = line
        plan.length[other] = float(np.hypot(*np.diff(line, axis=0).T).sum())
        plan.u[other] = kept if plan.u[other] == lost else plan.u[other]
        plan.v[other] = kept if plan.v[other] == lost else plan.v[other]


def _closed(graph: RoadGraph, plan: _Plan, collapsed: list[int]) -> RoadGraph:
    """Return the changed map as a graph, without the segments that have become points."""
    kept = np.setdiff1d(np.flatnonzero(np.array(plan.length) > 0), collapsed)
    u, v = np.array(plan.u, np.int64)[kept], np.array(plan.v, np.int64)[kept]
    lines = [plan.lines[segment] for segment in kept]
    position = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    for ends, vertex in ((u, 0), (v, -1)):
        position[ends] = np.reshape([line[vertex] for line in lines], (-1, 2))
    used = np.unique(np.concatenate([u, v]))
    node = graph.nodes.index.to_numpy()
    edges = graph.edges.iloc[kept].assign(u=node[u], v=node[v], geometry=[LineString(line) for line in lines])
    nodes = graph.nodes.iloc[used].set_geometry(shapely.points(position[used]), crs=graph.crs)
    return replace(graph, nodes=nodes, edges=finish_edges(edges), turns=empty_turns())


@njit(cache=True)
def _errors(
    offsets: NDArray[np.int64],
    xy: NDArray[np.float64],
    chosen: NDArray[np.int64],
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the root mean square distance of chosen runs from the nearest straight piece between start and stop."""
    errors = np.zeros(len(chosen))
    for place in range(len(chosen)):
        first, last = offsets[chosen[place]], offsets[chosen[place] + 1]
        for vertex in range(first, last):
            nearest = np.inf
            for piece in range(len(start)):
                to_x, to_y = xy[vertex, 0] - start[piece, 0], xy[vertex, 1] - start[piece, 1]
                dx, dy = stop[piece, 0] - start[piece, 0], stop[piece, 1] - start[piece, 1]
                squared = dx * dx + dy * dy
                share = min(max((to_x * dx + to_y * dy) / squared, 0.0), 1.0) if squared > 0 else 0.0
                nearest = min(nearest, (to_x - share * dx) ** 2 + (to_y - share * dy) ** 2)
            errors[place] += nearest / (last - first)
    return np.sqrt(errors)
