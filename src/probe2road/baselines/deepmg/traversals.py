"""How often traces drive each direction of every edge, by the map matcher of DeepMG (METHOD 3.7).

Strategy
--------
A hidden Markov model over the nearest points of edges within 50 m, once for each direction. A fix is normally
distributed about its point; from one fix to the next, the difference between the route and the straight line is
exponentially distributed with a mean of 2 m. Links are longer for the route than on the ground, and so is the
difference: a link costs a factor that grows with its length. Going backwards on an edge is impossible. Where no point
is near or no route leads on, the chain breaks and begins anew. Scores are logarithms, because the published products
of densities run out of digits.

The candidates and the search for routes are those of `probe2road.matching`, without its costs of turns. Routes are
looked for as far as they can matter: the search ends at four times the straight line plus 200 m, where the difference
has cost a factor of e^-100.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.baselines.deepmg.features import Steps
from probe2road.bounds import Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.candidates import Scratch, nearest_points, new_scratch
from probe2road.matching.network import Follow, States, build_follow, build_states
from probe2road.matching.routes import Labels, RouteQuery, new_labels, search
from probe2road.options import checked

__all__ = ["MatcherOptions", "count_traversals"]

_REACH, _REACH_FACTOR = 200.0, 4.0  # m, and times the straight line: bound of the search for a route


@dataclass(frozen=True)
@checked
class MatcherOptions:
    """The parameters of the matcher, as published."""

    radius: Positive[float] = 50.0  # m, within which edges are candidates
    sigma: Positive[float] = 50.0  # m, standard deviation of fixes
    beta: Positive[float] = 2.0  # m, mean difference of route and straight line
    link_factor: Positive[float] = 1.4  # by which links are longer for a route


class _Model(NamedTuple):
    """The input of the compiled functions: the network with its routing lengths, factors of edges, and parameters."""

    states: States  # with lengths on the ground
    routed: States  # with lengths as routes count them
    follow: Follow
    factor: NDArray[np.float64]  # (edges,) of a length for routes to that on the ground
    radius: float
    sigma: float
    beta: float
    min_path: int


class _Chain(NamedTuple):
    """The candidates of the fixes of one run (fix k: ``first[k]`` to ``first[k + 1]``), and their scores."""

    first: NDArray[np.int64]
    state: NDArray[np.int64]
    progress: NDArray[np.float64]  # m from the start of the directed edge, on the ground
    score: NDArray[np.float64]  # logarithm
    back: NDArray[np.int64]  # the candidate before, -1 where the chain begins


def count_traversals(
    steps: Steps, graph: RoadGraph, options: MatcherOptions | None = None, *, min_path: int = 1
) -> NDArray[np.int64]:
    """Count how often each edge was driven in each direction.

    Parameters
    ----------
    steps
        Thinned traces.
    graph
        Road graph in the same CRS; all edges may be driven both ways.
    options
        None takes the defaults.
    min_path
        Pieces of a trace that drive fewer edges than this are left out, as are single fixes.

    Returns
    -------
    ndarray of int64, shape (edges, 2)
        From u to v, and from v to u.

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.baselines.deepmg.features import thin_traces
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(200, 0), (100, 0)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(5), "x": [20.0, 60, 90, 130, 170], "y": [1.0, 0, 2, 0, 1]})
    >>> steps = thin_traces(fleet_from_tables(table, crs="EPSG:32616", keep_crs=True))
    >>> count_traversals(steps, graph).tolist()
    [[1, 0], [0, 1]]
    """
    options = options or MatcherOptions()
    if not len(graph.edges):
        return np.zeros((0, 2), np.int64)
    states = build_states(graph, respect_oneway=False)
    factor = np.where(graph.edges["origin"].to_numpy() == "gap", options.link_factor, 1.0)
    model = _Model(
        states=states,
        routed=states._replace(length=states.length * factor),
        follow=build_follow(states, np.ones(len(factor)), uturn_cost=0.0, turn_cost=0.0),
        factor=factor,
        radius=float(options.radius),
        sigma=float(options.sigma),
        beta=float(options.beta),
        min_path=min_path,
    )
    return np.asarray(_count(model, steps.x, steps.y, steps.starts)).reshape(-1, 2)


@njit(cache=True)
def _count(
    model: _Model, x: NDArray[np.float64], y: NDArray[np.float64], starts: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Match each run, and count the directed edges of all matched pieces."""
    count = np.zeros(len(model.states.head), np.int64)
    scratch, labels = new_scratch(len(model.states.x)), new_labels(len(model.states.head))
    for run in range(len(starts) - 1):
        own = slice(starts[run], starts[run + 1])
        chain = _candidates(model, x[own], y[own], starts[run], scratch)
        _forward(model, x[own], y[own], chain, labels)
        chosen = _backward(chain)
        piece = [0 for _ in range(0)]
        for k in range(len(chosen)):
            if chosen[k] < 0 or chain.back[chosen[k]] < 0:
                _add_piece(piece, model.min_path, count)
                piece = [0 for _ in range(0)]
                continue
            i = starts[run] + k
            straight = np.hypot(x[i] - x[i - 1], y[i] - y[i - 1])
            source = chain.back[chosen[k]]
            if len(piece) == 0:
                piece.append(chain.state[source])
            _append_route(model, chain, source, chosen[k], straight, labels, piece)
        _add_piece(piece, model.min_path, count)
    return count


