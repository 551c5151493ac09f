from pathlib import Path

import numpy as np
import pytest
import rasterio

from probe2road.errors import CRSError, InputError, OptionError
from probe2road.raster.grid import Grid, read_raster, sparse_zeros, write_raster
from sketches import UTM


def test_pixels_contain_their_positions():
    grid = Grid.from_bounds((446000.2, 4636000.7, 446100.9, 4636050.1), resolution=0.5, crs=UTM)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(446000.2, 446100.9, 500), rng.uniform(4636000.7, 4636050.1, 500)
    row, col = grid.rowcol(x, y)
    assert ((row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)).all()
    centre_x, centre_y = grid.xy(row, col)
    assert np.abs(centre_x - x).max() <= 0.25
    assert np.abs(centre_y - y).max() <= 0.25


def test_rows_run_south():
    grid = Grid.from_bounds((0, 0, 10, 10), crs=UTM)
    row, _ = grid.rowcol([5, 5], [9.5, 0.5])
    assert row[0] < row[1]


def test_moving_the_data_by_whole_pixels_moves_the_grid():
    here = Grid.from_bounds((446000.2, 4636000.7, 446100.9, 4636050.1), crs=UTM)
    there = Grid.from_bounds((446010.2, 4635993.7, 446110.9, 4636043.1), crs=UTM)
    assert there.shape == here.shape
    assert (there.left - here.left, there.top - here.top) == (10, -7)


def test_a_resolution_must_be_positive():
    with pytest.raises(OptionError, match="metres per pixel"):
        Grid.from_bounds((0, 0, 1, 1), resolution=0, crs=UTM)


def test_degrees_are_refused():
    with pytest.raises(CRSError, match="reproject"):
        Grid.from_bounds((0, 0, 1, 1), crs="EPSG:4326")


def test_windows_cover_every_pixel_once():
    grid = Grid.from_bounds((0, 0, 94, 41), crs=UTM)
    seen = np.zeros(grid.shape, int)
    for window in grid.windows(30, halo=4):
        seen[window.core] += 1
        padded = np.zeros(window.grid(grid).shape)
        assert padded[window.inner].shape == (window.rows, window.cols)
        assert window.grid(grid).xy(4, 4) == pytest.approx(grid.xy(window.row, window.col))
    assert (seen == 1).all()


@pytest.mark.parametrize("dtype", ["uint32", "float32", "bool", "uint8"])
def test_a_raster_comes_back_from_its_file(tmp_path, dtype):
    grid = Grid.from_bounds((446000, 4636000, 446099, 4636049), crs=UTM)
    array = (np.random.default_rng(1).random((2, *grid.shape)) * 9).astype(dtype)
    write_raster(tmp_path / "counts.tif", array, grid, names=["a", "b"])
    read, read_grid = read_raster(tmp_path / "counts.tif")
    np.testing.assert_array_equal(read.astype(dtype), array)
    assert read_grid == grid
    with rasterio.open(tmp_path / "counts.tif") as file:
        assert file.descriptions == ("a", "b")


def test_a_raster_that_is_none_is_named(tmp_path):
    (tmp_path / "noise.tif").write_bytes(b"not a raster")
    with pytest.raises(InputError, match=r"noise\.tif"):
        read_raster(tmp_path / "noise.tif")


def test_sparse_zeros_take_memory_where_they_are_written():
    resident = Path("/proc/self/statm")
    if not resident.exists():
        pytest.skip("this system does not tell how much memory a process has")
    before = int(resident.read_text().split()[1])
    area = sparse_zeros((20_000, 20_000), np.float32)
    for row in range(0, 20_000, 2_000):
        area[row : row + 100, 7_000:7_100] = 1
    pages = int(resident.read_text().split()[1]) - before
    assert area.sum() == 10 * 100 * 100
    assert pages * 4096 < 50e6  # of 1.6 GB
    assert sparse_zeros((0, 5), np.uint8).shape == (0, 5)
