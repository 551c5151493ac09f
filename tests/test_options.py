import importlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import probe2road
from probe2road.bounds import Above, AtMost, NotNegative, OneOf, Positive
from probe2road.errors import MissingExtraError, OptionError
from probe2road.graph.clean import CleanOptions
from probe2road.matching.match import MatchOptions
from probe2road.options import changed_by, checked, load_options, options_from_table
from probe2road.recipe import BuildOptions
from probe2road.simulation.presets import PRESETS

SOURCES = Path(probe2road.__file__).parent
NONSENSE = (math.inf, -math.inf, math.nan, True, "nonsense", None, {"nonsense": 1}, [object()], object(), 0.5, -7)


@dataclass(frozen=True)
class Inner:
    length: float = 1.0
    count: int = 2


@dataclass(frozen=True)
class Outer:
    name: str = "x"
    limit: float | None = None
    near: Inner = field(default_factory=lambda: Inner(length=9.0))


@dataclass(frozen=True)
@checked
class Everything:
    name: str = "x"
    folder: Path | None = None
    way: Annotated[str, OneOf("up", "down")] = "up"
    pair: tuple[Positive[float], float] = (1.0, 2.0)
    weights: Mapping[str, NotNegative[float]] = field(default_factory=dict)
    share: Annotated[float, Above(0), AtMost(1)] = 0.5
    inner: CleanOptions | None = None
    many: tuple[Inner, ...] = ()


def test_what_a_table_does_not_name_keeps_its_default():
    assert options_from_table({}, Outer) == Outer()
    changed = options_from_table({"limit": 3, "near": {"count": 5}}, Outer)
    assert changed == Outer(limit=3.0, near=Inner(length=9.0, count=5))


def test_a_nested_table_changes_the_defaults_of_its_own_place():
    options = options_from_table({"sparse": {"sigma": 8.0}}, MatchOptions)
    assert options.sparse.sigma == 8.0
    assert options.sparse.beta == MatchOptions().sparse.beta


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"nmae": "y"}, "there is no option 'nmae'; use name, limit, near"),
        ({"near": {"size": 1}}, "^Outer: near: there is no option 'size'"),
        ({"name": 3}, "^Outer: name is 3; use text$"),
        ({"near": {"count": 1.5}}, "^Outer: near: count is 1.5; use a whole number$"),
        ({"limit": "far"}, "^Outer: limit is 'far'; use a number or None$"),
        ({"near": 3}, "^Outer: near is 3; use Inner \\(in TOML a table\\)$"),
    ],
)
def test_mistakes_are_named(table, message):
    with pytest.raises(OptionError, match=message):
        options_from_table(table, Outer)


@pytest.mark.parametrize(("content", "message"), [("name = ", "is not TOML"), (None, "cannot be read")])
def test_files_that_cannot_be_read(tmp_path, content, message):
    path = tmp_path / "options.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(OptionError, match=message):
        load_options(path, Outer)


