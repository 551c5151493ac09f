from __future__ import annotations

import os
from pathlib import Path

import pytest

from probe2road.simulation.networks.network import network_from_sections

DATA = Path(os.environ.get("PROBE2ROAD_DATA", Path(__file__).parents[4] / "shared" / "data"))


@pytest.fixture(scope="session")
def fork():
    """A motorway with a ramp: 0 and 1 go straight on, 2 leaves between them."""
    lines = [[(0, 0), (2000, 0)], [(2000, 0), (4500, 0)], [(2000, 0), (2300, -30), (2700, -150)]]
    highway = ["motorway", "motorway", "motorway_link"]
    return network_from_sections(lines, crs="EPSG:32616", highway=highway, lanes_forward=[3, 3, 1])


@pytest.fixture(scope="session")
def extracts():
    """Folder of the OpenStreetMap extracts."""
    if not (DATA / "osm").is_dir():
        pytest.skip(f"the extracts are not at {DATA / 'osm'}; set PROBE2ROAD_DATA")
    return DATA / "osm"
