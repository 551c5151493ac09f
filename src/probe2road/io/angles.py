"""Longitudes and latitudes however they are written: E7 integers, radians, hemispheres, degrees and minutes.

Plain degrees, the usual case, pass untouched. Everything else is told by its header or by what can be nothing else,
converted, and logged by the reader.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pandas as pd

from probe2road.io.units import UNITS

__all__ = ["degrees_and_minutes", "degrees_of_column", "hidden_unit"]

_LIMIT = {"x": 180.0, "y": 90.0}
_NEGATIVE = ("S", "W")
_MOSTLY = 0.9  # of the cells of a column, which is written in a way if so many are
_NUMBER = r"\d+(?:[.,]\d+)?"
_ANGLE = re.compile(
    rf"^(?P<before>[NSEW])?\s*(?P<sign>[+-])?\s*(?P<degrees>{_NUMBER})\s*[°ºd:]?"
    rf"(?:(?<=[\s°ºd:])\s*(?P<minutes>{_NUMBER})\s*['\u2032\u2019m:]?"
    rf"(?:(?<=[\s'\u2032\u2019m:])\s*(?P<seconds>{_NUMBER})\s*(?:\"|\u2033|'')?)?)?\s*(?P<behind>[NSEW])?$"
)


def degrees_of_column(
    values: pd.Series, axis: str, unit: str | None = None, hemispheres: pd.Series | None = None
) -> tuple[pd.Series, str]:
    r"""Return a column of longitudes or latitudes in degrees, and how they were written where that is worth telling.

    Parameters
    ----------
    values
        Numbers or text; as it is where it holds plain degrees, or cannot be read.
    axis
        ``"x"`` for longitudes, ``"y"`` for latitudes.
    unit
        That the header names: radians, or integers of 1e-7 or 1e-6 degrees.
    hemispheres
        N and S, or E and W, beside the column; they also allow 4807.038, degrees and minutes as receivers write them.

    Returns
    -------
    (Series, str)
        Degrees, south and west negative, and a word for the notation.

    Examples
    --------
    >>> degrees_of_column(pd.Series(["48.1S", "48°30'0\"N"]), "y")
    (0   -48.1
    1    48.5
    dtype: float64, 'degrees with N, S, E or W')
    >>> degrees_of_column(pd.Series([115750000]), "x", "e7")[0].tolist()
    [11.575]
    >>> degrees_of_column(pd.Series([1131.5]), "x", hemispheres=pd.Series(["W"]))[0].tolist()
    [-11.525]
    """
    told = ""
    if not pd.api.types.is_numeric_dtype(values.dtype) and (read := _from_text(values)) is not None:
        values, told = read
    if pd.api.types.is_numeric_dtype(values.dtype):
        values, scaled = _scaled(values, axis, unit, minutes=hemispheres is not None)
        told = scaled or told
        if hemispheres is not None:
            negative = hemispheres.astype("str").str.strip().str.upper().str[:1].isin(_NEGATIVE).to_numpy(bool)
            values, told = values.abs().where(~negative, -values.abs()), told or "degrees with hemispheres"
    return values, told


def degrees_and_minutes(values: pd.Series) -> pd.Series:
    """Return numbers such as 4807.038, 48 degrees and 7.038 minutes as receivers write them, in degrees.

    Examples
    --------
    >>> degrees_and_minutes(pd.Series([4830.0, -1131.5])).tolist()
    [48.5, -11.525]
    """
    size = values.abs()
    return np.sign(values) * (size // 100 + size % 100 / 60)


def hidden_unit(lon: pd.Series, lat: pd.Series) -> str | None:
    """Return ``"e7"`` for integers that can be nothing but degrees times 1e7, though no header says so.

    Smaller ones may be degrees times 1e6 as well: None, so that they are refused as degrees.

    Examples
    --------
    >>> hidden_unit(pd.Series([115750000]), pd.Series([481370000]))
    'e7'
    >>> hidden_unit(pd.Series([11575000]), pd.Series([48137000])) is None
    True
    """
    sizes = []
    for values, axis in ((lon, "x"), (lat, "y")):
        if not pd.api.types.is_numeric_dtype(values.dtype) or not (values.dropna() % 1 == 0).all():
            return None
        sizes.append(values.abs().median() / _LIMIT[axis])
    return "e7" if 1e6 < max(sizes) <= 1e7 and min(sizes) > 1e3 else None


def _scaled(values: pd.Series, axis: str, unit: str | None, *, minutes: bool) -> tuple[pd.Series, str]:
    """Return numbers in degrees: by the unit of their header, or by a size that can be only one thing."""
    size = values.abs().max()
    limit = _LIMIT[axis]
    factor = 1.0 if unit is None else UNITS[axis][unit]
    if factor != 1.0:
        return values * factor, str(unit)
    if minutes and limit < size <= 100 * limit and (values.abs() % 100 < 60).all():
        return degrees_and_minutes(values), "degrees and minutes"
    return values, ""


def _from_text(values: pd.Series) -> tuple[pd.Series, str] | None:
    """Read text with hemispheres, or with degrees, minutes and seconds; None where it is neither."""
    words = values.astype("str").str.strip()
    if pd.to_numeric(words, errors="coerce").notna().mean() >= 1 - _MOSTLY:
        return None
    parts: Any = words.str.extract(_ANGLE)
    read = parts["degrees"].notna()
    if not len(words) or read.sum() < _MOSTLY * words.notna().sum():
        return None
    degrees, minute, second = (
        pd.to_numeric(parts[part].str.replace(",", ".")).fillna(0.0) for part in ("degrees", "minutes", "seconds")
    )
    letters = parts["before"].fillna(parts["behind"]).str.upper()
    negative = letters.isin(_NEGATIVE) | (parts["sign"] == "-")
    angle = (degrees + minute / 60 + second / 3600).where(read & (minute < 60) & (second < 60))
    told = "degrees with N, S, E or W" if letters.notna().any() else "degrees and minutes"
    if (parts["minutes"].isna() & letters.isna()).all():
        told = "decimal commas" if words.str.contains(",").any() else "degrees"
    return angle.where(~negative, -angle), told