@njit(cache=True)
def _add_piece(piece: list[int], min_path: int, count: NDArray[np.int64]) -> None:
    """Count the directed edges of a matched piece, if it is long enough."""
    if len(piece) >= max(min_path, 1):
        for state in piece:
            count[state] += 1


@njit(cache=True)
def _candidates(model: _Model, x: NDArray[np.float64], y: NDArray[np.float64], query: int, scratch: Scratch) -> _Chain:
    """List the candidates of fixes with the logarithms of their densities as scores; ``query`` numbers the search."""
    states = model.states
    first = np.zeros(len(x) + 1, np.int64)
    state, progress, score = [0 for _ in range(0)], [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for k in range(len(x)):
        for c in range(nearest_points(states, x[k], y[k], model.radius, query + k, scratch)):
            edge = states.edge[scratch.point[c]]
            for reverse in range(2):
                state.append(2 * edge + reverse)
                progress.append(states.length[edge] - scratch.along[c] if reverse else scratch.along[c])
                score.append(-0.5 * (scratch.distance[c] / model.sigma) ** 2)
        first[k + 1] = len(state)
    back = np.full(len(state), -1, np.int64)
    return _Chain(first, np.array(state, np.int64), np.array(progress), np.array(score), back)


@njit(cache=True)
def _forward(model: _Model, x: NDArray[np.float64], y: NDArray[np.float64], chain: _Chain, labels: Labels) -> None:
    """Replace the scores of candidates by those of the best chains that end there.

    Candidates that no route reaches are left out from then on (score -inf), unless none is reached at all.
    """
    for k in range(1, len(x)):
        straight = np.hypot(x[k] - x[k - 1], y[k] - y[k - 1])
        low, high = chain.first[k], chain.first[k + 1]
        best = np.full(high - low, -np.inf)
        for source in range(chain.first[k - 1], low):
            if high == low or chain.score[source] == -np.inf:
                continue
            _search(model, chain, source, low, high, straight, labels)
            for target in range(low, high):
                route = _route(model, chain, source, target, labels)[0]
                value = chain.score[source] - abs(route - straight) / model.beta
                if value > best[target - low]:
                    best[target - low], chain.back[target] = value, source
        if (best > -np.inf).any():
            chain.score[low:high] += best


@njit(cache=True)
def _backward(chain: _Chain) -> NDArray[np.int64]:
    """Follow the best chains back from their ends; return the candidate of each fix, -1 for none."""
    chosen = np.full(len(chain.first) - 1, -1, np.int64)
    here = -1
    for k in range(len(chosen) - 1, -1, -1):
        low, high = chain.first[k], chain.first[k + 1]
        if here < 0 and high > low:
            here = low + np.argmax(chain.score[low:high])
        chosen[k] = here
        here = chain.back[here] if here >= 0 else -1
    return chosen


@njit(cache=True)
def _search(model: _Model, chain: _Chain, source: int, low: int, high: int, straight: float, labels: Labels) -> None:
    """Label the starts of the directed edges of candidates ``low`` to ``high`` by routes from a source."""
    labels.number[0] += 1
    number, n_wanted = labels.number[0], 0
    for target in range(low, high):
        n_wanted += labels.wanted[chain.state[target]] != number
        labels.wanted[chain.state[target]] = number
    origin = chain.state[source]
    rest = (model.states.length[origin >> 1] - chain.progress[source]) * model.factor[origin >> 1]
    limit = _REACH_FACTOR * straight + _REACH
    search(model.routed, model.follow, RouteQuery(origin, rest, 1.0, limit, n_wanted), labels)


@njit(cache=True)
def _route(model: _Model, chain: _Chain, source: int, target: int, labels: Labels) -> tuple[float, bool]:
    """Return the routing length between two candidates, infinity for no route, and whether it stays on one edge."""
    d = chain.state[target]
    if chain.state[source] == d:
        step = chain.progress[target] - chain.progress[source]
        return (step * model.factor[d >> 1] if step > 0 else np.inf), True
    if labels.stamp[d] != labels.number[0]:
        return np.inf, False
    return labels.key[d] + chain.progress[target] * model.factor[d >> 1], False


@njit(cache=True)
def _append_route(
    model: _Model, chain: _Chain, source: int, target: int, straight: float, labels: Labels, piece: list[int]
) -> None:
    """Append the directed edges of a route, without the first one, to a piece."""
    d = chain.state[target]
    if chain.state[source] == d:
        return
    _search(model, chain, source, target, target + 1, straight, labels)
    route = [d]
    while labels.before[route[-1]] >= 0:
        route.append(labels.before[route[-1]])
    piece.extend(route[::-1])
