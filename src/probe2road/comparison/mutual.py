"""Two maps of the same roads looked up on each other, and the stretches that only one of them has.

Strategy. Every place of a road is looked up on the other map in each direction in which it is driven. It has a
counterpart only if that is mutual: if places of the other road, looked up in turn, come back to within some metres.
Otherwise the second carriageway of a street whose first one alone is mapped, or a track beside a motorway, would be
taken for the nearest road within the radius. Runs of places with and without a counterpart are the pieces of a road;
runs that are too short to say anything are joined to their neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.comparison.overlap import Counterparts, OverlapOptions, Roads, counterparts

__all__ = ["Mutual", "mutual", "pieces"]

_BACK = 12.0  # m along a road, within which a place that is looked up from the other map must come back
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
    looked = [
        tuple(counterparts(one, other, options, way=way) for way in (1, -1))
        for one, other in ((ours, theirs), (theirs, ours))
    ]
    driven = [_driven_ways(roads) for roads in (ours, theirs)]
    used = [
        tuple(ways[way][found[way].edge] & (found[way].other >= 0) for way in (0, 1))
        for ways, found in zip(driven, looked, strict=True)
    ]
    return tuple(
        Mutual(
            looked[i], tuple(used[i][way] & _comes_back(looked[i][way], looked[1 - i], used[1 - i]) for way in (0, 1))
        )
        for i in (0, 1)
    )  # type: ignore[return-value]


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
    places: Counterparts, back: tuple[Counterparts, ...], used: tuple[NDArray[np.bool_], ...]
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
