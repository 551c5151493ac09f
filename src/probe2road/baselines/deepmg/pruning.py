"""Pruning of a graph with links by the traces: the refinement of DeepMG (METHOD 3.7)."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.bounds import NotNegative
from probe2road.graph.direction import ONEWAY_TAGS, in_driving_direction
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.options import checked

__all__ = ["PruneOptions", "prune_graph"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
@checked
class PruneOptions:
    """How often each direction of an edge must be driven to be kept."""

    min_drives: NotNegative[int] = 1  # traversals of an edge of the mask
    min_link_drives: NotNegative[int] = 5  # traversals of a link
    max_links: NotNegative[int] = 2  # links at a node; the shortest are kept


def prune_graph(graph: RoadGraph, traversals: NDArray[np.int64], options: PruneOptions | None = None) -> RoadGraph:
    """Remove the directions of edges that are driven too rarely, edges without a direction, and excess links.

    Parameters
    ----------
    graph
        A graph with links as edges of origin ``gap``.
    traversals
        Shape (edges, 2), from `probe2road.baselines.deepmg.traversals.count_traversals`.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        ``forward`` and ``backward`` are the traversals of the directions that are left, and ``oneway`` says which these
        are; edges with one direction run in it. Of more than two links at a node the shortest are kept.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (90, 0)], [(90, 0), (90, 50)], [(90, 0), (99, 0)]], crs="EPSG:32616")
    >>> pruned = prune_graph(graph, np.array([[3, 0], [0, 0], [0, 2]]))
    >>> pruned.edges[["forward", "backward", "oneway"]].values.tolist()
    [[3, 0, 'yes'], [2, 0, 'yes']]
    """
    options = options or PruneOptions()
    link = graph.edges["origin"].to_numpy() == "gap"
    least = np.where(link, options.min_link_drives, options.min_drives)
    driven = traversals >= least[:, None]
    kept = driven.any(axis=1)
    kept &= ~_in_excess(graph, link & kept, options.max_links)
    counts = np.where(driven, traversals, 0)[kept]
    direction = driven[kept] @ [1, -1]
    edges = graph.edges[kept].assign(
        forward=pd.array(counts[:, 0], "Int64"),
        backward=pd.array(counts[:, 1], "Int64"),
        oneway=[ONEWAY_TAGS[way] for way in direction.tolist()],
    )
    nodes = graph.nodes[graph.nodes.index.isin(np.unique(edges[["u", "v"]]))]
    logger.info(
        "kept %d of %d edges of the mask and %d of %d links",
        int((kept & ~link).sum()), int((~link).sum()), int((kept & link).sum()), int(link.sum()),
    )  # fmt: skip
    return replace(graph, nodes=nodes, edges=in_driving_direction(finish_edges(edges)), turns=empty_turns())


def _in_excess(graph: RoadGraph, link: NDArray[np.bool_], most: int) -> NDArray[np.bool_]:
    """Mark the links that are not among the shortest at one of their nodes."""
    rows = np.flatnonzero(link)
    edges = graph.edges.iloc[rows]
    ends = pd.DataFrame(
        {
            "row": np.tile(rows, 2),
            "node": pd.concat([edges["u"], edges["v"]]).to_numpy(),
            "length": np.tile(edges["length"], 2),
        }
    ).sort_values(["length", "row"])
    excess = np.zeros(len(link), bool)
    excess[ends["row"][ends.groupby("node").cumcount() >= most]] = True
    return excess
