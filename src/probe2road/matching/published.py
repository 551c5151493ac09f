"""The map matcher of Biagioni and Eriksson (2012), which the paper reuses (METHOD 4.4).

Strategy
--------
The states are the directed edges and "unknown". Fixes are interpolated so that no two observations are more than
10 m apart, because every observation moves the chain by one edge at most. At each observation only the
edges with an emission are states: each takes the best of itself, of the edges that lead into it, and of unknown.
The states of the last 300 observations are kept in a ring; the best state now decides the one 300 observations
ago, as in the published program, so memory does not grow with the trace.

Rows of the transition matrix do not sum to 1, as published: the share of the reverse edge is lost.
"""

from __future__ import annotations

from math import erfc
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.fleet.contract import Fleet
from probe2road.matching.candidates import Scratch, nearest_points, new_scratch
from probe2road.matching.chains import Paths
from probe2road.matching.models import PublishedModel
from probe2road.matching.network import States

__all__ = ["emission_table", "match_published", "transition"]


class _Numbers(NamedTuple):
    """Logarithms of the probabilities of a `PublishedModel`."""

    cutoff: float  # m
    unknown: float
    stay: float
    onward: float  # of leaving an edge over its end, shared by weight
    turn_back: float
    leave: float
    stay_unknown: float
    enter: float  # to each edge
    local: bool  # whether ``enter`` is still to be shared by the edges near
    floor: float
    memory: int


def emission_table(model: PublishedModel) -> NDArray[np.float64]:
    """Return the emission probability of an edge at distances of 0, 1, 2, ... whole metres, up to the cutoff.

    It is the complementary normal distribution ``1 - Phi(d / sigma)``. Distances are rounded down.

    Examples
    --------
    >>> emission_table(PublishedModel())[[0, 10, 25, 50, 100, 116, 149]].round(4).tolist()
    [0.5, 0.4207, 0.3085, 0.1587, 0.0228, 0.0102, 0.0014]
    >>> len(emission_table(PublishedModel()))
    150
    """
    metres = np.arange(int(np.ceil(model.cutoff)))
    return np.array([0.5 * erfc(d / (model.sigma * np.sqrt(2.0))) for d in metres])


def match_published(fleet: Fleet, states: States, weight: NDArray[np.float64], model: PublishedModel) -> Paths:
    """Match all traces with the published model; ``weight``, shape (E,), holds the weights w of METHOD 4.4."""
    x, y = (np.ascontiguousarray(fleet.traces[axis].to_numpy(np.float64)) for axis in "xy")
    n_states = int(states.allowed.sum())
    local = model.reentry == "local"
    with np.errstate(divide="ignore"):  # a probability of 0 is a cost without bound
        numbers = _Numbers(
            cutoff=float(model.cutoff),
            unknown=float(np.log(model.unknown)),
            stay=float(np.log(model.stay)),
            onward=float(np.log(max(1.0 - model.stay - model.leave, 0.0))),
            turn_back=float(np.log(model.turn_back)),
            leave=float(np.log(model.leave)),
            stay_unknown=float(np.log(model.stay_unknown)),
            enter=float(np.log(model.enter / (1 if local else max(n_states, 1)))),
            local=local,
            floor=float(np.log(model.floor)),
            memory=int(model.memory),
        )
    log_emission = np.log(emission_table(model))
    return _match(states, np.log(_shares(states, weight)), log_emission, x, y, fleet.starts, model.step, numbers)


