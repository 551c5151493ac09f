"""The most likely route of every trace over candidate points (Newson and Krumm, METHOD 5.1).

Strategy
--------
Only key fixes, which are some metres apart, shape the route. Their candidates are the nearest points of edges,
once for each direction, and "no road". Costs are negative log probabilities. From one key fix to the next:

* a route costs ``|length - straight line| / beta`` and its turns;
* a jump to any candidate costs ``break_cost``, leaving and entering the network half of it each.

A jump is always possible, so the chain never breaks down, and it bounds the search: a route is only of use
where it beats the best jump, now or at the next key fix. The search from a candidate therefore ends where its own
cost plus that of the route is too high. This prunes without approximation.

Ties go to the candidate that comes first: lower edge row, then driven from u to v. Memory for a trace is a few
numbers for each candidate of its key fixes. All traces share nothing but the network.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.matching.candidates import Scratch, altitude_at, nearest_points
from probe2road.matching.models import RouteModel
from probe2road.matching.network import Follow, States
from probe2road.matching.routes import Labels, search

__all__ = [
    "JUMP",
    "NULL",
    "Candidates",
    "Decision",
    "Observations",
    "Parameters",
    "decide",
    "find_candidates",
    "parameters",
    "shortest",
]

NULL = -1  # came from, or is, no road
JUMP = -2  # came from the best candidate before, without a route

_BACKTRACK = 25.0  # m that noise may move a fix back along its edge


class Parameters(NamedTuple):
    """The numbers of a `RouteModel` that the kernels need; see there."""

    tail: float
    radius: float
    null_cost: float
    beta: float
    beta_rate: float
    break_cost: float
    altitude_sigma: float
    altitude_cap: float
    max_step: float


class Observations(NamedTuple):
    """What is known at every fix, shape (fixes,) each.

    ``t`` in s; ``sigma`` in m; ``course_x``, ``course_y`` the unit direction of driving and ``kappa`` its weight, 0
    where unknown; ``z`` in m on the datum of the graph, NaN where unknown; ``key`` marks the key fixes.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    t: NDArray[np.float64]
    sigma: NDArray[np.float64]
    course_x: NDArray[np.float64]
    course_y: NDArray[np.float64]
    kappa: NDArray[np.float64]
    z: NDArray[np.float64]
    key: NDArray[np.bool_]


class Candidates(NamedTuple):
    """Candidates of the key fixes of one trace; those of key k are ``first[k]`` to ``first[k + 1]``.

    ``along`` is the offset from u (m), ``progress`` that from the start of the directed edge, ``cost`` the emission.
    """

    first: NDArray[np.int64]
    state: NDArray[np.int64]
    along: NDArray[np.float64]
    progress: NDArray[np.float64]
    distance: NDArray[np.float64]
    cost: NDArray[np.float64]


class Decision(NamedTuple):
    """For every key fix of one trace: its candidate or `NULL`, and whether a route leads to it from the key before."""

    chosen: NDArray[np.int64]
    linked: NDArray[np.bool_]


def parameters(model: RouteModel) -> Parameters:
    """Reduce a model to the numbers of the kernels; the cost of no road is that of a fix at ``null_distance``."""
    null_cost = 0.5 * (model.tail + 1.0) * np.log1p((model.null_distance / model.sigma) ** 2 / model.tail)
    return Parameters(
        tail=float(model.tail),
        radius=float(model.radius),
        null_cost=float(null_cost),
        beta=float(model.beta),
        beta_rate=float(model.beta_rate),
        break_cost=float(model.break_cost),
        altitude_sigma=float(model.altitude_sigma),
        altitude_cap=float(model.altitude_cap),
        max_step=float(model.max_step),
    )


