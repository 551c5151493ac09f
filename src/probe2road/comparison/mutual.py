"""Two maps of the same roads looked up on each other, and the stretches that only one of them has.

Strategy. Every place of a road is looked up on the other map in each direction in which it is driven. It has a
counterpart only if that is mutual: if places of the other road, looked up in turn, come back to within some metres.
Otherwise the second carriageway of a street whose first one alone is mapped, or a track beside a motorway, would be
taken for the nearest road within the radius. What is left of both maps is looked up on each other once more, whichever
way it is driven: a carriageway that lies nearer to the other one than to itself, or is drawn the wrong way. Runs of
places with and without a counterpart are the pieces of a road; runs that are too short to say anything are joined to
their neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from shapely.ops import substring

from probe2road.comparison.overlap import Counterparts, OverlapOptions, Roads, counterparts, seen_from
from probe2road.graph.roadgraph import graph_from_lines
from probe2road.metrics.network import Network, locate, network_from_graph
from probe2road.metrics.projection import direction_over, project_along

__all__ = ["Mutual", "mutual", "pieces"]

_BACK = 12.0  # m along a road, within which a place that is looked up from the other map must come back
_AGAIN = 15.0  # m to a road that is left of the other map, at most
_SOME = 0.1  # share of the traversals in one direction, from which on a road is looked up in it


@dataclass(frozen=True, eq=False)
class Mutual:
    """What two maps say of each other; the places of a map are the same in both directions.

    Attributes
    ----------
    found
        Lookups of the places of a map along its lines, and against them.
    has
        Shape (S,) each: whether that lookup is mutual; False where nobody drives that way.
    """

    found: tuple[Counterparts, Counterparts]
    has: tuple[NDArray[np.bool_], NDArray[np.bool_]]

    @property
    def matched(self) -> NDArray[np.bool_]:
        """Return whether each place has a counterpart, shape (S,)."""
        return self.has[0] | self.has[1]

    @property
    def best(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the nearer counterpart of each place: the row of its edge (-1: none), the offset, the distance."""
        ahead, back = self.found
        distances = np.stack(
            [np.where(has, one.distance, np.inf) for one, has in zip(self.found, self.has, strict=True)]
        )
        first = distances[0] <= distances[1]
        other = np.where(first, ahead.other, back.other)
        offset = np.where(first, ahead.other_offset, back.other_offset)
        distance = distances.min(axis=0)
        return np.where(self.matched, other, -1), offset, np.where(self.matched, distance, np.nan)


def mutual(ours: Roads, theirs: Roads, options: OverlapOptions) -> tuple[Mutual, Mutual]:
    """Look up two maps on each other: what ours says of theirs, and what theirs says of ours.

    Examples
    --------
    The map has one carriageway of a street, of which we have both:

    >>> import pandas as pd
    >>> from probe2road.comparison.overlap import roads_of
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> oneway = {"crs": "EPSG:32616", "attributes": pd.DataFrame({"oneway": ["yes", "yes"]})}
    >>> ours = roads_of(graph_from_lines([[(0, 0), (200, 0)], [(200, 11), (0, 11)]], **oneway))
    >>> theirs = roads_of(graph_from_lines([[(0, 1), (200, 1)]], **oneway))
    >>> found, _ = mutual(ours, theirs, OverlapOptions())
    >>> [bool(found.matched[found.found[0].edge == edge].all()) for edge in (0, 1)]
    [True, False]
    """
    maps = (ours, theirs)
    looked = [[counterparts(maps[i], maps[1 - i], options, way=way) for way in (1, -1)] for i in (0, 1)]
    ways = [_driven_ways(roads) for roads in maps]
    has = _both_ways(looked, ways, maps, options)
    unmatched = [~(ahead | back) for ahead, back in has]
    rests = [_rest(maps[i], looked[i][0], unmatched[i]) for i in (0, 1)]
    known = [_pairs(looked[i], has[i]) for i in (0, 1)]
    again = [_looked_up_again(maps[i], looked[i][0], unmatched[i], rests[1 - i], known[i], options) for i in (0, 1)]
    has_again = _both_ways([[one, one] for one in again], ways, maps, options)
    results = []
    for i in (0, 1):
        found = tuple(_filled(first, again[i], unmatched[i]) for first in looked[i])
        late = tuple(before | (now & unmatched[i]) for before, now in zip(has[i], has_again[i], strict=True))
        results.append(Mutual((found[0], found[1]), (late[0], late[1])))
    return results[0], results[1]


