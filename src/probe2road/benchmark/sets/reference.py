"""Reference graphs of the benchmark: the roads that enough drives passed, known without any matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from probe2road.errors import InputError, OptionError
from probe2road.graph.ends import end_rows
from probe2road.graph.roadgraph import RoadGraph
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["MAIN_ROADS", "PRIMARY_ROADS", "labelled_reference", "main_roads"]

MAIN_ROADS = ("motorway", "motorway_link", "trunk", "trunk_link")
PRIMARY_ROADS = ("primary", "primary_link")


def labelled_reference(reference: RoadGraph, *, min_drives: int = 4) -> RoadGraph:
    """Keep the edges that enough drives passed: the reference for labels and for scores.

    The drives of the simulator begin and end at nodes, so every piece of an edge was passed by as many drives as the
    whole, and cutting edges first would change nothing.

    Parameters
    ----------
    reference
        With the true number of drives as ``support``.
    min_drives
        The N of the paper.

    Returns
    -------
    RoadGraph
        Edges keep their ids; nodes without an edge are left out, and so are turns from or onto an edge that is.

    Raises
    ------
    InputError
        If an edge has no number of drives.
    OptionError
        If the minimum is negative.

    Notes
    -----
    METHOD 0.1 row 28.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (90, 0)], [(90, 0), (90, 90)]], crs="EPSG:32616")
    >>> counted = replace(graph, edges=graph.edges.assign(support=[4, 3]))
    >>> labelled_reference(counted).edges.index.tolist(), labelled_reference(counted).nodes.index.tolist()
    ([0], [0, 1])
    """
    if min_drives < 0:
        raise OptionError(f"min_drives is {min_drives}", where="labelled_reference", fix="use 0 or more")
    support = reference.edges["support"]
    if support.isna().any():
        missing = support.index[support.isna()][0]
        raise InputError(f"edge {missing} has no number of drives", where="reference", fix="count the drives first")
    edges = reference.edges[(support >= min_drives).to_numpy(bool)]
    nodes = reference.nodes[reference.nodes.index.isin(pd.concat([edges["u"], edges["v"]]))]
    turns = reference.turns
    kept = turns["from_edge"].isin(edges.index) & turns["to_edge"].isin(edges.index)
    return replace(reference, nodes=nodes, edges=edges, turns=turns[kept].reset_index(drop=True))


def main_roads(network: RoadNetwork, *, main: Sequence[str] = MAIN_ROADS, reach: float = 300.0) -> RoadNetwork:
    """Keep main roads, and the parts of other roads near places where they meet main roads.

    Read the network with the classes that shall be there at all; heights are solved by then, so that a road that is
    left out here still has its bridge over one that stays.

    Parameters
    ----------
    network
        Any road network.
    main
        Highway classes that are kept everywhere.
    reach
        Other sections are kept where they begin within so many metres of a main road, along the roads.

    Returns
    -------
    RoadNetwork
        Sections and nodes keep their ids. Where there is no main road, everything is kept.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> lines = [[(0, 0), (900, 0)], [(900, 0), (900, 400)], [(900, 400), (900, 800)]]
    >>> network = network_from_sections(lines, crs="EPSG:32616", highway=["trunk", "primary", "primary"])
    >>> main_roads(network).sections.index.tolist()
    [0, 1]
    """
    sections = network.sections
    kept = sections["highway"].isin(main).to_numpy()
    if not kept.any():
        return network
    u, v = end_rows(network.nodes, sections).T
    away = np.full(len(network.nodes), np.inf)
    away[u[kept]] = away[v[kept]] = 0.0
    length, changed = sections.length.to_numpy(), True
    while changed:  # a few rounds: the reach is short, and so are the ways within it
        before = away.copy()
        np.minimum.at(away, v, before[u] + length)
        np.minimum.at(away, u, before[v] + length)
        away[away > reach] = np.inf
        changed = bool((away < before).any())
    kept = kept | (np.minimum(away[u], away[v]) <= reach)
    chosen = sections[kept]
    nodes = network.nodes[network.nodes.index.isin(pd.concat([chosen["u"], chosen["v"]]))]
    forbidden = network.restrictions
    known = forbidden["from_section"].isin(chosen.index) & forbidden["to_section"].isin(chosen.index)
    return replace(network, sections=chosen, nodes=nodes, restrictions=forbidden[known].reset_index(drop=True))
