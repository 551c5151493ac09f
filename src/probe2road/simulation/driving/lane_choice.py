"""Which lane a vehicle takes on each link of its route.

Strategy
--------
The lanes of a route form a trellis. Moving from a lane at the end of one link to a lane at the start of the next costs
by how far apart the two are; changing lanes within a link costs by the number of lanes, more where the link is short;
and each stretch of road has a preferred lane, drawn at random, that pulls a little. The cheapest path through the
trellis (Viterbi) therefore reaches the lane that its ramp leaves from before the ramp, overtakes now and then, and
otherwise stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.simulation.driving.routes import LinkGraph
from probe2road.simulation.lanes.lanes import lane_offsets
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["LinkLanes", "choose_lanes", "link_lanes"]

_PARAMETERS = ("offset", "start_offset", "end_offset", "start_taper", "end_taper")
_CORNER = 35.0  # degrees; a sharper turn is driven from lane to lane by rank, not by where the lanes lie
_MISMATCH = 1.2  # m of lateral distance between two lanes that costs as much as one lane change
_SHORT = 60.0  # m of link on which a lane change costs twice as much as on a very long one
_PREFERENCE = 0.35  # cost of each lane away from the preferred one, over 1 km


@dataclass(frozen=True)
class LinkLanes:
    """The lanes of every link in the view of a driver: left to right, with offsets positive to the right of travel.

    ``shape[j]`` holds offset, start_offset, end_offset, start_taper, end_taper (m) of lane j; link i owns the lanes
    ``indptr[i]:indptr[i + 1]``.
    """

    indptr: NDArray[np.int64]  # (n + 1,)
    shape: NDArray[np.float64]  # (k, 5)
    lane: NDArray[np.int64]  # (k,) number of the lane in lane_offsets: 0 is the leftmost seen from u to v


def link_lanes(network: RoadNetwork, graph: LinkGraph) -> LinkLanes:
    """Sort the lanes of a network by link.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> from probe2road.simulation.driving.routes import DemandModel, link_graph
    >>> road = {"crs": "EPSG:32616", "highway": "secondary", "lanes_backward": 1, "lane_width": 3.0}
    >>> network = network_from_sections([[(0, 0), (500, 0)]], **road)
    >>> lanes = link_lanes(network, link_graph(network, DemandModel(), rng=np.random.default_rng(0)))
    >>> lanes.shape[:, 0].tolist(), lanes.lane.tolist()
    ([1.5, 1.5], [1, 0])
    """
    table = lane_offsets(network)
    row = network.sections.index.get_indexer(table["section"])
    table = table.assign(row=row)
    link_of = np.full((len(network.sections), 2), -1, np.int64)
    link_of[graph.section, (graph.direction < 0).astype(np.int64)] = np.arange(graph.n)
    backward = (table["direction"] < 0).to_numpy()
    link = link_of[row, backward.astype(np.int64)]
    values = table[list(_PARAMETERS)].to_numpy(copy=True)
    values[backward, :3] *= -1.0
    values[backward] = values[backward][:, [0, 2, 1, 4, 3]]
    order = np.lexsort((values[:, 0], link))
    order = order[link[order] >= 0]
    indptr = np.concatenate([[0], np.cumsum(np.bincount(link[order], minlength=graph.n))]).astype(np.int64)
    return LinkLanes(indptr, values[order], table["lane"].to_numpy(np.int64)[order])


def choose_lanes(
    route: NDArray[np.int64],
    turns: NDArray[np.float64],
    lengths: NDArray[np.float64],
    lanes: LinkLanes,
    preferred: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Choose the lanes in which a vehicle enters and leaves each link of a route.

    Parameters
    ----------
    route
        Links, shape ``(m,)``.
    turns
        Change of heading between consecutive links, degrees, positive to the right, shape ``(m - 1,)``.
    lengths
        Lengths of the links (m), shape ``(m,)``.
    lanes
        Lanes of all links.
    preferred
        Preferred lane on each link as a share of its width, 0 the leftmost and 1 the rightmost, shape ``(m,)``.

    Returns
    -------
    entered, left : ndarray of int64, shape (m,)
        Lane numbers within the link, 0 the leftmost.
    """
    if len(route) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return _viterbi(route, turns, lengths, lanes.indptr, lanes.shape, preferred)


@njit(cache=True)
def _viterbi(
    route: NDArray[np.int64],
    turns: NDArray[np.float64],
    lengths: NDArray[np.float64],
    indptr: NDArray[np.int64],
    shape: NDArray[np.float64],
    preferred: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    m = len(route)
    widest = 1
    for link in route:
        widest = max(widest, indptr[link + 1] - indptr[link])
    cost = np.full((m, widest), np.inf)  # of the best way to leave link i in lane a
    entry = np.zeros((m, widest), np.int64)  # lane in which that way enters link i
    came = np.zeros((m, widest), np.int64)  # lane in which it leaves link i - 1
    for i in range(m):
        first = indptr[route[i]]
        count = indptr[route[i] + 1] - first
        change = 1.0 + _SHORT / max(lengths[i], 1.0)
        pull = _PREFERENCE * lengths[i] / 1000.0
        for b in range(count):
            start, source = 0.0, 0
            if i > 0:
                start = np.inf
                before = indptr[route[i - 1]]
                others = indptr[route[i - 1] + 1] - before
                for a in range(others):
                    step = cost[i - 1, a] + _step(shape, before, a, others, first, b, count, turns[i - 1])
                    if step < start:
                        start, source = step, a
            for a in range(count):
                total = start + change * abs(a - b) + pull * abs(a - preferred[i] * (count - 1))
                if total < cost[i, a]:
                    cost[i, a], entry[i, a], came[i, a] = total, b, source
    entered, left = np.zeros(m, np.int64), np.zeros(m, np.int64)
    lane = np.argmin(cost[m - 1])
    for i in range(m - 1, -1, -1):
        left[i], entered[i] = lane, entry[i, lane]
        lane = came[i, lane]
    return entered, left


@njit(cache=True)
def _step(
    shape: NDArray[np.float64], before: int, a: int, others: int, first: int, b: int, count: int, turn: float
) -> float:
    """Return the cost of going from lane a at the end of one link to lane b at the start of the next."""
    if abs(turn) < _CORNER:
        apart = abs(shape[before + a, 2] - shape[first + b, 1]) / _MISMATCH
        return apart * apart
    # Lanes counted from the side that one turns to: a right turn goes from right lane to right lane.
    rank_a = others - 1 - a if turn > 0 else a
    rank_b = count - 1 - b if turn > 0 else b
    return 1.0 * abs(rank_a - rank_b) + 0.7 * rank_a
