"""Coordinates of point geometry columns, straight from their buffers.

Strategy: a column of WKB points has values of one length, 21 bytes in the plane or 29 with a height, laid
end to end in one buffer. Read as an array of packed records it gives all coordinates at once, without a
geometry object per fix. GeoArrow columns hold the coordinates as they are: a struct of x, y (and z), or a
fixed-size list of them.
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import parse_crs
from probe2road.errors import InputError

__all__ = ["PositionsInText", "point_coordinates", "text_coordinates"]

_POINT, _LINE = 0, 1  # type ids of shapely; -1 is a missing geometry
_FIXES_OF_LINES = "write one row per fix, with a point each (lines have no times)"

# Geometry type codes of a point: ISO WKB, and the high bit with which EWKB marks a height.
_POINT_CODES = {21: (1,), 29: (1001, 0x80000001)}


class PositionsInText(NamedTuple):
    """The positions in a column of text."""

    axes: dict[str, NDArray[np.float64]]  # x, y, and z where any position has a height
    crs: CRS | None  # that the text names
    rows: NDArray[np.int64] | None  # of the column, of which every position is; None: each row has one
    in_json: bool = False  # which has longitude and latitude by convention


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
    column: pa.ChunkedArray, *, name: str, lines: bool = False, where: object = None
) -> PositionsInText:
    """Return the coordinates of a column of text: WKT, WKB in hexadecimal digits, GeoJSON, or JSON arrays of positions.

    Parameters
    ----------
    column
        Text; missing and unreadable values become NaN.
    name, where
        Column and file, for messages.
    lines
        Whether lines are read, too, of which a row has any number of positions.

    Returns
    -------
    PositionsInText
        Positions in float64 arrays: as many as rows, or as the lines have; and the CRS that a prefix ``SRID=4326;`` or
        extended WKB names.

    Raises
    ------
    InputError
        If the column holds areas, lines where there are to be points, or nothing that can be read.

    Examples
    --------
    >>> places = text_coordinates(pa.chunked_array([["SRID=4326;POINT (13.5 52.5)", None]]), name="geom")
    >>> places.axes["x"].tolist(), places.crs.to_epsg()
    ([13.5, nan], 4326)
    >>> places = text_coordinates(pa.chunked_array([["[[-8.6,41.1],[-8.7,41.2]]", "[]"]]), name="POLYLINE", lines=True)
    >>> places.axes["x"].tolist(), places.rows.tolist()
    ([-8.6, -8.7], [0, 0])
    """
    words = [word.strip() if isinstance(word, str) else None for word in column.to_pylist()]
    first = next((word for word in words if word), "")
    if first[:1] == "[":
        return _positions_in_json(words, name, where, lines=lines)
    srid = None
    if first[:1] == "{":
        shapes = shapely.from_geojson(np.array(words, object), on_invalid="ignore")
    elif re.fullmatch(r"0[01][0-9A-Fa-f]{8,}", first):
        shapes = shapely.from_wkb(np.array(words, object), on_invalid="ignore")
        srid = int(shapely.get_srid(next((shape for shape in shapes if shape is not None), None)))
    else:
        if found := re.match(r"SRID=(\d+);", first, re.IGNORECASE):
            srid = int(found[1])
            words = [None if word is None else word.rpartition(";")[2] for word in words]
        shapes = shapely.from_wkt(np.array(words, object), on_invalid="ignore")
    crs = parse_crs(srid, where=where) if srid and srid > 0 else None
    kinds = shapely.get_type_id(shapes)
    if len(shapes) and (kinds == -1).all():
        fault = f"column {name!r} holds no points that can be read ({first[:60]})"
        raise InputError(fault, where=where, fix="write POINT (x y), or name the columns of x and y")
    if lines and np.isin(kinds, (_LINE, -1)).all():
        positions, rows = shapely.get_coordinates(
            shapes, include_z=bool(shapely.has_z(shapes).any()), return_index=True
        )
        return PositionsInText(dict(zip("xyz", positions.T, strict=False)), crs, rows, first[:1] == "{")
    if not np.isin(kinds, (_POINT, -1)).all():
        raise _not_points(name, where)
    axes = {"x": shapely.get_x(shapes), "y": shapely.get_y(shapes)}
    if shapely.has_z(shapes).any():
        axes["z"] = shapely.get_z(shapes)
    return PositionsInText(axes, crs, None, first[:1] == "{")


def _positions_in_json(words: list[str | None], name: str, where: object, *, lines: bool) -> PositionsInText:
    """Read ``[lon, lat]`` or ``[[lon, lat], ...]``, all rows at once.

    Strategy: brackets say how many positions a row has, and are then taken out; what is left is one list of numbers.
    """
    column = pa.array(words, pa.string())
    opened = pc.fill_null(pc.count_substring(column, "["), 0).to_numpy(zero_copy_only=False)
    bare = pc.replace_substring_regex(pc.fill_null(column, ""), r"[\[\]\s]", "")
    is_line = opened.max(initial=0) > 1 or (opened[pc.not_equal(bare, "").to_numpy(zero_copy_only=False)] > 1).any()
    if is_line and not lines:
        raise _not_points(name, where)
    counts = np.maximum(opened - 1, 0) if is_line else opened
    cells = pc.split_pattern(bare, ",")
    lengths = np.where(counts > 0, pc.list_value_length(cells).to_numpy(zero_copy_only=False), 0)
    width = next((int(length // count) for length, count in zip(lengths, counts, strict=True) if count), 2)
    if width not in (2, 3) or (lengths != width * counts).any():
        bad = next(iter(np.flatnonzero(lengths != width * counts)), 0)
        raise _no_positions(name, f"row {bad}: {str(words[bad])[:60]}", where)
    try:
        flat = pc.cast(pc.filter(cells, pa.array(counts > 0)).flatten(), pa.float64()).to_numpy().reshape(-1, width)
    except pa.ArrowInvalid as error:
        raise _no_positions(name, str(error), where) from error
    if is_line or not counts.all():
        rows = np.repeat(np.arange(len(words)), counts)
        if is_line:
            return PositionsInText(dict(zip("xyz", flat.T, strict=False)), None, rows, in_json=True)
        whole = np.full((len(words), width), np.nan)
        whole[rows] = flat
        flat = whole
    return PositionsInText(dict(zip("xyz", flat.T, strict=False)), None, None, in_json=True)


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


def _no_positions(name: str, reason: str, where: object) -> InputError:
    return InputError(
        f"column {name!r} holds no positions [x, y] or [x, y, z] that can be read ({reason})",
        where=where,
        fix="write JSON such as [[13.4, 52.5], [13.5, 52.6]]",
    )


def _not_points(name: str, where: object) -> InputError:
    return InputError(
        f"column {name!r} holds geometries that are not all points of one kind",
        where=where,
        fix=_FIXES_OF_LINES,
    )
