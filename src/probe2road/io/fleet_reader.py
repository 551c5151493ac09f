"""Reading fleet data: files or folders of any supported format in, one checked `Fleet` out."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import WGS84, same_crs
from probe2road.errors import CRSError, InputError
from probe2road.fleet.cleaning import BY_VEHICLE, ENTERS, accurate_fixes, plausible_headings, tidied
from probe2road.fleet.contract import Fleet, fleet_from_checked
from probe2road.fleet.faults import TableOrigin
from probe2road.fleet.tables import check_points, check_traces
from probe2road.fleet.trimming import trim_ends
from probe2road.io.atomic import settled
from probe2road.io.clocks import FIRST_YEAR, LAST_YEAR
from probe2road.io.compressed import require_bounded
from probe2road.io.delimited import read_text_table
from probe2road.io.fleet_writer import points_path
from probe2road.io.formats import BBox, ColumnMap, FleetFormat, adjusted
from probe2road.io.gpx import read_gpx
from probe2road.io.guard import raised_by_callbacks
from probe2road.io.layers import read_layer
from probe2road.io.nmea import read_nmea
from probe2road.io.parquet import inside, read_parquet
from probe2road.io.plt import read_plt
from probe2road.io.records import read_records
from probe2road.io.sources import RawTable, SourceFile, find_sources

__all__ = ["read_fleet", "read_fleet_files"]

logger = logging.getLogger(__name__)

Source = str | PathLike[str] | Sequence[str | PathLike[str]]

# What libraries raise at damaged files. Memory and interruptions are none of these.
_DAMAGE = (
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    RuntimeError,
    EOFError,
    OSError,
    pa.ArrowException,
)
# Format of `probe2road.io.sources.FORMATS` to its reader.
_TABLES = {"parquet": read_parquet, "text": read_text_table, "layer": read_layer, "records": read_records}
_RECORDINGS = {"gpx": read_gpx, "nmea": read_nmea, "plt": read_plt}  # of one layout, and of traces only
_ROW_NUMBERS = ("id",)  # columns that number traces in some files, and rows in others
_FEW_ROWS = 3  # of so few, ids that all differ say nothing
_FILES_SHOWN = 10  # files with faults named in one error


def read_fleet(
    traces: Source,
    points: Source | None = None,
    *,
    format: FleetFormat | None = None,
    columns: ColumnMap | None = None,
    point_columns: ColumnMap | None = None,
    crs: Any = None,
    target_crs: Any = None,
    bbox: BBox | None = None,
    delimiter: str | None = None,
    header: bool | None = None,
    time_format: str | None = None,
    interval: float | None = None,
    layer: str | None = None,
    invalid: str | None = None,
    max_accuracy: float | None = None,
    max_speed: float | None = None,
    max_uncompressed: float | None = None,
) -> Fleet:
    r"""Read traces, and semantic points where there are any, and check everything.

    Formats go by suffix: Parquet and GeoParquet (``.parquet``, ``.pq``, ``.geoparquet``), text tables
    (``.csv``, ``.tsv``, ``.txt``, ``.log``), GPX (``.gpx``), logs of NMEA sentences (``.nmea``, or text that begins
    with ``$G``), GeoLife's and OziExplorer's ``.plt``, JSON records (``.json``, ``.jsonl``), all text also with
    ``.gz``, and layers of points in GIS files (``.gpkg``, ``.geojson``, ``.fgb``, ``.shp``). A folder stands for all of
    them in it and below; files called ``points`` or ``NAME.points`` are left out of the traces, and GIS files and JSON
    where anything else is there.

    Traces are told apart by their ids across all files. A file without ids is one trace called like the
    file, and in GPX every track segment is a trace called ``file/track/segment``.

    Parameters
    ----------
    traces
        A file, a folder, or a sequence of them. Trace columns are those of `Fleet`; times are ISO 8601 text,
        timestamps, or numbers since 1970 in s, ms, us or ns (told by their size); without zone they are UTC.
    points
        Semantic points, likewise (tables and layers only). Kinds may have the names in
        `probe2road.io.columns.KIND_SYNONYMS`.
    format
        The parameters below in one object, for example out of a TOML file; a parameter that is given, too, takes the
        place of its field. None leaves what the format says, and what a `FleetFormat` says by default.
    columns, point_columns
        Our column name to the file's, for example ``{"trace_id": "trip"}``; ``geometry`` names a column of
        points. An empty name says that there is no such column. What is not named is found by its usual name
        (`probe2road.io.columns.USUAL_NAMES`), and logged.
    crs
        CRS of the coordinates in the files. Not needed where the file states it (GeoParquet, GPX) or the
        columns are called longitude and latitude.
    target_crs
        Metric CRS to work in; see `probe2road.fleet.contract.fleet_from_tables`.
    bbox
        ``(left, bottom, right, top)`` in the CRS of the files (degrees for longitude and latitude): only fixes
        and points inside are read. In Parquet, row groups outside are skipped.
    delimiter
        Of text tables; told from the first line where it is not given.
    header
        Whether text tables start with a line of names, as they do by default; without, the columns are called 0, 1, 2.
    time_format
        How times are written, for `datetime.datetime.strptime`, such as ``"%d.%m.%Y %H:%M:%S"``. Not needed for ISO
        8601, for numbers, and where only one usual way of writing times fits.
    interval
        Seconds between the positions of a line that has only the time of its start.
    layer
        Of the fixes, in a GIS file with several layers of points.
    invalid
        What happens to rows without position, id or readable time, to lines of text with another number of fields, and
        to fixes that repeat a time at another place: ``"drop"`` leaves them out with a warning, ``"refuse"`` refuses
        them. Where it is not given, they are left out if they are no more than 5 % of a file.
    max_accuracy
        Metres: fixes that say themselves that they are less accurate are left out.
    max_speed
        m/s: fixes that could not have been driven to and away from any slower are left out.
    max_uncompressed
        Gigabytes that a compressed file may hold, 4 by default; one that holds more is refused before it is read.

    Returns
    -------
    Fleet
        Sorted, deduplicated, in one metric CRS.

    Raises
    ------
    InputError
        Naming file, row and remedy, for everything that is wrong with the files: see
        `probe2road.fleet.contract.fleet_from_tables` for the faults of tables.
    CRSError
        If there is no CRS, if ``crs`` contradicts a file, or if the files have several.
    OptionError
        If ``bbox`` is no box, ``delimiter`` not one character, or a column name none of ours.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "drives.csv")
    ...     _ = path.write_text("trip,time,lon,lat\n7,2024-05-01T08:00:00Z,-87.65,41.87\n")
    ...     fleet = read_fleet(path)
    >>> fleet.crs.to_epsg(), fleet.traces["trace_id"].tolist()
    (32616, [7])
    """
    format = adjusted(
        format or FleetFormat(),
        columns=columns,
        point_columns=point_columns,
        crs=crs,
        target_crs=target_crs,
        bbox=bbox,
        delimiter=delimiter,
        header=header,
        time_format=time_format,
        interval=interval,
        layer=layer,
        invalid=invalid,
        max_accuracy=max_accuracy,
        max_speed=max_speed,
        max_uncompressed=max_uncompressed,
    )
    trace_table, trace_crs, told = _read_all(traces, format, points=False)
    point_table, point_crs = None, trace_crs
    if points is not None:
        point_table, point_crs, _ = _read_all(points, format, points=True)
    where = _name(traces)
    if trace_table is not None and format.max_accuracy is not None:
        trace_table = accurate_fixes(trace_table, format.max_accuracy, where=where)
    if trace_table is None:
        fix = f"bbox is (left, bottom, right, top) in the CRS of the data, {trace_crs.name}"
        raise InputError(f"no fixes inside bbox {format.bbox}", where=where, fix=fix)
    fleet = fleet_from_checked(
        trace_table,
        point_table,
        crs=trace_crs,
        points_crs=point_crs,
        target_crs=format.target_crs,
        outliers=format.outliers,
        invalid=format.invalid,
        where=where,
    )
    fleet = tidied(fleet, max_speed=format.max_speed)
    _warn_of_times(fleet.traces["t"])
    logger.info(
        "read %d fixes of %d traces and %d semantic points from %s (%s)",
        *(len(fleet.traces), fleet.n_traces, len(fleet.points), where, told),
    )
    return trim_ends(fleet, format.trim_ends)


def _warn_of_times(times: pd.Series) -> None:
    """Warn of a fleet at a time before satellites, or that nobody has lived to see."""
    middle = times.dropna().median() if times.notna().any() else None
    if middle is not None and not FIRST_YEAR <= middle.year <= LAST_YEAR:
        logger.warning(
            "half of the times are before %s: in the year %d are no such drives; numbers count as seconds since 1970 "
            "if nothing else is told by their size, check the column of times",
            *(middle.isoformat(), middle.year),
        )


def read_fleet_files(path: str | PathLike[str]) -> Fleet:
    """Read what `probe2road.io.fleet_writer.write_fleet` wrote: traces, and the points beside them if there are any.

    Raises
    ------
    InputError
        As `read_fleet`.

    Examples
    --------
    >>> import tempfile
    >>> from probe2road.demo import demo_fleet
    >>> from probe2road.io.fleet_writer import write_fleet
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     written = write_fleet(demo_fleet(n_drives=2), f"{folder}/drives.parquet")
    ...     fleet = read_fleet_files(f"{folder}/drives.parquet")
    >>> fleet.n_traces, len(fleet.points) > 0
    (2, True)
    """
    points = settled(points_path(path))
    return read_fleet(path, points if points.exists() else None)


def _read_all(source: Source, format: FleetFormat, *, points: bool) -> tuple[pd.DataFrame | None, CRS, str]:
    """Read and check all files of one kind of table; the table (None if empty), its CRS, what was guessed."""
    files, left_out = find_sources(source, semantic_points=points)
    if left_out:
        logger.warning("left out %d files of semantic points; pass them as points", len(left_out))
    tables: list[pd.DataFrame] = []
    crs_of: dict[str, CRS] = {}
    guesses: dict[str, None] = {}
    errors: list[InputError] = []
    for file in files:
        try:
            require_bounded(file.path, format.max_uncompressed)
            with raised_by_callbacks(file.path):
                raw = _read_one(file, format, points=points)
            crs = _crs_of(raw, file, format.stated_crs)
            table = _checked_table(raw, file, crs, format, points=points)
        except InputError as error:
            errors.append(error)
            continue
        except _DAMAGE as error:
            reason = (str(error).splitlines() or [""])[0]
            fault = f"the file cannot be read ({type(error).__name__}: {reason})"
            errors.append(InputError(fault, where=file.path, fix="it may be damaged; copy or write it again"))
            continue
        guesses |= dict.fromkeys(raw.guessed)
        crs_of.setdefault(str(file.path), crs)
        if len(table):
            tables.append(table)
    if errors:
        raise _joined(errors, len(files))
    crs = _one_crs(crs_of)
    told = f"found by name: {', '.join(guesses)}; CRS {crs.name}" if guesses else f"CRS {crs.name}"
    return _concatenated(tables) if tables else None, crs, told


def _read_one(file: SourceFile, format: FleetFormat, *, points: bool) -> RawTable:
    """Read one file by the reader of its format."""
    if file.format in _TABLES:
        return _TABLES[file.format](file, format, points=points)
    if points:
        what = f"{file.format.upper()} holds no semantic points"
        raise InputError(what, where=file.path, fix="use a text table, Parquet or a layer")
    return _RECORDINGS[file.format](file, invalid=format.invalid)


def _crs_of(raw: RawTable, file: SourceFile, given: CRS | None) -> CRS:
    """Return the CRS of a file's coordinates: its own, the user's, or WGS84 by the columns' names."""
    if raw.crs is not None and given is not None and not same_crs(raw.crs, given):
        fault = f"the file is in {raw.crs.name}, which contradicts the CRS given, {given.name}"
        raise CRSError(fault, where=file.path, fix="leave the CRS out, or correct the file")
    crs = raw.crs or given or (WGS84 if raw.degrees else None)
    if crs is None:
        example = "EPSG:4326" if _look_like_degrees(raw.table) else "EPSG:32616"
        raise CRSError("no CRS", where=file.path, fix=f'say which one it is, for example crs="{example}"')
    return crs


