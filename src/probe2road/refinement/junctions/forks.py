"""Forks: junctions where two roads separate at a flat angle, moved to where their traces separate.

Strategy
--------
Two roads that part at a flat angle are one line of pixels until they are some metres apart, so a fork that was traced
from a mask lies tens of metres behind the place where the roads part. The traces know that place. Before it, the traces
of either road run along the common one at a constant distance from each other, which is that of the lanes they chose;
from there on the distance changes: it grows, or shrinks first where the ramp begins in the middle of the road and
traces swing towards it. So for every fork the distance between the medians of both groups is taken in bins along the
common road. Seen from the fork, the first stretch of some length on which it stays the same is where both roads are
still one, and the fork belongs at its near end.

Where a lane of its own leads to a ramp, traces change to it before the fork: their distance grows by a lane, stays, and
grows again. The stretch nearest to the fork then is that on the lane, as it should be; it may be shorter, where it lies
a lane beyond the next. How much the distance may change on a stretch follows its noise, which is told from bin to bin.

Legend of array shapes: E edges, F forks, B bins, n fixes. Ends of edges are numbered: 2 row at u, 2 row + 1 at v.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from probe2road.bounds import NotNegative
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import finish_edges
from probe2road.matching.frame import FramedFixes, Traversals, frame
from probe2road.matching.match import Matches
from probe2road.options import checked

__all__ = ["ForkOptions", "Forks", "find_forks", "move_forks"]

logger = logging.getLogger(__name__)

_NEAR, _FAR = 10.0, 40.0  # m from a junction between which the direction of a road is measured
_SHARE = 0.9  # share of a short road over which the direction is measured
_STRAIGHT = -0.75  # cosine between the common road and the mean of both branches, at most
_BIN = 5.0  # m along the common road
_NOISE = 3.0  # times the usual bend of the distances from bin to bin: by this they differ by noise alone
_KEPT = 10.0  # m of the common road that must remain
_LEAST = 3.0  # m; moving by less is not worth it


@dataclass(frozen=True)
@checked
class ForkOptions:
    """Which forks are moved, and how far."""

    reach: NotNegative[float] = 200.0  # m of the common road in which the place of a fork is looked for; 0 moves none
    max_angle: NotNegative[float] = 35.0  # degrees between the two branches of a fork
    min_traces: NotNegative[int] = 3  # traces that each branch needs at a place
    min_level: NotNegative[float] = 40.0  # m along which traces keep their distance before they part
    max_change: NotNegative[float] = 0.35  # m by which their distance may change there, or more where it is noisy
    min_lane_level: NotNegative[float] = 20.0  # m of a level on a lane that traces change to before they part
    min_lane: NotNegative[float] = 3.0  # m, width of such a lane
    rejoin: NotNegative[float] = 12.0  # m behind the old place of the fork, from which the branches stay as they were


@dataclass(frozen=True)
class Forks:
    """F nodes where one road becomes two, as rows of nodes and numbers of edge ends."""

    node: NDArray[np.int64]  # (F,)
    stem: NDArray[np.int64]  # (F,) end of the common road
    branch: NDArray[np.int64]  # (F, 2) ends of the two that part


def move_forks(graph: RoadGraph, fleet: Fleet, matches: Matches, *, options: ForkOptions | None = None) -> RoadGraph:
    """Move forks back along the common road to where the traces of the two branches separate.

    Topology, ids and attributes stay; geometry, ``length`` and the places of nodes change. A fork stays where it is if
    a branch has too few traces, if their distance stays the same up to it, or if it changes all along the road that is
    seen. Where both ends of a road are forks, they share its length. The matches no longer fit the result: match again.

    Parameters
    ----------
    graph
        The graph that was matched on.
    fleet
        The fleet that was matched.
    matches
        From `probe2road.matching.match.match`.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph

    Raises
    ------
    InputError
        If the matches belong to another fleet or graph.

    Examples
    --------
    A ramp that leaves at 100 m, traced from a mask that saw it from 150 m on:

    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.matching.match import match
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (150, 0)], [(150, 0), (160, 0), (300, 0)], [(150, 0), (160, -6), (300, -20)]]
    >>> graph = graph_from_lines(lines, crs="EPSG:32616")
    >>> x = np.arange(2.5, 300, 5)
    >>> lanes = [np.zeros(60), np.minimum(0.0, (100 - x) / 10)]
    >>> drives = [pd.DataFrame({"trace_id": k, "t": range(60), "x": x, "y": lanes[k % 2]}) for k in range(8)]
    >>> fleet = fleet_from_tables(pd.concat(drives), crs="EPSG:32616", keep_crs=True)
    >>> moved = move_forks(graph, fleet, match(graph, fleet))
    >>> bool(abs(moved.nodes.geometry[1].x - 100) < 5), bool(moved.edges["length"][0] < 105)
    (True, True)
    """
    options = options or ForkOptions()
    forks = find_forks(graph, max_angle=options.max_angle)
    if not len(forks.node) or not options.reach:
        return graph
    driven, fixes = frame(graph, fleet, matches)
    length = shapely.length(graph.edges.geometry.to_numpy())
    apart, count = _distances(forks, driven, fixes, length, options)
    shift = _room(forks, _level_ends(apart, count, options), length)
    moved = shift > 0
    logger.info(
        "moved %d of %d forks by %.0f m on average", moved.sum(), len(moved), shift[moved].mean() if moved.any() else 0
    )
    return _moved(graph, forks, shift, options.rejoin)


def find_forks(graph: RoadGraph, *, max_angle: float = ForkOptions.max_angle) -> Forks:
    """Find the nodes of three edges where two edges continue in about the direction of the third.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (90, 0)], [(90, 0), (180, 0)], [(90, 0), (180, 20)], [(180, 0), (180, -90)]]
    >>> forks = find_forks(graph_from_lines(lines, crs="EPSG:32616"))
    >>> forks.node.tolist(), forks.stem.tolist(), forks.branch.tolist()
    ([1], [1], [[2, 4]])
    """
    measured = graph.ends(reach=_FAR, skip=_NEAR, share=_SHARE)
    ahead = measured.ahead
    order = np.argsort(measured.node, kind="stable")
    node, first, count = np.unique(measured.node[order], return_index=True, return_counts=True)
    ends = order[first[count == 3][:, None] + np.arange(3)]  # (N, 3)
    node = node[count == 3]
    pairs = np.array([(0, 1), (0, 2), (1, 2)])
    cosine = (ahead[ends[:, pairs[:, 0]]] * ahead[ends[:, pairs[:, 1]]]).sum(axis=2)
    best = cosine.argmax(axis=1)
    every = np.arange(len(ends))
    branch, stem = ends[every[:, None], pairs[best]], ends[every, 2 - best]
    middle = ahead[branch].mean(axis=1)
    onward = (ahead[stem] * middle).sum(axis=1)
    three = (np.diff(np.sort(ends // 2, axis=1), axis=1) > 0).all(axis=1)
    fork = three & (cosine[every, best] >= np.cos(np.radians(max_angle))) & (onward <= _STRAIGHT)
    return Forks(node[fork], stem[fork], branch[fork])


def _distances(
    forks: Forks, driven: Traversals, fixes: FramedFixes, length: NDArray[np.float64], options: ForkOptions
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the distance between the branches' traces along the common road, and the smaller count, ``(F, B)``."""
    of_end = np.full(2 * len(length), -1)
    of_end[forks.stem] = np.arange(len(forks.stem))
    bins = max(int(options.reach / _BIN), 1)
    parts = []
    for end in (0, 1):
        fork = of_end[2 * driven.edge + end]
        branch = _branch_taken(forks, driven, fork, end)
        traversal = fixes.traversal
        along = fixes.along if end == 0 else length[driven.edge[traversal]] - fixes.along
        place = np.floor(along / _BIN).astype(np.int64)
        used = (fork[traversal] >= 0) & (branch[traversal] >= 0) & (place >= 0) & (place < bins)
        columns = {"fork": fork[traversal], "branch": branch[traversal], "bin": place, "drive": traversal}
        parts.append(pd.DataFrame({**columns, "left": fixes.left})[used])
    table = pd.concat(parts)
    means = table.groupby(["fork", "branch", "bin", "drive"])["left"].mean()
    groups = means.groupby(level=["fork", "branch", "bin"]).agg(["median", "count"])
    middle, count = np.full((len(forks.node), 2, bins), np.nan), np.zeros((len(forks.node), 2, bins), np.int64)
    at = tuple(groups.index.get_level_values(level).to_numpy() for level in range(3))
    middle[at], count[at] = groups["median"].to_numpy(), groups["count"].to_numpy()
    return middle[:, 0] - middle[:, 1], count.min(axis=1)


