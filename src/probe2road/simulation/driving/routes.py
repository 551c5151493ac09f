"""Where the fleet drives: a demand with a heavy tail, and routes of least perceived time.

A link is a section in one driving direction; routes are sequences of links joined by permitted movements, so that
turn restrictions and one-way streets hold by construction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from probe2road.bounds import NotNegative, Positive
from probe2road.errors import InputError
from probe2road.options import checked
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["DemandModel", "LinkGraph", "draw_route", "link_graph", "route_moves"]

_LINK_SUFFIX = "_link"
_SHARP_TURN = 40.0  # degrees; a node where somebody turns more sharply is a junction at grade, not a merge
_ATTEMPTS = 50  # origins tried before giving up: an origin may reach no destination far enough away


@dataclass(frozen=True)
@checked
class DemandModel:
    """How often drives start and end on each road, and how drivers choose their route.

    A drive begins at a link drawn by weight: Zipf's law over randomly ranked links times the traffic that a class
    carries. Its end is drawn from the links that it can reach, by their weight and by how long the way is (a
    production-constrained gravity model).
    """

    zipf_exponent: Positive[float] = 1.0  # of the weight over the rank; Zipf's law of places is 1
    class_weight: Mapping[str, NotNegative[float]] = field(
        default_factory=lambda: {  # annual average daily traffic over that of a secondary road
            "motorway": 12.0,
            "trunk": 5.0,
            "primary": 2.5,
            "secondary": 1.0,
        }
    )
    other_weight: NotNegative[float] = 0.4  # for all other classes
    inner_share: NotNegative[float] = 0.05  # weight of a link inside the network over one that enters or leaves it
    mean_trip_time: Positive[float] = 900.0  # s, scale of the exponential deterrence
    min_trip_time: NotNegative[float] = 60.0  # s
    cost_spread: NotNegative[float] = 0.25  # of perceived link times: standard deviation of their natural logarithm
    turn_time: NotNegative[float] = 4.0  # s, perceived cost of a turn sharper than 40 degrees


@dataclass(frozen=True)
class LinkGraph:
    """n links and the m movements between them, as flat arrays that can be sent to worker processes."""

    section: NDArray[np.int64]  # (n,) row of the link's section in network.sections
    direction: NDArray[np.int64]  # (n,) +1 drives from u to v, -1 from v to u
    time: NDArray[np.float64]  # (n,) s at the speed limit
    indptr: NDArray[np.int64]  # (n + 1,) movements that leave link i are indptr[i]:indptr[i + 1]
    indices: NDArray[np.int64]  # (m,) link that a movement enters
    turn: NDArray[np.float64]  # (m,) change of heading, degrees, positive to the right
    via: NDArray[np.int64]  # (m,) node id
    yields: NDArray[np.bool_]  # (m,) the movement gives way: a junction at grade with a more important road
    crosses: NDArray[np.bool_]  # (m,) the movement passes a junction at grade
    origin: NDArray[np.float64]  # (n,) probability that a drive begins here
    attraction: NDArray[np.float64]  # (n,) relative weight as destination

    @property
    def n(self) -> int:
        """Return the number of links."""
        return len(self.section)


def link_graph(network: RoadNetwork, demand: DemandModel, *, rng: np.random.Generator) -> LinkGraph:
    """Prepare a network for routing and draw its demand.

    Parameters
    ----------
    network
        At least one section.
    demand
        The demand model.
    rng
        Draws the ranks of the links.

    Raises
    ------
    InputError
        If the network has no section.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> roads = [[(0, 0), (500, 0)], [(500, 0), (1000, 0)]]
    >>> network = network_from_sections(roads, crs="EPSG:32616", highway="secondary", lanes_backward=1)
    >>> graph = link_graph(network, DemandModel(), rng=np.random.default_rng(1))
    >>> graph.n, graph.direction.tolist(), graph.indices.tolist()
    (4, [1, 1, -1, -1], [1, 2])
    """
    sections = network.sections
    if not len(sections):
        raise InputError("the network has no section", where="network", fix="check the extract and its road classes")
    backward = np.flatnonzero((sections["lanes_backward"] > 0).to_numpy())
    section = np.concatenate([np.arange(len(sections)), backward])
    direction = np.concatenate([np.ones(len(sections), np.int64), -np.ones(len(backward), np.int64)])
    moves = _numbered_movements(network, section, direction)
    n = len(section)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(moves["from_link"], minlength=n))]).astype(np.int64)
    highway = sections["highway"].to_numpy()[section]
    crosses, yields = _right_of_way(moves, highway)
    origin, attraction = _weights(moves, highway, sections.length.to_numpy()[section], demand, rng)
    return LinkGraph(
        section,
        direction,
        (sections.length / sections["speed_limit"]).to_numpy()[section],
        indptr,
        moves["to_link"].to_numpy(),
        moves["turn"].to_numpy(),
        moves["via_node"].to_numpy(),
        yields,
        crosses,
        origin,
        attraction,
    )


def draw_route(graph: LinkGraph, demand: DemandModel, *, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw the origin, the destination and the route of one drive.

    Every driver perceives the time of every link with an error of his own, so that two drives between the same
    places may differ, and takes the way that seems shortest.

    Returns
    -------
    ndarray of int64
        Links in driving order; a single link where the network offers nothing longer.
    """
    times = graph.time * np.exp(demand.cost_spread * rng.standard_normal(graph.n))
    cost = times[graph.indices] + demand.turn_time * (np.abs(graph.turn) > _SHARP_TURN)
    matrix = csr_array((cost, graph.indices, graph.indptr), shape=(graph.n, graph.n))
    cumulative = np.cumsum(graph.origin)
    origin = 0
    for _ in range(_ATTEMPTS):
        origin = int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"))
        reach, before = dijkstra(matrix, indices=origin, return_predecessors=True)
        far = np.isfinite(reach) & (reach >= demand.min_trip_time)
        weight = np.where(far, graph.attraction * np.exp(-np.where(far, reach, 0.0) / demand.mean_trip_time), 0.0)
        total = np.cumsum(weight)
        if total[-1] > 0:
            end = int(np.searchsorted(total, rng.random() * total[-1], side="right"))
            return _path(before, origin, end)
    reach, before = dijkstra(matrix, indices=origin, return_predecessors=True)
    return _path(before, origin, int(np.argmax(np.where(np.isfinite(reach), reach, -1.0))))