def _look_like_degrees(table: pd.DataFrame) -> bool:
    """Say whether most coordinates could be longitudes and latitudes, and are not drawn near an origin."""
    x, y = (pd.to_numeric(table[axis], errors="coerce").abs().median() for axis in "xy")
    return bool(0 < x <= 180 and 0 < y <= 90)


def _checked_table(raw: RawTable, file: SourceFile, crs: CRS, format: FleetFormat, *, points: bool) -> pd.DataFrame:
    """Check one file's table and cut it to the bounding box."""
    table = raw.table
    if format.bbox is not None and table.empty:
        return table
    by_vehicle = False
    if not points:
        table, by_vehicle = _with_trace_ids(table, raw.origin, file)
        if "t" not in table:
            logger.warning("%s: no column of times found: rows count as driven in their order", file.path)
    faults: list[str] = []
    check = check_points if points else check_traces
    table = check(table, crs, faults, origin=raw.origin, invalid=format.invalid)
    if faults:
        raise InputError.from_faults(faults, where=file.path)
    skipped = None if raw.skipped is None else raw.skipped[table.index.to_numpy()]
    if not points:
        table = plausible_headings(table.reset_index(drop=True), raw.origin, where=file.path)
        table = table.assign(**{BY_VEHICLE: True}) if by_vehicle else table
    if format.bbox is None:
        return table.reset_index(drop=True)
    keep = inside(table, format.bbox)
    if not points:
        table = table.assign(**{ENTERS: _enters(table, keep, skipped)})
    return table[keep].reset_index(drop=True)


