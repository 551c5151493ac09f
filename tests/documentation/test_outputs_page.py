"""The page on outputs lists the columns that a built graph has in its file, no more and no less."""

from __future__ import annotations

import re
from pathlib import Path

import pyogrio
import pytest

import probe2road as p2r
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.networks.network import network_from_sections

PAGE = (Path(__file__).parents[2] / "docs" / "guide" / "outputs.md").read_text(encoding="utf-8")


def listed(heading: str) -> set[str]:
    """Return the columns in the table below a heading; one row may list two."""
    section = PAGE.split(f"### {heading}\n")[1].split("\n#")[0]
    cells = re.findall(r"^\| (`[^|]*?) \|", section, re.MULTILINE)
    return {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the graph of a few drives round a corner, which pass the whole recipe."""
    network = network_from_sections([[(0, 0), (400, 0)], [(400, 0), (400, 300)]], crs="EPSG:32616")
    path = tmp_path_factory.mktemp("outputs") / "roads.gpkg"
    p2r.write_graph(p2r.build(simulate(network, n_drives=12, seed=1).fleet), path)
    return path


@pytest.mark.parametrize("layer", ["edges", "nodes", "turns"])
def test_page_lists_the_columns_of_the_file(built: Path, layer: str) -> None:
    info = pyogrio.read_info(built, layer=layer)
    columns = set(info["fields"]) | ({"geometry"} if info["geometry_type"] else set())
    assert listed(layer.capitalize()) == columns
