"""Which column of a file is which: the user's map, the usual names with or without a unit, the kinds of points.

Nothing here guesses silently. What is taken from a usual name is returned with the rest and logged by the
reader; where two columns would do, the reader asks.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np
import pandas as pd
from pyproj import CRS

from probe2road.errors import InputError, OptionError
from probe2road.fleet.columns import (
    POINT_COLUMNS,
    POINT_KINDS,
    POINT_OPTIONAL_COLUMNS,
    TRACE_COLUMNS,
    TRACE_OPTIONAL_COLUMNS,
)
from probe2road.io.formats import ColumnMap
from probe2road.io.units import normal, unit_of, without_unit

__all__ = [
    "KIND_SYNONYMS",
    "USUAL_NAMES",
    "ColumnChoice",
    "choose_columns",
    "standard_kinds",
]

# Usual names per column of ours, in lower case with separators removed. Names before None are specific; those
# behind it are so common for other things that they count only where no specific name is there.
USUAL_NAMES: dict[str, tuple[str | None, ...]] = {
    "trace_id": (
        *("traceid", "trip", "tripid", "drive", "driveid", "track", "trackid", "journey", "journeyid", "trace"),
        *("traj", "trajid", "trajectory", "trajectoryid", "rideid", "sessionid", "routeid", "trjid", "tripno"),
        *("tripnumber", "tripcode", "orderid", "activityid", "probeid", "runid", None, "id", "trackfid"),
    ),
    "t": (
        *("t", "timestamp", "time", "ts", "datetime", "gpstime", "gpstimestamp", "timestamputc", "timeutc", "utc"),
        *("epoch", "unixtime", "eventtime", "tstamp", "datetimeutc", "unixtimestamp", "epochtime", "posixtime"),
        *("utctime", "utcdatetime", "gpsdatetime", "trackedat", "recordedat", "measuredat", "observedat", "sampledat"),
        *("capturedat", "reportedat", "loggedat", "fixtime", "loctime", "locationtime", "positiontime", "recordtime"),
        *("recordedtime", "recorded", "pingtimestamp", "pingtime", "sampledate", "sampletime", "utctimestamp"),
        *("timeofday", "logtime", "loggedtime", "recordedon", "recordtimestamp", "positiontimestamp", "isotime"),
        *("hhmmss", "clock", "uhrzeit", "zeit", "zeitstempel", "hora", "fechahora", "dateandtime", "timestring"),
        *("datetimestring", "dateutctime", "eventtimestamp", "locationtimestamp"),
        *(None, "devicetime", "createdat", "servertime", "receivedat", "localtime", "localdatetime", "starttime"),
        *("startdatetime", "pickupdatetime", None, "date", "gpsdate", "utcdate"),
    ),
    "z": ("z", "alt", "altitude", "ele", "elevation", "elev", "gpsaltitude", "gpsalt", None, "height"),
    "vehicle_id": (
        *("vehicleid", "vehicle", "veh", "vehid", "vin", "deviceid", "taxiid", "taxi", "busid", "bus", "cabid"),
        *("truckid", "userid", "user", "driverid", "imei", "unitid", "agentid", "devid", "assetid", "carid"),
        *("cab", "car"),
        *("licenseplate", "licenceplate", "plate", "vehiclename", "devicename", "terminalid", "driver", "truck"),
        *(None, "device", "uid", "participant"),
    ),
    "heading": (
        *("heading", "bearing", "course", "azimuth", "gpsheading", "gpsbearing", "gpscourse", "courseoverground"),
        *("cog", "trueheading"),
    ),
    "speed": (
        *("speed", "velocity", "gpsspeed", "groundspeed", "speedoverground", "sog", "gpsvelocity", "vehiclespeed"),
        *("velocitysmooth",),
    ),
    "accuracy": ("accuracy", "horizontalaccuracy", "haccuracy", "hacc", "gpsaccuracy", "positionaccuracy"),
    "kind": ("kind", "class", "classname", "featuretype", "objecttype", None, "label", "type", "category"),
}
_NOT_ASKED = ("vehicle_id", "heading", "speed", "accuracy")
_LON_LAT = (
    (
        *("lon", "lng", "long", "longitude", "gpslon", "gpslng", "gpslong", "gpslongitude", "rawlng", "rawlon"),
        *("locationlon", "locationlng", "locationlong", "locationlongitude", "decimallongitude", "wgs84lon"),
        *("lonwgs84"),
        *("coordslongitude", "longitud", "laengengrad", "längengrad"),
    ),
    (
        *("lat", "latitude", "gpslat", "gpslatitude", "rawlat", "locationlat", "locationlatitude", "decimallatitude"),
        *("wgs84lat", "latwgs84", "coordslatitude", "lati", "latitud", "breitengrad"),
    ),
)
_PROJECTED = (("x", "easting", "east", "utmx", "utmeasting"), ("y", "northing", "north", "utmy", "utmnorthing"))
_GEOMETRY = (
    *("geometry", "geom", "wkbgeometry", "position", "polyline", "wkt", "thegeom", "linestring", "coordinates"),
    *("wktgeom", "geomwkt", "geometrywkt", "shape"),
)
# Columns that complete one of ours: the date of a time of day, and the hemisphere of degrees without sign.
_BESIDE = {
    "t": ("date", "gpsdate", "utcdate", "dateutc", "localdate", "datestamp", "recorddate", "tripdate", "datum", "day"),
    "x": (
        *("ew", "ewindicator", "eastwest", "eorw", "londir", "lonew", "longitudeew", "longitudedir", "lonref"),
        *("longituderef", "lonhemisphere", "longitudehemisphere", "longitudedirection", "londirection", "lonhemi"),
    ),
    "y": (
        *("ns", "nsindicator", "northsouth", "nors", "latdir", "latns", "latitudens", "latitudedir", "latref"),
        *("latituderef", "lathemisphere", "latitudehemisphere", "latitudedirection", "latdirection", "lathemi"),
    ),
}

# What else the two kinds of semantic points are called, in lower case with separators removed.
KIND_SYNONYMS: dict[str, tuple[str, ...]] = {
    "lane_marking": (
        *("lanemarking", "lanemarkings", "lanemarker", "lanemark", "marking", "markings", "laneline", "lane"),
        *("roadmarking", "lanedivider", "divider", "1"),
    ),
    "road_boundary": (
        *("roadboundary", "roadboundaries", "boundary", "boundaries", "roadedge", "edge", "kerb", "curb"),
        *("roadborder", "border", "guardrail", "barrier", "2"),
    ),
}


@dataclass(frozen=True)
class ColumnChoice:
    """The columns to read from one file."""

    columns: dict[str, str]  # our name -> the file's; "geometry" stands for x, y and z in one column
    guessed: tuple[str, ...]  # our names that were found under another, usual name
    degrees: bool  # the coordinates are longitude and latitude by name
    by_name: tuple[str, ...] = ()  # our names that the user did not give, whatever they are called in the file
    units: Mapping[str, str] = field(default_factory=dict)  # our names to the units in the file's names
    beside: Mapping[str, str] = field(default_factory=dict)  # t to a column of dates, x and y to their hemispheres

    @property
    def wanted(self) -> list[str]:
        """The file's columns to read, each once."""
        return list(dict.fromkeys([*self.columns.values(), *self.beside.values()]))


