"""Coordinates of point geometry columns, straight from their buffers.

Strategy: a column of WKB points has values of one length, 21 bytes in the plane or 29 with a height, laid
end to end in one buffer. Read as an array of packed records it gives all coordinates at once, without a
geometry object per fix. GeoArrow columns hold the coordinates as they are: a struct of x, y (and z), or a
fixed-size list of them.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import parse_crs
from probe2road.errors import InputError

__all__ = ["point_coordinates", "text_coordinates"]

# Geometry type codes of a point: ISO WKB, and the high bit with which EWKB marks a height.
_POINT_CODES = {21: (1,), 29: (1001, 0x80000001)}


def point_coordinates(column: pa.ChunkedArray, *, name: str, where: object = None) -> dict[str, NDArray[np.float64]]:
    """Return the coordinates of a column of points.

    Parameters
    ----------
    column
        WKB of 2-D or 3-D points, or GeoArrow points (struct or fixed-size list); missing ones become NaN.
    name, where
        Column and file, for messages.

    Returns
    -------
    dict
        ``x``, ``y``, and ``z`` where the points have heights: float64 arrays of the column's length.

    Raises
    ------
    InputError
        If a geometry is no point, or if the column is of another type.

    Examples
    --------
    >>> points = pa.chunked_array([shapely.to_wkb(shapely.points([[1.0, 2.0], [3.0, 4.0]]))])
    >>> point_coordinates(points, name="geometry")["y"].tolist()
    [2.0, 4.0]
    """
    chunks = [chunk.storage if isinstance(chunk, pa.ExtensionArray) else chunk for chunk in column.chunks]
    parts = [_with_holes(chunk, name, where) for chunk in chunks if len(chunk)]
    if not parts:
        return {axis: np.zeros(0) for axis in "xy"}
    axes = [axis for axis in "xyz" if any(axis in part for part in parts)]
    flat = {axis: [part.get(axis, np.full(len(part["x"]), np.nan)) for part in parts] for axis in axes}
    return {axis: arrays[0] if len(arrays) == 1 else np.concatenate(arrays) for axis, arrays in flat.items()}


def _with_holes(chunk: Any, name: str, where: object) -> dict[str, NDArray[np.float64]]:
    """Return the coordinates of one array, NaN where a value is missing."""
    if chunk.null_count == 0:
        return _coordinates(chunk, name, where)
    if chunk.null_count == len(chunk):
        return {axis: np.full(len(chunk), np.nan) for axis in "xy"}
    there = chunk.is_valid().to_numpy(zero_copy_only=False)
    whole = {}
    for axis, values in _coordinates(chunk.drop_null(), name, where).items():
        whole[axis] = np.full(len(chunk), np.nan)
        whole[axis][there] = values
    return whole


def text_coordinates(
    column: pa.ChunkedArray, *, name: str, where: object = None
) -> tuple[dict[str, NDArray[np.float64]], CRS | None]:
    """Return the coordinates of a column of points in text: WKT, WKB in hexadecimal digits, or GeoJSON.

    Parameters
    ----------
    column
        Text; missing and unreadable values become NaN.
    name, where
        Column and file, for messages.

    Returns
    -------
    (dict, CRS or None)
        ``x``, ``y`` and, where any point has a height, ``z``: float64 arrays of the column's length; and the CRS that
        a prefix ``SRID=4326;`` or extended WKB names.

    Raises
    ------
    InputError
        If the column holds lines or areas, or nothing that can be read.

    Examples
    --------
    >>> points, crs = text_coordinates(pa.chunked_array([["SRID=4326;POINT (13.5 52.5)", None]]), name="geom")
    >>> points["x"].tolist(), crs.to_epsg()
    ([13.5, nan], 4326)
    """
    words = [word.strip() if isinstance(word, str) else None for word in column.to_pylist()]
    first = next((word for word in words if word), "")
    srid = None
    if first[:1] == "{":
        points = shapely.from_geojson(np.array(words, object), on_invalid="ignore")
    elif re.fullmatch(r"0[01][0-9A-Fa-f]{8,}", first):
        points = shapely.from_wkb(np.array(words, object), on_invalid="ignore")
        srid = int(shapely.get_srid(next((point for point in points if point is not None), None)))
    else:
        if found := re.match(r"SRID=(\d+);", first, re.IGNORECASE):
            srid = int(found[1])
            words = [None if word is None else word.rpartition(";")[2] for word in words]
        points = shapely.from_wkt(np.array(words, object), on_invalid="ignore")
    kinds = shapely.get_type_id(points)
    if ((kinds != 0) & (kinds != -1)).any():
        raise _not_points(name, where)
    if len(points) and (kinds == -1).all():
        fault = f"column {name!r} holds no points that can be read ({first[:60]})"
        raise InputError(fault, where=where, fix="write POINT (x y), or name the columns of x and y")
    axes = {"x": shapely.get_x(points), "y": shapely.get_y(points)}
    if shapely.has_z(points).any():
        axes["z"] = shapely.get_z(points)
    return axes, parse_crs(srid, where=where) if srid and srid > 0 else None


def _coordinates(chunk: Any, name: str, where: object) -> dict[str, NDArray[np.float64]]:
    """Return the coordinates of one contiguous array."""
    kind = chunk.type
    if pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
        return _wkb_coordinates(chunk, name, where)
    if pa.types.is_struct(kind) and {"x", "y"} <= {field.name for field in kind}:
        axes = [field.name for field in kind if field.name in ("x", "y", "z")]
        return {axis: np.asarray(chunk.field(axis), np.float64) for axis in axes}
    if pa.types.is_fixed_size_list(kind) and kind.list_size in (2, 3):
        flat = np.asarray(chunk.flatten(), np.float64).reshape(len(chunk), kind.list_size)
        return {axis: flat[:, number] for number, axis in enumerate("xyz"[: kind.list_size])}
    raise InputError(f"column {name!r} holds {kind}, not points", where=where, fix="name the columns of x and y")


def _wkb_coordinates(chunk: Any, name: str, where: object) -> dict[str, NDArray[np.float64]]:
    """Return the coordinates of an array of WKB points of one length and byte order."""
    offset_type = np.int64 if pa.types.is_large_binary(chunk.type) else np.int32
    _, offset_buffer, data = chunk.buffers()
    offsets = np.frombuffer(offset_buffer, offset_type)[chunk.offset : chunk.offset + len(chunk) + 1]
    lengths = np.diff(offsets)
    length = int(lengths[0])
    if length not in _POINT_CODES or (lengths != length).any():
        raise _not_points(name, where)
    for order in ("<", ">"):
        fields = [("order", "u1"), ("code", f"{order}u4"), *((axis, f"{order}f8") for axis in "xyz"[: length // 8])]
        records = np.frombuffer(data, np.dtype(fields), count=len(chunk), offset=int(offsets[0]))
        if (records["order"] == (order == "<")).all() and np.isin(records["code"], _POINT_CODES[length]).all():
            return {axis: records[axis].astype(np.float64) for axis in "xyz"[: length // 8]}
    raise _not_points(name, where)


def _not_points(name: str, where: object) -> InputError:
    return InputError(
        f"column {name!r} holds geometries that are not all points of one kind",
        where=where,
        fix="write one row per fix, with a point each (lines have no times)",
    )
