"""Writing road graphs to GIS files: GeoPackage, GeoParquet, FlatGeobuf and GeoJSON.

=============  ============================================  ===================  =========
format         tables                                        coordinates          precision
=============  ============================================  ===================  =========
GeoPackage     layers ``nodes``, ``edges``, table ``turns``  metric CRS           exact
GeoParquet     ``NAME.parquet`` holds the edges; the others  metric CRS           exact
               lie beside it as ``NAME.nodes.parquet`` and
               ``NAME.turns.parquet``
FlatGeobuf     edges, turns as text                          metric CRS           exact
GeoJSON        edges, turns as text                          degrees (RFC 7946),  1 mm
                                                             metric CRS recorded
=============  ============================================  ===================  =========

With turns as text, an edge carries ``to_edge@via_node:count`` for every turn that starts on it.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely

from probe2road.crs import WGS84, crs_to_text, transform
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import edges_with_turns
from probe2road.io.atomic import atomic_path, atomic_paths
from probe2road.io.graph_tables import outgoing

__all__ = [
    "GRAPH_MARK",
    "geojson_features",
    "parquet_siblings",
    "write_flatgeobuf",
    "write_geojson",
    "write_geopackage",
    "write_geoparquet",
]

logger = logging.getLogger(__name__)

GRAPH_MARK = "probe2road_graph"  # attribute of the tables of one graph: a digest of all of them
GEOJSON_DECIMALS = 8  # of a degree: 1 mm


def write_geopackage(graph: RoadGraph, path: str | PathLike[str], *, note: Mapping[str, str] | None = None) -> None:
    """Write the layers ``nodes`` and ``edges`` and the attribute table ``turns`` to a GeoPackage.

    Notes go into the metadata of the edges, where `probe2road.io.graph_readers.read_note` finds them.

    Raises
    ------
    OutputError
        If the file cannot be written or the graph holds private columns.
    """
    graph = outgoing(graph, where=path)
    with atomic_path(path) as temporary:
        # Edges first: a program that opens only one layer opens the first.
        layers = {"edges": graph.edges.reset_index(), "nodes": graph.nodes.reset_index(), "turns": graph.turns}
        for layer, table in layers.items():
            pyogrio.write_dataframe(
                table,
                temporary,
                layer=layer,
                driver="GPKG",
                append=layer != "edges",
                geometry_type={"edges": _line_type(graph), "nodes": _point_type(graph)}.get(layer),
                layer_metadata=dict(note) if note and layer == "edges" else None,
            )


def write_geoparquet(graph: RoadGraph, path: str | PathLike[str]) -> None:
    """Write the edges as GeoParquet 1.1 with a covering bounding box, and nodes and turns to files beside it.

    The three files become those of the new graph together, or not at all.

    Raises
    ------
    OutputError
        If a file cannot be written or the graph holds private columns.
    """
    graph = outgoing(graph, where=path)
    tables = (graph.edges.reset_index(), graph.nodes.reset_index(), graph.turns.copy())
    mark = _digest(tables)
    # Each says which graph it is of: files can be copied one by one.
    for table in tables:
        table.attrs = {GRAPH_MARK: mark}
    edges, nodes, turns = tables
    with atomic_paths([path, *parquet_siblings(path)]) as (edges_place, nodes_place, turns_place):
        for table, place in ((edges, edges_place), (nodes, nodes_place)):
            table.to_parquet(place, index=False, compression="zstd", schema_version="1.1.0", write_covering_bbox=True)
        turns.to_parquet(turns_place, index=False, compression="zstd")


def _digest(tables: Sequence[pd.DataFrame]) -> str:
    """Return a digest of the content of some tables; equal tables have equal digests."""
    digest = hashlib.blake2b(digest_size=16)
    for table in tables:
        digest.update(json.dumps([str(name) for name in table]).encode())
        for name in table:
            if name == "geometry":
                lines = shapely.to_wkb(table[name].to_numpy())
                digest.update(b"".join(lines))
            else:
                digest.update(table[name].to_csv(index=False).encode())
    return digest.hexdigest()


def parquet_siblings(path: str | PathLike[str]) -> tuple[Path, Path]:
    """Return where the nodes and the turns of a GeoParquet graph lie.

    Examples
    --------
    >>> [sibling.name for sibling in parquet_siblings("roads.parquet")]
    ['roads.nodes.parquet', 'roads.turns.parquet']
    """
    path = Path(path)
    return path.with_name(f"{path.stem}.nodes{path.suffix}"), path.with_name(f"{path.stem}.turns{path.suffix}")


def write_flatgeobuf(graph: RoadGraph, path: str | PathLike[str]) -> None:
    """Write the edges, with a spatial index and their turns as text, to a FlatGeobuf file.

    Raises
    ------
    OutputError
        If the file cannot be written or the graph holds private columns.
    """
    graph = outgoing(graph, where=path)
    with atomic_path(path) as temporary:
        pyogrio.write_dataframe(
            edges_with_turns(graph.edges, graph.turns),
            temporary,
            layer="edges",
            driver="FlatGeobuf",
            geometry_type=_line_type(graph),
        )


def write_geojson(graph: RoadGraph, path: str | PathLike[str]) -> None:
    """Write the edges, with their turns as text, to GeoJSON in longitude and latitude (RFC 7946).

    The first line is a foreign member ``probe2road`` that names the metric CRS to read the graph back into.
    Heights are written for the lines whose every height is known.

    Raises
    ------
    OutputError
        If the file cannot be written or the graph holds private columns.
    """
    graph = outgoing(graph, where=path)
    features = geojson_features(edges_with_turns(graph.edges, graph.turns), decimals=GEOJSON_DECIMALS)
    head = json.dumps({"type": "FeatureCollection", "probe2road": {"crs": crs_to_text(graph.crs)}})
    rows = ",\n".join(json.dumps(feature, separators=(",", ":"), allow_nan=False) for feature in features)
    with atomic_path(path) as temporary:
        temporary.write_text(f'{head[:-1]},\n"features": [\n{rows}\n]}}\n', encoding="utf-8")


def geojson_features(table: gpd.GeoDataFrame, *, decimals: int) -> list[dict[str, Any]]:
    """Return the GeoJSON features of a table of LineStrings in a metric CRS; missing values become null.

    Parameters
    ----------
    table
        One row per feature.
    decimals
        Digits behind the point, in degrees; heights have three.

    Examples
    --------
    >>> line = shapely.LineString([(500000, 0), (500000, 100)])
    >>> geojson_features(gpd.GeoDataFrame({"edge": [7]}, geometry=[line], crs="EPSG:32632"), decimals=6)[0]["geometry"]
    {'type': 'LineString', 'coordinates': [[9.0, 0.0], [9.0, 0.000905]]}
    """
    lines = table.geometry.to_numpy()
    coordinates, owner = shapely.get_coordinates(lines, include_z=True, return_index=True)
    lon, lat = transform(coordinates[:, 0], coordinates[:, 1], table.crs, WGS84)
    in_plan = np.zeros(len(lines), bool)
    in_plan[owner[~np.isfinite(coordinates[:, 2])]] = True
    positions = np.column_stack(
        [np.round(lon, decimals), np.round(lat, decimals), np.round(coordinates[:, 2], 3)]
    ).tolist()
    starts = np.searchsorted(owner, np.arange(len(lines) + 1)).tolist()
    features = []
    for row, properties in enumerate(_plain_records(table.drop(columns=table.geometry.name))):
        vertices = positions[starts[row] : starts[row + 1]]
        if in_plan[row]:
            vertices = [vertex[:2] for vertex in vertices]
        geometry = {"type": "LineString", "coordinates": vertices}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    return features


def _plain_records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows as dictionaries of Python values, None where a value is missing or infinite."""
    plain = table.astype(object).where(table.notna() & ~table.isin([np.inf, -np.inf]), None)
    columns = [plain[column].tolist() for column in plain]
    names = [str(column) for column in plain]
    return [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]


def _line_type(graph: RoadGraph) -> str:
    """Return the geometry type of the layer, which says whether there are heights."""
    return "LineString Z" if shapely.has_z(graph.edges.geometry.to_numpy()).any() else "LineString"


def _point_type(graph: RoadGraph) -> str:
    return "Point Z" if shapely.has_z(graph.nodes.geometry.to_numpy()).any() else "Point"
