"""Splitting of edges at places on them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import finish_edges

__all__ = ["led_to", "split_edges"]


def split_edges(
    graph: RoadGraph, edge: NDArray[np.int64], along: NDArray[np.float64], *, merge: float = 0.0
) -> tuple[RoadGraph, NDArray[np.int64]]:
    """Cut edges at places on them, and return the new graph.

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
    >>> from probe2road.graph.roadgraph import graph_from_lines
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
    """Give turns at the end of a cut edge the id of its last part; turns at its start keep their id."""
    turns = graph.turns.copy()
    stop = graph.edges["v"]
    for column in ("from_edge", "to_edge"):
        at_stop = turns[column].map(stop) == turns["via_node"]
        turns[column] = turns[column].where(~at_stop, turns[column].map(lambda edge: last.get(edge, edge)))
    return turns


def led_to(line: shapely.LineString, cut: NDArray[np.float64], goals: list[shapely.Point | None]) -> shapely.LineString:
    """Cut lengths off both ends of a line, and connect the new ends to points, if given; heights at the ends stay."""
    kept = list(substring(line, cut[0], line.length - cut[1]).coords)
    for goal, at in zip(goals, (0, len(kept)), strict=True):
        if goal is not None:
            nearest = kept[min(at, len(kept) - 1)]
            kept.insert(len(kept) if at else 0, (goal.x, goal.y, *nearest[2:]))
    return shapely.LineString(kept)
