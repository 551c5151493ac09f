"""The local metric CRS of a run, and the check that refuses degrees.

Everything inside probe2road happens in one metric CRS, chosen once per run from the extent of the data, so
that a metre is a metre to within a part per thousand wherever the fleet drives. Degrees exist only in files.
"""

from __future__ import annotations

import logging
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError as ProjCRSError
from pyproj.exceptions import ProjError

from probe2road.errors import CRSError

__all__ = [
    "WGS84",
    "Placed",
    "crs_title",
    "crs_to_text",
    "extent_in_degrees",
    "extents_apart",
    "is_true_to_scale",
    "local_crs",
    "parse_crs",
    "require_metric",
    "require_same_crs",
    "same_crs",
    "transform",
    "turn_headings",
    "working_crs",
]

logger = logging.getLogger(__name__)

WGS84 = CRS.from_epsg(4326)

_UTM_ZONE_WIDTH = 6.0  # degrees of longitude
_UTM_ZONE_OVERHANG = 0.5  # degrees a data set may reach into the next zone and still use this one
_SCALE_TOLERANCE = 2e-3  # of a projection that may stay the CRS of a run
_WANTED_TOLERANCE = 1e-2  # of one that the user names: a neighbouring UTM zone is fine
_NORTH_DEGREES, _NORTH_METRES = 1e-4, 10.0  # how far north a place is looked at to find where north is
_NEAR = 1000.0  # m between two data sets that may have to do with each other
_UTM_LATITUDES = (-80.0, 84.0)  # degrees; outside, UTM is not defined


def parse_crs(value: Any, *, where: object = None) -> CRS:
    """Return a CRS from anything pyproj understands (EPSG code, WKT, PROJ string, CRS).

    Raises
    ------
    CRSError
        If pyproj cannot read it.

    Examples
    --------
    >>> parse_crs("EPSG:32616").to_epsg()
    32616
    """
    try:
        return CRS.from_user_input(value)
    except ProjCRSError as error:
        raise CRSError(
            f"{value!r} is not a coordinate reference system", where=where, fix="use a form such as EPSG:32616"
        ) from error


def local_crs(lon: ArrayLike, lat: ArrayLike) -> CRS:
    """Choose the metric CRS for data at these positions.

    UTM where the data fits one zone (with half a degree of overhang); a transverse Mercator on the data's
    own central meridian where it spans zones; a stereographic projection on the data's centre where UTM is
    undefined, north of 84 degrees or south of 80. All three are conformal.

    Parameters
    ----------
    lon, lat
        Longitudes and latitudes in degrees, WGS84, any equal shape, at least one finite pair. Longitudes may
        straddle the antimeridian.

    Returns
    -------
    CRS
        Projected, in metres, axes east and north.

    Raises
    ------
    CRSError
        If there is no finite position, or a latitude exceeds 90 degrees.

    Examples
    --------
    >>> local_crs([-87.65], [41.87]).to_epsg()
    32616
    >>> local_crs([8.0, 16.5], [48.0, 48.0]).name
    'probe2road local transverse Mercator at 12.25 E'
    """
    west, south, east, north = _degree_extent(lon, lat)
    middle = (west + east) / 2.0

    if south < _UTM_LATITUDES[0] or north > _UTM_LATITUDES[1]:
        return _named_crs(
            f"+proj=stere +lat_0={(south + north) / 2:.6f} +lon_0={_wrap(middle):.6f} +k=1",
            f"probe2road local stereographic at {(south + north) / 2:.2f} N {_wrap(middle):.2f} E",
        )
    zone_west = np.floor(middle / _UTM_ZONE_WIDTH) * _UTM_ZONE_WIDTH
    if west >= zone_west - _UTM_ZONE_OVERHANG and east <= zone_west + _UTM_ZONE_WIDTH + _UTM_ZONE_OVERHANG:
        zone = int(np.floor((_wrap(middle) + 180.0) / _UTM_ZONE_WIDTH)) % 60 + 1
        return CRS.from_epsg((32600 if (south + north) / 2 >= 0 else 32700) + zone)
    return _named_crs(
        f"+proj=tmerc +lat_0={(south + north) / 2:.6f} +lon_0={_wrap(middle):.6f} +k=1",
        f"probe2road local transverse Mercator at {_wrap(middle):.2f} E",
    )