def choose_columns(
    there: Sequence[str],
    given: ColumnMap | None = None,
    *,
    points: bool = False,
    geometry: str | None = None,
    crs: CRS | None = None,
    where: object = None,
) -> ColumnChoice:
    """Decide which columns of a file to read as ours.

    Parameters
    ----------
    there
        Column names of the file.
    given
        Our name to the file's, as the user said; an empty name means that the file has no such column, and
        ``date+time`` that the times stand in two.
    points
        Whether the file holds semantic points rather than traces.
    geometry
        Name of the file's point geometry column, which is preferred to guessed coordinates.
    crs
        CRS the user gave: where a file has both degrees and metres, it says which are meant.
    where
        The file, for messages.

    Returns
    -------
    ColumnChoice
        Columns that were neither given nor found are absent: traces may lack all but the position.

    Raises
    ------
    InputError
        If a given column is not there, if several columns have a usual name of the same one of ours, or if
        none has one that is needed.
    OptionError
        If a given name is none of ours.

    Examples
    --------
    >>> choose_columns(["Trip_ID", "time", "lat", "lon", "temperature"]).columns
    {'trace_id': 'Trip_ID', 't': 'time', 'x': 'lon', 'y': 'lat'}
    >>> choose_columns(["a", "b", "c"], {"trace_id": "a", "x": "b", "y": "c"}).guessed
    ()
    >>> choose_columns(["trip", "ts", "time", "x", "y"], where="drives.csv")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: drives.csv: column 't' could be ts, time; say which, for example columns={"t": "ts"}
    """
    ours = (*POINT_COLUMNS, *POINT_OPTIONAL_COLUMNS) if points else (*TRACE_COLUMNS, *TRACE_OPTIONAL_COLUMNS)
    there = list(dict.fromkeys(there))
    given, dates = _split_times(there, given or {})
    named = _given_columns(there, given, (*ours, "geometry"), where)
    left_out = {name for name, theirs in named.items() if not theirs}
    chosen = {name: theirs for name, theirs in named.items() if theirs}
    argument = "point_columns" if points else "columns"
    faults: list[str] = []
    position, degrees = _position_columns(there, chosen, geometry, crs, argument, faults)
    chosen |= position
    in_geometry = {"x", "y", "z"} if "geometry" in position else set()
    wanted = [name for name in ours if name not in left_out | in_geometry]
    chosen |= _usual_columns(wanted, there, chosen, argument, faults)
    needed = {"x", "y", "trace_id", "kind"} if points else {"x", "y"}
    faults += _missing_faults([name for name in ours if name in needed - in_geometry - set(chosen)], there, argument)
    if faults:
        raise InputError.from_faults(faults, where=where)
    ordered = {name: chosen[name] for name in (*ours, "geometry") if name in chosen}
    guessed = tuple(name for name, theirs in ordered.items() if name not in named and name != theirs)
    by_name = tuple(name for name in ordered if name not in named)
    units = {name: unit_of(theirs, name, _names(name)) for name, theirs in ordered.items()}
    known = {name: unit for name, unit in units.items() if unit is not None}
    return ColumnChoice(ordered, guessed, degrees, by_name, known, dates or _columns_beside(ordered, there, degrees))


