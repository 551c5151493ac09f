"""Traces in the layout of OziExplorer, as GeoLife has it: ``.plt``.

Six lines stand above the fixes. A fix is latitude, longitude, a mark where the track was interrupted, altitude in feet,
the day since 1899-12-30 with the time as its fraction, and the same as date and time in words.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.csv

from probe2road.crs import WGS84
from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin, may_leave_out
from probe2road.io.compressed import unpacked
from probe2road.io.guard import parsing
from probe2road.io.sources import RawTable, SourceFile
from probe2road.io.units import UNITS

__all__ = ["read_plt"]

logger = logging.getLogger(__name__)

_LINES_ABOVE = 6
_COLUMNS = ["lat", "lon", "break", "feet", "days", "date", "time"]
_DAY_ZERO = pd.Timestamp("1899-12-30", tz="UTC")
_NO_ALTITUDE = -777  # feet


def read_plt(source: SourceFile, *, invalid: str | None = None) -> RawTable:
    """Read one file, which is one trace, cut where it says that it was interrupted.

    Parameters
    ----------
    source
        The file.
    invalid
        What happens to lines of another number of fields; see `probe2road.read_fleet`.

    Returns
    -------
    RawTable
        In longitude and latitude. The trace is called like the file; pieces are ``file/0``, ``file/1``.

    Raises
    ------
    InputError
        If the lines are none of such a file.
    """
    ragged: list[int] = []

    def note(row: Any) -> str:
        ragged.append(row.number)
        return "skip"

    with parsing(source.path, "cannot be read as PLT", fix="check that it has six lines above the fixes"):
        with unpacked(source.path) as file:
            table = pyarrow.csv.read_csv(
                file,
                read_options=pyarrow.csv.ReadOptions(column_names=_COLUMNS, skip_rows=_LINES_ABOVE, use_threads=False),
                parse_options=pyarrow.csv.ParseOptions(invalid_row_handler=note),
                convert_options=pyarrow.csv.ConvertOptions(include_columns=_COLUMNS, strings_can_be_null=True),
            ).to_pandas()
        days = pd.to_numeric(table["days"])
        words = pd.to_datetime(table["date"].astype("str") + " " + table["time"].astype("str"), errors="coerce")
        in_days = _DAY_ZERO + pd.to_timedelta((days * 86_400_000).round(), unit="ms")
        feet = pd.to_numeric(table["feet"])
        piece = (table["break"].iloc[1:] == 1).cumsum().reindex(table.index, fill_value=0)
    if ragged:
        fault = f"{len(ragged)} lines do not have {len(_COLUMNS)} fields"
        if not may_leave_out(len(ragged), len(table) + len(ragged), invalid):
            raise InputError(fault, where=source.path, fix="repair them")
        logger.warning("%s: %s: left out", source.path, fault)
    named = f"{source.trace_name}/" + piece.astype(str) if piece.any() else source.trace_name
    ours = {
        "trace_id": named,
        "t": words.dt.tz_localize("UTC").fillna(in_days),
        "x": table["lon"],
        "y": table["lat"],
        "z": np.where(feet == _NO_ALTITUDE, np.nan, feet * UNITS["z"]["ft"]),
    }
    columns = {"x": "longitude", "y": "latitude", "z": "altitude", "t": "date and time"}
    origin = TableOrigin("traces", "line", _LINES_ABOVE + 1, columns)
    return RawTable(pd.DataFrame(ours), WGS84, True, origin)
