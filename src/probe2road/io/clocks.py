"""The times of a column: numbers since 1970, days of spreadsheets, times of day, and dates however they are written.

Strategy: numbers are told by their size. Text in ISO 8601 is left to the checks of the table. Any other text is tried
with the formats in which spreadsheets, loggers and databases write times, on the first cell, then on many: one format
that fits is taken and logged, and where two would do (is 03/04 in March or in April?) the user is asked.
"""

from __future__ import annotations

import itertools
import logging
import re
from datetime import datetime
from functools import cache

import numpy as np
import pandas as pd

from probe2road.errors import InputError
from probe2road.io.units import UNITS

__all__ = ["FIRST_YEAR", "LAST_YEAR", "day_numbers", "times_from_numbers", "times_of_column"]

logger = logging.getLogger(__name__)

FIRST_YEAR, LAST_YEAR = 1985, 2100  # that drives with a satellite receiver may be from
_DAY_STEP = 0.01  # days between fixes, at most; also seconds, which no receiver beats
_TRIED = 1000  # different cells that a format of times must fit
_MOSTLY = 0.9  # of the cells of a column of text, which are numbers if so many are
_NO_DATE = "1970-01-01"
_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
_SECONDS_OF_YEAR = 31556952

# How dates and times are written beside ISO 8601, for strptime.
_DATES = (
    *("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%Y%m%d", "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d/%m/%y"),
    *("%m/%d/%y", "%d-%m-%Y", "%m-%d-%Y", "%d-%b-%Y", "%d-%b-%y", "%d %b %Y", "%d %B %Y", "%b %d, %Y", "%B %d, %Y"),
    *("%d%m%Y", "%d%m%y", "%y%m%d", "%d/%b/%Y", "%b %d %Y"),
)
_TIMES = (
    *("%H:%M:%S", "%H:%M:%S.%f", "%H:%M", "%I:%M:%S %p", "%I:%M %p", "%I:%M:%S.%f %p", "%H:%M:%S%z", "%H:%M:%S %z"),
    *("%H:%M:%S.%f%z", "%H:%M:%S.%f %z", "%H%M%S", "%H%M%S.%f", "%H.%M.%S"),
)
_WRITTEN = (
    *_DATES,
    *(between.join(parts) for parts in itertools.product(_DATES, _TIMES) for between in (" ", "T", ", ")),
    *("%a %b %d %H:%M:%S GMT%z %Y", "%a %b %d %H:%M:%S %Y", "%a, %d %b %Y %H:%M:%S", "%a, %d %b %Y %H:%M:%S %z"),
    *("%H:%M:%S %d.%m.%Y", "%H:%M:%S %d/%m/%Y", "%H:%M:%S %m/%d/%Y", "%a %b %d %Y %H:%M:%S"),
)
_ZONE_WORD = r"(?<=\d)\s*(?:\+0000)?\s*(?:UTC|GMT)$"  # behind a time, says what naive times are anyway
_TIME_OF_DAY = r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d+)?)?\s*(?:[AaPp]\.?[Mm]\.?)?Z?"
_DIGITS_OF_DAY = r"(?:[01]?\d|2[0-3])[0-5]\d[0-5]\d(?:\.\d+)?"
_MIDNIGHT = r"[ T]0?0:00(?::00(?:\.0+)?)?$"  # that spreadsheets write behind a date


