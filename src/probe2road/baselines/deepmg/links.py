"""Links that DeepMG proposes where roads of the mask seem to be interrupted (METHOD 3.6).

Strategy
--------
All dead ends are looked at on the graph as it came, one after another: there are thousands, not millions, and each
sees a handful of edges. An edge is a polyline, and its straight parts are its pieces. A proposed link is a row of
plain values; which of them become edges is decided in `probe2road.baselines.deepmg.link_edges`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.baselines.deepmg.variants import Variant
from probe2road.bounds import Positive
from probe2road.crs import WGS84, transform
from probe2road.graph.roadgraph import RoadGraph
from probe2road.options import checked

__all__ = ["NO_NODE", "Link", "LinkOptions", "angle_stretch", "bearing_difference", "propose_links"]

NO_NODE = -1  # node of a link that leads into an edge

_Vector = NDArray[np.float64]


@dataclass(frozen=True)
@checked
class LinkOptions:
    """Which links DeepMG proposes."""

    radius: Positive[float] = 50.0  # m; longer links are never made
    snap: Positive[float] = 15.0  # m; a hit this near to a vertex of the polyline goes to that vertex
    stub: Positive[float] = 15.0  # m; an edge with two dead ends that is shorter has no direction of its own
    max_turn: Positive[float] = 90.0  # degrees, between a road and its link to a node that its extension misses
    min_angle: Positive[float] = 20.0  # degrees; of two links from one place that differ by less, the shorter is made


class Link(NamedTuple):
    """A proposed link from a dead end to a place on an edge."""

    start: int  # row of the node of the dead end
    edge: int  # row of the edge it leads to
    along: float  # m from the start of that edge
    node: int  # row of the node it leads to, NO_NODE where it leads to the inside of the edge
    vector: tuple[float, float]  # m, from the dead end to the place

    @property
    def length(self) -> float:
        """Return the length, metres."""
        return float(np.hypot(*self.vector))


class _Edges(NamedTuple):
    """The edges of a graph by row."""

    u: NDArray[np.int64]
    v: NDArray[np.int64]
    vertices: list[_Vector]  # (n, 2) each, m
    along: list[_Vector]  # (n,) each, m from the start
    stub: NDArray[np.bool_]  # short, and both ends dead


class _End(NamedTuple):
    """A dead end: its edge and node, its position, the vertex before it, and the other end of its edge."""

    edge: int
    node: int
    place: _Vector
    before: _Vector
    opposite: _Vector


def propose_links(graph: RoadGraph, variant: Variant, options: LinkOptions | None = None) -> list[Link]:
    """Propose links from all dead ends of a graph.

    Towards every edge near it, a dead end proposes at most one link: straight on to where its extension hits the edge,
    or else to an end node of that edge that lies ahead. An isolated edge shorter than 15 m has no direction; of
    its two ends, the one that is nearer is linked to the nearest point of the edge. Links that cross another edge are
    dropped, and the longer of two that leave a dead end in similar directions.

    Parameters
    ----------
    graph
        Any road graph.
    variant
        Decides how angles are measured, and which edges a link may not touch.
    options
        None takes the defaults.

    Returns
    -------
    list of Link
        In the order of the edges, by dead end.

    Examples
    --------
    >>> from probe2road.baselines.deepmg.variants import find_variant
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(50, -90), (50, -20)]], crs="EPSG:32616")
    >>> [(link.edge, link.along, link.length) for link in propose_links(graph, find_variant("fixed"))]
    [(0, 50.0, 20.0)]
    """
    options = options or LinkOptions()
    if not len(graph.edges):
        return []
    stretch = 1.0 if variant.true_angles else angle_stretch(graph)
    lines = shapely.force_2d(graph.edges.geometry.to_numpy())
    edges = _edges(graph, lines, options.stub)
    tree = shapely.STRtree(lines)
    proposed: list[Link] = []
    for end in _dead_ends(edges):
        square = shapely.box(*(end.place - options.radius), *(end.place + options.radius))
        near = [int(edge) for edge in sorted(tree.query(square)) if not _joins_same_nodes(edges, int(edge), end.edge)]
        if edges.stub[end.edge]:
            found = [_from_stub(edges, end, edge, options) for edge in near]
        else:
            found = [_straight_on(edges, end, edge, stretch, options) for edge in near]
        free = [link for link in found if link is not None and not _crosses(edges, end, link, near, variant)]
        proposed += _distinct(free, stretch, options.min_angle)
    return proposed


def angle_stretch(graph: RoadGraph) -> float:
    """Return the factor on eastward lengths that computing angles in degrees of longitude and latitude implies."""
    left, bottom, right, top = graph.bounds
    _, latitude = transform((left + right) / 2, (bottom + top) / 2, graph.crs, WGS84)
    return float(1.0 / np.cos(np.radians(latitude)))


def bearing_difference(
    one: tuple[float, float] | _Vector, other: tuple[float, float] | _Vector, stretch: float
) -> float:
    """Return the angle between two vectors whose eastward lengths are stretched, degrees from 0 to 180."""
    cross = stretch * (one[0] * other[1] - one[1] * other[0])
    dot = stretch**2 * one[0] * other[0] + one[1] * other[1]
    return float(np.degrees(np.arctan2(abs(cross), dot)))


def _edges(graph: RoadGraph, lines: NDArray[np.object_], stub: float) -> _Edges:
    """Return the edges of a graph by row."""
    u, v = graph.end_rows.T
    degree = np.bincount(graph.end_rows.ravel(), minlength=len(graph.nodes))
    vertices = [shapely.get_coordinates(line) for line in lines]
    along = [np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(part, axis=0).T))]) for part in vertices]
    return _Edges(u, v, vertices, along, (degree[u] == 1) & (degree[v] == 1) & (shapely.length(lines) < stub))


def _dead_ends(edges: _Edges) -> Iterator[_End]:
    """Yield the ends at nodes of degree 1."""
    degree = np.bincount(np.concatenate([edges.u, edges.v]))
    for edge, vertices in enumerate(edges.vertices):
        for node, line in ((edges.u[edge], vertices), (edges.v[edge], vertices[::-1])):
            if degree[node] == 1:
                yield _End(edge, int(node), line[0], line[1], line[-1])


def _joins_same_nodes(edges: _Edges, one: int, other: int) -> bool:
    """Tell whether two edges join the same two nodes."""
    return {edges.u[one], edges.v[one]} == {edges.u[other], edges.v[other]}


def _straight_on(edges: _Edges, end: _End, edge: int, stretch: float, options: LinkOptions) -> Link | None:
    """Extend a dead end straight to an edge; if it misses the edge, link to a node of the edge that lies ahead."""
    ahead = end.place - end.before
    ahead = ahead / np.hypot(*ahead)
    vertices, along = edges.vertices[edge], edges.along[edge]
    distance, share = _ray_hits(end.place, ahead, vertices)
    piece = int(np.argmin(distance))
    if distance[piece] < options.radius:
        size = along[piece + 1] - along[piece]
        nearer = piece + int(share[piece] > 0.5)
        snapped = min(share[piece], 1.0 - share[piece]) * size <= options.snap
        return _link(edges, end, edge, along[nearer] if snapped else along[piece] + share[piece] * size)
    best = None
    for vertex in (0, -1):
        vector = vertices[vertex] - end.place
        link = _link(edges, end, edge, along[vertex])
        fits = 0.0 < link.length < options.radius and bearing_difference(ahead, vector, stretch) <= options.max_turn
        if fits and (best is None or link.length < best.length):
            best = link
    return best


def _from_stub(edges: _Edges, end: _End, edge: int, options: LinkOptions) -> Link | None:
    """Link the end of an isolated stub to an edge beside it, if it is the nearer one of its two ends."""
    distance, along = _foot(end.place, edges.vertices[edge], edges.along[edge])
    if distance < options.radius:
        nearer = distance < _foot(end.opposite, edges.vertices[edge], edges.along[edge])[0]
        return _link(edges, end, edge, along) if nearer else None
    if not edges.stub[edge]:
        return None
    ends = edges.vertices[edge][[0, -1]]
    near, far = (np.hypot(*(ends - place).T).min() for place in (end.place, end.opposite))
    if not near < min(far, options.radius):
        return None
    first = np.hypot(*(ends - end.place).T).argmin() == 0
    return _link(edges, end, edge, 0.0 if first else edges.along[edge][-1])


def _link(edges: _Edges, end: _End, edge: int, along: float) -> Link:
    """Return the link to a place on an edge; a place at the end of the edge becomes its node."""
    total = edges.along[edge][-1]
    node = int(edges.u[edge]) if along <= 0.0 else int(edges.v[edge]) if along >= total else NO_NODE
    place = [np.interp(along, edges.along[edge], edges.vertices[edge][:, axis]) for axis in (0, 1)]
    return Link(end.node, edge, float(along), node, (float(place[0] - end.place[0]), float(place[1] - end.place[1])))


def _ray_hits(origin: _Vector, ahead: _Vector, vertices: _Vector) -> tuple[_Vector, _Vector]:
    """Return the distance (m) at which a ray hits each piece, infinity for a miss, and the share of the piece there."""
    step = np.diff(vertices, axis=0)
    to_start = vertices[:-1] - origin
    slope = ahead[0] * step[:, 1] - ahead[1] * step[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (to_start[:, 0] * step[:, 1] - to_start[:, 1] * step[:, 0]) / slope
        share = (to_start[:, 0] * ahead[1] - to_start[:, 1] * ahead[0]) / slope
        hit = (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(hit, distance, np.inf), share


def _foot(place: _Vector, vertices: _Vector, along: _Vector) -> tuple[float, float]:
    """Return the distance to the nearest perpendicular foot in a piece, infinity for none, and the place of it."""
    step = np.diff(vertices, axis=0)
    share = ((place - vertices[:-1]) * step).sum(axis=1) / (step**2).sum(axis=1)
    distance = np.hypot(*(vertices[:-1] + share[:, None] * step - place).T)
    distance[(share <= 0.0) | (share >= 1.0)] = np.inf
    piece = int(np.argmin(distance))
    return float(distance[piece]), float(along[piece] + share[piece] * (along[piece + 1] - along[piece]))


def _crosses(edges: _Edges, end: _End, link: Link, near: list[int], variant: Variant) -> bool:
    """Tell whether a link crosses one of the edges near its dead end, except the edge that it leads to."""
    others = [edge for edge in near if edge != link.edge]
    if link.node != NO_NODE and not variant.crosses_at_target:
        others = [edge for edge in others if link.node not in (edges.u[edge], edges.v[edge])]
    stop = end.place + link.vector
    for edge in others:
        c, d = edges.vertices[edge][:-1], edges.vertices[edge][1:]
        apart = _left(end.place, c, d) != _left(stop, c, d)
        if (apart & (_left(end.place, stop, c) != _left(end.place, stop, d))).any():
            return True
    return False


def _left(a: _Vector, b: _Vector, c: _Vector) -> NDArray[np.bool_]:
    """Tell whether a, b, c turn strictly to the left; each has shape (2,) or (n, 2)."""
    return np.asarray(
        (c[..., 1] - a[..., 1]) * (b[..., 0] - a[..., 0]) > (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    )


def _distinct(links: list[Link], stretch: float, min_angle: float) -> list[Link]:
    """Keep the links of one dead end that differ in direction from every shorter link that is kept."""
    kept: list[Link] = []
    for link in sorted(links, key=lambda one: one.length):
        if all(bearing_difference(link.vector, other.vector, stretch) >= min_angle for other in kept):
            kept.append(link)
    return sorted(kept, key=lambda one: one.edge)
