"""The road graph: two GeoDataFrames, their invariants, and the conversions that other tools need.

An edge is a stretch of centreline between two nodes; nodes are junctions and dead ends. The graph is a
multigraph: loops and parallel edges are ordinary, which is why edges have an id of their own and node pairs
do not identify them. Geometry runs from ``u`` to ``v``; an edge is drivable both ways unless its forward
and backward counts say otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from probe2road.crs import parse_crs, require_metric
from probe2road.errors import InputError

__all__ = ["ORIGINS", "RoadGraph", "check_graph", "driving_direction", "empty_graph", "graph_from_lines"]

ORIGINS = ("segmentation", "gap", "reference")
EDGE_DTYPES = {
    "u": "int64",
    "v": "int64",
    "key": "int64",
    "length": "float64",  # m, in plan
    "origin": "str",  # one of ORIGINS
    "support": "Int64",  # distinct traces matched to the edge; NA where nothing was matched yet
    "score": "float64",  # mean centreline probability along the edge; NaN where unknown
    "forward": "Int64",  # traversals from u to v
    "backward": "Int64",  # traversals from v to u
}
TURN_DTYPES = {"from_edge": "int64", "via_node": "int64", "to_edge": "int64", "count": "int64"}

_END_TOLERANCE = 1e-3  # m; an edge ends at its node to within this


@dataclass(frozen=True)
class RoadGraph:
    """A road network as an undirected multigraph with geometry, in one metric CRS.

    Build it with `graph_from_lines`, `empty_graph` or a reader; the constructor trusts you, `check_graph`
    does not.

    Attributes
    ----------
    nodes
        Index ``node`` (int64, unique); ``geometry`` Points. Further columns are kept.
    edges
        Index ``edge`` (int64, unique); columns ``u``, ``v``, ``key``, ``geometry`` (LineString from u to v,
        with Z where known), ``length`` (m), ``origin`` (one of `ORIGINS`), ``support`` (distinct traces, or
        NA), ``score`` (mean probability, or NaN), ``forward``, ``backward`` (traversals, or NA).
    turns
        ``from_edge``, ``via_node``, ``to_edge``, ``count``: how often traces drove that transition. Empty
        where nothing was matched yet.

    Examples
    --------
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 50)]], crs="EPSG:32616")
    >>> graph
    RoadGraph(3 nodes, 2 edges, 0.150 km, WGS 84 / UTM zone 16N)
    """

    nodes: gpd.GeoDataFrame
    edges: gpd.GeoDataFrame
    turns: pd.DataFrame

    @property
    def crs(self) -> CRS:
        """Metric CRS of nodes and edges."""
        return self.edges.crs

    @property
    def length(self) -> float:
        """Total length of the edges, metres."""
        return float(self.edges["length"].sum())

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box ``(left, bottom, right, top)``, metres; NaN for an empty graph."""
        left, bottom, right, top = self.edges.total_bounds
        return float(left), float(bottom), float(right), float(top)

    def degrees(self) -> pd.Series:
        """Count the edge ends at every node, indexed like ``nodes``; a loop counts twice."""
        ends = pd.concat([self.edges["u"], self.edges["v"]]).value_counts()
        return ends.reindex(self.nodes.index, fill_value=0).rename("degree").astype("int64")

    def to_crs(self, crs: Any) -> RoadGraph:
        """Return the graph in another metric CRS, lengths measured anew.

        Raises
        ------
        CRSError
            If the target is not metric.
        """
        target = require_metric(parse_crs(crs))
        if target == self.crs:
            return self
        edges = self.edges.to_crs(target)
        edges["length"] = edges.length
        return replace(self, nodes=self.nodes.to_crs(target), edges=edges)

    def to_networkx(self, *, min_count: int = 5) -> Any:
        """Return an OSMnx ``MultiDiGraph``; see `probe2road.export.to_networkx`."""
        from probe2road.io.graph_networkx import to_networkx

        return to_networkx(self, min_count=min_count)

    def __repr__(self) -> str:
        return (
            f"RoadGraph({len(self.nodes)} nodes, {len(self.edges)} edges, {self.length / 1000:.3f} km, {self.crs.name})"
        )


def empty_graph(crs: Any) -> RoadGraph:
    """Return the graph without roads, with every column in its type.

    Examples
    --------
    >>> len(empty_graph("EPSG:32616").edges)
    0
    """
    return graph_from_lines([], crs=crs)


