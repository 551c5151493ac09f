"""The choice of proposed links that become edges of the graph (METHOD 3.6, insertion)."""

from __future__ import annotations

import logging
from collections import defaultdict
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.baselines.deepmg.links import (
    NO_NODE,
    Link,
    LinkOptions,
    angle_stretch,
    bearing_difference,
    propose_links,
)
from probe2road.baselines.deepmg.variants import Variant
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import split_edges
from probe2road.graph.tables import finish_edges

__all__ = ["add_links", "choose_links"]

logger = logging.getLogger(__name__)

_Place = tuple[int, float]  # (NO_NODE - 1 - edge, m along it), or (node, 0)


def add_links(graph: RoadGraph, variant: Variant, options: LinkOptions | None = None) -> RoadGraph:
    """Add the links of DeepMG to a graph, as edges of origin ``gap``.

    Parameters
    ----------
    graph
        From `probe2road.baselines.deepmg.mask_graph.mask_graph`.
    variant, options
        As for `probe2road.baselines.deepmg.links.propose_links`.

    Returns
    -------
    RoadGraph
        Edges that links lead into are split there. A graph without dead ends comes back as it is.

    Examples
    --------
    >>> from probe2road.baselines.deepmg.variants import find_variant
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(50, -90), (50, -20)]], crs="EPSG:32616")
    >>> add_links(graph, find_variant("fixed")).edges[["origin", "length"]].values.tolist()
    [['segmentation', 50.0], ['segmentation', 70.0], ['segmentation', 50.0], ['gap', 20.0]]
    """
    options = options or LinkOptions()
    proposed = propose_links(graph, variant, options)
    stretch = 1.0 if variant.true_angles or not proposed else angle_stretch(graph)
    links = choose_links(proposed, graph.degrees().to_numpy(), min_angle=options.min_angle, stretch=stretch)
    logger.info("added %d of %d links between roads", len(links), len(proposed))
    return _with_edges(graph, links) if links else graph


def choose_links(
    proposed: list[Link], degree: NDArray[np.int64], *, min_angle: float, stretch: float = 1.0
) -> list[Link]:
    """Choose one of several links that end at one place in similar directions.

    Links are taken in the order of their places on the edges they lead to. One that is not shorter than a similar link
    at either of its ends is refused. Otherwise it replaces the similar ones, except those with an end of degree 2,
    which would become a dead end again.

    Parameters
    ----------
    proposed
        The links.
    degree
        Shape (nodes,): edges at every node, without links.
    min_angle
        Degrees below which two links at one place are similar.
    stretch
        See `probe2road.baselines.deepmg.links.angle_stretch`.
    """
    at: dict[_Place, list[Link]] = defaultdict(list)

    def degree_at(place: _Place) -> int:
        return (int(degree[place[0]]) if place[0] >= 0 else 2) + len(at[place])

    for link in sorted(proposed, key=lambda one: (one.edge, one.along, one.start)):
        similar = {
            other
            for place in _places(link)
            for other in at[place]
            if bearing_difference(_from(link, place), _from(other, place), stretch) < min_angle
        }
        if any(link.length >= other.length for other in similar):
            continue
        for other in sorted(similar):
            if all(degree_at(place) != 2 for place in _places(other)):
                for place in _places(other):
                    at[place].remove(other)
        for place in _places(link):
            at[place].append(link)
    return sorted({link for links in at.values() for link in links})


def _places(link: Link) -> tuple[_Place, _Place]:
    """Return the two places that a link joins."""
    target = (link.node, 0.0) if link.node != NO_NODE else (NO_NODE - 1 - link.edge, round(link.along, 3))
    return (link.start, 0.0), target


def _from(link: Link, place: _Place) -> tuple[float, float]:
    """Return the vector of a link, away from one of its places."""
    return link.vector if place == (link.start, 0.0) else (-link.vector[0], -link.vector[1])


def _with_edges(graph: RoadGraph, links: list[Link]) -> RoadGraph:
    """Split the edges on which links end, and add the links."""
    names, edge_ids = graph.nodes.index.to_numpy(), graph.edges.index.to_numpy()
    inside = np.array([link.node == NO_NODE for link in links])
    along = np.array([round(link.along, 3) for link in links])
    target_edge = edge_ids[[link.edge for link in links]]
    u, v = names[[link.start for link in links]], names[[max(link.node, 0) for link in links]]
    graph, made = split_edges(graph, target_edge[inside], along[inside])
    v[inside] = made
    first = int(graph.edges.index.max()) + 1
    ends = [shapely.get_coordinates(graph.nodes.geometry[node].to_numpy()) for node in (u, v)]
    new = gpd.GeoDataFrame(
        {"u": u, "v": v, "origin": "gap"},
        geometry=shapely.linestrings(np.stack(ends, axis=1)),
        index=np.arange(first, first + len(u)),
        crs=graph.crs,
    )
    return replace(graph, edges=finish_edges(pd.concat([graph.edges, finish_edges(new)])))
