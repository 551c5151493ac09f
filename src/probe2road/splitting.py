"""Splitting: edges cut at places on them, nodes taken apart by the edge ends that meet there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from probe2road.passages import Places
from probe2road.roadgraph import RoadGraph, finish_edges

__all__ = ["led_to", "open_artefacts", "split_edges", "split_nodes"]

_TRIM = (5.0, 20.0)  # m; least and most that is cut off a road beside an artefact, where thinning has bent it
_MAX_CUT = 0.4  # of an edge


def split_edges(
    graph: RoadGraph, edge: NDArray[np.int64], along: NDArray[np.float64], *, merge: float = 0.0
) -> tuple[RoadGraph, NDArray[np.int64]]:
    """Cut edges at places on them.

    Parameters
    ----------
    graph
        Any road graph.
    edge
        Shape (n,): edge ids, in any order and repeated at will.
    along
        Shape (n,): metres from the start of the edge, in plan, inside it.
    merge
        Places on one edge that follow each other within this distance (m) become one node, at their mean.

    Returns
    -------
    RoadGraph
        Old nodes first. The first part of an edge keeps its id; parts have its attributes.
    ndarray of int64
        Shape (n,): the node made for each place.

    Examples
    --------
    >>> from probe2road.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
    >>> cut, nodes = split_edges(graph, np.array([0, 0]), np.array([70.0, 30.0]))
    >>> cut.edges["length"].to_dict(), nodes.tolist()
    ({0: 30.0, 1: 40.0, 2: 30.0}, [3, 2])
    """
    if not len(edge):
        return graph, np.zeros(0, np.int64)
    places = pd.DataFrame({"edge": edge, "along": along}).sort_values(["edge", "along"])
    far = (places["edge"].diff() != 0) | (places["along"].diff() > merge)
    places["cut"] = far.cumsum() - 1
    cuts = places.groupby("cut").agg(edge=("edge", "first"), along=("along", "mean"))
    lines = graph.edges.geometry
    points = shapely.line_interpolate_point(lines[cuts["edge"]].to_numpy(), cuts["along"].to_numpy())
    # Numbered by place, so that the ids do not depend on the order of the edges.
    order = np.lexsort(shapely.get_coordinates(points).T)
    first = int(graph.nodes.index.max()) + 1
    cuts["node"] = 0
    cuts.iloc[order, cuts.columns.get_loc("node")] = np.arange(first, first + len(cuts))
    if not shapely.has_z(graph.nodes.geometry.to_numpy()).any():
        points = shapely.force_2d(points)
    new = gpd.GeoDataFrame(geometry=points[order], index=np.arange(first, first + len(cuts)))
    nodes = pd.concat([graph.nodes, new.set_crs(graph.crs)]).rename_axis("node")
    made = cuts["node"].to_numpy()[places["cut"].sort_index().to_numpy()]
    return _with_parts(replace(graph, nodes=nodes), cuts), made


def _with_parts(graph: RoadGraph, cuts: pd.DataFrame) -> RoadGraph:
    """Replace edges by their parts between cuts, which are sorted along each edge."""
    free = int(graph.edges.index.max()) + 1
    parts: list[dict[str, Any]] = []
    last: dict[int, int] = {}
    for edge, own in sorted(cuts.groupby("edge"), key=lambda item: int(item[1]["node"].min())):
        row = graph.edges.loc[edge]
        stops = [0.0, *own["along"], float(row.geometry.length)]
        nodes = [row["u"], *own["node"], row["v"]]
        for k in range(len(stops) - 1):
            name = int(edge) if k == 0 else free
            free += k > 0
            line = substring(row.geometry, stops[k], stops[k + 1])
            parts.append({"edge": name, "of": edge, "u": nodes[k], "v": nodes[k + 1], "geometry": line})
            last[int(edge)] = name
    table = pd.DataFrame(parts)
    whole = graph.edges[~graph.edges.index.isin(table["of"])]
    cut = graph.edges.loc[table["of"]].assign(
        u=table["u"].to_numpy(), v=table["v"].to_numpy(), geometry=table["geometry"].to_numpy()
    )
    cut.index = pd.Index(table["edge"].to_numpy(), name="edge")
    # First parts stand where their edge stood, all others at the end.
    order = [*graph.edges.index, *(name for name in table["edge"] if name not in last)]
    edges = finish_edges(pd.concat([whole, cut]).loc[order])
    return replace(graph, edges=edges, turns=_turns_of_parts(graph, last))


def _turns_of_parts(graph: RoadGraph, last: dict[int, int]) -> pd.DataFrame:
    """Give turns at the end of a cut edge the id of its last part; those at its start keep theirs."""
    turns = graph.turns.copy()
    stop = graph.edges["v"]
    for column in ("from_edge", "to_edge"):
        at_stop = turns[column].map(stop) == turns["via_node"]
        turns[column] = turns[column].where(~at_stop, turns[column].map(lambda edge: last.get(edge, edge)))
    return turns


def split_nodes(graph: RoadGraph, places: Places, group: NDArray[np.int64]) -> RoadGraph:
    """Take nodes apart by the groups of the edge ends that meet there.

    Parameters
    ----------
    graph
        Any road graph.
    places
        The ends at every node, as `probe2road.passages.places_at_nodes` gives them.
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
    """Remove edges together with their nodes, and lead each group of the ends around them to a node of its own.

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


def led_to(line: shapely.LineString, cut: NDArray[np.float64], goals: list[shapely.Point | None]) -> shapely.LineString:
    """Cut lengths off both ends of a line and lead it to points, where there are any; heights at the ends stay."""
    kept = list(substring(line, cut[0], line.length - cut[1]).coords)
    for goal, at in zip(goals, (0, len(kept)), strict=True):
        if goal is not None:
            nearest = kept[min(at, len(kept) - 1)]
            kept.insert(len(kept) if at else 0, (goal.x, goal.y, *nearest[2:]))
    return shapely.LineString(kept)
