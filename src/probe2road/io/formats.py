"""What files do not say of themselves: the columns, the CRS, the delimiter or the layer that a user names.

A fleet is read from any number of files with one `FleetFormat`, a road graph from one file with a `GraphFormat`.
Python, TOML and the command line share these two, so that a field has one name, one default and one check.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

from pyproj import CRS

from probe2road.bounds import MisfitError, Positive, fitted
from probe2road.crs import parse_crs
from probe2road.errors import OptionError
from probe2road.fleet.outliers import OutlierOptions

__all__ = ["BBox", "ColumnMap", "FleetFormat", "GraphFormat", "adjusted"]

BBox = tuple[float, float, float, float]
ColumnMap = Mapping[str, str | int | None]  # our column to the file's; empty or None: the file has no such column


@dataclass(frozen=True)
class FleetFormat:
    """How fleet data stands in its files; one format for all files of a fleet.

    Raises
    ------
    OptionError
        If ``bbox`` is no box, ``delimiter`` not one character, ``time_format`` none, ``trim_ends`` negative, or a limit
        no positive number.
    CRSError
        If pyproj cannot read a CRS.

    Examples
    --------
    >>> FleetFormat(columns={"trace_id": "trip"}, bbox=(0, 0, 10, 10)).bbox
    (0.0, 0.0, 10.0, 10.0)
    >>> FleetFormat(delimiter="::")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: delimiter '::' is not one character; use one, or leave it out
    """

    columns: ColumnMap = field(default_factory=dict)  # of the traces, ours to the file's; usual names need no entry
    point_columns: ColumnMap = field(default_factory=dict)  # of the semantic points, likewise
    crs: CRS | str | int | None = None  # of the coordinates, where neither the file nor its column names say it
    target_crs: CRS | str | int | None = None  # metric CRS to work in; chosen from the data where None
    bbox: BBox | None = None  # left, bottom, right, top in the CRS of the files; what is outside is not read
    delimiter: str | None = None  # of text tables; told from the first line where None
    header: bool = True  # whether text tables start with a line of names; else the columns are 0, 1, 2
    time_format: str | None = None  # how times are written, for strptime; told from them where None
    interval: float | None = None  # s between the positions of a line that has a start time only
    layer: str | None = None  # of the fixes, in a GIS file of several
    outliers: OutlierOptions = field(default_factory=OutlierOptions)  # what no vehicle can have been at is left out
    trim_ends: float = 0.0  # m left out at both ends of every trace, in which somebody may live
    invalid: str | None = None  # rows without position or readable time: drop or refuse; None: drop up to 5 % of a file
    max_accuracy: float | None = None  # m; fixes that say that they are less accurate are left out
    max_speed: float | None = None  # m/s; fixes that no slower vehicle could have come to and left are left out
    max_uncompressed: float = 4.0  # GB that a compressed file may hold

    def __post_init__(self) -> None:
        """Refuse what is no box, no delimiter or no CRS."""
        if self.bbox is not None:
            object.__setattr__(self, "bbox", _checked_bbox(self.bbox))  # four floats, whatever sequence they came in
        if self.delimiter is not None and len(self.delimiter) != 1:
            raise OptionError(f"delimiter {self.delimiter!r} is not one character", fix="use one, or leave it out")
        if not self.trim_ends >= 0:
            raise OptionError(f"trim_ends is {self.trim_ends}", fix="use metres, 0 or more")
        if self.invalid not in (None, "drop", "refuse"):
            raise OptionError(f"invalid is {self.invalid!r}", fix="use drop or refuse, or leave it out")
        for name in ("max_accuracy", "max_speed", "interval"):
            _fit(self, name, Positive[float] | None)
        _fit(self, "max_uncompressed", Positive[float])
        if self.time_format is not None and "%" not in self.time_format:
            fix = "write it as strptime does, such as %d.%m.%Y %H:%M:%S"
            raise OptionError(f"time_format {self.time_format!r} names no part of a time", fix=fix)
        _check_crs(self.crs, self.target_crs)

    @cached_property
    def stated_crs(self) -> CRS | None:
        """The CRS of the coordinates as an object, None where the user names none."""
        return None if self.crs is None else parse_crs(self.crs)

    def columns_of(self, *, points: bool) -> ColumnMap:
        """Return the column map of the semantic points, or that of the traces."""
        return self.point_columns if points else self.columns


@dataclass(frozen=True)
class GraphFormat:
    """How a road graph stands in its file.

    Raises
    ------
    CRSError
        If pyproj cannot read a CRS.
    OptionError
        If a limit is no positive number.
    """

    crs: CRS | str | int | None = None  # of the coordinates, where the file names none
    target_crs: CRS | str | int | None = None  # metric CRS to work in; else the recorded, the file's own or a local one
    layer: str | None = None  # of the edges, in a file of several
    inner_junctions: bool = True  # whether lines of a GIS file are cut at inner vertices on which another line ends
    max_uncompressed: float = 4.0  # GB that a compressed file may hold

    def __post_init__(self) -> None:
        """Refuse what is no CRS and no size."""
        _fit(self, "max_uncompressed", Positive[float])
        _check_crs(self.crs, self.target_crs)


F = TypeVar("F", FleetFormat, GraphFormat)


def adjusted(format: F, **given: Any) -> F:
    """Return a format with the fields that are given; None stands for a field that is not.

    Examples
    --------
    >>> adjusted(GraphFormat(crs="EPSG:32616"), layer="streets", crs=None)
    GraphFormat(crs='EPSG:32616', target_crs=None, layer='streets', inner_junctions=True, max_uncompressed=4.0)
    """
    return replace(format, **{name: value for name, value in given.items() if value is not None})


def _fit(format: FleetFormat | GraphFormat, name: str, kind: Any) -> None:
    """Bring a field into the form of its kind.

    Raises
    ------
    OptionError
        If it has no such form.
    """
    try:
        object.__setattr__(format, name, fitted(getattr(format, name), kind, name))
    except MisfitError as misfit:
        raise OptionError(misfit.what, fix=misfit.fix) from misfit


def _checked_bbox(bbox: Sequence[float]) -> BBox:
    """Return a bounding box of four ordered numbers."""
    fix = "use (left, bottom, right, top), left < right, bottom < top"
    try:
        numbers = tuple(map(float, bbox))
    except (TypeError, ValueError) as error:
        raise OptionError(f"bbox {bbox!r} is no box", fix=fix) from error
    if len(numbers) != 4 or not (numbers[0] < numbers[2] and numbers[1] < numbers[3]):
        raise OptionError(f"bbox {numbers} is no box", fix=fix)
    return numbers


def _check_crs(*values: CRS | str | int | None) -> None:
    """Refuse what pyproj does not take for a CRS."""
    for value in values:
        if value is not None:
            parse_crs(value)
