"""Forks: junctions where two roads separate at a flat angle, moved to where their traces separate.

Strategy
--------
Two roads that part at a flat angle are one line of pixels until they are some metres apart, so a fork that was traced
from a mask lies tens of metres behind the place where the roads part. The traces know that place. Before it, the traces
of either road run along the common one at a constant distance from each other, which is that of the lanes they chose;
from there on the distance grows. So for every fork the distance between the medians of both groups is taken in bins
along the common road, and a level followed by a straight rise is fitted: the fork belongs where the line bends. All
bends are tried for all forks at once, each a weighted least-squares fit with two unknowns in closed form.

Where a lane of its own leads to a ramp, traces change to it before the fork, and their distance grows by a lane there
already. So two rises with a level between them, one lane apart, are fitted as well. Where that explains the distances
much better, the fork belongs where the level ends.

Legend of array shapes: E edges, F forks, B bins, n fixes. Ends of edges are numbered: 2 row at u, 2 row + 1 at v.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

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
_STEP = 2.5  # m between bends that are tried
_LEVEL = 10.0  # m of the common road that must be seen before the bend
_FEWEST_BINS = 5
_ENOUGH = 20  # traces; a bin with more has no more weight
_KEPT = 10.0  # m of the common road that must remain
_LEAST = 3.0  # m; moving by less is not worth it
# Of lanes that lead to a fork, all m: where they end, how long they are, and over what length traces change to them.
_LANE_ENDS, _LANE_LENGTHS, _LANE_CHANGES = np.arange(0.0, 95.0, 2.5), (10.0, 20.0, 30.0, 45.0, 60.0), (25.0, 45.0, 70.0)
_LANE_GAIN = 0.5  # largest ratio of the squared errors with two rises to those with one


@dataclass(frozen=True)
@checked
class ForkOptions:
    """Which forks are moved, and how far."""

    reach: NotNegative[float] = 120.0  # m along the common road, by which a fork moves at most; 0 moves none
    max_angle: NotNegative[float] = 35.0  # degrees between the two branches of a fork
    min_traces: NotNegative[int] = 3  # traces that each branch needs at a place
    min_rise: NotNegative[float] = 1.5  # m by which traces must be apart at the old place of the fork
    confidence: NotNegative[float] = 3.0  # standard errors by which the rise must differ from none
    min_lane: NotNegative[float] = 2.5  # m, width of a lane that traces change to before they separate
    max_lane: NotNegative[float] = 4.5  # m; a larger change is not one to a neighbouring lane
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
    a branch has too few traces, if their distance does not grow, or if it grows all along the road that is seen. Where
    both ends of a road are forks, they share its length. The matches no longer fit the result: match again.

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
    >>> x = np.arange(5.0, 300, 10)
    >>> lanes = [np.zeros(30), np.minimum(0.0, (100 - x) / 10)]
    >>> drives = [pd.DataFrame({"trace_id": k, "t": range(30), "x": x, "y": lanes[k % 2]}) for k in range(8)]
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
    bends = _lane_ends(apart, count, _bends(apart, count, options), options)
    shift = _room(forks, bends, length)
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


def _bends(apart: NDArray[np.float64], count: NDArray[np.int64], options: ForkOptions) -> NDArray[np.float64]:
    """Return how far (m) from each fork its branches begin to separate, by a fit, ``(F,)``; 0 if nowhere."""
    at, weight, value = _weighted(apart, count, options)
    seen = np.where(weight > 0, at, 0.0).max(axis=1)
    free = (weight > 0).sum(axis=1) - 3.0  # level, rise and bend are fitted
    sums = weight.sum(axis=1), (weight * value).sum(axis=1), (weight * value**2).sum(axis=1)
    least, bend = np.full(len(apart), np.inf), np.zeros(len(apart))
    for place in _places(options):
        rise = np.maximum(place - at, 0.0)
        sum_rise, sum_square, sum_product = weight @ rise, weight @ rise**2, (weight * value) @ rise
        spread = np.maximum(sums[0] * sum_square - sum_rise**2, 1e-9)
        slope = (sums[0] * sum_product - sum_rise * sums[1]) / spread
        level = (sums[1] - slope * sum_rise) / np.maximum(sums[0], 1e-9)
        error = sums[2] - level * sums[1] - slope * sum_product
        doubt = np.sqrt(np.maximum(error, 1e-9) / np.maximum(free, 1.0) * sums[0] / spread)
        fits = (np.abs(slope * place) >= options.min_rise) & (np.abs(slope) >= options.confidence * doubt)
        better = (error < least) & (place <= seen - _LEVEL) & (free >= _FEWEST_BINS - 3)
        least = np.where(better, error, least)
        bend = np.where(better, np.where(fits, place, 0.0), bend)
    return bend


@dataclass(frozen=True)
class _Lane:
    """A separate lane that leads to a fork; all lengths are m along the common road, away from the fork."""

    end: float  # where the lane ends
    length: float
    change: float  # m over which traces change to the lane, behind its length

    def rises(self, at: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return the model terms of trace distances at places ``(B,)``: the lane, and the rise behind its end."""
        to_lane = np.clip((self.end + self.length + self.change - at) / self.change, 0.0, 1.0)
        return [to_lane, np.maximum(self.end - at, 0.0)] if self.end else [to_lane]


