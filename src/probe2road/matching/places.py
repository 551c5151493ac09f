"""Matches on the map: the position of every fix on its edge, and one line for every trip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.tables import step_rows

if TYPE_CHECKING:
    from probe2road.matching.match import Matches

__all__ = ["matched_edges", "matched_points", "trip_lines"]

_MAP_ID = "osmid"  # of the way that an edge is part of, where the graph is read from OpenStreetMap


def matched_points(matches: Matches, graph: RoadGraph) -> gpd.GeoDataFrame:
    """Return the fixes of `Matches`, with their position on the edge as geometry; it is missing without an edge.

    Edges of a graph from OpenStreetMap are named by ``osmid``, too, the id of their way.

    Raises
    ------
    InputError
        If a match names an edge that is not in the graph.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> from probe2road.matching.match import match
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 80)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(3), "x": [20.0, 60, 101], "y": [1.0, 0, 30]})
    >>> found = match(graph, fleet_from_tables(table, crs="EPSG:32616", keep_crs=True))
    >>> [str(point) for point in matched_points(found, graph).geometry]
    ['POINT (20 0)', 'POINT (60 0)', 'POINT (100 30)']
    """
    fixes = matches.fixes
    on = fixes["edge"].notna().to_numpy()
    rows = step_rows(graph, fixes[on], where="matched_points")
    places = np.full(len(fixes), None, dtype=object)
    lines = shapely.force_2d(graph.edges.geometry.to_numpy()[rows])
    places[on] = shapely.line_interpolate_point(lines, fixes["offset"].to_numpy()[on])
    return gpd.GeoDataFrame(_with_map_id(fixes, graph, on, rows), geometry=places, crs=graph.crs)


def matched_edges(matches: Matches, graph: RoadGraph) -> gpd.GeoDataFrame:
    """Return the steps of `Matches`, with the line of the edge in driving direction as geometry."""
    rows = step_rows(graph, matches.steps, where="matched_edges")
    table = _with_map_id(matches.steps, graph, np.ones(len(rows), bool), rows)
    return gpd.GeoDataFrame(table, geometry=_driven_lines(matches, graph), crs=graph.crs)


def trip_lines(matches: Matches, graph: RoadGraph) -> gpd.GeoDataFrame:
    """Return one row for every matched trace: the line along the edges from its first to its last fix.

    A path that breaks, where the trace left the network or jumped, is a line of several parts.

    Returns
    -------
    GeoDataFrame
        ``trace_id``, ``t_first``, ``t_last``, ``edges`` (how often one was entered), ``parts``, ``length`` (m), and
        the line.

    Raises
    ------
    InputError
        If a match names an edge that is not in the graph.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> from probe2road.matching.match import match
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 80)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(3), "x": [20.0, 60, 101], "y": [1.0, 0, 30]})
    >>> found = match(graph, fleet_from_tables(table, crs="EPSG:32616", keep_crs=True))
    >>> trip_lines(found, graph).geometry.iloc[0].wkt
    'LINESTRING (20 0, 100 0, 100 30)'
    """
    steps = matches.steps.reset_index(drop=True)
    lines = _cut_at_fixes(matches, graph)
    new = (steps[["trace_id", "part"]] != steps[["trace_id", "part"]].shift()).any(axis=1).to_numpy()
    part = np.cumsum(new) - 1
    joined = _joined(lines, part, int(new.sum()))
    of_part = steps[new].assign(line=joined)
    trips = steps.groupby("trace_id", sort=False)
    table = pd.DataFrame(
        {
            "t_first": trips["t_first"].min(),
            "t_last": trips["t_last"].max(),
            "edges": trips.size(),
            "parts": of_part.groupby("trace_id", sort=False).size(),
        }
    ).reset_index()
    geometry = [
        found[0] if len(found) == 1 else shapely.MultiLineString(list(found))
        for found in (group.to_numpy() for _, group in of_part.groupby("trace_id", sort=False)["line"])
    ]
    table["length"] = shapely.length(np.array(geometry, dtype=object)) if geometry else np.zeros(0)
    return gpd.GeoDataFrame(table, geometry=geometry, crs=graph.crs)


def _with_map_id(table: pd.DataFrame, graph: RoadGraph, on: NDArray[np.bool_], rows: NDArray[np.int64]) -> pd.DataFrame:
    """Add the id of each edge in the original map, if it has one."""
    if _MAP_ID not in graph.edges:
        return table
    ids = pd.Series(None, index=table.index, name=_MAP_ID, dtype=object)
    ids[on] = graph.edges[_MAP_ID].to_numpy()[rows]
    place = table.columns.get_loc("edge") + 1
    return pd.concat([table.iloc[:, :place], ids.convert_dtypes(), table.iloc[:, place:]], axis=1)


def _driven_lines(matches: Matches, graph: RoadGraph) -> NDArray[Any]:
    """Return the line of every step, in plan and in driving direction."""
    rows = step_rows(graph, matches.steps, where="matches")
    lines = shapely.force_2d(graph.edges.geometry.to_numpy()[rows])
    forward = matches.steps["forward"].to_numpy(bool)
    return np.asarray(np.where(forward, lines, shapely.reverse(lines)), dtype=object)


def _cut_at_fixes(matches: Matches, graph: RoadGraph) -> NDArray[Any]:
    """Cut the first line of every part at its first fix, and the last line at its last fix."""
    steps, lines = matches.steps.reset_index(drop=True), _driven_lines(matches, graph)
    on = matches.fixes[matches.fixes["edge"].notna()]
    offset = on.drop_duplicates(["trace_id", "t"]).set_index(["trace_id", "t"])["offset"]
    length = shapely.length(lines)
    whole = np.column_stack([np.zeros(len(lines)), length])
    for side, (flag, time) in enumerate((("entered", "t_first"), ("left", "t_last"))):
        ends = np.flatnonzero(~steps[flag].to_numpy(bool) & steps[time].notna().to_numpy())
        keys = pd.MultiIndex.from_frame(steps.loc[ends, ["trace_id", time]])
        along = offset.reindex(keys).to_numpy(np.float64)
        along = np.where(steps["forward"].to_numpy(bool)[ends], along, length[ends] - along)
        whole[ends, side] = np.where(np.isfinite(along), along, whole[ends, side])
    for row in np.flatnonzero((whole[:, 0] > 0) | (whole[:, 1] < length)):
        low, high = np.sort(whole[row])
        cut = substring(lines[row], low, high)
        lines[row] = cut if high > low else shapely.LineString([cut, cut])
    return lines


def _joined(lines: NDArray[Any], part: NDArray[np.int64], n_parts: int) -> NDArray[Any]:
    """Join the lines of each part; a point that two lines share appears once."""
    if not n_parts:
        return np.zeros(0, dtype=object)
    coordinates, owner = shapely.get_coordinates(lines, return_index=True)
    index = part[owner]
    same = (np.diff(coordinates, axis=0, prepend=np.nan) == 0).all(axis=1) & (np.diff(index, prepend=-1) == 0)
    kept, index = coordinates[~same], index[~same]
    alone = np.bincount(index, minlength=n_parts)[index] == 1  # a vehicle that stood: a line needs two points
    times = np.where(alone, 2, 1)
    return np.asarray(shapely.linestrings(np.repeat(kept, times, axis=0), indices=np.repeat(index, times)), object)
