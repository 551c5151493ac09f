"""Conversion of road graphs for files: checks and types that all formats share.

Going out, tables are checked for what must not leave (ids of vehicles and traces, times) and brought into
plain column types. Coming in, a graph is put together from a table of edges that carries our columns. Formats
that hold a single table keep the turns in a text column of the edges, and get their nodes back from the ends
of the edges.
"""

from __future__ import annotations

import re
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.errors import InputError, OutputError
from probe2road.graph.check import require_sound
from probe2road.graph.direction import in_driving_direction
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import (
    EDGE_DTYPES,
    TURN_DTYPES,
    TURNS_COLUMN,
    empty_turns,
    finish_edges,
    move_ends,
    without_unknown_heights,
)
from probe2road.io.guard import parsing

__all__ = [
    "OWN_COLUMNS",
    "graph_from_edge_table",
    "outgoing",
    "projected",
    "require_finite",
    "require_lines",
    "require_points",
    "text_value",
    "typed_column",
]

OWN_COLUMNS = ("edge", "u", "v", "key", "origin")  # a table with these was written by us

_PRIVATE_NAME = re.compile(
    r"((trace|vehicle|drive|driver|trip|journey|device|user|session)s?[_ -]?(id|ids|uuid|nr|no|name|key)?"
    r"|tracks?[_ -]?(ids?|uuid|nr|no|name|key)|vin|imei|imsi|msisdn|iccid"
    r"|(licen[cs]e|number|reg)?[_ -]?plate(_?(id|no|nr|number))?|t"
    r"|((first|last|gps|gnss|start|end|stop|begin|device|utc|local|record(ed|ing)?|event|fix|position)[_ -]?)?"
    r"(seen|time|timestamp|date|datetime)([_ -]?utc)?|(tracked|recorded|created|started|ended)[_ -]?at)s?",
    re.IGNORECASE,
)

_FARTHEST = 1e9  # m or degrees; no coordinate on Earth is larger in any CRS

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f]")


def outgoing(graph: RoadGraph, *, where: object) -> RoadGraph:
    """Return the graph in the form for files: without private columns, in plain types, edges in order of id.

    One-way edges run in their driving direction.

    Raises
    ------
    OutputError
        If a column holds, by its name or type, ids of vehicles or traces, or times; or if its values are
        not plain numbers, text or flags. Dropping it silently would hide that private data came this far.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (9, 0)]], crs="EPSG:32616")
    >>> outgoing(replace(graph, edges=graph.edges.assign(vehicle_id="A7")), where="roads.gpkg")
    Traceback (most recent call last):
        ...
    probe2road.errors.OutputError: roads.gpkg: column 'vehicle_id' of the edges may identify drives; drop it ...
    """
    for name, table in (("nodes", graph.nodes), ("edges", graph.edges), ("turns", graph.turns)):
        for column in table.columns.drop("geometry", errors="ignore"):
            _refuse_private(table[column], name, where)
    nodes, edges, turns = (
        graph.nodes.sort_index(),
        in_driving_direction(graph.edges.sort_index()),
        graph.turns.reset_index(drop=True),
    )
    edges = edges.set_geometry(_uniform_dimension(edges.geometry.to_numpy()), crs=edges.crs)
    for table in (nodes, edges, turns):
        table.attrs = {}  # pandas writes them into Parquet
    return RoadGraph(nodes, edges, turns)


def _refuse_private(values: pd.Series, table: str, where: object) -> None:
    """Refuse a column that may identify drives, or that no format can store."""
    is_time = pd.api.types.is_datetime64_any_dtype(values.dtype) or pd.api.types.is_timedelta64_dtype(values.dtype)
    if is_time or _PRIVATE_NAME.fullmatch(str(values.name)):
        raise OutputError(
            f"column {values.name!r} of the {table} may identify drives",
            where=where,
            fix="drop it before writing; ids of vehicles and traces, and times, never leave with a graph",
        )
    if (
        values.dtype == object
        and not values.map(lambda value: value is None or np.isscalar(value) or value is pd.NA).all()
    ):
        raise OutputError(
            f"column {values.name!r} of the {table} holds values that are not numbers or text",
            where=where,
            fix="drop it before writing, or turn it into text",
        )