def standard_kinds(values: pd.Series) -> pd.Series:
    """Replace what else the kinds of semantic points are called; other values stay as they are.

    Examples
    --------
    >>> standard_kinds(pd.Series(["Lane Line", "kerb", "tree"])).tolist()
    ['lane_marking', 'road_boundary', 'tree']
    """
    known = {synonym: kind for kind, synonyms in KIND_SYNONYMS.items() for synonym in synonyms}
    codes, found = pd.factorize(values, use_na_sentinel=False)
    standard = [kind if kind in POINT_KINDS else known.get(without_unit(str(kind), "kind"), kind) for kind in found]
    return pd.Series(np.array(standard, object)[codes], name=values.name)


def _split_times(there: Sequence[str], given: ColumnMap) -> tuple[ColumnMap, dict[str, str]]:
    """Take a column of dates out of ``date+time``, unless a column is called so."""
    theirs = given.get("t")
    if not isinstance(theirs, str) or theirs in there or "+" not in theirs:
        return given, {}
    dates, _, times = theirs.partition("+")
    if dates not in there:
        return given, {}
    return {**given, "t": times}, {"t": dates}


def _columns_beside(chosen: Mapping[str, str], there: Sequence[str], degrees: bool) -> dict[str, str]:
    """Find the columns that complete others: dates for times, hemispheres for degrees."""
    found: dict[str, str] = {}
    for ours, names in _BESIDE.items():
        if ours in chosen and (degrees or ours == "t"):
            free = [column for column in there if column not in chosen.values() and normal(column) in names]
            found |= {ours: free[0]} if free else {}
    return found


def _given_columns(there: Sequence[str], given: ColumnMap, ours: Sequence[str], where: object) -> dict[str, str]:
    """Check the user's column map against our names and the file's."""
    unknown = [name for name in given if name not in ours]
    if unknown:
        raise OptionError(f"columns names {', '.join(unknown)}", fix=f"the names are {', '.join(ours)}")
    named = {name: "" if theirs is None else str(theirs) for name, theirs in given.items()}
    missing = [f"{theirs!r} ({name})" for name, theirs in named.items() if theirs and theirs not in there]
    if missing:
        raise InputError(
            f"there is no column {', '.join(missing)}", where=where, fix=f"the columns are {', '.join(there)}"
        )
    return named


