"""Ids that last: a graph that is built again takes over the ids of an earlier one, road by road.

Strategy. Every few metres of an edge are looked up on the earlier graph, and the other way round. Two edges are
related if half of one of them lies on the other. Of all related pairs the one with the longest common stretch is
joined first, then the longest of what is left: the new edge gets the earlier id. So an edge that was split keeps its
id on its longest part, and one that was merged from several has the id of the longest. What has no earlier edge gets
an id that was never used before. Nodes keep theirs where the two graphs have each other's nearest node.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from probe2road.bounds import Positive, Probability
from probe2road.comparison.overlap import OverlapOptions, Roads, counterparts, overlaps, require_common_area, roads_of
from probe2road.errors import OptionError
from probe2road.graph.direction import in_driving_direction, turned
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import finish_edges
from probe2road.options import checked

__all__ = ["CHANGES", "IdentityOptions", "keep_ids"]

logger = logging.getLogger(__name__)

CHANGES = ("kept", "moved", "split", "merged", "new", "gone")
_LARGEST_ID = 2**63 - 1


@dataclass(frozen=True)
@checked
class IdentityOptions:
    """When an edge of a new graph is an edge of an earlier one."""

    overlap: OverlapOptions = field(default_factory=OverlapOptions)  # where two lines are the same road
    min_share: Probability = 0.5  # of one of the two edges that lies on the other, at least
    moved: Positive[float] = 3.0  # m between the lines, on average, from which on an edge has moved
    moved_end: Positive[float] = 20.0  # m between the ends, from which on it has moved, too
    node_radius: Positive[float] = 20.0  # m within which a node is the same


def keep_ids(
    graph: RoadGraph, earlier: RoadGraph, *, first_new: int | None = None, options: IdentityOptions | None = None
) -> tuple[RoadGraph, gpd.GeoDataFrame]:
    """Give the edges and nodes of a graph the ids that the same roads have in an earlier graph.

    The result depends on the two graphs only, not on the order of their edges. An edge that is open both ways runs in
    the direction that it had, so that a position from 0 to 1 along it stays where it was.

    Parameters
    ----------
    graph
        The new graph.
    earlier
        The earlier one, in any metric CRS; it may be without roads: then every edge is new.
    first_new
        Ids of new edges and nodes are at least this. None: above all ids of the earlier graph. Where the highest id of
        the earlier graph may once have been given to a road that is gone, pass one more than the highest ever given.
    options
        None takes the defaults.

    Returns
    -------
    graph : RoadGraph
        The same roads with other ids, ordered by them.
    changes : GeoDataFrame
        One row for each pair of edges that are the same road, and for each edge without one, in the order of
        ``earlier``, then ``edge``: ``change`` (one of `CHANGES`), ``edge`` (id in the returned graph, NA if gone),
        ``earlier`` (id in the earlier graph, NA if new), ``of_edge`` and ``of_earlier`` (the share of either that lies
        on the other), ``distance`` (m between the lines, on average), ``end_distance`` (m between their ends, the
        larger), and the line of the edge, or of the earlier one if it is gone.

    Raises
    ------
    InputError
        If the two graphs are of different places.
    OptionError
        If ids beyond 2**63 - 1 would be needed.

    Examples
    --------
    The street is built again half a metre beside, and cut by a new side street:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> earlier = graph_from_lines([[(0, 0), (300, 0)]], crs="EPSG:32616")
    >>> lines = [[(100, 0.5), (100, 90)], [(100, 0.5), (300, 0.5)], [(0, 0.5), (100, 0.5)]]
    >>> graph, changes = keep_ids(graph_from_lines(lines, crs="EPSG:32616"), earlier)
    >>> graph.edges["length"].to_dict()
    {0: 200.0, 1: 100.0, 2: 89.5}
    >>> changes[["change", "edge", "earlier"]].values.tolist()
    [['split', 0, 0], ['split', 1, 0], ['new', 2, <NA>]]
    """
    options = options or IdentityOptions()
    earlier = earlier.to_crs(graph.crs)
    graph = replace(graph, edges=in_driving_direction(graph.edges))
    if not graph.edges.empty and not earlier.edges.empty:
        require_common_area(graph, earlier, where="keep_ids", name="earlier graph")
    graph = replace(graph, edges=_by_place(graph.edges))
    ours, theirs = roads_of(graph), roads_of(replace(earlier, edges=earlier.edges.sort_index()))
    pairs = _related(ours, theirs, options)
    joined = pairs.iloc[_longest_first(pairs)]
    graph = replace(graph, edges=_turned_as_before(ours, joined))
    edge_ids = _ids(len(ours.sense), joined, theirs.graph.edges.index.to_numpy(), first_new)
    node_pairs = _same_nodes(graph, earlier, options.node_radius)
    node_ids = _ids(len(graph.nodes), node_pairs, earlier.nodes.index.to_numpy(), first_new)
    changes = _changes(ours, theirs, pairs, edge_ids, options)
    counts = changes["change"].value_counts()
    logger.info("ids of an earlier graph: %s", ", ".join(f"{counts.get(name, 0)} {name}" for name in CHANGES))
    return _renumbered(graph, edge_ids, node_ids), changes


def _by_place(edges: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Order edges by their middle, so that new ids do not depend on the order in which they come."""
    middle = shapely.get_coordinates(shapely.line_interpolate_point(edges.geometry.to_numpy(), 0.5, normalized=True))
    return edges.iloc[np.lexsort((edges["length"], *middle.T[::-1]))]


