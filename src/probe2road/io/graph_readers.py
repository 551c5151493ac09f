"""Reading road graphs from GIS files: our own, and reference networks of plain lines from other sources.

A file that we wrote comes back as it was. Any other file of LineStrings becomes a reference graph: edges meet
where the ends of lines meet, and further columns are kept.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely
from numpy.typing import NDArray
from pyogrio.errors import DataLayerError, DataSourceError
from pyproj import CRS

from probe2road.crs import parse_crs, require_metric, working_crs
from probe2road.errors import CRSError, InputError
from probe2road.graph.direction import in_driving_direction
from probe2road.graph.lines import cut_at_ends, one_line_each
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.io.atomic import settled
from probe2road.io.graph_tables import OWN_COLUMNS, graph_from_edge_table, projected, require_finite
from probe2road.io.graph_writers import GRAPH_MARK, parquet_siblings
from probe2road.io.guard import parsing
from probe2road.io.overture import holds_segments, segment_lines

__all__ = ["graph_from_table", "read_note", "read_parquet_graph", "read_vector_graph"]

logger = logging.getLogger(__name__)

_SNAP = 0.01  # m; ends of lines nearer than this are one place


def read_vector_graph(
    path: str | PathLike[str],
    *,
    crs: Any = None,
    target_crs: Any = None,
    layer: str | None = None,
    inner_junctions: bool = True,
) -> RoadGraph:
    """Read a graph from GeoPackage, FlatGeobuf or GeoJSON.

    Parameters
    ----------
    path
        The file.
    crs
        CRS of the coordinates, for a file that names none.
    target_crs
        Metric CRS to work in; otherwise the file's own, or the one recorded in it, or a local one.
    layer
        Layer of the edges; otherwise ``edges`` where there is one, or the only layer.
    inner_junctions
        Whether a line that is not ours is cut at its inner vertices on which another one ends.

    Raises
    ------
    InputError
        If the file is damaged, has no such layer, or holds no lines.
    CRSError
        If there is no CRS.
    """
    path = Path(path)
    with parsing(path, "cannot be read"):
        layers = [str(name) for name in pyogrio.list_layers(path)[:, 0]]
        chosen = _edge_layer(layers, layer, path)
        table = pyogrio.read_dataframe(path, layer=chosen)
        own = set(OWN_COLUMNS) <= set(table)
        nodes = pyogrio.read_dataframe(path, layer="nodes") if own and "nodes" in layers else None
        turns = pyogrio.read_dataframe(path, layer="turns") if own and "turns" in layers else None
    recorded = _recorded_crs(path) if path.suffix.lower() in (".geojson", ".json") else None
    if recorded is not None:
        target_crs = target_crs or recorded
        if table.empty:  # without features there are no columns either
            return empty_graph(target_crs)
    return graph_from_table(
        table,
        nodes=nodes,
        turns=turns,
        crs=crs,
        target_crs=target_crs,
        inner_junctions=inner_junctions,
        where=path,
    )


def read_note(path: str | PathLike[str], name: str) -> str | None:
    """Return a note that `probe2road.io.graph_writers.write_geopackage` put into a file, or None.

    None also where the file cannot be read.
    """
    try:
        notes = pyogrio.read_info(path, layer="edges")["layer_metadata"] or {}
    except (DataSourceError, DataLayerError):
        return None
    return notes.get(name)


def read_parquet_graph(
    path: str | PathLike[str], *, crs: Any = None, target_crs: Any = None, inner_junctions: bool = True
) -> RoadGraph:
    """Read a graph from GeoParquet; nodes and turns are read from the files beside it if they exist.

    The parameters and errors are those of `read_vector_graph`.
    """
    path = Path(path)
    nodes_path, turns_path = parquet_siblings(path)
    nodes_path, turns_path = settled(nodes_path), settled(turns_path)
    with parsing(path, "cannot be read as GeoParquet"):
        table = gpd.read_parquet(settled(path))
        own = set(OWN_COLUMNS) <= set(table)
        nodes = gpd.read_parquet(nodes_path) if own and nodes_path.is_file() else None
        turns = pd.read_parquet(turns_path) if own and turns_path.is_file() else None
    mark = table.attrs.pop(GRAPH_MARK, None)
    for beside, sibling in ((nodes_path, nodes), (turns_path, turns)):
        other = None if sibling is None else sibling.attrs.pop(GRAPH_MARK, None)
        if None not in (mark, other) and mark != other:
            fix = "take both from one run, or remove the file beside the edges"
            raise InputError(f"the file beside it, {beside.name}, is of another graph", where=path, fix=fix)
    return graph_from_table(
        table,
        nodes=nodes,
        turns=turns,
        crs=crs,
        target_crs=target_crs,
        inner_junctions=inner_junctions,
        where=path,
    )


def graph_from_table(
    table: gpd.GeoDataFrame,
    *,
    nodes: gpd.GeoDataFrame | None = None,
    turns: pd.DataFrame | None = None,
    crs: Any = None,
    target_crs: Any = None,
    inner_junctions: bool = True,
    where: object,
) -> RoadGraph:
    """Make a graph from a table of lines: our own edges as they were, other lines as a reference graph.

    One-way edges run in their driving direction: a line whose ``oneway`` says that it is driven against its course
    is turned. Two lines of a reference that run through the same places in opposite directions are one edge. With
    ``inner_junctions`` they are cut at inner vertices on which another line ends. A reference whose CRS is not true to
    scale, such as Web Mercator, is projected to the local one.

    Raises
    ------
    InputError
        If there are no lines, or our own columns are damaged.
    CRSError
        If there is no CRS, or the target is not metric.

    Examples
    --------
    >>> import shapely
    >>> table = gpd.GeoDataFrame({"name": ["Main"]}, geometry=[shapely.LineString([(9, 0), (9, 0.001)])], crs=4326)
    >>> graph = graph_from_table(table, where="streets.gpkg")
    >>> graph.edges["name"].tolist(), graph.edges["origin"].tolist(), graph.crs.to_epsg()
    (['Main'], ['reference'], 32632)
    """
    own = set(OWN_COLUMNS) <= set(table)
    if not own and not len(table):
        raise InputError("holds no features", where=where, fix="give a file with road centrelines")
    table = _with_crs(table, crs, where)
    if not own and holds_segments(table):
        with parsing(where, "the segments of Overture are damaged", fix="download them again"):
            table = segment_lines(table)
    require_finite(table, where=where)
    left, bottom, right, top = table.total_bounds if len(table) and not table.geometry.isna().all() else [[]] * 4
    target = working_crs(
        table.crs, np.hstack([left, right]), np.hstack([bottom, top]), target_crs=target_crs, own=own, where=where
    )
    table = projected(table, target, where=where)
    if own:
        nodes = None if nodes is None else projected(nodes, target, where=where)
        return graph_from_edge_table(table, nodes=nodes, turns=turns, where=where)
    lines, attributes = _streets(table)
    if inner_junctions:
        lines, line = cut_at_ends(lines, snap=_SNAP)
        attributes = attributes.iloc[line]
    graph = graph_from_lines(lines, crs=target, origin="reference", snap=_SNAP, attributes=attributes)
    if graph.edges.empty:
        kinds = ", ".join(sorted({str(kind) for kind in table.geom_type.dropna()})) or "no geometry"
        raise InputError(f"holds no lines ({kinds})", where=where, fix="give a file with road centrelines")
    logger.info("%s: %d lines became %s", where, len(table), graph)
    return replace(graph, edges=in_driving_direction(graph.edges))


def _edge_layer(layers: list[str], wanted: str | None, path: Path) -> str:
    if wanted is None:
        wanted = "edges" if "edges" in layers else layers[0] if len(layers) == 1 else None
    if wanted is None or wanted not in layers:
        what = f"has no layer {wanted!r}" if wanted else "has several layers, and none is called 'edges'"
        example = f', for example layer="{layers[0]}"' if layers else ""
        fix = f"name the layer of the edges{example}"
        raise InputError(f"{what} (there are: {', '.join(layers)})", where=path, fix=fix)
    return wanted


def _recorded_crs(path: Path) -> CRS | None:
    """Return the metric CRS that `write_geojson` recorded in the first line, or None."""
    with path.open(encoding="utf-8", errors="replace") as file:
        head = file.readline(1 << 16).rstrip().removesuffix(",")
    try:
        recorded = json.loads(f"{head}}}")["probe2road"]["crs"]
    except (ValueError, LookupError, TypeError):
        return None
    return parse_crs(recorded, where=path)


def _with_crs(table: gpd.GeoDataFrame, crs: Any, where: object) -> gpd.GeoDataFrame:
    """Return the table with a CRS: its own, or the given one if it has none."""
    if not isinstance(table, gpd.GeoDataFrame):
        raise InputError("holds no geometry", where=where, fix="give a file with road centrelines")
    if table.crs is not None:
        if crs is not None and parse_crs(crs, where=where) != table.crs:
            raise CRSError(f"is in {table.crs.name}, not in {crs}", where=where, fix="leave the CRS out")
        return table
    if crs is None:
        require_metric(None, where=where)
    return table.set_crs(parse_crs(crs, where=where))


def _streets(table: gpd.GeoDataFrame) -> tuple[NDArray[Any], pd.DataFrame]:
    """Return the lines of a foreign file, one for each street, with the columns to keep."""
    parts, row = shapely.get_parts(table.geometry.to_numpy(), return_index=True)
    lines = shapely.get_type_id(parts) == shapely.GeometryType.LINESTRING
    return one_line_each(parts[lines], _further_columns(table).iloc[row[lines]])


def _further_columns(table: gpd.GeoDataFrame) -> pd.DataFrame:
    """Return the columns of a foreign file to keep; columns with the names of ours have other meanings."""
    own = ["edge", "support", "score", "forward", "backward", "origin"]
    return pd.DataFrame(table.drop(columns=[table.geometry.name, *own], errors="ignore"))
