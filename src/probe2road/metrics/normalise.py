"""Normalisation of both graphs before any metric: one CRS, one area, no twin edges, no nodes of degree 2."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.crs import require_metric
from probe2road.errors import InputError
from probe2road.graph.clean import merge_degree_two_nodes
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.metrics.network import EPSILON, Network, locate, network_from_graph

__all__ = ["clip_graph", "comparable", "comparable_networks", "drop_twin_edges"]

logger = logging.getLogger(__name__)


def comparable(
    proposal: RoadGraph, reference: RoadGraph, *, area: Any = None, merge: bool = True
) -> tuple[RoadGraph, RoadGraph]:
    """Normalise two graphs so that they can be compared.

    Parameters
    ----------
    proposal, reference
        Road graphs; the proposal is reprojected to the CRS of the reference.
    area
        Where to compare, in the CRS of the reference: a polygon, or ``(left, bottom, right, top)``. Both graphs
        are clipped by `clip_graph`. Leave a margin of 50 m or so to where the data ends: clipping makes dead ends.
    merge
        Whether to drop twins (`drop_twin_edges`) and then merge nodes of degree 2, after clipping.

    Returns
    -------
    proposal, reference
        New graphs.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    METHOD 0.1 row 29 and 6.1.
    """
    require_metric(proposal.crs, where="proposal")
    require_metric(reference.crs, where="reference")
    if proposal.crs != reference.crs:
        logger.info("reprojecting the proposal from %s to %s", proposal.crs.name, reference.crs.name)
        proposal = proposal.to_crs(reference.crs)
    graphs = [proposal, reference]
    if area is not None:
        graphs = [clip_graph(graph, area) for graph in graphs]
    if merge:
        graphs = [merge_degree_two_nodes(drop_twin_edges(graph)) for graph in graphs]
    return graphs[0], graphs[1]


def comparable_networks(
    proposal: RoadGraph, reference: RoadGraph, *, area: Any = None, merge: bool = True
) -> tuple[Network, Network]:
    """Return two graphs, normalised by `comparable`, as arrays."""
    first, second = comparable(proposal, reference, area=area, merge=merge)
    return network_from_graph(first), network_from_graph(second)


def drop_twin_edges(graph: RoadGraph) -> RoadGraph:
    """Keep only one of several edges that join the same nodes along the same line, in either direction.

    Maps with one edge per direction draw such twins; in an undirected graph they are one road. Roads one above the
    other have different nodes and stay. The first edge is kept as it is; turns are dropped where a twin is.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (9, 0)], [(9, 0), (0, 0)], [(0, 0), (4, 4), (9, 0)]]
    >>> drop_twin_edges(graph_from_lines(lines, crs="EPSG:32616")).edges["length"].round(1).tolist()
    [9.0, 12.1]
    """
    edges = graph.edges
    line = shapely.to_wkb(shapely.normalize(shapely.force_2d(edges.geometry.to_numpy())))
    low, high = edges[["u", "v"]].min(axis=1), edges[["u", "v"]].max(axis=1)
    twin = pd.DataFrame({"low": low, "high": high, "line": line}).duplicated().to_numpy()
    if not twin.any():
        return graph
    return replace(graph, edges=finish_edges(edges[~twin]), turns=empty_turns())


def clip_graph(graph: RoadGraph, area: Any) -> RoadGraph:
    """Keep the part of a graph within an area; roads are cut at the border and end there in new nodes.

    Nodes keep their identity, so roads that cross without meeting still do not meet. Pieces shorter than a
    micrometre are left out, and so are nodes that lose all their edges. Turns are dropped.

    Parameters
    ----------
    graph
        Any road graph.
    area
        Polygon or MultiPolygon, or ``(left, bottom, right, top)``, in the graph's CRS.

    Returns
    -------
    RoadGraph
        An edge in one piece keeps its id; further pieces get new ids. Heights of cut edges are interpolated.

    Raises
    ------
    InputError
        If the area is empty or not an area.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 50)]], crs="EPSG:32616")
    >>> clip_graph(graph, (40, -10, 120, 20)).edges["length"].tolist()
    [60.0, 20.0]
    """
    polygon = area if isinstance(area, shapely.Geometry) else shapely.box(*area)
    if polygon.is_empty or polygon.area == 0:
        raise InputError("the area to clip to is empty", where="clip", fix="pass a polygon or left, bottom, right, top")
    shapely.prepare(polygon)
    lines = graph.edges.geometry.to_numpy()
    inside = shapely.covers(polygon, lines)
    crossing = np.flatnonzero(~inside & shapely.intersects(polygon, lines))
    network = network_from_graph(graph)
    edge, begin, end = _intervals_inside(network, crossing, polygon)
    return _with_pieces(graph, network, inside, edge, begin, end)


def _intervals_inside(
    network: Network, edges: NDArray[np.int64], polygon: shapely.Geometry
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Find the stretches of edges inside a polygon, segment by segment, as offsets along the edges.

    Single segments cannot cross themselves, so a loop that does is not cut at its own crossing.
    """
    rows = np.concatenate([np.arange(network.first[e], network.first[e + 1] - 1) for e in edges] or [np.empty(0, int)])
    rows = rows.astype(np.int64)
    owner = np.searchsorted(network.first, rows, side="right") - 1
    segments = shapely.linestrings(np.stack([network.xy[rows], network.xy[rows + 1]], axis=1)) if len(rows) else []
    parts, segment = shapely.get_parts(shapely.intersection(segments, polygon), return_index=True)
    linear = shapely.length(parts) > EPSILON
    parts, segment = parts[linear], segment[linear]
    start = network.xy[rows[segment]]
    ends = np.stack([shapely.get_coordinates(shapely.get_point(parts, k)) for k in (0, -1)], axis=1)
    away = np.sort(np.hypot(ends[..., 0] - start[:, None, 0], ends[..., 1] - start[:, None, 1]), axis=1)
    begin, end = (network.along[rows[segment]][:, None] + away).T
    order = np.lexsort((begin, owner[segment]))
    edge, begin, end = owner[segment][order], begin[order], end[order]
    fresh = np.ones(len(edge), bool)
    fresh[1:] = (edge[1:] != edge[:-1]) | (begin[1:] > end[:-1] + EPSILON)
    last = np.append(np.flatnonzero(fresh)[1:], len(edge)) - 1
    return edge[fresh], begin[fresh], end[last[: fresh.sum()]]


