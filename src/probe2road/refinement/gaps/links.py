"""Links across gaps: the places that a dead end may have been cut off from.

Strategy
--------
All dead ends are looked at together and on the graph as it came. A link is a row: the dead end it starts from, and a
target, which is a node or a place on an edge. Ties are broken by coordinates, so the order of the edges plays no part.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from probe2road.bounds import NotNegative, Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.options import checked

__all__ = [
    "NO_NODE",
    "DeadEnds",
    "GapOptions",
    "Links",
    "angle_between",
    "crosses",
    "dead_ends",
    "straight_on",
    "to_dead_ends",
    "to_edges_beside",
    "within_reach",
]

NO_NODE = -1  # node of a link that ends on an edge

_ALONG = 45.0  # degrees; an edge beside a dead end runs along it when the two directions differ by less
_TURN = 45.0  # degrees of turn that count as much as the distance itself
_LEAD = 2.0  # times the lateral distance that a link to a parallel edge leads ahead: it leaves at about 27 degrees
_TOUCH = 0.05  # m; a link is not tested for crossings nearer than this to its ends


@dataclass(frozen=True)
@checked
class GapOptions:
    """Which gaps are filled (METHOD 3.6, 0.1 rows 16 to 18)."""

    max_length: NotNegative[float] = 50.0  # m; longer links are never made
    snap: NotNegative[float] = 15.0  # m; a link that hits an edge this near to its end goes to the node there
    beside: NotNegative[float] = 20.0  # m; a dead end is linked to a parallel edge this near; 0: none
    max_turn: NotNegative[float] = 90.0  # degrees, between road and link, at both ends of a link between dead ends
    min_angle: NotNegative[float] = 20.0  # degrees; of two links at one node that differ by less, the shorter is made
    heading_length: Positive[float] = 15.0  # m, over which the direction of a dead end is measured
    max_links: NotNegative[int] = 2  # links at one node
    stem_turn: NotNegative[float] = 20.0  # degrees, at both ends of a link between junctions face to face; 0: none


@dataclass(frozen=True)
class DeadEnds:
    """n dead ends."""

    edge: NDArray[np.int64]  # (n,) row of the edge
    node: NDArray[np.int64]  # (n,) row of the node
    at_start: NDArray[np.bool_]  # (n,) whether the edge starts here
    position: NDArray[np.float64]  # (n, 2) m
    ahead: NDArray[np.float64]  # (n, 2) unit vector out of the road


@dataclass(frozen=True)
class Links:
    """n links from dead ends."""

    end: NDArray[np.int64]  # (n,) row of the dead end
    node: NDArray[np.int64]  # (n,) row of the node it leads to, NO_NODE where it leads into an edge
    edge: NDArray[np.int64]  # (n,) row of the edge it leads to, also where it was snapped to one of its nodes
    along: NDArray[np.float64]  # (n,) m from the start of that edge
    target: NDArray[np.float64]  # (n, 2) m

    def where(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Links:
        """Return some of the links."""
        return Links(*(getattr(self, field.name)[kept] for field in fields(self)))


def dead_ends(graph: RoadGraph, reach: float) -> DeadEnds:
    """Collect the ends of edges at nodes of degree 1, with directions measured over a length (m) or the whole edge.

    An edge that curls back onto its end within that length has no direction there, and is left out.
    """
    ends = graph.ends(reach=reach)
    degree = np.bincount(ends.node, minlength=len(graph.nodes))
    end = np.flatnonzero((degree[ends.node] == 1) & ends.ahead.any(axis=1))
    return DeadEnds(end // 2, ends.node[end], end % 2 == 0, ends.position[end], -ends.ahead[end])


def to_dead_ends(ends: DeadEnds, options: GapOptions) -> Links:
    """Link every dead end to the nearest dead end, if each of the two lies ahead of the other.

    A turn counts like a detour, each 45 degrees like the distance once more: where two interrupted roads cross, their
    four ends are joined across and not around the corner.
    """
    pairs = KDTree(ends.position).query_pairs(options.max_length, output_type="ndarray") if len(ends.edge) else []
    one, other = np.concatenate([pairs, np.flip(pairs, 1)]).T if len(pairs) else np.zeros((2, 0), np.int64)
    vector = ends.position[other] - ends.position[one]
    turns = np.stack([angle_between(ends.ahead[one], vector), angle_between(-ends.ahead[other], vector)])
    distance = np.hypot(*vector.T) * (1.0 + turns.sum(axis=0) / _TURN)
    fits = (turns.max(axis=0) <= options.max_turn) & (distance > 0)
    one, other, distance = one[fits], other[fits], distance[fits]
    order = np.lexsort([*ends.position[other].T, distance.round(6), one])
    nearest = order[_heads(one[order])]
    one, other = one[nearest], other[nearest]
    unknown = np.full(len(one), -1)
    return Links(one, ends.node[other], unknown, np.full(len(one), np.nan), ends.position[other])


def straight_on(
    graph: RoadGraph, lines: NDArray[np.object_], tree: shapely.STRtree, ends: DeadEnds, options: GapOptions
) -> Links:
    """Link every dead end to the first edge that its straight extension hits."""
    far = ends.position + options.max_length * ends.ahead
    rays = shapely.linestrings(np.stack([ends.position, far], axis=1))
    end, edge = tree.query(rays, predicate="intersects")
    hits = shapely.intersection(rays[end], lines[edge])
    places, pair = shapely.get_coordinates(hits, return_index=True)  # both ends of a common stretch
    end, edge = end[pair], edge[pair]
    distance = ((places - ends.position[end]) * ends.ahead[end]).sum(axis=1)
    along = shapely.line_locate_point(lines[edge], shapely.points(places))
    kept = (distance > _TOUCH) & _apart_on_edge(lines, ends, end, edge, along, options.max_length)
    order = np.flatnonzero(kept)
    order = order[np.lexsort([along[order], distance[order], end[order]])]
    first = order[_heads(end[order])]
    return _snapped(graph, lines, end[first], edge[first], along[first], options.snap)


def to_edges_beside(
    graph: RoadGraph, lines: NDArray[np.object_], tree: shapely.STRtree, ends: DeadEnds, options: GapOptions
) -> Links:
    """Link every dead end to the nearest parallel edge, at a place ahead by twice the distance between the two.

    A ramp's end is nearly parallel to the mainline. Its straight extension would reach it far ahead, or never.
    """
    near = _edges_near(lines, tree, ends, options.beside)
    runs_along = _runs_along(lines, ends, near)
    runs_along &= _apart_on_edge(lines, ends, near.end, near.edge, near.along, options.max_length)
    order = np.flatnonzero(runs_along)
    order = order[np.lexsort([*near.target[order].T, near.aside[order], near.end[order]])]
    nearest = order[_heads(near.end[order])]
    return _snapped(graph, lines, near.end[nearest], near.edge[nearest], near.along[nearest], options.snap)


@dataclass(frozen=True)
class _EdgesNear:
    """n pairs of a dead end and an edge near it."""

    end: NDArray[np.int64]  # (n,) row of the dead end
    edge: NDArray[np.int64]  # (n,) row of the edge
    foot: NDArray[np.float64]  # (n, 2) m, from the dead end to the nearest place of the edge
    aside: NDArray[np.float64]  # (n,) m, length of foot
    along: NDArray[np.float64]  # (n,) m from the start of the edge to where a link would end
    target: NDArray[np.float64]  # (n, 2) m, place where a link would end


def _edges_near(lines: NDArray[np.object_], tree: shapely.STRtree, ends: DeadEnds, distance: float) -> _EdgesNear:
    """Pair dead ends with the edges within a distance (m), and find the places on the edges where links would end."""
    points = shapely.points(ends.position)
    end, edge = tree.query(points, predicate="dwithin", distance=distance)
    nearest = shapely.line_interpolate_point(lines[edge], shapely.line_locate_point(lines[edge], points[end]))
    foot = shapely.get_coordinates(nearest).reshape(-1, 2) - ends.position[end]
    aside = np.hypot(*foot.T)
    ahead = shapely.points(ends.position[end] + _LEAD * aside[:, None] * ends.ahead[end])
    along = shapely.line_locate_point(lines[edge], ahead)
    target = shapely.get_coordinates(shapely.line_interpolate_point(lines[edge], along))
    return _EdgesNear(end, edge, foot, aside, along, target)


def _runs_along(lines: NDArray[np.object_], ends: DeadEnds, near: _EdgesNear) -> NDArray[np.bool_]:
    """Tell which edges are parallel to the dead end beside them, shape (n,)."""
    ahead = ends.ahead[near.end]
    slope = angle_between(ahead, _directions(lines[near.edge], near.along))
    return np.asarray(
        (near.aside > _TOUCH)
        & (angle_between(ahead, near.foot) >= _ALONG)  # else it is ahead, not beside
        & (np.minimum(slope, 180.0 - slope) <= _ALONG)
        & (angle_between(ahead, near.target - ends.position[near.end]) <= _ALONG)
    )


def _apart_on_edge(
    lines: NDArray[np.object_],
    ends: DeadEnds,
    end: NDArray[np.int64],
    edge: NDArray[np.int64],
    along: NDArray[np.float64],
    least: float,
) -> NDArray[np.bool_]:
    """Tell which places lie on another edge than the dead end itself, or far away along the same edge."""
    own = ends.edge[end] == edge
    from_end = np.where(ends.at_start[end], along, shapely.length(lines[edge]) - along)
    return np.asarray(~own | (from_end > 2 * least))


def _snapped(
    graph: RoadGraph,
    lines: NDArray[np.object_],
    end: NDArray[np.int64],
    edge: NDArray[np.int64],
    along: NDArray[np.float64],
    snap: float,
) -> Links:
    """Return links to places on edges, or to the nearer end node of the edge if it is within ``snap``."""
    length = shapely.length(lines[edge])
    at_start = along <= length - along
    snapped = np.minimum(along, length - along) <= snap
    node = np.where(snapped, graph.end_rows[edge, np.where(at_start, 0, 1)], NO_NODE)
    along = np.where(snapped, np.where(at_start, 0.0, length), along)
    target = shapely.get_coordinates(shapely.line_interpolate_point(lines[edge], along)).reshape(-1, 2)
    return Links(end, node, edge, along, target)


def within_reach(ends: DeadEnds, links: Links, options: GapOptions) -> Links:
    """Drop links that are too long, turn too sharply, or lead nowhere."""
    vector = links.target - ends.position[links.end]
    length = np.hypot(*vector.T)
    turn = angle_between(ends.ahead[links.end], vector)
    # A link that ends at a dead end turns there too, whichever rule proposed it.
    of_node = pd.Series(np.arange(len(ends.node)), index=ends.node).groupby(level=0).first()
    other = of_node.reindex(links.node).to_numpy(np.float64)
    into = np.isfinite(other)
    turn[into] = np.maximum(turn[into], angle_between(-ends.ahead[other[into].astype(np.int64)], vector[into]))
    elsewhere = (links.node != ends.node[links.end]) & (length > 0)
    return links.where(elsewhere & (length <= options.max_length) & (turn <= options.max_turn))


def crosses(graph: RoadGraph, tree: shapely.STRtree, ends: DeadEnds, links: Links) -> NDArray[np.bool_]:
    """Tell which links cross an edge between their ends, ignoring the edges at the node where the link ends."""
    start = ends.position[links.end]
    vector = links.target - start
    length = np.maximum(np.hypot(*vector.T), 2 * _TOUCH)[:, None]
    body = shapely.linestrings(
        np.stack([start + vector * (_TOUCH / length), links.target - vector * (_TOUCH / length)], axis=1)
    )
    link, edge = tree.query(body, predicate="intersects")
    at_target = (graph.end_rows[edge] == links.node[link][:, None]).any(axis=1)
    asked = ~at_target & ~((links.node[link] == NO_NODE) & (links.edge[link] == edge))
    crosses = np.zeros(len(links.end), bool)
    crosses[link[asked]] = True
    return crosses


def _directions(lines: NDArray[np.object_], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction vectors of lines at places on them, measured over 2 m, shape (n, 2)."""
    before = shapely.line_interpolate_point(lines, np.maximum(along - 1.0, 0.0))
    after = shapely.line_interpolate_point(lines, np.minimum(along + 1.0, shapely.length(lines)))
    return np.asarray(shapely.get_coordinates(after) - shapely.get_coordinates(before))


def angle_between(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle between vectors of shape (n, 2), degrees from 0 to 180."""
    cross = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return np.asarray(np.degrees(np.arctan2(np.abs(cross), (one * other).sum(axis=1))))


def _heads(group: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark the first row of every group in a sorted array."""
    return np.diff(group, prepend=-1) != 0