def _branch_taken(forks: Forks, driven: Traversals, fork: NDArray[np.int64], end: int) -> NDArray[np.int64]:
    """Return the branch that each drive takes at one end of its edge: 0, 1, or -1 for neither; ``(T,)``."""
    same = driven.trace[1:] == driven.trace[:-1]
    after, before = np.full(len(driven.edge), -1), np.full(len(driven.edge), -1)
    after[:-1][same], before[1:][same] = driven.edge[1:][same], driven.edge[:-1][same]
    other = np.where(driven.forward == (end == 1), after, before)
    branches = forks.branch[fork] // 2
    return np.where(other == branches[:, 0], 0, np.where(other == branches[:, 1], 1, -1))


def _level_ends(apart: NDArray[np.float64], count: NDArray[np.int64], options: ForkOptions) -> NDArray[np.float64]:
    """Return how far (m) from each fork the first stretch of constant distance begins, ``(F,)``; 0 if there is none."""
    known = np.where(count >= max(options.min_traces, 1), apart, np.nan)
    return np.array([_level_end(distances, options) for distances in known])


def _level_end(distances: NDArray[np.float64], options: ForkOptions) -> float:
    """Return how far from one fork the first level begins, given distances ``(B,)`` that are NaN where unknown."""
    change = max(options.max_change, _NOISE * _usual_bend(distances[np.isfinite(distances)]))
    starts, levels = _levels(distances, options.min_level, change)
    if not len(starts):
        return 0.0
    first, level = starts[0], levels[0]
    starts, lanes = _levels(distances[:first], options.min_lane_level, options.max_change)  # noise hides short levels
    nearest = distances[np.isfinite(distances)][0]
    leaves = (starts == 0) | ((nearest - lanes) * np.sign(lanes - level) >= options.max_change)
    on_lane = (np.abs(lanes - level) >= options.min_lane) & leaves
    first = starts[on_lane][0] if on_lane.any() else first
    return float((first + 0.5) * _BIN) if first else 0.0


