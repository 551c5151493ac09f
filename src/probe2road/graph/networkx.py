"""The tables of a road graph as a NetworkX graph in the form of OSMnx."""

from __future__ import annotations

from typing import Any

import geopandas as gpd
import networkx as nx
import pandas as pd
import shapely

from probe2road.crs import WGS84, crs_to_text, transform
from probe2road.graph.direction import driving_direction, in_driving_direction
from probe2road.graph.tables import degrees, edges_with_turns

__all__ = ["present", "to_networkx"]


def to_networkx(nodes: gpd.GeoDataFrame, edges: gpd.GeoDataFrame, turns: pd.DataFrame) -> nx.MultiDiGraph:
    """Return the tables of a graph as an OSMnx ``MultiDiGraph`` in the metric CRS.

    An edge that is open both ways becomes two directed edges, the second with ``reversed`` true, its geometry
    turned and its counts swapped; one-way edges become one, in the direction in which they are driven (see
    `probe2road.graph.direction`). Both carry the id in ``edge``. Missing values are left out. The result passes
    ``osmnx.convert.validate_graph``, unless it is empty, which OSMnx does not allow.

    Parameters
    ----------
    nodes, edges, turns
        Of a `probe2road.graph.roadgraph.RoadGraph`.

    Returns
    -------
    networkx.MultiDiGraph
        Nodes have ``x``, ``y`` (m), ``lon``, ``lat``, ``street_count``; edges ``osmid`` (the edge id where
        there is none), ``length`` (m), ``oneway``, ``reversed``, ``geometry`` and the columns of the graph,
        with the turns as text. A column ``oneway`` of the graph becomes ``oneway_tag``.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
    >>> directed = to_networkx(graph.nodes, graph.edges, graph.turns)
    >>> sorted((u, v, data["reversed"], data["length"]) for u, v, data in directed.edges(data=True))
    [(0, 1, False, 100.0), (1, 0, True, 100.0)]
    """
    result = nx.MultiDiGraph(crs=crs_to_text(edges.crs), created_with="probe2road")
    result.add_nodes_from(zip(nodes.index.tolist(), present(_with_positions(nodes, edges)), strict=True))

    edges = in_driving_direction(edges)
    two_way = (driving_direction(edges) == 0).to_numpy()
    edges = edges_with_turns(edges, turns)
    edges = edges.rename(columns={"oneway": "oneway_tag"})
    edges["osmid"] = edges["osmid"] if "osmid" in edges else edges["edge"]
    edges["oneway"] = ~two_way
    backward = edges.assign(
        reversed=True,
        geometry=shapely.reverse(edges.geometry.to_numpy()),
        forward=edges["backward"],
        backward=edges["forward"],
    ).rename(columns={"u": "v", "v": "u"})
    # Both directions of a loop join the same pair of nodes: the second needs another key.
    loop = (edges["u"] == edges["v"]).to_numpy() & two_way
    backward.loc[loop, "key"] += edges["key"].max() + 1 if loop.any() else 0
    for table in (edges.assign(reversed=False), backward[two_way]):
        ends = (table[name].tolist() for name in ("u", "v", "key"))
        attributes = present(pd.DataFrame(table.drop(columns=["u", "v", "key"])))
        result.add_edges_from(zip(*ends, attributes, strict=True))
    return result


def _with_positions(nodes: gpd.GeoDataFrame, edges: gpd.GeoDataFrame) -> pd.DataFrame:
    """Return the node table with the columns that OSMnx needs, instead of the geometry."""
    position = shapely.get_coordinates(nodes.geometry.to_numpy())
    lon, lat = transform(position[:, 0], position[:, 1], nodes.crs, WGS84)
    return pd.DataFrame(nodes.drop(columns="geometry")).assign(
        x=position[:, 0], y=position[:, 1], lon=lon, lat=lat, street_count=degrees(nodes, edges)
    )


def present(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows as dictionaries of Python values, without missing values."""
    columns = {str(name): table[name].astype(object).tolist() for name in table}
    there = {str(name): table[name].notna().tolist() for name in table}
    return [{name: columns[name][row] for name in columns if there[name][row]} for row in range(len(table))]
