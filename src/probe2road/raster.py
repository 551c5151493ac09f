"""Fleet data to count rasters: how many traces, lane markings and road boundaries each pixel has seen."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS

from probe2road.crs import parse_crs, require_metric
from probe2road.errors import OptionError

__all__ = ["CHANNELS", "Grid"]

logger = logging.getLogger(__name__)

CHANNELS = ("traces", "lane_markings", "road_boundaries")  # the paper's A, B, C


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
        """``(rows, cols)``."""
        return self.rows, self.cols

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """``(left, bottom, right, top)``, metres."""
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
        """Return the centres of pixels, which may be fractional."""
        x = self.left + (np.asarray(col, np.float64) + 0.5) * self.resolution
        y = self.top - (np.asarray(row, np.float64) + 0.5) * self.resolution
        return x, y

    def window(self, row: int, col: int, rows: int, cols: int) -> Grid:
        """Return the grid of a rectangle of pixels, which may reach outside."""
        return Grid(
            self.left + col * self.resolution, self.top - row * self.resolution, self.resolution, rows, cols, self.crs
        )
