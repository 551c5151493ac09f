"""Heights of edges: one common profile from traces whose own heights are wrong by metres.

Strategy
--------
The height of a trace is wrong by metres, and by nearly the same all along a few hundred metres. What places are high
and what stretches of traces are wrong about it are therefore estimated in turn, until they explain every fix together.
The profile of each edge is then smoothed, edges meet where they end at one height, and only vertices that are needed
are added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.bounds import NotNegative, Positive
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.frame import (
    FramedFixes,
    Stations,
    Traversals,
    courses,
    edge_lines,
    robust_sigma,
    smooth_stations,
    stations_along,
)
from probe2road.options import checked

__all__ = ["HeightOptions", "with_heights"]

_SIGMA_OF_MAD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_ROUNDS = 12  # alternations between profile and bias; the last ones change heights by millimetres


@dataclass(frozen=True)
@checked
class HeightOptions:
    """How heights are estimated."""

    spacing: Positive[float] = 10.0  # m between the places at which heights are estimated
    bias_length: Positive[float] = 500.0  # m driven, over which the height error (bias) of a trace is constant
    bias_sigma: Positive[float] = 4.0  # m, 1 sigma of this bias
    sigma: Positive[float] = 0.5  # m, least 1 sigma of heights about the bias; a larger observed one is used
    reach: NotNegative[float] = 100.0  # m; shorter humps are levelled
    tolerance: NotNegative[float] = 0.15  # m, by which the profile may be simplified
    same_height: NotNegative[float] = 1.5  # m; edge ends at a node that differ by less meet at one height


def with_heights(
    graph: RoadGraph,
    fleet: Fleet,
    driven: Traversals,
    fixes: FramedFixes,
    *,
    options: HeightOptions | None = None,
) -> RoadGraph:
    """Give edges the height profile on which their traces agree, and add the column ``height_spread``.

    Edges that nobody with a height drove keep what they have. The course in plan stays the same.

    Parameters
    ----------
    graph, fleet
        The graph that was matched on, and the fleet that was matched.
    driven, fixes
        From `probe2road.matching.frame.frame`.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph

    Examples
    --------
    >>> from probe2road.matching.frame import frame
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.matching.match import match
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(9), "x": np.arange(10.0, 100, 10), "y": 0.0, "z": 7.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> print(with_heights(graph, fleet, *frame(graph, fleet, match(graph, fleet))).edges.geometry[0])
    LINESTRING Z (0 0 7, 100 0 7)
    """
    options = options or HeightOptions()
    z = fleet.traces["z"].to_numpy(np.float64)[fixes.row]
    known = np.isfinite(z)
    empty = np.full(len(graph.edges), np.nan)
    if not known.any():
        return replace(graph, edges=graph.edges.assign(height_spread=empty))
    lines = edge_lines(graph)
    stations = stations_along(lines.length, options.spacing)
    edge = driven.edge[fixes.traversal]
    place = stations.nearest(edge, fixes.along)[known]
    stretch = _stretches(fleet, fixes.row, driven.trace[fixes.traversal], options.bias_length)[known]
    height, left_over, weight = _heights_without_bias(z[known], place, stretch, len(stations.edge), options)
    has = np.bincount(stations.edge, weight, len(graph.edges)) > 0
    mean = np.bincount(stations.edge, np.where(weight > 0, weight * height, 0.0), len(graph.edges))
    mean = np.divide(mean, np.bincount(stations.edge, weight, len(graph.edges)), out=np.zeros(len(has)), where=has)
    level = mean[stations.edge]
    profile = level + smooth_stations(height - level, weight, stations, reach=options.reach, pull=1e-6)
    profile = _joined_at_nodes(graph, stations, profile, has, options.same_height)
    geometry = _profiled(graph, stations, profile, has, options.tolerance)
    spread = robust_sigma(left_over, edge[known], len(graph.edges))
    return replace(graph, edges=graph.edges.set_geometry(geometry, crs=graph.crs).assign(height_spread=spread))


def _stretches(fleet: Fleet, row: NDArray[np.int64], trace: NDArray[np.int64], longest: float) -> NDArray[np.int64]:
    """Cut traces into stretches of a given length (m); the height error of a trace is constant on each stretch."""
    xy = fleet.traces[["x", "y"]].to_numpy(np.float64)
    step = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    step[fleet.starts[:-1]] = 0.0
    driven = np.cumsum(step)
    driven -= driven[fleet.starts[:-1]][fleet.owner]
    piece = (driven[row] / longest).astype(np.int64)
    return pd.factorize(trace * (int(piece.max(initial=0)) + 1) + piece)[0].astype(np.int64)


def _heights_without_bias(
    z: NDArray[np.float64],
    place: NDArray[np.int64],
    stretch: NDArray[np.int64],
    n_places: int,
    options: HeightOptions,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Estimate the height of every place and the constant height error of every stretch of a trace.

    Alternates between the two; each is a mean in which outliers count less (Cauchy's weights), and the bias is drawn
    towards zero, which fixes the level of the whole. Returns heights ``(n_places,)``, what is left over of every fix,
    and the weight of each place: how many stretches passed it, down-weighted where they disagree.
    """
    cells = pd.DataFrame({"place": place, "stretch": stretch, "z": z}).groupby(["place", "stretch"])["z"].median()
    place_of = cells.index.levels[0].to_numpy()[cells.index.codes[0].astype(np.int64)]
    stretch_of = cells.index.levels[1].to_numpy()[cells.index.codes[1].astype(np.int64)]
    value = cells.to_numpy()
    n_stretches = int(stretch.max()) + 1
    middle = pd.Series(value).groupby(place_of).median()
    height, bias, weight = np.full(n_places, np.nan), np.zeros(n_stretches), np.ones(len(value))
    height[middle.index.to_numpy()] = middle.to_numpy()
    sigma = options.sigma
    for _ in range(_ROUNDS):
        away = value - height[place_of]
        pull = (sigma / options.bias_sigma) ** 2
        bias = np.bincount(stretch_of, weight * away, n_stretches) / (
            np.bincount(stretch_of, weight, n_stretches) + pull
        )
        total = np.bincount(place_of, weight, n_places)
        sums = np.bincount(place_of, weight * (value - bias[stretch_of]), n_places)
        height = np.divide(sums, total, out=np.full(n_places, np.nan), where=total > 0)
        off = value - bias[stretch_of] - height[place_of]
        sigma = max(options.sigma, _SIGMA_OF_MAD * float(np.median(np.abs(off))))
        weight = 1.0 / (1.0 + (off / (3.0 * sigma)) ** 2)
    left_over: NDArray[np.float64] = z - bias[stretch] - height[place]
    return height, left_over, np.bincount(place_of, weight, n_places).astype(np.float64)


