"""Turns at junctions that could have been made and that no drive made: as far as drives tell, they cannot be made."""

from __future__ import annotations

import numpy as np
import pandas as pd

from probe2road.errors import OptionError
from probe2road.graph.direction import driving_direction
from probe2road.graph.roadgraph import RoadGraph

__all__ = ["untaken_turns"]


def untaken_turns(graph: RoadGraph, *, min_expected: float = 5.0) -> pd.DataFrame:
    """Return the turns that drives would have made by now if they were possible.

    If drives chose their way on at a junction whatever road they came from, a turn would be made by as many as arrive
    on its first edge, times the share of all that leave on its second. A turn that nobody made although so many are
    expected is not possible, or not allowed: of 5 expected, none is seen by chance once in 150 times.

    Parameters
    ----------
    graph
        With the turns that drives made. One-way edges run in their driving direction.
    min_expected
        How many drives must be expected.

    Returns
    -------
    DataFrame
        Columns ``from_edge``, ``via_node``, ``to_edge``, ``expected``; ordered by the first three. Turns back onto the
        same edge, and loops, are not among them.

    Raises
    ------
    OptionError
        If ``min_expected`` is not positive.

    Examples
    --------
    Two roads that a mask has tied to each other at a bridge:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> from dataclasses import replace
    >>> lines = [[(-50, 0), (0, 0)], [(0, 0), (50, 0)], [(0, -50), (0, 0)], [(0, 0), (0, 50)]]
    >>> graph = graph_from_lines(lines, crs="EPSG:32616", attributes=pd.DataFrame({"oneway": ["yes"] * 4}))
    >>> made = pd.DataFrame({"from_edge": [0, 2], "via_node": [1, 1], "to_edge": [1, 3], "count": [30, 20]})
    >>> untaken_turns(replace(graph, turns=made))[["from_edge", "to_edge", "expected"]].values.tolist()
    [[0.0, 3.0, 12.0], [2.0, 1.0, 12.0]]
    """
    if not min_expected > 0:
        raise OptionError(f"min_expected is {min_expected}", where="untaken_turns", fix="use a positive number")
    edges = graph.edges[graph.edges["u"] != graph.edges["v"]]
    way = driving_direction(edges).fillna(0).to_numpy()
    ends = edges[["u", "v"]].rename_axis("edge").reset_index()
    ahead, against = ends[way >= 0], ends[way <= 0]
    arrive = _at_nodes((ahead, "v"), (against, "u")).rename(columns={"edge": "from_edge"})
    leave = _at_nodes((ahead, "u"), (against, "v")).rename(columns={"edge": "to_edge"})
    made, at = graph.turns, "via_node"
    turns = arrive.merge(leave, on=at)
    turns = turns[turns["from_edge"] != turns["to_edge"]]
    for edge, name in (("from_edge", "arrived"), ("to_edge", "left")):
        counts = made.groupby([edge, at], as_index=False)["count"].sum()
        turns = turns.merge(counts.rename(columns={"count": name}), on=[edge, at])
    turns["expected"] = turns["arrived"] * turns["left"] / turns[at].map(made.groupby(at)["count"].sum())
    columns = ["from_edge", at, "to_edge"]
    taken = pd.MultiIndex.from_frame(made[columns])
    untaken = ~pd.MultiIndex.from_frame(turns[columns]).isin(taken)
    chosen = turns[untaken & (turns["expected"] >= min_expected).to_numpy(bool)]
    return chosen[[*columns, "expected"]].astype({"expected": np.float64}).sort_values(columns, ignore_index=True)


def _at_nodes(*parts: tuple[pd.DataFrame, str]) -> pd.DataFrame:
    """Return edges and the node at one of their ends, as columns ``edge`` and ``via_node``."""
    return pd.concat(
        [table[["edge", end]].rename(columns={end: "via_node"}) for table, end in parts], ignore_index=True
    )
