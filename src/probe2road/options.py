"""Stage options from TOML: what a file may set is exactly what the dataclasses declare."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from probe2road.errors import OptionError

__all__ = ["changed_by", "load_options", "options_from_table", "read_toml"]

T = TypeVar("T")


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


def options_from_table(table: dict[str, Any], kind: type[T], *, where: object = None) -> T:
    """Build a dataclass, all of whose fields have defaults, from a table of some of them.

    Raises
    ------
    OptionError
        Naming an unknown field or a value of the wrong type.

    Examples
    --------
    >>> from probe2road.graph.clean import CleanOptions
    >>> options_from_table({"dead_end": 20}, CleanOptions).dead_end
    20.0
    >>> options_from_table({"deadend": 20}, CleanOptions, where="build.toml")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: build.toml: there is no option 'deadend'; use short_edge, max_ring, ...
    """
    return changed_by(kind(), table, where=where)


def changed_by(defaults: T, table: dict[str, Any], *, where: object = None) -> T:
    """Return a dataclass with the fields that a table sets; nested tables change nested dataclasses.

    Raises
    ------
    OptionError
        As `options_from_table`.
    """
    hints = get_type_hints(type(defaults))
    names = [field.name for field in fields(defaults)]  # type: ignore[arg-type]  # of a dataclass
    values = {}
    for name, value in table.items():
        if name not in names:
            raise OptionError(f"there is no option {name!r}", where=where, fix=f"use {', '.join(names)}")
        default, place = getattr(defaults, name), f"{where}: {name}" if where else name
        nested = is_dataclass(default) and isinstance(value, dict)
        values[name] = changed_by(default, value, where=place) if nested else _converted(value, hints[name], place)
    return replace(defaults, **values)  # type: ignore[type-var]


def _converted(value: Any, hint: Any, where: str) -> Any:
    """Return the value as its field wants it: whole numbers become floats, lists become tuples, tables dataclasses."""
    some = [kind for kind in get_args(hint) if kind is not type(None)]
    if len(some) == 1 and get_origin(some[0]) is tuple and isinstance(value, list):  # a tuple or None
        hint = some[0]
    if get_origin(hint) is tuple and isinstance(value, list):
        kinds = get_args(hint)
        if kinds[-1] is not Ellipsis and len(value) != len(kinds):
            raise OptionError(f"has {len(value)} values, not {len(kinds)}", where=where)
        kinds = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
        return tuple(_converted(*pair, f"{where}[{n}]") for n, pair in enumerate(zip(value, kinds, strict=True)))
    if is_dataclass(hint) and isinstance(value, dict):
        defaults: Any = hint
        return changed_by(defaults(), value, where=where)
    if get_origin(hint) is Mapping and isinstance(value, dict):
        return {name: _converted(entry, get_args(hint)[1], f"{where}: {name}") for name, entry in value.items()}
    allowed = get_args(hint) or (hint,)
    if float in allowed and type(value) is int:
        return float(value)
    if type(value) not in allowed:
        expected = " or ".join(getattr(kind, "__name__", str(kind)) for kind in allowed if kind is not type(None))
        raise OptionError(f"{value!r} is not of type {expected}", where=where)
    return value
