"""Reading and writing of road graphs: files of every format, chosen by the suffix."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError

from probe2road.errors import InputError, MissingFileError, OptionError, OutputError
from probe2road.graph.check import require_sound
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import settled
from probe2road.io.compressed import require_bounded
from probe2road.io.formats import GraphFormat, adjusted
from probe2road.io.graph_networkx import read_graphml, write_graphml
from probe2road.io.graph_readers import read_parquet_graph, read_vector_graph
from probe2road.io.graph_writers import write_flatgeobuf, write_geojson, write_geopackage, write_geoparquet
from probe2road.io.guard import located
from probe2road.io.osm import read_osm
from probe2road.io.osm_json import holds_osm_json
from probe2road.io.osm_writer import OsmOptions, write_osm

__all__ = ["READABLE", "WRITABLE", "graph_format", "read_graph", "write_graph"]

logger = logging.getLogger(__name__)


def write_graph(graph: RoadGraph, path: str | PathLike[str], *, osm: OsmOptions | None = None) -> None:
    """Write a road graph to a file, in the format that its suffix names.

    The invariants are checked first, and a file is complete or absent. What each format keeps, and how
    precisely, is in the guide on outputs; the metric CRS is recorded in all of them.

    Parameters
    ----------
    graph
        The graph; it may be empty.
    path
        File with a suffix of `WRITABLE`; GeoParquet puts nodes and turns in two files beside it.
    osm
        For whom an OSM file is written; for routing engines where the suffix is ``.osm.pbf``, else for editors.

    Raises
    ------
    OptionError
        If the suffix is of no format we write, or an OSM file would need ids that are too large.
    OutputError
        If the file cannot be written, or the graph holds columns that may identify drives.
    InputError
        If the graph breaks an invariant.

    Examples
    --------
    >>> import tempfile
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> path = Path(tempfile.mkdtemp()) / "roads.gpkg"
    >>> write_graph(graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616"), path)
    >>> read_graph(path)
    RoadGraph(2 nodes, 1 edges, 0.100 km, WGS 84 / UTM zone 16N)
    """
    kind = graph_format(path, WRITABLE)
    writer = partial(write_osm, options=osm) if kind == "OSM" else _WRITERS[kind]
    require_sound(graph, where="graph to write")
    try:
        writer(graph, path)
    except OutputError:
        raise  # an OSError as well, and says what is wrong
    except (OSError, RuntimeError, DataSourceError, DataLayerError, FieldError, FeatureError) as error:
        raise OutputError(f"cannot be written ({error})", where=path) from error
    logger.info("wrote %d nodes and %d edges to %s", len(graph.nodes), len(graph.edges), path)


def read_graph(
    path: str | PathLike[str],
    *,
    format: GraphFormat | None = None,
    crs: Any = None,
    target_crs: Any = None,
    layer: str | None = None,
    inner_junctions: bool | None = None,
    max_uncompressed: float | None = None,
) -> RoadGraph:
    """Read a road graph from a file, in the format that its suffix names.

    A file that probe2road wrote comes back as it was, to the precision of the format. A file of plain lines
    becomes a graph of origin ``reference``: edges join where the ends of lines meet, and where a line ends on an inner
    vertex of another; a line for each direction of a street becomes one edge. OSM ways are split where
    they share a node; see `probe2road.io.osm.read_osm`, also for reading other than drivable roads.

    Parameters
    ----------
    path
        File with a suffix of `READABLE`.
    format
        The parameters below in one object; a parameter that is given, too, takes the place of its field.
    crs
        CRS of the coordinates, for a file that names none.
    target_crs
        Metric CRS to work in. Otherwise the recorded one, the file's own, or, for degrees, the local one.
    layer
        Layer of the edges, in a file of several.
    inner_junctions
        Whether lines of a GIS file are cut at inner vertices on which another line ends; True by default.
    max_uncompressed
        Gigabytes that a compressed file may hold, 4 by default; one that holds more is refused before it is read.

    Raises
    ------
    MissingFileError
        If the file is absent.
    InputError
        If it is empty or damaged, or holds no lines.
    CRSError
        If it names no CRS and none is given, or the two contradict.
    OptionError
        If the suffix is of no format we read.
    """
    format = adjusted(
        format or GraphFormat(),
        crs=crs,
        target_crs=target_crs,
        layer=layer,
        inner_junctions=inner_junctions,
        max_uncompressed=max_uncompressed,
    )
    kind = graph_format(path, READABLE)
    file = settled(path)
    if not file.is_file():
        raise MissingFileError("no such file", where=path, fix="check the path")
    if file.stat().st_size == 0:
        raise InputError("the file is empty", where=path, fix="check that it is complete")
    require_bounded(file, format.max_uncompressed)
    with located(path):
        if kind == "OSM" or (kind == "GeoJSON" and holds_osm_json(path)):
            return read_osm(path, target_crs=format.target_crs)
        if kind == "GraphML":
            return read_graphml(path, target_crs=format.target_crs)
        said: dict[str, Any] = {"crs": format.crs, "target_crs": format.target_crs}
        said["inner_junctions"] = format.inner_junctions
        if kind == "GeoParquet":
            return read_parquet_graph(path, **said)
        return read_vector_graph(path, layer=format.layer, **said)


WRITABLE = {
    ".gpkg": "GeoPackage",
    ".parquet": "GeoParquet",
    ".geoparquet": "GeoParquet",
    ".fgb": "FlatGeobuf",
    ".geojson": "GeoJSON",
    ".graphml": "GraphML",
    ".osm": "OSM",
    ".osm.pbf": "OSM",
    ".osc": "OSM",
}  # suffix to format
READABLE = {**WRITABLE, ".json": "GeoJSON", ".pbf": "OSM", ".osm.gz": "OSM", ".osm.bz2": "OSM", ".shp": "Shapefile"}


def graph_format(path: str | PathLike[str], formats: dict[str, str] = WRITABLE) -> str:
    """Return the format that the suffix of a path names.

    Examples
    --------
    >>> graph_format("out/Roads.OSM.PBF")
    'OSM'
    >>> graph_format("roads.dxf")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: roads.dxf: suffix is of no known format; use one of .fgb, .geojson, ...
    """
    name = Path(path).name.lower()
    for suffix in sorted(formats, key=len, reverse=True):
        if name.endswith(suffix):
            return formats[suffix]
    raise OptionError("suffix is of no known format", where=path, fix=f"use one of {', '.join(sorted(formats))}")


_WRITERS: dict[str, Callable[[RoadGraph, str | PathLike[str]], None]] = {
    "GeoPackage": write_geopackage,
    "GeoParquet": write_geoparquet,
    "FlatGeobuf": write_flatgeobuf,
    "GeoJSON": write_geojson,
    "GraphML": write_graphml,
}
