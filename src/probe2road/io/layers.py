"""Fleet data from layers of points in GIS files: GeoPackage, GeoJSON, FlatGeobuf, Shapefile."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyogrio

from probe2road.crs import parse_crs
from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin
from probe2road.io.cells import raw_table
from probe2road.io.columns import choose_columns
from probe2road.io.formats import FleetFormat
from probe2road.io.guard import parsing
from probe2road.io.sources import RawTable, SourceFile

__all__ = ["holds_fixes", "read_layer"]

_GEOMETRY = "geometry"
_UNNAMED = "wkb_geometry"  # what pyogrio calls the shapes of formats that do not name them
_GRAPH_LAYERS = ("edges", "nodes")  # of road graphs, ours and OSMnx's
_TRACK_POINTS = "track_points"  # of GPX that GDAL made a GeoPackage of


def read_layer(source: SourceFile, format: FleetFormat | None = None, *, points: bool = False) -> RawTable:
    """Read one layer of points.

    Parameters
    ----------
    source
        The file.
    format
        What the user says of the layer, the columns and the CRS; nothing where it is None.
    points
        Whether the file holds semantic points rather than traces.

    Returns
    -------
    RawTable
        In the CRS of the layer.

    Raises
    ------
    InputError
        If the file is damaged, has no such layer, several layers of points, or lines, which have no times.
    """
    format = format or FleetFormat()
    with parsing(source.path, "cannot be read"):
        layer = _chosen_layer(source.path, format.layer)
        about, content = pyogrio.read_arrow(source.path, layer=layer)
        content = pa.table(content)
        shapes = content.column(about["geometry_name"] or _UNNAMED)
        attributes = content.drop_columns([about["geometry_name"] or _UNNAMED])
        content = attributes.drop_columns([_GEOMETRY] * (_GEOMETRY in attributes.schema.names))
        content = content.append_column(_GEOMETRY, shapes)
    choice = choose_columns(
        content.schema.names,
        format.columns_of(points=points),
        points=points,
        geometry=_GEOMETRY,
        crs=format.stated_crs,
        where=source.path,
    )
    crs = parse_crs(about["crs"], where=source.path) if about["crs"] else None
    origin = TableOrigin("points" if points else "traces", "feature")
    with parsing(source.path, "a column cannot be read", fix="write the file again, or name other columns"):
        return raw_table(content, choice, format, origin, crs=crs, where=source.path)


def holds_fixes(path: Path, layer: str | None = None) -> bool:
    """Say whether a GIS file is one of fixes rather than of roads: points, and no layers of a road graph."""
    try:
        layers = {str(name): str(kind) for name, kind in pyogrio.list_layers(path)}
    except Exception:  # whoever reads it says what is wrong
        return False
    if layer is not None:
        return "Point" in layers.get(layer, "")
    return any("Point" in kind for kind in layers.values()) and not set(_GRAPH_LAYERS) & set(layers)


def _chosen_layer(path: Path, wanted: str | None) -> str:
    """Return the layer to read: the one named, the track points of a GPX file, or the only one of points."""
    layers = {str(name): str(kind) for name, kind in pyogrio.list_layers(path)}
    there = ", ".join(layers)
    if wanted is not None:
        if wanted not in layers:
            raise InputError(f"there is no layer {wanted!r}", where=path, fix=f"the layers are {there}")
        return wanted
    of_points = [name for name, kind in layers.items() if "Point" in kind] or list(layers)
    if _TRACK_POINTS in of_points:
        return _TRACK_POINTS
    if len(of_points) != 1:
        fix = f'say which has the fixes, for example layer="{next(iter(of_points), "fixes")}"'
        raise InputError(f"several layers may hold the fixes ({there})", where=path, fix=fix)
    return of_points[0]
