"""Writing of a table to a file, in the format of its suffix: CSV, Parquet, GeoParquet, GeoPackage, GeoJSON."""

from __future__ import annotations

import logging
from os import PathLike
from pathlib import Path

import geopandas as gpd
import pandas as pd
import pyogrio

from probe2road.crs import WGS84
from probe2road.errors import OptionError
from probe2road.io.atomic import atomic_path

__all__ = ["GEO_SUFFIXES", "TABLE_SUFFIXES", "require_table_suffix", "write_table"]

logger = logging.getLogger(__name__)

GEO_SUFFIXES = (".geoparquet", ".gpkg", ".geojson")
TABLE_SUFFIXES = (".csv", ".parquet", *GEO_SUFFIXES)
_TIME = "%Y-%m-%dT%H:%M:%S.%fZ"


def require_table_suffix(path: str | PathLike[str], suffixes: tuple[str, ...] = TABLE_SUFFIXES) -> str:
    """Return the suffix of a path in lower case, or refuse one that `write_table` cannot write.

    Raises
    ------
    OptionError
        If it is not.

    Examples
    --------
    >>> require_table_suffix("Matches.CSV")
    '.csv'
    >>> require_table_suffix("matches.xlsx")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: matches.xlsx: no table is written to .xlsx; use one of .csv, .parquet, ...
    """
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        what = f"no table is written to {suffix or 'a file without suffix'}"
        raise OptionError(what, where=path, fix=f"use one of {', '.join(suffixes)}")
    return suffix


def write_table(table: pd.DataFrame, path: str | PathLike[str], *, layer: str = "table") -> None:
    r"""Write a table to a file, complete or not at all; the suffix determines the format.

    Parameters
    ----------
    table
        The table. For a format with geometry a `GeoDataFrame` in any CRS: GeoJSON is in degrees, the others in its CRS.
        Geometry in ``.csv`` becomes WKT, and in ``.parquet`` WKB.
    path
        File with a suffix of `TABLE_SUFFIXES`.
    layer
        Name of the layer in a GeoPackage.

    Raises
    ------
    OptionError
        If the suffix is of another format, or the format needs a geometry and the table has none.
    OutputError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "matches.csv")
    >>> write_table(pd.DataFrame({"trace_id": [7], "edge": pd.array([None], "Int64")}), path)
    >>> path.read_text()
    'trace_id,edge\n7,\n'
    """
    suffix = require_table_suffix(path)
    if suffix in GEO_SUFFIXES and not isinstance(table, gpd.GeoDataFrame):
        raise OptionError("the table has no geometry", where=path, fix="use .csv or .parquet")
    with atomic_path(path) as temporary:
        if suffix == ".csv":
            (table.to_wkt() if isinstance(table, gpd.GeoDataFrame) else table).to_csv(
                temporary, index=False, date_format=_TIME, lineterminator="\n"
            )
        elif suffix in (".parquet", ".geoparquet"):
            table.to_parquet(temporary, index=False)
        else:
            plain = _plain(table)
            if suffix == ".geojson":
                pyogrio.write_dataframe(plain.to_crs(WGS84), temporary, driver="GeoJSON", RFC7946="YES")
            else:
                pyogrio.write_dataframe(plain, temporary, layer=layer, driver="GPKG")
    logger.info("wrote %d rows to %s", len(table), path)


def _plain(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the table with the column types of GDAL."""
    types = {}
    for name in table.columns.drop(table.geometry.name):
        if isinstance(table[name].dtype, pd.CategoricalDtype):
            types[name] = table[name].cat.categories.dtype
    return table.astype(types)