def checked_classes() -> list[tuple[str, str]]:
    """Module and name of every checked class, found without importing anything."""
    return [
        (".".join(["probe2road", *path.relative_to(SOURCES).with_suffix("").parts]), name)
        for path in sorted(SOURCES.rglob("*.py"))
        for name in re.findall(r"^@checked\nclass (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    ]


def example(kind: Any) -> Any:
    """An object of a class; fields without a default need a value."""
    mixed = PRESETS["mixed"]
    for one in (mixed, mixed.gnss, mixed.fusion, mixed.odometry, mixed.camera):
        if isinstance(one, kind):
            return one
    needed = {"ModelInfo": {"name": "m", "channels": ("traces",)}, "Source": {"folder": "sets", "work": "work"}}
    names = {entry.name for entry in fields(kind)}
    return kind(**{name: value for name, value in needed.get(kind.__name__, {}).items() if name in names})


def may_be(value: Any, hint: Any) -> bool:
    """Whether an annotation allows one of the values of NONSENSE; the checker, written the short way for these."""
    if get_origin(hint) is Annotated:
        kind, *bounds = get_args(hint)
        return may_be(value, kind) and all(bound.allows(value) for bound in bounds)
    if get_origin(hint) in (Union, UnionType):
        return any(may_be(value, one) for one in get_args(hint))
    if hint is float:
        return isinstance(value, float | int) and not isinstance(value, bool) and math.isfinite(value)
    if get_origin(hint) in (Mapping, dict):
        return isinstance(value, dict) and may_be(1, get_args(hint)[1])
    if hint in (int, bool, NoneType):
        return type(value) is hint
    return hint is Any or (hint in (str, Path) and isinstance(value, str))


@pytest.mark.parametrize(("module", "name"), checked_classes())
def test_nonsense_is_refused_by_every_field(module: str, name: str) -> None:
    try:
        kind = getattr(importlib.import_module(module), name)
    except MissingExtraError as error:
        pytest.skip(str(error))
    start = example(kind)
    assert replace(start) == start
    for field_name, hint in get_type_hints(kind, include_extras=True).items():
        for value in NONSENSE:
            if may_be(value, hint):
                continue
            with pytest.raises(OptionError) as caught:
                replace(start, **{field_name: value})
            assert str(caught.value).startswith(f"{name}: {field_name}"), (field_name, value)
            with pytest.raises(OptionError) as caught:
                changed_by(start, {field_name: value}, where="build.toml")
            assert re.match(rf"build\.toml: {field_name}\b", str(caught.value)), (field_name, value)


def test_every_class_of_options_is_checked() -> None:
    unchecked = r"^@dataclass\(frozen=True\)\nclass (\w*(?:Options|Model|Gaps|Config))\b"
    texts = {path.name: path.read_text(encoding="utf-8") for path in SOURCES.rglob("*.py")}
    found = {name: re.findall(unchecked, text, re.MULTILINE) for name, text in texts.items()}
    assert {name: classes for name, classes in found.items() if classes} == {}
    assert len(checked_classes()) > 50


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": None}, "name is None; use text"),
        ({"folder": 3}, "folder is 3; use a path or None"),
        ({"way": "left"}, "way is 'left'; use up or down"),
        ({"pair": (1.0, 2.0, 3.0)}, "pair is (1.0, 2.0, 3.0); use a list of 2 values"),
        ({"pair": (0.0, 2.0)}, "pair[0] is 0.0; use a number above 0"),
        ({"weights": {"a": -1}}, "weights.a is -1; use a number of at least 0"),
        ({"weights": 3}, "weights is 3; use a mapping (in TOML a table)"),
        ({"share": 0}, "share is 0; use a number above 0 and at most 1"),
        ({"share": 10**400}, f"share is 1{'0' * 56}...; use a number above 0 and at most 1"),
        ({"inner": {"dead_end": 3}}, "inner is {'dead_end': 3}; use CleanOptions (in TOML a table) or None"),
        (
            {"name": 1, "share": 2},
            "2 faults\n  1. name is 1; use text\n  2. share is 2; use a number above 0 and at most 1",
        ),
    ],
)
def test_what_is_wrong_is_said(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError) as caught:
        Everything(**changes)
    assert str(caught.value) == f"Everything: {message}"


def test_what_can_be_converted_is() -> None:
    made = Everything(folder="x", pair=[1, np.float32(2)], weights={"a": np.int64(3)}, share=1)  # type: ignore[arg-type]
    assert repr(made) == repr(Everything(folder=Path("x"), pair=(1.0, 2.0), weights={"a": 3.0}, share=1.0))


def test_tables_become_dataclasses_in_optional_fields_lists_and_mappings() -> None:
    made = options_from_table({"inner": {"dead_end": 3}, "many": [{"count": 5}, {}]}, Everything)
    assert made == Everything(inner=CleanOptions(dead_end=3), many=(Inner(count=5), Inner()))
    with pytest.raises(OptionError, match=r"^b.toml: many\[1\]: count is 'a'; use a whole number$"):
        options_from_table({"many": [{}, {"count": "a"}]}, Everything, where="b.toml")


def test_the_table_of_a_nested_fault_is_named(tmp_path: Path) -> None:
    path = tmp_path / "build.toml"
    path.write_text("[clean]\ndead_end = -3")
    with pytest.raises(OptionError) as caught:
        load_options(path, BuildOptions)
    assert str(caught.value) == f"{path}: clean: dead_end is -3; use a number of at least 0"
    path.write_text("[mask]\nthreshold = 0.9\nseed_threshold = 0.6")
    with pytest.raises(OptionError, match=r"build.toml: mask: threshold is 0.9, seed_threshold is 0.6; use thr"):
        load_options(path, BuildOptions)


def test_tables_of_what_has_no_default_have_to_be_whole() -> None:
    with pytest.raises(OptionError, match=r"^mine.toml: camera: there is no far and no half_angle and .*; set what"):
        changed_by(PRESETS["phone"], {"camera": {"near": 4.0}}, where="mine.toml")


def test_a_dataclass_that_would_not_be_checked_is_refused() -> None:
    with pytest.raises(TypeError, match="stands below @dataclass"):
        checked(Inner)
