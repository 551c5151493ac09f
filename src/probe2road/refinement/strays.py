"""Strays: dead ends that few traces left beside a busy road, because their positions were wrong there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.bounds import Positive, Share
from probe2road.fleet.contract import Fleet
from probe2road.graph.clean import drop_edges
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.frame import frame, robust_sigma
from probe2road.matching.match import Matches
from probe2road.options import checked
from probe2road.refinement.undriven import traces_per_edge

__all__ = ["StrayOptions", "drop_strays"]

_SPACING = 10.0  # m between the places where an edge is compared with the roads beside it
_SPAN = 5.0  # m to either side of a place, over which the direction of a line is measured


@dataclass(frozen=True)
@checked
class StrayOptions:
    """Which dead ends are strays."""

    ratio: Positive[float] = 20.0  # times as many traces drove on the road beside it
    reach: Positive[float] = 6.0  # spreads (1 sigma) of the fixes of that road, up to which a stray is off it
    max_angle: Positive[float] = 25.0  # degrees between the two, as undirected lines
    share: Share = 0.8  # of the length, that must run so


def drop_strays(graph: RoadGraph, fleet: Fleet, matches: Matches, *, options: StrayOptions | None = None) -> RoadGraph:
    """Remove dead ends that run beside a road that many more traces drove on, within the errors of positions there.

    The spread of the fixes on the busy road says how far positions are off: tens of metres beside a street among tall
    buildings, a few where vehicles have odometry. A service road that few drove on so stays where positions are good.

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
        Not merged; turns on removed edges are dropped. The graph itself where there is no stray.

    Raises
    ------
    InputError
        If the matches belong to another fleet or graph.

    Examples
    --------
    Forty drives along a street, spread over 20 m, and one that strayed:

    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> from probe2road.matching.match import match
    >>> lines = [[(0, 0), (60, 0)], [(60, 0), (400, 0)], [(60, 0), (90, 20), (300, 25)]]
    >>> graph = graph_from_lines(lines, crs="EPSG:32616")
    >>> drives = [(k, t, 10.0 * t, 6.0 * np.sin(k)) for k in range(40) for t in range(41)]
    >>> stray = [(40, t, x, y) for t, (x, y) in enumerate([(0, 0), (60, 0), (90, 20), (200, 22), (300, 25)])]
    >>> table = pd.DataFrame(drives + stray, columns=["trace_id", "t", "x", "y"])
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> drop_strays(graph, fleet, match(graph, fleet)).edges.index.tolist()
    [0, 1]
    """
    options = options or StrayOptions()
    traces = traces_per_edge(graph, matches.steps)
    degree = graph.degrees()
    ends = np.minimum(degree[graph.edges["u"]].to_numpy(), degree[graph.edges["v"]].to_numpy()) == 1
    suspect = np.flatnonzero(ends & (traces * options.ratio <= traces.max(initial=0)))
    if not len(suspect):
        return graph
    driven, fixes = frame(graph, fleet, matches)
    spread = robust_sigma(fixes.left, driven.edge[fixes.traversal], len(graph.edges))
    lines = shapely.force_2d(graph.edges.geometry.to_numpy())
    beside = _share_beside(lines, suspect, traces, options.reach * np.nan_to_num(spread), options)
    dropped = np.zeros(len(graph.edges), bool)
    dropped[suspect[beside >= options.share]] = True
    return drop_edges(graph, dropped, why="that stray from a busy road")


def _share_beside(
    lines: NDArray[np.object_],
    suspect: NDArray[np.int64],
    traces: NDArray[np.int64],
    reach: NDArray[np.float64],
    options: StrayOptions,
) -> NDArray[np.float64]:
    """Return the share of each suspect edge that runs beside a much busier edge, within the reach of that one."""
    count = np.maximum(np.ceil(shapely.length(lines[suspect]) / _SPACING), 1).astype(np.int64)
    owner = np.repeat(np.arange(len(suspect)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    own = lines[suspect[owner]]
    along = (number + 0.5) / count[owner] * shapely.length(own)
    places = shapely.line_interpolate_point(own, along)
    busy = np.flatnonzero(reach > 0)
    place, other = shapely.STRtree(lines[busy]).query(places, predicate="dwithin", distance=float(reach.max()))
    other = busy[other]
    near = shapely.distance(places[place], lines[other]) <= reach[other]
    busier = traces[other] >= options.ratio * np.maximum(traces[suspect[owner[place]]], 1)
    place, other = place[near & busier], other[near & busier]
    there = shapely.line_locate_point(lines[other], places[place])
    turned = _direction(own[place], along[place]) - _direction(lines[other], there)
    turned = np.abs((turned + 90.0) % 180.0 - 90.0)
    found = np.zeros(len(places), bool)
    found[place[turned <= options.max_angle]] = True
    return np.bincount(owner, found) / count


def _direction(lines: NDArray[np.object_], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction of lines at distances along them, degrees."""
    length = shapely.length(lines)
    ahead, behind = (
        shapely.get_coordinates(shapely.line_interpolate_point(lines, np.clip(at + way * _SPAN, 0.0, length)))
        for way in (1, -1)
    )
    return np.degrees(np.arctan2(*(ahead - behind).T[::-1]))
