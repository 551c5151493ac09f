"""Rasters in blocks say what an array says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pyproj import CRS

from probe2road.errors import OptionError
from probe2road.fleet.contract import fleet_from_tables
from probe2road.raster.blocks import Blocks
from probe2road.raster.counts import fleet_grid, rasterize_windows
from probe2road.raster.grid import Grid, read_blocks, read_raster, write_raster
from probe2road.segmentation.mask import threshold_mask
from probe2road.vectorize.lines import vectorize
from probe2road.vectorize.skeleton import skeletonize, skeletonize_windows

UTM = CRS.from_epsg(32632)


def two_roads() -> tuple[np.ndarray, Blocks]:
    """Draw two wide roads, far from each other, and a faint spot, as an array and in blocks."""
    array = np.zeros((300, 700), np.float32)
    array[10:17, 20:280] = 0.9
    array[5:290, 600:606] = 0.6
    array[100, 600:606] = 0.8
    array[200:203, 100:103] = 0.6
    blocks = Blocks(array.shape, np.float32, side=64)
    for top in range(0, 300, 100):
        blocks[top : top + 100, :] = array[top : top + 100]
    return array, blocks


def test_slices_and_pixels_are_those_of_the_array() -> None:
    array, blocks = two_roads()
    assert len(blocks.filled) < 20
    np.testing.assert_array_equal(blocks[:, :], array)
    np.testing.assert_array_equal(blocks[7:250, 590:], array[7:250, 590:])
    row, col = np.array([12, 250, 299, 12]), np.array([100, 603, 0, 601])
    np.testing.assert_array_equal(blocks[row, col], array[row, col])
    np.testing.assert_array_equal(blocks.nonzero(), np.nonzero(array))
    blocks[12:13, 100:103] = 0.0
    np.testing.assert_array_equal(blocks[12:13, 100:103], 0.0)


def test_mask_skeleton_and_graph_are_those_of_the_array() -> None:
    array, blocks = two_roads()
    mask = threshold_mask(blocks, threshold=0.5, seed_threshold=0.7)
    np.testing.assert_array_equal(mask[:, :], threshold_mask(array, threshold=0.5, seed_threshold=0.7))
    skeleton = skeletonize_windows(mask, window=96, halo=4)
    np.testing.assert_array_equal(skeleton[:, :], skeletonize(mask[:, :]))
    grid = Grid(0.0, 300.0, 1.0, 300, 700, UTM)
    ours = vectorize(skeleton, grid, probability=blocks)
    theirs = vectorize(skeleton[:, :], grid, probability=array)
    pd.testing.assert_frame_equal(pd.DataFrame(ours.edges), pd.DataFrame(theirs.edges))


def test_a_file_holds_the_blocks_alone(tmp_path: Path) -> None:
    array, blocks = two_roads()
    grid = Grid(0.0, 300.0, 1.0, 300, 700, UTM)
    write_raster(tmp_path / "blocks.tif", blocks, grid)
    write_raster(tmp_path / "array.tif", array, grid)
    for name in ("blocks.tif", "array.tif"):
        np.testing.assert_array_equal(read_raster(tmp_path / name)[0][0], array)
        np.testing.assert_array_equal(read_blocks(tmp_path / name)[0][:, :], array)


def test_a_country_takes_the_room_of_what_is_driven(tmp_path: Path) -> None:
    grid = Grid(0.0, 1e6, 1.0, 1_000_000, 1_000_000, UTM)
    country = Blocks(grid.shape, np.float32)
    country[10:13, 5:300] = 0.9
    country[999_000:999_300, 999_990:999_993] = 0.9
    write_raster(tmp_path / "country.tif", country, grid)
    assert (tmp_path / "country.tif").stat().st_size < 8_000_000
    read, read_grid = read_blocks(tmp_path / "country.tif")
    assert read_grid == grid
    skeleton = skeletonize_windows(threshold_mask(read, threshold=0.5))
    assert len(skeleton.filled) <= 8
    assert len(vectorize(skeleton, grid).edges) == 2


def two_cities(distance: float) -> pd.DataFrame:
    """Draw one drive of 100 m in each of two cities."""
    x = 500000.0 + 10 * np.arange(11)
    drives = [
        pd.DataFrame({"trace_id": k, "t": range(11), "x": x + k * distance, "y": 5.3e6 + k * distance}) for k in (0, 1)
    ]
    return pd.concat(drives)


def test_only_windows_of_the_cities_are_drawn() -> None:
    fleet = fleet_from_tables(two_cities(180_000.0), crs=UTM, keep_crs=True)
    grid = fleet_grid(fleet)
    drawn = list(rasterize_windows(fleet, grid, size=256, halo=16))
    assert sum(int(counts[0][window.inner].sum()) for window, counts in drawn) == 2 * 101
    assert len(drawn) <= 8


def test_a_resolution_that_nobody_can_hold_is_refused() -> None:
    fleet = fleet_from_tables(two_cities(500.0), crs=UTM, keep_crs=True)
    with pytest.raises(OptionError, match=r"resolution is 0.0001 m, which makes [\d,]+ pixels"):
        fleet_grid(fleet, resolution=0.0001)
