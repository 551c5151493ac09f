"""The TOML of the guide sets options that exist."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from probe2road.io.formats import FleetFormat
from probe2road.options import options_from_table
from probe2road.recipe import BuildOptions

GUIDE = Path(__file__).parents[2] / "docs" / "guide"
BLOCKS = [
    (path.name, block)
    for path in sorted(GUIDE.rglob("*.md"))
    for block in re.findall(r"```toml\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
]


@pytest.mark.parametrize(("page", "block"), BLOCKS, ids=[page for page, _ in BLOCKS])
def test_block_is_a_configuration_of_build(page: str, block: str) -> None:
    table = tomllib.loads(block)
    options_from_table(table.pop("format", {}), FleetFormat, where=page)
    options_from_table(table, BuildOptions, where=page)