def require_metric(crs: CRS | None, *, where: object = None) -> CRS:
    """Return a CRS in metres; refuse any other CRS.

    Raises
    ------
    CRSError
        If there is no CRS, if it is geographic (degrees), or if its unit is not the metre.

    Examples
    --------
    >>> require_metric(WGS84, where="graph")
    Traceback (most recent call last):
        ...
    probe2road.errors.CRSError: graph: coordinates are in degrees (WGS 84); reproject to a metric CRS and rerun
    """
    if crs is None:
        raise CRSError("no CRS", where=where, fix='say which one it is, for example crs="EPSG:32616"')
    if crs.is_geographic:
        raise CRSError(
            f"coordinates are in degrees ({crs.name})", where=where, fix="reproject to a metric CRS and rerun"
        )
    units = {axis.unit_name for axis in crs.axis_info[:2]}
    if units - {"metre", "meter", "m"}:
        raise CRSError(
            f"coordinates are in {', '.join(sorted(units))} ({crs.name})",
            where=where,
            fix="reproject to a CRS in metres and rerun",
        )
    return crs


def is_true_to_scale(crs: CRS, lon: ArrayLike, lat: ArrayLike, *, tolerance: float = _SCALE_TOLERANCE) -> bool:
    """Tell whether a metre of a projected CRS is a metre on the ground at positions, by default to two per thousand.

    Two per thousand is what a UTM zone shows half a zone beside its edge. Web Mercator fails away from the
    equator, where its metre is short by the cosine of the latitude.

    Examples
    --------
    >>> is_true_to_scale(CRS.from_epsg(32616), [-87.65], [41.87])
    True
    >>> is_true_to_scale(CRS.from_epsg(3857), [-87.65], [41.87])
    False
    """
    factors = Proj(crs).get_factors(np.asarray(lon, np.float64), np.asarray(lat, np.float64))
    scales = np.concatenate([np.ravel(factors.meridional_scale), np.ravel(factors.parallel_scale)])
    return bool((np.abs(scales - 1.0) <= tolerance).all())


def working_crs(
    source: CRS, x: ArrayLike, y: ArrayLike, *, target_crs: Any = None, own: bool = False, where: object = None
) -> CRS:
    """Return the metric CRS to work in, for data at some positions in another CRS.

    Parameters
    ----------
    source
        CRS of the positions.
    x, y
        Positions; the extremes are enough.
    target_crs
        What the user wants; it must be true to scale to a hundredth where the data lies.
    own
        Whether a graph of ours comes back: it keeps the CRS in which it was made.
    where
        The file, for messages.

    Returns
    -------
    CRS
        The wanted one; else the data's own if it is in metres and true to scale; else a local one.

    Raises
    ------
    CRSError
        If the wanted CRS is not metric or not true to scale, if the data's own is in other units, or if its positions
        are nowhere on Earth.

    Examples
    --------
    >>> mercator = CRS.from_epsg(3857)
    >>> working_crs(mercator, [-9757000.0], [5142000.0]).to_epsg()
    32616
    >>> working_crs(mercator, [-9757000.0], [5142000.0], target_crs=3857)
    Traceback (most recent call last):
        ...
    probe2road.errors.CRSError: a metre of WGS 84 / Pseudo-Mercator is no metre on the ground here; name another, ...
    """
    try:
        lon, lat = (np.asarray(values, np.float64) for values in transform(x, y, source, WGS84))
        placed = np.isfinite(lon) & np.isfinite(lat) & (np.abs(lat) <= 90.0)
    except ProjError as error:
        raise CRSError(
            f"coordinates in {source.name} lie nowhere on Earth", where=where, fix="check the CRS"
        ) from error
    if lon.size and not placed.all():
        fix = "check the CRS and the order of the coordinates"
        raise CRSError(f"coordinates lie outside of {source.name}", where=where, fix=fix)
    if target_crs is not None:
        target = require_metric(parse_crs(target_crs, where=where), where=where)
        if not own and lon.size and not is_true_to_scale(target, lon, lat, tolerance=_WANTED_TOLERANCE):
            fix = f'name another, for example target_crs="{crs_to_text(local_crs(lon, lat))}", or none'
            raise CRSError(f"a metre of {target.name} is no metre on the ground here", where=where, fix=fix)
        return target
    if source.is_geographic:
        return local_crs(lon, lat)
    require_metric(source, where=where)
    if own or not lon.size or is_true_to_scale(source, lon, lat):
        return source
    local = local_crs(lon, lat)
    logger.info("%s: a metre of %s is no metre on the ground here: projected to %s", where, source.name, local.name)
    return local


