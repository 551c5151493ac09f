"""Shortest routes over directed edges, up to a maximum length.

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

__all__ = ["Labels", "RouteQuery", "new_labels", "search"]


class Labels(NamedTuple):
    """Labels of directed edges from the last searches, shape (D,) each.

    ``stamp`` is the number of the search that wrote the label. ``key`` and ``driven`` (m) are the label itself, for the
    start of the edge. ``before`` is the directed edge before (-1: none), ``wanted`` the number of the search that
    needs the edge. ``number``, shape (1,), is the number of the last search; the caller of a search increases it first.
    """

    stamp: NDArray[np.int64]
    key: NDArray[np.float64]
    driven: NDArray[np.float64]
    before: NDArray[np.int64]
    wanted: NDArray[np.int64]
    number: NDArray[np.int64]


class RouteQuery(NamedTuple):
    """The start of a route search, and its maximum length.

    Attributes
    ----------
    origin, rest
        Directed edge of the point where they begin, and distance (m) from it to the end of this edge.
    beta
        Metres that a cost of one is worth.
    limit
        Largest key.
    n_wanted
        How many directed edges are asked for: those whose ``wanted`` is the number of the search.
    """

    origin: int
    rest: float
    beta: float
    limit: float
    n_wanted: int


@njit(cache=True)
def new_labels(n_states: int) -> Labels:
    """Return empty labels, before any search."""
    return Labels(
        np.full(n_states, -1, np.int64),
        np.empty(n_states),
        np.empty(n_states),
        np.empty(n_states, np.int64),
        np.full(n_states, -1, np.int64),
        np.zeros(1, np.int64),
    )


@njit(cache=True)
def search(states: States, follow: Follow, query: RouteQuery, labels: Labels) -> None:
    """Label the starts of directed edges with the best route from a point on an edge."""
    if query.rest > query.limit:
        return
    heap = [(0.0, 0) for _ in range(0)]
    number, n_wanted = labels.number[0], query.n_wanted
    _relax(follow, query, query.origin, (-1, query.rest, query.rest), labels, heap)
    while len(heap) > 0 and n_wanted > 0:
        key, d = heappop(heap)
        if key > labels.key[d]:
            continue
        if labels.wanted[d] == number:
            n_wanted -= 1
        length = states.length[d >> 1]
        _relax(follow, query, d, (d, key + length, labels.driven[d] + length), labels, heap)


@njit(cache=True, inline="always")
def _relax(
    follow: Follow, query: RouteQuery, d: int, label: tuple[int, float, float], labels: Labels,
    heap: list[tuple[float, int]],
) -> None:  # fmt: skip
    """Label the successors of a directed edge with the label (before, key, driven) of its end, where this is better."""
    before, key, driven = label
    number = labels.number[0]
    for k in range(follow.first[d], follow.first[d + 1]):
        other = follow.state[k]
        value = key + query.beta * follow.cost[k]
        if value <= query.limit and (labels.stamp[other] != number or value < labels.key[other]):
            labels.stamp[other] = number
            labels.key[other] = value
            labels.driven[other] = driven
            labels.before[other] = before
            heappush(heap, (value, other))
