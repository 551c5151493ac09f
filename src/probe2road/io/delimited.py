"""Fleet data from text tables: CSV, TSV and the like, with or without header, gzip or not."""

from __future__ import annotations

import csv
import json
import logging
import re
import zlib
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv

from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin, may_leave_out
from probe2road.io.cells import raw_table
from probe2road.io.columns import ColumnChoice, choose_columns
from probe2road.io.compressed import unpacked
from probe2road.io.formats import FleetFormat
from probe2road.io.guard import parsing
from probe2road.io.sources import RawTable, SourceFile

__all__ = ["read_text_table"]

logger = logging.getLogger(__name__)

_DELIMITERS = (",", ";", "\t", "|", " ")  # the earlier one where two are as frequent
_HEAD = 65536  # bytes looked at for the header
_WORDS = pa.dictionary(pa.int32(), pa.string())  # few different values in many rows
_PLAIN_INTEGER = re.compile(r"0|-?[1-9]\d{0,17}")
_DECIMAL_COMMA = re.compile(r"(?<![\w.,])[+-]?\d+,\d+(?![\w.,])")
_EXAMPLES_SHOWN = 3
_COMMENTS = ("#", "//", "%")  # that lines above the table start with
_LINES_PARSED = 20  # to find the delimiter
_LEAST_TABLE = 3  # lines that make a table below a title
_DATE = re.compile(r"\d{4}[-/.]?\d{2}[-/.]?\d{2}([T ]|$)|\d{1,2}[/.]\d{1,2}[/.]\d{4}")
_EPOCH = re.compile(r"1\d{9}(?:\d{3})?(?:\.\d+)?")  # s or ms since 1970, of this century
_NO_ID = (None, "", "NULL", "\\N")
_NULLS = [*("", "NULL", "null", "Null", "NaN", "nan", "NA", "N/A", "n/a", "#N/A", "None", "\\N", "-", "NaT")]


class _Head(NamedTuple):
    """The top of a text file."""

    lines: list[str]  # the first lines that are neither blank nor comments above the table
    places: list[int]  # how many lines of the file are above each
    delimiter: str | None  # that the file states itself, as spreadsheets do in a line sep=;
    is_all: bool  # nothing follows the first line


def read_text_table(source: SourceFile, format: FleetFormat | None = None, *, points: bool = False) -> RawTable:
    """Read one text table in UTF-8.

    Trace ids stay text unless every one is a plain integer: ``007`` and ``7`` are two traces.

    Parameters
    ----------
    source
        The file.
    format
        What the user says of the columns, the CRS, the delimiter and the header; nothing where it is None.
    points
        Whether the file holds semantic points rather than traces.

    Returns
    -------
    RawTable
        May have no rows.

    Raises
    ------
    InputError
        If the file is binary, not UTF-8 or a broken gzip, if rows differ in length, or if its columns cannot
        be told.
    """
    format = format or FleetFormat()
    head = _read_head(source)
    delimiter = format.delimiter or head.delimiter or _delimiter(head.lines)
    head = _without_title(head, delimiter, source)
    names = _column_names(head, delimiter, source, header=format.header)
    if format.header and not format.columns_of(points=points):
        _refuse_data_as_names(names, head, source, points=points)
    choice = choose_columns(
        names, format.columns_of(points=points), points=points, crs=format.stated_crs, where=source.path
    )
    skip = head.places[0] + format.header
    has_commas = delimiter != "," and any(_DECIMAL_COMMA.search(line) for line in head.lines[format.header :])
    content = _parse(source, names, choice, delimiter, skip, format, has_commas=has_commas)
    origin = TableOrigin("points" if points else "traces", "line", skip + 1)
    with parsing(source.path, "a column cannot be read", fix="write the file again, or name other columns"):
        return raw_table(content, choice, format, origin, identifiers=_identifiers, where=source.path)


