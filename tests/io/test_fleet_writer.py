from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest

from probe2road.errors import OutputError
from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.io.describe import describe_fleet
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import write_fleet


def small_fleet(*, points: bool = True, crs: str = "EPSG:2100") -> Fleet:
    traces = pd.DataFrame(
        {
            "trace_id": ["a", "a", "b"],
            "t": [0.125, 1, 2],
            "x": [482785.9, 482795.9, 482795.9],
            "y": 4216659.1,
            "z": [np.nan, 100.5, 101.0],
            "vehicle_id": ["v1", "v1", None],
        }
    )
    kinds = traces.drop(columns=["t", "vehicle_id"]).assign(kind=["lane_marking", "road_boundary", "lane_marking"])
    return fleet_from_tables(traces, kinds if points else None, crs=crs)


def test_two_files_that_other_tools_open(tmp_path: Path) -> None:
    fleet = small_fleet()
    written = write_fleet(fleet, tmp_path / "drives.parquet")
    assert [path.name for path in written] == ["drives.parquet", "drives.points.parquet"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drives.parquet", "drives.points.parquet"]
    frame = gpd.read_parquet(written[0])
    assert frame.crs.to_epsg() == 2100
    np.testing.assert_array_equal(frame.geometry.x, fleet.traces["x"])
    assert frame.geometry.has_z.all()


def test_a_folder_written_to_is_read_without_its_points(tmp_path: Path) -> None:
    fleet = small_fleet()
    _, points = write_fleet(fleet, tmp_path / "drives.parquet")
    pd.testing.assert_frame_equal(read_fleet(tmp_path, points).traces, fleet.traces)
    assert write_fleet(small_fleet(points=False), tmp_path / "drives.parquet") == [tmp_path / "drives.parquet"]
    assert not points.exists()


def test_other_suffixes_and_missing_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"the suffix '.csv' is not supported; use .parquet"):
        write_fleet(small_fleet(), tmp_path / "drives.csv")
    with pytest.raises(OutputError, match="does not exist"):
        write_fleet(small_fleet(), tmp_path / "nowhere" / "drives.parquet")
    assert list(tmp_path.iterdir()) == []


def test_the_description_of_a_fleet(tmp_path: Path) -> None:
    write_fleet(small_fleet(), tmp_path / "drives.parquet")
    figures = describe_fleet(tmp_path / "drives.parquet", points=tmp_path / "drives.points.parquet")
    assert figures == {
        "traces": 2,
        "fixes": 3,
        "lane_marking": 2,
        "road_boundary": 1,
        "start": "1970-01-01T00:00:00.125000+00:00",
        "end": "1970-01-01T00:00:02+00:00",
        "interval_median": 0.875,
        "interval_p95": 0.875,
        "step_median": 10.0,
        "step_p95": 10.0,
        "length_km": 0.01,
        "gaps": 0,
        "gap_share": 0.0,
        "share_without_z": 0.3333,
        "bbox": figures["bbox"],
        "crs": "EPSG:2100",
    }
    left, bottom, right, top = figures["bbox"]
    assert 23.8 < left < right < 23.81
    assert 38.0 < bottom <= top < 38.2


def test_the_description_of_a_fleet_without_clock_or_steps() -> None:
    table = pd.DataFrame({"trace_id": [1, 2], "x": [446e3, 447e3], "y": 4636e3})
    figures = describe_fleet(fleet_from_tables(table, crs="EPSG:32616"))
    assert figures["start"] is figures["interval_median"] is figures["step_median"] is None
    assert (figures["length_km"], figures["gaps"], figures["gap_share"]) == (0.0, 0, 0.0)
