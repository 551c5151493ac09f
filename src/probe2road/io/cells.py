"""From the columns of a file to ours: every cell in our unit, every row one fix.

What is measured decides how a column is read: places by `probe2road.io.wkb`, degrees by `probe2road.io.angles`, times
by `probe2road.io.clocks`, the rest by the units of `probe2road.io.units`. Whatever they parse, readers share this.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin
from probe2road.io.angles import degrees_of_column, hidden_unit
from probe2road.io.clocks import times_of_column
from probe2road.io.columns import ColumnChoice, standard_kinds
from probe2road.io.formats import FleetFormat
from probe2road.io.sources import RawTable
from probe2road.io.units import UNITS, in_our_unit, normal
from probe2road.io.wkb import PositionsInText, point_coordinates, text_coordinates

__all__ = ["raw_table"]

logger = logging.getLogger(__name__)

_PORTO_COLUMN, _PORTO_INTERVAL = "polyline", 15.0  # s; of the taxis of Porto, whose file does not say it


class _Lines(NamedTuple):
    """What became of a column of lines: which row of the file every fix is from, and its number in the line."""

    rows: NDArray[np.int64]
    number: NDArray[np.int64]
    counts: NDArray[np.int64]  # fixes of every row


def raw_table(
    content: pa.Table,
    choice: ColumnChoice,
    format: FleetFormat,
    origin: TableOrigin,
    *,
    identifiers: Callable[[pa.ChunkedArray], pd.Series] | None = None,
    crs: CRS | None = None,
    skipped: NDArray[np.int64] | None = None,
    where: object = None,
) -> RawTable:
    """Return a file's table in our columns and units, unchecked.

    Parameters
    ----------
    content
        At least the columns of the choice.
    choice
        Which column is which.
    format
        What the user says of times, and of the CRS.
    origin
        Names for messages; columns are filled in here.
    identifiers
        How ids are read; as they are where it is None.
    crs
        That the file states.
    skipped
        See `RawTable`.
    where
        The file, for messages.

    Raises
    ------
    InputError
        If places are none, times are days of spreadsheets or of an unknown format, or lines have no times.
    """
    table: dict[str, Any] = {}
    lines: _Lines | None = None
    degrees = choice.degrees
    if "geometry" in choice.columns:
        theirs = choice.columns["geometry"]
        timed = "t" in choice.columns or not format.columns.get("t", True)  # or the user does without
        has_lines = origin.name == "traces" and timed
        places, lines = _places(content.column(theirs), theirs, lines=has_lines, where=where)
        table |= places.axes
        crs = crs or places.crs
        degrees = places.in_json and _in_range(places.axes)
    told: list[str] = []
    for name, theirs in choice.columns.items():
        if name == "geometry":
            continue
        if name.endswith("_id") and identifiers is not None:
            values = identifiers(content.column(theirs))
        else:
            values = _plain_series(content.column(theirs), is_id=name.endswith("_id"))
        if name == "t":
            dates = _plain_series(content.column(choice.beside["t"])) if "t" in choice.beside else None
            values, notation = _times(values, theirs, dates, choice, format, lines, where)
            told += [f"t {'as' if '%' in notation else 'in'} {notation}"] if notation else []
        elif lines is not None:
            values = values.take(lines.rows).reset_index(drop=True)
        if name in UNITS and name not in ("t", "x", "y"):
            values, unit = in_our_unit(values, name, theirs, choice.units.get(name), where=where)
            told += [f"{name} in {unit}"] if unit else []
        table[name] = standard_kinds(values) if name == "kind" else values
    if "x" in choice.columns and (
        choice.degrees or (format.stated_crs is not None and format.stated_crs.is_geographic)
    ):
        told += _to_degrees(table, content, choice)
    guessed = (*(f"{name}={choice.columns[name]}" for name in choice.guessed), *told)
    names = {name: choice.columns.get(name, choice.columns.get("geometry", name)) for name in table}
    row_word, first_row = (origin.row_word, origin.first_row) if lines is None else ("position", 0)
    origin = TableOrigin(origin.name, row_word, first_row, names, choice.by_name)
    return RawTable(pd.DataFrame(table, copy=False), crs, degrees, origin, guessed, skipped)


def _places(column: pa.ChunkedArray, name: str, *, lines: bool, where: object) -> tuple[PositionsInText, _Lines | None]:
    """Unpack a column of points, or of lines in text."""
    if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        return PositionsInText(point_coordinates(column, name=name, where=where), None, None), None
    places = text_coordinates(column, name=name, lines=lines, where=where)
    if places.rows is None:
        return places, None
    counts = np.bincount(places.rows, minlength=len(column))
    number = np.arange(len(places.rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return places, _Lines(places.rows, number, counts)


def _in_range(axes: Mapping[str, NDArray[np.float64]]) -> bool:
    """Say whether all positions could be longitudes and latitudes."""
    return all(bool(np.nanmax(np.abs(axes[axis]), initial=0.0) <= limit) for axis, limit in (("x", 180.0), ("y", 90.0)))


def _plain_series(column: pa.ChunkedArray, *, is_id: bool = False) -> pd.Series:
    """Return a column for pandas; decimal numbers as float64."""
    if pa.types.is_decimal(column.type) and not is_id:
        column = column.cast(pa.float64())
    return column.to_pandas().reset_index(drop=True)


def _times(
    values: pd.Series,
    name: str,
    dates: pd.Series | None,
    choice: ColumnChoice,
    format: FleetFormat,
    lines: _Lines | None,
    where: object,
) -> tuple[pd.Series, str]:
    """Read the times of fixes; those of lines from a list in each row, or from a start and the interval."""

    def read(values: pd.Series, dates: pd.Series | None = None) -> tuple[pd.Series, str]:
        unit = choice.units.get("t")
        return times_of_column(values, name, unit=unit, dates=dates, time_format=format.time_format, where=where)

    if lines is None:
        return read(values, dates)
    if (listed := _listed_times(values, name, lines, where)) is not None:
        return read(listed)
    interval = format.interval
    if interval is None and normal(choice.columns["geometry"]) == _PORTO_COLUMN:
        interval = _PORTO_INTERVAL
        logger.warning(
            "%s: positions of a %s count as %g s apart, as those of Porto's taxis; if not, say the interval",
            *(where, choice.columns["geometry"], interval),
        )
    if interval is None:
        fault = f"column {name!r} (t) has one time for each line"
        fix = 'say how many seconds lie between positions, for example interval=15, or do without: columns={"t": ""}'
        raise InputError(fault, where=where, fix=fix)
    starts, notation = read(values, dates)
    starts = pd.to_datetime(starts, utc=True, errors="coerce", format="ISO8601")
    later = pd.Series(pd.to_timedelta(lines.number * interval, unit="s"))
    return starts.take(lines.rows).reset_index(drop=True) + later, notation


def _listed_times(values: pd.Series, name: str, lines: _Lines, where: object) -> pd.Series | None:
    """Take lists of times apart, such as ``[0, 5, 9]`` or ``0,5,9``; None where the column holds none."""
    words = values.dropna().astype(str)
    if not words.str.contains(r"^\s*[\[({]|[,;]").any():
        return None
    cells = words.str.strip(" \t[](){}").str.replace(r"[\"']", "", regex=True).str.split(r"\s*[,;]\s*", regex=True)
    lengths = np.zeros(len(values), np.int64)
    lengths[cells.index] = cells.str.len()
    bad = np.flatnonzero((lengths != lines.counts) & (lines.counts > 0))
    if len(bad):
        fault = (
            f"column {name!r} (t) does not have a time for each position in {len(bad)} of {len(values)} lines "
            f"(row {bad[0]}: {lengths[bad[0]]} times, {lines.counts[bad[0]]} positions)"
        )
        raise InputError(fault, where=where, fix='correct them, or do without: columns={"t": ""}')
    return cells[lines.counts[cells.index] > 0].explode(ignore_index=True)


def _to_degrees(table: dict[str, Any], content: pa.Table, choice: ColumnChoice) -> list[str]:
    """Bring longitudes and latitudes to degrees, in place; say how they were written."""
    hidden = hidden_unit(table["x"], table["y"])
    told = []
    for axis in "xy":
        hemispheres = _plain_series(content.column(choice.beside[axis])) if axis in choice.beside else None
        unit = choice.units.get(axis, hidden)
        table[axis], notation = degrees_of_column(table[axis], axis, unit, hemispheres)
        told += [f"{axis} in {notation}"] if notation else []
    return told
