"""Which edge lies beside a place and leads in about its direction."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph

__all__ = ["edge_beside"]


def edge_beside(
    graph: RoadGraph,
    xy: NDArray[np.float64],
    direction: NDArray[np.float64],
    *,
    radius: float,
    max_angle: float,
) -> NDArray[np.int64]:
    """Return the nearest edge to each place that leads in about its direction.

    A road that crosses there is none, however near it is.

    Parameters
    ----------
    graph
        Any road graph.
    xy
        Places, shape (n, 2), in the graph's CRS, metres.
    direction
        Unit vectors, shape (n, 2).
    radius
        Metres from the place to the edge, inclusive.
    max_angle
        Degrees between the direction and the piece of the edge there, as undirected lines.

    Returns
    -------
    ndarray of int64, shape (n,)
        Rows of edges; -1 where there is none.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(50, -50), (50, 50)]], crs="EPSG:32616")
    >>> north = np.tile([0.0, 1.0], (2, 1))
    >>> edge_beside(graph, np.array([[20.0, 1.0], [49.0, 1.0]]), north, radius=4.0, max_angle=20.0).tolist()
    [-1, 1]
    """
    found = np.full(len(xy), -1, np.int64)
    corner, owner = shapely.get_coordinates(graph.edges.geometry.to_numpy(), return_index=True)
    first = np.flatnonzero(owner[1:] == owner[:-1])
    if not len(first) or not len(xy):
        return found
    pieces = shapely.linestrings(np.stack([corner[first], corner[first + 1]], axis=1))
    course = corner[first + 1] - corner[first]
    course /= np.maximum(np.hypot(*course.T), 1e-9)[:, None]
    points = shapely.points(xy)
    place, piece = shapely.STRtree(pieces).query(points, predicate="dwithin", distance=radius)
    alike = np.abs((direction[place] * course[piece]).sum(axis=1)) >= np.cos(np.radians(max_angle))
    place, piece = place[alike], piece[alike]
    order = np.lexsort((piece, shapely.distance(points[place], pieces[piece]), place))
    nearest = order[np.unique(place[order], return_index=True)[1]]
    found[place[nearest]] = owner[first[piece[nearest]]]
    return found
