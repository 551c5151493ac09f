"""Roads interrupted between two junctions: stems of two T-junctions that face each other.

Where a road crosses two carriageways, a mask often loses the piece between them. What is left are two T-junctions and
no dead end, so the rules for dead ends (`probe2road.refinement.gaps.links`) find nothing. The road is straight there,
on a bridge or under one, which makes the rule simple.

Strategy
--------
An edge end is a stem if no other end at its node continues it. Stems that face each other are paired with their
nearest, and a pair is a link where each is the other's choice.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from probe2road.graph.roadgraph import RoadGraph
from probe2road.refinement.gaps.links import GapOptions, angle_between

__all__ = ["facing_stems"]

_CONTINUED = 45.0  # degrees; a smaller turn to another end at the node continues a road
_DETOUR = 1.5  # times the distance; nodes that an edge up to this long joins need no link


def facing_stems(graph: RoadGraph, options: GapOptions) -> NDArray[np.int64]:
    """List the pairs of nodes that a straight link across a gap should join.

    Parameters
    ----------
    graph
        Any road graph.
    options
        Only ``max_length``, ``heading_length`` and ``stem_turn`` are used.

    Returns
    -------
    ndarray of int64, shape (n, 2)
        Rows of nodes, the smaller first; at least one of the two is a junction.

    Examples
    --------
    Two carriageways, and a road across them that lacks the piece between:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (50, 0)], [(50, 0), (99, 0)], [(0, 20), (50, 20)], [(50, 20), (99, 20)]]
    >>> lines += [[(50, -60), (50, 0)], [(50, 20), (50, 80)]]
    >>> graph = graph_from_lines(lines, crs="EPSG:32616")
    >>> pairs = facing_stems(graph, GapOptions())
    >>> shapely.get_coordinates(graph.nodes.geometry.to_numpy()[pairs[0]]).tolist()
    [[50.0, 0.0], [50.0, 20.0]]
    """
    none = np.zeros((0, 2), np.int64)
    if options.stem_turn == 0 or graph.edges.empty:
        return none
    node, position, ahead, at_junction = _stems(graph, options.heading_length)
    pairs = KDTree(position).query_pairs(options.max_length, output_type="ndarray") if len(node) else none
    one, other = np.concatenate([pairs, np.flip(pairs, 1)]).T
    vector = position[other] - position[one]
    distance = np.hypot(*vector.T)
    turn = np.maximum(angle_between(ahead[one], vector), angle_between(-ahead[other], vector))
    fits = (node[one] != node[other]) & (at_junction[one] | at_junction[other])
    fits &= (turn <= options.stem_turn) & (distance > 0)
    one, other, distance = one[fits], other[fits], distance[fits]
    order = np.lexsort([*position[other].T, distance.round(6), one])
    choice = np.full(len(node), -1)
    choice[one[order][::-1]] = other[order][::-1]  # the nearest is written last
    stem = np.flatnonzero(choice >= 0)
    stem = stem[(choice[choice[stem]] == stem) & (stem < choice[stem])]
    links = np.unique(np.sort(np.stack([node[stem], node[choice[stem]]], axis=1), axis=1), axis=0)
    return links[~_joined(graph, links) & ~_crossing(graph, links)]


def _stems(
    graph: RoadGraph, reach: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Collect edge ends that no other edge continues: node row, position, direction out of the road, at a junction."""
    measured = graph.ends(reach=reach)
    node, position, ahead = measured.node, measured.position, -measured.ahead
    ends = pd.DataFrame({"node": node, "end": np.arange(len(node))})
    met = ends.merge(ends, on="node", suffixes=("", "_other"))
    met = met[met["end"] != met["end_other"]]
    straight = angle_between(ahead[met["end"]], -ahead[met["end_other"]]) <= _CONTINUED
    continued = np.isin(ends["end"], met["end"][straight])
    degree = np.bincount(node, minlength=len(graph.nodes))[node]
    kept = ~continued & ahead.any(axis=1) & (degree != 2)
    return node[kept], position[kept], ahead[kept], degree[kept] > 2


def _joined(graph: RoadGraph, links: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which links have an edge between the same nodes that is hardly longer than the link."""
    place = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    ends = np.sort(graph.end_rows, axis=1)
    shortest = graph.edges["length"].groupby([ends[:, 0], ends[:, 1]]).min()
    length = shortest.reindex(pd.MultiIndex.from_arrays(links.T)).to_numpy() if len(links) else np.zeros(0)
    away = np.hypot(*(place[links[:, 1]] - place[links[:, 0]]).T) if len(place) else np.zeros(0)
    return np.asarray(length <= _DETOUR * away)


def _crossing(graph: RoadGraph, links: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which links cross an edge that does not end at one of their nodes."""
    place = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    bodies = shapely.linestrings(place[links]) if len(links) else np.zeros(0, object)
    link, edge = shapely.STRtree(graph.edges.geometry.to_numpy()).query(bodies, predicate="intersects")
    own = (graph.end_rows[edge][:, :, None] == links[link][:, None, :]).any(axis=(1, 2))
    crossing = np.zeros(len(links), bool)
    crossing[link[~own]] = True
    return crossing