def _uniform_dimension(lines: NDArray[Any]) -> NDArray[Any]:
    """Give all lines heights if one has heights: NaN for unknown ones, which a layer with heights can store."""
    if not shapely.has_z(lines).any():
        return lines
    coordinates, owner = shapely.get_coordinates(lines, include_z=True, return_index=True)
    return shapely.linestrings(coordinates, indices=owner)


def _turns_from_text(edges: pd.DataFrame) -> pd.DataFrame:
    """Undo `edges_with_turns`, in the order of the edges."""
    if TURNS_COLUMN not in edges:
        return empty_turns()
    text = edges.set_index("edge")[TURNS_COLUMN].dropna().str.split().explode().dropna()
    parts = text.str.extract(r"^(?P<to_edge>-?\d+)@(?P<via_node>-?\d+):(?P<count>\d+)$")
    return parts.rename_axis("from_edge").reset_index()[list(TURN_DTYPES)].astype(TURN_DTYPES)


def graph_from_edge_table(
    table: gpd.GeoDataFrame,
    *,
    nodes: gpd.GeoDataFrame | None = None,
    turns: pd.DataFrame | None = None,
    where: object,
) -> RoadGraph:
    """Make a graph from edges with `OWN_COLUMNS`, in a metric CRS; one-way edges get their driving direction.

    Parameters
    ----------
    table
        One row per edge, ``edge`` a column; lines whose heights are all NaN lose them.
    nodes
        Nodes with ``node`` as a column, or None: then they are the ends of the edges.
    turns
        Turn table, or None: then it is read from the text column of the edges.
    where
        The file, for error messages.

    Raises
    ------
    InputError
        If a column cannot be converted, or the graph breaks an invariant.
    """
    require_lines(table, where=where)
    _require_ids(table, where=where)
    with parsing(where, "the columns of the edges are damaged", fix="write it again"):
        turns = _turns_from_text(table) if turns is None else turns[list(TURN_DTYPES)].astype(TURN_DTYPES)
        edges = (
            table.drop(columns=TURNS_COLUMN, errors="ignore").astype({"edge": "int64"}).set_index("edge").sort_index()
        )
        key = edges["key"].astype("int64")
        edges = edges.set_geometry(without_unknown_heights(edges.geometry.to_numpy()), crs=table.crs)
        text = [name for name in edges if name not in EDGE_DTYPES and pd.api.types.is_object_dtype(edges[name].dtype)]
        edges = in_driving_direction(finish_edges(edges.astype(dict.fromkeys(text, "str"))).assign(key=key))
    if nodes is None:
        nodes, edges = _nodes_from_ends(edges)
    else:
        with parsing(where, "the table of the nodes is damaged", fix="write it again"):
            nodes = nodes.astype({"node": "int64"}).set_index("node").sort_index()
        require_points(nodes, where=where)
    graph = RoadGraph(nodes, edges, turns)
    require_sound(graph, where=where)
    return graph


def _require_ids(table: pd.DataFrame, *, where: object) -> None:
    """Refuse ids that 64 bits do not hold: they would be turned into others."""
    for name in ("edge", "u", "v"):
        values = table[name].dropna()
        if pd.api.types.is_numeric_dtype(values.dtype) and len(values):
            largest = max(abs(float(values.min())), abs(float(values.max())))
            if largest >= 2.0**63:
                fault = f"column {name!r} holds ids beyond 2**63"
                raise InputError(fault, where=where, fix="number the edges and nodes anew")


