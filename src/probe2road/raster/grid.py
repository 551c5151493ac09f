"""Pixel grids in a metric CRS, their windows, and raster files."""

from __future__ import annotations

import mmap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from pyproj import CRS

from probe2road.crs import parse_crs, require_metric
from probe2road.errors import InputError, OptionError
from probe2road.io.atomic import atomic_path
from probe2road.raster.blocks import Blocks

__all__ = ["Grid", "Window", "read_blocks", "read_raster", "read_tag", "sparse_zeros", "write_raster"]

_TILE, _LARGEST_TILE = 256, 4096  # px, side of a tile of a file
_MOST_TILES = 2**18  # in one file; each takes 16 bytes even if it is empty


@dataclass(frozen=True)
class Grid:
    """A north-up pixel grid in a metric CRS.

    Row 0 is the northernmost; pixel ``(row, col)`` covers ``left + col * resolution`` to
    ``left + (col + 1) * resolution`` east and likewise southwards from ``top``.

    Examples
    --------
    >>> grid = Grid.from_bounds((0.3, 0.2, 9.5, 4.9), resolution=1.0, crs="EPSG:32616")
    >>> grid.shape, grid.bounds
    ((5, 10), (0.0, 0.0, 10.0, 5.0))
    >>> grid.rowcol([0.5, 9.9], [4.5, 0.1])
    (array([0, 4]), array([0, 9]))
    """

    left: float
    top: float
    resolution: float  # m per pixel
    rows: int
    cols: int
    crs: CRS

    @classmethod
    def from_bounds(
        cls, bounds: tuple[float, float, float, float], *, resolution: float = 1.0, crs: Any, margin: float = 0.0
    ) -> Grid:
        """Return the smallest grid that covers bounds and a margin (m), on whole multiples of the resolution.

        Because the origin is a multiple of the resolution, moving the data by whole pixels moves the grid
        with it and changes no pixel.

        Raises
        ------
        OptionError
            If the resolution is not positive.
        """
        if not resolution > 0:
            raise OptionError(f"resolution is {resolution}", where="Grid", fix="use metres per pixel, for example 1.0")
        west, south, east, north = bounds
        left, bottom = (int(np.floor((low - margin) / resolution)) for low in (west, south))
        right, top = (int(np.floor((high + margin) / resolution)) + 1 for high in (east, north))
        metric = require_metric(parse_crs(crs))
        return cls(left * resolution, top * resolution, resolution, top - bottom, right - left, metric)

    @property
    def shape(self) -> tuple[int, int]:
        """Return ``(rows, cols)``."""
        return self.rows, self.cols

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return ``(left, bottom, right, top)``, metres."""
        return (
            self.left,
            self.top - self.rows * self.resolution,
            self.left + self.cols * self.resolution,
            self.top,
        )

    def rowcol(self, x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the pixel that contains each position; positions outside give indices outside the shape."""
        col = np.floor((np.asarray(x, np.float64) - self.left) / self.resolution)
        row = np.ceil((self.top - np.asarray(y, np.float64)) / self.resolution) - 1
        return row.astype(np.int64), col.astype(np.int64)

    def xy(self, row: ArrayLike, col: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the positions of pixel centres; rows and columns may be fractional."""
        x = self.left + (np.asarray(col, np.float64) + 0.5) * self.resolution
        y = self.top - (np.asarray(row, np.float64) + 0.5) * self.resolution
        return x, y

    def window(self, row: int, col: int, rows: int, cols: int) -> Grid:
        """Return the grid of a rectangle of pixels, which may extend beyond this grid."""
        return Grid(
            self.left + col * self.resolution, self.top - row * self.resolution, self.resolution, rows, cols, self.crs
        )

    def windows(self, size: int, *, halo: int = 0) -> list[Window]:
        """Cut the grid into square windows of ``size`` pixels (smaller at the far edges), row by row."""
        return [
            Window(row, col, min(size, self.rows - row), min(size, self.cols - col), halo)
            for row in range(0, self.rows, size)
            for col in range(0, self.cols, size)
        ]


@dataclass(frozen=True)
class Window:
    """A rectangle of a grid that is processed in one pass, and the context around it that the pass needs."""

    row: int
    col: int
    rows: int
    cols: int
    halo: int = 0  # pixels of context on every side, also beyond the grid

    @property
    def core(self) -> tuple[slice, slice]:
        """Return the rows and columns of the window in an array of the whole grid."""
        return slice(self.row, self.row + self.rows), slice(self.col, self.col + self.cols)

    @property
    def inner(self) -> tuple[slice, slice]:
        """Return the rows and columns of the window in an array that includes the halo."""
        return slice(self.halo, self.halo + self.rows), slice(self.halo, self.halo + self.cols)

    def grid(self, grid: Grid) -> Grid:
        """Return the grid of the window and its halo."""
        margin = 2 * self.halo
        return grid.window(self.row - self.halo, self.col - self.halo, self.rows + margin, self.cols + margin)


def write_raster(
    path: str | Path,
    array: NDArray[Any] | Blocks,
    grid: Grid,
    *,
    names: Sequence[str] = (),
    nodata: float | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write a raster as a compressed, tiled GeoTIFF that QGIS can open; the file is complete or absent.

    Parameters
    ----------
    path
        File to write.
    array
        Shape ``(channel, row, col)`` or ``(row, col)``. Of `probe2road.raster.blocks.Blocks` only the blocks that are
        there take room in the file.
    grid
        The array's grid.
    names
        One description per channel, or none.
    nodata
        Value to show as transparent.
    tags
        Notes that the file carries.
    """
    import rasterio

    profile = {
        "driver": "GTiff",
        "dtype": "uint8" if array.dtype == np.bool_ else array.dtype.name,
        "count": 1 if array.ndim == 2 else array.shape[0],
        "height": grid.rows,
        "width": grid.cols,
        "crs": grid.crs.to_wkt(),
        "transform": rasterio.Affine(grid.resolution, 0.0, grid.left, 0.0, -grid.resolution, grid.top),
        "compress": "zstd",
        "tiled": True,
        "nodata": nodata,
        "bigtiff": "if_safer",
        "sparse_ok": True,
        **_tiles(grid),
    }
    with atomic_path(path) as temporary, rasterio.open(temporary, "w", **profile) as target:
        if isinstance(array, Blocks):
            for row, col, pixels in array.windows():
                window = rasterio.windows.Window(col, row, pixels.shape[1], pixels.shape[0])
                target.write(pixels.astype(profile["dtype"], copy=False), 1, window=window)
        else:
            for number, band in enumerate(array[None] if array.ndim == 2 else array, start=1):
                target.write(band.astype(profile["dtype"], copy=False), number)
        for number, name in enumerate(names, start=1):
            target.set_band_description(number, name)
        target.update_tags(**tags or {})


def _tiles(grid: Grid) -> dict[str, int]:
    """Return the tile size of a file: 256 pixels, or more if the list of tiles alone would be large."""
    side = _TILE
    while -(-grid.rows // side) * -(-grid.cols // side) > _MOST_TILES and side < _LARGEST_TILE:
        side *= 2
    return {"blockxsize": side, "blockysize": side}


def sparse_zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of zeros that uses memory only where it is written to.

    An ordinary large array of zeros comes in pages of 2 MB, because numpy asks the system for large ones. A few windows
    written along a road then fill all of it. Here pages have their ordinary size of some kilobytes, on systems that map
    private memory; elsewhere it is an ordinary array.

    Examples
    --------
    >>> city = sparse_zeros((30_000, 30_000), np.float32)  # 3.4 GiB, if it were filled
    >>> city[5, 5:9] = 1
    >>> city[5, 3:7]
    array([0., 0., 1., 1.], dtype=float32)
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size == 0 or not hasattr(mmap, "MAP_PRIVATE"):
        return np.zeros(shape, dtype)
    # Systems that limit reserved memory should not count this array before it is used.
    unreserved = getattr(mmap, "MAP_NORESERVE", 0)
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | unreserved)
    return np.frombuffer(memory, dtype).reshape(shape)


def read_tag(path: str | Path, name: str) -> str | None:
    """Return a note that `write_raster` put into a file; None without a note or a readable file."""
    import rasterio

    try:
        with rasterio.open(path) as source:
            value = source.tags().get(name)
    except rasterio.errors.RasterioError:
        return None
    return None if value is None else str(value)


def read_blocks(path: str | Path) -> tuple[Blocks, Grid]:
    """Read the first band of a north-up GeoTIFF and its grid; tiles that are missing in the file use no memory.

    Raises
    ------
    InputError
        As `read_raster`.
    """
    import rasterio

    try:
        with rasterio.open(path) as source:
            grid = _grid_of(source, path)
            blocks = Blocks(grid.shape, source.dtypes[0])
            for (row, col), window in source.block_windows(1):
                if source.get_tag_item(f"BLOCK_OFFSET_{col}_{row}", "TIFF", bidx=1) is not None:
                    blocks[
                        window.row_off : window.row_off + window.height, window.col_off : window.col_off + window.width
                    ] = source.read(1, window=window)
    except rasterio.errors.RasterioError as error:
        raise InputError(f"not a readable raster ({error})", where=path) from error
    return blocks, grid


def read_raster(path: str | Path) -> tuple[NDArray[Any], Grid]:
    """Read a north-up GeoTIFF with square pixels: its bands ``(channel, row, col)`` and their grid.

    Raises
    ------
    InputError
        If the file cannot be read, is rotated, or has pixels that are not square.
    """
    import rasterio

    try:
        with rasterio.open(path) as source:
            grid = _grid_of(source, path)
            array = source.read()
    except rasterio.errors.RasterioError as error:
        raise InputError(f"not a readable raster ({error})", where=path) from error
    return array, grid


def _grid_of(source: Any, path: str | Path) -> Grid:
    """Return the grid of an open raster."""
    transform, crs = source.transform, source.crs
    if transform.b or transform.d or not np.isclose(transform.a, -transform.e):
        raise InputError("the raster is rotated or its pixels are not square", where=path, fix="warp it north-up")
    metric = require_metric(CRS.from_user_input(crs) if crs else None, where=path)
    return Grid(transform.c, transform.f, transform.a, source.height, source.width, metric)
