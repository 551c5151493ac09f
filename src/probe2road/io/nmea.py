"""Traces from logs of NMEA 0183, the sentences of a satellite receiver: RMC and GGA of every talker.

Strategy: one regular expression takes the sentences out of the lines, whatever stands before them, and one pass over
all bytes checks their sums. Sentences that follow each other with the same time are one fix: RMC gives the date, speed
and course, GGA the height. Sentences without position, or marked as void, are none.
"""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from probe2road.crs import WGS84
from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin
from probe2road.io.angles import degrees_and_minutes, degrees_of_column
from probe2road.io.compressed import unpacked
from probe2road.io.guard import parsing
from probe2road.io.sources import RawTable, SourceFile
from probe2road.io.units import UNITS

__all__ = ["read_nmea"]

logger = logging.getLogger(__name__)

_SENTENCE = r"\$(?P<body>[A-Z]{2}(?P<kind>RMC|GGA),(?P<values>[^*$]*))(?:\*(?P<sum>[0-9A-Fa-f]{2}))?"
# Which field of a sentence is what, after its name.
_FIELDS = {
    "RMC": {"time": 0, "valid": 1, "lat": 2, "ns": 3, "lon": 4, "ew": 5, "speed": 6, "heading": 7, "date": 8},
    "GGA": {"time": 0, "lat": 1, "ns": 2, "lon": 3, "ew": 4, "valid": 5, "z": 8},
}
_VOID = ("V", "0")  # no fix: status of RMC, quality of GGA
_SOUND = 0.5  # share of sentences with a right checksum, up to which a log is not trusted
_NO_DATE = pd.Timestamp("1970-01-01")


def read_nmea(source: SourceFile, *, invalid: str | None = None) -> RawTable:
    """Read one log, which is one trace.

    Parameters
    ----------
    source
        The file.
    invalid
        What happens to sentences with a wrong checksum: left out with a warning, unless they are half of the log, or
        this is ``"refuse"``.

    Returns
    -------
    RawTable
        In longitude and latitude, UTC, m/s and degrees from north. Without any date, times count from 1970-01-01.

    Raises
    ------
    InputError
        If no sentence holds a position, or too many checksums are wrong.
    """
    with parsing(source.path, "cannot be read as NMEA"):
        with unpacked(source.path) as file:
            lines = [line.decode("ascii", errors="replace") for line in file.read().splitlines()]
        found = pc.extract_regex(pa.array(lines, pa.string()), _SENTENCE)
        found = pc.drop_null(found)
        sound = _sums_fit(found.field("body"), found.field("sum")) if len(found) else np.zeros(0, bool)
    if not sound.all():
        fault = f"{int((~sound).sum())} of {len(sound)} NMEA sentences have a wrong checksum"
        if invalid == "refuse" or (invalid is None and sound.mean() <= _SOUND):
            raise InputError(fault, where=source.path, fix='copy the log again, or leave them out with invalid="drop"')
        logger.warning("%s: %s: left out", source.path, fault)
    with parsing(source.path, "cannot be read as NMEA"):
        fixes = _fixes(found.filter(pa.array(sound)))
    if fixes.empty:
        fault = "no NMEA sentence RMC or GGA holds a position"
        raise InputError(fault, where=source.path, fix="check that the receiver had a fix")
    if fixes["date"].isna().all():
        logger.warning("%s: no sentence holds a date: times count from %s", source.path, _NO_DATE.date())
    table = {"trace_id": source.trace_name, "t": _times(fixes), "x": fixes["lon"], "y": fixes["lat"]}
    table |= {name: fixes[name] for name in ("z", "heading", "speed") if fixes[name].notna().any()}
    origin = TableOrigin("traces", "fix", 0, {"x": "longitude", "y": "latitude", "heading": "course"})
    return RawTable(pd.DataFrame(table), WGS84, True, origin)


def _sums_fit(bodies: pa.StringArray, sums: pa.StringArray) -> NDArray[np.bool_]:
    """Say which sentences have the checksum that they state, or state none; bodies are not empty."""
    encoded = [body.encode() for body in bodies.to_pylist()]
    ends = np.cumsum([len(body) for body in encoded])
    computed = np.bitwise_xor.reduceat(np.frombuffer(b"".join(encoded), np.uint8), np.r_[0, ends[:-1]])
    stated = np.array([int(text, 16) if text else -1 for text in sums.to_pylist()])
    return np.asarray((stated == -1) | (stated == computed), bool)


def _fixes(sentences: pa.StructArray) -> pd.DataFrame:
    """Return one row for each fix: time of day and date as text, degrees, m, m/s, degrees from north."""
    kinds = sentences.field("kind").to_pandas()
    values = sentences.field("values").to_pandas().str.split(",", expand=True)
    names = list(dict.fromkeys(name for fields in _FIELDS.values() for name in fields))
    table = pd.DataFrame(index=kinds.index, columns=names, dtype=object)
    for kind, fields in _FIELDS.items():
        for name, number in fields.items():
            if number in values:
                table[name] = table[name].where(kinds != kind, values[number])
    table = table.map(lambda word: word.strip() or None, na_action="ignore")
    table = table[~table["valid"].isin(_VOID) & table["time"].notna() & table["lat"].notna() & table["lon"].notna()]
    fix = (table["time"] != table["time"].shift()).cumsum()
    table = table.groupby(fix).first()
    for axis, name, hemisphere in (("x", "lon", "ew"), ("y", "lat", "ns")):
        angle = degrees_and_minutes(pd.to_numeric(table[name], errors="coerce"))
        table[name] = degrees_of_column(angle, axis, hemispheres=table[hemisphere])[0]
    for name in ("z", "speed", "heading"):
        table[name] = pd.to_numeric(table[name], errors="coerce")
    table["speed"] *= UNITS["speed"]["kn"]
    return table.reset_index(drop=True)


def _times(fixes: pd.DataFrame) -> pd.Series:
    """Return UTC times; a fix without date is of the last date, or of the day after where its clock is behind."""
    clock = pd.to_numeric(fixes["time"], errors="coerce")
    seconds = clock // 10000 * 3600 + clock % 10000 // 100 * 60 + clock % 100
    days = pd.to_datetime(fixes["date"].astype("str"), format="%d%m%y", errors="coerce")
    dated = days.notna()
    if not dated.any():
        midnights = (seconds.diff() < -43200).cumsum()
        days = _NO_DATE + pd.to_timedelta(midnights, unit="D")
    else:
        since = seconds.where(dated).ffill()
        days = days.ffill().bfill() + pd.to_timedelta((since - seconds > 43200).astype(int), unit="D")
    return (days + pd.to_timedelta((seconds * 1000).round(), unit="ms")).dt.tz_localize("UTC")