def require_finite(table: gpd.GeoDataFrame, *, where: object) -> None:
    """Refuse geometry with coordinates that are not finite."""
    coordinates, row = shapely.get_coordinates(table.geometry.to_numpy(), return_index=True)
    wrong = np.unique(row[~(np.abs(coordinates) < _FARTHEST).all(axis=1)])
    if len(wrong):
        fault = f"coordinates of {len(wrong)} features are no positions (first: row {wrong[0]})"
        raise InputError(fault, where=where, fix="check that it is complete, and its CRS")


def require_lines(table: gpd.GeoDataFrame, *, where: object) -> None:
    """Refuse a table of our edges with a geometry that is not a line."""
    geometry = table.geometry.to_numpy()
    line = (shapely.get_type_id(geometry) == shapely.GeometryType.LINESTRING) & ~shapely.is_empty(geometry)
    if not line.all():
        fault = f"{int((~line).sum())} edges are no LineString (first: row {np.flatnonzero(~line)[0]})"
        raise InputError(fault, where=where, fix="write it again")
    require_finite(table, where=where)


def require_points(nodes: gpd.GeoDataFrame, *, where: object) -> None:
    """Refuse a table of our nodes with a missing position."""
    geometry = nodes.geometry.to_numpy()
    point = (shapely.get_type_id(geometry) == shapely.GeometryType.POINT) & ~shapely.is_empty(geometry)
    if not point.all():
        fault = f"{int((~point).sum())} nodes are no Point (first: row {np.flatnonzero(~point)[0]})"
        raise InputError(fault, where=where, fix="write it again")


def projected(table: Any, target: CRS, *, where: object) -> gpd.GeoDataFrame:
    """Return a table in another CRS.

    Raises
    ------
    InputError
        If it is no table of geometry with a CRS, or its positions cannot be projected.
    """
    if not isinstance(table, gpd.GeoDataFrame) or table.crs is None:
        raise InputError("a table has no geometry or no CRS", where=where, fix="write it again")
    if table.crs != target:
        with parsing(where, f"cannot be projected to {target.name}", fix="check its CRS"):
            table = table.to_crs(target)
    require_finite(table, where=where)
    return table


def _nodes_from_ends(edges: gpd.GeoDataFrame) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Place every node at the first edge end that names it, and move the other ends there.

    A format that rounds coordinates can part ends that were within a millimetre of each other.
    """
    lines = edges.geometry.to_numpy()
    ends = shapely.get_point(np.tile(lines, 2), np.repeat([0, -1], len(lines)))
    node = edges[["u", "v"]].to_numpy().T.ravel()
    ids, first, place = np.unique(node, return_index=True, return_inverse=True)
    position = shapely.get_coordinates(ends)
    nodes = gpd.GeoDataFrame(
        geometry=shapely.points(position[first]), index=pd.Index(ids, name="node", dtype="int64"), crs=edges.crs
    )
    apart = np.hypot(*(position - position[first][place]).T)
    if apart.any():
        u, v = position[first][place].reshape(2, -1, 2)
        edges = edges.set_geometry(move_ends(lines, u, v), crs=edges.crs)
        edges["length"] = edges.length
    return nodes, edges


def text_value(value: Any) -> str | None:
    """Return a value as text for a format that only stores text; None if it is missing.

    Control characters, which XML cannot hold, are left out.

    Examples
    --------
    >>> text_value(0.1), text_value(7), text_value(pd.NA)
    ('0.1', '7', None)
    """
    if pd.isna(value):
        return None
    return _CONTROL.sub("", repr(float(value)) if isinstance(value, float) else str(value))


def typed_column(text: pd.Series) -> pd.Series:
    """Undo `text_value` for a column: numbers or flags if every value can be read as one, else text."""
    if text.dropna().isin(["True", "False"]).all():
        return text.map({"True": True, "False": False})
    try:
        return pd.to_numeric(text)
    except (ValueError, TypeError):
        return text
