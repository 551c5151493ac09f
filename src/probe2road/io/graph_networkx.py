"""Conversion of road graphs to and from NetworkX graphs in the form of OSMnx, and GraphML."""

from __future__ import annotations

from os import PathLike
from typing import Any

import geopandas as gpd
import networkx as nx
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.crs import parse_crs, working_crs
from probe2road.errors import CRSError, InputError
from probe2road.graph.check import require_sound
from probe2road.graph.direction import told_direction
from probe2road.graph.ends import end_rows
from probe2road.graph.networkx import present
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import EDGE_DTYPES, empty_turns, finish_edges, move_ends
from probe2road.io.atomic import atomic_path
from probe2road.io.graph_tables import (
    OWN_COLUMNS,
    graph_from_edge_table,
    outgoing,
    projected,
    require_finite,
    require_lines,
    text_value,
    typed_column,
)
from probe2road.io.guard import parsing

__all__ = ["from_networkx", "read_graphml", "to_networkx", "write_graphml"]

_DERIVED_NODE_COLUMNS = ("x", "y", "lon", "lat", "street_count")  # made by to_networkx, not data of ours
_END_TOLERANCE = 0.01  # m; ends of foreign edges this near their node are moved onto it


def to_networkx(graph: RoadGraph) -> nx.MultiDiGraph:
    """Return an OSMnx ``MultiDiGraph``; see `probe2road.graph.networkx.to_networkx`."""
    return graph.to_networkx()


def from_networkx(graph: nx.Graph, *, target_crs: Any = None) -> RoadGraph:
    """Return the road graph of a NetworkX graph that was made by `to_networkx` or OSMnx.

    Of a foreign graph, two directed edges with the same geometry become one edge open both ways. One that stands
    alone is one-way as it runs if its ``oneway`` says so, whichever way: the tag may be that of the way it was made
    of. Edges without geometry are straight; lists of values become text, separated by ``;``; edges without extent are
    left out.

    Parameters
    ----------
    graph
        Nodes with integer ids, ``x`` and ``y``; the CRS in ``graph.graph["crs"]``.
    target_crs
        Metric CRS to work in; otherwise the graph's own, or, for degrees, the local one.

    Raises
    ------
    InputError
        If nodes lack coordinates or integer ids, or an invariant is broken.
    CRSError
        If there is no CRS, or the target is not metric.

    Examples
    --------
    >>> foreign = nx.MultiDiGraph(crs="EPSG:32616")
    >>> foreign.add_nodes_from([(7, {"x": 446000, "y": 4636000}), (9, {"x": 446030, "y": 4636040})])
    >>> foreign.add_edges_from([(7, 9, {"highway": "service"}), (9, 7, {"highway": "service"})])
    [0, 0]
    >>> from_networkx(foreign).edges[["u", "v", "length", "highway"]].values.tolist()
    [[7, 9, 50.0, 'service']]
    """
    fix = "set graph.graph['crs']"
    return _road_graph(graph, target_crs=target_crs, where="NetworkX graph", no_crs=fix)


def _road_graph(graph: nx.Graph, *, target_crs: Any, where: object, no_crs: str) -> RoadGraph:
    """Do the work of `from_networkx`; errors name the source, and the remedy for a missing CRS."""
    source = parse_crs(graph.graph["crs"], where=where) if "crs" in graph.graph else None
    if source is None:
        raise CRSError("has no CRS", where=where, fix=no_crs)
    nodes = _nodes_from_networkx(graph, source, where)
    rows = [
        {**data, "u": u, "v": v, "key": key} for u, v, key, data in nx.MultiDiGraph(graph).edges(keys=True, data=True)
    ]
    table = pd.DataFrame(rows, columns=None if rows else [*OWN_COLUMNS, "geometry"])
    lines = _drawn(table, nodes)
    edges = gpd.GeoDataFrame(table.drop(columns="geometry", errors="ignore"), geometry=lines, crs=source)
    require_finite(nodes, where=where)
    require_lines(edges, where=where)
    own = set(OWN_COLUMNS) <= set(edges)
    if own and "geometry" in table and table["geometry"].isna().any():
        raise InputError("some edges have lost their geometry", where=where, fix="write it again")
    if own and not edges.empty:
        edges = _one_edge_per_id(edges, where)
    x, y = nodes.get_coordinates().to_numpy().T
    target = working_crs(source, x, y, target_crs=target_crs, own=own, where=where)
    nodes, edges = (projected(part, target, where=where) for part in (nodes, edges))
    if own:
        return graph_from_edge_table(edges, nodes=nodes.reset_index(), where=where)
    return _from_foreign(nodes, edges, where)