def _with_pieces(
    graph: RoadGraph,
    network: Network,
    whole: NDArray[np.bool_],
    edge: NDArray[np.int64],
    begin: NDArray[np.float64],
    end: NDArray[np.float64],
) -> RoadGraph:
    """Build a graph from whole edges and from pieces of others; the cut ends get new nodes."""
    cut_begin, cut_end = begin > EPSILON, end < network.length[edge] - EPSILON
    node_ids = graph.nodes.index.to_numpy()
    spare = (node_ids.max() if len(node_ids) else -1) + 1
    u, v = node_ids[network.u[edge]], node_ids[network.v[edge]]
    u[cut_begin] = spare + np.arange(cut_begin.sum())
    v[cut_end] = spare + cut_begin.sum() + np.arange(cut_end.sum())
    lines = graph.edges.geometry.to_numpy()
    pieces = [_piece(lines[e], *ends) for e, *ends in zip(edge, begin, end, strict=True)]

    table = graph.edges.iloc[edge].assign(u=u, v=v)
    table = table.set_geometry(gpd.GeoSeries(pieces, index=table.index, crs=graph.crs))
    again = table.index.duplicated()
    ids = table.index.to_numpy().copy()
    ids[again] = (graph.edges.index.max() if len(ids) else 0) + 1 + np.arange(again.sum())
    edges = pd.concat([graph.edges[whole], table.set_index(pd.Index(ids))])

    corner, _ = locate(network, np.r_[edge[cut_begin], edge[cut_end]], np.r_[begin[cut_begin], end[cut_end]])
    borders = gpd.GeoDataFrame(
        geometry=shapely.points(corner), index=spare + np.arange(len(corner)), crs=graph.nodes.crs
    )
    nodes = pd.concat([graph.nodes, borders]) if len(borders) else graph.nodes
    nodes = nodes[nodes.index.isin(pd.concat([edges["u"], edges["v"]]))].rename_axis("node")
    return replace(graph, nodes=nodes, edges=finish_edges(edges), turns=empty_turns())


def _piece(line: shapely.LineString, begin: float, end: float) -> shapely.LineString:
    """Cut a line at two offsets in plan, and interpolate heights there."""
    coordinates = shapely.get_coordinates(line, include_z=bool(line.has_z))
    step = np.hypot(*np.diff(coordinates[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(step)])
    inner = (along > begin + EPSILON) & (along < end - EPSILON)
    offsets = np.concatenate([[begin], along[inner], [end]])
    return shapely.LineString(np.column_stack([np.interp(offsets, along, axis) for axis in coordinates.T]))
