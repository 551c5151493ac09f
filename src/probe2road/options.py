"""Options of the stages: one checker for Python, the command line and TOML.

Strategy
--------
A dataclass of options says what it wants where it says the unit:

    @dataclass(frozen=True)
    @checked
    class GapOptions:
        max_length: NotNegative[float] = 50.0  # m; longer links are never made

`checked` reads type and bounds (`probe2road.bounds`) from there and checks them whenever an object is made: in Python,
from the command line, or from a TOML file. So there is one list of what is allowed, and one way to say what is wrong.
What relates two fields to each other stays in a short ``__post_init__``, which finds every field in order.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from probe2road.bounds import MAPPINGS, MisfitError, alternatives, fitted
from probe2road.errors import OptionError

__all__ = ["changed_by", "checked", "load_options", "options_from_table", "read_toml"]

T = TypeVar("T")


def checked(kind: type[T]) -> type[T]:
    """Make a dataclass check its fields against their annotations; to be placed below ``@dataclass(frozen=True)``.

    Checked are types, bounds and choices, also inside tuples, mappings and optional fields, as
    `probe2road.bounds.fitted` has it; what can be converted is. Nested options have to be an object of their class.
    A ``__post_init__`` of the class runs afterwards, for what relates its fields to each other.

    Raises
    ------
    OptionError
        When an object is made whose fields are not as annotated; it names the class, and all such fields.

    Examples
    --------
    >>> from probe2road.graph.clean import CleanOptions
    >>> CleanOptions(dead_end=20)
    CleanOptions(short_edge=15.0, collapse='shape', max_shift=3.0, dead_end=20.0, component=15.0)
    >>> CleanOptions(dead_end=float("inf"))
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: CleanOptions: dead_end is inf; use a number of at least 0
    >>> CleanOptions(short_edge="long", component=-1)
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: CleanOptions: 2 faults
      1. short_edge is 'long'; use a number of at least 0
      2. component is -1; use a number of at least 0
    """
    if "__dataclass_fields__" in vars(kind):
        raise TypeError(f"{kind.__name__}: @checked stands below @dataclass, which would not call it otherwise")
    relations: Callable[[Any], None] | None = getattr(kind, "__post_init__", None)

    def check(self: Any) -> None:
        """Check the fields, each for itself and then together."""
        values = {name: getattr(self, name) for name in _field_hints(self.__class__)}
        for name, value in _settled(self.__class__, values, self.__class__.__name__).items():
            object.__setattr__(self, name, value)
        if relations is not None:
            relations(self)

    kind.__post_init__ = check  # type: ignore[attr-defined]  # dataclass looks for it
    return kind


def load_options(path: str | Path, kind: type[T]) -> T:
    """Read options of a dataclass from a TOML file; nested dataclasses are tables.

    Raises
    ------
    OptionError
        If the file cannot be read, is not TOML, or sets something the dataclass does not have.
    """
    return options_from_table(read_toml(path), kind, where=path)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    OptionError
        If the file cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise OptionError(f"cannot be read ({error.strerror})", where=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"is not TOML: {error}", where=path) from error


def options_from_table(table: Mapping[str, Any], kind: type[T], *, where: object = None) -> T:
    """Build a dataclass from a table of some of its fields; other fields have their defaults.

    Parameters
    ----------
    table
        Values by field; a nested table sets some fields of a nested dataclass.
    kind
        The dataclass; it need not be `checked` to be checked here.
    where
        What messages call the table; the name of the class if it is None.

    Raises
    ------
    OptionError
        Naming an unknown field, a missing one, or values that are not allowed.

    Examples
    --------
    >>> from probe2road.graph.clean import CleanOptions
    >>> options_from_table({"dead_end": 20}, CleanOptions).dead_end
    20.0
    >>> options_from_table({"dead_end": -3}, CleanOptions, where="build.toml: clean")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: build.toml: clean: dead_end is -3; use a number of at least 0
    >>> options_from_table({"deadend": 20}, CleanOptions, where="build.toml")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: build.toml: there is no option 'deadend'; use short_edge, collapse, ...
    """
    defaults = {field.name: _default(field) for field in fields(kind)}  # type: ignore[arg-type]  # a dataclass
    return _made(kind, {name: value for name, value in defaults.items() if value is not MISSING}, table, where)


def changed_by(defaults: T, table: Mapping[str, Any], *, where: object = None) -> T:
    """Return a dataclass with the fields in a table replaced; nested tables change nested dataclasses.

    Raises
    ------
    OptionError
        As `options_from_table`.
    """
    values = {field.name: getattr(defaults, field.name) for field in fields(defaults)}  # type: ignore[arg-type]
    return _made(type(defaults), values, table, where)


def _made(kind: Any, defaults: Mapping[str, Any], table: Mapping[str, Any], where: object) -> Any:
    """Return an object of a dataclass, from a table and defaults."""
    where, hints = where or kind.__name__, _field_hints(kind)
    values = dict(defaults)
    for name, value in table.items():
        if name not in hints:
            raise OptionError(f"there is no option {name!r}", where=where, fix=f"use {', '.join(hints)}")
        values[name] = _from_toml(value, hints[name], defaults.get(name), f"{where}: {name}")
    if missing := [name for name in hints if name not in values]:
        raise OptionError(f"there is no {' and no '.join(missing)}", where=where, fix="set what has no default")
    values = _settled(kind, values, where)
    try:
        return kind(**values)
    except OptionError as error:  # what relates fields to each other: the class does not know of the file
        raise OptionError(error.what, where=where, fix=error.fix) from error


def _from_toml(value: Any, hint: Any, default: Any, where: str) -> Any:
    """Convert tables to the dataclasses of a field; other values are left to the check."""
    kinds = alternatives(hint)
    if isinstance(value, Mapping):
        if is_dataclass(default):
            return changed_by(default, value, where=where)
        for kind in kinds:
            if isinstance(kind, type) and is_dataclass(kind):
                return options_from_table(value, kind, where=where)
            if get_origin(kind) in MAPPINGS:
                entry = get_args(kind)[1]
                return {name: _from_toml(value[name], entry, None, f"{where}: {name}") for name in value}
    if isinstance(value, list) and get_origin(kinds[0]) is tuple:
        entry = get_args(kinds[0])[0]
        return [_from_toml(one, entry, None, f"{where}[{number}]") for number, one in enumerate(value)]
    return value


def _settled(kind: type, values: Mapping[str, Any], where: object) -> dict[str, Any]:
    """Return the values converted to the fields of a dataclass; raise OptionError with all that do not fit."""
    settled, faults = {}, []
    for name, hint in _field_hints(kind).items():
        try:
            settled[name] = fitted(values[name], hint, name)
        except MisfitError as misfit:
            faults.append(misfit)
    if len(faults) == 1:
        raise OptionError(faults[0].what, where=where, fix=faults[0].fix)
    if faults:
        lines = "".join(f"\n  {number}. {fault}" for number, fault in enumerate(faults, start=1))
        raise OptionError(f"{len(faults)} faults{lines}", where=where)
    return settled


@cache
def _field_hints(kind: Any) -> dict[str, Any]:
    """Return the annotations of the fields of a dataclass, including bounds."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def _default(field: Field[Any]) -> Any:
    """Return the default of a field; MISSING if it has none."""
    return field.default if field.default_factory is MISSING else field.default_factory()
