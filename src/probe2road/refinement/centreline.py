"""Centreline refinement: edges moved to where their matched traces say the middle of the road is.

Strategy
--------
Stations along every edge collect votes: the mean offset, across the road, of each traversal near them. Traffic keeps
to one side, so on roads driven both ways the votes of either direction are first moved to the middle by half of what
lies between the directions on the whole edge; a station that only one direction passed is then still unbiased. Road
boundaries seen on both sides say where the middle is by themselves. The medians are smoothed along the edge with
weights that grow with the votes, and drawn towards the present course, which is what is known where nobody drove.

A node goes where the edges that end there want it, in the least-squares sense, and their ends are led to it. An edge
that would fold is moved less, or not at all.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.bounds import NotNegative, Positive, Share
from probe2road.crs import require_same_crs
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.beside import edge_beside
from probe2road.matching.frame import (
    EdgeLines,
    FramedFixes,
    Stations,
    Traversals,
    courses,
    edge_lines,
    frame,
    robust_sigma,
    smooth_stations,
    stations_along,
)
from probe2road.matching.match import Matches
from probe2road.options import checked

__all__ = ["CentrelineOptions", "refine_centreline"]

logger = logging.getLogger(__name__)

_DRAWN, _DRAWN_ANGLE = 1.5, 20.0  # m and degrees from a drawn line, up to which an edge runs along it
_HELD = 1000.0  # votes by which an edge stays on a drawn line
_STEPS = (1.0, 0.5, 0.25, 0.0)  # shares of the shift of an edge that are tried, until the edge does not fold


@dataclass(frozen=True)
@checked
class CentrelineOptions:
    """How far the traces may move an edge."""

    spacing: Positive[float] = 10.0  # m between stations, at most
    reach: NotNegative[float] = 80.0  # m; wiggles of the shift that are shorter are levelled
    max_shift: NotNegative[float] = 5.0  # m
    max_left: NotNegative[float] = 20.0  # m; fixes farther aside do not vote
    prior_sigma: Positive[float] = 4.0  # m, expected error of the present course
    vote_sigma: Positive[float] = 1.5  # m, least spread of votes about the middle, lanes included
    min_traces: NotNegative[int] = 3  # on an edge; with fewer it stays
    two_way_share: Share = 0.1  # of the votes that the rarer direction has on a road driven both ways
    max_gap: NotNegative[float] = 6.0  # m between the two directions; an edge with more is two roads, and stays
    fade: Positive[float] = 25.0  # m from a node, within which the shift of the node changes to that of the edge
    boundaries: bool = True  # whether road boundaries count, where the fleet has any
    boundary_weight: NotNegative[float] = 60.0  # votes that boundaries seen on both sides count as
    tolerance: NotNegative[float] = 0.1  # m, by which the result is simplified


def refine_centreline(
    graph: RoadGraph,
    fleet: Fleet,
    matches: Matches,
    *,
    options: CentrelineOptions | None = None,
    drawn: RoadGraph | None = None,
) -> RoadGraph:
    """Move edges to the middle of what was driven.

    Topology, ids and attributes stay; geometry, ``length`` and the places of nodes change, each by ``max_shift`` at
    most. Edges with too few traces stay where they are, but for the ends they share with others. Heights move along.
    The matches no longer fit the result exactly: match again where that matters.

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
    drawn
        Edges stay where they run along a line of this graph. None moves all of them.

    Returns
    -------
    RoadGraph

    Raises
    ------
    CRSError
        If fleet and graph are in different CRS.
    InputError
        If the matches belong to another fleet or graph.

    Examples
    --------
    Three traces each way, 3 m apart, on a road that is drawn 2 m too far north:

    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.matching.match import match
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 2), (400, 2)]], crs="EPSG:32616")
    >>> there = pd.DataFrame({"t": range(40), "x": np.arange(5.0, 400, 10), "y": -1.5})
    >>> drives = [there.assign(trace_id=k) for k in range(3)]
    >>> drives += [there.assign(trace_id=k, x=there["x"][::-1].to_numpy(), y=1.5) for k in range(3, 6)]
    >>> fleet = fleet_from_tables(pd.concat(drives), crs="EPSG:32616", keep_crs=True)
    >>> refined = refine_centreline(graph, fleet, match(graph, fleet))
    >>> bool(np.abs(shapely.get_coordinates(refined.edges.geometry)[:, 1]).max() < 0.5)
    True
    """
    options = options or CentrelineOptions()
    require_same_crs(fleet.crs, graph.crs, where="refine_centreline")
    driven, fixes = frame(graph, fleet, matches)
    if not len(graph.edges) or not len(fixes.row):
        return graph
    lines = edge_lines(graph)
    stations = stations_along(lines.length, options.spacing)
    offset, weight = _offsets(driven, fixes, stations, options)
    if options.boundaries and len(fleet.points):
        seen, seen_weight = _between_boundaries(fleet, driven, fixes, lines, stations, options)
        total = weight + seen_weight
        both = weight * np.nan_to_num(offset) + seen_weight * np.nan_to_num(seen)
        offset, weight = np.divide(both, total, out=np.zeros(len(total)), where=total > 0), total
    weight = weight * _enough(driven, len(graph.edges), options.min_traces)[stations.edge]
    if drawn is not None:
        place, direction = lines.at(stations.edge, stations.along)
        there = edge_beside(drawn, place[:, :2], direction, radius=_DRAWN, max_angle=_DRAWN_ANGLE) >= 0
        offset, weight = np.where(there, 0.0, offset), np.where(there, _HELD, weight)
    shift = smooth_stations(
        np.clip(np.nan_to_num(offset), -options.max_left, options.max_left), weight / options.vote_sigma**2, stations,
        reach=options.reach, pull=1.0 / options.prior_sigma**2,
    )  # fmt: skip
    shift = np.clip(shift, -options.max_shift, options.max_shift)
    refined, moved = _moved(graph, lines, stations, shift, weight, options)
    logger.info("moved %d of %d edges by %.2f m on average", int((moved > 0.01).sum()), len(moved), moved.mean())
    return refined


def _enough(driven: Traversals, n_edges: int, min_traces: int) -> NDArray[np.bool_]:
    """Tell which edges were driven by enough distinct traces; shape (E,)."""
    pairs = np.unique(np.stack([driven.edge, driven.trace]), axis=1)
    return np.bincount(pairs[0], minlength=n_edges) >= min_traces


@dataclass(frozen=True)
class _Votes:
    """V votes: where one drive along an edge was when it passed a station."""

    place: NDArray[np.int64]  # (V,) station
    edge: NDArray[np.int64]  # (V,)
    forward: NDArray[np.bool_]  # (V,) whether it was driven from u to v
    left: NDArray[np.float64]  # (V,) m to the left of the edge

    def where(self, kept: NDArray[np.bool_]) -> _Votes:
        """Return some of the votes."""
        return _Votes(self.place[kept], self.edge[kept], self.forward[kept], self.left[kept])


@dataclass(frozen=True)
class _Ways:
    """The two directions of traffic on each edge; zeros and False where only one is driven."""

    half: NDArray[np.float64]  # (E,) m to the left, half of what lies between the backward and the forward traffic
    two: NDArray[np.bool_]  # (E,) whether both directions are driven
    apart: NDArray[np.bool_]  # (E,) whether they are too far apart to be one road
    mostly_forward: NDArray[np.bool_]  # (E,)


def _offsets(
    driven: Traversals, fixes: FramedFixes, stations: Stations, options: CentrelineOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the offset of the middle at every station (m to the left, NaN without votes) and its weight; (S,) each."""
    n, n_edges = len(stations.edge), len(stations.spacing)
    votes = _votes(driven, fixes, stations, options.max_left)
    ways = _ways(votes, n_edges, options)
    # A few votes against the traffic of a one-way road are wrong matches.
    votes = votes.where(ways.two[votes.edge] | (votes.forward == ways.mostly_forward[votes.edge]))
    centred = votes.left - np.where(votes.forward, ways.half[votes.edge], -ways.half[votes.edge])
    found = pd.Series(centred).groupby(votes.place).agg(["median", "count"])
    offset, weight = np.full(n, np.nan), np.zeros(n)
    offset[found.index.to_numpy()] = found["median"].to_numpy()
    weight[found.index.to_numpy()] = found["count"].to_numpy()
    spread = robust_sigma(centred, votes.edge, n_edges)
    spread = np.maximum(np.nan_to_num(spread, nan=options.vote_sigma), options.vote_sigma)
    weight[ways.apart[stations.edge]] = 0.0
    return offset, weight * (options.vote_sigma / spread[stations.edge]) ** 2


