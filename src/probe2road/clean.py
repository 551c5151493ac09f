"""Cleaning of a road graph: degree-2 nodes, dead ends, short edges between junctions, small components.

Strategy
--------
A graph is taken apart into flat arrays: node rows ``u`` and ``v`` of every edge, and one long coordinate array
with offsets. An edge has two ends; end ``2 e`` is where edge ``e`` starts, end ``2 e + 1`` where it stops, so
``end // 2`` is the edge and ``end ^ 1`` the other end. Every step works on all edges at once, returns a new
graph, and returns its input itself where there is nothing to do: that is how `clean_graph` knows that it has
reached the fixed point.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import shapely
from numba import njit
from numpy.typing import NDArray

from probe2road.roadgraph import RoadGraph, finish_edges

__all__ = ["merge_degree_two_nodes"]

logger = logging.getLogger(__name__)

_STRENGTH = {"segmentation": 0, "reference": 1, "gap": 2}  # a chain takes the origin of its least doubtful member


def merge_degree_two_nodes(graph: RoadGraph) -> RoadGraph:
    """Join the edges that meet at nodes of degree 2 into one edge each.

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
    >>> from probe2road.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(50, 9), (0, 0)], [(50, 9), (99, 0)]], crs="EPSG:32616")
    >>> print(merge_degree_two_nodes(graph).edges.geometry.iloc[0])
    LINESTRING (99 0, 50 9, 0 0)

    Two halves of a ring become a loop:

    >>> ring = graph_from_lines([[(0, 0), (9, 0), (9, 9)], [(9, 9), (0, 9), (0, 0)]], crs="EPSG:32616")
    >>> merge_degree_two_nodes(ring).edges[["u", "v", "length"]].values.tolist()
    [[0.0, 0.0, 36.0]]
    """
    u, v = _end_rows(graph)
    mate = _mates(u, v)
    if not (mate >= 0).any():
        return graph
    members, backwards, starts = _chains(mate)
    stops = np.append(starts[1:], len(members))
    first, last = members[starts], members[stops - 1]
    # The first member in table order names the chain; the walk runs in its direction.
    name = np.minimum.reduceat(members, starts)
    node = graph.nodes.index.to_numpy()
    merged = graph.edges.iloc[name].assign(
        u=node[np.where(backwards[starts], v[first], u[first])],
        v=node[np.where(backwards[stops - 1], u[last], v[last])],
        geometry=_joined_lines(graph.edges.geometry.to_numpy(), members, backwards, starts),
        **_joined_attributes(graph.edges, members, backwards, starts),
    )
    chain = np.empty(len(members), np.int64)
    chain[members] = np.repeat(graph.edges.index.to_numpy()[name], stops - starts)
    kept = np.ones(len(node), bool)
    kept[u], kept[v] = False, False
    kept |= np.isin(node, merged[["u", "v"]].to_numpy())
    turns = graph.turns[graph.turns["via_node"].isin(node[kept])]
    turns = _renamed_turns(turns, edges=pd.Series(chain, index=graph.edges.index))
    logger.info("merged %d nodes of degree 2, %d edges left", (~kept).sum(), len(merged))
    return replace(graph, nodes=graph.nodes[kept], edges=finish_edges(merged), turns=turns)


def _end_rows(graph: RoadGraph) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the nodes table at which edges start and stop."""
    row = pd.Series(np.arange(len(graph.nodes)), index=graph.nodes.index)
    return row[graph.edges["u"]].to_numpy(), row[graph.edges["v"]].to_numpy()


