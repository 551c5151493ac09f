"""Pruning: segments without enough support by trips are dropped, and the others joined into longer ones."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.baselines.biagioni.traversals import Runs
from probe2road.graph.clean import merge_degree_two_nodes
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.graph.topology import chains, mates

__all__ = ["prune_segments"]

logger = logging.getLogger(__name__)


def prune_segments(graph: RoadGraph, runs: Runs, *, min_runs: int) -> tuple[RoadGraph, Runs]:
    """Keep segments with enough good runs in one direction, and join them at nodes where only two are left.

    The published segments have a direction and a twin that has the other. Here a segment is undirected, and stays
    if one of the two would.

    Parameters
    ----------
    graph
        A map.
    runs
        Good runs, whose segments are rows of its edges.
    min_runs
        Runs in one direction that keep a segment.

    Returns
    -------
    RoadGraph
        ``forward`` and ``backward`` are good runs in either direction, ``support`` is their sum; of a joined segment,
        each is the least of its members.
    Runs
        Those on the segments kept, which now are rows of that graph's edges.

    Notes
    -----
    METHOD 4.5.

    Examples
    --------
    The road in the middle was driven once in either direction; the others are joined around it:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (90, 0)], [(90, 0), (180, 0)], [(90, 0), (90, 90)]]
    >>> runs = Runs(np.array([0, 0, 1, 1, 2, 2]), np.array([1, 1, 1, 1, 1, 0]) == 1, np.arange(7), np.zeros((6, 2)))
    >>> kept, runs = prune_segments(graph_from_lines(lines, crs="EPSG:32616"), runs, min_runs=2)
    >>> kept.edges[["length", "support"]].values.tolist(), runs.segment.tolist()
    ([[180.0, 2]], [0, 0, 0, 0])
    """
    n_segments = len(graph.edges)
    forward = np.bincount(runs.segment[runs.forward], minlength=n_segments)
    backward = np.bincount(runs.segment[~runs.forward], minlength=n_segments)
    kept = np.maximum(forward, backward) >= min_runs
    counts = {"forward": forward, "backward": backward, "support": forward + backward}
    edges = graph.edges.assign(**{name: pd.array(count, "Int64") for name, count in counts.items()})[kept]
    nodes = graph.nodes[graph.nodes.index.isin(np.unique(edges[["u", "v"]]))]
    pruned = replace(graph, nodes=nodes, edges=finish_edges(edges), turns=empty_turns())
    joined = merge_degree_two_nodes(pruned)
    row = np.full(n_segments, -1)
    row[kept] = joined.edges.index.get_indexer(_chain_ids(pruned))
    logger.info("kept %d of %d segments, %d when joined", kept.sum(), n_segments, len(joined.edges))
    return joined, _on_segments(runs, row[runs.segment])


def _chain_ids(graph: RoadGraph) -> NDArray[np.int64]:
    """Return, for every edge, the id that its chain gets when nodes of degree 2 are merged: that of its first edge."""
    mate = mates(*graph.end_rows.T)
    if not (mate >= 0).any():
        return graph.edges.index.to_numpy()
    members, _, starts = chains(mate)
    first = np.empty(len(members), np.int64)
    first[members] = np.repeat(np.minimum.reduceat(members, starts), np.diff(starts, append=len(members)))
    return graph.edges.index.to_numpy()[first]


def _on_segments(runs: Runs, segment: NDArray[np.int64]) -> Runs:
    """Return the runs with new segment numbers; runs with segment -1 are dropped."""
    kept = segment >= 0
    size = np.diff(runs.offsets)
    return Runs(
        segment=segment[kept],
        forward=runs.forward[kept],
        offsets=np.concatenate([[0], np.cumsum(size[kept])]),
        xy=runs.xy[np.repeat(kept, size)],
    )
