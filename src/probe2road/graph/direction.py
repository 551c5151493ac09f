"""The driving direction of edges: from the words of tags and columns, and from the counts of drives.

Strategy: a column ``oneway`` from a map or a sign comes first, in the words of OpenStreetMap or of GIS files. Without
it, the counts of drives decide: three models (one-way, one-way the other way, both ways) explain the traversals in the
two directions, and the most probable model is taken if it is certain enough. Refinement does this once and writes the
result into ``oneway``; for a graph that has only counts, the same rule is applied at every call.

A one-way edge is stored in its driving direction: `in_driving_direction` reverses edges that are not.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.special import betaln

from probe2road.bounds import Positive, Probability
from probe2road.options import checked

__all__ = [
    "DIRECTION_TAGS",
    "ONEWAY_TAGS",
    "ONEWAY_WORDS",
    "WAYS",
    "DirectionOptions",
    "counted_direction",
    "driving_direction",
    "in_driving_direction",
    "oneway_probabilities",
    "tagged_direction",
    "told_direction",
    "turned",
]

WAYS = (1, -1, 0)  # from u to v only, from v to u only, both: the columns of `oneway_probabilities`
ONEWAY_TAGS = {1: "yes", -1: "-1", 0: "no"}  # the words of OpenStreetMap for them
ONEWAY_WORDS = {
    **{"yes": 1, "true": 1, "1": 1, "1.0": 1},
    **{"-1": -1, "-1.0": -1, "reverse": -1},
    **{"no": 0, "false": 0, "0": 0, "0.0": 0},
    **{"reversible": 0, "alternating": 0},  # one direction at a time, and the other at another time
    **{"f": 1, "t": -1, "b": 0},  # extracts of OSM for GIS: from, to, both
    **{"ft": 1, "tf": -1},  # GIS networks: from-to, to-from
}  # words that are read, in lower case

DIRECTION_TAGS = ("oneway", "highway", "junction")  # tags that say which way a way of OpenStreetMap may be driven
_IMPLYING_CLASSES = ("motorway", "motorway_link")
_IMPLYING_JUNCTIONS = ("roundabout", "circular")
_TURNED_LETTERS = {"t": "F", "tf": "FT"}
_SIDES = {"forward": "backward", "backward": "forward", "left": "right", "right": "left"}
_SIDE = re.compile(rf"(?<![a-z])({'|'.join(_SIDES)})(?![a-z])")


@dataclass(frozen=True)
@checked
class DirectionOptions:
    """When counts make an edge one-way, or open in both directions."""

    min_confidence: Probability = 0.9  # probability from which the counts decide
    wrong_way: Probability = 0.02  # share of traversals of a one-way road that are matched the wrong way
    imbalance: Positive[float] = 2.0  # a of Beta(a, a), the distribution of the share of one direction on two-way roads
    oneway_share: Probability = 0.5  # prior share of edges that are one-way


def told_direction(oneway: pd.Series) -> pd.Series:
    """Read the values of a column ``oneway``: 1 along the line, -1 against it, 0 for both directions.

    Upper and lower case are alike, numbers and flags are read like their text. A word that is not in `ONEWAY_WORDS`
    says nothing.

    Parameters
    ----------
    oneway
        Text, numbers or flags.

    Returns
    -------
    Series of Int64
        NA where nothing is said.

    Examples
    --------
    >>> told_direction(pd.Series(["Yes", "-1", "reversible", "TF", "perhaps", None])).tolist()
    [1, -1, 0, -1, <NA>, <NA>]
    >>> told_direction(pd.Series([True, False])).tolist(), told_direction(pd.Series([1.0, float("nan")])).tolist()
    ([1, 0], [1, <NA>])
    """
    words = oneway.astype("str").str.strip().str.lower()
    return words.map(ONEWAY_WORDS).astype("Int64")


def tagged_direction(tags: pd.DataFrame) -> pd.Series:
    """Return the driving direction of ways of OpenStreetMap, from their tags.

    Where ``oneway`` says nothing, motorways, their links and roundabouts are one-way as drawn. For motorway links
    this is what routers do, and how most are mapped.

    Parameters
    ----------
    tags
        One row for each way, with any of `DIRECTION_TAGS` as columns.

    Returns
    -------
    Series of Int64
        1 as drawn, -1 against it, 0 both ways, NA where the tags say nothing.

    Examples
    --------
    >>> tags = pd.DataFrame({"highway": ["motorway", "motorway", "primary"], "oneway": [None, "no", None]})
    >>> tagged_direction(tags).tolist()
    [1, 0, <NA>]
    """
    tags = tags.reindex(columns=list(DIRECTION_TAGS))
    implied = tags["highway"].isin(_IMPLYING_CLASSES) | tags["junction"].isin(_IMPLYING_JUNCTIONS)
    return told_direction(tags["oneway"]).mask(lambda told: told.isna() & implied, 1)


def oneway_probabilities(
    forward: NDArray[np.float64], backward: NDArray[np.float64], *, options: DirectionOptions | None = None
) -> NDArray[np.float64]:
    """Return the probabilities that edges are one-way from u to v, one-way from v to u, or open in both directions.

    Bayes' law for three models of how traversals fall on the two directions: all but a few wrongly matched ones on
    one, or on both in a share that follows a Beta distribution.

    Parameters
    ----------
    forward, backward
        Shape (n,): traversals.
    options
        ``wrong_way``, ``imbalance``, ``oneway_share``.

    Returns
    -------
    ndarray, shape (n, 3)

    Examples
    --------
    >>> oneway_probabilities(np.array([0.0, 9, 9]), np.array([0.0, 0, 4])).round(2).tolist()
    [[0.25, 0.25, 0.5], [0.9, 0.0, 0.1], [0.01, 0.0, 0.99]]
    """
    options = options or DirectionOptions()
    wrong = 1.0 / options.wrong_way - 1.0  # b of Beta(1, b), whose mean is the share
    even = options.imbalance
    log = np.stack(
        [
            np.log(options.oneway_share / 2) + betaln(forward + wrong, backward + 1.0) - betaln(wrong, 1.0),
            np.log(options.oneway_share / 2) + betaln(forward + 1.0, backward + wrong) - betaln(1.0, wrong),
            np.log(1 - options.oneway_share) + betaln(forward + even, backward + even) - betaln(even, even),
        ],
        axis=-1,
    )
    likelihood = np.exp(log - log.max(axis=-1, keepdims=True))
    return likelihood / likelihood.sum(axis=-1, keepdims=True)


def counted_direction(edges: pd.DataFrame, *, options: DirectionOptions | None = None) -> pd.Series:
    """Return the driving direction of edges from their counts alone, if the counts are certain enough.

    Parameters
    ----------
    edges
        With ``forward`` and ``backward``; missing counts are none.
    options
        None takes the defaults: nine drives one way, and none the other, make an edge one-way.

    Returns
    -------
    Series of Int64, indexed like the edges
        1, -1 or 0 as in `driving_direction`; NA where the counts leave it open.

    Examples
    --------
    >>> counted_direction(pd.DataFrame({"forward": [9, 8, 40, 0, 3], "backward": [0, 0, 1, 9, 3]})).tolist()
    [1, <NA>, 1, -1, 0]
    """
    options = options or DirectionOptions()
    forward, backward = (edges[name].to_numpy(np.float64, na_value=0.0) for name in ("forward", "backward"))
    probability = oneway_probabilities(forward, backward, options=options)
    best = pd.Series(np.array(WAYS)[probability.argmax(axis=1)], index=edges.index, dtype="Int64")
    return best.mask((probability.max(axis=1) < options.min_confidence) | (forward + backward == 0))


def driving_direction(edges: pd.DataFrame, *, options: DirectionOptions | None = None) -> pd.Series:
    """Return the driving direction of each edge: 1 from u to v only, -1 from v to u only, 0 for both.

    The column ``oneway`` decides where it says something (see `told_direction`): it holds what a map says, or what
    `probe2road.refinement.evidence` made of the drives. An edge whose drives were weighed there (it has a value of
    ``oneway_confidence``) but whose ``oneway`` was left open is open both ways. For all others the counts decide
    (`counted_direction`), and where they are too few the edge is open both ways.

    Parameters
    ----------
    edges
        Edge table of a graph.
    options
        When counts decide; None takes the defaults.

    Returns
    -------
    Series of int64, indexed like the edges

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> edges = graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 9)], [(9, 9), (0, 0)]], crs="EPSG:32616").edges
    >>> edges = edges.assign(forward=[12, 0, 2], backward=[0, 9, 0])
    >>> driving_direction(edges).tolist()
    [1, -1, 0]
    >>> driving_direction(edges.assign(oneway=["no", None, "yes"])).tolist()
    [0, -1, 1]
    """
    direction = counted_direction(edges, options=options)
    if "oneway_confidence" in edges:
        direction = direction.mask(edges["oneway_confidence"].notna())
    if "oneway" in edges:
        direction = told_direction(edges["oneway"]).fillna(direction)
    return direction.fillna(0).astype("int64").rename("direction")


def in_driving_direction(edges: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Reverse the edges that are open from v to u only, so that every one-way edge has its driving direction.

    Of a turned edge ``u`` and ``v`` change places, the line runs the other way, and so do the values of columns that
    come in pairs (``forward`` and ``backward``, ``lanes:left`` and ``lanes:right``); ``oneway`` says ``yes``, or 1
    where it is a number. Ids, keys, heights and turns stay: turns name edges and nodes. Matches made before do not fit
    any more, because they say where on the line a fix lies. A table without such edges is returned as it is.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> edges = graph_from_lines([[(0, 0), (9, 0)]], crs="EPSG:32616").edges.assign(oneway="-1")
    >>> turned = in_driving_direction(edges)
    >>> turned[["u", "v", "oneway"]].values.tolist(), str(turned.geometry[0])
    ([[1, 0, 'yes']], 'LINESTRING (9 0, 0 0)')
    """
    against = (driving_direction(edges) == -1).to_numpy()
    return turned(edges, against) if against.any() else edges


