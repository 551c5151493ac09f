from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import CRSError, InputError
from probe2road.graph.roadgraph import graph_from_lines
from probe2road.io.describe import describe_file
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.formats import FleetFormat
from probe2road.io.graph_files import write_graph

SECONDS = np.arange(5)
FIXES = gpd.GeoDataFrame(
    {
        "trip": [7] * 3 + [8] * 2,
        "time": pd.Timestamp("2024-05-01T08:00:00Z") + pd.to_timedelta(SECONDS, unit="s"),
        "speed_kmh": 36.0,
    },
    geometry=shapely.points(446000.0 + 10 * SECONDS, 4636000.0),
    crs="EPSG:32616",
)


@pytest.mark.filterwarnings("ignore:Field time")  # Shapefiles hold no times: they become text
@pytest.mark.parametrize("suffix", ["gpkg", "geojson", "fgb", "shp"])
def test_a_layer_of_points_is_a_table_of_fixes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"fixes.{suffix}"
    (FIXES.to_crs(4326) if suffix == "geojson" else FIXES).to_file(path)
    fleet = read_fleet(path)
    assert fleet.traces["trace_id"].tolist() == [7, 7, 7, 8, 8]
    assert fleet.traces["t"].dt.second.tolist() == [0, 1, 2, 3, 4]
    assert fleet.traces["speed"].tolist() == pytest.approx([10.0] * 5)
    assert fleet.traces["x"].tolist() == pytest.approx(446000.0 + 10 * SECONDS, abs=1e-3)
    assert fleet.crs.to_epsg() == 32616
    assert describe_file(path)["content"] == "fleet data"


def test_one_of_several_layers(tmp_path: Path) -> None:
    path = tmp_path / "week.gpkg"
    FIXES.to_file(path, layer="monday")
    FIXES.iloc[:3].to_file(path, layer="tuesday")
    with pytest.raises(InputError, match=r'several layers may hold the fixes \(monday, tuesday\).*layer="monday"'):
        read_fleet(path)
    with pytest.raises(InputError, match="there is no layer 'sunday'; the layers are monday, tuesday"):
        read_fleet(path, layer="sunday")
    assert len(read_fleet(path, layer="tuesday").traces) == 3
    assert describe_file(path, format=FleetFormat(layer="monday"))["fixes"] == 5


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
def test_layers_without_points_or_crs(tmp_path: Path) -> None:
    lines = gpd.GeoDataFrame(geometry=[shapely.LineString([(0, 0), (1, 1)])], crs="EPSG:32616")
    lines.to_file(tmp_path / "lines.gpkg")
    with pytest.raises(InputError, match="lines have no times"):
        read_fleet(tmp_path / "lines.gpkg")
    FIXES.set_crs(None, allow_override=True).to_file(tmp_path / "bare.fgb")
    with pytest.raises(CRSError, match="no CRS"):
        read_fleet(tmp_path / "bare.fgb")
    assert len(read_fleet(tmp_path / "bare.fgb", crs="EPSG:32616").traces) == 5


def test_a_map_in_a_folder_of_drives_is_no_drive(tmp_path: Path) -> None:
    FIXES.drop(columns="geometry").assign(x=FIXES.geometry.x, y=4636000.0).to_csv(tmp_path / "a.csv", index=False)
    write_graph(graph_from_lines([[(446000, 4636000), (446100, 4636000)]], crs="EPSG:32616"), tmp_path / "roads.gpkg")
    assert len(read_fleet(tmp_path, crs="EPSG:32616").traces) == 5
    assert describe_file(tmp_path / "roads.gpkg")["content"] == "road graph"
    (tmp_path / "week").mkdir()
    FIXES.to_file(tmp_path / "week" / "monday.gpkg")
    assert len(read_fleet(tmp_path / "week").traces) == 5


def test_semantic_points_are_read_from_layers_too(tmp_path: Path) -> None:
    FIXES.to_file(tmp_path / "fixes.gpkg")
    FIXES.assign(kind="curb").to_file(tmp_path / "seen.gpkg")
    assert read_fleet(tmp_path / "fixes.gpkg", tmp_path / "seen.gpkg").points["kind"].tolist() == ["road_boundary"] * 5
