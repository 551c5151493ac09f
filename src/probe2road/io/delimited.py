"""Fleet data from text tables: CSV, TSV and the like, with or without header, gzip or not."""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv

from probe2road.errors import InputError
from probe2road.fleet.tables import TableOrigin
from probe2road.io.columns import ColumnChoice, choose_columns, standard_kinds, times_from_numbers
from probe2road.io.formats import FleetFormat
from probe2road.io.sources import RawTable, SourceFile

__all__ = ["read_text_table"]

_DELIMITERS = (",", ";", "\t", "|", " ")  # the earlier one where two are as frequent
_HEAD = 65536  # bytes looked at for the header
_WORDS = pa.dictionary(pa.int32(), pa.string())  # few different values in many rows
_PLAIN_INTEGER = re.compile(r"0|-?[1-9]\d{0,17}")
_EXAMPLES_SHOWN = 3


class _Head(NamedTuple):
    """The top of a text file."""

    line: str  # the first that is not blank
    n_blank: int  # lines above it
    is_all: bool  # nothing follows


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
    delimiter = format.delimiter or max(_DELIMITERS, key=head.line.count)
    names = _column_names(head, delimiter, source, header=format.header)
    choice = choose_columns(
        names, format.columns_of(points=points), points=points, crs=format.stated_crs, where=source.path
    )
    skip = head.n_blank + format.header
    table, unit = _our_columns(_parse(source, names, choice, delimiter, skip), choice)
    guessed = tuple(f"{name}={choice.columns[name]}" for name in choice.guessed)
    origin = TableOrigin("points" if points else "traces", "line", skip + 1, choice.columns, choice.by_name)
    return RawTable(table, None, choice.degrees, origin, (*guessed, *([f"t in {unit}"] if unit else [])))


def _read_head(source: SourceFile) -> _Head:
    """Read the top of a text file."""
    try:
        with gzip.open(source.path) if source.path.suffix.lower() == ".gz" else source.path.open("rb") as file:
            head = file.read(_HEAD)
    except (OSError, EOFError, zlib.error) as error:
        raise _broken(source, error) from error
    if not head.strip():
        raise InputError("the file holds no text", where=source.path, fix="write it again")
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError("the text is UTF-16", where=source.path, fix="save it as UTF-8")
    if b"\0" in head:
        raise InputError("the file is binary, not text", where=source.path, fix="check its suffix")
    lines = head.splitlines()
    n_blank = next(number for number, line in enumerate(lines) if line.strip())
    try:
        first = lines[n_blank].decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"the first line is not UTF-8 ({error})", where=source.path, fix="save it as UTF-8") from error
    return _Head(first, n_blank, len(head) < _HEAD and not any(line.strip() for line in lines[n_blank + 1 :]))


def _column_names(head: _Head, delimiter: str, source: SourceFile, *, header: bool) -> list[str]:
    """Return the names in the header, or the numbers 0, 1, 2 where there is none."""
    if header and head.is_all:
        raise InputError("no rows below the header", where=source.path, fix="check the export")
    cells = [cell.strip() for cell in next(csv.reader([head.line], delimiter=delimiter))]
    if not header:
        return [str(number) for number in range(len(cells))]
    if all(map(_is_number, cells)):
        fix = "say that there is no header (header=False); the columns are then called 0, 1, 2"
        raise InputError(f"the first line holds numbers ({head.line[:60]}), not names", where=source.path, fix=fix)
    return cells


def _distinct_columns(names: list[str], choice: ColumnChoice, source: SourceFile) -> list[str]:
    """Return the file's names of the chosen columns, each once; refuse a name that several columns have."""
    wanted = list(dict.fromkeys(choice.columns.values()))
    repeated = [name for name in wanted if names.count(name) > 1]
    if repeated:
        raise InputError(f"several columns are called {', '.join(repeated)}", where=source.path, fix="rename them")
    return wanted


def _parse(source: SourceFile, names: list[str], choice: ColumnChoice, delimiter: str, skip: int) -> pa.Table:
    """Parse the chosen columns, and report every row that is too short or too long."""
    wanted = _distinct_columns(names, choice, source)
    types = {choice.columns[name]: _WORDS for name in ("trace_id", "vehicle_id", "kind") if name in choice.columns}
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
                include_columns=[number_of[name] for name in wanted],
                column_types={number_of[name]: kind for name, kind in types.items()},
            ),
        )
    except (pa.ArrowInvalid, OSError) as error:
        raise _broken(source, error) from error
    if ragged:
        shown = ", ".join(f"line {row.number}: {row.actual_columns}" for row in ragged[:_EXAMPLES_SHOWN])
        fault = f"{len(ragged)} lines do not have {len(names)} fields ({shown}{', ...' if len(ragged) > 3 else ''})"
        raise InputError(fault, where=source.path, fix=f"repair them, or give the delimiter if it is not {delimiter!r}")
    content = content.rename_columns(wanted)
    binary = [field.name for field in content.schema if pa.types.is_binary(field.type)]
    if binary:
        raise InputError(f"column {', '.join(binary)} is not UTF-8", where=source.path, fix="save it as UTF-8")
    return content


def _our_columns(content: pa.Table, choice: ColumnChoice) -> tuple[pd.DataFrame, str]:
    """Rename the columns to ours and read numeric times; and the unit of those times."""
    table, unit = {}, ""
    for name, theirs in choice.columns.items():
        values = _identifiers(content.column(theirs)) if name.endswith("_id") else content.column(theirs).to_pandas()
        if name == "t":
            values, unit = times_from_numbers(values)
        table[name] = standard_kinds(values) if name == "kind" else values
    return pd.DataFrame(table, copy=False), unit


def _identifiers(column: pa.ChunkedArray) -> pd.Series:
    """Return ids as integers where all of them are written as plain ones, as text otherwise; empty ones missing."""
    encoded = column.unify_dictionaries().combine_chunks()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.chunk(0) if encoded.num_chunks else pa.array([], _WORDS)
    words: list[str | None] = [word or None for word in encoded.dictionary.to_pylist()]
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