def turned(edges: gpd.GeoDataFrame, rows: NDArray[np.bool_]) -> gpd.GeoDataFrame:
    """Reverse some edges: their ends, lines and the columns of their sides, as `in_driving_direction` does.

    Parameters
    ----------
    edges
        Edge table. Edges that are open from v to u only must be among those that are turned.
    rows
        Shape (E,): which edges.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> edges = graph_from_lines([[(0, 0), (9, 0)]], crs="EPSG:32616").edges.assign(forward=4, backward=1)
    >>> turned(edges, np.array([True]))[["u", "v", "forward", "backward"]].values.tolist()
    [[1, 0, 1, 4]]
    """
    lines = edges.geometry.to_numpy().copy()
    lines[rows] = shapely.reverse(lines[rows])
    opposite = {name: _other_side(name) for name in edges if isinstance(name, str)} | {"u": "v", "v": "u"}
    swapped: dict[str, Any] = {
        name: edges[name].mask(rows, edges[other])
        for name, other in opposite.items()
        if other != name and other in edges
    }
    if "oneway" in edges:
        swapped["oneway"] = _turned_words(edges["oneway"])
    return edges.assign(**swapped).set_geometry(lines, crs=edges.crs)


def _other_side(name: str) -> str:
    """Return the name of the column that holds the same property for the other direction, or side, of a line."""
    return _SIDE.sub(lambda side: _SIDES[side[0]], name)


def _turned_words(oneway: pd.Series) -> pd.Series:
    """Replace the word for "against the line" by the word for "along the line", in the vocabulary of the column."""
    against = (told_direction(oneway) == -1).fillna(False).to_numpy(bool)
    if pd.api.types.is_numeric_dtype(oneway.dtype):
        return oneway.mask(against, 1)
    words = oneway.astype("str").str.strip().str.lower()
    return oneway.mask(against, words.map(_TURNED_LETTERS).astype(object).fillna(ONEWAY_TAGS[1]))