def same_crs(first: CRS, second: CRS) -> bool:
    """Tell whether coordinates in x, y order mean the same in both CRS; axis order and heights are ignored.

    Examples
    --------
    >>> same_crs(parse_crs("OGC:CRS84"), WGS84), same_crs(parse_crs("EPSG:4979"), WGS84)
    (True, True)
    >>> same_crs(parse_crs("EPSG:4258"), WGS84)
    False
    """
    return bool(first == second or first.to_2d().equals(second.to_2d(), ignore_axis_order=True))


def require_same_crs(
    first: CRS, second: CRS, *, where: str, what: tuple[str, str] = ("the traces are", "the graph is")
) -> None:
    """Refuse data in two different CRS.

    Parameters
    ----------
    first, second
        The two CRS, compared as `same_crs` does.
    where
        Who asks, for the message.
    what
        What has the one and what the other, with its verb.

    Raises
    ------
    CRSError
        If coordinates do not mean the same in both.

    Examples
    --------
    >>> require_same_crs(CRS.from_epsg(32616), CRS.from_epsg(32617), where="match")
    Traceback (most recent call last):
        ...
    probe2road.errors.CRSError: match: two CRS that differ: the traces are in WGS 84 / UTM zone 16N, the graph is in WGS
    84 / UTM zone 17N; reproject one of them, for example with to_crs
    """
    if not same_crs(first, second):
        fault = f"two CRS that differ: {what[0]} in {first.name}, {what[1]} in {second.name}"
        raise CRSError(fault, where=where, fix="reproject one of them, for example with to_crs")


def transform(x: ArrayLike, y: ArrayLike, source: CRS, target: CRS) -> tuple[Any, Any]:
    """Transform coordinates, always in the order x (east, lon), y (north, lat).

    Equal CRS return the input arrays unchanged. Points that cannot be projected come back as infinity.

    Examples
    --------
    >>> x, y = transform([9.0], [0.0], WGS84, CRS.from_epsg(32632))
    >>> float(round(x[0], 3)), float(round(y[0], 3))
    (500000.0, 0.0)
    """
    if source == target:
        return x, y
    return Transformer.from_crs(source, target, always_xy=True).transform(x, y)


def extent_in_degrees(bounds: tuple[float, float, float, float], crs: CRS) -> str:
    """Return the position of a box (left, bottom, right, top) in degrees, as text for a message.

    Examples
    --------
    >>> extent_in_degrees((446000, 4636000, 447000, 4637000), CRS.from_epsg(32616))
    '-87.6508..-87.6387 E, 41.8741..41.8832 N'
    """
    left, bottom, right, top = bounds
    lon, lat = transform(np.array([left, right, left, right]), np.array([bottom, bottom, top, top]), crs, WGS84)
    return f"{min(lon):.4f}..{max(lon):.4f} E, {min(lat):.4f}..{max(lat):.4f} N"


