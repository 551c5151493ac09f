"""Reading traces from GPX 1.0 and 1.1 as a stream: a file is never held in memory as a tree.

Strategy: expat calls back at the elements of a track point; the texts of positions, heights and times are
collected in lists, which become arrays as soon as they are long: a point takes some forty bytes, not a kilobyte.
Routes and waypoints are no drives and are passed over.
"""

from __future__ import annotations

import logging
import zlib
from typing import Any
from xml.parsers import expat

import numpy as np
import pandas as pd

from probe2road.crs import WGS84
from probe2road.errors import InputError
from probe2road.fleet.faults import TableOrigin
from probe2road.io.compressed import unpacked
from probe2road.io.sources import RawTable, SourceFile

__all__ = ["read_gpx"]

logger = logging.getLogger(__name__)

_BLOCK, _SAID = 1 << 20, 100  # bytes read at once, and blocks between two lines of the log
_POINTS = 1 << 16  # points whose texts are held
_TEXT = "string[pyarrow]"
_ANONYMOUS = "openstreetmap.org"  # creator of files with the points of many, whose own files it names otherwise

_VALUES = {"ele": "z", "time": "t", "speed": "speed", "course": "heading"}  # children of a track point, at any depth


def read_gpx(source: SourceFile, *, invalid: str | None = None) -> RawTable:
    """Read the track points of one GPX file.

    Every track segment is a trace, called ``name of the file/number of the track/number of the segment``,
    both counted from 0. Speed and course are read where GPX 1.0 or a common extension of 1.1 has them.

    Parameters
    ----------
    source
        File with suffix ``.gpx`` or ``.gpx.gz``.
    invalid
        ``"refuse"`` also refuses a file in which only some points are anonymous.

    Returns
    -------
    RawTable
        In longitude and latitude, with ``t`` only where at least one point has a time.

    Raises
    ------
    InputError
        If the XML is broken (with the line), the file is no GPX, it has no track points, or only anonymous ones of the
        OpenStreetMap server, which are no drive.
    """
    lists, blocks = _parse(source)
    count = sum(map(len, blocks["lon"]))
    if not count:
        fault = "no track points (routes and waypoints are not traces)"
        raise InputError(fault, where=source.path, fix="export the tracks")
    names = pd.array([f"{source.trace_name}/{track}/{segment}" for track, segment in lists["segment"]], dtype="str")
    counts = np.diff([*lists["start"], count])
    table = {"trace_id": pd.Series(names.take(np.repeat(np.arange(len(counts)), counts)))}
    table |= {"x": _joined(blocks["lon"]), "y": _joined(blocks["lat"])}
    for tag, name in _VALUES.items():
        if not all(pd.isna(block).all() for block in blocks[tag]):
            table[name] = _joined(blocks[tag])
    columns = {"x": "lon", "y": "lat", "z": "ele", "t": "time", "heading": "course"}
    return RawTable(
        _drives(pd.DataFrame(table), lists, source, invalid),
        WGS84,
        True,
        TableOrigin("traces", "track point", 0, columns),
    )


def _drives(table: pd.DataFrame, lists: dict[str, list[Any]], source: SourceFile, invalid: str | None) -> pd.DataFrame:
    """Leave out what is no drive: points without time that the OpenStreetMap server gives in no order."""
    untimed = table["t"].isna() if "t" in table else pd.Series(True, table.index)
    untimed = untimed.groupby(table["trace_id"], sort=False).transform("all")
    if not any(_ANONYMOUS in creator.lower() for creator in lists["creator"]):
        if untimed.any():
            logger.warning(
                "%s: %d of %d track points have no time and count as driven in their order; points of many vehicles, "
                "as an anonymous download gives them, are no drive: leave them out",
                *(source.path, int(untimed.sum()), len(table)),
            )
        return table
    if not untimed.any():
        return table
    fault = f"{int(untimed.sum())} of {len(table)} track points of the OpenStreetMap server are anonymous, no drive"
    if untimed.all() or invalid == "refuse":
        fix = "they have no times and no order: download traces that are identifiable or trackable"
        raise InputError(fault, where=source.path, fix=fix)
    logger.warning("%s: %s: left out", source.path, fault)
    return table[~untimed].reset_index(drop=True)