def _position_columns(
    there: Sequence[str],
    chosen: Mapping[str, str],
    geometry: str | None,
    crs: CRS | None,
    argument: str,
    faults: list[str],
) -> tuple[dict[str, str], bool]:
    """Find the coordinates: given ones, then the geometry column, then lon and lat, then x and y."""
    if "geometry" in chosen:
        return {"geometry": chosen["geometry"]}, False
    if "x" in chosen and "y" in chosen:
        by_name = [_matching([chosen[axis]], axis, names) for axis, names in zip("xy", _LON_LAT, strict=True)]
        return {"x": chosen["x"], "y": chosen["y"]}, all(by_name)
    if geometry is not None and "x" not in chosen and "y" not in chosen:
        return {"geometry": geometry}, False
    degrees_first = crs is None or crs.is_geographic
    partial: dict[str, str] = {}
    for names in (_LON_LAT, _PROJECTED) if degrees_first else (_PROJECTED, _LON_LAT):
        found = {
            axis: [chosen[axis]] if axis in chosen else _matching(there, axis, usual)
            for axis, usual in zip("xy", names, strict=True)
        }
        pair = {axis: columns[0] for axis, columns in found.items() if columns}
        if len(pair) == 2:
            faults += [_ambiguous(axis, columns, argument) for axis, columns in found.items() if len(columns) > 1]
            return pair, names is _LON_LAT
        partial = partial or pair
    geometries = _matching(there, "geometry", _GEOMETRY)
    return ({"geometry": geometries[0]} if len(geometries) == 1 else partial), False


def _usual_columns(
    wanted: Sequence[str], there: Sequence[str], taken: Mapping[str, str], argument: str, faults: list[str]
) -> dict[str, str]:
    """Find those of our columns that are not taken by their usual names; a column of the file serves once."""
    found: dict[str, str] = {}
    for name in wanted:
        if name in USUAL_NAMES and name not in taken:
            theirs = _usual(name, there, argument, faults)
            if theirs is not None and theirs not in {*taken.values(), *found.values()}:
                found[name] = theirs
    return found


def _usual(name: str, there: Sequence[str], argument: str, faults: list[str]) -> str | None:
    """Find the one column with a usual name of ours, or say that there are several."""
    if name in there:
        return name
    names = USUAL_NAMES[name]
    tiers = [list(tier) for is_name, tier in groupby(names, lambda usual: usual is not None) if is_name]
    found: list[str] = next(filter(None, (_matching(there, name, tier) for tier in tiers)), [])
    if len(found) > 1 and name in _NOT_ASKED:  # nobody is asked for what may be absent: the likelier name is taken
        return min(found, key=lambda column: names.index(without_unit(column, name, _names(name))))
    if len(found) > 1:
        faults.append(_ambiguous(name, found, argument))
    return found[0] if found else None


def _missing_faults(missing: Collection[str], there: Sequence[str], argument: str) -> list[str]:
    """Name the columns that are needed and were neither given nor found; no fault where none is missing."""
    if not missing:
        return []
    example = f"{argument}={json.dumps(dict.fromkeys(missing, 'NAME'))}"
    names = f"no column for {', '.join(missing)} (the columns are {', '.join(there)})"
    return [f"{names}; say which, for example {example}"]


def _matching(there: Sequence[str], ours: str, names: Collection[str | None]) -> list[str]:
    """Return the columns with one of the names: those without a unit, or all others where there is none."""
    usual = [name for name in names if name is not None]
    found = [column for column in there if without_unit(column, ours, usual) in usual]
    return [column for column in found if normal(column) in usual] or found


def _names(ours: str) -> list[str]:
    """Return all usual names of one of our columns, to which a unit may be glued."""
    axes = {axis: (*_LON_LAT[number], *_PROJECTED[number]) for number, axis in enumerate("xy")}
    return [name for name in (*USUAL_NAMES.get(ours, ()), *axes.get(ours, ())) if name is not None]


def _ambiguous(name: str, found: Sequence[str], argument: str) -> str:
    example = f"{argument}={json.dumps({name: found[0]}, ensure_ascii=False)}"
    return f"column {name!r} could be {', '.join(found)}; say which, for example {example}"