def _shares(states: States, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each directed edge's share of the weights of all edges that leave its start node, shape (D,).

    The reverse of the edge that the vehicle comes from counts too, as published.
    """
    weight = np.repeat(weight, 2) * states.allowed
    total = np.bincount(states.tail, weight, minlength=len(states.out_first) - 1)
    return np.where(states.allowed, weight / np.maximum(total[states.tail], np.finfo(float).tiny), 1.0)


def transition(
    states: States, weight: NDArray[np.float64], before: int, after: int, model: PublishedModel | None = None
) -> float:
    """Return the probability of going from one directed edge to another between two observations.

    Examples
    --------
    The example of METHOD 11: of three edges at a node one is a gap edge of weight 0.1.

    >>> from probe2road.matching.network import build_states
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (9, 0)], [(9, 0), (18, 0)], [(9, 0), (9, 9)]]
    >>> states = build_states(graph_from_lines(lines, crs="EPSG:32616"))
    >>> weight = np.array([1.0, 1.0, 0.1])
    >>> [round(transition(states, weight, 0, after) / 0.49999, 4) for after in (2, 4)]
    [0.4762, 0.0476]
    """
    model = model or PublishedModel()
    if before == after:
        return model.stay
    if states.head[before] != states.tail[after]:
        return 0.0
    if after == before ^ 1:
        return model.turn_back if _may_turn_back(states, before) else 0.0
    return float(_shares(states, weight)[after] * (1.0 - model.stay - model.leave))


@njit(cache=True)
def _may_turn_back(states: States, d: int) -> bool:
    """Tell whether vehicles may turn at the end of a directed edge: not at a node in the middle of a chain."""
    n_out = 0
    for k in range(states.out_first[states.head[d]], states.out_first[states.head[d] + 1]):
        n_out += states.allowed[states.out[k]]
    return n_out != 2


@njit(cache=True)
def _match(
    states: States, log_share: NDArray[np.float64], log_emission: NDArray[np.float64],
    x: NDArray[np.float64], y: NDArray[np.float64], starts: NDArray[np.int64], step: float, numbers: _Numbers,
) -> Paths:  # fmt: skip
    """Match all traces, and return their paths."""
    n_fixes = len(x)
    fix_step = np.full(n_fixes, -1, np.int64)
    along, distance = np.full(n_fixes, np.nan), np.full(n_fixes, np.nan)
    near = np.zeros(n_fixes, np.bool_)
    step_state, step_trace = [0 for _ in range(0)], [0 for _ in range(0)]
    step_part, step_entered = [0 for _ in range(0)], [False for _ in range(0)]
    scratch = new_scratch(len(states.x))
    query = 0
    for trace in range(len(starts) - 1):
        at_x, at_y, fix = _interpolated(x, y, starts[trace], starts[trace + 1], step)
        decided = _decide(states, log_share, log_emission, at_x, at_y, query, scratch, numbers)
        query += len(at_x)
        part, before = -1, -1
        for k in range(len(decided)):
            d = decided[k]
            if d >= 0 and d != before:
                entered = before >= 0 and states.head[before] == states.tail[d]
                part += not entered
                step_state.append(d)
                step_trace.append(trace)
                step_part.append(part)
                step_entered.append(entered)
            before = d
            i = fix[k]
            if i >= 0 and d >= 0:
                fix_step[i] = len(step_state) - 1
        for k in range(len(fix)):
            i = fix[k]
            if i < 0:
                continue
            n_points = nearest_points(states, x[i], y[i], numbers.cutoff, query, scratch)
            query += 1
            near[i] = n_points > 0
            if fix_step[i] < 0:
                continue
            edge = step_state[fix_step[i]] >> 1
            for c in range(n_points):
                if states.edge[scratch.point[c]] == edge and not scratch.distance[c] >= distance[i]:
                    along[i], distance[i] = scratch.along[c], scratch.distance[c]
    return Paths(
        fix_step, along, distance, near,
        np.array(step_state, np.int64), np.array(step_trace, np.int64),
        np.array(step_part, np.int64), np.array(step_entered, np.bool_),
    )  # fmt: skip


@njit(cache=True)
def _interpolated(
    x: NDArray[np.float64], y: NDArray[np.float64], start: int, stop: int, step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Divide the stretches between fixes into the fewest equal steps of at most ``step`` m.

    Returns the places, and the fix that each one is, -1 for places between fixes.
    """
    count = 1
    for i in range(start + 1, stop):
        count += max(int(np.ceil(np.hypot(x[i] - x[i - 1], y[i] - y[i - 1]) / step)), 1)
    at_x, at_y, fix = np.empty(count), np.empty(count), np.full(count, -1, np.int64)
    at_x[0], at_y[0], fix[0] = x[start], y[start], start
    place = 1
    for i in range(start + 1, stop):
        n_steps = max(int(np.ceil(np.hypot(x[i] - x[i - 1], y[i] - y[i - 1]) / step)), 1)
        for k in range(1, n_steps + 1):
            at_x[place] = x[i - 1] + (x[i] - x[i - 1]) * k / n_steps
            at_y[place] = y[i - 1] + (y[i] - y[i - 1]) * k / n_steps
            place += 1
        fix[place - 1] = i
    return at_x, at_y, fix


