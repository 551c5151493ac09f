"""The check of the invariants of a road graph."""

from __future__ import annotations

import numpy as np
import pandas as pd
import shapely

from probe2road.crs import require_metric
from probe2road.errors import InputError
from probe2road.graph.ends import end_rows
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import EDGE_DTYPES, ORIGINS

__all__ = ["check_graph", "require_sound"]

_END_TOLERANCE = 1e-3  # m; an edge ends at its node to within this


def check_graph(graph: RoadGraph) -> None:
    """Check the invariants of a road graph, and report all faults at once.

    Raises
    ------
    InputError
        Naming every invariant that is broken: unique ids, known end nodes, edges that start and end at their
        nodes, simple LineStrings of two vertices or more and positive length, unique ``(u, v, key)``,
        lengths that agree with the geometry, known origins, one CRS, turns between existing edges.
    CRSError
        If the CRS is missing or not metric.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
    >>> check_graph(graph)
    >>> check_graph(replace(graph, nodes=graph.nodes.iloc[:1]))
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: graph: edge 0 ends at a node that does not exist (v = 1)
    """
    require_sound(graph, where="graph")


def require_sound(graph: RoadGraph, *, where: object) -> None:
    """Check a graph in the same way as `check_graph`, and name its source in errors; for readers and writers."""
    nodes, edges = graph.nodes, graph.edges
    missing = [column for column in (*EDGE_DTYPES, "geometry") if column not in edges]
    if missing:
        raise InputError(f"edges lack the columns {', '.join(missing)}", where=where)
    require_metric(edges.crs, where=where)
    faults = []
    if nodes.crs != edges.crs:
        faults.append(f"nodes are in {nodes.crs}, edges in {edges.crs}")
    faults += [
        f"{name} ids are not unique" for name, table in (("node", nodes), ("edge", edges)) if not table.index.is_unique
    ]
    faults += _dangling_ends(graph)
    if not faults and len(edges):
        faults += _edge_faults(graph)
    faults += _turn_faults(graph)
    if faults:
        raise InputError.from_faults(faults, where=where)


def _dangling_ends(graph: RoadGraph) -> list[str]:
    faults = []
    for end in ("u", "v"):
        dangling = graph.edges[~graph.edges[end].isin(graph.nodes.index)]
        if len(dangling):
            edge, node = dangling.index[0], dangling[end].iloc[0]
            more = f", and {len(dangling) - 1} more" if len(dangling) > 1 else ""
            faults.append(f"edge {edge} ends at a node that does not exist ({end} = {node}){more}")
    return faults


def _edge_faults(graph: RoadGraph) -> list[str]:
    """List the faults of single edges: one line for each kind, with the id of the first such edge."""
    edges = graph.edges
    geometry = edges.geometry.to_numpy()
    kind = shapely.get_type_id(geometry) == shapely.GeometryType.LINESTRING
    if not kind.all():
        return [f"edge {edges.index[~kind][0]} is not a LineString"]
    position = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    checks = {"has no length": shapely.length(geometry) > 0}
    # The rows that the graph has stored are not used: the tables may have been changed since.
    for end, vertex, row in zip("uv", (0, -1), end_rows(graph.nodes, edges).T, strict=True):
        ends = shapely.get_coordinates(shapely.get_point(geometry, vertex))
        away = np.hypot(*(ends - position[row]).T)
        checks[f"does not touch its node {end}"] = away <= _END_TOLERANCE
    checks["has a length that differs from its geometry"] = np.isclose(
        edges["length"], shapely.length(geometry), rtol=1e-6, atol=1e-3
    )
    checks["has an unknown origin"] = edges["origin"].isin(ORIGINS).to_numpy()
    low, high = edges[["u", "v"]].min(axis=1), edges[["u", "v"]].max(axis=1)
    repeated = pd.DataFrame({"low": low, "high": high, "key": edges["key"]}).duplicated()
    checks["repeats the (u, v, key) of another"] = ~repeated.to_numpy()
    return [f"edge {edges.index[~fine][0]} {fault}" for fault, fine in checks.items() if not fine.all()]


def _turn_faults(graph: RoadGraph) -> list[str]:
    """List turns that name a missing edge, or a node at which their edges do not meet."""
    turns, edges = graph.turns, graph.edges
    known = turns["from_edge"].isin(edges.index) & turns["to_edge"].isin(edges.index)
    if not known.all():
        return [f"{int((~known).sum())} turns are between edges that do not exist"]
    if not edges.index.is_unique:
        return []
    meets = np.ones(len(turns), bool)
    for edge in ("from_edge", "to_edge"):
        ends = edges.loc[turns[edge], ["u", "v"]].to_numpy()
        meets &= (ends == turns["via_node"].to_numpy()[:, None]).any(axis=1)
    return [] if meets.all() else [f"{int((~meets).sum())} turns are at a node that is not an end of both edges"]