def graph_from_lines(
    lines: Sequence[Any] | NDArray[Any],
    *,
    crs: Any,
    origin: str = "segmentation",
    snap: float = 0.01,
    attributes: pd.DataFrame | None = None,
) -> RoadGraph:
    """Build a graph from lines that meet at their ends.

    Edges join where their ends are within ``snap`` of each other, directly or by way of further ends; lines
    that merely cross, or meet the middle of another, stay separate, as bridges do. The order of the lines is
    the order of the edges.

    Parameters
    ----------
    lines
        LineStrings, or coordinate sequences of shape ``(n, 2)`` or ``(n, 3)``. MultiLineStrings are taken
        apart; lines no longer than ``snap`` and other geometries are left out.
    crs
        Metric CRS of the coordinates.
    origin
        One of `ORIGINS`, for all edges.
    snap
        Ends nearer than this (m) are one node, at the place of the first of them.
    attributes
        Further columns, one row per line in the order of the lines; the parts of a MultiLineString share
        theirs. A column named like one of ours is taken as ours, except for those computed here (``u``,
        ``v``, ``key``, ``length``).

    Returns
    -------
    RoadGraph
        Nodes numbered by first appearance. Edge ends are moved onto their node.

    Raises
    ------
    CRSError
        If the CRS is missing or not metric.

    Examples
    --------
    A loop and two parallel edges survive:

    >>> lines = [[(0, 0), (9, 9), (0, 9), (0, 0)], [(0, 0), (50, 5), (100, 0)], [(0, 0), (50, -5), (100, 0)]]
    >>> graph = graph_from_lines(lines, crs="EPSG:32616")
    >>> graph.edges[["u", "v", "key"]].values.tolist()
    [[0, 0, 0], [0, 1, 0], [0, 1, 1]]
    """
    target = require_metric(parse_crs(crs) if crs is not None else None, where="graph")
    geometry, line = _single_lines(lines, snap)
    first, last = (shapely.get_coordinates(shapely.get_point(geometry, end)) for end in (0, -1))
    # Ends in drawing order (u0, v0, u1, v1, ...), so that numbering follows first appearance.
    ends = np.stack([first, last], axis=1).reshape(-1, 2)
    node_of_end, position = _joined(ends, snap)
    u, v = node_of_end.reshape(-1, 2).T
    geometry = move_ends(geometry, position[u], position[v])
    kept = shapely.length(geometry) > 0  # a chain of joined ends can swallow a short line whole
    geometry, line, u, v = geometry[kept], line[kept], u[kept], v[kept]

    nodes = gpd.GeoDataFrame(
        geometry=shapely.points(position), index=pd.RangeIndex(len(position), name="node"), crs=target
    )
    edges = gpd.GeoDataFrame({"u": u, "v": v, "origin": origin}, geometry=geometry, crs=target)
    if attributes is not None:
        further = attributes.iloc[line].drop(columns=["u", "v", "key", "length", "geometry"], errors="ignore")
        edges = edges.assign(**{str(name): column.array for name, column in further.items()})
    return RoadGraph(nodes, finish_edges(edges), empty_turns())


