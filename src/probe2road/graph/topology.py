"""Road networks as flat arrays, and chains of edges in them.

Strategy
--------
Nodes are rows; an edge has its node rows ``u`` and ``v``, and its vertices lie in one coordinate array from
``offsets[e]`` up to ``offsets[e + 1]``. An edge has two ends: end ``2 e`` is where edge ``e`` starts, end
``2 e + 1`` where it stops, so ``end // 2`` is the edge and ``end ^ 1`` the other end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array

__all__ = ["Topology", "chains", "end_nodes", "joined_lines", "mates", "shortest_arcs"]


@dataclass(frozen=True)
class Topology:
    """A network of N nodes and E edges with P vertices in D dimensions.

    Attributes
    ----------
    position
        Shape (N, 2), metres.
    u, v
        Shape (E,), node rows.
    vertices
        Shape (P, D), metres; plan coordinates first.
    offsets
        Shape (E + 1,).
    edge
        Shape (E,), the edge rows of the network that this one was made from.
    weight
        Shape (N,), how many junctions have gone into a node.
    """

    position: NDArray[np.float64]
    u: NDArray[np.int64]
    v: NDArray[np.int64]
    vertices: NDArray[np.float64]
    offsets: NDArray[np.int64]
    edge: NDArray[np.int64]
    weight: NDArray[np.int64]


def end_nodes(u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the node of every end, shape (2 E,)."""
    return np.stack([u, v], axis=1).reshape(-1)


def mates(u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each end, the other end at its node if the node joins exactly two edges, else -1."""
    node = end_nodes(u, v)
    order = np.argsort(node, kind="stable")
    heads = np.flatnonzero(np.diff(node[order], prepend=-1))
    pairs = heads[np.diff(np.append(heads, len(order))) == 2]
    one, other = order[pairs], order[pairs + 1]
    distinct = one // 2 != other // 2  # the two ends of a loop are not joined
    mate = np.full(len(node), -1)
    mate[one[distinct]], mate[other[distinct]] = other[distinct], one[distinct]
    return mate


@njit(cache=True)
def chains(mate: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64]]:
    """Follow every chain of mated ends, in the direction of its first edge.

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


def joined_lines(
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


def shortest_arcs(a: NDArray[np.int64], b: NDArray[np.int64], size: NDArray[np.float64], n_nodes: int) -> csr_array:
    """Return the undirected graph of arcs for scipy's routing, with only the shortest of parallel arcs.

    A sparse matrix would add the sizes of parallel arcs up, and take an arc of length 0 for none.

    Examples
    --------
    >>> shortest_arcs(np.array([0, 1]), np.array([1, 0]), np.array([7.0, 5.0]), 2).toarray().tolist()
    [[0.0, 5.0], [0.0, 0.0]]
    """
    low, high, size = np.minimum(a, b), np.maximum(a, b), np.maximum(size, 1e-12)
    order = np.lexsort((size, high, low))
    low, high, size = low[order], high[order], size[order]
    shortest = np.ones(len(low), bool)
    shortest[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    return csr_array((size[shortest], (low[shortest], high[shortest])), shape=(n_nodes, n_nodes))
