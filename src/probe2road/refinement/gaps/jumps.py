"""Roads that are interrupted although traces continue: pairs of edge ends between which traces jump.

Where a road passes over or under several others its mask is often lost for longer than geometry alone may bridge, and
its ends have grown into the roads it crosses. Matched traces show that: they leave the graph at one edge end and are
back at another, some metres ahead. Such a link may cross other roads, which is what the road does.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.tables import step_rows
from probe2road.refinement.gaps.links import GapOptions, angle_between

__all__ = ["jumped_gaps"]


def jumped_gaps(graph: RoadGraph, steps: pd.DataFrame, options: GapOptions) -> NDArray[np.int64]:
    """List the pairs of nodes between which traces leave the graph.

    Parameters
    ----------
    graph
        Any road graph.
    steps
        Paths matched on it: `probe2road.matching.match.Matches.steps`.
    options
        Only ``max_jump``, ``min_jumps``, ``jump_turn`` and ``heading_length`` are used.

    Returns
    -------
    ndarray of int64, shape (n, 2)
        Rows of nodes, the smaller first; pairs that an edge joins are left out.

    Raises
    ------
    InputError
        If the steps name an edge that is not in the graph.

    Examples
    --------
    Two drives are lost for 60 m:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(160, 0), (300, 0)]], crs="EPSG:32616")
    >>> steps = pd.DataFrame({"trace_id": [1, 1, 2, 2], "edge": [0, 1, 0, 1], "forward": True})
    >>> jumped_gaps(graph, steps.assign(entered=False, left=False), GapOptions())
    array([[1, 2]])
    """
    trace, forward = steps["trace_id"].to_numpy(), steps["forward"].to_numpy(bool)
    edge = step_rows(graph, steps, where="fill_jumps")
    entered, left = (steps[name].to_numpy(bool) for name in ("entered", "left"))
    off = np.flatnonzero((trace[1:] == trace[:-1]) & ~left[:-1] & ~entered[1:])
    ends = graph.ends(reach=options.heading_length)
    lost, found_again = 2 * edge[off] + forward[off], 2 * edge[off + 1] + ~forward[off + 1]
    link = ends.position[found_again] - ends.position[lost]
    distance = np.hypot(*link.T)
    turn = np.maximum(angle_between(-ends.ahead[lost], link), angle_between(ends.ahead[found_again], link))
    pairs = np.sort(np.stack([ends.node[lost], ends.node[found_again]], axis=1), axis=1)
    fits = (pairs[:, 0] != pairs[:, 1]) & (distance > 0)
    fits &= (distance <= options.max_jump) & (turn <= options.jump_turn)
    pairs = pairs[fits]
    jumps = pd.DataFrame({"one": pairs[:, 0], "other": pairs[:, 1], "trace": trace[off[fits]]})
    traces = jumps.groupby(["one", "other"])["trace"].nunique()
    joined = np.sort(graph.end_rows, axis=1)
    found = traces.index[(traces >= options.min_jumps) & ~traces.index.isin(pd.MultiIndex.from_arrays(joined.T))]
    return np.array(found.to_list(), np.int64).reshape(-1, 2)
