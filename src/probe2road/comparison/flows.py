"""What drives say of the roads of another map: traversals of its edges in both directions."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.comparison.mutual import Mutual
from probe2road.comparison.overlap import Roads
from probe2road.errors import InputError

__all__ = ["base_flows", "require_counts"]


def require_counts(roads: Roads, *, where: str) -> None:
    """Refuse a graph whose edges have no counts of drives.

    Raises
    ------
    InputError
        If there are none.
    """
    edges = roads.graph.edges
    if edges[["support", "forward", "backward"]].isna().all(axis=None):
        raise InputError(
            "the graph has no counts of drives", where=where, fix="use a graph that is built with refinement"
        )


def base_flows(ours: Roads, theirs: Roads, found: Mutual, back: Mutual) -> pd.DataFrame:
    """Return the traversals of every edge of a base map, as our counts give them.

    The counts of our edges are brought to the base road on which each place of theirs lies, in each direction for
    itself: one line of ours may stand for two carriageways, and two lines of ours for one street of the base. A one-way
    road of the base gets counts only from lines that are its nearest: others belong to a carriageway that is not there.

    Parameters
    ----------
    ours, theirs
        The graph with counts, and the base map.
    found, back
        Our places, looked up on the base, and those of the base.

    Returns
    -------
    DataFrame, indexed by the rows of the base's edges
        ``along`` and ``against``, traversals; ``support``, distinct traces; ``covered``, the share of the edge that
        they were seen on; ``nearest``, the share to which one of our lines is nearer than to any other of its roads.
    """
    edges = ours.graph.edges
    counts = [edges[name].to_numpy(np.float64, na_value=0.0) for name in ("forward", "backward", "support")]
    n = len(theirs.sense)
    total: dict[str, NDArray[np.float64]] = {name: np.zeros(n) for name in ("along", "against", "support")}
    metres: dict[str, NDArray[np.float64]] = {name: np.zeros(n) for name in ("along", "against", "any")}
    nearest = pd.MultiIndex.from_arrays([back.best[0], back.found[0].edge]).unique()  # our edge, and theirs
    for way, count in ((0, counts[0]), (1, counts[1])):
        places, has = found.found[way], found.has[way]
        driven = has & (count[places.edge] > 0)
        own = pd.MultiIndex.from_arrays([places.edge, places.other]).isin(nearest)
        driven &= own | (theirs.sense[np.maximum(places.other, 0)] == 0)
        for name, goes in (("along", places.along != (way == 1)), ("against", places.along == (way == 1))):
            rows = np.flatnonzero(driven & goes)
            to, size = places.other[rows], places.metres[rows]
            np.add.at(total[name], to, size * count[places.edge[rows]])
            np.add.at(metres[name], to, size)
    best, _, _ = found.best
    on = np.flatnonzero(best >= 0)
    places = found.found[0]
    np.add.at(total["support"], best[on], places.metres[on] * counts[2][places.edge[on]])
    np.add.at(metres["any"], best[on], places.metres[on])
    length = theirs.network.length
    # Traversals per metre of the road that was seen: of two lines of ours on one of the base, both count.
    seen = np.clip(np.maximum(metres["along"], metres["against"]), 1e-9, length)
    return pd.DataFrame(
        {
            "along": total["along"] / seen,
            "against": total["against"] / seen,
            "support": total["support"] / np.clip(metres["any"], 1e-9, length),
            "nearest": np.clip(metres["any"] / length, 0.0, 1.0),
            "covered": np.clip(np.maximum(metres["along"], metres["against"]) / length, 0.0, 1.0),
        }
    )
