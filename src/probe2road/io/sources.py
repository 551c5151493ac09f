"""The files to read, the format of each, and the names of its traces."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.errors import InputError, MissingFileError
from probe2road.fleet.faults import TableOrigin
from probe2road.io.atomic import settled
from probe2road.io.compressed import unpacked

__all__ = ["FORMATS", "POINTS_MARK", "RawTable", "SourceFile", "find_sources", "format_of"]

FORMATS = {
    **dict.fromkeys((".parquet", ".pq", ".geoparquet"), "parquet"),
    **dict.fromkeys((".csv", ".tsv", ".txt", ".log", ".csv.gz", ".tsv.gz", ".txt.gz", ".log.gz"), "text"),
    **dict.fromkeys((".gpx", ".gpx.gz"), "gpx"),
    **dict.fromkeys((".nmea", ".nmea.gz"), "nmea"),
    **dict.fromkeys((".plt", ".plt.gz"), "plt"),
    **dict.fromkeys((".gpkg", ".geojson", ".fgb", ".shp"), "layer"),
    **dict.fromkeys((".json", ".jsonl", ".ndjson", ".json.gz"), "records"),
}
# What a file of a more general suffix is, by what its first bytes hold.
_BEGINNINGS = {
    "text": {rb"\$G": "nmea", rb"Geolife trajectory": "plt", rb"OziExplorer Track": "plt"},
    "records": {rb'\{.*"type"\s*:\s*"FeatureCollection"': "layer", rb'\{.*"(osm3s|elements)"\s*:': "layer"},
}
_HEAD = 4096  # bytes looked at
_ASKED_FOR = ("layer", "records")  # formats of maps as well: taken out of a folder only where nothing else is in it
POINTS_MARK = "points"  # a file called points.SUFFIX or NAME.points.SUFFIX holds semantic points


@dataclass(frozen=True)
class SourceFile:
    """A file of fleet data."""

    path: Path
    format: str  # a value of FORMATS
    trace_name: str  # what a trace is called that the file does not name; differs between files


@dataclass(frozen=True)
class RawTable:
    """The unchecked content of a file: our column names, the file's types."""

    table: pd.DataFrame
    crs: CRS | None  # that the file itself states
    degrees: bool  # the columns are called longitude and latitude
    origin: TableOrigin
    guessed: tuple[str, ...] = ()  # "ours=theirs" of every column found by usual name
    skipped: NDArray[np.int64] | None = None  # parts of the file outside the box, and not read, before every row


def find_sources(
    source: str | PathLike[str] | Sequence[str | PathLike[str]], *, semantic_points: bool = False
) -> tuple[list[SourceFile], list[Path]]:
    """List the files of fleet data in a path, sorted by name.

    A folder stands for all files in it, and in the folders below, that have a supported suffix and are not
    hidden (a name that starts with ``.`` or ``_``). Files of semantic points beside the traces, by name, are
    left out of a folder of traces, and so are GIS files and JSON, which may be maps, where anything else is in it.

    Parameters
    ----------
    source
        A file, a folder, or a sequence of them.
    semantic_points
        Whether semantic points are looked for, so that none is left out.

    Returns
    -------
    (list of SourceFile, list of Path)
        The files, at least one, none twice; and the files of semantic points left out.

    Raises
    ------
    MissingFileError
        If a path does not exist.
    InputError
        If a file's suffix is not supported, a folder holds no supported file, or a file is empty.

    Examples
    --------
    >>> find_sources("nowhere.csv")
    Traceback (most recent call last):
        ...
    probe2road.errors.MissingFileError: nowhere.csv: there is no such file or folder; check the path
    """
    given = [source] if isinstance(source, str | PathLike) else list(source)
    if not given:
        raise InputError("no files were given", fix="pass a file, a folder, or several of them")
    files: dict[Path, str] = {}
    left_out: list[Path] = []
    for item in map(Path, given):
        if item.is_dir():
            inside = _supported_files(item)
            marked = [] if semantic_points else [path for path in inside if _is_marked(path)]
            left_out += marked
            files |= {path: _stem(path.relative_to(item)) for path in inside if path not in marked}
            if not files:
                raise InputError("the folder holds no supported file", where=item, fix=_supported())
        else:
            files.setdefault(_existing(settled(item)), _stem(Path(item.name)))
    if len(set(files.values())) < len(files):  # files of one name: call them by their whole paths
        files = {path: path.as_posix() for path in files}
    return [SourceFile(path, format_of(path), name) for path, name in files.items()], left_out


def format_of(path: Path) -> str:
    """Return the format of a file, by its suffix and, where that is general, by its first bytes."""
    format = FORMATS[_suffix(path)]
    if format not in _BEGINNINGS:
        return format
    try:
        with unpacked(path) as file:
            head = file.read(_HEAD).removeprefix(b"\xef\xbb\xbf").lstrip()
    except (OSError, EOFError, zlib.error):
        return format  # whose reader says what is wrong
    beginnings = _BEGINNINGS[format].items()
    return next((found for pattern, found in beginnings if re.match(pattern, head, re.DOTALL)), format)


def _existing(path: Path) -> Path:
    """Return the path of a file, or refuse one that cannot be read."""
    if not path.exists():
        raise MissingFileError("there is no such file or folder", where=path, fix="check the path")
    if _suffix(path) not in FORMATS:
        raise InputError(f"the suffix {_suffix(path)!r} is not supported", where=path, fix=_supported())
    if path.stat().st_size == 0:
        raise InputError("the file is empty (0 bytes)", where=path, fix="write it again")
    return path


def _supported_files(folder: Path) -> list[Path]:
    """List the supported files in a folder and below, without hidden ones."""
    hidden = (".", "_")
    for place in {path.parent for path in folder.rglob(".*") if path.is_dir()}:
        settled(place / "any")  # ends what a killed process began
    inside = (path for path in folder.rglob("*") if path.is_file() and _suffix(path) in FORMATS)
    seen = (path for path in inside if not any(part.startswith(hidden) for part in path.relative_to(folder).parts))
    found = sorted(seen)
    drives = [path for path in found if FORMATS[_suffix(path)] not in _ASKED_FOR]
    return [_existing(path) for path in drives or found]


def _is_marked(path: Path) -> bool:
    """Tell whether the name of a file says that it contains semantic points."""
    return _stem(Path(path.name)).split(".")[-1].lower() == POINTS_MARK


def _suffix(path: Path) -> str:
    """Return the suffix in lower case, with the one before a final .gz."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    return "".join(suffixes[-2:] if suffixes[-1:] == [".gz"] else suffixes[-1:])


def _stem(path: Path) -> str:
    """Return the path without its suffix, with forward slashes."""
    return path.as_posix()[: -len(_suffix(path)) or None]


def _supported() -> str:
    return f"supported are {', '.join(FORMATS)}"
