"""Roads of a map that nobody drove although many drives passed their ends."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.comparison.overlap import Roads

__all__ = ["expected_passages"]

_WEIGHTS = {
    **{"motorway": 8.0, "trunk": 6.0, "primary": 5.0, "secondary": 3.0, "tertiary": 2.0},
    **{"motorway_link": 2.0, "trunk_link": 2.0, "primary_link": 1.5, "secondary_link": 1.0, "tertiary_link": 1.0},
    **{"unclassified": 1.0, "residential": 0.7, "living_street": 0.3, "service": 0.2},
}  # what share of the drives takes a road of this class, against others at the same junction
_UNKNOWN = 1.0  # the weight of a road of any other class
_ROUNDS = 5  # roads that nobody drove, one after the other, through which drives are followed


def expected_passages(theirs: Roads, flows: pd.DataFrame, driven: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return how many drives would have passed the edges that nobody drove, if they were as attractive as their class.

    Drives that arrive at a node are shared among the roads that can be left on, by their class, and drives that leave
    a node among those that can be arrived on. Of the two numbers for an edge, from its beginning and from its end, the
    smaller one counts: a road that leads out of the area that is driven has none.

    Parameters
    ----------
    theirs
        The base map; a column ``highway`` gives the class.
    flows
        From `probe2road.comparison.flows.base_flows`.
    driven
        Shape (E,): which edges were driven.

    Returns
    -------
    ndarray, shape (E,)
        0 for edges that were driven.

    Examples
    --------
    >>> from probe2road.comparison.overlap import roads_of
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (90, 0)], [(90, 0), (200, 0)], [(200, 0), (300, 0)], [(90, 0), (150, 60), (200, 0)]]
    >>> roads = roads_of(graph_from_lines(lines, crs="EPSG:32616", attributes=pd.DataFrame({"oneway": ["yes"] * 4})))
    >>> flows = pd.DataFrame({"along": [30.0, 30, 30, 0], "against": 0.0})
    >>> expected_passages(roads, flows, np.array([True, True, True, False])).tolist()
    [0.0, 0.0, 0.0, 15.0]
    """
    network, edges, n = theirs.network, theirs.graph.edges, len(theirs.sense)
    classes = edges["highway"].astype("str") if "highway" in edges else pd.Series("", index=edges.index)
    weight = classes.map(_WEIGHTS).fillna(_UNKNOWN).to_numpy(np.float64)
    # Each edge once for each direction in which it is open.
    edge = np.concatenate([np.flatnonzero(theirs.sense >= 0), np.flatnonzero(theirs.sense <= 0)])
    ahead = np.arange(len(edge)) < np.count_nonzero(theirs.sense >= 0)
    tail = np.where(ahead, network.u[edge], network.v[edge])
    head = np.where(ahead, network.v[edge], network.u[edge])
    flow = np.where(ahead, flows["along"].to_numpy()[edge], flows["against"].to_numpy()[edge])
    flow = np.where(driven[edge], flow, 0.0)
    back = _reversed_arcs(edge, n)
    sides = []
    for near, far in ((tail, head), (head, tail)):
        share = weight[edge] / np.bincount(near, weights=weight[edge], minlength=len(network.node_xy))[near]
        passing = flow.copy()
        for _ in range(_ROUNDS):
            arriving = np.bincount(far, weights=passing, minlength=len(network.node_xy))
            turned = np.where(back >= 0, passing[back], 0.0)  # nobody drives into a road to turn and come back
            passing = np.where(driven[edge], flow, (arriving[near] - turned) * share)
        sides.append(passing)
    expected = np.where(driven[edge], 0.0, np.minimum(*sides))
    return np.bincount(edge, weights=expected, minlength=n).astype(np.float64)


def _reversed_arcs(edge: NDArray[np.int64], n_edges: int) -> NDArray[np.int64]:
    """Return for every arc the row of the arc of its edge in the other direction, -1 if that is closed."""
    row = np.arange(len(edge))
    first, last = np.full(n_edges, -1, np.int64), np.full(n_edges, -1, np.int64)
    last[edge] = row
    first[edge[::-1]] = row[::-1]
    other = np.where(first[edge] == row, last[edge], first[edge])
    return np.where(other == row, -1, other)