def _lane_ends(
    apart: NDArray[np.float64], count: NDArray[np.int64], bend: NDArray[np.float64], options: ForkOptions
) -> NDArray[np.float64]:
    """Return bends (m), ``(F,)``, or the end of a lane where a model with a lane fits the distances much better."""
    bend = bend.copy()
    bent = np.flatnonzero(bend)
    at, weight, value = _weighted(apart[bent], count[bent], options)
    one_rise = np.min([_fit([np.maximum(place - at, 0.0)], weight, value)[1] for place in _places(options)], axis=0)
    lane_end, two_rises = _best_lanes(at, weight, value, options)
    changed = two_rises < _LANE_GAIN * one_rise
    bend[bent[changed]] = lane_end[changed]
    return bend


def _best_lanes(
    at: NDArray[np.float64], weight: NDArray[np.float64], value: NDArray[np.float64], options: ForkOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Find the lane that fits the distances at each fork best: return its end (m) and the squared error, ``(F,)`` each.

    The errors are infinite where none fits that is as wide as a lane.
    """
    least, lane_end = np.full(len(value), np.inf), np.zeros(len(value))
    for lane in _lanes(options):
        rises, error = _fit(lane.rises(at), weight, value)
        width = np.abs(rises[:, 0])
        fits = (width > options.min_lane) & (width < options.max_lane) & (rises[:, 0] * rises[:, -1] >= 0.0)
        better = fits & (error < least)
        least, lane_end = np.where(better, error, least), np.where(better, lane.end, lane_end)
    return lane_end, least


def _lanes(options: ForkOptions) -> Iterator[_Lane]:
    """Yield the lanes to try: those that leave enough of the common road behind them."""
    for lane in (_Lane(*sizes) for sizes in product(_LANE_ENDS.tolist(), _LANE_LENGTHS, _LANE_CHANGES)):
        if lane.end + lane.length <= options.reach - 2.0 * _LEVEL:
            yield lane


def _places(options: ForkOptions) -> NDArray[np.float64]:
    """Return the positions of bends to try, m from the fork."""
    return np.arange(_BIN, options.reach, _STEP)


def _weighted(
    apart: NDArray[np.float64], count: NDArray[np.int64], options: ForkOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the bin middles (m), ``(B,)``, and weights and distances, ``(F, B)``: both 0 where traces are too few."""
    known = np.isfinite(apart) & (count >= max(options.min_traces, 1))
    weight = np.where(known, np.minimum(count, _ENOUGH), 0).astype(np.float64)
    at = (np.arange(apart.shape[1], dtype=np.float64) + 0.5) * _BIN
    return at, weight, np.where(known, apart, 0.0)


def _fit(
    terms: Sequence[NDArray[np.float64]], weight: NDArray[np.float64], value: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a level and terms ``(B,)`` to each row of values: return the factors, ``(F, terms)``, and squared errors."""
    basis = np.vstack([np.ones(value.shape[1]), *terms])
    normal = np.einsum("fb,ib,jb->fij", weight, basis, basis) + 1e-6 * np.eye(len(basis))
    right = (weight * value) @ basis.T
    factors = np.linalg.solve(normal, right[..., None])[..., 0]
    return factors[:, 1:], np.maximum((weight * value**2).sum(axis=1) - (factors * right).sum(axis=1), 1e-9)


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
