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
from probe2road.matching.routes import Labels, RouteQuery, search

__all__ = [
    "JUMP",
    "NULL",
    "Candidates",
    "Decision",
    "Observations",
    "Parameters",
    "Problem",
    "decide",
    "find_candidates",
    "parameters",
    "shortest",
]

NULL = -1  # no road, or reached from no road
JUMP = -2  # reached from the best candidate before, without a route

_BACKTRACK = 25.0  # m that noise may move a fix back along its edge


class Parameters(NamedTuple):
    """The numbers of a `RouteModel` that the compiled functions need; the fields are explained there."""

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
    """The observations at every fix, shape (fixes,) each.

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


class Problem(NamedTuple):
    """The input of the search: a network, the fixes of all traces, and the numbers of the model."""

    states: States
    follow: Follow
    observed: Observations
    parameters: Parameters


class Candidates(NamedTuple):
    """Candidates of the key fixes of one trace; those of key k are ``first[k]`` to ``first[k + 1]``.

    ``fix`` is the row of each key fix in the observations, ``along`` the offset from u (m), ``progress`` that from the
    start of the directed edge, ``cost`` the emission.
    """

    fix: NDArray[np.int64]
    first: NDArray[np.int64]
    state: NDArray[np.int64]
    along: NDArray[np.float64]
    progress: NDArray[np.float64]
    distance: NDArray[np.float64]
    cost: NDArray[np.float64]


class _Scores(NamedTuple):
    """For every candidate, the cost of the best chain that ends there, and the candidate before, `JUMP` or `NULL`."""

    score: NDArray[np.float64]
    back: NDArray[np.int64]


class _Gap(NamedTuple):
    """The gap between two key fixes: its straight length (m), and the number of metres that add a cost of one."""

    straight: float
    beta: float


class Decision(NamedTuple):
    """For every key fix of a trace, its candidate or `NULL`, and whether a route leads to it from the key before."""

    chosen: NDArray[np.int64]
    linked: NDArray[np.bool_]


def parameters(model: RouteModel) -> Parameters:
    """Return the numbers of a model; the cost of no road equals that of a fix at ``null_distance``."""
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
def find_candidates(problem: Problem, keys: NDArray[np.int64], scratch: Scratch) -> Candidates:
    """Find the candidates of key fixes, given as rows of the observations, and their emission costs."""
    states, _, observed, parameters = problem
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
                numbers[3, count] = _emission(problem, i, p, along, distance, reverse)
                count += 1
        first[k + 1] = count
    return Candidates(keys, first, state, numbers[0], numbers[1], numbers[2], numbers[3])


@njit(cache=True)
def _emission(problem: Problem, i: int, p: int, along: float, distance: float, reverse: int) -> float:
    """Return the emission cost of a candidate for a fix: from its distance, course and altitude."""
    states, _, observed, parameters = problem
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
def decide(problem: Problem, candidates: Candidates, labels: Labels) -> Decision:
    """Find the most likely chain of candidates."""
    parameters = problem.parameters
    n_keys = len(candidates.fix)
    scores = _Scores(np.empty(len(candidates.state)), np.full(len(candidates.state), NULL, np.int64))
    score, back = scores
    null_back = np.full(n_keys, NULL, np.int64)  # best candidate before, or NULL
    best = np.full(n_keys, NULL, np.int64)
    null_score = 0.0
    for k in range(n_keys):
        low, high = candidates.first[k], candidates.first[k + 1]
        before = best[k - 1] if k > 0 else NULL
        jump = score[before] + parameters.break_cost if before >= 0 else np.inf
        enter = null_score + (parameters.break_cost / 2.0 if k > 0 else 0.0)
        floor = min(jump, enter)
        for candidate in range(low, high):
            score[candidate] = floor
            back[candidate] = JUMP if jump < enter else NULL
        if k > 0:
            _advance(problem, candidates, k, floor, scores, labels)
        leave = score[before] + parameters.break_cost / 2.0 if before >= 0 else np.inf
        null_back[k] = before if leave <= null_score else NULL
        null_score = min(null_score, leave) + parameters.null_cost
        for candidate in range(low, high):
            score[candidate] += candidates.cost[candidate]
            if best[k] < 0 or score[candidate] < score[best[k]]:
                best[k] = candidate
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
    return Decision(chosen, linked)


@njit(cache=True)
def _advance(problem: Problem, candidates: Candidates, k: int, floor: float, scores: _Scores, labels: Labels) -> None:
    """Improve the scores of the candidates of key k by routes from the candidates of the key before.

    Sources are taken from the best on. A target is of no use any more where its score, its emission included,
    exceeds that of the best target by a jump: from the next key on, the jump is at least as good. ``cap`` is the
    score that a target must stay below, so the searches of the later sources are short.
    """
    states, follow, _, parameters = problem
    score, back = scores
    gap = _gap_before(problem, candidates, k)
    straight, beta = gap
    if straight > parameters.max_step:
        return
    low, start = candidates.first[k], candidates.first[k - 1]
    targets = np.arange(low, candidates.first[k + 1])
    n_targets = len(targets)
    lowest = (floor + candidates.cost[targets]).min() if n_targets else np.inf
    for rank in np.argsort(score[start:low], kind="mergesort"):
        source = start + rank
        base = score[source]
        labels.number[0] += 1
        number = labels.number[0]
        origin = candidates.state[source]
        rest = states.length[origin >> 1] - candidates.progress[source]
        limit, n_wanted, kept = 0.0, 0, 0
        for place in range(n_targets):
            target = targets[place]
            cap = min(score[target], lowest + parameters.break_cost - candidates.cost[target])
            if cap <= base:
                continue  # also for later sources, because bases rise and caps fall
            targets[kept] = target
            kept += 1
            if candidates.state[target] == origin:
                cap = min(cap, base + _stay(candidates, source, target, gap))
            reach = straight + beta * (cap - base)
            if rest + candidates.progress[target] <= reach:  # else no route over the end of the edge is short enough
                limit = max(limit, reach - candidates.progress[target])
                n_wanted += labels.wanted[candidates.state[target]] != number
                labels.wanted[candidates.state[target]] = number
        n_targets = kept
        if n_targets == 0:
            break
        if n_wanted > 0:
            search(states, follow, RouteQuery(origin, rest, beta, limit, n_wanted), labels)
        for place in range(n_targets):
            target = targets[place]
            cost = base + _route(candidates, source, target, gap, labels)[0]
            if cost < score[target]:
                score[target], back[target] = cost, source
                lowest = min(lowest, cost + candidates.cost[target])


@njit(cache=True)
def _gap_before(problem: Problem, candidates: Candidates, k: int) -> _Gap:
    """Measure the gap from the key fix before to key k."""
    observed, parameters = problem.observed, problem.parameters
    i, j = candidates.fix[k - 1], candidates.fix[k]
    straight = np.hypot(observed.x[j] - observed.x[i], observed.y[j] - observed.y[i])
    return _Gap(straight, parameters.beta + parameters.beta_rate * (observed.t[j] - observed.t[i]))


@njit(cache=True, inline="always")
def _route(candidates: Candidates, source: int, target: int, gap: _Gap, labels: Labels) -> tuple[float, bool]:
    """Return the cost of the route between two candidates, and whether it stays on their edge."""
    d = candidates.state[target]
    cost = _stay(candidates, source, target, gap) if d == candidates.state[source] else np.inf
    stays = cost < np.inf
    if labels.stamp[d] == labels.number[0]:
        length = labels.driven[d] + candidates.progress[target]
        around = (abs(length - gap.straight) + labels.key[d] - labels.driven[d]) / gap.beta
        if around < cost:
            cost, stays = around, False
    return cost, stays


@njit(cache=True, inline="always")
def _stay(candidates: Candidates, source: int, target: int, gap: _Gap) -> float:
    """Return the cost of going between two candidates on one directed edge; noise may lead a little backwards."""
    step = candidates.progress[target] - candidates.progress[source]
    return abs(step - gap.straight) / gap.beta if step >= -_BACKTRACK else np.inf


@njit(cache=True)
def shortest(problem: Problem, candidates: Candidates, k: int, source: int, target: int, labels: Labels) -> bool:
    """Repeat the search for the route that `decide` found between candidates of keys k - 1 and k, to label its edges.

    Returns whether the route stays on one edge and needs no labels.
    """
    gap = _gap_before(problem, candidates, k)
    origin, d = candidates.state[source], candidates.state[target]
    cost = _stay(candidates, source, target, gap) if d == origin else np.inf
    most = min(cost, problem.parameters.break_cost)
    limit = gap.straight + gap.beta * most - candidates.progress[target] + 1e-3  # for rounding
    labels.number[0] += 1
    labels.wanted[d] = labels.number[0]
    rest = problem.states.length[origin >> 1] - candidates.progress[source]
    search(problem.states, problem.follow, RouteQuery(origin, rest, gap.beta, limit, 1), labels)
    return _route(candidates, source, target, gap, labels)[1]
