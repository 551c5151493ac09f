"""The tables of a road graph: their columns, and how edge and turn tables are made to fit the contract.

This stands below `probe2road.graph.roadgraph`: functions here take and return tables, not graphs.
"""

from __future__ import annotations

from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

__all__ = [
    "EDGE_DTYPES",
    "ORIGINS",
    "TURNS_COLUMN",
    "TURN_DTYPES",
    "degrees",
    "edges_with_turns",
    "empty_turns",
    "finish_edges",
    "move_ends",
    "without_unknown_heights",
]


ORIGINS = ("segmentation", "gap", "reference")


EDGE_DTYPES = {
    "u": "int64",
    "v": "int64",
    "key": "int64",
    "length": "float64",  # m, in plan
    "origin": "str",  # one of ORIGINS
    "support": "Int64",  # distinct traces matched to the edge; NA where nothing was matched yet
    "score": "float64",  # mean centreline probability along the edge; NaN where unknown
    "forward": "Int64",  # traversals from u to v
    "backward": "Int64",  # traversals from v to u
}


TURN_DTYPES = {"from_edge": "int64", "via_node": "int64", "to_edge": "int64", "count": "int64"}


TURNS_COLUMN = "turns"


def edges_with_turns(edges: gpd.GeoDataFrame, turns: pd.DataFrame) -> gpd.GeoDataFrame:
    """Return the edges with their id as a column and their turns as text ``to_edge@via_node:count``.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> edges = graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 9)]], crs="EPSG:32616").edges
    >>> turns = pd.DataFrame({"from_edge": [0, 0], "via_node": [1, 1], "to_edge": [1, 0], "count": [5, 2]})
    >>> edges_with_turns(edges, turns)["turns"].tolist()
    ['1@1:5 0@1:2', nan]
    """
    edges = edges.reset_index()
    if turns.empty:
        return edges
    text = [f"{to}@{via}:{count}" for to, via, count in turns[["to_edge", "via_node", "count"]].to_numpy()]
    of_edge = pd.Series(text, dtype="str").groupby(turns["from_edge"].to_numpy()).agg(" ".join)
    return edges.assign(**{TURNS_COLUMN: edges["edge"].map(of_edge).astype("str")})


def degrees(nodes: gpd.GeoDataFrame, edges: gpd.GeoDataFrame) -> pd.Series:
    """Return the number of edge ends at every node, indexed like the nodes; a loop counts twice."""
    ends = pd.concat([edges["u"], edges["v"]]).value_counts()
    return ends.reindex(nodes.index, fill_value=0).rename("degree").astype("int64")


def finish_edges(edges: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Complete an edge table: keys and lengths are computed, missing columns filled, and types set.

    Needs ``u``, ``v`` and ``geometry``; the index becomes ``edge``. Further columns are kept, behind ours.
    """
    pair = pd.DataFrame({"low": edges[["u", "v"]].min(axis=1), "high": edges[["u", "v"]].max(axis=1)})
    filled = {"origin": "segmentation", "support": pd.NA, "score": np.nan, "forward": pd.NA, "backward": pd.NA}
    edges = edges.assign(
        key=pair.groupby(["low", "high"]).cumcount() if len(pair) else np.zeros(0, np.int64),
        length=shapely.length(edges.geometry.to_numpy()),
        **{column: value for column, value in filled.items() if column not in edges},
    )
    further = [column for column in edges if column not in EDGE_DTYPES and column != "geometry"]
    edges = edges[[*EDGE_DTYPES, *further, "geometry"]].astype(EDGE_DTYPES)
    edges.index = edges.index.astype("int64").rename("edge")
    return edges


def empty_turns() -> pd.DataFrame:
    """Return a turn table without rows."""
    return pd.DataFrame({column: pd.Series(dtype=dtype) for column, dtype in TURN_DTYPES.items()})


def move_ends(lines: NDArray[Any], first: NDArray[np.float64], last: NDArray[np.float64]) -> NDArray[Any]:
    """Move the end vertices of lines in plan, to positions of shape ``(n_lines, 2)``; heights stay."""
    has_z = bool(shapely.has_z(lines).any())
    coordinates, owner = shapely.get_coordinates(lines, include_z=has_z, return_index=True)
    heads = np.flatnonzero(np.diff(owner, prepend=-1))
    tails = np.append(heads[1:], len(owner)) - 1
    if len(lines):
        coordinates[heads, :2], coordinates[tails, :2] = first, last
    return without_unknown_heights(shapely.linestrings(coordinates, indices=owner))


def without_unknown_heights(lines: NDArray[Any]) -> NDArray[Any]:
    """Convert lines whose every height is NaN to two dimensions: a table with one geometry type has such lines."""
    if not shapely.has_z(lines).any():
        return lines
    coordinates, owner = shapely.get_coordinates(lines, include_z=True, return_index=True)
    known = np.zeros(len(lines), bool)
    known[owner[np.isfinite(coordinates[:, 2])]] = True
    return np.where(known, lines, shapely.force_2d(lines))