def _enters(table: pd.DataFrame, keep: NDArray[np.bool_], skipped: NDArray[np.int64] | None) -> NDArray[np.bool_]:
    """Mark the fixes in the box whose trace was outside of it just before, in the order of time.

    Where part of the file between two fixes was not read, a pause longer than usual tells that fixes are missing.
    """
    codes = pd.factorize(table["trace_id"])[0]
    order = np.lexsort((table["t"].to_numpy("datetime64[ns]").view(np.int64), codes))
    enters = np.zeros(len(table), bool)
    before, after = order[:-1], order[1:]
    same = codes[after] == codes[before]
    enters[after] = same & keep[after] & ~keep[before]
    if skipped is not None and same.any():
        interval = np.diff(table["t"].to_numpy("datetime64[ns]")[order]) / np.timedelta64(1, "s")
        usual = np.nanmedian(interval[same]) if np.isfinite(interval[same]).any() else 0.0
        missing = (skipped[after] != skipped[before]) & ~(interval <= 1.5 * usual)
        enters[after] |= same & keep[after] & missing
    return enters


def _with_trace_ids(table: pd.DataFrame, origin: TableOrigin, file: SourceFile) -> tuple[pd.DataFrame, bool]:
    """Return the table with trace ids: its own, those of its vehicles (True), or one for the whole file."""
    if "trace_id" in table:
        theirs = origin.columns.get("trace_id", "")
        unique = len(table) >= _FEW_ROWS and table["trace_id"].nunique() == len(table)
        if not unique or "trace_id" not in origin.by_name:
            return table, False
        if theirs.lower() not in _ROW_NUMBERS:
            logger.warning("%s: column %r (trace_id) differs in every row: every trace is one fix", file.path, theirs)
            return table, False
        logger.warning("%s: column %r numbers the rows, it is no trace id; name one with columns", file.path, theirs)
        table = table.drop(columns="trace_id")
    if "vehicle_id" in table and table["vehicle_id"].notna().all():
        theirs = origin.columns.get("vehicle_id", "vehicle_id")
        logger.warning("%s: no column of trace ids found: traces are told apart by %r", file.path, theirs)
        return table.assign(trace_id=table["vehicle_id"]), True
    logger.warning("%s: no column of trace ids found: the file is one trace", file.path)
    return table.assign(trace_id=file.trace_name), False


