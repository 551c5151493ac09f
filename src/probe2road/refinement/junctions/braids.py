"""Braids: parallel roads whose lines touch again and again, separated by the direction of traffic.

Strategy
--------
Where two carriageways run closer than the network's lines are wide, the mask is a chain of short edges that part and
join at flat angles, and every joint is a junction that does not exist. Such a chain is found as a set of nodes at which
all edges lie along one line, connected by short edges. What leads into it and out of it is clean: if traces drive in
by one edge and out by one on either side, there are two roads in opposite directions, whatever they were matched to
between. The chain is replaced by two lines along its middle, as far apart as the roads are before and behind it. If
only one edge leads to either side, there is one road, and one line along the middle.

Legend of array shapes: E edges, N nodes. Ends of edges are numbered: 2 row at u, 2 row + 1 at v.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from probe2road.bounds import NotNegative
from probe2road.graph.clean import merge_degree_two_nodes
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import led_to
from probe2road.graph.tables import finish_edges
from probe2road.matching.tables import step_rows
from probe2road.options import checked

__all__ = ["BraidOptions", "open_braids"]

logger = logging.getLogger(__name__)

_NEAR, _FAR = 8.0, 30.0  # m from a node between which the direction of an edge is measured
_SHARE = 0.9  # share of a short edge over which the direction is measured
_STEP = 5.0  # m between the points of new lines
_SMOOTH = 25.0  # m over which the middle of a chain is averaged
_TRIM = 15.0  # m; cut off a road beside a chain, where it has been bent to the first joint
_MAX_CUT = 0.4  # share of an edge that is cut off at most
_BESIDE = (15.0, 40.0)  # m from a chain between which the distance of its roads is measured


@dataclass(frozen=True)
@checked
class BraidOptions:
    """Which chains of short edges count as two parallel roads."""

    max_inner: NotNegative[float] = 100.0  # m; longer edges between two joints are roads of their own; 0 opens nothing
    max_shared: NotNegative[float] = 300.0  # m; the same for edges that are driven in both directions
    max_angle: NotNegative[float] = 30.0  # degrees between an edge at a joint and the line of all edges there
    max_width: NotNegative[float] = 16.0  # m between the outermost lines of a chain, and between roads that lead to it
    min_traces: NotNegative[int] = 3  # fewest traces that drive in, or out, by each outer edge of a chain
    min_share: NotNegative[float] = 0.85  # least share of the traces on such an edge in one direction


@dataclass(frozen=True)
class _Chain:
    """A connected set of joints: rows of nodes, rows of the edges between them, and the outer edge ends by side."""

    nodes: NDArray[np.int64]
    inner: NDArray[np.int64]
    ends: NDArray[np.int64]
    side: NDArray[np.int64]  # 0 or 1, the side of each end


def open_braids(graph: RoadGraph, steps: pd.DataFrame, *, options: BraidOptions | None = None) -> RoadGraph:
    """Replace chains of edges that separate and rejoin by the roads that traces drive through them.

    Parameters
    ----------
    graph
        Any road graph.
    steps
        Paths matched on it: `probe2road.matching.match.Matches.steps`.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        Edges that no chain had a part in keep ids and attributes; new ones have the attributes of its longest edge.
        Nodes of degree 2 are merged. All turns are dropped: match again. The graph itself where there was no chain.

    Raises
    ------
    InputError
        If the steps name an edge that is not in the graph.

    Notes
    -----
    Not in the paper; docs/decisions/0013-false-junctions.md says what it gave.

    Examples
    --------
    Two carriageways 6 m apart whose lines touch for 60 m:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> arms = [[(-200, 3), (-40, 3), (-30, 0)], [(-30, 0), (-40, -3), (-200, -3)], [(-30, 0), (30, 0)]]
    >>> arms += [[(30, 0), (40, 3), (200, 3)], [(200, -3), (40, -3), (30, 0)]]
    >>> graph = graph_from_lines(arms, crs="EPSG:32616")
    >>> ways = [[(0, True), (2, True), (3, True)], [(4, True), (2, False), (1, True)]]
    >>> drives = [{"trace_id": k, "edge": e, "forward": f} for k in range(8) for e, f in ways[k % 2]]
    >>> opened = open_braids(graph, pd.DataFrame(drives))
    >>> len(opened.edges), [round(line.distance(shapely.Point(0, 0)), 1) for line in opened.edges.geometry]
    (2, [3.0, 3.0])
    """
    options = options or BraidOptions()
    if not options.max_inner or graph.edges.empty:
        return graph
    lines = shapely.force_2d(graph.edges.geometry.to_numpy())
    ways = _ways(graph, steps)
    out, into = ways.ravel(), ways[:, ::-1].ravel()  # of every end: away from its node, towards it
    changed = _Changes(graph)
    shared = ways.min(axis=1) >= np.maximum(options.min_traces, (1.0 - options.min_share) * ways.sum(axis=1))
    longest = np.where(shared, options.max_shared, options.max_inner)
    short = shapely.length(lines) <= longest
    joint = _joints(graph, options.max_angle)
    for chain in _chains(graph, joint, short & joint[graph.end_rows].all(axis=1)):
        roads = _roads(chain, into[chain.ends], out[chain.ends], options)
        middle = _middle(chain, roads, lines, graph.end_rows) if roads else None
        if middle is None or _width(lines[chain.inner], middle) > options.max_width:
            continue
        left = _offsets(roads, lines, middle, options)
        if left is not None:
            changed.add(chain, roads, middle, left)
    if not changed.chains:
        return graph
    joints = sum(len(chain.nodes) for chain in changed.chains)
    logger.info("opened %d braids with %d joints", len(changed.chains), joints)
    return merge_degree_two_nodes(changed.made())


def _ways(graph: RoadGraph, steps: pd.DataFrame) -> NDArray[np.int64]:
    """Count the traversals of each edge forwards and backwards, shape (E, 2)."""
    row = step_rows(graph, steps, where="open_braids")
    backwards = ~steps["forward"].to_numpy(bool)
    return np.bincount(2 * row + backwards, minlength=2 * len(graph.edges)).reshape(-1, 2)


def _joints(graph: RoadGraph, max_angle: float) -> NDArray[np.bool_]:
    """Tell which nodes have three or more edge ends, all along one line (within an angle, degrees); shape (N,)."""
    ends, n_nodes = graph.ends(reach=_FAR, skip=_NEAR, share=_SHARE), len(graph.nodes)
    angle = np.arctan2(ends.ahead[:, 1], ends.ahead[:, 0])
    # Opposite directions lie on one line, so the mean is that of the doubled angles.
    sums = [np.bincount(ends.node, wave(2.0 * angle), n_nodes) for wave in (np.sin, np.cos)]
    line = np.arctan2(*sums) / 2.0
    aside = np.abs((angle - line[ends.node] + np.pi / 2.0) % np.pi - np.pi / 2.0)
    worst = np.zeros(n_nodes)
    np.maximum.at(worst, ends.node, aside)
    return (np.bincount(ends.node, minlength=n_nodes) >= 3) & (worst <= np.radians(max_angle))


def _chains(graph: RoadGraph, joint: NDArray[np.bool_], inner: NDArray[np.bool_]) -> Iterator[_Chain]:
    """Yield the sets of two or more joints that inner edges connect and that have outer edges on two sides."""
    node = graph.end_rows.ravel()
    places = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    for ends in _ends_by_part(graph, joint, inner):
        is_inner = inner[ends // 2]
        leading, joints = ends[~is_inner], np.unique(node[ends])
        side = _sides(places[joints], places[node[leading]])
        if 0 < side.sum() < len(side):
            yield _Chain(joints, np.unique(ends[is_inner] // 2), leading, side)


def _ends_by_part(graph: RoadGraph, joint: NDArray[np.bool_], inner: NDArray[np.bool_]) -> Iterator[NDArray[np.int64]]:
    """Yield the edge ends at each set of two or more joints that inner edges connect."""
    node, n_nodes = graph.end_rows.ravel(), len(graph.nodes)
    links = coo_array((np.ones(inner.sum()), tuple(graph.end_rows[inner].T)), shape=(n_nodes, n_nodes))
    part = connected_components(links, directed=False)[1]
    size = np.bincount(part, minlength=n_nodes)
    ends = np.flatnonzero(joint[node] & (size[part[node]] > 1))
    for _, members in pd.Series(ends).groupby(part[node[ends]]):
        yield members.to_numpy()


def _sides(joints: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return for each place (m) which of the two joints farthest apart is nearer: 0 or 1."""
    apart = np.hypot(*(joints[:, None] - joints).T)
    first, last = np.unravel_index(apart.argmax(), apart.shape)
    to_first, to_last = (np.hypot(*(places - joints[joint]).T) for joint in (first, last))
    return (to_last < to_first).astype(np.int64)