def _nodes_from_networkx(graph: nx.Graph, crs: Any, where: object) -> gpd.GeoDataFrame:
    """Return the node table, in the CRS of the graph."""
    table = pd.DataFrame([data for _, data in graph.nodes(data=True)])
    if not {"x", "y"} <= set(table) and len(graph):
        raise InputError("nodes have no x and y", where=where, fix="set their coordinates")
    ids = list(graph.nodes)
    if not all(isinstance(node, int | np.integer) for node in ids):
        raise InputError("node ids are not integers", where=where, fix="renumber the nodes")
    with parsing(where, "x and y of the nodes are not numbers", fix="check that it is complete"):
        x, y = (table[name].to_numpy(np.float64, na_value=np.nan) for name in ("x", "y")) if ids else (np.zeros(0),) * 2
    if not np.isfinite([x, y]).all():
        raise InputError("some nodes have no x and y", where=where, fix="set their coordinates")
    points = shapely.points(x, y)
    further = table.drop(columns=[*_DERIVED_NODE_COLUMNS, "geometry"], errors="ignore").map(_single_value)
    return gpd.GeoDataFrame(further, geometry=points, crs=crs).set_index(pd.Index(ids, name="node", dtype="int64"))


def _drawn(table: pd.DataFrame, nodes: gpd.GeoDataFrame) -> NDArray[Any]:
    """Return the geometry of every directed edge; without one, a straight line."""
    position = nodes.get_coordinates().to_numpy()
    u, v = position[end_rows(nodes, table).T]
    straight = shapely.linestrings(np.stack([u, v], axis=1)) if len(table) else np.zeros(0, object)
    if "geometry" not in table:
        return straight
    given = table["geometry"].to_numpy(dtype=object)
    return np.where(pd.notna(given), given, straight)


def _one_edge_per_id(edges: gpd.GeoDataFrame, where: object) -> gpd.GeoDataFrame:
    """Undo the two directions of `to_networkx`: one row per ``edge``, reversed if only the reverse direction exists."""
    flags = edges.get("reversed", pd.Series(False, edges.index))
    if not flags.map(lambda flag: isinstance(flag, bool | np.bool_)).all():
        raise InputError("edges do not say whether they are reversed", where=where, fix="write it again")
    edges = edges.assign(reversed=flags.astype(bool)).sort_values("reversed", kind="stable").drop_duplicates("edge")
    turned = edges["reversed"].to_numpy(bool)
    lines = edges.geometry.to_numpy()
    forward, backward = (edges.get(name, pd.Series(pd.NA, edges.index)) for name in ("forward", "backward"))
    result = edges.assign(
        u=edges["u"].where(~turned, edges["v"]),
        v=edges["v"].where(~turned, edges["u"]),
        forward=forward.where(~turned, backward),
        backward=backward.where(~turned, forward),
    ).set_geometry(np.where(turned, shapely.reverse(lines), lines), crs=edges.crs)
    if "osmid" in result and (result["osmid"] == result["edge"]).all():
        result = result.drop(columns="osmid")
    return result.drop(columns=["oneway", "reversed"], errors="ignore").rename(columns={"oneway_tag": "oneway"})


