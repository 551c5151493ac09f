"""Pictures of the same place by every method, over traces and reference, as in the paper's Fig. 5."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.draw.picture import Panel, write_filmstrip
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.raster.counts import rasterize
from probe2road.raster.grid import Grid

__all__ = ["busiest_places", "draw_place"]

_COLUMNS = 4
_PIXELS = 800  # of the longer side of the panel with the traces

Bounds = tuple[float, float, float, float]


def busiest_places(reference: RoadGraph, count: int, *, size: float = 700.0) -> list[Bounds]:
    """Return the squares with the most junctions of a reference, without overlap.

    Parameters
    ----------
    reference
        Road graph in metric CRS.
    count
        How many squares; fewer come back where there are fewer junctions.
    size
        Side of a square, m.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> star = [[(0, 0), (90, 0)], [(0, 0), (-90, 0)], [(0, 0), (0, 90)]]
    >>> busiest_places(graph_from_lines(star, crs="EPSG:32616"), 3, size=100.0)
    [(-50.0, -50.0, 50.0, 50.0)]
    """
    xy = shapely.get_coordinates(reference.nodes.geometry.to_numpy())[reference.degrees().to_numpy() >= 3]
    places: list[Bounds] = []
    while len(xy) and len(places) < count:
        near = _neighbours(xy, size / 2.0)
        x, y = xy[near.argmax()]
        places.append((float(x - size / 2), float(y - size / 2), float(x + size / 2), float(y + size / 2)))
        xy = xy[np.abs(xy - (x, y)).max(axis=1) > size]
    return places


def draw_place(path: Path, bounds: Bounds, fleet: Fleet, reference: RoadGraph, graphs: Mapping[str, RoadGraph]) -> None:
    """Draw the traces of a place, and each graph over the reference, side by side.

    Parameters
    ----------
    path
        The PNG file.
    bounds
        Of the place, in the CRS of fleet and graphs.
    fleet
        Its traces are drawn in the first panel.
    reference
        Drawn underneath as a pale band.
    graphs
        Title of each panel, and its graph.
    """
    resolution = max(bounds[2] - bounds[0], bounds[3] - bounds[1]) / _PIXELS
    grid = Grid.from_bounds(bounds, resolution=resolution, crs=fleet.crs)
    below = _within(reference, bounds)
    panels = [Panel("Traces", rasterize(fleet, grid)[0], grid, "each pixel counts fixes of drives")]
    for title, graph in graphs.items():
        inside = graph.degrees()[graph.nodes.geometry.within(shapely.box(*bounds))]
        caption = f"{(inside >= 3).sum()} junctions, {(inside == 1).sum()} dead ends"
        panels.append(Panel(title, _within(graph, bounds), caption=caption, reference=below))
    write_filmstrip(panels, path, bounds=bounds, columns=_COLUMNS)


def _within(graph: RoadGraph, bounds: Bounds) -> RoadGraph:
    """Keep the edges that touch an area, uncut, and their nodes."""
    touching = graph.edges.geometry.intersects(shapely.box(*bounds)).to_numpy()
    edges = graph.edges[touching]
    used = np.union1d(edges["u"], edges["v"])
    return replace(graph, edges=edges, nodes=graph.nodes[graph.nodes.index.isin(used)], turns=graph.turns.iloc[:0])


def _neighbours(xy: NDArray[np.float64], reach: float) -> NDArray[np.int64]:
    """Count the points within a square around each point, shape (K,)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(xy)
    return np.asarray(tree.query_ball_point(xy, reach, p=np.inf, return_length=True), np.int64)