def _levels(
    distances: NDArray[np.float64], length: float, change: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find where distances ``(B,)`` change by no more than a bound over a length (m): first bins, and the distances.

    At least half of the bins must be known, and the first of them.
    """
    size = max(int(np.ceil(length / _BIN)), 1)
    if len(distances) < size:
        return np.zeros(0, np.int64), np.zeros(0)
    part = np.lib.stride_tricks.sliding_window_view(distances, size)
    known = np.isfinite(part)
    highest, lowest = np.where(known, part, -np.inf).max(axis=1), np.where(known, part, np.inf).min(axis=1)
    level = (highest - lowest <= change) & known[:, 0] & (known.sum(axis=1) >= size / 2)
    return np.flatnonzero(level), (highest[level] + lowest[level]) / 2


def _usual_bend(values: NDArray[np.float64]) -> float:
    """Return the median size of the second differences of values, 0 for fewer than three."""
    return float(np.median(np.abs(np.diff(values, 2)))) if len(values) > 2 else 0.0


def _room(forks: Forks, shift: NDArray[np.float64], length: NDArray[np.float64]) -> NDArray[np.float64]:
    """Limit shifts (m) to the length of the common road, so that two forks do not pass each other."""
    stem = forks.stem // 2
    wanted = np.bincount(stem, shift, minlength=len(length))[stem]
    room = np.maximum(length[stem] - _KEPT, 0.0)
    shift = shift * np.minimum(1.0, np.divide(room, wanted, out=np.ones(len(shift)), where=wanted > 0))
    return np.where(shift >= _LEAST, shift, 0.0)


def _moved(graph: RoadGraph, forks: Forks, shift: NDArray[np.float64], rejoin: float) -> RoadGraph:
    """Shorten common roads by a shift (m), and lead both branches straight from there."""
    lines, nodes = graph.edges.geometry.to_numpy().copy(), graph.nodes.geometry.to_numpy().copy()

    def outward(end: int) -> shapely.LineString:
        return shapely.reverse(lines[end // 2]) if end % 2 else lines[end // 2]

    def put(end: int, line: shapely.LineString) -> None:
        lines[end // 2] = shapely.reverse(line) if end % 2 else line

    for fork in np.flatnonzero(shift):
        stem = outward(forks.stem[fork])
        rest = substring(stem, shift[fork], stem.length)
        put(forks.stem[fork], rest)
        start = shapely.get_coordinates(rest, include_z=rest.has_z)[:1]
        node = forks.node[fork]
        nodes[node] = shapely.points(start if nodes[node].has_z else start[:, :2])[0]
        for end in forks.branch[fork]:
            line = outward(end)
            tail = substring(line, min(rejoin, line.length / 2), line.length)
            put(end, shapely.linestrings(np.vstack([start, shapely.get_coordinates(tail, include_z=rest.has_z)])))
    edges = finish_edges(graph.edges.set_geometry(lines, crs=graph.crs))
    return replace(graph, edges=edges, nodes=graph.nodes.set_geometry(nodes, crs=graph.crs))