def times_of_column(
    values: pd.Series,
    name: str,
    *,
    unit: str | None = None,
    dates: pd.Series | None = None,
    time_format: str | None = None,
    where: object = None,
) -> tuple[pd.Series, str]:
    """Return the times of a column, and how they were written where that is worth telling.

    Parameters
    ----------
    values
        Numbers, text, or times.
    name
        The file's name of the column, for messages.
    unit
        Of numbers, that the header names: it counts where their size tells nothing, as in a clock that starts at 0.
    dates
        Dates beside times of day; without effect where the values have dates themselves.
    time_format
        How the times are written, for `datetime.datetime.strptime`; with dates, of both with a space between.
    where
        The file, for messages.

    Returns
    -------
    (Series, str)
        UTC times; text in ISO 8601, and what cannot be read, as it is.

    Raises
    ------
    InputError
        If the numbers look like days, no time has the format, or the day cannot be told from the month.

    Examples
    --------
    >>> times_of_column(pd.Series(["24.12.2024 08:00"]), "Zeit")
    (0   2024-12-24 08:00:00+00:00
    dtype: datetime64[...UTC], '%d.%m.%Y %H:%M')
    >>> times_of_column(pd.Series(["03/04/2024 08:00"]), "time", where="drives.csv")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: drives.csv: column 'time' (t) could be day/month ... time_format="%d/%m/%Y %H:%M" ...
    """
    if dates is not None or time_format is not None:
        values = _joined(values, dates, has_format=time_format is not None)
    if time_format is not None:
        return _by_the_users_format(values, name, time_format, where)
    if _holds_text(values):
        values = _numbers_in_text(values)
    if _holds_text(values):
        return _times_from_text(values, name, where)
    if day_numbers(values):
        first = values.dropna().iloc[0]
        fault = (
            f"column {name!r} (t) holds no seconds since 1970: {first:.12g} looks like a day number of a spreadsheet"
        )
        raise InputError(fault, where=where, fix="write times as ISO 8601, such as 2024-05-01T08:00:00Z")
    return times_from_numbers(values, unit)


