"""Gap filling: link dead ends to the roads they were probably cut off from, and keep the links that traces drive.

Strategy
--------
Each dead end proposes at most three links (`probe2road.refinement.gaps.links`). Those that cross an edge are dropped.
What is left is taken from the shortest link to the longest, as long as it does not repeat one that was taken.
"""

from __future__ import annotations

import logging
from dataclasses import fields

import numpy as np
import pandas as pd
import shapely

from probe2road.errors import OptionError
from probe2road.graph.clean import drop_edges, merge_degree_two_nodes
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import split_edges
from probe2road.refinement.gaps.added import with_gap_edges
from probe2road.refinement.gaps.links import (
    NO_NODE,
    DeadEnds,
    GapOptions,
    Links,
    crosses,
    dead_ends,
    straight_on,
    to_dead_ends,
    to_edges_beside,
    within_reach,
)
from probe2road.refinement.gaps.stems import facing_stems
from probe2road.refinement.undriven import traces_per_edge

__all__ = ["GapOptions", "fill_gaps", "gap_weights", "prune_gaps"]

logger = logging.getLogger(__name__)

_NEW_NODE = 5.0  # m; links that hit an edge within this of each other share a node


def fill_gaps(graph: RoadGraph, *, options: GapOptions | None = None) -> RoadGraph:
    """Add edges of origin ``gap`` where roads seem to be interrupted.

    From every dead end, links may lead to

    1. the nearest dead end for which the turn is not sharper than ``max_turn`` at either end; turns count like detours,
       so that the ends of two interrupted roads that cross are joined across;
    2. what its straight extension hits first: a node where one is within ``snap`` of the hit, else the edge, which is
       split there;
    3. the nearest edge within ``beside`` that runs along it, as a mainline beside the end of its ramp, joined a
       little ahead. The paper does not have this rule; ``beside=0`` switches it off.
    4. Junctions are joined where roads that end in them face each other (`probe2road.refinement.gaps.stems`), as where
    the piece
       between two carriageways is lost. The paper does not have this rule; ``stem_turn=0`` switches it off.

    No link is longer than ``max_length`` or crosses an edge, links at one node differ by ``min_angle`` or more, and no
    node gets more than ``max_links``. The result does not depend on the order of the edges. A graph without gaps to
    fill is returned as it is.

    Parameters
    ----------
    graph
        Any road graph.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        Edges keep their ids; a split edge keeps its on the first part. Its parts share its attributes.

    Notes
    -----
    Paper, section III-B; METHOD 3.6 and 0.1 rows 16 to 18. Links are proposals: match traces with `gap_weights`, then
    call `prune_gaps`.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (100, 0)], [(130, 0), (200, 0)], [(50, -90), (50, -20)]]
    >>> filled = fill_gaps(graph_from_lines(lines, crs="EPSG:32616"))
    >>> for line in filled.edges.geometry[filled.edges["origin"] == "gap"]:
    ...     print(line)
    LINESTRING (50 -20, 50 0)
    LINESTRING (100 0, 130 0)
    """
    options = options or GapOptions()
    if not len(graph.edges):
        return graph
    lines = shapely.force_2d(graph.edges.geometry.to_numpy())
    ends = dead_ends(graph, options.heading_length)
    tree = shapely.STRtree(lines)
    proposed = [
        to_dead_ends(ends, options),
        straight_on(graph, lines, tree, ends, options),
        to_edges_beside(graph, lines, tree, ends, options),
    ]
    links = Links(*(np.concatenate([getattr(part, field.name) for part in proposed]) for field in fields(Links)))
    links = within_reach(ends, links, options)
    links = links.where(~crosses(graph, tree, ends, links))
    links = _chosen(ends, links, options)
    logger.info("added %d gap edges from %d dead ends", len(links.end), len(ends.edge))
    filled = _with_links(graph, ends, links) if len(links.end) else graph
    stems = facing_stems(filled, options)
    logger.info("added %d gap edges between junctions", len(stems))
    return with_gap_edges(filled, *filled.nodes.index.to_numpy()[stems.T]) if len(stems) else filled