def _joined(errors: Sequence[InputError], n_files: int) -> InputError:
    """Return one error for the faults of several files."""
    if len(errors) == 1:
        return errors[0]
    shown = "".join(f"\n  {error}" for error in errors[:_FILES_SHOWN])
    more = f"\n  and {len(errors) - _FILES_SHOWN} more" if len(errors) > _FILES_SHOWN else ""
    kind = CRSError if all(isinstance(error, CRSError) for error in errors) else InputError
    return kind(f"{len(errors)} of {n_files} files cannot be read{shown}{more}")


def _one_crs(crs_of: Mapping[str, CRS]) -> CRS:
    """Return the CRS that all files share."""
    (first, crs), *others = crs_of.items()
    for name, other in others:
        if not same_crs(crs, other):
            fault = f"mixed CRS: {first} is in {crs.name}, {name} in {other.name}"
            raise CRSError(fault, fix="reproject the files to one CRS, or read them one by one")
    return crs


def _concatenated(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Join checked tables; ids become text where some files have numbers and others words."""
    if len(tables) == 1:
        return tables[0]
    if len({table["trace_id"].dtype for table in tables}) > 1:
        tables = [table.assign(trace_id=table["trace_id"].astype(str)) for table in tables]
    return pd.concat(tables, ignore_index=True)


def _name(source: Source) -> str:
    """Name a source in a message."""
    if isinstance(source, str | PathLike):
        return str(source)
    return f"{source[0]} and {len(source) - 1} more" if len(source) > 1 else str(source[0])