def _mates(u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, per end, the other end at its node where the node joins exactly two edges, else -1."""
    node = np.stack([u, v], axis=1).reshape(-1)
    order = np.argsort(node, kind="stable")
    heads = np.flatnonzero(np.diff(node[order], prepend=-1))
    pairs = heads[np.diff(np.append(heads, len(order))) == 2]
    one, other = order[pairs], order[pairs + 1]
    distinct = one // 2 != other // 2  # the two ends of a loop have nothing to join
    mate = np.full(len(node), -1)
    mate[one[distinct]], mate[other[distinct]] = other[distinct], one[distinct]
    return mate


@njit(cache=True)
def _chains(mate: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64]]:
    """Walk every chain of mated ends in the direction of its first edge.

    Returns the members chain by chain, whether each is passed backwards, and where each chain starts.
    """
    n_edges = len(mate) // 2
    members = np.empty(n_edges, np.int64)
    backwards = np.empty(n_edges, np.bool_)
    starts = np.empty(n_edges, np.int64)
    seen = np.zeros(n_edges, np.bool_)
    filled = n_chains = 0
    for edge in range(n_edges):
        if seen[edge]:
            continue
        end = 2 * edge
        while mate[end] >= 0:  # back to where the chain begins, or once around a ring
            end = mate[end] ^ 1
            if end == 2 * edge:
                break
        starts[n_chains] = filled
        n_chains += 1
        while end >= 0 and not seen[end // 2]:
            seen[end // 2] = True
            members[filled], backwards[filled] = end // 2, end % 2 == 1
            filled += 1
            end = mate[end ^ 1]
    return members, backwards, starts[:n_chains]


def _joined_lines(
    lines: NDArray[Any], members: NDArray[np.int64], backwards: NDArray[np.bool_], starts: NDArray[np.int64]
) -> NDArray[Any]:
    """Concatenate lines along chains; the vertex that two members share appears once."""
    joined = lines[members[starts]]
    lengths = np.diff(np.append(starts, len(members)))
    moving = np.flatnonzero(np.repeat(lengths > 1, lengths))  # single edges keep their line
    chain = np.repeat(np.arange(len(starts)), lengths)[moving]
    has_z = bool(shapely.has_z(lines).any())
    coordinates, owner = shapely.get_coordinates(lines[members[moving]], include_z=has_z, return_index=True)
    count = np.bincount(owner, minlength=len(moving))
    offset = np.cumsum(count) - count
    place = np.arange(len(coordinates)) - offset[owner]
    flipped = backwards[moving][owner]
    source = offset[owner] + np.where(flipped, count[owner] - 1 - place, place)
    inner = np.diff(chain, prepend=-1) == 0  # members that follow another member of their chain
    wanted = ~(inner[owner] & (place == 0))
    if len(moving):
        names, group = np.unique(chain[owner[wanted]], return_inverse=True)
        joined[names] = shapely.linestrings(coordinates[source[wanted]], indices=group)
    return joined


def _joined_attributes(
    edges: pd.DataFrame, members: NDArray[np.int64], backwards: NDArray[np.bool_], starts: NDArray[np.int64]
) -> dict[str, Any]:
    """Aggregate the attribute columns of the members of every chain."""

    def column(name: str) -> NDArray[np.float64]:
        return edges[name].to_numpy("float64", na_value=np.nan)[members]

    def minimum(values: NDArray[np.float64]) -> Any:  # NaN wins, as it must
        return pd.array(np.minimum.reduceat(values, starts), dtype="Float64").astype("Int64")

    ahead, against = column("forward"), column("backward")
    weight = np.where(np.isnan(column("score")), 0.0, column("length"))
    known = np.add.reduceat(weight, starts)
    score = np.add.reduceat(weight * np.nan_to_num(column("score")), starts)
    mean = np.divide(score, known, out=np.full(len(starts), np.nan), where=known > 0)
    single = np.diff(np.append(starts, len(members))) == 1  # no rounding where there is nothing to average
    strength = edges["origin"].map(_STRENGTH).to_numpy()[members]
    return {
        "origin": np.array(list(_STRENGTH))[np.minimum.reduceat(strength, starts)],
        "support": minimum(column("support")),
        "score": np.where(single, column("score")[starts], mean),
        "forward": minimum(np.where(backwards, against, ahead)),
        "backward": minimum(np.where(backwards, ahead, against)),
    }


def _renamed_turns(turns: pd.DataFrame, *, edges: pd.Series, nodes: pd.Series | None = None) -> pd.DataFrame:
    """Give turns the new ids of their edges and nodes, drop those whose edge is gone, add up those that coincide."""
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