def gap_weights(graph: RoadGraph, *, gap: float = 0.1) -> pd.Series:
    """Return the weight of every edge for map matching: 1, and ``gap`` for gap edges.

    Raises
    ------
    OptionError
        If the weight is not above 0 and at most 1.

    Notes
    -----
    The alphas of the paper's equation 1; METHOD 0.1 row 19.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = fill_gaps(graph_from_lines([[(0, 0), (100, 0)], [(130, 0), (200, 0)]], crs="EPSG:32616"))
    >>> gap_weights(graph).tolist()
    [1.0, 1.0, 0.1]
    """
    if not 0 < gap <= 1:
        raise OptionError(f"gap is {gap}", where="gap_weights", fix="use a number above 0 and at most 1")
    is_gap = graph.edges["origin"].to_numpy() == "gap"
    return pd.Series(np.where(is_gap, gap, 1.0), index=graph.edges.index, name="weight")


def prune_gaps(graph: RoadGraph, steps: pd.DataFrame, *, min_traces: int = 4) -> RoadGraph:
    """Remove gap edges that too few traces drove through, and merge the edges that they had split.

    Parameters
    ----------
    graph
        Result of `fill_gaps`.
    steps
        Matched paths on that graph: `probe2road.matching.match.Matches.steps`.
    min_traces
        Distinct traces that must enter a gap edge at one end and leave it at the other.

    Returns
    -------
    RoadGraph
        Attributes and turns as for `probe2road.graph.clean.merge_degree_two_nodes`; turns on removed edges are dropped.

    Raises
    ------
    OptionError
        If ``min_traces`` is negative.

    Notes
    -----
    METHOD 0.1 row 22.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = fill_gaps(graph_from_lines([[(0, 0), (100, 0)], [(50, -90), (50, -20)]], crs="EPSG:32616"))
    >>> nobody = pd.DataFrame({"trace_id": [], "edge": [], "entered": [], "left": []})
    >>> len(graph.edges), len(prune_gaps(graph, nobody).edges)
    (4, 2)
    """
    if min_traces < 0:
        raise OptionError(f"min_traces is {min_traces}", where="prune_gaps", fix="use a number that is not negative")
    through = steps[steps["entered"].astype(bool) & steps["left"].astype(bool)]
    dropped = (graph.edges["origin"] == "gap").to_numpy() & (traces_per_edge(graph, through) < min_traces)
    why = f"of origin gap with fewer than {min_traces} traces"
    return merge_degree_two_nodes(drop_edges(graph, dropped, why=why))


def _chosen(ends: DeadEnds, links: Links, options: GapOptions) -> Links:
    """Choose links, the shortest first: none similar to another at its node, and not too many at one node."""
    vector = links.target - ends.position[links.end]
    order = np.lexsort([*links.target.T, *ends.position[links.end].T, np.hypot(*vector.T).round(6)])
    at: dict[tuple[str, int, int], list[float]] = {}
    taken: list[int] = []
    for link in order:
        bearing = float(np.degrees(np.arctan2(vector[link, 1], vector[link, 0])))
        away, towards = ("node", int(ends.node[links.end[link]]), 0), ("node", int(links.node[link]), 0)
        if links.node[link] == NO_NODE:
            towards = ("edge", int(links.edge[link]), round(links.along[link] / _NEW_NODE))
        here, there = at.setdefault(away, []), at.setdefault(towards, [])
        if _has_room(here, bearing, options) and _has_room(there, bearing + 180.0, options):
            here.append(bearing)
            there.append(bearing + 180.0)
            taken.append(int(link))
    return links.where(np.array(taken, np.int64))


def _has_room(bearings: list[float], bearing: float, options: GapOptions) -> bool:
    """Tell whether a node whose links have the given bearings (degrees) can take one more link."""
    near = any(abs((other - bearing + 180.0) % 360.0 - 180.0) < options.min_angle for other in bearings)
    return not near and len(bearings) < options.max_links


def _with_links(graph: RoadGraph, ends: DeadEnds, links: Links) -> RoadGraph:
    """Split the edges on which links end, and add the links as edges."""
    into = links.node == NO_NODE
    edge_ids = graph.edges.index.to_numpy()
    graph, made = split_edges(graph, edge_ids[links.edge[into]], links.along[into], merge=_NEW_NODE)
    names = graph.nodes.index.to_numpy()  # the old nodes come first, in their order
    u = names[ends.node[links.end]]
    v = names[links.node]
    v[into] = made
    return with_gap_edges(graph, u, v)
