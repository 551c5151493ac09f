"""The map for the matcher of Biagioni and Eriksson: segments between intersections, and their straight pieces.

A segment is an edge of a road graph. Where its line bends, the published program has a vertex like any other: its
matcher's states are the straight pieces between vertices, driven one way or the other.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.baselines.biagioni.density import LEVELS
from probe2road.baselines.fringe import trace_fringe
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.raster.grid import Grid
from probe2road.vectorize.lines import VectorizeOptions, graph_from_pixels

__all__ = ["Pieces", "initial_map", "straight_pieces"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Pieces:
    """The straight pieces of a map.

    Attributes
    ----------
    graph
        One edge for each piece, in the order of the segments and along each from u to v; also a node at every bend.
    segment
        Row of the segment that each piece is of, shape (P,).
    """

    graph: RoadGraph
    segment: NDArray[np.int64]


def initial_map(skeleton: NDArray[np.uint8], grid: Grid, *, tolerance: float) -> RoadGraph:
    """Turn a gray-scale skeleton into a map.

    Parameters
    ----------
    skeleton
        From `probe2road.baselines.biagioni.gray_skeleton.gray_skeleton`, shape ``(rows, cols)``.
    grid
        Its grid.
    tolerance
        Of Douglas-Peucker, m.

    Returns
    -------
    RoadGraph
        The ``score`` of a segment is the mean rank of its pixels as a share of all levels: its weight in matching.

    Notes
    -----
    METHOD 4.3. The published Douglas-Peucker loses the vertex where it cuts a line; this one does not.
    """
    options = VectorizeOptions(smoothing=0.0, simplify_tolerance=tolerance)
    graph = graph_from_pixels(trace_fringe(skeleton), grid, probability=skeleton, options=options)
    return replace(graph, edges=graph.edges.assign(score=graph.edges["score"] / len(LEVELS)))


def straight_pieces(graph: RoadGraph) -> Pieces:
    """Cut all segments at their bends.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> pieces = straight_pieces(graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 9), (0, 9)]], crs="EPSG:32616"))
    >>> pieces.segment.tolist(), pieces.graph.edges[["u", "v"]].values.tolist()
    ([0, 1, 1], [[0, 1], [1, 3], [3, 2]])
    """
    xy, owner = shapely.get_coordinates(graph.edges.geometry.to_numpy(), return_index=True)
    last = np.diff(owner, append=-1) != 0
    first = np.roll(last, 1)
    bend = ~(first | last)
    node = np.empty(len(xy), np.int64)
    node[first], node[last] = graph.end_rows.T
    node[bend] = len(graph.nodes) + np.arange(bend.sum())
    start = np.flatnonzero(~last)
    lines = shapely.linestrings(np.stack([xy[start], xy[start + 1]], axis=1))
    edges = gpd.GeoDataFrame({"u": node[start], "v": node[start + 1]}, geometry=lines, crs=graph.crs)
    points = np.concatenate([graph.nodes.geometry.to_numpy(), shapely.points(xy[bend])])
    nodes = gpd.GeoDataFrame(geometry=points, crs=graph.crs)
    return Pieces(RoadGraph(nodes, finish_edges(edges), empty_turns()), owner[start].astype(np.int64))
