"""From pixel lines to a road graph in metres: smoothing, simplification, coordinates, scores.

Strategy
--------
The pixels of a straight road form stairs whose steps say nothing about the road, so a line is smoothed along
itself before it is simplified. A pixel's centre is at most half its diagonal from the line that it stands for;
no vertex is smoothed farther than that. Each line is worked on in pixels from its own first vertex, and turned
into metres at the end: lines of equal shape get equal results wherever they lie.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numba import njit
from numpy.typing import NDArray

from probe2road.bounds import NotNegative
from probe2road.errors import InputError
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.options import checked
from probe2road.raster.blocks import Blocks
from probe2road.raster.counts import Grid
from probe2road.vectorize.skeleton import skeleton_pixels
from probe2road.vectorize.tracing import PixelGraph, trace_pixels

__all__ = ["VectorizeOptions", "graph_from_pixels", "vectorize"]

logger = logging.getLogger(__name__)

_HALF_DIAGONAL = 0.5**0.5  # px; farthest that smoothing moves a vertex


@dataclass(frozen=True)
@checked
class VectorizeOptions:
    """How lines of pixels become road geometry."""

    smoothing: NotNegative[float] = 2.0  # m, standard deviation of the smoothing along the line; 0 switches it off
    simplify_tolerance: NotNegative[float] = 1.0  # m, Douglas-Peucker; 0 keeps every vertex


def vectorize(
    skeleton: NDArray[Any] | Blocks,
    grid: Grid,
    *,
    probability: NDArray[Any] | Blocks | None = None,
    options: VectorizeOptions | None = None,
) -> RoadGraph:
    """Turn a one-pixel skeleton into a road graph.

    Every line of pixels becomes an edge of origin ``segmentation``; loops and parallel edges are kept, isolated
    pixels are not. An empty skeleton gives an empty graph. Nodes stay at their pixels. Edges stay within the
    simplification tolerance and half a pixel diagonal of the centres of their pixels.

    Parameters
    ----------
    skeleton
        Shape ``(rows, cols)``, from `probe2road.vectorize.skeleton.skeletonize`; an array, a memory map, or blocks.
    grid
        The skeleton's grid.
    probability
        Centreline probability of the same shape; its mean along an edge becomes the edge's ``score``.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        Nodes in reading order of their pixels, edges in the order of their first node.

    Raises
    ------
    InputError
        If skeleton or probability do not have the shape of the grid.

    Notes
    -----
    METHOD 0.1 rows 14 and 15.

    Examples
    --------
    >>> from pyproj import CRS
    >>> grid = Grid(left=0.0, top=3.0, resolution=1.0, rows=3, cols=5, crs=CRS("EPSG:32616"))
    >>> skeleton = np.array([[0, 0, 0, 0, 1], [1, 1, 1, 1, 0], [0, 0, 0, 0, 1]])
    >>> graph = vectorize(skeleton, grid)
    >>> graph.edges[["u", "v"]].values.tolist()
    [[0, 2], [1, 2], [2, 3]]
    >>> print(graph.edges.geometry.iloc[1])
    LINESTRING (0.5 1.5, 3.5 1.5)
    """
    for name, array in (("skeleton", skeleton), ("probability", probability)):
        if array is None:
            continue
        shape = array.shape if isinstance(array, Blocks) else np.shape(array)
        if shape != grid.shape:
            raise InputError(f"shape {shape} is not the grid's {grid.shape}", where=name)
    pixels = trace_pixels(*skeleton_pixels(skeleton))
    return graph_from_pixels(pixels, grid, probability=probability, options=options)


def graph_from_pixels(
    pixels: PixelGraph,
    grid: Grid,
    *,
    probability: NDArray[Any] | Blocks | None = None,
    options: VectorizeOptions | None = None,
) -> RoadGraph:
    """Turn traced pixel lines into a road graph, as `vectorize` does; rows and columns are those of the grid."""
    options = options or VectorizeOptions()
    if len(pixels.start) == 0:
        return empty_graph(grid.crs)
    corner = np.floor(np.stack([pixels.row, pixels.col], axis=1)[pixels.offsets[:-1]])
    smoothed = _smoothed(pixels, corner, options.smoothing / grid.resolution)
    lines = _simplified(smoothed, pixels.start == pixels.stop, options.simplify_tolerance / grid.resolution)
    local, line = shapely.get_coordinates(lines, return_index=True)
    edges = gpd.GeoDataFrame(
        {"u": pixels.start, "v": pixels.stop, "origin": "segmentation"},
        geometry=shapely.linestrings(np.stack(grid.xy(*(local + corner[line]).T), axis=1), indices=line),
        crs=grid.crs,
    )
    if probability is not None:
        edges["score"] = _scores(pixels, probability)
    position = shapely.points(*grid.xy(pixels.node_row, pixels.node_col))
    nodes = gpd.GeoDataFrame(geometry=position, index=pd.RangeIndex(len(position), name="node"), crs=grid.crs)
    graph = RoadGraph(nodes, finish_edges(edges), empty_turns())
    logger.info("vectorised %d edges, %.3f km, %d vertices", len(edges), graph.length / 1000, len(local))
    return graph


def _smoothed(pixels: PixelGraph, corner: NDArray[np.float64], sigma: float) -> NDArray[Any]:
    """Smooth lines with a sigma in pixels; return LineStrings of (row, col), relative to a whole pixel of each line.

    Passes of the kernel (1, 2, 1) / 4 with fixed ends add up to a Gaussian whose variance is half their number,
    in vertices, and leave a straight line straight up to its ends.
    """
    line = np.repeat(np.arange(len(pixels.start)), np.diff(pixels.offsets))
    local = np.stack([pixels.row, pixels.col], axis=1) - corner[line]
    moved = local.copy()
    _diffuse(moved, pixels.offsets, round(2 * sigma**2))
    step = moved - local
    # No vertex moves out of the circle around its pixel: a larger change would alter the shape, not the pixel steps.
    local += step * (_HALF_DIAGONAL / np.maximum(np.hypot(*step.T), _HALF_DIAGONAL))[:, None]
    return shapely.linestrings(local, indices=line)


@njit(cache=True)
def _diffuse(vertices: NDArray[np.float64], offsets: NDArray[np.int64], passes: int) -> None:
    """Replace each inner vertex, ``passes`` times, by half of itself and a quarter of each neighbour."""
    for line in range(len(offsets) - 1):
        for _ in range(passes):
            row, col = vertices[offsets[line]]
            for place in range(offsets[line] + 1, offsets[line + 1] - 1):
                here_row, here_col = vertices[place]
                vertices[place, 0] = here_row / 2 + (row + vertices[place + 1, 0]) / 4
                vertices[place, 1] = here_col / 2 + (col + vertices[place + 1, 1]) / 4
                row, col = here_row, here_col


def _simplified(lines: NDArray[Any], loop: NDArray[np.bool_], tolerance: float) -> NDArray[Any]:
    """Simplify lines with Douglas-Peucker; a loop that would lose its area stays as it is."""
    simple = shapely.simplify(lines, tolerance, preserve_topology=False)
    flat = loop & (shapely.get_num_coordinates(simple) < 4)
    return np.where(flat, lines, simple)


def _scores(pixels: PixelGraph, probability: NDArray[Any] | Blocks) -> NDArray[np.float64]:
    """Return the mean probability at the pixels of every line, including its nodes."""
    row, col = (np.rint(part).astype(np.int64) for part in (pixels.row, pixels.col))
    total = np.add.reduceat(probability[row, col].astype(np.float64), pixels.offsets[:-1])
    return total / np.diff(pixels.offsets)
