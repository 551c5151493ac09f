from dataclasses import dataclass, field

import pytest

from probe2road.errors import OptionError
from probe2road.matching.match import MatchOptions
from probe2road.options import load_options, options_from_table


@dataclass(frozen=True)
class Inner:
    length: float = 1.0
    count: int = 2


@dataclass(frozen=True)
class Outer:
    name: str = "x"
    limit: float | None = None
    near: Inner = field(default_factory=lambda: Inner(length=9.0))


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
        ({"near": {"size": 1}}, "near: there is no option 'size'"),
        ({"name": 3}, "name: 3 is not of type str"),
        ({"near": {"count": 1.5}}, "count: 1.5 is not of type int"),
        ({"limit": "far"}, "'far' is not of type float"),
        ({"near": 3}, "near: 3 is not of type Inner"),
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
