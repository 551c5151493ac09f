"""The unit in which a column is measured, as its header says it.

A header names a unit in brackets (``speed [km/h]``), or behind its name (``speed_kmh``, ``speedKmh``). One table says
for each of our columns which units there are; what is found is converted to ours and logged, and what is unknown is
warned of, never taken for ours in silence.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Mapping

import numpy as np
import pandas as pd

__all__ = ["UNITS", "in_our_unit", "normal", "unit_of", "without_unit"]

logger = logging.getLogger(__name__)


def _spelled(factors: Mapping[float, str]) -> dict[str, float]:
    return {word: factor for factor, words in factors.items() for word in words.split()}


_LENGTHS = _spelled(
    {
        1.0: "m meter meters metre metres mtr",
        0.3048: "ft feet foot",
        1e-2: "cm centimeters centimetres",
        1e-3: "mm millimeters millimetres",
        1e3: "km kilometers kilometres",
    }
)
_DEGREES = {1.0: "deg degree degrees decimaldegrees dd"}
_RADIANS = {math.degrees(1.0): "rad radian radians"}

# Unit, in lower case with letters and digits only, to what it is in ours: m/s, degrees, m, s.
UNITS: Mapping[str, Mapping[str, float]] = {
    "speed": _spelled(
        {
            1.0: "ms mps msec msecond meterssecond meterspersecond metressecond metrespersecond mperssecond ms1 mpers",
            1 / 3.6: "kmh kmhr kph kmph kmperh kmperhour kilometershour kilometersperhour kilometresperhour",
            0.44704: "mph mih mihr miph milesperhour mileshour",
            1852 / 3600: "kn kt kts knt knot knots",
            0.3048: "fps fts ftps feetpersecond feetsecond",
            0.01: "cms cmps centimeterspersecond",
            0.001: "mms mmps millimeterspersecond",
        }
    ),
    "heading": _spelled(
        {
            **_DEGREES,
            **_RADIANS,
            0.01: "cdeg centidegrees",
            0.001: "mdeg millidegrees",
        }
    ),
    "x": _spelled({1.0: "deg degree degrees decimaldegrees dd m", **_RADIANS, 1e-7: "e7 1e7 1e7deg", 1e-6: "e6 1e6"}),
    "z": _LENGTHS,
    "accuracy": _LENGTHS,
    "t": _spelled(
        {
            1.0: "s sec secs second seconds",
            1e-3: "ms msec millis millisec milliseconds",
            1e-6: "us µs μs usec micros microseconds",
            1e-9: "ns nsec nanos nanoseconds",
        }
    ),
}
UNITS = {**UNITS, "y": UNITS["x"]}

_LAST_BRACKETS = re.compile(r"[\[({]([^\[\](){}]*)[\])}]\s*$")
_MEASUREMENT = re.compile(r"^\s*(?P<number>[+-]?\d+(?:[.,]\d+)?)\s*(?P<unit>[^\s\d.,].*?)\s*$")
_NO_UNITS = ("wgs84", "epsg4326", "utc", "gmt", "gps", "iso8601", "truenorth", "msl", "raw", "filtered")


def normal(text: str) -> str:
    """Bring a name to lower case, letters and digits only.

    Examples
    --------
    >>> normal("GPS Speed (km/h)")
    'gpsspeedkmh'
    """
    return "".join(letter for letter in text.lower() if letter.isalnum())


def unit_of(header: str, ours: str, names: Collection[str] = ()) -> str | None:
    """Return the unit that the header of a column names, None where it names none that we know.

    Parameters
    ----------
    header
        The file's name of the column.
    ours
        Our name of it, which says what is measured.
    names
        Usual names of such columns, to which a unit may be glued: ``speedkmh``.

    Examples
    --------
    >>> [unit_of(header, "speed", ["speed"]) for header in ("Speed [km/h]", "speed_mph", "v (kn)", "speedkmh", "rpms")]
    ['kmh', 'mph', 'kn', 'kmh', None]
    >>> unit_of("latitudeE7", "y"), unit_of("speed", "speed"), unit_of("speed (smooth)", "speed")
    ('e7', None, None)
    """
    units = UNITS.get(ours, {})
    if brackets := _LAST_BRACKETS.search(header):
        inside = normal(re.sub(r"\s+per\s+", "/", brackets[1]))
        return inside if inside in units else None
    words = re.split(r"[^a-z0-9µμ]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", header).lower())
    tails = ("".join(words[start:]) for start in range(1, len(words)))  # the longest first: "km h" before "h"
    glued = (normal(header).removeprefix(name) for name in names if normal(header).startswith(name))
    return next((tail for tail in (*tails, *glued) if tail in units), None)


def without_unit(header: str, ours: str, names: Collection[str] = ()) -> str:
    """Return the normal name of a column without its unit, or without any brackets at its end.

    Examples
    --------
    >>> without_unit("Speed [km/h]", "speed"), without_unit("alt_ft", "z"), without_unit("Position (WGS84)", "x")
    ('speed', 'alt', 'position')
    """
    bare = normal(_LAST_BRACKETS.sub("", header) or header)
    unit = None if _LAST_BRACKETS.search(header) else unit_of(header, ours, names)
    return bare.removesuffix(unit) or bare if unit else bare


def in_our_unit(
    values: pd.Series, ours: str, header: str, unit: str | None, *, where: object = None
) -> tuple[pd.Series, str]:
    """Convert a column of measurements to our unit.

    Parameters
    ----------
    values
        Numbers, or words of a number and its unit (``23.5 kn``); other cells stay as they are.
    ours, header
        Our name of the column, and the file's.
    unit
        What `unit_of` says of the header.
    where
        The file, for messages.

    Returns
    -------
    (Series, str)
        The column in m/s, degrees or m, and the unit that it was in; an empty text where that was ours, or is unknown.

    Examples
    --------
    >>> in_our_unit(pd.Series([36, 72]), "speed", "speed_kmh", "kmh")
    (0    10.0
    1    20.0
    dtype: float64, 'kmh')
    >>> in_our_unit(pd.Series([36, 72]), "speed", "speed", None)[0].tolist()
    [36, 72]
    >>> in_our_unit(pd.Series(["36 km/h", "10 m/s", "?"]), "speed", "speed", None)
    (0    10.0
    1    10.0
    2       ?
    dtype: object, 'kmh, ms')
    """
    units = UNITS[ours]
    if unit is None:
        stated = _LAST_BRACKETS.search(header)
        if stated and normal(stated[1]) and normal(stated[1]) not in (*units, *_NO_UNITS):
            logger.warning(
                "%s: the unit of column %r (%s) is not known: the numbers count as they are", where, header, ours
            )
        return _cells_in_our_unit(values, units)
    if units[unit] == 1.0:
        return values, ""
    numbers = pd.to_numeric(values, errors="coerce")
    unreadable = (numbers.isna() & values.notna()).to_numpy(bool)
    if unreadable.all():
        return values, ""
    scaled = (numbers * units[unit]).astype(np.float64)
    return (scaled.astype(object).mask(unreadable, values) if unreadable.any() else scaled), unit


def _cells_in_our_unit(values: pd.Series, units: Mapping[str, float]) -> tuple[pd.Series, str]:
    """Convert the cells that name their unit behind their number."""
    if pd.api.types.is_numeric_dtype(values.dtype):
        return values, ""
    parts = values.astype("str").str.extract(_MEASUREMENT)
    unit = parts["unit"].str.replace("°", "deg").map(normal, na_action="ignore")
    known = unit.isin(list(units)).to_numpy()
    if not known.any():
        return values, ""
    numbers = pd.to_numeric(parts["number"].str.replace(",", "."), errors="coerce") * unit.map(units)
    converted = values.astype(object).mask(known, numbers)
    return converted if not known.all() else numbers.astype(np.float64), ", ".join(sorted(set(unit[known])))
