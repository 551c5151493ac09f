"""Writing fleet data: GeoParquet that reads back as it was."""

from __future__ import annotations

import json
import logging
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from probe2road.errors import OutputError
from probe2road.fleet import Fleet
from probe2road.io.atomic import atomic_path
from probe2road.io.sources import FORMATS, POINTS_MARK

__all__ = ["points_path", "write_fleet"]

logger = logging.getLogger(__name__)

_ROW_GROUP = 262_144  # rows; small enough that a bounding box skips some, large enough to compress


def points_path(path: str | PathLike[str]) -> Path:
    """Return where the semantic points of a fleet go: beside its traces, marked in the name.

    Examples
    --------
    >>> points_path("drives.parquet").name
    'drives.points.parquet'
    """
    path = Path(path)
    return path.with_name(f"{path.stem}.{POINTS_MARK}{path.suffix}")


def write_fleet(fleet: Fleet, path: str | PathLike[str]) -> list[Path]:
    """Write traces, and semantic points where there are any, as GeoParquet 1.1.

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
        `points_path` of it. Each file is complete or absent.

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
    >>> from probe2road.fleet import fleet_from_tables
    >>> from probe2road.io.fleet_reader import read_fleet
    >>> fleet = fleet_from_tables(pd.DataFrame({"trace_id": [7], "x": [446e3], "y": [4636e3]}), crs="EPSG:32616")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     (file,) = write_fleet(fleet, Path(folder, "drives.parquet"))
    ...     read_fleet(file).traces.equals(fleet.traces)
    True
    """
    path = Path(path)
    if FORMATS.get(path.suffix.lower()) != "parquet":
        raise OutputError(f"the suffix {path.suffix!r} is not supported", where=path, fix="use .parquet")
    beside = points_path(path)
    _write_table(fleet.traces, fleet.crs.to_json_dict(), path)
    written = [path]
    if len(fleet.points):
        _write_table(fleet.points, fleet.crs.to_json_dict(), beside)
        written.append(beside)
    else:
        beside.unlink(missing_ok=True)
    logger.info("wrote %d fixes and %d semantic points to %s", len(fleet.traces), len(fleet.points), path)
    return written


def _write_table(table: pd.DataFrame, crs: dict[str, Any], path: Path) -> None:
    """Write one table with its positions as a column of native points."""
    axes = "xyz" if np.isfinite(table["z"].to_numpy()).any() else "xy"
    coordinates = [pa.array(table[axis].to_numpy(), pa.float64(), from_pandas=False) for axis in axes]
    geometry = pa.StructArray.from_arrays(coordinates, fields=[pa.field(axis, pa.float64(), False) for axis in axes])
    columns = pa.Table.from_pandas(table.drop(columns=list("xyz")), preserve_index=False)
    columns = columns.append_column(pa.field("geometry", geometry.type, False), geometry)
    x, y = table["x"].to_numpy(), table["y"].to_numpy()
    about: dict[str, Any] = {
        "encoding": "point",
        "geometry_types": ["Point Z" if axes == "xyz" else "Point"],
        "crs": crs,
    }
    if len(table):
        about["bbox"] = [float(x.min()), float(y.min()), float(x.max()), float(y.max())]
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": about}}
    columns = columns.replace_schema_metadata({**(columns.schema.metadata or {}), b"geo": json.dumps(geo).encode()})
    with atomic_path(path) as temporary:
        pq.write_table(columns, temporary, compression="zstd", row_group_size=_ROW_GROUP)
