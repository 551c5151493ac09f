"""Nodes and short edges split by groups of the edge ends that meet there."""

from __future__ import annotations

from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import led_to
from probe2road.graph.tables import finish_edges
from probe2road.refinement.junctions.passages import Places

__all__ = ["open_artefacts", "split_nodes"]


_TRIM = (5.0, 20.0)  # m; least and most that is cut off a road beside an artefact, where thinning has bent it


_MAX_CUT = 0.4  # share of an edge that is cut off at most


def split_nodes(graph: RoadGraph, places: Places, group: NDArray[np.int64]) -> RoadGraph:
    """Split nodes into one node for each group of edge ends.

    Parameters
    ----------
    graph
        Any road graph.
    places
        The ends at every node, as `probe2road.refinement.junctions.passages.places_at_nodes` gives them.
    group
        Shape (m,): number of the group of each of them. Groups of one node with different numbers part.

    Returns
    -------
    RoadGraph
        The largest group keeps the node (of groups of one size, that with the first end); each other has a new one at
        the same position. Turns are those of the input and must be counted anew.
    """
    table = pd.DataFrame({"node": places.junction, "end": places.end, "group": group})
    groups = table.groupby(["node", "group"], sort=False).agg(size=("end", "size"), first=("end", "min")).reset_index()
    groups = groups.sort_values(["node", "size", "first"], ascending=[True, False, True])
    ids = graph.nodes.index.to_numpy()
    extra = groups["node"].duplicated().to_numpy()
    groups["id"] = ids[groups["node"]]
    first = int(ids.max(initial=-1)) + 1
    groups.loc[extra, "id"] = np.arange(first, first + int(extra.sum()))
    new = graph.nodes.iloc[groups["node"].to_numpy()[extra]].set_axis(groups["id"].to_numpy()[extra])
    node = table.merge(groups[["node", "group", "id"]], on=["node", "group"])
    of_end = np.empty(len(node), np.int64)
    of_end[node["end"]] = node["id"]
    edges = graph.edges.assign(u=of_end[0::2], v=of_end[1::2])
    nodes = pd.concat([graph.nodes, new]).rename_axis("node") if extra.any() else graph.nodes
    return replace(graph, nodes=nodes, edges=finish_edges(edges))


def open_artefacts(
    graph: RoadGraph, inner: NDArray[np.int64], end: NDArray[np.int64], group: NDArray[np.int64]
) -> RoadGraph:
    """Remove edges together with their nodes, and give each group of edge ends around them a node of its own.

    What thinning has bent towards the removed edge is cut off: half its length, but 5 m to 20 m. A group of two ends is
    one road, which is led straight across.

    Parameters
    ----------
    graph
        Any road graph.
    inner
        Shape (m,): rows of the edges to remove, each once for every end around it; no two of them share a node.
    end
        Shape (m,): the ends around them.
    group
        Shape (m,): the groups of these ends.

    Returns
    -------
    RoadGraph
        Turns are those of the input and must be counted anew.
    """
    if not len(inner):
        return graph
    lines = graph.edges.geometry.to_numpy().copy()
    length = shapely.length(lines)
    cut = np.minimum(np.clip(length[inner] / 2, *_TRIM), _MAX_CUT * length[end // 2])
    from_start = np.where(end % 2 == 0, cut, length[end // 2] - cut)
    points = shapely.line_interpolate_point(lines[end // 2], from_start)
    has_z = bool(shapely.has_z(graph.nodes.geometry.to_numpy()).any())
    place = pd.DataFrame(shapely.get_coordinates(points, include_z=has_z)).assign(inner=inner, group=group)
    middle = place.groupby(["inner", "group"], sort=True).mean()
    first = int(graph.nodes.index.max()) + 1
    ids = pd.Series(np.arange(first, first + len(middle)), index=middle.index)
    new = gpd.GeoDataFrame(geometry=shapely.points(middle.to_numpy()), index=ids.to_numpy(), crs=graph.crs)
    node = ids.loc[pd.MultiIndex.from_arrays([inner, group])].to_numpy()

    cuts = np.zeros((len(lines), 2))
    target = np.full((len(lines), 2), -1)
    cuts[end // 2, end % 2], target[end // 2, end % 2] = cut, node
    for row in np.unique(end // 2):
        goals = [new.geometry[goal] if goal >= 0 else None for goal in target[row]]
        lines[row] = led_to(lines[row], cuts[row], goals)
    uv = np.where(target >= 0, target, graph.edges[["u", "v"]].to_numpy())
    old = graph.edges[["u", "v"]].to_numpy()[np.unique(inner)].ravel()
    edges = graph.edges.assign(u=uv[:, 0], v=uv[:, 1], geometry=lines)
    edges = edges.drop(index=graph.edges.index[np.unique(inner)])
    nodes = pd.concat([graph.nodes.drop(index=old), new]).rename_axis("node")
    return replace(graph, nodes=nodes, edges=finish_edges(edges))