def _from_foreign(nodes: gpd.GeoDataFrame, edges: gpd.GeoDataFrame, where: object) -> RoadGraph:
    """Join the two directions of each road in an OSMnx graph to one edge."""
    low, high = edges[["u", "v"]].min(axis=1), edges[["u", "v"]].max(axis=1)
    shape = shapely.to_wkb(shapely.normalize(edges.geometry.to_numpy()))
    twins = pd.DataFrame({"low": low, "high": high, "shape": shape})
    single = ~twins.duplicated(keep=False)
    edges = edges[~twins.duplicated()]
    if "oneway" in edges:
        edges = edges.assign(oneway=told_direction(edges["oneway"]).fillna(0).ne(0).astype(bool) & single[edges.index])

    position = nodes.get_coordinates().to_numpy()
    u, v = position[end_rows(nodes, edges).T]
    lines = _towards(edges.geometry.to_numpy(), u)
    first, last = (shapely.get_coordinates(shapely.get_point(lines, end)) for end in (0, -1))
    near = [np.hypot(*(ends - place).T)[:, None] <= _END_TOLERANCE for ends, place in ((first, u), (last, v))]
    lines = move_ends(lines, np.where(near[0], u, first), np.where(near[1], v, last))
    edges = edges.set_geometry(lines, crs=edges.crs)[shapely.length(lines) > 0]

    own = [name for name in (*EDGE_DTYPES, "edge", "reversed", "from", "to") if name not in ("u", "v")]
    further = edges.drop(columns=own, errors="ignore").reset_index(drop=True)
    for column in further.columns.drop(["u", "v", "geometry"]):
        further[column] = further[column].map(_single_value)
    graph = RoadGraph(nodes, finish_edges(further.assign(origin="reference")), empty_turns())
    require_sound(graph, where=where)
    return graph


def _towards(lines: NDArray[Any], u: NDArray[np.float64]) -> NDArray[Any]:
    """Reverse lines that start nearer to their end node, because undirected graphs do not keep the order."""
    first, last = (shapely.get_coordinates(shapely.get_point(lines, end)) for end in (0, -1))
    turned = np.hypot(*(last - u).T) < np.hypot(*(first - u).T)
    return np.where(turned, shapely.reverse(lines), lines)


def _single_value(value: Any) -> Any:
    """Join a list of values, which OSMnx has on simplified edges, in the way of OSM."""
    return ";".join(map(str, value)) if isinstance(value, list | tuple | set) else value


def write_graphml(graph: RoadGraph, path: str | PathLike[str]) -> None:
    """Write GraphML that ``osmnx.io.load_graphml`` reads: the graph of `to_networkx`, values as text.

    Raises
    ------
    OutputError
        If the file cannot be written or the graph holds private columns.
    """
    directed = to_networkx(outgoing(graph, where=path))
    text = nx.MultiDiGraph(**directed.graph)
    text.add_nodes_from((node, _as_text(data)) for node, data in directed.nodes(data=True))
    text.add_edges_from((u, v, key, _as_text(data)) for u, v, key, data in directed.edges(keys=True, data=True))
    with atomic_path(path) as temporary:
        nx.write_graphml(text, temporary)


def _as_text(data: dict[str, Any]) -> dict[str, str | None]:
    """Return attributes as text, and geometry as WKT with all digits."""
    return {
        name: shapely.to_wkt(value, rounding_precision=-1) if isinstance(value, shapely.Geometry) else text_value(value)
        for name, value in data.items()
    }


def read_graphml(path: str | PathLike[str], *, target_crs: Any = None) -> RoadGraph:
    """Read GraphML written by `write_graphml` or ``osmnx.io.save_graphml``.

    Raises
    ------
    InputError
        If the file is damaged, or is not a graph with coordinates.
    CRSError
        If it names no CRS.
    """
    with parsing(path, "cannot be read as GraphML"):
        text = nx.read_graphml(path, node_type=int, force_multigraph=True)
        typed = nx.MultiDiGraph(**text.graph)
        typed.add_nodes_from(zip(text.nodes, _typed_rows([data for _, data in text.nodes(data=True)]), strict=True))
        edges = list(text.edges(keys=True, data=True))
        rows = _typed_rows([{name: data[name] for name in data if name != "id"} for *_, data in edges])
        typed.add_edges_from((u, v, key, row) for (u, v, key, _), row in zip(edges, rows, strict=True))
    fix = "write it with a CRS, as osmnx.io.save_graphml does"
    return _road_graph(typed, target_crs=target_crs, where=path, no_crs=fix)


def _typed_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Convert text attributes to numbers, flags and geometry, column by column."""
    if not rows:
        return []
    table = pd.DataFrame(rows, index=pd.RangeIndex(len(rows)))
    for column in table:
        values = table[column]
        table[column] = _lines_from_text(values) if column == "geometry" else typed_column(values)
    return present(table)


def _lines_from_text(text: pd.Series) -> NDArray[Any]:
    """Read lines from WKT; an edge without WKT, which OSMnx omits for straight ones, gets None."""
    plain = text.astype(object)
    return np.asarray(shapely.from_wkt(plain.where(plain.notna(), None).to_numpy(object)), object)
