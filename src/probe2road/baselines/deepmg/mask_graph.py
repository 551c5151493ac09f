"""From mask to graph by the method of DeepMG: thinning, then tracing by the branches around each pixel (METHOD 3.5)."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from probe2road.baselines.deepmg.variants import Variant
from probe2road.baselines.fringe import trace_fringe
from probe2road.graph.clean import drop_dead_ends
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import finish_edges
from probe2road.raster.grid import Grid
from probe2road.vectorize.lines import VectorizeOptions, graph_from_pixels, vectorize
from probe2road.vectorize.skeleton import skeletonize_windows

__all__ = ["mask_graph"]

logger = logging.getLogger(__name__)

_SHORTEST = 5.0  # m; shorter lines are dropped


def mask_graph(mask: NDArray[np.bool_], grid: Grid, variant: Variant) -> RoadGraph:
    """Turn a mask into a road graph.

    The published code follows the skeleton from node to node by the fringe method and keeps one line between any two
    nodes, which loses parallel roads and loops. The other variant traces the same skeleton with
    `probe2road.vectorize.lines`, which keeps them.

    Parameters
    ----------
    mask
        Shape ``(rows, cols)``, True on roads; an empty one gives an empty graph.
    grid
        Its grid.
    variant
        Decides how the skeleton is followed, and how far lines are simplified.

    Returns
    -------
    RoadGraph
        Without lines of up to 5 m: all of them as published, only dead ends in the other variant.

    Examples
    --------
    >>> from probe2road.baselines.deepmg.variants import find_variant
    >>> mask = np.zeros((5, 40), bool)
    >>> mask[2, 5:35] = True
    >>> grid = Grid.from_bounds((0, 0, 79, 9), resolution=2.0, crs="EPSG:32616")
    >>> print(mask_graph(mask, grid, find_variant("fixed")).edges.geometry.iloc[0])
    LINESTRING (11 5, 69 5)
    """
    skeleton = skeletonize_windows(mask, method="zhang_suen")
    options = VectorizeOptions(smoothing=0.0, simplify_tolerance=variant.simplify_tolerance)
    if variant.multigraph:
        return drop_dead_ends(vectorize(skeleton, grid, options=options), min_length=_SHORTEST)
    graph = graph_from_pixels(trace_fringe(skeleton), grid, options=options)
    ends = np.sort(graph.edges[["u", "v"]].to_numpy(), axis=1)
    # A later line between the same nodes takes the place of an earlier one, as in a table keyed by nodes.
    repeated = graph.edges.assign(low=ends[:, 0], high=ends[:, 1]).duplicated(["low", "high"], keep="last").to_numpy()
    edges = graph.edges[(graph.edges["length"].to_numpy() > _SHORTEST) & ~repeated]
    nodes = graph.nodes[graph.nodes.index.isin(np.unique(edges[["u", "v"]]))]
    logger.info("dropped %d parallel lines and lines of up to %g m", len(graph.edges) - len(edges), _SHORTEST)
    return replace(graph, nodes=nodes, edges=finish_edges(edges))