class Placed(Protocol):
    """What lies somewhere: a fleet, or a road graph."""

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, bottom, right, top; NaN where there is nothing."""

    @property
    def crs(self) -> CRS:
        """The CRS of the bounds."""


def extents_apart(first: Placed, second: Placed) -> tuple[str, str] | None:
    """Say in degrees where two data sets lie that have nothing in common; None where they meet, or one is empty.

    Data sets meet where no more than a kilometre lies between their boxes.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> here, near, away = (graph_from_lines([[(x, 4e6), (x + 9, 4e6)]], crs="EPSG:32616") for x in (0, 99, 5e5))
    >>> extents_apart(here, near)
    >>> extents_apart(here, away)
    ('-92.5357..-92.5356 E, 36.0417..36.0417 N', '-87.0000..-86.9999 E, 36.1447..36.1447 N')
    """
    if not np.isfinite([first.bounds, second.bounds]).all():
        return None
    left, bottom, right, top = second.bounds
    x, y = transform(np.array([left, left, right, right]), np.array([bottom, top, bottom, top]), second.crs, first.crs)
    west, south, east, north = first.bounds
    aside = np.max([west - x.max(), x.min() - east, south - y.max(), y.min() - north])
    if aside <= _NEAR:  # corners that cannot be projected are far away
        return None
    return extent_in_degrees(first.bounds, first.crs), extent_in_degrees(second.bounds, second.crs)


def turn_headings(heading: ArrayLike, x: ArrayLike, y: ArrayLike, source: CRS, target: CRS) -> NDArray[np.float64]:
    """Convert headings relative to the north of one CRS to that of another, which may differ by some degrees.

    Parameters
    ----------
    heading
        Degrees clockwise from the direction in which y grows in the source CRS; true north for longitude and latitude.
    x, y
        Where they were taken, in the source CRS.
    source, target
        The CRS.

    Returns
    -------
    ndarray of float64
        Degrees in [0, 360), clockwise from the direction in which y grows in the target CRS; NaN where it was.

    Examples
    --------
    In the east of a UTM zone, the meridians lean to the left of its grid:

    >>> turn_headings([0.0, 90.0], [11.9, 11.9], [50.0, 50.0], WGS84, CRS.from_epsg(32632)).round(1)
    array([357.8,  87.8])
    """
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    north = y + (_NORTH_DEGREES if source.is_geographic else _NORTH_METRES)
    here, there = (np.stack(transform(x, place, source, target)) for place in (y, north))
    east, up = there - here
    return np.asarray((np.asarray(heading, np.float64) + np.degrees(np.arctan2(east, up))) % 360.0)


def _degree_extent(lon: ArrayLike, lat: ArrayLike) -> tuple[float, float, float, float]:
    """Return west, south, east, north of the finite positions; east may exceed 180 across the antimeridian."""
    lons, lats = np.asarray(lon, np.float64).ravel(), np.asarray(lat, np.float64).ravel()
    finite = np.isfinite(lons) & np.isfinite(lats)
    lons, lats = lons[finite], lats[finite]
    if lons.size == 0:
        raise CRSError("no position to choose a local CRS from", fix="check that the data is not empty")
    if np.abs(lats).max() > 90:
        raise CRSError(f"latitude {lats[np.abs(lats).argmax()]:.6g} exceeds 90 degrees", fix="check the column order")
    # Longitudes relative to one of them, in [-180, 180), so that 179 and -179 are two degrees apart.
    relative = (lons - lons[0] + 180.0) % 360.0 - 180.0
    west, east = lons[0] + relative.min(), lons[0] + relative.max()
    return float(west), float(lats.min()), float(east), float(lats.max())


def _wrap(lon: float) -> float:
    """Return a longitude wrapped to [-180, 180)."""
    return float((lon + 180.0) % 360.0 - 180.0)


def _named_crs(proj: str, name: str) -> CRS:
    """Return a WGS84 projected CRS in metres with a name (PROJ strings have none)."""
    definition = CRS.from_user_input(f"{proj} +datum=WGS84 +units=m +no_defs +type=crs").to_json_dict()
    definition["name"] = name
    return CRS.from_json_dict(definition)


def crs_to_text(crs: CRS) -> str:
    """Return the shortest text from which `probe2road.crs.parse_crs` makes an equal CRS.

    Examples
    --------
    >>> crs_to_text(CRS.from_epsg(32616))
    'EPSG:32616'
    """
    authority = crs.to_authority()
    if authority is not None and CRS.from_authority(*authority) == crs:
        return ":".join(authority)
    return crs.to_json()


def crs_title(crs: CRS) -> str:
    """Return the name of a CRS for people, or a description if it has no name.

    Examples
    --------
    >>> crs_title(CRS("EPSG:32616"))
    'WGS 84 / UTM zone 16N'
    >>> crs_title(CRS("+proj=tmerc +lat_0=48 +lon_0=12.25 +ellps=WGS84"))
    'Transverse Mercator around 48°, 12.25°'
    """
    name = crs.name.strip()
    if name.lower() not in ("", "unknown", "unnamed", "undefined", "undefined crs"):
        return name
    operation = crs.coordinate_operation
    if operation is None:
        return "coordinate reference system without a name"
    origin = {value.name: value.value for value in operation.params}
    places = [
        f"{value:g}°"
        for word in ("Latitude of", "Longitude of")
        for name, value in origin.items()
        if name.startswith(word)
    ]
    return operation.method_name + (f" around {', '.join(places[:2])}" if places else "")