def _read_head(source: SourceFile) -> _Head:
    """Read the top of a text file."""
    try:
        with unpacked(source.path) as file:
            head = file.read(_HEAD)
    except (OSError, EOFError, zlib.error) as error:
        raise _broken(source, error) from error
    if not head.strip():
        raise InputError("the file holds no text", where=source.path, fix="write it again")
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError("the text is UTF-16", where=source.path, fix="save it as UTF-8")
    if b"\0" in head:
        raise InputError("the file is binary, not text", where=source.path, fix="check its suffix")
    stated, n_above, lines = None, 0, head.splitlines()
    for line in lines:
        text = line.decode("utf-8-sig", errors="replace").strip()
        if found := re.fullmatch(r'"?sep=(.)"?', text, re.IGNORECASE):
            stated = found[1]
        elif text and not text.startswith(_COMMENTS):
            break
        n_above += 1
    places = [place for place in range(n_above, min(len(lines), n_above + _LINES_PARSED)) if lines[place].strip()]
    below = [lines[place] for place in places]
    if not below:
        raise InputError("the file holds no rows", where=source.path, fix="write it again")
    try:
        below[0].decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"the first line is not UTF-8 ({error})", where=source.path, fix="save it as UTF-8") from error
    texts = [line.decode("utf-8-sig", errors="replace") for line in below]
    return _Head(texts, places, stated, len(texts) == 1 and len(head) < _HEAD)


def _delimiter(lines: list[str]) -> str:
    """Return the delimiter that gives most lines in a row the same number of fields, two or more."""
    return max(_DELIMITERS, key=lambda delimiter: _table_in(_widths(lines, delimiter)))


def _widths(lines: list[str], delimiter: str) -> list[int]:
    """Return the number of fields of every line."""
    return [len(cells) for cells in csv.reader(lines, delimiter=delimiter, skipinitialspace=True)]


def _table_in(widths: list[int]) -> tuple[int, int]:
    """Return the length and the width of the longest run of lines with the same number of fields, two or more."""
    runs = ((len(list(run)), width) for width, run in groupby(widths))
    return max(((length, width) for length, width in runs if width > 1), default=(0, 1))


def _without_title(head: _Head, delimiter: str, source: SourceFile) -> _Head:
    """Pass over what reports write above a table: lines with at most half of the fields of the lines that follow."""
    widths = _widths(head.lines, delimiter)
    length, usual = _table_in(widths)
    first = next((number for number, width in enumerate(widths) if 2 * width > usual), 0)
    if first == 0 or len(widths) != len(head.lines) or length < _LEAST_TABLE:
        return head
    logger.info("%s: passed over %d lines above the table", source.path, first)
    return head._replace(lines=head.lines[first:], places=head.places[first:])


def _refuse_data_as_names(names: list[str], head: _Head, source: SourceFile, *, points: bool) -> None:
    """Refuse a first line that holds values rather than names, and say how to read the file."""
    numbers = [number for number, cell in enumerate(names) if _is_number(cell)]
    times = [number for number, cell in enumerate(names) if _DATE.match(cell)]
    if len(numbers) + len(times) < max(2, 0.5 * len(names)):
        return
    fractions = [number for number in numbers if "." in names[number]]
    times += [number for number in numbers if _EPOCH.fullmatch(names[number])]
    columns: dict[str, str] = {}
    example = ""
    if len(fractions) >= 2:
        x, y = fractions[:2]
        first, second = float(names[x]), float(names[y])
        if abs(first) <= 90 < abs(second):
            x, y = y, x
        before = [number for number in range(min(x, y)) if number not in times]
        ids = [("vehicle_id", before[:1]), ("trace_id", before[1:2])] if len(before) > 1 else [("trace_id", before)]
        found = [*ids, ("t", times[:1]), ("x", [x]), ("y", [y])]
        columns = {name: str(number) for name, place in found for number in place}
        degrees = max(abs(first), abs(second)) <= 180
        example = f', for example columns={json.dumps(columns)} crs="{"EPSG:4326" if degrees else "EPSG:32616"}"'
        example = example.replace("columns", "point_columns") if points else example
    shown = head.lines[0] if len(head.lines[0]) <= 60 else f"{head.lines[0][:60]}..."
    kind = "holds numbers" if len(numbers) == len(names) else "looks like data"
    raise InputError(
        f"the first line {kind} ({shown}), not names",
        where=source.path,
        fix=f"say that there is no header (header=False); the columns are then called 0, 1, 2{example}",
    )


def _column_names(head: _Head, delimiter: str, source: SourceFile, *, header: bool) -> list[str]:
    """Return the names in the header, or the numbers 0, 1, 2 where there is none."""
    if header and head.is_all:
        raise InputError("no rows below the header", where=source.path, fix="check the export")
    cells = [cell.strip() for cell in next(csv.reader(head.lines[:1], delimiter=delimiter))]
    if not header:
        return [str(number) for number in range(len(cells))]
    rows = head.lines[1:]
    has_no_name = all(line.endswith(delimiter) for line in rows) and _table_in(_widths(rows, delimiter))[1]
    return [*cells, ""] if has_no_name == len(cells) + 1 else cells  # every row ends with a delimiter, the names do not