@njit(cache=True)
def find_candidates(
    states: States, observed: Observations, keys: NDArray[np.int64], parameters: Parameters, scratch: Scratch
) -> Candidates:
    """Find the candidates of key fixes, given as rows of the observations, and the costs of their emissions."""
    n_keys = len(keys)
    first = np.zeros(n_keys + 1, np.int64)
    size = 16 * n_keys + 16
    state, numbers = np.empty(size, np.int64), np.empty((4, size))
    count = 0
    for k in range(n_keys):
        i = keys[k]
        n_points = nearest_points(states, observed.x[i], observed.y[i], parameters.radius, i, scratch)
        if count + 2 * n_points > len(state):
            size = 2 * (count + 2 * n_points)
            wider, wider_numbers = np.empty(size, np.int64), np.empty((4, size))
            wider[:count], wider_numbers[:, :count] = state[:count], numbers[:, :count]
            state, numbers = wider, wider_numbers
        for c in range(n_points):
            p, along, distance = scratch.point[c], scratch.along[c], scratch.distance[c]
            for reverse in range(2):
                d = 2 * states.edge[p] + reverse
                if not states.allowed[d]:
                    continue
                state[count] = d
                numbers[0, count] = along
                numbers[1, count] = states.length[d >> 1] - along if reverse else along
                numbers[2, count] = distance
                numbers[3, count] = _emission(states, observed, i, p, along, distance, reverse, parameters)
                count += 1
        first[k + 1] = count
    return Candidates(first, state, numbers[0], numbers[1], numbers[2], numbers[3])


@njit(cache=True)
def _emission(
    states: States, observed: Observations, i: int, p: int, along: float, distance: float, reverse: int,
    parameters: Parameters,
) -> float:  # fmt: skip
    """Return the cost of seeing a fix from a point: of its distance, its course and its altitude."""
    ratio = distance / observed.sigma[i]
    cost = 0.5 * (parameters.tail + 1.0) * np.log1p(ratio * ratio / parameters.tail)
    if observed.kappa[i] > 0 and states.size[p] > 0:
        cosine = (observed.course_x[i] * states.dx[p] + observed.course_y[i] * states.dy[p]) / states.size[p]
        cost += observed.kappa[i] * (1.0 + cosine if reverse else 1.0 - cosine)
    height = observed.z[i] - altitude_at(states, p, along)
    if height == height:  # not NaN
        ratio = height / parameters.altitude_sigma
        cost += min(0.5 * ratio * ratio, parameters.altitude_cap)
    return cost


@njit(cache=True)
def decide(
    states: States, follow: Follow, observed: Observations, keys: NDArray[np.int64], candidates: Candidates,
    parameters: Parameters, labels: Labels, number: int,
) -> tuple[Decision, int]:  # fmt: skip
    """Find the most likely chain of candidates; ``number`` is that of the last search, and so is the result's."""
    n_keys = len(keys)
    back = np.full(len(candidates.state), NULL, np.int64)
    null_back = np.full(n_keys, NULL, np.int64)  # best candidate before, or NULL
    best = np.full(n_keys, NULL, np.int64)
    score = np.empty(len(candidates.state))
    null_score = 0.0
    for k in range(n_keys):
        low, high = candidates.first[k], candidates.first[k + 1]
        before = best[k - 1] if k > 0 else NULL
        jump = score[before] + parameters.break_cost if before >= 0 else np.inf
        enter = null_score + (parameters.break_cost / 2.0 if k > 0 else 0.0)
        floor = min(jump, enter)
        for c in range(low, high):
            score[c] = floor
            back[c] = JUMP if jump < enter else NULL
        if k > 0:
            number = _advance(
                states, follow, observed, keys, k, candidates, parameters, labels, number, floor, score, back
            )
        leave = score[before] + parameters.break_cost / 2.0 if before >= 0 else np.inf
        null_back[k] = before if leave <= null_score else NULL
        null_score = min(null_score, leave) + parameters.null_cost
        for c in range(low, high):
            score[c] += candidates.cost[c]
            if best[k] < 0 or score[c] < score[best[k]]:
                best[k] = c
    chosen, linked = np.full(n_keys, NULL, np.int64), np.zeros(n_keys, np.bool_)
    here = best[n_keys - 1]
    if here >= 0 and score[here] > null_score:
        here = NULL
    for k in range(n_keys - 1, -1, -1):
        chosen[k] = here
        if here < 0:
            here = null_back[k]
        else:
            linked[k] = back[here] >= 0
            here = best[k - 1] if back[here] == JUMP else back[here]
    return Decision(chosen, linked), number