def _related(ours: Roads, theirs: Roads, options: IdentityOptions) -> pd.DataFrame:
    """Return the pairs of rows ``edge``, ``other`` of edges that are the same road, with what they share."""
    there = overlaps(counterparts(ours, theirs, options.overlap))
    back = overlaps(counterparts(theirs, ours, options.overlap)).rename(columns={"edge": "other", "other": "edge"})
    pairs = there.merge(back[["edge", "other", "metres"]], on=["edge", "other"], suffixes=("", "_earlier"))
    pairs["of_edge"] = pairs["metres"] / ours.network.length[pairs["edge"]]
    pairs["of_earlier"] = pairs["metres_earlier"] / theirs.network.length[pairs["other"]]
    opposed = ours.sense[pairs["edge"]] * theirs.sense[pairs["other"]] * np.sign(pairs["along"] - 0.5) < 0
    same = (pairs[["of_edge", "of_earlier"]].max(axis=1) >= options.min_share) & ~opposed
    return pairs[same].reset_index(drop=True)


def _longest_first(pairs: pd.DataFrame) -> NDArray[np.int64]:
    """Return the rows of the pairs that are joined: one for each edge of either graph, the longest first."""
    metres = pairs[["metres", "metres_earlier"]].min(axis=1).round(6)
    order = np.lexsort((pairs["edge"], pairs["other"], -metres))
    taken, edges, others = [], set(), set()
    for row, edge, other in zip(order, pairs["edge"].to_numpy()[order], pairs["other"].to_numpy()[order], strict=True):
        if edge not in edges and other not in others:
            taken.append(row)
            edges.add(edge)
            others.add(other)
    return np.array(taken, np.int64)


def _turned_as_before(ours: Roads, pairs: pd.DataFrame) -> gpd.GeoDataFrame:
    """Return our edges, of which those that are open both ways run as the earlier edge does."""
    against = np.zeros(len(ours.sense), bool)
    against[pairs["edge"][pairs["along"] < 0.5]] = True
    return turned(ours.graph.edges, against & (ours.sense == 0))


def _same_nodes(graph: RoadGraph, earlier: RoadGraph, radius: float) -> pd.DataFrame:
    """Return the rows ``edge``, ``other`` of nodes that are each other's nearest within a radius."""
    here, there = (shapely.get_coordinates(nodes.geometry.to_numpy()) for nodes in (graph.nodes, earlier.nodes))
    if not len(here) or not len(there):
        return pd.DataFrame({"edge": np.zeros(0, np.int64), "other": np.zeros(0, np.int64)})
    away, nearest = KDTree(there).query(here)
    mutual = KDTree(here).query(there)[1][nearest] == np.arange(len(here))
    own = np.flatnonzero(mutual & (away <= radius))
    return pd.DataFrame({"edge": own, "other": nearest[own]})


