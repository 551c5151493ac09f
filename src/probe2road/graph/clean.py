"""Cleaning of road graphs: degree-2 nodes, dead ends, short edges between junctions, small components.

Strategy
--------
Every step takes the graph apart into flat arrays (see `probe2road.graph.topology`), works on all edges at once, and
returns a new graph, or its input itself where there is nothing to do: that is how `clean_graph` knows that it
has reached the fixed point. Each step that does something leaves fewer nodes or edges, so there is one.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Annotated, Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.bounds import NotNegative, OneOf
from probe2road.errors import OptionError
from probe2road.graph.contraction import contract_short_edges
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import finish_edges
from probe2road.graph.topology import Topology, chains, joined_lines, mates
from probe2road.options import checked

__all__ = [
    "CleanOptions",
    "clean_graph",
    "collapse_short_edges",
    "drop_dead_ends",
    "drop_edges",
    "drop_small_components",
    "merge_degree_two_nodes",
]

logger = logging.getLogger(__name__)

_STRENGTH = {"segmentation": 0, "reference": 1, "gap": 2}  # a chain takes the origin of its least doubtful member


@dataclass(frozen=True)
@checked
class CleanOptions:
    """Which parts of a graph count as flaws."""

    short_edge: NotNegative[float] = 15.0  # m; edges between junctions up to this long may collapse; 0 keeps all
    collapse: Annotated[str, OneOf("shape", "length")] = "shape"  # those that keep the lines in place, or all
    max_shift: NotNegative[float] = 3.0  # m by which a collapse that keeps them in place may move a line
    dead_end: NotNegative[float] = 15.0  # m; shorter dead ends and isolated edges are dropped; 0 keeps all
    component: NotNegative[float] = 15.0  # m; shorter components are dropped; 0 keeps all


def clean_graph(graph: RoadGraph, *, options: CleanOptions | None = None) -> RoadGraph:
    """Clean a graph repeatedly until nothing changes any more.

    Each round drops small components and short dead ends, then collapses short edges between junctions, then
    merges nodes of degree 2. Dead ends go first because a spur cuts a road into short edges that are none once
    it is gone. Cleaning a clean graph returns it as it is. An empty graph stays empty.

    Parameters
    ----------
    graph
        Any road graph.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        Attributes and turns are those of `merge_degree_two_nodes`; turns from, to or over removed edges are
        dropped, and turns at collapsed junctions move to the node that replaces them.

    Notes
    -----
    METHOD 0.1 rows 25 to 27.

    Examples
    --------
    A road with a spur of 4 m is one road:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (50, 0)], [(50, 0), (50, 4)], [(50, 0), (99, 0)]]
    >>> clean_graph(graph_from_lines(lines, crs="EPSG:32616")).edges["length"].tolist()
    [99.0]
    """
    options = options or CleanOptions()
    shift = options.max_shift if options.collapse == "shape" else None
    before, done = graph, None
    while done is not graph:
        done = graph
        graph = drop_small_components(graph, min_length=options.component)
        graph = drop_dead_ends(graph, min_length=options.dead_end)
        graph = collapse_short_edges(graph, max_length=options.short_edge, max_shift=shift)
        graph = merge_degree_two_nodes(graph)
    logger.info("cleaned %d edges (%.3f km) to %d", len(before.edges), before.length / 1000, len(graph.edges))
    return graph


def drop_edges(graph: RoadGraph, dropped: NDArray[np.bool_], *, why: str) -> RoadGraph:
    """Drop edges, their turns, and the nodes that lose their last edge; return the same graph if no edge is dropped.

    Parameters
    ----------
    graph
        Any road graph.
    dropped
        Which, in the order of the edges.
    why
        For the log: "removed 3 edges WHY".

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 9)]], crs="EPSG:32616")
    >>> len(drop_edges(graph, np.array([True, False]), why="as an example").nodes)
    2
    """
    if not dropped.any():
        return graph
    edges = graph.edges[~dropped]
    lost = graph.edges.index[dropped]
    turns = graph.turns[~(graph.turns["from_edge"].isin(lost) | graph.turns["to_edge"].isin(lost))]
    logger.info("removed %d edges %s", len(lost), why)
    nodes = _nodes_with_edges(graph.nodes, graph.edges, edges)
    return replace(graph, nodes=nodes, edges=finish_edges(edges), turns=turns)


def drop_small_components(graph: RoadGraph, *, min_length: float = 15.0) -> RoadGraph:
    """Drop connected components with a total length below ``min_length`` (m), and the turns on them.

    Raises
    ------
    OptionError
        If the length is negative.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (9, 0)], [(50, 0), (99, 0)]], crs="EPSG:32616")
    >>> drop_small_components(graph).edges["length"].to_dict()
    {1: 49.0}
    """
    _require_length(min_length, "min_length")
    u, v = graph.end_rows.T
    n_nodes = len(graph.nodes)
    adjacency = coo_array((np.ones(len(u), bool), (u, v)), shape=(n_nodes, n_nodes))
    _, component = connected_components(adjacency, directed=False) if n_nodes else (0, np.zeros(0, np.int64))
    total = np.bincount(component[u], weights=graph.edges["length"], minlength=n_nodes)
    return drop_edges(graph, total[component[u]] < min_length, why=f"in components shorter than {min_length:g} m")


def drop_dead_ends(graph: RoadGraph, *, min_length: float = 15.0) -> RoadGraph:
    """Drop dead ends and isolated edges shorter than ``min_length`` (m), repeatedly until none is left.

    Lengths are measured up to the junction: nodes of degree 2 are merged first, and again after each round. At a
    junction the shortest go first and two ends always stay. A road that ends in a fork of two spurs so keeps the
    longer one as its end and is not eaten up from there spur by spur, and a star of short edges keeps its two
    longest, which then are one edge. Loops are no dead ends.

    Parameters
    ----------
    graph
        Any road graph.
    min_length
        Metres; 0 only merges.

    Returns
    -------
    RoadGraph
        Without nodes of degree 2; attributes and turns as for `merge_degree_two_nodes`, and turns on dropped edges
        dropped.

    Raises
    ------
    OptionError
        If the length is negative.

    Notes
    -----
    METHOD 0.1 row 26.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> fork = [[(0, 0), (50, 0)], [(50, 0), (54, 3)], [(50, 0), (54, -4)]]
    >>> print(drop_dead_ends(graph_from_lines(fork, crs="EPSG:32616")).edges.geometry.iloc[0])
    LINESTRING (0 0, 50 0, 54 -4)
    """
    _require_length(min_length, "min_length")
    done = None
    while done is not graph:
        graph = done = merge_degree_two_nodes(graph)
        u, v = graph.end_rows.T
        degree = np.bincount(graph.end_rows.ravel(), minlength=len(graph.nodes))
        length = graph.edges["length"].to_numpy()
        tips = (degree[u] == 1).astype(int) + (degree[v] == 1)
        spur = np.flatnonzero((tips == 1) & (length < min_length))
        junction = np.where(degree[u[spur]] == 1, v[spur], u[spur])
        order = np.lexsort([length[spur], junction])
        spur, junction = spur[order], junction[order]
        rank = np.arange(len(spur)) - np.searchsorted(junction, junction)  # shortest at its junction: 0
        dropped = (tips == 2) & (length < min_length)
        dropped[spur[rank < degree[junction] - 2]] = True
        graph = drop_edges(graph, dropped, why=f"in dead ends shorter than {min_length:g} m")
    return graph


def collapse_short_edges(graph: RoadGraph, *, max_length: float = 15.0, max_shift: float | None = 3.0) -> RoadGraph:
    """Collapse edges of at most ``max_length`` (m) between two junctions, the shortest first, until none is left.

    Two junctions become one in the middle, weighted by the number of junctions that went into each. Around
    it, within one and a half times the distance of the two, the other edges become straight lines to it, which
    cuts off the hooks that thinning leaves there. Edges with a dead end are never collapsed, nor are loops.

    A collapse must not change the shape of the roads: an edge stays if its collapse would move any line by more than
    ``max_shift``. Where two roads cross at a flat angle they lie beside the edge between their two junctions, and
    hardly move. At a roundabout, at an island, or where the crossed road is two carriageways, they would. A small hole
    in the mask collapses with the edges on both of its sides.

    Parameters
    ----------
    graph
        Any road graph; its nodes of degree 2 are merged first, for a short edge may be a chain.
    max_length
        Metres; 0 only merges.
    max_shift
        Metres by which one collapse may move lines: the Hausdorff distance, in either direction, of the lines within
        its circle before and after. None collapses by length alone, as the paper does.

    Returns
    -------
    RoadGraph
        Edges keep ids and attributes, a new junction has the id of the first of its old ones in table order.
        Turns move to the new junctions; those from or to collapsed edges are dropped.

    Raises
    ------
    OptionError
        If a length is negative.

    Notes
    -----
    METHOD 0.1 row 25 and 7.3: thinning leaves such edges where roads cross. Length alone cannot tell them from
    real short links.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> cross = [[(0, 40), (40, 3)], [(0, -40), (40, 3)], [(40, 3), (44, 3)], [(44, 3), (84, 40)], [(44, 3), (84, -40)]]
    >>> graph = collapse_short_edges(graph_from_lines(cross, crs="EPSG:32616"))
    >>> print(graph.nodes.geometry[1], graph.degrees()[1])
    POINT (42 3) 4
    """
    _require_length(max_length, "max_length")
    if max_shift is not None:
        _require_length(max_shift, "max_shift")
    graph = merge_degree_two_nodes(graph)
    network, stands_for = contract_short_edges(_network(graph), max_length=max_length, max_shift=max_shift)
    if len(network.edge) == len(graph.edges):
        return graph
    node = graph.nodes.index.to_numpy()
    line = np.repeat(np.arange(len(network.edge)), np.diff(network.offsets))
    edges = graph.edges.iloc[network.edge].assign(
        u=node[network.u], v=node[network.v], geometry=shapely.linestrings(network.vertices, indices=line)
    )
    points = graph.nodes.geometry.to_numpy().copy()
    grown = network.weight > 1
    points[grown] = shapely.points(network.position[grown])
    turns = _renamed_turns(
        graph.turns,
        edges=pd.Series(edges.index, index=edges.index),
        nodes=pd.Series(node[stands_for], index=graph.nodes.index),
    )
    logger.info("collapsed %d edges up to %g m between junctions", len(graph.edges) - len(edges), max_length)
    nodes = _nodes_with_edges(graph.nodes.set_geometry(points, crs=graph.crs), graph.edges, edges)
    return replace(graph, nodes=nodes, edges=finish_edges(edges), turns=turns)


def merge_degree_two_nodes(graph: RoadGraph) -> RoadGraph:
    """Join the edges that meet at nodes of degree 2 into one edge.

    No vertex is lost: the joint stays as a vertex of the line. Loops and parallel edges survive, and a ring
    without junctions keeps one node, the start of its first edge. Nodes without edges stay. A graph without
    nodes to merge is returned as it is.

    Parameters
    ----------
    graph
        Any road graph.

    Returns
    -------
    RoadGraph
        A merged edge takes the id, the direction and any further columns of its first member in table order.
        ``support`` is the minimum of the members, ``forward`` and ``backward`` the minimum in the merged
        direction; all three are unknown where one member's is. ``score`` is the mean weighted by length over
        the members whose score is known. ``origin`` is ``gap`` only where all members are, and ``reference``
        only where none is from segmentation. Turns at merged nodes are dropped, all others follow their edges.

    Notes
    -----
    METHOD 0.1 rows 26 and 27; the minimum is the rule of Biagioni and Eriksson (METHOD 4.5).

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(50, 9), (0, 0)], [(50, 9), (99, 0)]], crs="EPSG:32616")
    >>> print(merge_degree_two_nodes(graph).edges.geometry.iloc[0])
    LINESTRING (99 0, 50 9, 0 0)

    Two halves of a ring become a loop:

    >>> ring = graph_from_lines([[(0, 0), (9, 0), (9, 9)], [(9, 9), (0, 9), (0, 0)]], crs="EPSG:32616")
    >>> merge_degree_two_nodes(ring).edges[["u", "v", "length"]].values.tolist()
    [[0.0, 0.0, 36.0]]
    """
    u, v = graph.end_rows.T
    mate = mates(u, v)
    if not (mate >= 0).any():
        return graph
    members, backwards, starts = chains(mate)
    stops = np.append(starts[1:], len(members))
    first, last = members[starts], members[stops - 1]
    # The first member in table order gives the chain its id and direction.
    name = np.minimum.reduceat(members, starts)
    node = graph.nodes.index.to_numpy()
    merged = graph.edges.iloc[name].assign(
        u=node[np.where(backwards[starts], v[first], u[first])],
        v=node[np.where(backwards[stops - 1], u[last], v[last])],
        geometry=joined_lines(graph.edges.geometry.to_numpy(), members, backwards, starts),
        **_joined_attributes(graph.edges, members, backwards, starts),
    )
    chain = np.empty(len(members), np.int64)
    chain[members] = np.repeat(graph.edges.index.to_numpy()[name], stops - starts)
    nodes = _nodes_with_edges(graph.nodes, graph.edges, merged)
    turns = graph.turns[graph.turns["via_node"].isin(nodes.index)]
    turns = _renamed_turns(turns, edges=pd.Series(chain, index=graph.edges.index))
    logger.info("merged %d nodes of degree 2, %d edges left", len(node) - len(nodes), len(merged))
    return replace(graph, nodes=nodes, edges=finish_edges(merged), turns=turns)


def _network(graph: RoadGraph) -> Topology:
    """Return a graph as arrays; heights stay with the vertices."""
    u, v = graph.end_rows.T
    lines = graph.edges.geometry.to_numpy()
    vertices = shapely.get_coordinates(lines, include_z=bool(shapely.has_z(lines).any()))
    return Topology(
        position=shapely.get_coordinates(graph.nodes.geometry.to_numpy()),
        u=u.copy(),  # a writable copy, so that compiled functions get one type of array
        v=v.copy(),
        vertices=vertices,
        offsets=np.concatenate([[0], np.cumsum(shapely.get_num_coordinates(lines))]),
        edge=np.arange(len(u)),
        weight=np.ones(len(graph.nodes), np.int64),
    )


def _nodes_with_edges(nodes: gpd.GeoDataFrame, before: pd.DataFrame, after: pd.DataFrame) -> gpd.GeoDataFrame:
    """Drop the nodes that have lost their last edge."""
    had, has = (nodes.index.isin(np.unique(edges[["u", "v"]])) for edges in (before, after))
    return nodes[has | ~had]


def _require_length(value: float, name: str) -> None:
    if not 0 <= value < np.inf:
        raise OptionError(f"{name} is {value}", where="clean", fix="use 0 m or more")


def _joined_attributes(
    edges: pd.DataFrame, members: NDArray[np.int64], backwards: NDArray[np.bool_], starts: NDArray[np.int64]
) -> dict[str, Any]:
    """Aggregate the attribute columns of the members of every chain."""

    def column(name: str) -> NDArray[np.float64]:
        return edges[name].to_numpy("float64", na_value=np.nan)[members]

    def minimum(values: NDArray[np.float64]) -> Any:  # NaN if any value is NaN
        return pd.array(np.minimum.reduceat(values, starts), dtype="Float64").astype("Int64")

    ahead, against = column("forward"), column("backward")
    weight = np.where(np.isnan(column("score")), 0.0, column("length"))
    known = np.add.reduceat(weight, starts)
    score = np.add.reduceat(weight * np.nan_to_num(column("score")), starts)
    mean = np.divide(score, known, out=np.full(len(starts), np.nan), where=known > 0)
    single = np.diff(np.append(starts, len(members))) == 1  # single members are not averaged, which avoids rounding
    strength = edges["origin"].map(_STRENGTH).to_numpy()[members]
    return {
        "origin": np.array(list(_STRENGTH))[np.minimum.reduceat(strength, starts)],
        "support": minimum(column("support")),
        "score": np.where(single, column("score")[starts], mean),
        "forward": minimum(np.where(backwards, against, ahead)),
        "backward": minimum(np.where(backwards, ahead, against)),
    }


def _renamed_turns(turns: pd.DataFrame, *, edges: pd.Series, nodes: pd.Series | None = None) -> pd.DataFrame:
    """Give turns the new ids of their edges and nodes, drop turns of dropped edges, and add up equal ones."""
    if turns.empty:
        return turns
    known = turns[turns["from_edge"].isin(edges.index) & turns["to_edge"].isin(edges.index)]
    renamed = known.assign(
        from_edge=edges[known["from_edge"]].to_numpy(),
        via_node=known["via_node"].to_numpy() if nodes is None else nodes[known["via_node"]].to_numpy(),
        to_edge=edges[known["to_edge"]].to_numpy(),
    )
    keys = ["from_edge", "via_node", "to_edge"]
    return renamed.groupby(keys, sort=False, as_index=False)["count"].sum()