def finish_edges(edges: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Bring an edge table into the contract: keys and lengths computed, absent columns filled, types set.

    Needs ``u``, ``v`` and ``geometry``; the index becomes ``edge``. Further columns are kept, behind ours.
    """
    pair = pd.DataFrame({"low": edges[["u", "v"]].min(axis=1), "high": edges[["u", "v"]].max(axis=1)})
    filled = {"origin": "segmentation", "support": pd.NA, "score": np.nan, "forward": pd.NA, "backward": pd.NA}
    edges = edges.assign(
        key=pair.groupby(["low", "high"]).cumcount() if len(pair) else np.zeros(0, np.int64),
        length=shapely.length(edges.geometry.to_numpy()),
        **{column: value for column, value in filled.items() if column not in edges},
    )
    further = [column for column in edges if column not in EDGE_DTYPES and column != "geometry"]
    edges = edges[[*EDGE_DTYPES, *further, "geometry"]].astype(EDGE_DTYPES)
    edges.index = edges.index.astype("int64").rename("edge")
    return edges


def empty_turns() -> pd.DataFrame:
    """Return a turn table without rows."""
    return pd.DataFrame({column: pd.Series(dtype=dtype) for column, dtype in TURN_DTYPES.items()})


def driving_direction(edges: gpd.GeoDataFrame, *, min_count: int = 5) -> pd.Series:
    """Say which way each edge may be driven: 1 from u to v only, -1 from v to u only, 0 both ways.

    A column ``oneway`` that came with the data (an OSM tag, or a flag) decides where it has a value. Where
    `probe2road.evidence` weighed the counts already (column ``oneway_confidence``) and left the value open, the
    edge is open both ways. Otherwise the counts decide: an edge that was driven ``min_count`` times or more,
    always the same way, is one-way. On a two-way road with even traffic, five traversals agree by chance once in
    sixteen times; where the counts are fewer or missing, the edge is open both ways.

    Parameters
    ----------
    edges
        Edge table of a graph.
    min_count
        Traversals needed to call an edge one-way.

    Returns
    -------
    Series of int64, indexed like the edges

    Examples
    --------
    >>> edges = graph_from_lines([[(0, 0), (9, 0)], [(9, 0), (9, 9)], [(9, 9), (0, 0)]], crs="EPSG:32616").edges
    >>> driving_direction(edges.assign(forward=[7, 0, 2], backward=[0, 9, 0])).tolist()
    [1, -1, 0]
    """
    forward, backward = (edges[name].to_numpy(np.float64, na_value=0.0) for name in ("forward", "backward"))
    direction = pd.Series(0, index=edges.index, name="direction")
    if "oneway_confidence" not in edges:
        direction[(forward >= min_count) & (backward == 0)] = 1
        direction[(backward >= min_count) & (forward == 0)] = -1
    if "oneway" in edges:
        tag = edges["oneway"].astype("str").str.lower()
        for value, tags in (
            (1, ("yes", "true", "1", "1.0")),
            (-1, ("-1", "-1.0", "reverse")),
            (0, ("no", "false", "0")),
        ):
            direction[tag.isin(tags)] = value
    return direction


def check_graph(graph: RoadGraph, *, where: object = "graph") -> None:
    """Verify the invariants of a road graph.

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
    >>> graph = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
    >>> check_graph(graph)
    >>> check_graph(replace(graph, nodes=graph.nodes.iloc[:1]))
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: graph: edge 0 ends at a node that does not exist (v = 1)
    """
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
    """Faults of single edges, one line for each kind with the first offender's id."""
    edges = graph.edges
    geometry = edges.geometry.to_numpy()
    kind = shapely.get_type_id(geometry) == shapely.GeometryType.LINESTRING
    if not kind.all():
        return [f"edge {edges.index[~kind][0]} is not a LineString"]
    position = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    row = pd.Series(np.arange(len(graph.nodes)), index=graph.nodes.index)
    checks = {"has no length": shapely.length(geometry) > 0}
    for end, vertex in (("u", 0), ("v", -1)):
        ends = shapely.get_coordinates(shapely.get_point(geometry, vertex))
        away = np.hypot(*(ends - position[row[edges[end]].to_numpy()]).T)
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
    """List turns that name an edge that does not exist, or a node at which their edges do not meet."""
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


def _single_lines(lines: Sequence[Any] | NDArray[Any], shortest: float) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Flatten to an array of LineStrings with extent, and the position of the line each one came from."""
    geometry = np.empty(len(lines), dtype=object)
    for position, line in enumerate(lines):
        geometry[position] = line if line is None or isinstance(line, shapely.Geometry) else shapely.LineString(line)
    parts, line_of_part = shapely.get_parts(geometry, return_index=True)
    kept = (shapely.get_type_id(parts) == shapely.GeometryType.LINESTRING) & (shapely.length(parts) > shortest)
    return parts[kept], line_of_part[kept]


def _joined(ends: NDArray[np.float64], snap: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Give line ends that belong together one number, in the order of first appearance.

    Strategy: most ends that belong together are equal to the last bit, so equal ends are counted as one place
    first, by hashing. Places within ``snap`` of each other are then linked through a k-d tree, and the
    connected components of the links are the nodes.

    Parameters
    ----------
    ends
        Shape ``(2 * n_lines, 2)``, metres, in drawing order.
    snap
        Metres.

    Returns
    -------
    node_of_end : ndarray of int64, shape (2 * n_lines,)
    position : ndarray of float64, shape (n_nodes, 2)
        The first end at each node.
    """
    if not len(ends):
        return np.zeros(0, np.int64), np.zeros((0, 2))
    column, row = (pd.factorize(values)[0].astype(np.int64) for values in (ends + 0.0).T)  # + 0.0: no minus zero
    place, _ = pd.factorize(column * (row.max() + 1) + row)
    position = _first(ends, place)
    links = KDTree(position).query_pairs(snap, output_type="ndarray") if snap > 0 else np.zeros((0, 2), np.int64)
    if len(links):
        n = len(position)
        matrix = coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(n, n))
        component = connected_components(matrix, directed=False)[1]
        place, _ = pd.factorize(component[place])
        position = _first(ends, place)
    return place.astype(np.int64), position


def _first(values: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the first value of each group; groups are numbered 0, 1, ..."""
    first = np.zeros((int(group.max()) + 1, values.shape[1]))
    first[group[::-1]] = values[::-1]
    return first


def move_ends(lines: NDArray[Any], first: NDArray[np.float64], last: NDArray[np.float64]) -> NDArray[Any]:
    """Move the end vertices of lines in plan, to positions of shape ``(n_lines, 2)``; heights stay."""
    has_z = bool(shapely.has_z(lines).any())
    coordinates, owner = shapely.get_coordinates(lines, include_z=has_z, return_index=True)
    heads = np.flatnonzero(np.diff(owner, prepend=-1))
    tails = np.append(heads[1:], len(owner)) - 1
    if len(lines):
        coordinates[heads, :2], coordinates[tails, :2] = first, last
    return without_unknown_heights(shapely.linestrings(coordinates, indices=owner))


def without_unknown_heights(lines: NDArray[Any]) -> NDArray[Any]:
    """Bring lines into the plane whose every height is NaN, as a table with one geometry type has them."""
    if not shapely.has_z(lines).any():
        return lines
    coordinates, owner = shapely.get_coordinates(lines, include_z=True, return_index=True)
    known = np.zeros(len(lines), bool)
    known[owner[np.isfinite(coordinates[:, 2])]] = True
    return np.where(known, lines, shapely.force_2d(lines))
