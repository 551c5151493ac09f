"""What files do not say of themselves: the columns, the CRS, the delimiter or the layer that a user names.

A fleet is read from any number of files with one `FleetFormat`, a road graph from one file with a `GraphFormat`.
Python, TOML and the command line share these two, so that a field has one name, one default and one check.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, TypeVar

from pyproj import CRS

from probe2road.bounds import NotNegative, Positive
from probe2road.crs import parse_crs
from probe2road.errors import OptionError
from probe2road.fleet.outliers import OutlierOptions
from probe2road.options import checked

__all__ = ["BBox", "ColumnMap", "FleetFormat", "GraphFormat", "adjusted"]

BBox = tuple[float, float, float, float]
ColumnMap = Mapping[str, str | int | None]  # our column to the file's; empty or None: the file has no such column


@dataclass(frozen=True)
@checked
class FleetFormat:
    """How fleet data stands in its files; one format for all files of a fleet.

    Raises
    ------
    OptionError
        If a field is not as annotated, ``bbox`` is no box, ``delimiter`` not one character, or ``time_format`` names no
        part of a time.
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
    interval: Positive[float] | None = None  # s between the positions of a line that has a start time only
    layer: str | None = None  # of the fixes, in a GIS file of several
    outliers: OutlierOptions = field(default_factory=OutlierOptions)  # what no vehicle can have been at is left out
    trim_ends: NotNegative[float] = 0.0  # m left out at both ends of every trace, in which somebody may live
    invalid: Literal["drop", "refuse"] | None = (
        None  # bad rows, without position or time; None: drop up to 5 % of a file
    )
    max_accuracy: Positive[float] | None = None  # m; fixes that say that they are less accurate are left out
    max_speed: Positive[float] | None = (
        None  # m/s; fixes that no slower vehicle could have come to and left are left out
    )
    max_uncompressed: Positive[float] = 4.0  # GB that a compressed file may hold

    def __post_init__(self) -> None:
        """Refuse what is no box, no delimiter or no CRS."""
        if self.bbox is not None and not (self.bbox[0] < self.bbox[2] and self.bbox[1] < self.bbox[3]):
            fix = "use (left, bottom, right, top), left < right, bottom < top"
            raise OptionError(f"bbox {self.bbox} is no box", fix=fix)
        if self.delimiter is not None and len(self.delimiter) != 1:
            raise OptionError(f"delimiter {self.delimiter!r} is not one character", fix="use one, or leave it out")
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
@checked
class GraphFormat:
    """How a road graph stands in its file.

    Raises
    ------
    CRSError
        If pyproj cannot read a CRS.
    OptionError
        If a field is not as annotated.
    """

    crs: CRS | str | int | None = None  # of the coordinates, where the file names none
    target_crs: CRS | str | int | None = None  # metric CRS to work in; else the recorded, the file's own or a local one
    layer: str | None = None  # of the edges, in a file of several
    inner_junctions: bool = True  # whether lines of a GIS file are cut at inner vertices on which another line ends
    max_uncompressed: Positive[float] = 4.0  # GB that a compressed file may hold

    def __post_init__(self) -> None:
        """Refuse what is no CRS."""
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


def _check_crs(*values: CRS | str | int | None) -> None:
    """Refuse what pyproj does not take for a CRS."""
    for value in values:
        if value is not None:
            parse_crs(value)
