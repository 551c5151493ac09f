"""Edges that too few traces drove on: lines that are no roads, and rungs between parallel roads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.bounds import NotNegative
from probe2road.errors import OptionError
from probe2road.graph.clean import drop_edges
from probe2road.graph.roadgraph import RoadGraph
from probe2road.options import checked

__all__ = ["RungOptions", "drop_undriven", "traces_per_edge"]


@dataclass(frozen=True)
@checked
class RungOptions:
    """Which edges are rungs: short edges between two junctions, driven only in the errors of the map matching."""

    max_length: NotNegative[float] = 60.0  # m; longer edges are roads; 0 takes none for a rung
    min_traces: NotNegative[int] = 4  # an edge with as many traces is a road
    min_share: NotNegative[float] = 0.3  # an edge with this share of the traces at its quieter end is a road, too


def drop_undriven(
    graph: RoadGraph, steps: pd.DataFrame, *, min_traces: int = 1, rungs: RungOptions | None = None
) -> RoadGraph:
    """Remove edges that too few traces drove on.

    Where two roads come near each other, a mask joins them, and the errors of the matching lead a trace or two over
    that rung. On a quiet street a few traces are all there are: a rung is told by how few they are beside those that
    pass it.

    Parameters
    ----------
    graph
        Any road graph.
    steps
        Matched paths on that graph: `probe2road.matching.match.Matches.steps`.
    min_traces
        Distinct traces that must be matched to an edge; 0 keeps all.
    rungs
        Which edges need more than that; none if it is None.

    Returns
    -------
    RoadGraph
        Not merged; turns on removed edges are dropped. The graph itself where every edge is driven.

    Raises
    ------
    OptionError
        If ``min_traces`` is negative.

    Examples
    --------
    Two roads, ten traces on each, and one trace that was matched over the rung between them:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (90, 0)], [(90, 0), (180, 0)], [(0, 8), (90, 8)], [(90, 8), (180, 8)], [(90, 0), (90, 8)]]
    >>> graph = graph_from_lines(lines, crs="EPSG:32616")
    >>> driven = [(trace, 2 * (trace % 2) + part) for trace in range(20) for part in (0, 1)] + [(7, 4)]
    >>> steps = pd.DataFrame(driven, columns=["trace_id", "edge"])
    >>> drop_undriven(graph, steps).edges.index.tolist()
    [0, 1, 2, 3, 4]
    >>> drop_undriven(graph, steps, rungs=RungOptions()).edges.index.tolist()
    [0, 1, 2, 3]
    """
    if min_traces < 0:
        raise OptionError(f"min_traces is {min_traces}", where="drop_undriven", fix="use a number that is not negative")
    traces = traces_per_edge(graph, steps)
    dropped = traces < min_traces
    if rungs is not None:
        dropped |= _are_rungs(graph, traces, rungs)
    return drop_edges(graph, dropped, why="that too few traces drove on")


def traces_per_edge(graph: RoadGraph, steps: pd.DataFrame) -> NDArray[np.int64]:
    """Count the distinct traces that have a step on each edge, shape (E,)."""
    traces = steps.groupby("edge")["trace_id"].nunique()
    return traces.reindex(graph.edges.index, fill_value=0).to_numpy(np.int64)


def _are_rungs(graph: RoadGraph, traces: NDArray[np.int64], options: RungOptions) -> NDArray[np.bool_]:
    """Tell which edges are rungs, shape (E,)."""
    u, v = graph.edges["u"], graph.edges["v"]
    degree = graph.degrees()
    between = (degree[u].to_numpy() >= 3) & (degree[v].to_numpy() >= 3)
    short = graph.edges["length"].to_numpy() <= options.max_length
    most = pd.Series(np.tile(traces, 2)).groupby(np.concatenate([u, v])).max()
    passing = np.minimum(most[u].to_numpy(), most[v].to_numpy())
    return np.asarray(between & short & (traces < options.min_traces) & (traces < options.min_share * passing))