def _roads(
    chain: _Chain, into: NDArray[np.int64], out: NDArray[np.int64], options: BraidOptions
) -> list[tuple[int, int]]:
    """Pair the ends where traces enter a chain with those where they leave it; return an empty list if unclear."""
    least = np.maximum(options.min_traces, options.min_share * (into + out))
    came, went = into >= least, out >= least
    if not (came | went).all():
        return []
    roads = []
    for side in (0, 1):
        begins, stops = chain.ends[came & (chain.side == side)], chain.ends[went & (chain.side != side)]
        if len(begins) != len(stops) or len(begins) > 1:
            return []
        roads += list(zip(begins.tolist(), stops.tolist(), strict=True))
    return roads


def _middle(
    chain: _Chain,
    roads: list[tuple[int, int]],
    lines: NDArray[np.object_],
    rows: NDArray[np.int64],
) -> NDArray[np.float64] | None:
    """Return points along the middle of a chain (m, 2), in the direction of its first road; None without a path."""
    node = rows.ravel()
    came, went = roads[0]
    way = _way_through(chain, lines, rows, int(node[came]), int(node[went]))
    if way is None:
        return None
    count = max(round(way.length / _STEP), 2) + 1
    points = shapely.get_coordinates(way.interpolate(np.linspace(0.0, 1.0, count), normalized=True))
    normal = _normals(points)
    # The path follows one side of each lens: it is moved to the middle between the outermost points on both sides.
    every = shapely.get_coordinates(shapely.segmentize(lines[chain.inner], _STEP))
    near = cKDTree(points).query(every)[1]
    left = ((every - points[near]) * normal[near]).sum(axis=1)
    lowest, highest = np.zeros(count), np.zeros(count)
    np.minimum.at(lowest, near, left)
    np.maximum.at(highest, near, left)
    aside = uniform_filter1d((lowest + highest) / 2.0, max(round(_SMOOTH / _STEP), 1), mode="nearest")
    return np.asarray(points + aside[:, None] * normal, np.float64)


