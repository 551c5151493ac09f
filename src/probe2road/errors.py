"""The errors that probe2road raises on purpose.

Every message answers three questions: what is wrong, where it is, what to do about it. The command line
prints that message and exits with code 2; a traceback therefore always means a defect in probe2road.

An error is also the error of Python that says the same, so that a program which knows nothing of probe2road catches
it where it expects it: bad data and bad options are `ValueError`, an output that cannot be written is an `OSError`, a
file that is not there is a `FileNotFoundError`, and a package that is not there is an `ImportError`.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

__all__ = [
    "CRSError",
    "InputError",
    "MissingExtraError",
    "MissingFileError",
    "OptionError",
    "OutputError",
    "Probe2RoadError",
    "needs_extra",
]


_LONGEST_LINE = 480  # characters of a line of a message: some lines of a terminal
_MOST_LINES = 40


def _shortened(text: str) -> str:
    """Shorten a text: cut long lines in the middle, and many lines at the end, because a list of names may be long."""
    lines = text.split("\n")
    if len(lines) > _MOST_LINES:
        lines = [*lines[:_MOST_LINES], f"  and {len(lines) - _MOST_LINES} more lines"]
    head, tail = _LONGEST_LINE * 2 // 3, _LONGEST_LINE // 3
    return "\n".join(line if len(line) <= _LONGEST_LINE else f"{line[:head]} [...] {line[-tail:]}" for line in lines)


class Probe2RoadError(Exception):
    """Base of every error that probe2road raises on purpose.

    Messages are cut at some hundred characters a line, whatever the data put into them.

    Parameters
    ----------
    what
        The fault, in one clause.
    where
        File, table, column or row it was found in.
    fix
        What the user can do.

    Examples
    --------
    >>> print(Probe2RoadError("column 'x' is missing", where="drives.csv", fix="pass --columns x=easting"))
    drives.csv: column 'x' is missing; pass --columns x=easting
    """

    def __init__(self, what: str, *, where: object = None, fix: str | None = None) -> None:
        what, fix = _shortened(what), None if fix is None else _shortened(fix)
        self.what, self.where, self.fix = what, where, fix
        prefix = "" if where is None else f"{where}: "
        suffix = "" if fix is None else f"; {fix}"
        super().__init__(f"{prefix}{what}{suffix}")

    def __str__(self) -> str:
        # An OSError would put its number in front.
        return str(self.args[0])

    def __reduce__(self) -> tuple[Callable[..., Probe2RoadError], tuple[str], dict[str, Any]]:
        # From its parts, so that an error of a worker process arrives as it was raised.
        return partial(type(self), where=self.where, fix=self.fix), (self.what,), self.__dict__


class InputError(Probe2RoadError, ValueError):
    """The user's data are wrong.

    Examples
    --------
    All faults of one input are reported at once:

    >>> print(InputError.from_faults(["no fixes", "no CRS"], where="drives.csv"))
    drives.csv: 2 faults
      1. no fixes
      2. no CRS
    """

    @classmethod
    def from_faults(cls, faults: Sequence[str], *, where: object = None) -> InputError:
        """Build one error from the faults that a validator collected (at least one)."""
        if len(faults) == 1:
            return cls(faults[0], where=where)
        lines = "".join(f"\n  {number}. {fault}" for number, fault in enumerate(faults, start=1))
        return cls(f"{len(faults)} faults{lines}", where=where)


class CRSError(InputError):
    """A coordinate reference system is missing, in degrees where metres are needed, or contradictory."""


class MissingFileError(InputError, FileNotFoundError):
    """A file of the user's data is not there.

    Examples
    --------
    >>> try:
    ...     raise MissingFileError("there is no such file", where="drives.csv")
    ... except FileNotFoundError as error:
    ...     print(error)
    drives.csv: there is no such file
    """

    def __init__(self, what: str, *, where: object = None, fix: str | None = None) -> None:
        super().__init__(what, where=where, fix=fix)
        # What a FileNotFoundError of Python carries.
        self.errno = errno.ENOENT
        self.filename = None if where is None else str(where)


class OptionError(Probe2RoadError, ValueError):
    """An option is out of range, unknown, or contradicts another."""


class OutputError(Probe2RoadError, OSError):
    """An output cannot be written."""


class MissingExtraError(Probe2RoadError, ImportError):
    """A feature needs an optional dependency that is not installed.

    It is an `ImportError` as well, for programs that try a module and carry on without it.

    Examples
    --------
    >>> print(MissingExtraError.for_extra("train", feature="training the segmentation network"))
    training the segmentation network needs an optional dependency; install it with: pip install 'probe2road[train]'
    """

    @classmethod
    def for_extra(cls, extra: str, *, feature: str) -> MissingExtraError:
        """Build the error that gives the exact install command of an extra."""
        return cls(f"{feature} needs an optional dependency", fix=f"install it with: pip install 'probe2road[{extra}]'")


@contextmanager
def needs_extra(extra: str, *, feature: str) -> Iterator[None]:
    """Replace an import error for a missing package in the block by the error that says what to install.

    For the top of a module that cannot work without an optional dependency. A package that is there but broken
    keeps its own error.

    Parameters
    ----------
    extra
        The extra of probe2road that brings the packages.
    feature
        What needs them, as the subject of the message.

    Raises
    ------
    MissingExtraError
        If a package that the block imports is not installed.

    Examples
    --------
    >>> with needs_extra("train", feature="training the segmentation network"):
    ...     import no_such_package
    Traceback (most recent call last):
        ...
    probe2road.errors.MissingExtraError: training the segmentation network needs an optional dependency; install it
    with: pip install 'probe2road[train]'
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError.for_extra(extra, feature=feature) from error