def route_moves(graph: LinkGraph, route: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers of the movements between the consecutive links of a route, shape ``(m - 1,)``."""
    first, last = graph.indptr[route[:-1]], graph.indptr[route[:-1] + 1]
    # The movements of a link are sorted by the link that they enter.
    ways = zip(first, last, route[1:], strict=True)
    return np.array([a + np.searchsorted(graph.indices[a:b], link) for a, b, link in ways], np.int64)


def _path(before: NDArray[np.int32], origin: int, end: int) -> NDArray[np.int64]:
    """Follow the predecessors back from the destination."""
    links = [end]
    while links[-1] != origin:
        links.append(int(before[links[-1]]))
    return np.array(links[::-1], np.int64)


def _numbered_movements(network: RoadNetwork, section: NDArray[np.int64], direction: NDArray[np.int64]) -> pd.DataFrame:
    """Return the network's movements with link numbers, sorted; U-turns only where no other movement is possible."""
    ids = network.sections.index.to_numpy()[section]
    number = pd.Series(np.arange(len(section)), index=pd.MultiIndex.from_arrays([ids, direction]))
    moves = network.movements()
    moves = moves.assign(
        from_link=number.reindex(pd.MultiIndex.from_frame(moves[["from_section", "from_direction"]])).to_numpy(),
        to_link=number.reindex(pd.MultiIndex.from_frame(moves[["to_section", "to_direction"]])).to_numpy(),
    )
    kept = moves[["from_link", "to_link", "via_node", "turn"]].astype(
        {"from_link": "int64", "to_link": "int64", "via_node": "int64"}
    )
    # A ring of two sections has two ways from one to the other; one movement a pair of links is enough to drive.
    kept = kept.sort_values(["from_link", "to_link", "via_node"]).drop_duplicates(["from_link", "to_link"])
    return kept.reset_index(drop=True)


def _right_of_way(moves: pd.DataFrame, highway: NDArray[np.object_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Mark the movements through a junction at grade, and those among them that yield to a larger road."""
    rank = _importance(highway)
    sharp = moves["turn"].abs() > _SHARP_TURN
    at_grade = sharp.groupby(moves["via_node"]).transform("any").to_numpy()
    own = rank[moves["from_link"]]
    largest = np.maximum(own, rank[moves["to_link"]])
    largest = pd.Series(largest).groupby(moves["via_node"]).transform("max").to_numpy()
    motorway = np.array([str(name).startswith("motorway") for name in highway], bool)
    crosses = at_grade & ~motorway[moves["from_link"]]
    return crosses, crosses & (own < largest)


def _importance(highway: NDArray[np.object_]) -> NDArray[np.int64]:
    """Return the rank of each class, larger for more important ones; a link road is half a rank below its class."""
    order = ("residential", "unclassified", "tertiary", "secondary", "primary", "trunk", "motorway")
    rank = {name: 2 * position for position, name in enumerate(order)}
    return np.array(
        [rank.get(str(name).removesuffix(_LINK_SUFFIX), 0) - str(name).endswith(_LINK_SUFFIX) for name in highway],
        np.int64,
    )


def _weights(
    moves: pd.DataFrame,
    highway: NDArray[np.object_],
    length: NDArray[np.float64],
    demand: DemandModel,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the origin probability and the destination weight of every link."""
    n = len(highway)
    by_class = np.array([demand.class_weight.get(str(name), demand.other_weight) for name in highway])
    inner_class = np.array(["motorway" not in str(name) and _LINK_SUFFIX not in str(name) for name in highway])
    enters = np.bincount(moves["to_link"], minlength=n) == 0
    leaves = np.bincount(moves["from_link"], minlength=n) == 0
    inner = demand.inner_share * inner_class * np.minimum(length / 200.0, 1.0)
    weights = []
    for terminal in (enters, leaves):
        zipf = (1.0 + rng.permutation(n)) ** -demand.zipf_exponent
        weight = zipf * by_class * np.where(terminal, 1.0, inner)
        weights.append(weight if weight.sum() > 0 else zipf * length)
    origin, attraction = weights
    return origin / origin.sum(), attraction
