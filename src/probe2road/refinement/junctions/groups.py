"""Which edge ends at a junction belong together: by driven passages, heights, and directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.graph.ends import EdgeEnds
from probe2road.graph.roadgraph import RoadGraph
from probe2road.refinement.junctions.passages import Passages, Places

__all__ = [
    "Evidence",
    "GroupingRules",
    "connected_ends",
    "evidence",
    "proven_groups",
]

_REACH = 20.0  # m; the direction of an edge end is measured over this length
_SHARE = 0.5  # largest share of a short edge over which the direction is measured
_USUAL_SPREAD = 3.0  # m, spread of heights between traces if there are too few data
_LEAST_SPREAD = 0.5  # m
_FEWEST = 5  # traces of one pair of ends from which a spread is estimated
_ENOUGH = 30  # heights from which the estimated spread is used
_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_MEDIAN_LOSS = 1.25  # standard error of a median over that of a mean


@dataclass(frozen=True)
class GroupingRules:
    """When edge ends count as connected, and when as apart: part of `DisambiguateOptions`."""

    min_count: int
    min_share: float
    min_height: float  # m
    confidence: float  # standard errors


@dataclass(frozen=True)
class Evidence:
    """The counted passages between m places: p pairs of places, with heights from q traces."""

    places: Places
    pairs: pd.DataFrame  # p rows: one, other (places, one <= other), count (passages, both directions)
    heights: pd.DataFrame  # q rows, sorted by pair: pair, trace, z (m)
    spread: float  # m, standard deviation of heights between traces


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
    """Return the group of every place, shape (m,): pairs with ``min_count`` or more passages share a group.

    This is the literal reading of the paper: a place without such a pair is a group of its own.
    """
    pairs = found.pairs[found.pairs["count"] >= min_count]
    return _components(pairs["one"].to_numpy(), pairs["other"].to_numpy(), len(found.places.end))


def proven_groups(graph: RoadGraph, found: Evidence, rules: GroupingRules) -> NDArray[np.int64]:
    """Return the group of every place, shape (m,); groups are separated only where traces prove it.

    All places of a junction are in one group unless there is proof of two. Numbers of different junctions differ.
    """
    ends = graph.ends(reach=_REACH, share=_SHARE)
    labels = _labels(found, _joined_pairs(found, rules))
    heads = np.flatnonzero(np.diff(found.places.junction, prepend=-1))
    first = np.append(heads, len(found.places.end))
    group = np.repeat(heads, np.diff(first))
    pairs_at = found.pairs.reset_index(drop=True).groupby(group[found.pairs["one"]]).indices
    for head in _junctions_in_doubt(found, labels, group):
        places = slice(int(head), int(first[np.searchsorted(heads, head) + 1]))
        junction = _junction_at(places, pairs_at[head], found, labels, ends)
        group[places] = places.start + _parted(junction, rules)
    return group


@dataclass(frozen=True)
class _Labels:
    """The connections by traces at all junctions; numbers of different junctions differ."""

    proven: NDArray[np.int64]  # (m,) group by joined pairs, -1 for places without one
    unproven: NDArray[np.int64]  # (m,) group of the places without one, by any passage between two such; -1 for others


@dataclass(frozen=True)
class _Junction:
    """One junction with k ends and p pairs of them."""

    direction: NDArray[np.float64]  # (k, 2) unit vectors into the edges
    position: NDArray[np.float64]  # (k, 2) m
    proven: NDArray[np.int64]  # (k,) as in `_Labels`
    unproven: NDArray[np.int64]  # (k,) as in `_Labels`
    counts: NDArray[np.int64]  # (k, k) passages, symmetric
    ends: NDArray[np.int64]  # (p, 2)
    heights: list[NDArray[np.float64]]  # p arrays, m
    spread: float  # m


def _joined_pairs(found: Evidence, rules: GroupingRules) -> NDArray[np.bool_]:
    """Tell which pairs of places are joined: by enough passages, and by a large enough share at either place; (p,)."""
    one, other, count = (found.pairs[name].to_numpy() for name in ("one", "other", "count"))
    m = len(found.places.end)
    flow = np.bincount(one, count, m) + np.bincount(other, count, m)
    enough = (count >= rules.min_count) & (count >= rules.min_share * np.minimum(flow[one], flow[other]))
    return np.asarray((one != other) & enough)


def _labels(found: Evidence, joined: NDArray[np.bool_]) -> _Labels:
    """Group places by joined pairs, and places without a joined pair by the other passages."""
    one, other = (found.pairs[name].to_numpy() for name in ("one", "other"))
    m = len(found.places.end)
    is_proven = np.zeros(m, bool)
    is_proven[one[joined]] = is_proven[other[joined]] = True
    beside = ~is_proven[one] & ~is_proven[other]
    by_joined, by_any = (_components(one[pairs], other[pairs], m) for pairs in (joined, beside))
    return _Labels(np.where(is_proven, by_joined, -1), np.where(is_proven, -1, by_any))


def _junctions_in_doubt(found: Evidence, labels: _Labels, head: NDArray[np.int64]) -> NDArray[np.int64]:
    """List the first place of each junction that may be two; ``head``, shape (m,), gives this place for every place.

    Such a junction has two proven groups, or passages between unproven places, which heights might separate.
    """
    proven = np.unique(np.stack([head, labels.proven])[:, labels.proven >= 0], axis=1)[0]
    groups = np.bincount(proven, minlength=len(head))
    in_doubt = groups >= 2
    if len(found.heights):
        one, other = (found.pairs[name].to_numpy() for name in ("one", "other"))
        unproven = (one != other) & (labels.unproven[one] >= 0) & (labels.unproven[other] >= 0)
        in_doubt[head[one[unproven]]] = True
    return np.flatnonzero(in_doubt)


def _junction_at(
    places: slice, pairs: NDArray[np.int64], found: Evidence, labels: _Labels, ends: EdgeEnds
) -> _Junction:
    """Collect the evidence at one junction, given its places and the rows of its pairs."""
    end = found.places.end[places]
    table = found.pairs.iloc[pairs]
    local = table[["one", "other"]].to_numpy() - places.start
    counts = np.zeros((len(end), len(end)), np.int64)
    counts[local[:, 0], local[:, 1]] = counts[local[:, 1], local[:, 0]] = table["count"]
    of_pair, z = found.heights["pair"].to_numpy(), found.heights["z"].to_numpy()
    low, high = (np.searchsorted(of_pair, pairs, side) for side in ("left", "right"))
    return _Junction(
        direction=ends.ahead[end],
        position=ends.position[end],
        proven=labels.proven[places],
        unproven=labels.unproven[places],
        counts=counts,
        ends=local,
        heights=[z[i:j] for i, j in zip(low, high, strict=True)],
        spread=found.spread,
    )


def _parted(junction: _Junction, rules: GroupingRules) -> NDArray[np.int64]:
    """Return the group of every end of one junction, shape (k,)."""
    k = len(junction.proven)
    groups = _members(junction.proven)
    groups = _without_level_crossings(junction, groups, rules)
    for unproven in _unproven_groups(junction):
        foreign = max((int(junction.counts[np.ix_(unproven, group)].sum()) for group in groups), default=0)
        own = int(junction.counts[np.ix_(unproven, unproven)].sum()) // 2
        if own > foreign and all(_stacked(junction, unproven, group, rules) for group in groups):
            groups.append(unproven)
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


def _unproven_groups(junction: _Junction) -> list[NDArray[np.int64]]:
    """Return the groups of ends that some traces connect but no joined pair; the most driven group first."""
    groups = [group for group in _members(junction.unproven) if len(group) > 1]
    return sorted(groups, key=lambda group: -int(junction.counts[np.ix_(group, group)].sum()))


def _members(label: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """List the ends of every group, in the order of the group numbers; ends numbered -1 are left out."""
    return [np.flatnonzero(label == name) for name in np.unique(label[label >= 0])]


def _without_level_crossings(
    junction: _Junction, groups: list[NDArray[np.int64]], rules: GroupingRules
) -> list[NDArray[np.int64]]:
    """Unite groups that cross each other at one level: this is a crossing where no trace turned."""
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
    """Return the difference of the median heights of two groups and its standard error; NaN, infinity if unknown."""
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
    """Return the group that traces connect to an end most often, else the group that the end continues straightest."""
    counts = [int(junction.counts[end, group].sum()) for group in groups]
    straight = [float((junction.direction[group] @ -junction.direction[end]).max()) for group in groups]
    return max(range(len(groups)), key=lambda number: (counts[number], straight[number]))


def _components(one: NDArray[np.int64], other: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Return the connected component of each of n items that pairs join."""
    matrix = coo_array((np.ones(len(one), bool), (one, other)), shape=(n, n))
    return connected_components(matrix, directed=False)[1].astype(np.int64) if n else np.zeros(0, np.int64)


def _spread(heights: pd.DataFrame) -> float:
    """Estimate the standard deviation of heights between traces from the pairs with many traces."""
    of_pair = heights.groupby("pair")["z"]
    away = (heights["z"] - of_pair.transform("median")).abs()[of_pair.transform("size") >= _FEWEST]
    return max(_MAD * float(away.median()), _LEAST_SPREAD) if len(away) >= _ENOUGH else _USUAL_SPREAD