def _way_through(
    chain: _Chain, lines: NDArray[np.object_], rows: NDArray[np.int64], start: int, stop: int
) -> shapely.LineString | None:
    """Find the shortest path from joint to joint along the edges of a chain."""
    at = {int(node): k for k, node in enumerate(chain.nodes)}
    n = len(at)
    length = np.full((n, n), np.inf)
    edge = np.full((n, n), -1)
    for row in chain.inner.tolist():
        a, b = (at[int(node)] for node in rows[row])
        if lines[row].length < length[a, b]:
            length[a, b] = length[b, a] = lines[row].length
            edge[a, b] = edge[b, a] = row
    before = dijkstra(np.where(np.isinf(length), 0.0, length), indices=at[start], return_predecessors=True)[1]
    points, here = [], at[stop]
    while here != at[start]:
        last = int(before[here])
        if last < 0:
            return None
        row = edge[last, here]
        part = shapely.get_coordinates(lines[row])
        points.append(part if at[int(rows[row, 1])] == here else part[::-1])
        here = last
    return shapely.LineString(np.concatenate(points[::-1])) if points else None


def _offsets(
    roads: list[tuple[int, int]], lines: NDArray[np.object_], middle: NDArray[np.float64], options: BraidOptions
) -> NDArray[np.float64] | None:
    """Return how far left of the middle the first road is at both ends (m); the second road is as far to the right.

    None where the roads are too far apart, or change sides.
    """
    if len(roads) == 1:
        return np.zeros(2)
    (came, went), (back_came, back_went) = roads
    offset = []
    for one, other, normal in zip((came, went), (back_went, back_came), _normals(middle)[[0, -1]], strict=True):
        own = _beside(lines[one // 2], one % 2)
        nearest = shapely.line_interpolate_point(lines[other // 2], shapely.line_locate_point(lines[other // 2], own))
        away = shapely.get_coordinates(own) - shapely.get_coordinates(nearest)
        offset.append(float(np.median(away @ normal)) / 2.0)
    apart = 2.0 * np.abs(offset)
    if offset[0] * offset[1] <= 0 or apart.max() > options.max_width:
        return None
    return np.array(offset)


def _normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vectors that point to the left of a line, shape (m, 2)."""
    ahead = np.gradient(points, axis=0)
    return np.asarray(np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.hypot(*ahead.T)[:, None])


def _beside(line: shapely.LineString, end: int) -> NDArray[np.object_]:
    """Return points on a line at a distance from one of its ends."""
    far = min(_BESIDE[1], line.length)
    along = np.linspace(min(_BESIDE[0], far), far, 6)
    return np.asarray(shapely.line_interpolate_point(line, along if end == 0 else line.length - along))


def _width(lines: NDArray[np.object_], middle: NDArray[np.float64]) -> float:
    """Return twice the largest distance of a point of some lines from their middle, m."""
    points = shapely.points(shapely.get_coordinates(shapely.segmentize(lines, _STEP)))
    return 2.0 * float(shapely.distance(points, shapely.LineString(middle)).max())


class _Changes:
    """The changes to a graph, collected chain by chain."""

    def __init__(self, graph: RoadGraph) -> None:
        self.graph = graph
        self.chains: list[_Chain] = []
        self._edges: list[pd.DataFrame] = []
        self._places: list[NDArray[np.float64]] = []  # of new nodes
        self._target = np.full((len(graph.edges), 2), -1)  # new node of each end, -1 for none

    def add(
        self, chain: _Chain, roads: list[tuple[int, int]], middle: NDArray[np.float64], left: NDArray[np.float64]
    ) -> None:
        """Replace a chain by one line for each road."""
        self.chains.append(chain)
        longest = chain.inner[self.graph.edges["length"].to_numpy()[chain.inner].argmax()]
        aside = np.linspace(left[0], left[1], len(middle))[:, None] * _normals(middle)
        for (came, went), sign in zip(roads, (1.0, -1.0), strict=False):
            line = middle + sign * aside
            line = line if sign > 0 else line[::-1]
            first = len(self._places)
            self._places += [line[0], line[-1]]
            self._target[came // 2, came % 2], self._target[went // 2, went % 2] = first, first + 1
            row = self.graph.edges.iloc[[longest]].assign(u=first, v=first + 1, geometry=[shapely.LineString(line)])
            self._edges.append(row)

    def made(self) -> RoadGraph:
        """Apply all changes to the graph."""
        graph, lines = self.graph, self.graph.edges.geometry.to_numpy().copy()
        free = int(graph.nodes.index.max()) + 1
        ids = np.arange(free, free + len(self._places))
        points = shapely.points(np.array(self._places))
        if shapely.has_z(graph.nodes.geometry.to_numpy()).any():
            points = shapely.force_3d(points, np.nan)
        for row in np.flatnonzero((self._target >= 0).any(axis=1)):
            cuts = np.where(self._target[row] >= 0, min(_TRIM, _MAX_CUT * lines[row].length), 0.0)
            lines[row] = led_to(lines[row], cuts, [points[goal] if goal >= 0 else None for goal in self._target[row]])
        uv = np.where(self._target >= 0, self._target + free, graph.edges[["u", "v"]].to_numpy())
        kept = graph.edges.assign(u=uv[:, 0], v=uv[:, 1], geometry=lines)
        kept = kept.drop(index=graph.edges.index[np.concatenate([chain.inner for chain in self.chains])])
        new = pd.concat(self._edges)
        new = new.assign(u=new["u"] + free, v=new["v"] + free)
        new.index = pd.RangeIndex(first := int(graph.edges.index.max()) + 1, first + len(new))
        gone = graph.nodes.index[np.concatenate([chain.nodes for chain in self.chains])]
        nodes = gpd.GeoDataFrame(geometry=points, index=ids, crs=graph.crs)
        nodes = pd.concat([graph.nodes.drop(index=gone), nodes]).rename_axis("node")
        return replace(graph, nodes=nodes, edges=finish_edges(pd.concat([kept, new])), turns=graph.turns.iloc[:0])