@njit(cache=True)
def _advance(
    states: States, follow: Follow, observed: Observations, keys: NDArray[np.int64], k: int,
    candidates: Candidates, parameters: Parameters, labels: Labels, number: int,
    floor: float, score: NDArray[np.float64], back: NDArray[np.int64],
) -> int:  # fmt: skip
    """Improve the scores of the candidates of key k over routes from those of the key before.

    Sources are taken from the best on. A target is of no use any more where its score, its emission included,
    exceeds that of the best target by a jump: from the next key on, the jump is at least as good. ``cap`` is the
    score that a target must stay below, so the searches of the later sources are short.
    """
    i, j = keys[k - 1], keys[k]
    straight = np.hypot(observed.x[j] - observed.x[i], observed.y[j] - observed.y[i])
    if straight > parameters.max_step:
        return number
    beta = parameters.beta + parameters.beta_rate * (observed.t[j] - observed.t[i])
    low, start = candidates.first[k], candidates.first[k - 1]
    targets = np.arange(low, candidates.first[k + 1])
    n_targets = len(targets)
    lowest = (floor + candidates.cost[targets]).min() if n_targets else np.inf
    for rank in np.argsort(score[start:low], kind="mergesort"):
        source = start + rank
        base = score[source]
        number += 1
        origin = candidates.state[source]
        rest = states.length[origin >> 1] - candidates.progress[source]
        limit, n_wanted, kept = 0.0, 0, 0
        for place in range(n_targets):
            c = targets[place]
            cap = min(score[c], lowest + parameters.break_cost - candidates.cost[c])
            if cap <= base:
                continue  # for good, because bases rise and caps fall
            targets[kept] = c
            kept += 1
            if candidates.state[c] == origin:
                cap = min(cap, base + _stay(candidates, source, c, straight, beta))
            reach = straight + beta * (cap - base)
            if rest + candidates.progress[c] <= reach:  # else no route over the end of the edge is short enough
                limit = max(limit, reach - candidates.progress[c])
                n_wanted += labels.wanted[candidates.state[c]] != number
                labels.wanted[candidates.state[c]] = number
        n_targets = kept
        if n_targets == 0:
            break
        if n_wanted > 0:
            search(states, follow, origin, rest, beta, limit, labels, number, n_wanted)
        for place in range(n_targets):
            c = targets[place]
            cost = base + _route(candidates, source, c, straight, beta, labels, number)[0]
            if cost < score[c]:
                score[c], back[c] = cost, source
                lowest = min(lowest, cost + candidates.cost[c])
    return number


@njit(cache=True, inline="always")
def _route(
    candidates: Candidates, source: int, target: int, straight: float, beta: float, labels: Labels, number: int
) -> tuple[float, bool]:
    """Return the cost of the route between two candidates, and whether it stays on their edge."""
    d = candidates.state[target]
    cost = _stay(candidates, source, target, straight, beta) if d == candidates.state[source] else np.inf
    stays = cost < np.inf
    if labels.stamp[d] == number:
        length = labels.driven[d] + candidates.progress[target]
        around = (abs(length - straight) + labels.key[d] - labels.driven[d]) / beta
        if around < cost:
            cost, stays = around, False
    return cost, stays


@njit(cache=True, inline="always")
def _stay(candidates: Candidates, source: int, target: int, straight: float, beta: float) -> float:
    """Return the cost of going between two candidates on one directed edge; noise may go back a little."""
    step = candidates.progress[target] - candidates.progress[source]
    return abs(step - straight) / beta if step >= -_BACKTRACK else np.inf


@njit(cache=True)
def shortest(
    states: States, follow: Follow, observed: Observations, keys: NDArray[np.int64], k: int,
    candidates: Candidates, source: int, target: int, parameters: Parameters, labels: Labels, number: int,
) -> tuple[int, bool]:  # fmt: skip
    """Search the route that `decide` found between candidates of key k - 1 and k anew, for its labels.

    Returns the number of the search, and whether the route stays on one edge and needs no labels.
    """
    i, j = keys[k - 1], keys[k]
    straight = np.hypot(observed.x[j] - observed.x[i], observed.y[j] - observed.y[i])
    beta = parameters.beta + parameters.beta_rate * (observed.t[j] - observed.t[i])
    origin, d = candidates.state[source], candidates.state[target]
    cost = _stay(candidates, source, target, straight, beta) if d == origin else np.inf
    limit = straight + beta * min(cost, parameters.break_cost) - candidates.progress[target] + 1e-3  # for rounding
    number += 1
    labels.wanted[d] = number
    rest = states.length[origin >> 1] - candidates.progress[source]
    search(states, follow, origin, rest, beta, limit, labels, number, 1)
    return number, _route(candidates, source, target, straight, beta, labels, number)[1]
