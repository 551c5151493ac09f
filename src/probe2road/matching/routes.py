"""Shortest routes over directed edges, as far as they can matter.

Strategy
--------
Dijkstra's algorithm over directed edges, because turning back and other turns have a cost. The key of a directed
edge is the length (m) driven until its start plus ``beta`` times the cost of the turns. Labels carry the
number of the search that wrote them, so nothing is cleared between searches. A search ends at its limit, or when
every directed edge that was asked for is final.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.matching.network import Follow, States

__all__ = ["Labels", "new_labels", "search"]


class Labels(NamedTuple):
    """Labels of directed edges, shape (D,) each.

    ``stamp`` is the search that wrote a label, ``key`` and ``driven`` (m) are what it found at the start of the
    edge, ``before`` the directed edge it came from (-1: the first), ``wanted`` the search that asks for the edge.
    """

    stamp: NDArray[np.int64]
    key: NDArray[np.float64]
    driven: NDArray[np.float64]
    before: NDArray[np.int64]
    wanted: NDArray[np.int64]


@njit(cache=True)
def new_labels(n_states: int) -> Labels:
    """Return labels that no search has written."""
    return Labels(
        np.full(n_states, -1, np.int64),
        np.empty(n_states),
        np.empty(n_states),
        np.empty(n_states, np.int64),
        np.full(n_states, -1, np.int64),
    )


@njit(cache=True)
def search(
    states: States, follow: Follow, origin: int, rest: float, beta: float, limit: float,
    labels: Labels, number: int, n_wanted: int,
) -> None:  # fmt: skip
    """Label the starts of directed edges by the best route from a point on another.

    Parameters
    ----------
    states, follow
        The network.
    origin, rest
        Directed edge of the point, and distance (m) from it to the end of this edge.
    beta
        Metres that a cost of one is worth.
    limit
        Largest key.
    labels, number
        Labels, and the number of this search; edges whose ``wanted`` is this number are asked for.
    n_wanted
        How many they are.
    """
    if rest > limit:
        return
    heap = [(0.0, 0) for _ in range(0)]
    _relax(follow, origin, -1, rest, rest, beta, limit, labels, number, heap)
    while len(heap) > 0 and n_wanted > 0:
        key, d = heappop(heap)
        if key > labels.key[d]:
            continue
        if labels.wanted[d] == number:
            n_wanted -= 1
        length = states.length[d >> 1]
        _relax(follow, d, d, key + length, labels.driven[d] + length, beta, limit, labels, number, heap)


@njit(cache=True, inline="always")
def _relax(
    follow: Follow, d: int, before: int, key: float, driven: float, beta: float, limit: float,
    labels: Labels, number: int, heap: list[tuple[float, int]],
) -> None:  # fmt: skip
    """Label the successors of a directed edge that ends at this key and length, where that is an improvement."""
    for k in range(follow.first[d], follow.first[d + 1]):
        other = follow.state[k]
        value = key + beta * follow.cost[k]
        if value <= limit and (labels.stamp[other] != number or value < labels.key[other]):
            labels.stamp[other] = number
            labels.key[other] = value
            labels.driven[other] = driven
            labels.before[other] = before
            heappush(heap, (value, other))