def _can_be(found: Counterparts, other: Roads, way: int, options: OverlapOptions) -> NDArray[np.bool_]:
    """Tell which counterparts can be true: a road that lies aside and is driven the other way is another road."""
    there = other.sense[np.maximum(found.other, 0)] * np.where(found.along, way, -way)
    return (found.other >= 0) & ~((there < 0) & (found.distance > options.against))


@dataclass(frozen=True, eq=False)
class _Rest:
    """The stretches of a map that have no counterpart yet: their lines, and where they are."""

    network: Network
    edge: NDArray[np.int64]  # row of the edge that a stretch is of
    begin: NDArray[np.float64]  # m along it


def _both_ways(
    looked: Sequence[Sequence[Counterparts]],
    ways: Sequence[tuple[NDArray[np.bool_], NDArray[np.bool_]]],
    maps: Sequence[Roads],
    options: OverlapOptions,
) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Tell of each map which places have a mutual counterpart, along the lines and against them."""
    used = [
        [
            ways[i][way][looked[i][way].edge] & _can_be(looked[i][way], maps[1 - i], 1 - 2 * way, options)
            for way in (0, 1)
        ]
        for i in (0, 1)
    ]
    has = [[used[i][way] & _comes_back(looked[i][way], looked[1 - i], used[1 - i]) for way in (0, 1)] for i in (0, 1)]
    return [(ahead, back) for ahead, back in has]


def _rest(roads: Roads, places: Counterparts, unmatched: NDArray[np.bool_]) -> _Rest:
    """Cut the stretches without a counterpart out of a map."""
    run = _runs(places.edge, unmatched)
    first = _firsts(run)
    last = np.append(first[1:], len(run)) - 1
    first, last = first[unmatched[first]], last[unmatched[first]]
    begin = places.offset[first] - places.metres[first] / 2
    end = places.offset[last] + places.metres[last] / 2
    edge = places.edge[first]
    kept = end - begin > 1.0
    edge, begin, end = edge[kept], begin[kept], end[kept]
    lines = [substring(roads.network.lines[row], low, high) for row, low, high in zip(edge, begin, end, strict=True)]
    return _Rest(network_from_graph(graph_from_lines(lines, crs=roads.graph.crs)), edge, begin)


def _pairs(looked: Sequence[Counterparts], has: Sequence[NDArray[np.bool_]]) -> pd.MultiIndex:
    """Return the pairs of edges that have places in common."""
    pairs = [(found.edge[on], found.other[on]) for found, on in zip(looked, has, strict=True)]
    return pd.MultiIndex.from_arrays([np.concatenate(side) for side in zip(*pairs, strict=True)]).unique()


def _looked_up_again(
    roads: Roads,
    places: Counterparts,
    unmatched: NDArray[np.bool_],
    rest: _Rest,
    known: pd.MultiIndex,
    options: OverlapOptions,
) -> Counterparts:
    """Look up the places without a counterpart on what is left of the other map, whichever way it is driven.

    It has to be nearer than in the first lookup, but for pairs of edges that were found to be the same road elsewhere.
    """
    rows = np.flatnonzero(unmatched)
    edge, offset = places.edge[rows], places.offset[rows]
    xy, _ = locate(roads.network, edge, offset)
    direction = direction_over(roads.network, edge, offset, options.span)
    stretch, at = project_along(
        xy, direction, rest.network, radius=options.radius, max_angle=options.max_angle, span=options.span
    )
    on = np.flatnonzero(stretch >= 0)
    away, runs_along = seen_from(xy[on], direction[on], rest.network, stretch[on], at[on], options.span)
    same = pd.MultiIndex.from_arrays([edge[on], rest.edge[stretch[on]]]).isin(known)
    kept = same | (away <= _AGAIN)
    on, away, runs_along = on[kept], away[kept], runs_along[kept]
    n = len(places.edge)
    other, other_offset = np.full(n, -1, np.int64), np.zeros(n)
    distance, along = np.full(n, np.nan), np.zeros(n, bool)
    other[rows[on]] = rest.edge[stretch[on]]
    other_offset[rows[on]] = rest.begin[stretch[on]] + at[on]
    distance[rows[on]], along[rows[on]] = away, runs_along
    return replace(places, other=other, other_offset=other_offset, distance=distance, along=along)


def _filled(first: Counterparts, again: Counterparts, unmatched: NDArray[np.bool_]) -> Counterparts:
    """Return the second lookup in the place of the first one where that was not mutual."""
    names = ("other", "other_offset", "distance", "along")
    return replace(first, **{name: np.where(unmatched, getattr(again, name), getattr(first, name)) for name in names})


def _driven_ways(roads: Roads) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which edges are driven along their line, and which against it, shape (E,) each.

    Counts tell it where there are any; else what is allowed.
    """
    edges = roads.graph.edges
    ahead, back = (edges[name].to_numpy(np.float64, na_value=0.0) for name in ("forward", "backward"))
    some = ahead + back > 0
    return (
        np.where(some, ahead >= _SOME * (ahead + back), roads.sense >= 0),
        np.where(some, back >= _SOME * (ahead + back), roads.sense <= 0),
    )