def _joined_at_nodes(
    graph: RoadGraph, stations: Stations, profile: NDArray[np.float64], has: NDArray[np.bool_], tolerance: float
) -> NDArray[np.float64]:
    """Make edges meet at one height at a node if their heights there differ by less than a tolerance (m)."""
    end = np.stack([stations.first[:-1], stations.first[1:] - 1], axis=1).ravel()
    ends = pd.DataFrame({"node": graph.edges[["u", "v"]].to_numpy().ravel(), "z": profile[end]})[np.repeat(has, 2)]
    of_node = ends.groupby("node")["z"]
    middle = of_node.transform("mean")
    shift = np.zeros(2 * len(has))
    shift[ends.index] = np.where(
        (of_node.transform("max") - of_node.transform("min")) <= tolerance, middle - ends["z"], 0
    )
    share = stations.along / np.maximum(stations.along[stations.first[1:] - 1][stations.edge], 1e-9)
    return profile + (1 - share) * shift[2 * stations.edge] + share * shift[2 * stations.edge + 1]


def _profiled(
    graph: RoadGraph, stations: Stations, profile: NDArray[np.float64], has: NDArray[np.bool_], tolerance: float
) -> NDArray[Any]:
    """Write heights into the lines of edges; stations become vertices where the profile needs them."""
    lines = edge_lines(graph)
    needed = has[stations.edge] & stations.bends(profile, tolerance)
    edge, along, xyz = courses(lines, stations, needed)
    xyz[:, 2] = np.where(has[edge], stations.interpolate(profile, edge, along), xyz[:, 2])
    made = shapely.linestrings(xyz, indices=edge)
    return np.where(has | shapely.has_z(graph.edges.geometry.to_numpy()), made, shapely.force_2d(made))
