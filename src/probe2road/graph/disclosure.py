"""Disclosure: what a road graph reveals about single vehicles, and how to leave it out."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pandas as pd

from probe2road.errors import InputError, OptionError
from probe2road.graph.roadgraph import RoadGraph

__all__ = ["withhold"]

logger = logging.getLogger(__name__)


def withhold(graph: RoadGraph, *, min_vehicles: int = 1, min_drives: int = 1) -> RoadGraph:
    """Remove the edges that only few vehicles or drives support, before a graph is passed on.

    An edge goes with all that is said of it: its line, speed and counts, the turns onto it and off it, and nodes that
    only such edges have. Turns that were driven fewer than ``min_drives`` or ``min_vehicles`` times go as well. What
    was read from a map, of origin ``reference`` and without counts, stays.

    Parameters
    ----------
    graph
        A graph with counts.
    min_vehicles
        Distinct vehicles that an edge needs; 1 keeps what no vehicle drove, too.
    min_drives
        Distinct drives that an edge needs, likewise.

    Returns
    -------
    RoadGraph
        Ids of nodes and edges stay.

    Raises
    ------
    OptionError
        If a number is below 1.
    InputError
        If the graph has no such counts: because nothing was matched, or because the fleet names no vehicles.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> counts = pd.DataFrame({"drive_support": pd.array([7, 1], "Int64")})
    >>> graph = graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 9)]], crs="EPSG:32616", attributes=counts)
    >>> withhold(graph, min_drives=3).edges["drive_support"].tolist()
    [7]
    """
    least = {"min_vehicles": min_vehicles, "min_drives": min_drives}
    for name, value in least.items():
        if value < 1:
            raise OptionError(f"{name} is {value}", where="withhold", fix="use 1 or more")
    if max(least.values()) == 1:
        return graph
    counted = graph.edges["support"].notna() | (graph.edges["origin"] != "reference")
    kept = np.ones(len(graph.edges), bool)
    if min_vehicles > 1:
        kept &= (
            _support(graph, counted, "vehicle_support", "the fleet names no vehicles: use min_drives") >= min_vehicles
        )
    if min_drives > 1:
        kept &= _support(graph, counted, "drive_support", "build it with refine=True") >= min_drives
    kept |= ~counted.to_numpy()
    edges = graph.edges[kept]
    turns = graph.turns
    stays = turns["from_edge"].isin(edges.index) & turns["to_edge"].isin(edges.index)
    stays &= turns["count"] >= max(least.values())
    nodes = graph.nodes[graph.nodes.index.isin(edges[["u", "v"]].to_numpy().ravel())]
    logger.info("withheld %d of %d edges, which too few stand behind", int((~kept).sum()), len(kept))
    return replace(graph, nodes=nodes, edges=edges, turns=turns[stays].reset_index(drop=True))


def _support(graph: RoadGraph, counted: pd.Series, column: str, fix: str) -> np.ndarray:
    """Return the support of every edge, 0 if it has none; refuse a graph without support."""
    if column not in graph.edges:
        column = "support" if column == "drive_support" else column
    if column not in graph.edges or (counted.any() and graph.edges.loc[counted, column].isna().all()):
        raise InputError(f"the edges have no {column}", where="withhold", fix=fix)
    return graph.edges[column].fillna(0).to_numpy(np.int64)
