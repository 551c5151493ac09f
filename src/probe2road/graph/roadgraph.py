"""The road graph: two GeoDataFrames, their invariants, and the conversions that other tools need.

An edge is a stretch of centreline between two nodes; nodes are junctions and dead ends. The graph is a
multigraph: loops and parallel edges are ordinary, which is why edges have an id of their own and node pairs
do not identify them. Geometry runs from ``u`` to ``v``, on a one-way edge in its driving direction; which edges are
one-way is told by `probe2road.graph.direction`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import networkx as nx
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from probe2road.crs import parse_crs, require_metric
from probe2road.graph.ends import EdgeEnds, end_rows
from probe2road.graph.networkx import to_networkx
from probe2road.graph.tables import degrees, empty_turns, finish_edges, move_ends
from probe2road.notebook import figures_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["RoadGraph", "empty_graph", "graph_from_lines"]


@dataclass(frozen=True, eq=False)
class RoadGraph:
    """A road network as an undirected multigraph with geometry, in one metric CRS.

    Build it with `graph_from_lines`, `empty_graph` or a reader; the constructor trusts you, `check_graph`
    does not. A graph equals itself only; compare the tables where their content counts.

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
        """Return the metric CRS of nodes and edges."""
        return self.edges.crs

    @property
    def length(self) -> float:
        """Return the total length of the edges, metres."""
        return float(self.edges["length"].sum())

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return the bounding box ``(left, bottom, right, top)``, metres; NaN for an empty graph."""
        left, bottom, right, top = self.edges.total_bounds
        return float(left), float(bottom), float(right), float(top)

    def degrees(self) -> pd.Series:
        """Count the edge ends at every node, indexed like ``nodes``; a loop counts twice."""
        return degrees(self.nodes, self.edges)

    @cached_property
    def end_rows(self) -> NDArray[np.int64]:
        """Return the rows of ``nodes`` at which the edges start and stop, shape ``(E, 2)``; raveled, by end number."""
        rows = end_rows(self.nodes, self.edges)
        rows.setflags(write=False)
        return rows

    def ends(self, *, reach: float, skip: float = 0.0, share: float = 1.0) -> EdgeEnds:
        """Return the nodes, positions and directions of all edge ends, numbered as in `probe2road.graph.ends`.

        They are measured once for each choice of lengths, and kept: their arrays cannot be written to.

        Parameters
        ----------
        reach
            Metres from the node up to which the direction is measured.
        skip
            Metres from the node that are left out of it; at most half of the reach on that edge.
        share
            Of the length of an edge, what the reach is at most.

        Examples
        --------
        >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 50)]], crs="EPSG:32616")
        >>> ends = graph.ends(reach=20.0)
        >>> ends.node.tolist(), ends.ahead[1].tolist()
        ([0, 1, 1, 2], [-1.0, 0.0])
        """
        measured: dict[tuple[float, float, float], EdgeEnds] = self.__dict__.setdefault("_ends", {})
        lengths = (reach, skip, share)
        if lengths not in measured:
            lines = self.edges.geometry.to_numpy()
            measured[lengths] = EdgeEnds.from_lines(lines, self.end_rows, reach=reach, skip=skip, share=share)
        return measured[lengths]

    def to_crs(self, crs: Any) -> RoadGraph:
        """Return the graph in another metric CRS, with lengths measured again.

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

    def to_networkx(self) -> nx.MultiDiGraph:
        """Return an OSMnx ``MultiDiGraph``; see `probe2road.graph.networkx.to_networkx`."""
        return to_networkx(self.nodes, self.edges, self.turns)

    def plot(self, column: str | None = None, *, ax: Axes | None = None, **style: Any) -> Axes:
        """Draw the edges with matplotlib, like ``GeoDataFrame.plot``.

        Parameters
        ----------
        column
            Edge column to colour by; one colour if it is None.
        ax
            Axes to draw into; a new figure if it is None.
        **style
            Further arguments of ``GeoDataFrame.plot``: ``color``, ``linewidth``, ``legend``, ``figsize`` and others.

        Returns
        -------
        matplotlib.axes.Axes

        Examples
        --------
        >>> from matplotlib.figure import Figure
        >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 50)]], crs="EPSG:32616")
        >>> axes = graph.plot("length", ax=Figure().subplots(), linewidth=2)
        >>> len(axes.collections)
        1
        """
        return self.edges.plot(column, ax=ax, **style)

    def explore(self, **options: Any) -> Any:
        """Show the graph as an interactive page: in the notebook, or else in the web browser.

        Unlike the page of ``GeoDataFrame.explore``, this one needs no network.

        Parameters
        ----------
        **options
            Arguments of `probe2road.draw.view.explore`: ``fleet`` to draw underneath, ``title``, ``color_by``.

        Returns
        -------
        probe2road.draw.view.Page
            A notebook shows it; ``save`` writes it to a file.
        """
        # The room for drawing is below this one: it is called through the public interface, as a user would.
        import probe2road

        return probe2road.draw.view.explore(self, **options)

    def __getstate__(self) -> dict[str, Any]:
        """Return the tables alone for pickling and copying, because measured properties are quickly computed again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __repr__(self) -> str:
        return (
            f"RoadGraph({len(self.nodes)} nodes, {len(self.edges)} edges, {self.length / 1000:.3f} km, {self.crs.name})"
        )

    def _repr_html_(self) -> str:
        """Show figures in a notebook."""
        origins = {f"... of origin {origin}": n for origin, n in self.edges["origin"].value_counts().items()}
        figures = {"nodes": len(self.nodes), "edges": len(self.edges), **origins}
        return figures_table("RoadGraph", {**figures, "km": f"{self.length / 1000:.3f}", "CRS": self.crs.name})


def empty_graph(crs: Any) -> RoadGraph:
    """Return a graph without roads, with every column in its type.

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
    kept = shapely.length(geometry) > 0  # when ends are joined, a short line can become a point
    geometry, line, u, v = geometry[kept], line[kept], u[kept], v[kept]

    nodes = gpd.GeoDataFrame(
        geometry=shapely.points(position), index=pd.RangeIndex(len(position), name="node"), crs=target
    )
    edges = gpd.GeoDataFrame({"u": u, "v": v, "origin": origin}, geometry=geometry, crs=target)
    if attributes is not None:
        further = attributes.iloc[line].drop(columns=["u", "v", "key", "length", "geometry"], errors="ignore")
        edges = edges.assign(**{str(name): column.array for name, column in further.items()})
    return RoadGraph(nodes, finish_edges(edges), empty_turns())


def _single_lines(lines: Sequence[Any] | NDArray[Any], shortest: float) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Return an array of LineStrings that are not points, and the position of the line that each one comes from."""
    geometry = np.empty(len(lines), dtype=object)
    for position, line in enumerate(lines):
        geometry[position] = line if line is None or isinstance(line, shapely.Geometry) else shapely.LineString(line)
    parts, line_of_part = shapely.get_parts(geometry, return_index=True)
    kept = (shapely.get_type_id(parts) == shapely.GeometryType.LINESTRING) & (shapely.length(parts) > shortest)
    return parts[kept], line_of_part[kept]


def _joined(ends: NDArray[np.float64], snap: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Give line ends at the same place one number, in the order of first appearance.

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
