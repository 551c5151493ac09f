"""Conversion of errors of other libraries to ours.

A damaged file can make GDAL, Arrow, osmium, expat, PROJ and pandas raise nearly anything. What parses a file stands
under `parsing`; what is made of its content is validated, so that a defect of ours stays visible as one.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from probe2road.errors import InputError, Probe2RoadError

__all__ = ["located", "parsing", "raised_by_callbacks"]

_LONGEST = 200  # characters of a foreign message that are of use


@contextmanager
def parsing(where: object, what: str, *, fix: str = "check that it is complete") -> Iterator[None]:
    """Replace any error of another library in the block by one that names the file.

    Only for blocks that call parsers and convert what they gave. Warnings of the parsers are silenced: what they warn
    of is checked afterwards.

    Parameters
    ----------
    where
        The file.
    what
        What went wrong, such as ``cannot be read as GraphML``.
    fix
        What the user can do.

    Raises
    ------
    InputError
        In the place of an error that is not ours.

    Examples
    --------
    >>> with parsing("roads.graphml", "cannot be read as GraphML"):
    ...     int("seven")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: roads.graphml: cannot be read as GraphML (invalid literal for int() ...); check ...
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except Probe2RoadError:
        raise
    except Exception as error:
        raise InputError(f"{what} ({_short(error)})", where=where, fix=fix) from error


@contextmanager
def located(where: object) -> Iterator[None]:
    """Add the file to errors of ours that name no place, such as an error about the CRS of its content.

    Examples
    --------
    >>> with located("roads.osm"):
    ...     raise InputError("no position", fix="check that it is complete")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: roads.osm: no position; check that it is complete
    """
    try:
        yield
    except Probe2RoadError as error:
        if error.where is not None:
            raise
        raise type(error)(error.what, where=where, fix=error.fix) from error


@contextmanager
def raised_by_callbacks(where: object) -> Iterator[None]:
    """Refuse a file of which compiled code shows a callback text that is not UTF-8.

    Python would print that error, forget it, and let the block go on as if nothing had been.

    Raises
    ------
    InputError
        In the place of what the block raises, or at its end.
    """
    found: list[BaseException] = []
    usual = sys.unraisablehook

    def note(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, UnicodeDecodeError):
            found.append(unraisable.exc_value)
        else:
            usual(unraisable)

    sys.unraisablehook = note
    try:
        yield
    except Probe2RoadError:
        if not found:
            raise
    finally:
        sys.unraisablehook = usual
    if found:
        raise InputError(f"the text is not UTF-8 ({found[0]})", where=where, fix="save it as UTF-8")


def _short(error: Exception) -> str:
    """Return the first line of a message, shortened if it is long; the type of the error if there is no message."""
    lines = str(error).strip().splitlines()
    text = lines[0] if lines else type(error).__name__
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
