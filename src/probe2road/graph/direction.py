"""Which way an edge may be driven: one rule for tags and for counts."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd

__all__ = ["driving_direction"]


def driving_direction(edges: gpd.GeoDataFrame, *, min_count: int = 5) -> pd.Series:
    """Say which way each edge may be driven: 1 from u to v only, -1 from v to u only, 0 both ways.

    A column ``oneway`` that came with the data (an OSM tag, or a flag) decides where it has a value. Where
    `probe2road.refinement.evidence` weighed the counts already (column ``oneway_confidence``) and left the value open,
    the edge is open both ways. Otherwise the counts decide: an edge that was driven ``min_count`` times or more, always
    the same way, is one-way. On a two-way road with even traffic, five traversals agree by chance once in sixteen
    times; where the counts are fewer or missing, the edge is open both ways.

    Parameters
    ----------
    edges
        Edge table of a graph.
    min_count
        Traversals needed to call an edge one-way.

    Returns
    -------
    Series of int64, indexed like the edges

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> edges = graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 9)], [(9, 9), (0, 0)]], crs="EPSG:32616").edges
    >>> driving_direction(edges.assign(forward=[7, 0, 2], backward=[0, 9, 0])).tolist()
    [1, -1, 0]
    """
    forward, backward = (edges[name].to_numpy(np.float64, na_value=0.0) for name in ("forward", "backward"))
    direction = pd.Series(0, index=edges.index, name="direction")
    if "oneway_confidence" not in edges:
        direction[(forward >= min_count) & (backward == 0)] = 1
        direction[(backward >= min_count) & (forward == 0)] = -1
    if "oneway" in edges:
        tag = edges["oneway"].astype("str").str.lower()
        for value, tags in (
            (1, ("yes", "true", "1", "1.0")),
            (-1, ("-1", "-1.0", "reverse")),
            (0, ("no", "false", "0")),
        ):
            direction[tag.isin(tags)] = value
    return direction