def _distinct_columns(names: list[str], choice: ColumnChoice, source: SourceFile) -> list[str]:
    """Return the file's names of the chosen columns, each once; refuse a name that several columns have."""
    wanted = choice.wanted
    repeated = [name for name in wanted if names.count(name) > 1]
    if repeated:
        raise InputError(f"several columns are called {', '.join(repeated)}", where=source.path, fix="rename them")
    return wanted


def _parse(
    source: SourceFile,
    names: list[str],
    choice: ColumnChoice,
    delimiter: str,
    skip: int,
    format: FleetFormat,
    *,
    has_commas: bool,
) -> pa.Table:
    """Parse the chosen columns; rows that are too short or too long are left out, or reported if there are many."""
    wanted = _distinct_columns(names, choice, source)
    types: dict[str, pa.DataType] = {choice.columns["geometry"]: pa.string()} if "geometry" in choice.columns else {}
    types |= {choice.columns[name]: _WORDS for name in ("trace_id", "vehicle_id", "kind") if name in choice.columns}
    # Digits of times stay as they are written: with leading zeros, and with the commas of a list.
    if format.time_format is not None or (has_commas and "geometry" in choice.columns):
        types |= {name: pa.string() for name in (choice.columns.get("t"), choice.beside.get("t")) if name is not None}
    ragged: list[Any] = []

    def note(row: Any) -> str:
        ragged.append(row)
        return "skip"

    # Column names may not be unique in the columns that are not wanted: give each its number instead.
    numbers = [str(number) for number in range(len(names))]
    number_of = dict(zip(names, numbers, strict=True))
    try:
        content = pyarrow.csv.read_csv(
            source.path,
            read_options=pyarrow.csv.ReadOptions(use_threads=False, column_names=numbers, skip_rows=skip),
            parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=note),
            convert_options=pyarrow.csv.ConvertOptions(
                decimal_point="," if has_commas else ".",
                include_columns=[number_of[name] for name in wanted],
                null_values=_NULLS,
                column_types={number_of[name]: kind for name, kind in types.items()},
            ),
        )
    except (pa.ArrowException, UnicodeDecodeError, OSError) as error:
        raise _broken(source, error) from error
    if ragged:
        shown = ", ".join(f"line {row.number}: {row.actual_columns}" for row in ragged[:_EXAMPLES_SHOWN])
        fault = f"{len(ragged)} lines do not have {len(names)} fields ({shown}{', ...' if len(ragged) > 3 else ''})"
        if not may_leave_out(len(ragged), content.num_rows + len(ragged), format.invalid):
            fix = f"repair them, or give the delimiter if it is not {delimiter!r}"
            raise InputError(fault, where=source.path, fix=fix)
        logger.warning("%s: %s: left out", source.path, fault)
    content = content.rename_columns(wanted)
    binary = [field.name for field in content.schema if pa.types.is_binary(field.type)]
    if binary:
        raise InputError(f"column {', '.join(binary)} is not UTF-8", where=source.path, fix="save it as UTF-8")
    return content


def _identifiers(column: pa.ChunkedArray) -> pd.Series:
    """Return ids as integers where all of them are written as plain ones, as text otherwise; empty ones missing."""
    encoded = column.unify_dictionaries().combine_chunks()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.chunk(0) if encoded.num_chunks else pa.array([], _WORDS)
    words: list[str | None] = [None if word in _NO_ID else word for word in encoded.dictionary.to_pylist()]
    codes = encoded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    if (codes >= 0).all() and all(word is not None and _PLAIN_INTEGER.fullmatch(word) for word in words):
        return pd.Series(np.array(words, np.int64)[codes] if words else np.zeros(0, np.int64))
    return pd.Series(pd.array([*words, None], dtype="str").take(codes))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _broken(source: SourceFile, error: Exception) -> InputError:
    """Return the error of a file that cannot be parsed."""
    reason = str(error).splitlines()[0]
    if source.path.suffix.lower() == ".gz" and not isinstance(error, pa.ArrowInvalid):
        return InputError(f"broken gzip ({reason})", where=source.path, fix="it may be truncated; copy it again")
    return InputError(f"not a readable text table ({reason})", where=source.path, fix="check its format and delimiter")