def _parse(source: SourceFile) -> tuple[dict[str, list[Any]], dict[str, list[Any]]]:
    """Return the numbers and first points of all segments, and the values of the track points in blocks."""
    lists: dict[str, list[Any]] = {name: [] for name in ("lon", "lat", *_VALUES, "segment", "start", "creator")}
    blocks: dict[str, list[Any]] = {name: [] for name in ("lon", "lat", *_VALUES)}
    parser = expat.ParserCreate()
    parser.buffer_text = True
    _connect(parser, lists, blocks, source)
    try:
        with unpacked(source.path) as file:
            number = 0
            while block := file.read(_BLOCK):
                parser.Parse(block, False)
                number += 1
                if number % _SAID == 0:
                    logger.info("%s: read %d MB", source.path, number)
            parser.Parse(b"", True)
    except expat.ExpatError as error:
        fault = f"broken XML at line {error.lineno}, column {error.offset + 1}: {expat.ErrorString(error.code)}"
        raise InputError(fault, where=source.path, fix="repair that line, or export the file again") from error
    except (OSError, EOFError, zlib.error) as error:
        fault = "broken gzip" if source.path.suffix.lower() == ".gz" else "the file cannot be read"
        raise InputError(f"{fault} ({error})", where=source.path, fix="copy it again") from error
    _pack(lists, blocks)
    return lists, blocks


def _pack(lists: dict[str, list[Any]], blocks: dict[str, list[Any]]) -> None:
    """Turn the texts in the lists into arrays, and empty the lists."""
    for name, column in blocks.items():
        texts = lists[name]
        column.append(pd.array(texts, dtype=_TEXT) if name == "time" else _numbers(texts))
        texts.clear()


def _connect(
    parser: expat.XMLParserType, lists: dict[str, list[Any]], blocks: dict[str, list[Any]], source: SourceFile
) -> None:
    """Let the parser fill the lists, and pack what they hold before they are long."""
    lon, lat, values = lists["lon"], lists["lat"], [lists[tag] for tag in _VALUES]
    text: list[str] = []
    state = {"track": -1, "segment": -1, "point": False, "root": False}
    packed = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal packed
        tag = name.rpartition(":")[2]
        if tag == "trkpt":
            if len(lon) == _POINTS:
                packed += _POINTS
                _pack(lists, blocks)
            state["point"] = True
            lon.append(attributes.get("lon"))
            lat.append(attributes.get("lat"))
            for column in values:
                column.append(None)
        elif tag in _VALUES:
            if state["point"]:
                parser.CharacterDataHandler = text.append
        elif tag == "trkseg":
            state["segment"] += 1
            lists["segment"].append((state["track"], state["segment"]))
            lists["start"].append(packed + len(lon))
        elif tag == "trk":
            state["track"] += 1
            state["segment"] = -1
        elif not state["root"] and tag != "gpx":
            raise InputError(f"the root element is <{name}>, not <gpx>", where=source.path, fix="check its suffix")
        if not state["root"]:
            lists["creator"].append(attributes.get("creator", ""))
        state["root"] = True

    def end(name: str) -> None:
        tag = name.rpartition(":")[2]
        if tag == "trkpt":
            state["point"] = False
        elif tag in _VALUES and state["point"]:
            lists[tag][-1] = "".join(text).strip() or None
            text.clear()
            parser.CharacterDataHandler = None

    parser.StartElementHandler = start
    parser.EndElementHandler = end


def _joined(blocks: list[Any]) -> pd.Series:
    """Return one column; of texts where a block holds any."""
    return pd.concat([pd.Series(block) for block in blocks], ignore_index=True)


def _numbers(texts: list[str | None]) -> Any:
    """Convert texts to float64, missing ones to NaN; return the texts themselves if one is not a number."""
    try:
        return np.array(["nan" if text is None else text for text in texts], np.float64)
    except ValueError:
        return pd.Series(texts, dtype=object)