def _votes(driven: Traversals, fixes: FramedFixes, stations: Stations, max_left: float) -> _Votes:
    """Average the fixes of every drive near every station, as far as they lie within a distance (m) of the edge."""
    near = np.abs(fixes.left) <= max_left
    place = stations.nearest(driven.edge[fixes.traversal], fixes.along)
    table = pd.DataFrame({"place": place, "traversal": fixes.traversal, "left": fixes.left})[near]
    means = table.groupby(["place", "traversal"], sort=True)["left"].mean().reset_index()
    place = means["place"].to_numpy()
    return _Votes(place, stations.edge[place], driven.forward[means["traversal"].to_numpy()], means["left"].to_numpy())


def _ways(votes: _Votes, n_edges: int, options: CentrelineOptions) -> _Ways:
    """Tell which edges are driven in both directions, and how far apart the two directions are."""
    of_way = 2 * votes.edge + votes.forward
    count = np.bincount(of_way, minlength=2 * n_edges).reshape(-1, 2)
    two = count.min(axis=1) >= np.maximum(options.two_way_share * count.sum(axis=1), 3)
    middle = np.zeros(2 * n_edges)
    medians = pd.Series(votes.left).groupby(of_way).median()
    middle[medians.index.to_numpy()] = medians.to_numpy()
    between = middle[1::2] - middle[0::2]
    apart = two & (np.abs(between) > options.max_gap)
    return _Ways(np.where(two, between / 2, 0.0), two, apart, count[:, 1] >= count[:, 0])