def _ids(n: int, pairs: pd.DataFrame, known: NDArray[np.int64], first_new: int | None) -> NDArray[np.int64]:
    """Return ids for n rows: the known one of the partner, or a new one, in the order of the rows."""
    ids, new = np.zeros(n, np.int64), np.ones(n, bool)
    ids[pairs["edge"]], new[pairs["edge"]] = known[pairs["other"]], False
    lowest = max(int(known.max()) + 1 if len(known) else 0, first_new or 0)
    if lowest + int(new.sum()) > _LARGEST_ID:
        raise OptionError(f"new ids would begin at {lowest}", where="keep_ids", fix="use ids below 2**63")
    ids[new] = lowest + np.arange(int(new.sum()))
    return ids


def _changes(
    ours: Roads, theirs: Roads, pairs: pd.DataFrame, ids: NDArray[np.int64], options: IdentityOptions
) -> gpd.GeoDataFrame:
    """Return the table of changes."""
    known = theirs.graph.edges.index.to_numpy()
    several = pairs.groupby("edge")["other"].transform("size").to_numpy() > 1
    parts = pairs.groupby("other")["edge"].transform("size").to_numpy() > 1
    end_distance = _end_distances(ours, theirs, pairs)
    moved = (pairs["distance"] >= options.moved) | (end_distance >= options.moved_end)
    change = np.select([several, parts, moved], ["merged", "split", "moved"], "kept")
    new = np.setdiff1d(np.arange(len(ids)), pairs["edge"])
    gone = np.setdiff1d(np.arange(len(known)), pairs["other"])
    lines = (ours.graph.edges.geometry.to_numpy(), theirs.graph.edges.geometry.to_numpy())
    tables = [
        pd.DataFrame(
            {
                "change": change,
                "edge": ids[pairs["edge"]],
                "earlier": known[pairs["other"]],
                "of_edge": np.minimum(pairs["of_edge"], 1.0),
                "of_earlier": np.minimum(pairs["of_earlier"], 1.0),
                "distance": pairs["distance"],
                "end_distance": end_distance,
            }
        ),
        pd.DataFrame({"change": "new", "edge": ids[new]}),
        pd.DataFrame({"change": "gone", "earlier": known[gone]}),
    ]
    table = pd.concat([part.astype({"change": "str"}) for part in tables], ignore_index=True)
    table = table.astype({"edge": "Int64", "earlier": "Int64"})
    geometry = np.concatenate([lines[0][pairs["edge"]], lines[0][new], lines[1][gone]])
    result = gpd.GeoDataFrame(table, geometry=shapely.force_2d(geometry), crs=ours.graph.crs)
    return result.sort_values(["earlier", "edge"], ignore_index=True)


def _end_distances(ours: Roads, theirs: Roads, pairs: pd.DataFrame) -> NDArray[np.float64]:
    """Return how far the ends of two edges lie apart, the larger of the two distances, metres."""
    ends = []
    for roads, column in ((ours, "edge"), (theirs, "other")):
        network, row = roads.network, pairs[column].to_numpy()
        ends.append((network.node_xy[network.u[row]], network.node_xy[network.v[row]]))
    (start, stop), (first, last) = ends
    against = (pairs["along"] < 0.5).to_numpy()[:, None]
    first, last = np.where(against, last, first), np.where(against, first, last)
    return np.maximum(np.hypot(*(start - first).T), np.hypot(*(stop - last).T))


def _renumbered(graph: RoadGraph, edge_ids: NDArray[np.int64], node_ids: NDArray[np.int64]) -> RoadGraph:
    """Return the graph with other ids, in their order."""
    edge_of = pd.Series(edge_ids, graph.edges.index)
    node_of = pd.Series(node_ids, graph.nodes.index)
    nodes = graph.nodes.set_axis(pd.Index(node_ids, name="node")).sort_index()
    ends = {end: graph.edges[end].map(node_of).to_numpy() for end in ("u", "v")}
    edges = graph.edges.assign(**ends).set_axis(pd.Index(edge_ids, name="edge")).sort_index()
    turns = graph.turns.assign(
        from_edge=graph.turns["from_edge"].map(edge_of),
        via_node=graph.turns["via_node"].map(node_of),
        to_edge=graph.turns["to_edge"].map(edge_of),
    )
    turns = turns.sort_values(["from_edge", "via_node", "to_edge"], ignore_index=True)
    return RoadGraph(nodes, finish_edges(edges), turns.astype(graph.turns.dtypes.to_dict()))
