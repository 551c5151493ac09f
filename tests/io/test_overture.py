"""Segments of Overture Maps become a graph that meets at their connectors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import geopandas as gpd
import pytest
import shapely

from probe2road.io.graph_files import read_graph

# Two roads that share a connector in the middle, and a bridge over the first that shares none.
EAST = [(9.0, 48.0), (9.01, 48.0), (9.02, 48.0), (9.03, 48.0)]
NORTH = [(9.01, 47.99), (9.01, 48.0), (9.01, 48.01)]
BRIDGE = [(9.02, 47.99), (9.02, 48.0), (9.02, 48.01)]


def segment(name: str, places: list[tuple[float, float]], *at: float, **more: Any) -> dict[str, Any]:
    connectors = [{"connector_id": f"{name}{value}", "at": value} for value in (0.0, *at, 1.0)]
    return {
        "id": name,
        "subtype": "road",
        "class": "primary",
        "connectors": connectors,
        "access_restrictions": None,
        "level_rules": None,
        "sources": [{"dataset": "OpenStreetMap", "record_id": "w77@3", "property": ""}],
        "geometry": shapely.LineString(places),
        **more,
    }


@pytest.fixture
def file(tmp_path: Path) -> Path:
    closed = [{"access_type": "denied", "when": {"heading": "forward", "mode": None, "during": None}}]
    in_part = [{"access_type": "denied", "when": {"heading": "backward"}, "between": [0.0, 0.5]}]
    bridge = [{"value": 1, "between": None}]
    rows = [
        segment("east", EAST, 0.3334, access_restrictions=in_part),
        segment("north", NORTH, 0.5, access_restrictions=closed),
        segment("bridge", BRIDGE, level_rules=bridge),
        segment("rails", [(9.0, 48.02), (9.03, 48.02)], subtype="rail"),
    ]
    gpd.GeoDataFrame(rows, crs="EPSG:4326").to_parquet(tmp_path / "segments.parquet")
    return tmp_path / "segments.parquet"


def test_segments_meet_at_their_connectors_only(file: Path) -> None:
    graph = read_graph(file)
    assert sorted(graph.edges["segment"]) == ["bridge", "east", "east", "north", "north"]
    assert sorted(graph.degrees()) == [1, 1, 1, 1, 1, 1, 4]
    assert set(graph.edges["highway"]) == {"primary"}
    assert set(graph.edges["osmid"]) == {"77"}


def test_rules_become_tags(file: Path) -> None:
    edges = read_graph(file).edges.set_index("segment")
    assert edges.loc["bridge", "layer"] == 1
    assert edges["oneway"].dropna().to_dict() == {"north": "yes"}
    # Closed along its line: the edges are turned, and run south.
    assert all(line.coords[0][1] > line.coords[-1][1] for line in edges.geometry.loc["north"])
