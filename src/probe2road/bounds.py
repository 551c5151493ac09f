"""Bounds of values for `typing.Annotated`, and the check of one value against them.

The vocabulary is small on purpose. Four names cover most fields of options: `Positive` (above 0), `NotNegative` (0 or
more), `Share` (0 to 1, both included) and `Probability` (0 to 1, none included). Bounds cover the others:

    reach: Positive[float] = 80.0  # m
    rounds: Annotated[int, AtLeast(1), AtMost(4)] = 1
    device: Annotated[str, OneOf("cpu", "cuda")] = "cpu"
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, is_dataclass
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

__all__ = [
    "MAPPINGS",
    "Above",
    "AtLeast",
    "AtMost",
    "Below",
    "MisfitError",
    "NotEmpty",
    "NotNegative",
    "OneOf",
    "Positive",
    "Probability",
    "Share",
    "alternatives",
    "fitted",
]

Number = TypeVar("Number", int, float)

MAPPINGS = (Mapping, dict)  # as typing.get_origin has them
_UNIONS = (Union, UnionType)
_LONGEST_VALUE = 60  # characters of a wrong value that a message shows


@dataclass(frozen=True)
class AtLeast:
    """A lower bound that is allowed itself."""

    limit: float

    def allows(self, value: Any) -> bool:
        """Tell whether a value is within the bound."""
        return value >= self.limit

    def __str__(self) -> str:
        return f"at least {self.limit:g}"


@dataclass(frozen=True)
class Above:
    """A lower bound that is not allowed itself."""

    limit: float

    def allows(self, value: Any) -> bool:
        """Tell whether a value is within the bound."""
        return value > self.limit

    def __str__(self) -> str:
        return f"above {self.limit:g}"


@dataclass(frozen=True)
class AtMost:
    """An upper bound that is allowed itself."""

    limit: float

    def allows(self, value: Any) -> bool:
        """Tell whether a value is within the bound."""
        return value <= self.limit

    def __str__(self) -> str:
        return f"at most {self.limit:g}"


@dataclass(frozen=True)
class Below:
    """An upper bound that is not allowed itself."""

    limit: float

    def allows(self, value: Any) -> bool:
        """Tell whether a value is within the bound."""
        return value < self.limit

    def __str__(self) -> str:
        return f"below {self.limit:g}"


class OneOf:
    """A bound: one of several words, as in ``OneOf("greedy", "optimal")``."""

    def __init__(self, *choices: str) -> None:
        self.choices = choices

    def allows(self, value: Any) -> bool:
        """Tell whether a value is one of the words."""
        return value in self.choices

    def __str__(self) -> str:
        return _listed(self.choices)


@dataclass(frozen=True)
class NotEmpty:
    """A bound: a list with at least one element."""

    def allows(self, value: Any) -> bool:
        """Tell whether a list has at least one element."""
        return len(value) > 0

    def __str__(self) -> str:
        return "with at least one entry"


Positive = Annotated[Number, Above(0)]
NotNegative = Annotated[Number, AtLeast(0)]
Share = Annotated[float, AtLeast(0), AtMost(1)]
Probability = Annotated[float, Above(0), Below(1)]  # neither impossible nor certain


class MisfitError(Exception):
    """A value does not fit its annotation."""

    def __init__(self, name: str, value: Any, hint: Any) -> None:
        text = repr(value)
        shown = text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."
        self.what, self.fix = f"{name} is {shown}", f"use {_words(hint)}"
        super().__init__(f"{self.what}; {self.fix}")


def fitted(value: Any, hint: Any, name: str) -> Any:
    """Return a value converted to its annotation, or raise MisfitError.

    A whole number becomes a float where one is wanted (never the reverse), a list or an array becomes a tuple, text
    becomes a path, and numbers of NumPy become those of Python. A number is finite; ``True`` is none.

    Parameters
    ----------
    value
        Anything.
    hint
        A type, or a type with bounds: number, text, path, dataclass, `Literal`, tuple, mapping, or a union of them.
    name
        What messages call the value.

    Raises
    ------
    MisfitError
        If the value is of another type, or breaks a bound.

    Examples
    --------
    >>> fitted([1, 2.5], tuple[Positive[float], ...], "radii")
    (1.0, 2.5)
    >>> try:
    ...     fitted([1, -2], tuple[Positive[float], ...], "radii")
    ... except MisfitError as misfit:
    ...     print(misfit)
    radii[1] is -2; use a number above 0
    """
    kind, bounds = _without_bounds(hint)
    found = _converted(value, kind, name)
    if found is MISSING or not all(bound.allows(found) for bound in bounds):
        raise MisfitError(name, value, hint)
    return found


def _converted(value: Any, kind: Any, name: str) -> Any:
    """Return a value as an object of a type; MISSING if it is none, MisfitError if one of its entries does not fit."""
    origin, arguments = get_origin(kind) or kind, get_args(kind)
    if origin in _UNIONS:
        for one in arguments:
            with suppress(MisfitError):
                return fitted(value, one, name)
        return MISSING
    if origin is tuple:
        return _converted_list(value, arguments, name)
    if origin in MAPPINGS:
        if not isinstance(value, Mapping):
            return MISSING
        return {fitted(key, arguments[0], name): fitted(value[key], arguments[1], f"{name}.{key}") for key in value}
    if origin is Literal:
        return value if isinstance(value, str) and value in arguments else MISSING
    if kind is Any:
        return value
    if isinstance(value, bool):
        return value if kind is bool else MISSING
    if kind in (int, float):
        return _converted_number(value, kind)
    if kind is Path and isinstance(value, str):
        return Path(value)
    return value if isinstance(value, kind) else MISSING


def _converted_list(value: Any, kinds: tuple[Any, ...], name: str) -> Any:
    """Return a list as a tuple of types; the last type may be an ellipsis."""
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(value, tuple | list):
        return MISSING
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(kinds) != len(value):
        return MISSING
    return tuple(fitted(one, kind, f"{name}[{n}]") for n, (one, kind) in enumerate(zip(value, kinds, strict=True)))


def _converted_number(value: Any, kind: type) -> Any:
    """Return a value as a finite number."""
    if kind is int:
        return int(value) if isinstance(value, Integral) else MISSING
    if not isinstance(value, Real):
        return MISSING
    try:
        number = float(value)
    except OverflowError:
        return MISSING
    return number if math.isfinite(number) else MISSING


def _words(hint: Any) -> str:
    """Return in words what an annotation allows."""
    kind, bounds = _without_bounds(hint)
    origin, arguments = get_origin(kind) or kind, get_args(kind)
    limits = " and ".join(str(bound) for bound in bounds)
    if origin in _UNIONS:
        return _listed([_words(one) for one in arguments])
    if origin is Literal:
        return _listed(arguments)
    if kind in (int, float):
        noun = "a number" if kind is float else "a whole number"
        return f"{noun} of {limits}" if limits.startswith("at ") else f"{noun} {limits}".rstrip()
    if kind is str:
        return limits or "text"
    if origin is tuple:
        noun = "a list" if arguments[-1] is Ellipsis else f"a list of {len(arguments)} values"
        return f"{noun} {limits}".rstrip()
    if origin in MAPPINGS:
        return "a mapping (in TOML a table)"
    if is_dataclass(kind):
        return f"{getattr(kind, '__name__', kind)} (in TOML a table)"
    return {bool: "true or false", Path: "a path", NoneType: "None"}.get(kind, kind.__name__)


def _listed(words: Sequence[str]) -> str:
    """Join words with commas, and the last one with "or"."""
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _without_bounds(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Split an annotation into its type and its bounds."""
    if get_origin(hint) is Annotated:
        kind, *bounds = get_args(hint)
        return kind, tuple(bounds)
    return hint, ()


def alternatives(hint: Any) -> tuple[Any, ...]:
    """Return the types of a union, all without bounds; for another type, the type itself."""
    kind = _without_bounds(hint)[0]
    kinds = get_args(kind) if get_origin(kind) in _UNIONS else (kind,)
    return tuple(_without_bounds(one)[0] for one in kinds)
