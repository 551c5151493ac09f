"""Counterparts along the roads of one map, and where they are on the roads of another.

Both identities of edges and differences of maps rest on this: every few metres of a road, the nearest road of the
other map that runs the same way. Roads that cross are never taken for each other, and of the two carriageways of a
street the one that is driven the same way is preferred.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.bounds import Positive
from probe2road.crs import extent_in_degrees, require_metric
from probe2road.errors import InputError
from probe2road.graph.direction import driving_direction
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.network import Network, locate, network_from_graph
from probe2road.metrics.projection import direction_over, project_along
from probe2road.options import checked

__all__ = [
    "Counterparts",
    "OverlapOptions",
    "Roads",
    "counterparts",
    "overlaps",
    "require_common_area",
    "roads_of",
    "seen_from",
]

_BEYOND = 1000.0  # m between two maps, from which on they are of different places


@dataclass(frozen=True)
@checked
class OverlapOptions:
    """Which road of another map is the same road."""

    radius: Positive[float] = 15.0  # m between the two, at most
    max_angle: Positive[float] = 30.0  # degrees between their directions, at most
    spacing: Positive[float] = 5.0  # m along a road, from place to place
    span: Positive[float] = 10.0  # m to either side over which a direction is taken
    against: Positive[float] = 8.0  # m that a road which is driven the other way counts as farther


@dataclass(frozen=True, eq=False)
class Roads:
    """A graph, its arrays, and which way its edges may be driven: 1 along their line, 0 both ways; shape (E,)."""

    graph: RoadGraph
    network: Network
    sense: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Counterparts:
    """S places in the middle of equal parts of the edges of one map, in the order of the edges and along them."""

    edge: NDArray[np.int64]  # (S,) row of the edge
    offset: NDArray[np.float64]  # (S,) m along it
    metres: NDArray[np.float64]  # (S,) length of the part that a place stands for
    other: NDArray[np.int64]  # (S,) row of the edge of the other map; -1 where it has none there
    other_offset: NDArray[np.float64]  # (S,) m along that
    distance: NDArray[np.float64]  # (S,) m between the two; NaN where there is none
    along: NDArray[np.bool_]  # (S,) whether the two lines run the same way there


def roads_of(graph: RoadGraph) -> Roads:
    """Return a graph with its arrays and the driving directions of its edges."""
    return Roads(graph, network_from_graph(graph), driving_direction(graph.edges).to_numpy())


def counterparts(roads: Roads, other: Roads, options: OverlapOptions, *, way: int | None = None) -> Counterparts:
    """Look up the places of a map on another one.

    Parameters
    ----------
    roads, other
        The map that has the places, and the one they are looked up on; in one CRS.
    options
        What counts as the same road.
    way
        1 or -1 if traffic along the lines, or against them, is looked up: then a road of the other map that is closed
        in its direction counts as farther. None takes the direction of one-way edges, and none for the others.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> ours = roads_of(graph_from_lines([[(0, 0), (40, 0)]], crs="EPSG:32616"))
    >>> theirs = roads_of(graph_from_lines([[(20, 3), (90, 3)]], crs="EPSG:32616"))
    >>> found = counterparts(ours, theirs, OverlapOptions(spacing=10.0, radius=5.0))
    >>> found.offset.tolist(), found.other.tolist(), found.other_offset.tolist()
    ([5.0, 15.0, 25.0, 35.0], [-1, -1, 0, 0], [0.0, 0.0, 5.0, 15.0])
    """
    edge, offset, metres = _middles(roads.network, options.spacing)
    xy, _ = locate(roads.network, edge, offset)
    direction = direction_over(roads.network, edge, offset, options.span)
    near: dict[str, Any] = {"radius": options.radius, "max_angle": options.max_angle, "span": options.span}
    sense = np.full(len(edge), way) if way is not None else roads.sense[edge]
    driven = direction * np.where(sense < 0, -1.0, 1.0)[:, None]
    found, place = project_along(xy, driven, other.network, sense=other.sense, against=options.against, **near)
    both = sense == 0
    if both.any():  # which way a one-way road of the other map goes is of no account
        found[both], place[both] = project_along(xy[both], direction[both], other.network, **near)
    on = found >= 0
    distance, along = np.full(len(edge), np.nan), np.zeros(len(edge), bool)
    distance[on], along[on] = seen_from(xy[on], direction[on], other.network, found[on], place[on], options.span)
    return Counterparts(edge, offset, metres, found, place, distance, along)


def seen_from(
    xy: NDArray[np.float64],
    direction: NDArray[np.float64],
    network: Network,
    edge: NDArray[np.int64],
    offset: NDArray[np.float64],
    span: float,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return how far places on a network are from points, m, and whether they run along the direction there; (n,)."""
    there, _ = locate(network, edge, offset)
    return np.hypot(*(there - xy).T), (direction_over(network, edge, offset, span) * direction).sum(axis=1) > 0


def overlaps(found: Counterparts) -> pd.DataFrame:
    """Return a row ``edge``, ``other``, ``metres``, ``distance``, ``along`` for each pair of edges with a common part.

    The distance is the mean, and ``along`` the share of the metres at which the two lines run the same way.
    """
    on = found.other >= 0
    metres = found.metres[on]
    table = pd.DataFrame(
        {
            "edge": found.edge[on],
            "other": found.other[on],
            "metres": metres,
            "distance": metres * found.distance[on],
            "along": metres * found.along[on],
        }
    )
    table = table.groupby(["edge", "other"], as_index=False).sum()
    return table.assign(distance=table["distance"] / table["metres"], along=table["along"] / table["metres"])


def require_common_area(graph: RoadGraph, other: RoadGraph, *, where: str, name: str) -> None:
    """Refuse two maps of different places, or without roads.

    Parameters
    ----------
    graph, other
        In one CRS.
    where
        Who asks, for the message.
    name
        What the other one is called.

    Raises
    ------
    CRSError
        If the CRS is not metric.
    InputError
        If one of them has no roads, or they are more than a kilometre apart.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> here = graph_from_lines([[(500000, 5000000), (500100, 5000000)]], crs="EPSG:32632")
    >>> there = graph_from_lines([[(500000, 5900000), (500100, 5900000)]], crs="EPSG:32632")
    >>> require_common_area(here, there, where="diff", name="base")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: diff: the base is in another place, at ...
    """
    require_metric(graph.crs, where="graph")
    for named, roads in (("graph", graph), (name, other)):
        if roads.edges.empty:
            raise InputError(f"the {named} has no roads", where=where, fix="check the file, or the area it was cut to")
    left, bottom, right, top = graph.bounds
    west, south, east, north = other.bounds
    if max(west - right, left - east, south - top, bottom - north) > _BEYOND:
        places = (extent_in_degrees(roads.bounds, roads.crs) for roads in (other, graph))
        raise InputError(
            "the {} is in another place, at {}; the graph is at {}".format(name, *places),
            where=where,
            fix="check the files and their CRS",
        )


def _middles(network: Network, spacing: float) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the row, the offset (m) and the length (m) of equal parts of the edges, of about the spacing."""
    count = np.maximum(np.ceil(network.length / spacing), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    metres = (network.length / count)[edge]
    return edge, (rank + 0.5) * metres, metres
