"""Road graphs from GIS files: our own, and reference networks of plain lines from anywhere.

A file that we wrote comes back as it was. Any other file of LineStrings becomes a reference graph: edges meet
where the ends of lines meet, and further columns are kept.
"""

from __future__ import annotations

import json
import logging
import warnings
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd
import pyarrow as pa
import pyogrio
from pyogrio.errors import DataLayerError, DataSourceError
from pyproj import CRS

from probe2road.crs import WGS84, local_crs, parse_crs, require_metric
from probe2road.errors import CRSError, InputError
from probe2road.graph.direction import in_driving_direction
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.io.atomic import settled
from probe2road.io.graph_tables import OWN_COLUMNS, graph_from_edge_table
from probe2road.io.graph_writers import GRAPH_MARK, parquet_siblings

__all__ = ["graph_from_table", "read_note", "read_parquet_graph", "read_vector_graph"]

logger = logging.getLogger(__name__)


def read_vector_graph(
    path: str | PathLike[str], *, crs: Any = None, target_crs: Any = None, layer: str | None = None
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

    Raises
    ------
    InputError
        If the file is damaged, has no such layer, or holds no lines.
    CRSError
        If there is no CRS.
    """
    path = Path(path)
    try:
        layers = [str(name) for name in pyogrio.list_layers(path)[:, 0]]
        chosen = _edge_layer(layers, layer, path)
        table = _read_layer(path, chosen)
        own = set(OWN_COLUMNS) <= set(table)
        nodes = _read_layer(path, "nodes") if own and "nodes" in layers else None
        turns = _read_layer(path, "turns") if own and "turns" in layers else None
    except (DataSourceError, DataLayerError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot be read ({_first_line(error)})", where=path, fix="check that it is complete"
        ) from error
    recorded = _recorded_crs(path) if path.suffix.lower() in (".geojson", ".json") else None
    if recorded is not None:
        target_crs = target_crs or recorded
        if table.empty:  # without features there are no columns either
            return empty_graph(target_crs)
    return graph_from_table(table, nodes=nodes, turns=turns, crs=crs, target_crs=target_crs, where=path)


def read_note(path: str | PathLike[str], name: str) -> str | None:
    """Return a note that `probe2road.io.graph_writers.write_geopackage` put into a file, or None.

    None also where the file cannot be read.
    """
    try:
        notes = pyogrio.read_info(path, layer="edges")["layer_metadata"] or {}
    except (DataSourceError, DataLayerError):
        return None
    return notes.get(name)


def read_parquet_graph(path: str | PathLike[str], *, crs: Any = None, target_crs: Any = None) -> RoadGraph:
    """Read a graph from GeoParquet; nodes and turns are taken from the files beside it where they are.

    The parameters and errors are those of `read_vector_graph`.
    """
    path = Path(path)
    nodes_path, turns_path = parquet_siblings(path)
    nodes_path, turns_path = settled(nodes_path), settled(turns_path)
    try:
        table = gpd.read_parquet(settled(path))
        own = set(OWN_COLUMNS) <= set(table)
        nodes = gpd.read_parquet(nodes_path) if own and nodes_path.is_file() else None
        turns = pd.read_parquet(turns_path) if own and turns_path.is_file() else None
    except (pa.ArrowInvalid, OSError, ValueError) as error:
        raise InputError(
            f"cannot be read as GeoParquet ({_first_line(error)})", where=path, fix="check that it is complete"
        ) from error
    mark = table.attrs.pop(GRAPH_MARK, None)
    for beside, sibling in ((nodes_path, nodes), (turns_path, turns)):
        other = None if sibling is None else sibling.attrs.pop(GRAPH_MARK, None)
        if None not in (mark, other) and mark != other:
            fix = "take both from one run, or remove the file beside the edges"
            raise InputError(f"the file beside it, {beside.name}, is of another graph", where=path, fix=fix)
    return graph_from_table(table, nodes=nodes, turns=turns, crs=crs, target_crs=target_crs, where=path)


def graph_from_table(
    table: gpd.GeoDataFrame,
    *,
    nodes: gpd.GeoDataFrame | None = None,
    turns: pd.DataFrame | None = None,
    crs: Any = None,
    target_crs: Any = None,
    where: object,
) -> RoadGraph:
    """Make a graph of a table of lines: our own edges as they were, any others as a reference graph.

    One-way edges run in their driving direction: a line whose ``oneway`` says that it is driven against its course
    is turned.

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
    target = _target(table, target_crs, where)
    table = table if table.crs == target else table.to_crs(target)
    if own:
        nodes = nodes if nodes is None or nodes.crs == target else nodes.to_crs(target)
        return graph_from_edge_table(table, nodes=nodes, turns=turns, where=where)
    graph = graph_from_lines(
        table.geometry.to_numpy(), crs=target, origin="reference", attributes=_further_columns(table)
    )
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


def _read_layer(path: Path, layer: str) -> Any:
    with warnings.catch_warnings():
        # GDAL warns of what we check ourselves, such as rings that are not closed.
        warnings.simplefilter("ignore", RuntimeWarning)
        return pyogrio.read_dataframe(path, layer=layer)


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
    """Return the table with a CRS: its own, or the given one where it has none."""
    if not isinstance(table, gpd.GeoDataFrame):
        raise InputError("holds no geometry", where=where, fix="give a file with road centrelines")
    if table.crs is not None:
        if crs is not None and parse_crs(crs, where=where) != table.crs:
            raise CRSError(f"is in {table.crs.name}, not in {crs}", where=where, fix="leave the CRS out")
        return table
    if crs is None:
        require_metric(None, where=where)
    return table.set_crs(parse_crs(crs, where=where))


def _target(table: gpd.GeoDataFrame, target_crs: Any, where: object) -> CRS:
    """Return the metric CRS to work in."""
    if target_crs is not None:
        return require_metric(parse_crs(target_crs, where=where), where=where)
    if not table.crs.is_geographic:
        return require_metric(table.crs, where=where)
    left, bottom, right, top = table.to_crs(WGS84).total_bounds
    return local_crs([left, right], [bottom, top])


def _further_columns(table: gpd.GeoDataFrame) -> pd.DataFrame:
    """Return the columns to keep of a file that is not ours: none of them means what ours mean."""
    own = ["edge", "support", "score", "forward", "backward", "origin"]
    return pd.DataFrame(table.drop(columns=[table.geometry.name, *own], errors="ignore"))


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