@njit(cache=True)
def _decide(
    states: States, log_share: NDArray[np.float64], log_emission: NDArray[np.float64],
    x: NDArray[np.float64], y: NDArray[np.float64], query: int, scratch: Scratch, numbers: _Numbers,
) -> NDArray[np.int64]:  # fmt: skip
    """Return the directed edge of every observation of one trace, -1 for unknown.

    In the ring, row ``k % depth`` holds the states of observation k: column 0 is unknown, the others are directed
    edges, and ``back`` is the column of each one's predecessor in the row before.
    """
    depth = numbers.memory + 1
    state, back = np.full((depth, 64), -1, np.int64), np.zeros((depth, 64), np.int64)
    column, stamp = np.zeros(len(states.head), np.int64), np.full(len(states.head), -1, np.int64)
    score = np.zeros(1)  # the prior: unknown
    decided = np.full(len(x), -1, np.int64)
    best = 0
    for k in range(len(x)):
        n_points = nearest_points(states, x[k], y[k], numbers.cutoff, query + k, scratch)
        if 2 * n_points + 1 > state.shape[1]:
            state, back = _wider(state, 4 * n_points), _wider(back, 4 * n_points)
        row = k % depth
        count, emission = _near_states(states, log_emission, n_points, scratch, state[row])
        unknown = score[0]
        new = np.empty(count)
        back[row, 0] = 0
        new[0] = unknown + numbers.stay_unknown
        if score[best] + numbers.leave > new[0]:
            new[0], back[row, 0] = score[best] + numbers.leave, best
        new[0] += numbers.unknown
        enter = unknown + numbers.enter - (np.log(count - 1.0) if numbers.local and count > 1 else 0.0)
        for c in range(1, count):
            new[c], back[row, c] = _best_before(
                states, log_share, state[row, c], column, stamp, k - 1, score, enter, numbers
            )
            new[c] += emission[c]
        score, best = _normalised(new, numbers.floor)
        for c in range(1, count):
            column[state[row, c]], stamp[state[row, c]] = c, k
        if k >= numbers.memory:
            place = best
            for earlier in range(k, k - numbers.memory, -1):
                place = back[earlier % depth, place]
            decided[k - numbers.memory] = state[(k - numbers.memory) % depth, place]
    place = best
    for k in range(len(x) - 1, max(len(x) - 1 - numbers.memory, -1), -1):
        decided[k] = state[k % depth, place]
        place = back[k % depth, place]
    return decided


@njit(cache=True)
def _near_states(
    states: States, log_emission: NDArray[np.float64], n_points: int, scratch: Scratch, state: NDArray[np.int64]
) -> tuple[int, NDArray[np.float64]]:
    """List the directed edges of points after the unknown state; return the number of states, and their emissions.

    Points come in the order of their edges, so several points of one edge, of which the nearest counts, are neighbours.
    """
    emission = np.full(2 * n_points + 1, -np.inf)
    state[0] = -1
    count = 1
    for c in range(n_points):
        edge = states.edge[scratch.point[c]]
        metres = int(scratch.distance[c])
        value = log_emission[metres] if metres < len(log_emission) else -np.inf
        for reverse in range(2):
            d = 2 * edge + reverse
            if not states.allowed[d]:
                continue
            place = count
            for known in range(max(count - 2, 1), count):
                if state[known] == d:
                    place = known
            state[place] = d
            emission[place] = max(emission[place], value)
            count = max(count, place + 1)
    return count, emission


@njit(cache=True)
def _best_before(
    states: States, log_share: NDArray[np.float64], d: int, column: NDArray[np.int64], stamp: NDArray[np.int64],
    before: int, score: NDArray[np.float64], enter: float, numbers: _Numbers,
) -> tuple[float, int]:  # fmt: skip
    """Return the best score of a directed edge before its emission, and the column of its predecessor.

    Ties go to staying, then to the lower directed edge, then to unknown.
    """
    best, place = -np.inf, 0
    if stamp[d] == before and before >= 0:
        best, place = score[column[d]] + numbers.stay, column[d]
    tail = states.tail[d]
    for k in range(states.out_first[tail], states.out_first[tail + 1]):
        e = states.out[k] ^ 1
        if before < 0 or stamp[e] != before or e == d:
            continue
        if e == d ^ 1:
            value = score[column[e]] + numbers.turn_back if _may_turn_back(states, e) else -np.inf
        else:
            value = score[column[e]] + log_share[d] + numbers.onward
        if value > best:
            best, place = value, column[e]
    return (enter, 0) if enter > best else (best, place)


@njit(cache=True)
def _normalised(score: NDArray[np.float64], floor: float) -> tuple[NDArray[np.float64], int]:
    """Divide probabilities by their sum and drop those below the floor; return the best state, too.

    Where nothing is left the chain restarts from the prior. Ties go to the edge that comes first.
    """
    highest = score.max()
    if highest == -np.inf:
        score[0] = 0.0
        return score, 0
    score -= highest + np.log(np.exp(score - highest).sum())
    best = 0
    for c in range(1, len(score)):
        if score[c] < floor:
            score[c] = -np.inf
        elif score[c] > score[best] or (best == 0 and score[c] == score[0]):
            best = c
    if score[0] < floor:
        score[0] = -np.inf
    return score, best


@njit(cache=True)
def _wider(values: NDArray[np.int64], columns: int) -> NDArray[np.int64]:
    """Return a copy of a table with more columns."""
    wider = np.zeros((len(values), columns), np.int64)
    wider[:, : values.shape[1]] = values
    return wider
