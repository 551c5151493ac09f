"""From lines of single voxels to a road graph in three dimensions.

Strategy
--------
Voxels that touch are linked, but not by a step that two or more shorter steps replace: a staircase is then an
ordinary path. Voxels with three links or more are junctions, and those that are linked to each other are one, at
their mean. Every link is a short edge of a graph at first; merging nodes of degree 2 makes roads of them.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import combinations, product

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.baselines.volume import Pillars
from probe2road.graph.clean import drop_edges, merge_degree_two_nodes
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.raster.grid import Grid

__all__ = ["graph_from_volume", "voxel_links"]

logger = logging.getLogger(__name__)

_Step = tuple[int, ...]


def graph_from_volume(
    skeleton: Pillars, grid: Grid, *, floor: float, height: float, tolerance: float = 1.0
) -> RoadGraph:
    """Turn a thinned volume into a road graph whose edges have heights.

    Voxels without a link are dropped.

    Parameters
    ----------
    skeleton
        From `probe2road.baselines.volume_skeleton.thin_volume`.
    grid
        The grid seen from above.
    floor, height
        Lower side of layer 0, and height of a layer, m.
    tolerance
        Of Douglas-Peucker in plan, m.

    Returns
    -------
    RoadGraph
        Lines run through the centres of their voxels.

    Examples
    --------
    >>> from pyproj import CRS
    >>> from probe2road.baselines.volume import pillars_from_voxels
    >>> grid = Grid(left=0.0, top=3.0, resolution=1.0, rows=3, cols=6, crs=CRS("EPSG:32616"))
    >>> line = pillars_from_voxels(np.array([1, 1, 1, 1]), np.array([1, 2, 3, 4]), np.array([0, 0, 0, 1]))
    >>> print(graph_from_volume(line, grid, floor=10.0, height=3.0).edges.geometry.iloc[0])
    LINESTRING Z (1.5 1.5 11.5, 4.5 1.5 14.5)
    """
    row, col, layer = skeleton.voxels()
    xyz = np.stack([*grid.xy(row, col), floor + (layer + 0.5) * height], axis=1)
    one, other = voxel_links(row, col, layer)
    node, position = _joined_junctions(one, other, xyz)
    pairs = np.sort(np.stack([node[one], node[other]], axis=1), axis=1)
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    lines = shapely.linestrings(position[pairs])
    edges = gpd.GeoDataFrame({"u": pairs[:, 0], "v": pairs[:, 1]}, geometry=lines, crs=grid.crs)
    used = np.unique(pairs)
    nodes = gpd.GeoDataFrame(geometry=shapely.points(position[used]), index=used, crs=grid.crs)
    graph = merge_degree_two_nodes(RoadGraph(nodes.rename_axis("node"), finish_edges(edges), empty_turns()))
    simple = shapely.simplify(graph.edges.geometry.to_numpy(), tolerance, preserve_topology=False)
    # A loop that would fall flat keeps its vertices, and so does a line that ends above its start.
    flat = (graph.edges["u"] == graph.edges["v"]).to_numpy() & (shapely.get_num_coordinates(simple) < 4)
    flat |= shapely.length(simple) == 0
    simple[flat] = graph.edges.geometry.to_numpy()[flat]
    logger.info("%d voxels became %d edges", len(row), len(simple))
    graph = replace(graph, edges=finish_edges(graph.edges.set_geometry(simple, crs=grid.crs)))
    return drop_edges(graph, shapely.length(simple) == 0, why="that are upright")


def voxel_links(
    row: NDArray[np.int64], col: NDArray[np.int64], layer: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Link voxels that touch, unless a voxel between them touches both along fewer axes.

    Parameters
    ----------
    row, col, layer
        The voxels, each once, sorted in this order, V in all.

    Returns
    -------
    one, other
        Numbers of linked voxels, shape (L,).

    Examples
    --------
    Around a corner, the diagonal is no link:

    >>> [part.tolist() for part in voxel_links(np.array([0, 0, 1]), np.array([0, 1, 1]), np.array([0, 0, 0]))]
    [[0, 1], [1, 2]]
    """
    place = np.stack([part - part.min(initial=0) + 1 for part in (row, col, layer)], axis=1)
    extent = place.max(axis=0, initial=0) + 2
    scale = np.array([extent[1] * extent[2], extent[2], 1])
    key = place @ scale
    found = []
    for step in product((-1, 0, 1), repeat=3):
        if step <= (0, 0, 0):
            continue  # links are looked for from the voxel that comes first
        target = np.searchsorted(key, key + np.dot(step, scale))
        linked = _are_in(key, key + np.dot(step, scale))
        for part in _parts(step):
            linked &= ~_are_in(key, key + np.dot(part, scale))
        found.append(np.stack([np.flatnonzero(linked), target[linked]]))
    one, other = np.concatenate(found, axis=1)
    order = np.lexsort([other, one])
    return one[order], other[order]


def _parts(step: _Step) -> list[_Step]:
    """List the steps along some of the axes of a step, but not all."""
    axes = [axis for axis in range(3) if step[axis]]
    chosen = [group for size in range(1, len(axes)) for group in combinations(axes, size)]
    return [(step[0] * (0 in group), step[1] * (1 in group), step[2] * (2 in group)) for group in chosen]


def _are_in(key: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which numbers are in a sorted array."""
    place = np.searchsorted(key, wanted)
    return (place < len(key)) & (key[np.minimum(place, len(key) - 1)] == wanted)


def _joined_junctions(
    one: NDArray[np.int64], other: NDArray[np.int64], xyz: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Join linked junction voxels: return the node of every voxel, and the mean position of every node."""
    count = len(xyz)
    junction = np.bincount(np.concatenate([one, other]), minlength=count) > 2
    both = junction[one] & junction[other]
    links = coo_array((np.ones(both.sum()), (one[both], other[both])), shape=(count, count))
    n_nodes, node = connected_components(links, directed=False) if count else (0, np.zeros(0, np.int64))
    size = np.bincount(node, minlength=n_nodes)
    position = np.stack([np.bincount(node, part, minlength=n_nodes) / size for part in xyz.T], axis=1)
    return node.astype(np.int64), position
