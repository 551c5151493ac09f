"""A road graph as plain arrays, on which the metrics compute.

Legend of array shapes: N nodes, E edges, V vertices of all edges one after another, S positions on edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph

__all__ = ["EPSILON", "Network", "locate", "network_from_graph"]

EPSILON = 1e-6  # m; positions nearer than this are the same: coordinates of 10^6 m have a resolution of 10^-9 m


@dataclass(frozen=True)
class Network:
    """Arrays of a road graph in plan.

    Attributes
    ----------
    node_xy
        Shape (N, 2), metres.
    u, v
        Shape (E,), rows of ``node_xy``.
    length
        Shape (E,), metres.
    first
        Shape (E + 1,): the vertices of edge ``e`` are ``first[e]`` to ``first[e + 1]``.
    xy, along
        Shapes (V, 2) and (V,): vertices, and their distance from the start of their edge.
    incident_first, incident_edge
        Shapes (N + 1,) and (2 E,): the edges at each node, ascending; a loop stands there twice.
    lines
        Shape (E,), the same geometry as shapely LineStrings, for spatial indexes.
    """

    node_xy: NDArray[np.float64]
    u: NDArray[np.int64]
    v: NDArray[np.int64]
    length: NDArray[np.float64]
    first: NDArray[np.int64]
    xy: NDArray[np.float64]
    along: NDArray[np.float64]
    incident_first: NDArray[np.int64]
    incident_edge: NDArray[np.int64]
    lines: NDArray[Any]

    @property
    def degree(self) -> NDArray[np.int64]:
        """Return the number of edge ends at every node, shape (N,); a loop counts twice."""
        return np.diff(self.incident_first)

    @property
    def km(self) -> float:
        """Return the total length, kilometres."""
        return float(self.length.sum()) / 1000.0


def network_from_graph(graph: RoadGraph) -> Network:
    """Convert a road graph to arrays; edge ends are moved exactly to their nodes, and heights are dropped.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> network = network_from_graph(graph_from_lines([[(0, 0), (3, 4)], [(3, 4), (3, 9), (0, 9)]], crs="EPSG:32616"))
    >>> network.length.tolist(), network.along.tolist(), network.degree.tolist()
    ([5.0, 8.0], [0.0, 5.0, 0.0, 5.0, 8.0], [1, 2, 1])
    """
    node_xy = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    u, v = (rows.copy() for rows in graph.end_rows.T)
    xy, owner = shapely.get_coordinates(graph.edges.geometry.to_numpy(), return_index=True)
    n_edges = len(u)
    first = np.searchsorted(owner, np.arange(n_edges + 1)).astype(np.int64)
    xy[first[:-1]], xy[first[1:] - 1] = node_xy[u], node_xy[v]

    step = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    step[first[:-1]] = 0.0
    total = np.cumsum(step)
    along = total - total[first[:-1]][owner]
    ends = graph.end_rows.ravel()
    order = np.argsort(ends, kind="stable")
    return Network(
        node_xy=node_xy,
        u=u,
        v=v,
        length=along[first[1:] - 1],
        first=first,
        xy=xy,
        along=along,
        incident_first=np.searchsorted(ends[order], np.arange(len(node_xy) + 1)).astype(np.int64),
        incident_edge=(order // 2).astype(np.int64),
        lines=shapely.linestrings(xy, indices=owner) if n_edges else np.empty(0, object),
    )


def locate(
    network: Network, edge: NDArray[np.int64], offset: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the coordinates of positions on edges, and the unit direction of the edge there, from u to v.

    Parameters
    ----------
    network
        The graph.
    edge, offset
        Shape (S,): rows of the edges, and distances (m) from their starts. Offsets beyond an end are that end.

    Returns
    -------
    xy, direction
        Both of shape (S, 2).

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> network = network_from_graph(graph_from_lines([[(0, 0), (4, 0), (4, 6)]], crs="EPSG:32616"))
    >>> xy, direction = locate(network, np.array([0, 0]), np.array([3.0, 9.0]))
    >>> xy.tolist(), direction.tolist()
    ([[3.0, 0.0], [4.0, 5.0]], [[1.0, 0.0], [0.0, 1.0]])
    """
    return _locate(np.asarray(edge, np.int64), np.asarray(offset, np.float64), network.first, network.xy, network.along)


@njit(cache=True)
def _locate(
    edge: NDArray[np.int64],
    offset: NDArray[np.float64],
    first: NDArray[np.int64],
    xy: NDArray[np.float64],
    along: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    position, direction = np.empty((len(edge), 2)), np.empty((len(edge), 2))
    for i in range(len(edge)):
        low, high = first[edge[i]], first[edge[i] + 1]
        vertex = low + np.searchsorted(along[low:high], offset[i])
        vertex = min(max(vertex, low + 1), high - 1)
        while vertex < high - 1 and along[vertex] == along[vertex - 1]:  # repeated vertices have no direction
            vertex += 1
        while vertex > low + 1 and along[vertex] == along[vertex - 1]:
            vertex -= 1
        size = along[vertex] - along[vertex - 1]
        share = (offset[i] - along[vertex - 1]) / size if size > 0 else 0.0
        share = min(max(share, 0.0), 1.0)
        for axis in range(2):
            difference = xy[vertex, axis] - xy[vertex - 1, axis]
            position[i, axis] = xy[vertex, axis] if share == 1.0 else xy[vertex - 1, axis] + share * difference
            direction[i, axis] = difference / size if size > 0 else 0.0
    return position, direction
