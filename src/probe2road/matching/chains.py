"""From the candidates chosen for key fixes to matched paths: the driven edges, and the position of every fix on them.

Legend of array shapes: F fixes, T traces, S steps of all traces one after another.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.matching.candidates import nearest_on_edge, new_scratch
from probe2road.matching.network import States
from probe2road.matching.routes import Labels, new_labels
from probe2road.matching.viterbi import Candidates, Problem, decide, find_candidates, shortest

__all__ = ["Paths", "match_over_routes"]


class Paths(NamedTuple):
    """Matched paths of many traces.

    Attributes
    ----------
    step
        Shape (F,): row of the step a fix lies on, or -1.
    along, distance
        Shape (F,): offset from u, and distance to the edge, m; NaN where unmatched.
    near
        Shape (F,), bool: whether there was any candidate to choose from.
    state, trace, part
        Shape (S,): directed edge, row of the trace, and number of the part of the trace.
    entered
        Shape (S,), bool: the path came over the start node of the directed edge, from the step before.
    """

    step: NDArray[np.int64]
    along: NDArray[np.float64]
    distance: NDArray[np.float64]
    near: NDArray[np.bool_]
    state: NDArray[np.int64]
    trace: NDArray[np.int64]
    part: NDArray[np.int64]
    entered: NDArray[np.bool_]


class _Steps(NamedTuple):
    """The steps found so far, as lists, because numba can extend lists but not arrays."""

    state: list[int]
    trace: list[int]
    part: list[int]
    entered: list[bool]


@njit(cache=True)
def match_over_routes(problem: Problem, starts: NDArray[np.int64]) -> Paths:
    """Match all traces; trace i has the fixes ``starts[i]`` to ``starts[i + 1]`` (excluded)."""
    states, observed = problem.states, problem.observed
    n_fixes = len(observed.x)
    paths = Paths(
        np.full(n_fixes, -1, np.int64),
        np.full(n_fixes, np.nan),
        np.full(n_fixes, np.nan),
        np.zeros(n_fixes, np.bool_),
        np.empty(0, np.int64),
        np.empty(0, np.int64),
        np.empty(0, np.int64),
        np.empty(0, np.bool_),
    )
    steps = _no_steps()
    scratch = new_scratch(len(states.x))
    labels = new_labels(len(states.head))
    for trace in range(len(starts) - 1):
        keys = starts[trace] + np.flatnonzero(observed.key[starts[trace] : starts[trace + 1]])
        candidates = find_candidates(problem, keys, scratch)
        decision = decide(problem, candidates, labels)
        part = -1
        for k in range(len(keys)):
            stop = keys[k + 1] if k + 1 < len(keys) else starts[trace + 1]
            paths.near[keys[k] : stop] = candidates.first[k + 1] > candidates.first[k]
            chosen = decision.chosen[k]
            if chosen < 0:
                continue
            if decision.linked[k]:
                _follow_route(problem, candidates, decision.chosen, k, labels, steps, paths)
            else:
                part += 1
                steps.state.append(candidates.state[chosen])
                steps.trace.append(trace)
                steps.part.append(part)
                steps.entered.append(False)
            _place(paths, keys[k], len(steps.state) - 1, candidates.along[chosen], candidates.distance[chosen])
            if k + 1 == len(keys) or not decision.linked[k + 1]:
                _place_behind(problem, keys[k] + 1, stop, steps, paths)
    return Paths(
        paths.step, paths.along, paths.distance, paths.near,
        np.array(steps.state, np.int64), np.array(steps.trace, np.int64),
        np.array(steps.part, np.int64), np.array(steps.entered, np.bool_),
    )  # fmt: skip


@njit(cache=True)
def _no_steps() -> _Steps:
    """Return empty lists.

    The comprehensions, which tell the compiler their types, stand apart, because numba drops writes to the arrays of a
    local named tuple, as in ``paths.near[fix] = True``, from a function that holds one.
    """
    return _Steps([0 for _ in range(0)], [0 for _ in range(0)], [0 for _ in range(0)], [False for _ in range(0)])


@njit(cache=True, inline="always")
def _place(paths: Paths, fix: int, step: int, along: float, distance: float) -> None:
    paths.step[fix], paths.along[fix], paths.distance[fix] = step, along, distance


@njit(cache=True)
def _follow_route(
    problem: Problem, candidates: Candidates, chosen: NDArray[np.int64], k: int, labels: Labels,
    steps: _Steps, paths: Paths,
) -> None:  # fmt: skip
    """Append the steps from the key fix before to key fix k, and place the fixes between them on the route."""
    states, observed = problem.states, problem.observed
    source, target = chosen[k - 1], chosen[k]
    first = len(steps.state) - 1
    if not shortest(problem, candidates, k, source, target, labels):
        route = [candidates.state[target]]
        while labels.before[route[-1]] >= 0:
            route.append(labels.before[route[-1]])
        for r in range(len(route) - 1, -1, -1):
            steps.state.append(route[r])
            steps.trace.append(steps.trace[first])
            steps.part.append(steps.part[first])
            steps.entered.append(True)
    begin, end = candidates.along[source], candidates.along[target]
    last = len(steps.state) - 1
    reached = first
    for fix in range(candidates.fix[k - 1] + 1, candidates.fix[k]):
        best, best_along, best_step = np.inf, begin, reached
        for step in range(reached, last + 1):
            low, high = _driven_span(states, steps.state[step], begin, end, step == first, step == last)
            along, distance = nearest_on_edge(
                states, steps.state[step] >> 1, observed.x[fix], observed.y[fix], low, high
            )
            if distance < best:
                best, best_along, best_step = distance, along, step
        reached = best_step
        _place(paths, fix, best_step, best_along, best)


@njit(cache=True, inline="always")
def _driven_span(
    states: States, state: int, begin: float, end: float, is_first: bool, is_last: bool
) -> tuple[float, float]:
    """Return the offsets from u between which a directed edge was driven, the smaller first."""
    length = states.length[state >> 1]
    reverse = state & 1
    start, stop = (length, 0.0) if reverse else (0.0, length)
    if is_first:
        start = begin
    if is_last:
        stop = end
    return min(start, stop), max(start, stop)


@njit(cache=True)
def _place_behind(problem: Problem, start: int, stop: int, steps: _Steps, paths: Paths) -> None:
    """Place the fixes after the last key fix of a part on its last edge, if they are within the radius."""
    states, observed, radius = problem.states, problem.observed, problem.parameters.radius
    step = len(steps.state) - 1
    edge = steps.state[step] >> 1
    for fix in range(start, stop):
        along, distance = nearest_on_edge(states, edge, observed.x[fix], observed.y[fix], 0.0, states.length[edge])
        if distance <= radius:
            _place(paths, fix, step, along, distance)
