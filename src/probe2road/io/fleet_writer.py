"""Writing fleet data as GeoParquet, from which the same data are read back."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from probe2road.errors import OutputError
from probe2road.fleet.contract import Fleet
from probe2road.io.atomic import atomic_paths
from probe2road.io.sources import FORMATS, POINTS_MARK

__all__ = ["ROW_GROUP", "bounding_box", "point_table", "points_path", "require_fleet_suffix", "with_geo", "write_fleet"]

logger = logging.getLogger(__name__)

ROW_GROUP = 262_144  # rows; small enough that a bounding box skips some, large enough to compress


def points_path(path: str | PathLike[str]) -> Path:
    """Return the path for the semantic points of a fleet: beside its traces, marked in the name.

    Examples
    --------
    >>> points_path("drives.parquet").name
    'drives.points.parquet'
    """
    path = Path(path)
    return path.with_name(f"{path.stem}.{POINTS_MARK}{path.suffix}")


def require_fleet_suffix(path: str | PathLike[str]) -> None:
    """Refuse a file name with a suffix that `write_fleet` cannot write.

    Raises
    ------
    OutputError
        If the suffix is another than those of Parquet.
    """
    suffix = Path(path).suffix
    if FORMATS.get(suffix.lower()) != "parquet":
        raise OutputError(f"the suffix {suffix!r} is not supported", where=path, fix="use .parquet")


def write_fleet(fleet: Fleet, path: str | PathLike[str]) -> list[Path]:
    """Write the traces, and the semantic points if there are any, as GeoParquet 1.1.

    Positions are a geometry column of native points (a struct of ``x``, ``y`` and, where any is known, ``z``)
    in the fleet's CRS: readers skip row groups by its statistics, and nothing is rounded. Reading the files
    with `probe2road.read_fleet` gives the same fleet (with ``target_crs`` where the fleet's CRS is one that
    is not true to scale).

    Parameters
    ----------
    fleet
        The fleet.
    path
        File for the traces, with suffix ``.parquet``, ``.pq`` or ``.geoparquet``; the points go to
        `points_path` of it. Both become those of this fleet together, or not at all.

    Returns
    -------
    list of Path
        The files written. An older file of points is removed where the fleet has none.

    Raises
    ------
    OutputError
        If the suffix is another or the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.io.fleet_reader import read_fleet
    >>> fleet = fleet_from_tables(pd.DataFrame({"trace_id": [7], "x": [446e3], "y": [4636e3]}), crs="EPSG:32616")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     (file,) = write_fleet(fleet, Path(folder, "drives.parquet"))
    ...     read_fleet(file).traces.equals(fleet.traces)
    True
    """
    path = Path(path)
    require_fleet_suffix(path)
    beside = points_path(path)
    written = [path, beside] if len(fleet.points) else [path]
    with atomic_paths([path, beside]) as places:
        for table, place in zip((fleet.traces, fleet.points), places[: len(written)], strict=False):
            _write_table(table, fleet.crs.to_json_dict(), place)
    logger.info("wrote %d fixes and %d semantic points to %s", len(fleet.traces), len(fleet.points), path)
    return written


def point_table(table: pd.DataFrame, axes: str = "xyz") -> pa.Table:
    """Convert a table to Arrow, with its positions as one column of native points, as GeoParquet requires."""
    coordinates = [pa.array(table[axis].to_numpy(np.float64), pa.float64(), from_pandas=False) for axis in axes]
    geometry = pa.StructArray.from_arrays(coordinates, fields=[pa.field(axis, pa.float64(), False) for axis in axes])
    columns = pa.Table.from_pandas(table.drop(columns=list("xyz")), preserve_index=False)
    return columns.append_column(pa.field("geometry", geometry.type, False), geometry)


def with_geo(schema: pa.Schema, crs: Mapping[str, Any], bbox: Sequence[float] | None) -> pa.Schema:
    """Return the schema of a `point_table` with the metadata of GeoParquet 1.1."""
    heights = schema.field("geometry").type.num_fields == 3
    about: dict[str, Any] = {
        "encoding": "point",
        "geometry_types": ["Point Z" if heights else "Point"],
        "crs": crs,
    }
    if bbox is not None:
        about["bbox"] = list(bbox)
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": about}}
    return schema.with_metadata({**(schema.metadata or {}), b"geo": json.dumps(geo).encode()})


def bounding_box(table: pd.DataFrame) -> list[float] | None:
    """Return ``[left, bottom, right, top]`` of a table's positions, None for a table without rows."""
    return None if table.empty else [float(value) for value in (*table[["x", "y"]].min(), *table[["x", "y"]].max())]


def _write_table(table: pd.DataFrame, crs: Mapping[str, Any], path: Path) -> None:
    """Write one table with its positions as a column of native points."""
    columns = point_table(table, "xyz" if np.isfinite(table["z"].to_numpy()).any() else "xy")
    columns = columns.replace_schema_metadata(with_geo(columns.schema, crs, bounding_box(table)).metadata)
    pq.write_table(columns, path, compression="zstd", row_group_size=ROW_GROUP)
