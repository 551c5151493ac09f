"""Faint roads: stretches that few traces drove on, in a graph whose roads are driven by more."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.bounds import NotNegative
from probe2road.fleet.contract import Fleet
from probe2road.graph.clean import drop_edges
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import split_edges
from probe2road.matching.frame import Stations, Traversals, frame, stations_along
from probe2road.matching.match import Matches
from probe2road.options import checked

__all__ = ["FaintOptions", "drop_faint"]

_SPACING = 20.0  # m between the stations at which traces are counted
_PARENT = "_parent"


@dataclass(frozen=True)
@checked
class FaintOptions:
    """Which stretches of a finished graph are faint."""

    min_traces: NotNegative[int] = 4  # a stretch with as many traces is a road; 0 takes none for faint; the paper's N
    min_share: NotNegative[float] = 0.2  # a stretch with this share of the usual traces is a road, too
    min_length: NotNegative[float] = 100.0  # m; shorter stretches of an edge go with what they lie between


def drop_faint(graph: RoadGraph, fleet: Fleet, matches: Matches, *, options: FaintOptions | None = None) -> RoadGraph:
    """Remove the stretches of edges that few traces passed, as far as the graph is driven by more.

    Traffic changes along an edge where the mask has lost the ramps on which it came. How many traces are few is told by
    what the median traversal of an edge shares it with, so that the graph of a small fleet stays as it is. An edge
    shorter than two stretches is judged by its middle: near its ends the errors of the matching lead traces onto it
    that stay on the road beside.

    Parameters
    ----------
    graph
        Any road graph.
    fleet
        The fleet, in the graph's CRS.
    matches
        Of the fleet to the graph.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        Not merged; turns on removed edges are dropped. The graph itself where nothing is faint.

    Raises
    ------
    InputError
        If the matches belong to another fleet or graph.

    Examples
    --------
    Of 20 traces three go on at the end of a road, which is faint there. Of four traces three would be as good as all:

    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> from probe2road.matching.match import match
    >>> graph = graph_from_lines([[(0, 0), (1000, 0)]], crs="EPSG:32616")
    >>> for usual in (20, 4):
    ...     ends = [60] * (usual - 3) + [100] * 3
    ...     fixes = [(n, t, 10.0 * t, 0.0) for n, end in enumerate(ends) for t in range(end + 1)]
    ...     table = pd.DataFrame(fixes, columns=["trace_id", "t", "x", "y"])
    ...     fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    ...     drop_faint(graph, fleet, match(graph, fleet)).edges["length"].tolist()
    [610.0]
    [1000.0]

    Notes
    -----
    METHOD 0.1 row 28 counts the drives of reference edges in the same way.
    """
    options = options or FaintOptions()
    if graph.edges.empty:
        return graph
    driven, _ = frame(graph, fleet, matches)
    length = graph.edges["length"].to_numpy()
    stations = stations_along(length, _SPACING)
    traces = _traces_at(driven, stations)
    faint = _settled(traces < _limit(traces, options), stations, length, options.min_length)
    if not faint.any():
        return graph
    change = np.flatnonzero((faint[1:] != faint[:-1]) & (stations.edge[1:] == stations.edge[:-1]))
    along = (stations.along[change] + stations.along[change + 1]) / 2
    ids = graph.edges.index.to_numpy()
    parts, _ = split_edges(
        replace(graph, edges=graph.edges.assign(**{_PARENT: np.arange(len(ids))})), ids[stations.edge[change]], along
    )
    parent = parts.edges[_PARENT].to_numpy()
    middle = shapely.line_interpolate_point(parts.edges.geometry.to_numpy(), 0.5, normalized=True)
    at = shapely.line_locate_point(graph.edges.geometry.to_numpy()[parent], middle)
    parts = replace(parts, edges=parts.edges.drop(columns=_PARENT))
    return drop_edges(parts, faint[stations.nearest(parent, at)], why="that few traces drove on, as roads here go")


def _traces_at(driven: Traversals, stations: Stations) -> NDArray[np.int64]:
    """Count the distinct traces that pass each station, shape (S,); a trace counts from its first to its last place."""
    covered = driven.low <= driven.high
    spans = pd.DataFrame({name: getattr(driven, name)[covered] for name in ("edge", "trace", "low", "high")}).groupby(
        ["edge", "trace"], as_index=False
    )
    low, high = spans["low"].min(), spans["high"].max()
    edge = low["edge"].to_numpy()
    begin = stations.first[edge] + np.ceil(low["low"] / stations.spacing[edge]).to_numpy(np.int64)
    stop = stations.first[edge] + np.floor(high["high"] / stations.spacing[edge]).to_numpy(np.int64) + 1
    change = np.zeros(len(stations.edge) + 1, np.int64)
    np.add.at(change, begin, 1)
    np.add.at(change, np.maximum(stop, begin), -1)
    return np.cumsum(change)[:-1]


def _limit(traces: NDArray[np.int64], options: FaintOptions) -> float:
    """Return how many traces are enough, by those at the station that the median passing of a station is at."""
    counts = np.sort(traces)
    passings = np.cumsum(counts)
    usual = counts[np.searchsorted(passings, passings[-1] / 2)] if len(counts) else 0
    return min(options.min_traces, options.min_share * float(usual))


def _settled(
    faint: NDArray[np.bool_], stations: Stations, length: NDArray[np.float64], min_length: float
) -> NDArray[np.bool_]:
    """Give short stretches of an edge to what they lie between, clear ones first; short edges go by their middle."""
    settled = faint.copy()
    short = length < 2 * min_length
    middle = (stations.first[:-1] + stations.first[1:] - 1) // 2
    settled[short[stations.edge]] = faint[middle][stations.edge[short[stations.edge]]]
    for kind in (False, True):
        begins = np.ones(len(settled), bool)
        begins[1:] = (settled[1:] != settled[:-1]) | (stations.edge[1:] != stations.edge[:-1])
        run = np.cumsum(begins) - 1
        first = np.flatnonzero(begins)
        count = np.diff(np.append(first, len(settled)))
        whole = count == np.diff(stations.first)[stations.edge[first]]
        brief = (count * stations.spacing[stations.edge[first]] < min_length) & ~whole & (settled[first] == kind)
        settled[brief[run]] = not kind
    return settled