def _comes_back(
    places: Counterparts, back: Sequence[Counterparts], used: Sequence[NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """Tell of each place whether a lookup from its counterpart leads to it."""
    hit = np.concatenate([one.other[on] for one, on in zip(back, used, strict=True)])
    offset = np.concatenate([one.other_offset[on] for one, on in zip(back, used, strict=True)])
    source = np.concatenate([one.edge[on] for one, on in zip(back, used, strict=True)])
    hits = pd.DataFrame({"edge": hit, "other": source, "at": offset}).sort_values("at")
    asked = pd.DataFrame(
        {"edge": places.edge, "other": places.other, "at": places.offset, "row": np.arange(len(places.edge))}
    )
    near = pd.merge_asof(
        asked.sort_values("at"),
        hits.assign(hit=True),
        on="at",
        by=["edge", "other"],
        direction="nearest",
        tolerance=_BACK,
    )
    result = np.zeros(len(places.edge), bool)
    result[near["row"]] = near["hit"].notna()
    return result


def pieces(found: Mutual, length: NDArray[np.float64], *, shortest: float) -> pd.DataFrame:
    """Cut the edges of a map where their counterparts begin and end.

    Parameters
    ----------
    found
        What is known of the places of the map.
    length
        Shape (E,): of its edges, metres.
    shortest
        Metres; a run that is shorter is joined to the runs beside it.

    Returns
    -------
    DataFrame
        One row for each piece, in the order of the edges: ``edge`` (row), ``begin`` and ``end`` (m along it),
        ``matched``, ``other`` (row of the edge that most of it lies on; -1: none), ``distance`` (median, m) and
        ``other_begin``, ``other_end`` (m along that edge).
    """
    places = found.found[0]
    matched = found.matched.copy()
    for value in (False, True):
        run = _runs(places.edge, matched)
        size = np.bincount(run, weights=places.metres)
        alone = np.bincount(run, minlength=len(size)) == np.bincount(places.edge)[places.edge[_firsts(run)]]
        short = (size < shortest) & ~alone
        matched ^= short[run] & (matched == value)
    run = _runs(places.edge, matched)
    other, offset, distance = found.best
    table = pd.DataFrame(
        {"run": run, "edge": places.edge, "matched": matched, "other": other, "offset": offset, "distance": distance}
    )
    table["begin"], table["end"] = places.offset - places.metres / 2, places.offset + places.metres / 2
    whole = table.groupby("run").agg(
        edge=("edge", "first"),
        begin=("begin", "first"),
        end=("end", "last"),
        matched=("matched", "first"),
        distance=("distance", "median"),
    )
    on = table[table["other"] >= 0]
    most = (
        on.groupby(["run", "other"])
        .size()
        .rename("n")
        .reset_index()
        .sort_values(["run", "n", "other"], ascending=[True, False, True])
    )
    whole["other"] = (
        most.drop_duplicates("run").set_index("run")["other"].reindex(whole.index).fillna(-1).astype("int64")
    )
    own = on[on["other"] == on["run"].map(whole["other"])].groupby("run")["offset"]
    whole["other_begin"], whole["other_end"] = own.min().reindex(whole.index), own.max().reindex(whole.index)
    whole["end"] = np.where(whole["end"] > length[whole["edge"]] - 1e-6, length[whole["edge"]], whole["end"])
    return whole.reset_index(drop=True)


def _runs(edge: NDArray[np.int64], matched: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Give runs of equal values within an edge one number: 0, 1, and so on."""
    new = np.ones(len(edge), bool)
    new[1:] = (edge[1:] != edge[:-1]) | (matched[1:] != matched[:-1])
    return np.cumsum(new) - 1


def _firsts(run: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the first row of each run."""
    return np.flatnonzero(np.diff(run, prepend=-1))