def times_from_numbers(values: pd.Series, stated: str | None = None) -> tuple[pd.Series, str]:
    """Convert times in seconds, milliseconds, microseconds or nanoseconds since 1970, by their magnitude.

    Times before the year 5138 in one unit are smaller than those after 1973 in the next, so that the median
    decides; smaller numbers, such as seconds since midnight, count as seconds, or in the unit that the header states.

    Returns
    -------
    (Series, str)
        UTC times (NaT where the number is missing) and the unit found. A column of anything but numbers comes
        back as it is, without unit; numbers too large for a time come back in seconds, to be refused later.

    Examples
    --------
    >>> times, unit = times_from_numbers(pd.Series([1577836800000, 1577836800200]))
    >>> unit, str(times[1])
    ('ms', '2020-01-01 00:00:00.200000+00:00')
    """
    if (dates := _written_dates(values)) is not None:
        return dates
    if pd.api.types.is_bool_dtype(values.dtype) or not pd.api.types.is_numeric_dtype(values.dtype):
        return values, ""
    numbers = values.to_numpy(dtype=np.float64, na_value=np.nan)
    middle = float(np.nanmedian(np.abs(numbers))) if np.isfinite(numbers).any() else 0.0
    unit = "s" if middle < 1e11 else "ms" if middle < 1e14 else "us" if middle < 1e17 else "ns"
    if stated is not None and not FIRST_YEAR <= 1970 + middle / _PER_SECOND[unit] / _SECONDS_OF_YEAR <= LAST_YEAR:
        unit = next(known for known, per_second in _PER_SECOND.items() if UNITS["t"][stated] * per_second == 1)
    per_second = _PER_SECOND[unit]
    missing = np.isnan(numbers)
    if np.nanmax(np.abs(numbers), initial=0.0) >= 9.2e9 * per_second:
        return pd.Series(numbers / per_second), unit
    if pd.api.types.is_integer_dtype(values.dtype) and not missing.any():
        nanoseconds = values.to_numpy(np.int64) * (10**9 // per_second)
    else:
        # A float64 holds the seconds of this century to a microsecond at best: do not invent nanoseconds.
        nanoseconds = np.round(np.where(missing, 0.0, numbers) * (1e6 / per_second)).astype(np.int64) * 1000
        nanoseconds[missing] = np.iinfo(np.int64).min
    return pd.Series(nanoseconds.view("datetime64[ns]")).dt.tz_localize("UTC"), unit


def _written_dates(values: pd.Series) -> tuple[pd.Series, str] | None:
    """Read numbers such as 20240501080000: dates written without separators. None where any is no such date."""
    if not pd.api.types.is_integer_dtype(values.dtype) or values.dropna().empty:
        return None
    format = {12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}.get(len(str(values.dropna().iloc[0])))
    if format is None:
        return None
    times = pd.to_datetime(values.astype("str"), format=format, errors="coerce", utc=True)
    read = times.notna()
    if not (read | values.isna()).all() or not times[read].dt.year.between(1980, 2099).all():
        return None
    return times, "yyyymmddHHMMSS"[: 12 if len(format) == 10 else 14]


def day_numbers(values: pd.Series) -> bool:
    """Say whether numbers look like days since 1899-12-30 with the time as fraction, as spreadsheets store times.

    Seconds of a day are of the same size, but lie further apart.

    Examples
    --------
    >>> day_numbers(pd.Series([45413.3333333, 45413.3334491])), day_numbers(pd.Series([45413.0, 45423.0]))
    (True, False)
    """
    if not pd.api.types.is_float_dtype(values.dtype):
        return False
    steps = values.diff().abs()
    steps = steps[steps > 0]
    return bool(20_000 < values.median() < 80_000 and len(steps) and steps.median() < _DAY_STEP)


def _holds_text(values: pd.Series) -> bool:
    return bool(values.dtype.kind not in "biufmM" and not isinstance(values.dtype, pd.DatetimeTZDtype))


def _joined(values: pd.Series, dates: pd.Series | None, *, has_format: bool) -> pd.Series:
    """Return times as text, with their dates before them where they are times of day."""
    words = _words(values)
    if dates is None:
        return words
    clock = words.str.replace(r"\.0+$", "", regex=True).str.replace(r"^(\d{1,5})(?=\.|$)", _six_digits, regex=True)
    days = _words(dates).str.replace(r"^(\d{5}|\d{7})$", r"0\1", regex=True)  # 010524 that was read as a number
    if has_format:
        return _words(dates) + " " + words
    if clock.dropna().str.fullmatch(_TIME_OF_DAY).all() or clock.dropna().str.fullmatch(_DIGITS_OF_DAY).all():
        return days.str.replace(_MIDNIGHT, "", regex=True) + " " + clock
    return values


def _six_digits(found: re.Match[str]) -> str:
    """Write 80000, a time of day whose first zero a spreadsheet dropped, as 080000."""
    return found[1].zfill(6)


def _words(values: pd.Series) -> pd.Series:
    """Return a column as text; numbers without the fraction that a hole among integers gives them."""
    if pd.api.types.is_float_dtype(values.dtype) and (values.dropna() % 1 == 0).all():
        values = values.astype("Int64")
    if not isinstance(values.dtype, pd.StringDtype):
        values = values.astype(object).map(str, na_action="ignore").astype("str")
    return values.str.strip()


def _numbers_in_text(values: pd.Series) -> pd.Series:
    """Return a column of text as numbers where nearly all cells are some; others become missing."""
    there = values.dropna()
    if there.empty or pd.to_numeric(_words(there.iloc[:_TRIED]), errors="coerce").notna().mean() < _MOSTLY:
        return values
    numbers = pd.to_numeric(_words(there), errors="coerce").reindex(values.index)
    whole = bool((numbers.dropna() % 1 == 0).all())
    return numbers.astype("Int64") if whole else numbers.astype(np.float64)


def _times_from_text(values: pd.Series, name: str, where: object) -> tuple[pd.Series, str]:
    """Read times that are not in ISO 8601 by the one format that fits them; others are left as they are."""
    words = _words(values)
    some = pd.Series(words.drop_duplicates().dropna().iloc[:_TRIED].to_numpy(), dtype="str")
    if some.empty or pd.to_datetime(some, format="ISO8601", errors="coerce", utc=True).notna().any():
        return values, ""
    if some.str.fullmatch(_TIME_OF_DAY).all():
        logger.warning("%s: column %r (t) holds times of day without date: they count from %s", where, name, _NO_DATE)
        words = _NO_DATE + " " + words
        return _times_from_text(words, name, where)
    plain = some.str.replace(_ZONE_WORD, "", regex=True)
    fitting = _fitting_formats(plain)
    if not fitting:
        whole = pd.to_datetime(plain, format="ISO8601", errors="coerce", utc=True)
        return (words.str.replace(_ZONE_WORD, "", regex=True), "") if whole.notna().any() else (values, "")
    readings = {format: pd.to_datetime(plain, format=format, utc=True) for format in fitting}
    first, *others = fitting
    for other in others:
        if not readings[first].equals(readings[other]):
            parts = ("day/month", "month/day") if "/" in first or "-" in first else (first, other)
            raise InputError(
                f"column {name!r} (t) could be {parts[0]} or {parts[1]} ({plain.iloc[0]})",
                where=where,
                fix=f'say which, time_format="{first}" or time_format="{other}"',
            )
    if not plain.equals(some):
        words = words.str.replace(_ZONE_WORD, "", regex=True)
    return _read(words, first, values), first


def _fitting_formats(words: pd.Series) -> list[str]:
    """Return the formats that read all cells as times of this age."""

    def fits(format: str) -> bool:
        try:
            datetime.strptime(words.iloc[0], format)  # only whether it can be read
        except ValueError:
            return False
        times = pd.to_datetime(words, format=format, errors="coerce", utc=True)
        years = times.dropna().dt.year
        plausible = years.between(FIRST_YEAR, LAST_YEAR).all() or (years == 1970).all()
        return bool(plausible and times.notna().mean() >= _MOSTLY)

    alike = _formats_by_shape()
    return [format for format in (*alike.get(_shape(words.iloc[0]), []), *alike["zone"]) if fits(format)]


@cache
def _formats_by_shape() -> dict[str, list[str]]:
    """Sort the formats by the shape of the times that they write; those with a zone, which has many forms, apart."""
    some_time = datetime(2024, 8, 30, 10, 20, 30, 400000)
    found: dict[str, list[str]] = {"zone": []}
    for format in _WRITTEN:
        found.setdefault("zone" if "%z" in format else _shape(some_time.strftime(format)), []).append(format)
    return found


def _shape(text: str) -> str:
    """Write one digit for every number and one letter for every word: few formats write times of one shape."""
    return re.sub(r"[^\W\d_]+", "a", re.sub(r"\d+", "0", text))


def _by_the_users_format(values: pd.Series, name: str, format: str, where: object) -> tuple[pd.Series, str]:
    """Read times by the format that the user gave; cells that have another stay as they are, to be refused later."""
    words = _words(values)
    times = _read(words, format, values)
    if words.notna().any() and pd.api.types.is_object_dtype(times.dtype) and times.equals(values.astype(object)):
        first = words.dropna().iloc[0]
        fault = f"no time in column {name!r} (t) has the format {format} (the first is {first})"
        raise InputError(fault, where=where, fix="correct time_format, whose letters are those of strptime")
    return times, ""


def _read(words: pd.Series, format: str, values: pd.Series) -> pd.Series:
    """Read text by a format; where some cells have another, all as text: times in ISO 8601, the others unchanged."""
    times = pd.to_datetime(words, format=format, errors="coerce", utc=True)
    unread = (times.isna() & words.notna()).to_numpy(bool)
    if not unread.any():
        return times
    iso = times.dt.strftime("%Y-%m-%dT%H:%M:%S.%f+00:00").astype(object)
    return iso.mask(unread, values.astype(object))
