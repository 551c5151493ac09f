"""Which edge ends at a junction belong together: by what traces drove, how high they were, how straight they lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.graph.roadgraph import RoadGraph
from probe2road.refinement.junctions.passages import Passages, Places

__all__ = [
    "EndDirections",
    "Evidence",
    "GroupingRules",
    "connected_ends",
    "end_directions",
    "evidence",
    "proven_groups",
]

_REACH = 20.0  # m; the direction of an edge end is measured over this length
_USUAL_SPREAD = 3.0  # m, of heights between traces, where the data is too little to tell
_LEAST_SPREAD = 0.5  # m
_FEWEST = 5  # traces of one pair of ends from which a spread is estimated
_ENOUGH = 30  # heights from which a spread is believed
_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_MEDIAN_LOSS = 1.25  # standard error of a median over that of a mean


@dataclass(frozen=True)
class GroupingRules:
    """From what on edge ends are connected, and apart: part of `DisambiguateOptions`."""

    min_count: int
    min_share: float
    min_height: float  # m
    confidence: float  # standard errors


@dataclass(frozen=True)
class EndDirections:
    """Where the ends of E edges lie and lead; rows are ends."""

    position: NDArray[np.float64]  # (2 E, 2) m
    ahead: NDArray[np.float64]  # (2 E, 2) unit vector from the junction into the edge


@dataclass(frozen=True)
class Evidence:
    """What was counted between m places; p pairs of places, of which q traces have heights."""

    places: Places
    pairs: pd.DataFrame  # p rows: one, other (places, one <= other), count (passages, both directions)
    heights: pd.DataFrame  # q rows, sorted by pair: pair, trace, z (m)
    spread: float  # m, standard deviation of heights between traces


def end_directions(graph: RoadGraph) -> EndDirections:
    """Measure positions and directions of all edge ends."""
    lines = shapely.force_2d(graph.edges.geometry.to_numpy())
    length = shapely.length(lines)
    reach = np.minimum(_REACH, length / 2)
    at = np.stack([np.zeros(len(lines)), length], axis=1)
    inside = np.stack([reach, length - reach], axis=1)
    position, tip = (
        shapely.get_coordinates(shapely.line_interpolate_point(lines[:, None], along).reshape(-1))
        for along in (at, inside)
    )
    vector = tip - position
    return EndDirections(position, vector / np.maximum(np.hypot(*vector.T), 1e-9)[:, None])


def evidence(places: Places, passages: Passages) -> Evidence:
    """Count passages between places, both directions together, and collect their heights."""
    one, other = (places.find(passages.junction, end) for end in (passages.came, passages.went))
    table = pd.DataFrame(
        {
            "one": np.minimum(one, other),
            "other": np.maximum(one, other),
            "trace": passages.trace,
            "z": passages.xyz[:, 2],
        }
    )
    pairs = table.groupby(["one", "other"]).size().rename("count").reset_index()
    keyed = table.merge(pairs.reset_index(names="pair"), on=["one", "other"])
    heights = keyed[keyed["z"].notna()].groupby(["pair", "trace"])["z"].mean().reset_index()
    return Evidence(places, pairs, heights, _spread(heights))


def connected_ends(found: Evidence, *, min_count: int) -> NDArray[np.int64]:
    """Give places that pairs with ``min_count`` passages connect one number, shape (m,).

    The literal reading of the paper: a place without such a pair is a group of its own.
    """
    pairs = found.pairs[found.pairs["count"] >= min_count]
    return _components(pairs["one"].to_numpy(), pairs["other"].to_numpy(), len(found.places.end))


def proven_groups(found: Evidence, directions: EndDirections, rules: GroupingRules) -> NDArray[np.int64]:
    """Return the group of every place, shape (m,): apart only where traces prove it.

    All places of a junction are in one group unless there is proof of two. Numbers of different junctions differ.
    """
    places, pairs = found.places, found.pairs
    m = len(places.end)
    one, other, count = (pairs[name].to_numpy() for name in ("one", "other", "count"))
    flow = np.bincount(one, count, m) + np.bincount(other, count, m)
    joined = (one != other) & (count >= rules.min_count)
    joined &= count >= rules.min_share * np.minimum(flow[one], flow[other])
    label = _components(one[joined], other[joined], m)
    proven = np.zeros(m, bool)
    proven[one[joined]] = proven[other[joined]] = True

    head = np.flatnonzero(np.diff(places.junction, prepend=-1))
    owner = np.repeat(np.arange(len(head)), np.diff(np.append(head, m)))
    n_proven = pd.DataFrame({"owner": owner, "label": label})[proven].drop_duplicates()["owner"]
    asked = np.bincount(n_proven, minlength=len(head)) >= 2
    light = (one != other) & ~proven[one] & ~proven[other]
    light_label = _components(one[light], other[light], m)
    if len(found.heights):
        asked[owner[one[light]]] = True
    group = head[owner]
    bounds = np.searchsorted(found.heights["pair"].to_numpy(), np.arange(len(pairs) + 1))
    z = found.heights["z"].to_numpy()
    by_junction = pairs.assign(pair=np.arange(len(pairs))).groupby(owner[one]).indices
    for junction in np.flatnonzero(asked):
        stop = head[junction + 1] if junction + 1 < len(head) else m
        here = slice(int(head[junction]), int(stop))
        rows = by_junction[junction]
        local = _Junction(
            direction=directions.ahead[places.end[here]],
            position=directions.position[places.end[here]],
            label=np.where(proven[here], label[here], -1),
            light=np.where(proven[here], -1, light_label[here]),
            counts=_count_matrix(one[rows] - here.start, other[rows] - here.start, count[rows], here.stop - here.start),
            ends=np.stack([one[rows], other[rows]], axis=1) - here.start,
            heights=[z[bounds[row] : bounds[row + 1]] for row in rows],
            spread=found.spread,
        )
        group[here] = here.start + _parted(local, rules)
    return group


@dataclass(frozen=True)
class _Junction:
    """One junction with k ends and p pairs of them."""

    direction: NDArray[np.float64]  # (k, 2) unit vectors into the edges
    position: NDArray[np.float64]  # (k, 2) m
    label: NDArray[np.int64]  # (k,) group by connected pairs, -1 for ends without one
    light: NDArray[np.int64]  # (k,) group of the ends without one, by any passage between two such; -1 for all others
    counts: NDArray[np.int64]  # (k, k) passages, symmetric
    ends: NDArray[np.int64]  # (p, 2)
    heights: list[NDArray[np.float64]]  # p arrays, m
    spread: float  # m


def _parted(junction: _Junction, rules: GroupingRules) -> NDArray[np.int64]:
    """Return the group of every end of one junction, shape (k,)."""
    k = len(junction.label)
    groups = [np.flatnonzero(junction.label == name) for name in np.unique(junction.label[junction.label >= 0])]
    groups = _without_level_crossings(junction, groups, rules)
    for light in _light_groups(junction):
        foreign = max((int(junction.counts[np.ix_(light, group)].sum()) for group in groups), default=0)
        own = int(junction.counts[np.ix_(light, light)].sum()) // 2
        if own > foreign and all(_stacked(junction, light, group, rules) for group in groups):
            groups.append(light)
    result = np.zeros(k, np.int64)
    if len(groups) < 2:
        return result
    free = np.ones(k, bool)
    for number, group in enumerate(groups):
        result[group] = number
        free[group] = False
    for end in np.flatnonzero(free):
        result[end] = _closest_group(junction, int(end), groups)
    return result


def _light_groups(junction: _Junction) -> list[NDArray[np.int64]]:
    """Return the groups of ends without a connected pair that some traces passed between; the most driven first."""
    groups = [np.flatnonzero(junction.light == name) for name in np.unique(junction.light[junction.light >= 0])]
    groups = [group for group in groups if len(group) > 1]
    return sorted(groups, key=lambda group: -int(junction.counts[np.ix_(group, group)].sum()))


def _without_level_crossings(
    junction: _Junction, groups: list[NDArray[np.int64]], rules: GroupingRules
) -> list[NDArray[np.int64]]:
    """Unite groups that cross each other at one level: a crossing where nobody was seen to turn."""
    n = len(groups)
    if n < 2:
        return groups
    links = [
        (i, j)
        for i in range(n)
        for j in range(i + 1, n)
        if _level(junction, groups[i], groups[j], rules) and _interleaved(junction, groups[i], groups[j])
    ]
    one, other = np.array(links, np.int64).reshape(-1, 2).T
    label = _components(one, other, n)
    return [np.concatenate([groups[i] for i in np.flatnonzero(label == name)]) for name in np.unique(label)]


def _height_difference(junction: _Junction, one: NDArray[np.int64], other: NDArray[np.int64]) -> tuple[float, float]:
    """Difference of the median heights of two groups, and its standard error; NaN and infinite without heights."""
    sides = []
    for group in (one, other):
        within = np.isin(junction.ends, group).all(axis=1)
        sides.append(np.concatenate([np.zeros(0), *(junction.heights[pair] for pair in np.flatnonzero(within))]))
    if not all(len(z) for z in sides):
        return np.nan, np.inf
    error = [junction.spread * (_MEDIAN_LOSS if len(z) > 2 else 1.0) / np.sqrt(len(z)) for z in sides]
    return abs(float(np.median(sides[0]) - np.median(sides[1]))), float(np.hypot(*error))


def _stacked(junction: _Junction, one: NDArray[np.int64], other: NDArray[np.int64], rules: GroupingRules) -> bool:
    difference, error = _height_difference(junction, one, other)
    return difference >= max(rules.min_height, rules.confidence * error)


def _level(junction: _Junction, one: NDArray[np.int64], other: NDArray[np.int64], rules: GroupingRules) -> bool:
    difference, error = _height_difference(junction, one, other)
    return difference + rules.confidence * error < rules.min_height


def _interleaved(junction: _Junction, one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    """Tell whether the ends of two groups alternate around the junction."""
    tips = junction.position + _REACH * junction.direction
    away = tips - junction.position.mean(axis=0)
    ends = np.concatenate([one, other])
    order = np.argsort(np.arctan2(away[ends, 1], away[ends, 0]), kind="stable")
    is_one = order < len(one)
    return int((is_one != np.roll(is_one, 1)).sum()) >= 4


def _closest_group(junction: _Junction, end: int, groups: list[NDArray[np.int64]]) -> int:
    """Return the group that traces connect an end to most often, else the one it continues most nearly straight."""
    counts = [int(junction.counts[end, group].sum()) for group in groups]
    straight = [float((junction.direction[group] @ -junction.direction[end]).max()) for group in groups]
    return max(range(len(groups)), key=lambda number: (counts[number], straight[number]))


def _components(one: NDArray[np.int64], other: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Return the connected component of each of n things that pairs join."""
    matrix = coo_array((np.ones(len(one), bool), (one, other)), shape=(n, n))
    return connected_components(matrix, directed=False)[1].astype(np.int64) if n else np.zeros(0, np.int64)


def _count_matrix(
    one: NDArray[np.int64], other: NDArray[np.int64], count: NDArray[np.int64], k: int
) -> NDArray[np.int64]:
    matrix = np.zeros((k, k), np.int64)
    matrix[one, other] = matrix[other, one] = count
    return matrix


def _spread(heights: pd.DataFrame) -> float:
    """Estimate the standard deviation of heights between traces from the pairs with many traces."""
    of_pair = heights.groupby("pair")["z"]
    away = (heights["z"] - of_pair.transform("median")).abs()[of_pair.transform("size") >= _FEWEST]
    return max(_MAD * float(away.median()), _LEAST_SPREAD) if len(away) >= _ENOUGH else _USUAL_SPREAD
