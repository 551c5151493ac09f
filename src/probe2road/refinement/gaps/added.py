"""Edges of origin ``gap`` added to a graph between nodes that it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import finish_edges

__all__ = ["with_gap_edges"]


def with_gap_edges(
    graph: RoadGraph,
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    between: Sequence[NDArray[np.float64]] | None = None,
) -> RoadGraph:
    """Add edges of origin ``gap`` between nodes.

    Parameters
    ----------
    graph
        Any road graph with an edge.
    u, v
        Ids of the nodes, shape (n,).
    between
        For each edge, the vertices between its nodes in plan, shape (k, 2), metres. None draws straight edges.

    Returns
    -------
    RoadGraph
        If its edges have heights, those of the new ones change evenly from one end to the other.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (9, 0)], [(20, 0), (30, 0)]], crs="EPSG:32616")
    >>> added = with_gap_edges(graph, np.array([1]), np.array([2]), [np.array([[15.0, 1.0]])])
    >>> print(added.edges.geometry.iloc[-1], added.edges["origin"].iloc[-1])
    LINESTRING (9 0, 15 1, 20 0) gap
    """
    inner = [np.zeros((0, 2))] * len(u) if between is None else between
    ends = np.stack([_positions(graph, u), _positions(graph, v)], axis=1)  # (n, 2, 2 or 3)
    lines = [_line(end, vertices) for end, vertices in zip(ends, inner, strict=True)]
    first = int(graph.edges.index.max()) + 1
    new = gpd.GeoDataFrame(
        {"u": u, "v": v, "origin": "gap"},
        geometry=lines,
        index=np.arange(first, first + len(u)),
        crs=graph.crs,
    )
    edges = pd.concat([graph.edges, finish_edges(new)])
    return replace(graph, edges=finish_edges(edges))


def _positions(graph: RoadGraph, node: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the positions of nodes, shape ``(n, 2)``; with the heights of edges there, if the edges have any."""
    lines = graph.edges.geometry.to_numpy()
    if not shapely.has_z(lines).any():
        return shapely.get_coordinates(graph.nodes.geometry[node].to_numpy())
    ends = shapely.get_point(np.stack([lines, lines]), np.array([[0], [-1]])).ravel()
    of_node = pd.Series(ends, index=np.concatenate([graph.edges["u"], graph.edges["v"]])).groupby(level=0).first()
    return shapely.get_coordinates(of_node[node].to_numpy(), include_z=True)


def _line(ends: NDArray[np.float64], between: NDArray[np.float64]) -> shapely.LineString:
    """Draw a line from one end to the other through vertices in plan; ends have shape ``(2, 2)`` or ``(2, 3)``."""
    plan = np.vstack([ends[:1, :2], between, ends[1:, :2]])
    if ends.shape[1] == 2:
        return shapely.LineString(plan)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(plan, axis=0).T))])
    height = np.interp(along, along[[0, -1]], ends[:, 2])
    return shapely.LineString(np.column_stack([plan, height]))
