"""Fleet data from JSON records: a list of objects, one a fix, as web services and phones export it.

The list may be the whole file, or stand anywhere in it (``{"locations": [...]}``); values inside of values are columns
called ``coords.latitude``. A file of one object a line is such a list, too.
"""

from __future__ import annotations

import json
from typing import Any

import pandas as pd
import pyarrow as pa

from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin
from probe2road.io.cells import raw_table
from probe2road.io.columns import choose_columns
from probe2road.io.compressed import unpacked
from probe2road.io.formats import FleetFormat
from probe2road.io.guard import parsing
from probe2road.io.sources import RawTable, SourceFile

__all__ = ["read_records"]

_DEEPEST = 4  # levels of a file that are searched for its records


def read_records(source: SourceFile, format: FleetFormat | None = None, *, points: bool = False) -> RawTable:
    """Read the longest list of objects in one file.

    Parameters
    ----------
    source
        The file.
    format
        What the user says of the columns and the CRS; nothing where it is None.
    points
        Whether the file holds semantic points rather than traces.

    Returns
    -------
    RawTable
        May lack everything but the position.

    Raises
    ------
    InputError
        If the file is no JSON, holds no list of objects, or its columns cannot be told.
    """
    format = format or FleetFormat()
    with parsing(source.path, "cannot be read as JSON"):
        with unpacked(source.path) as file:
            text = file.read().decode("utf-8-sig")
        found = _longest_list(_parsed(text))
    if not found:
        fix = "write a list of objects, one for each fix, or a text table"
        raise InputError("the file holds no JSON records", where=source.path, fix=fix)
    with parsing(source.path, "cannot be read as JSON"):
        table = pd.json_normalize(found)
        mixed = {name: table[name].map(str, na_action="ignore") for name in table if table[name].dtype == object}
        content = pa.Table.from_pandas(table.assign(**mixed), preserve_index=False)
    choice = choose_columns(
        content.schema.names,
        format.columns_of(points=points),
        points=points,
        crs=format.stated_crs,
        where=source.path,
    )
    origin = TableOrigin("points" if points else "traces", "record")
    with parsing(source.path, "a column cannot be read", fix="write the file again, or name other columns"):
        return raw_table(content, choice, format, origin, where=source.path)


def _parsed(text: str) -> Any:
    """Return the content of a file of JSON, or of one object a line."""
    try:
        return json.loads(text)
    except ValueError:
        return [json.loads(line) for line in text.splitlines() if line.strip()]


def _longest_list(content: Any, depth: int = 0) -> list[dict[str, Any]]:
    """Return the longest list of objects; the outer one of two that are as long."""
    if isinstance(content, list) and content and all(isinstance(item, dict) for item in content):
        return content
    if depth == _DEEPEST or not isinstance(content, dict | list):
        return []
    inside = content.values() if isinstance(content, dict) else content
    return max((_longest_list(item, depth + 1) for item in inside), key=len, default=[])
