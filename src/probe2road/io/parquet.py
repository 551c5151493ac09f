"""Fleet data from Parquet and GeoParquet: only the columns and row groups that are needed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import parse_crs
from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin
from probe2road.io.cells import raw_table
from probe2road.io.columns import ColumnChoice, choose_columns
from probe2road.io.formats import BBox, FleetFormat
from probe2road.io.guard import parsing
from probe2road.io.sources import RawTable, SourceFile

__all__ = ["inside", "read_parquet"]

_DEFAULT_CRS = "OGC:CRS84"  # GeoParquet 1.1: what a geometry column without a "crs" is in


def read_parquet(source: SourceFile, format: FleetFormat | None = None, *, points: bool = False) -> RawTable:
    """Read one Parquet or GeoParquet file.

    A geometry column of points (WKB, or GeoArrow as GeoParquet 1.1 allows it) is preferred to coordinate
    columns that the user did not name, and brings its CRS. Folder names of the form ``key=value`` count as
    columns. The bounding box skips row groups where the file has statistics of coordinate columns or of a covering.

    Parameters
    ----------
    source
        The file.
    format
        What the user says of the columns, the CRS and the bounding box; nothing where it is None.
    points
        Whether the file holds semantic points rather than traces.

    Returns
    -------
    RawTable
        May have no rows.

    Raises
    ------
    InputError
        If the file is no complete Parquet file, or its columns cannot be told.
    """
    format = format or FleetFormat()
    bbox = format.bbox
    try:
        dataset = ds.dataset(str(source.path), format="parquet", partitioning="hive")
        geo = _geo_metadata(dataset.schema, source)
        geometry = geo["primary_column"] if geo else None
        choice = choose_columns(
            dataset.schema.names,
            format.columns_of(points=points),
            points=points,
            geometry=geometry,
            crs=format.stated_crs,
            where=source.path,
        )
        about = geo["columns"].get(choice.columns.get("geometry"), {}) if geo else {}
        condition = None if bbox is None else _row_filter(choice, about, dataset.schema, bbox)
        content, skipped = _read_groups(dataset, choice.wanted, condition)
    except (pa.ArrowException, UnicodeDecodeError, OSError) as error:
        reason = (str(error).splitlines() or [""])[0]
        fix = "it may be truncated; copy or write it again"
        raise InputError(f"not a readable Parquet file ({reason})", where=source.path, fix=fix) from error
    file_crs = _crs_of(about, source) if "geometry" in choice.columns and geo else None
    origin = TableOrigin("points" if points else "traces")
    with parsing(source.path, "a column cannot be read", fix="write the file again, or name other columns"):
        return raw_table(content, choice, format, origin, crs=file_crs, skipped=skipped, where=source.path)


def _read_groups(
    dataset: Any, wanted: list[str], condition: ds.Expression | None
) -> tuple[pa.Table, NDArray[np.int64] | None]:
    """Read the row groups that may hold rows of the box, whole; and the number of groups skipped before every row.

    Rows outside are needed: a trace that leaves the box and comes back is two.
    """
    if condition is None:
        return dataset.to_table(columns=wanted), None
    tables, skipped, n_skipped, n_groups = [], [], 0, 0
    for fragment in dataset.get_fragments():
        kept = [group.id for group in fragment.subset(condition).row_groups]
        for number in kept:
            n_skipped += number - n_groups
            n_groups = number + 1
            part = fragment.subset(row_group_ids=[number]).to_table(schema=dataset.schema, columns=wanted)
            tables.append(part)
            skipped.append(np.full(part.num_rows, n_skipped, np.int64))
    if not tables:
        return dataset.schema.empty_table().select(wanted), np.zeros(0, np.int64)
    return pa.concat_tables(tables), np.concatenate(skipped)


def inside(table: pd.DataFrame, bbox: BBox) -> NDArray[np.bool_]:
    """Mark the rows whose ``x`` and ``y`` lie in the box, its border included; all where they are no numbers."""
    if not all(pd.api.types.is_numeric_dtype(table[axis].dtype) for axis in "xy"):
        return np.ones(len(table), bool)
    left, bottom, right, top = bbox
    x, y = (table[axis].to_numpy(np.float64, na_value=np.nan) for axis in "xy")
    return np.asarray((x >= left) & (x <= right) & (y >= bottom) & (y <= top), bool)


def _geo_metadata(schema: pa.Schema, source: SourceFile) -> dict[str, Any] | None:
    """Return the GeoParquet metadata of a file, None where it has none."""
    raw = (schema.metadata or {}).get(b"geo")
    if raw is None:
        return None
    try:
        geo = json.loads(raw)
        return {"primary_column": geo["primary_column"], "columns": dict(geo["columns"])}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError("the GeoParquet metadata is broken", where=source.path, fix="write the file again") from error


def _crs_of(about: Mapping[str, Any], source: SourceFile) -> CRS | None:
    """Return the CRS of a geometry column: absent means longitude and latitude, null means unknown."""
    value = about.get("crs", _DEFAULT_CRS)
    return None if value is None else parse_crs(value, where=source.path)


def _row_filter(choice: ColumnChoice, about: Mapping[str, Any], schema: pa.Schema, bbox: BBox) -> ds.Expression | None:
    """Return the condition that Parquet statistics can prove false for a row group, None where there is none."""
    left, bottom, right, top = bbox
    geometry = choice.columns.get("geometry")
    covering = about.get("covering", {}).get("bbox")
    if geometry is None:
        if not _holds_plain_degrees(choice, schema):
            return None
        x_min = x_max = ds.field(choice.columns["x"])
        y_min = y_max = ds.field(choice.columns["y"])
    elif pa.types.is_struct(schema.field(geometry).type):
        x_min = x_max = ds.field(geometry, "x")
        y_min = y_max = ds.field(geometry, "y")
    elif covering:
        x_min, x_max, y_min, y_max = (ds.field(*covering[side]) for side in ("xmin", "xmax", "ymin", "ymax"))
    else:
        return None
    return (x_max >= left) & (x_min <= right) & (y_max >= bottom) & (y_min <= top)


def _holds_plain_degrees(choice: ColumnChoice, schema: pa.Schema) -> bool:
    """Say whether coordinates are in the file as they are in the box, not as integers, in radians or without sign."""
    as_they_are = all(pa.types.is_floating(schema.field(choice.columns[axis]).type) for axis in "xy")
    return (as_they_are or not choice.degrees) and not {"x", "y"} & {*choice.units, *choice.beside}