def _between_boundaries(
    fleet: Fleet,
    driven: Traversals,
    fixes: FramedFixes,
    lines: EdgeLines,
    stations: Stations,
    options: CentrelineOptions,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the offset of the middle between both road boundaries (m to the left) and its weight; (S,) each.

    A boundary point belongs to the edge that the vehicle was matched to when it saw the point. The boundary of a side
    is the nearest one, which many see; what lies behind it belongs to another road.
    """
    n = len(stations.edge)
    points = fleet.points[(fleet.points["kind"] == "road_boundary").to_numpy()]
    poses = fleet.traces.iloc[fixes.row][["trace_id", "t"]].assign(traversal=fixes.traversal).dropna(subset="t")
    seen = points[["trace_id", "t", "x", "y"]].merge(poses.drop_duplicates(["trace_id", "t"]), on=["trace_id", "t"])
    if seen.empty:
        return np.full(n, np.nan), np.zeros(n)
    edge = driven.edge[seen["traversal"].to_numpy()]
    line = shapely.linestrings(lines.xyz[:, :2], indices=np.repeat(np.arange(len(lines.length)), np.diff(lines.first)))
    xy = seen[["x", "y"]].to_numpy(np.float64)
    along = shapely.line_locate_point(line[edge], shapely.points(xy))
    place, direction = lines.at(edge, along)
    away = xy - place[:, :2]
    left = direction[:, 0] * away[:, 1] - direction[:, 1] * away[:, 0]
    used = (np.abs(left) <= options.max_left) & (along > 0) & (along < lines.length[edge])
    table = pd.DataFrame({"place": stations.nearest(edge, along), "left": left, "side": left > 0})[used]
    sides = table.groupby(["place", "side"])["left"].agg(["median", "count"]).unstack("side")  # noqa: PD010
    sides = sides.reindex(columns=pd.MultiIndex.from_product([["median", "count"], [False, True]]))
    enough = sides["count"].min(axis=1, skipna=False) >= 3
    middle = sides["median"].mean(axis=1)[enough]
    offset, weight = np.full(n, np.nan), np.zeros(n)
    offset[middle.index.to_numpy()] = middle.to_numpy()
    weight[middle.index.to_numpy()] = options.boundary_weight
    return offset, weight


@dataclass(frozen=True)
class _Shifts:
    """The planned shifts of stations and nodes, before it is known which of them would fold an edge."""

    lines: EdgeLines
    stations: Stations
    own: NDArray[np.float64]  # (S, 2) m, shift of every station
    of_node: NDArray[np.float64]  # (N, 2) m
    node: NDArray[np.int64]  # (E, 2) rows of the nodes of every edge
    at_end: NDArray[np.float64]  # (S, 2) share of the shift that is that of the node at the start and at the end

    def shared(self, share: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the shifts of stations ``(S, 2)`` and nodes ``(N, 2)``, each scaled by the share ``(E,)`` of its edge.

        A node takes the least share of its edges.
        """
        of_node = np.ones(len(self.of_node))
        np.minimum.at(of_node, self.node.ravel(), np.repeat(share, 2))
        node_shift = of_node[:, None] * self.of_node
        own = share[self.stations.edge][:, None] * self.own
        shift = own.copy()
        for end, vertex in enumerate((self.stations.first[:-1], self.stations.first[1:] - 1)):
            led = node_shift[self.node[:, end]] - own[vertex]
            shift += self.at_end[:, end, None] * led[self.stations.edge]
        return shift, node_shift


def _moved(
    graph: RoadGraph,
    lines: EdgeLines,
    stations: Stations,
    shift: NDArray[np.float64],
    weight: NDArray[np.float64],
    options: CentrelineOptions,
) -> tuple[RoadGraph, NDArray[np.float64]]:
    """Shift all stations (m to the left, shape (S,)) and the nodes with them; return the mean shift of every edge."""
    shifts = _planned(graph, lines, stations, shift, weight, options)
    edge, along, xyz = courses(lines, stations, np.ones(len(stations.edge), bool))
    was_simple = shapely.is_simple(graph.edges.geometry.to_numpy())
    level = np.zeros(len(lines.length), np.int64)
    while True:
        moved, of_node = shifts.shared(np.array(_STEPS)[level])
        there = xyz[:, :2] + stations.interpolate(moved, edge, along)
        folds = _folds(xyz[:, :2], there, edge, was_simple) & (level < len(_STEPS) - 1)
        if not folds.any():
            break
        level[folds] += 1
    needed = stations.bends(moved[:, 0], options.tolerance) | stations.bends(moved[:, 1], options.tolerance)
    edge, along, xyz = courses(lines, stations, needed)
    xyz[:, :2] += stations.interpolate(moved, edge, along)
    size = np.bincount(stations.edge, np.hypot(*moved.T), len(level)) / np.diff(stations.first)
    return _with_geometry(graph, edge, xyz, shifts.node, of_node), size


def _planned(
    graph: RoadGraph,
    lines: EdgeLines,
    stations: Stations,
    shift: NDArray[np.float64],
    weight: NDArray[np.float64],
    options: CentrelineOptions,
) -> _Shifts:
    """Turn offsets to the left into shifts of stations and nodes."""
    length = lines.length[stations.edge]
    before, _ = lines.at(stations.edge, stations.along - options.spacing)
    after, _ = lines.at(stations.edge, stations.along + options.spacing)
    chord = (after - before)[:, :2]  # its direction turns slowly, so that neighbours do not cross in bends
    normal = np.column_stack([-chord[:, 1], chord[:, 0]]) / np.maximum(np.hypot(*chord.T), 1e-9)[:, None]
    node = graph.end_rows
    end = np.stack([stations.first[:-1], stations.first[1:] - 1], axis=1)

    # Shift of a node: least squares over the shifts across its edges, with a prior of no shift.
    vote_weight, prior_weight = weight[end].ravel() / options.vote_sigma**2, 1.0 / options.prior_sigma**2
    end_normal, end_shift, end_node = normal[end].reshape(-1, 2), shift[end].ravel(), node.ravel()
    end_weight = vote_weight + prior_weight
    matrix = np.zeros((len(graph.nodes), 2, 2))
    right = np.zeros((len(graph.nodes), 2))
    np.add.at(matrix, end_node, end_weight[:, None, None] * end_normal[:, :, None] * end_normal[:, None, :])
    np.add.at(right, end_node, (end_weight * end_shift)[:, None] * end_normal)
    matrix += prior_weight * np.eye(2)
    of_node = np.asarray(np.linalg.solve(matrix, right[:, :, None])[:, :, 0], np.float64)
    size = np.hypot(*of_node.T)
    of_node *= np.minimum(1.0, options.max_shift / np.maximum(size, 1e-9))[:, None]

    fade = np.minimum(options.fade, length / 2)
    distance = np.column_stack([stations.along, length - stations.along]) / np.maximum(fade, 1e-9)[:, None]
    at_end = 0.5 + 0.5 * np.cos(np.pi * np.clip(distance, 0.0, 1.0))
    return _Shifts(lines, stations, shift[:, None] * normal, of_node, node, at_end)


def _folds(
    before: NDArray[np.float64], after: NDArray[np.float64], edge: NDArray[np.int64], was_simple: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Tell which edges run backwards somewhere, or cross themselves where they did not before; shape (E,)."""
    same = np.diff(edge) == 0
    old, new = np.diff(before, axis=0), np.diff(after, axis=0)
    backwards = same & ((old * new).sum(axis=1) <= 0) & ((old**2).sum(axis=1) > 0)
    folded = np.bincount(edge[:-1], backwards, len(was_simple)) > 0
    return folded | (was_simple & ~shapely.is_simple(shapely.linestrings(after, indices=edge)))


def _with_geometry(
    graph: RoadGraph,
    edge: NDArray[np.int64],
    xyz: NDArray[np.float64],
    node: NDArray[np.int64],
    of_node: NDArray[np.float64],
) -> RoadGraph:
    """Return the graph with new vertices of its edges and its nodes shifted (m, shape (N, 2))."""
    old_nodes = graph.nodes.geometry.to_numpy()
    position = shapely.get_coordinates(old_nodes, include_z=True)
    position[:, :2] += of_node
    first = np.searchsorted(edge, np.arange(len(node)))
    last = np.searchsorted(edge, np.arange(len(node)), side="right") - 1
    xyz[first, :2], xyz[last, :2] = position[node[:, 0], :2], position[node[:, 1], :2]
    old = graph.edges.geometry.to_numpy()
    made = shapely.linestrings(xyz, indices=edge)
    made = np.where(shapely.has_z(old), made, shapely.force_2d(made))
    points = shapely.points(position)
    points = np.where(shapely.has_z(old_nodes), points, shapely.force_2d(points))
    edges = graph.edges.set_geometry(gpd.GeoSeries(made, index=graph.edges.index, crs=graph.crs))
    nodes = graph.nodes.set_geometry(gpd.GeoSeries(points, index=graph.nodes.index, crs=graph.crs))
    return replace(graph, nodes=nodes, edges=edges.assign(length=shapely.length(made)))
