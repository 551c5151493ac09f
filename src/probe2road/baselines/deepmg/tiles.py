"""Training tiles: features and labels of squares of cells, computed once and kept on disk."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.baselines.deepmg.features import FeatureOptions, Steps, extract_features
from probe2road.baselines.deepmg.variants import find_variant
from probe2road.errors import InputError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path
from probe2road.raster.drawing import label_mask
from probe2road.raster.grid import Grid

__all__ = ["REGION_WIDTH", "TILE_CELLS", "Batch", "TileSet", "open_tiles", "read_batch", "tile_grids", "write_tiles"]

logger = logging.getLogger(__name__)

TILE_CELLS = 256  # along each side of a tile
REGION_WIDTH = 5  # cells; the region of a road is its centreline dilated by a square of so many

_INDEX = "tiles.json"


class Batch(NamedTuple):
    """The features and labels of B tiles."""

    planes: NDArray[np.float32]  # (B, 11, 256, 256)
    neighbours: NDArray[np.uint8]  # (B, 16, 256, 256), 128 bits packed
    line: NDArray[np.uint8]  # (B, 256, 256), 1 on a centreline
    region: NDArray[np.uint8]  # (B, 256, 256), 1 on a road


@dataclass(frozen=True)
class TileSet:
    """A folder of tiles, and the options they were made with."""

    folder: Path
    count: int
    variant: str
    features: FeatureOptions


def tile_grids(squares: Sequence[Any], *, resolution: float, crs: Any) -> list[Grid]:
    """Cover squares with as few tiles as possible; the outer tiles end at the border of the square.

    Parameters
    ----------
    squares
        Polygons of which the bounding box counts; at least one tile wide.
    resolution
        m per cell.
    crs
        Of the squares.

    Examples
    --------
    >>> grids = tile_grids([shapely.box(0, 0, 1000, 1000)], resolution=2.0, crs="EPSG:32617")
    >>> [(grid.left, grid.top) for grid in grids]
    [(0.0, 1000.0), (488.0, 1000.0), (0.0, 512.0), (488.0, 512.0)]
    """
    grids = []
    for square in squares:
        whole = Grid.from_bounds(_inner(shapely.bounds(square), resolution), resolution=resolution, crs=crs)
        grids += [
            whole.window(row, col, TILE_CELLS, TILE_CELLS)
            for row in _offsets(whole.rows)
            for col in _offsets(whole.cols)
        ]
    return grids


def write_tiles(
    folder: str | Path,
    steps: Steps,
    labels: RoadGraph,
    grids: Sequence[Grid],
    *,
    variant: str,
    features: FeatureOptions,
) -> TileSet:
    """Compute features and labels of tiles, and write them to a folder that is complete or absent.

    Tiles without a fix are left out: there is nothing to see in them.

    Parameters
    ----------
    folder
        Replaced where it exists; its parent must exist.
    steps
        From `probe2road.baselines.deepmg.features.thin_traces`, with the same features.
    labels
        The roads that shall be found.
    grids
        From `tile_grids`.
    variant, features
        What the network is to see.
    """
    count = 0
    with atomic_path(folder) as temporary:
        temporary.mkdir()
        for grid in grids:
            planes, neighbours = extract_features(steps, grid, find_variant(variant))
            if not planes[0].any():
                continue
            line, region = label_mask(labels, grid), label_mask(labels, grid, width=REGION_WIDTH)
            np.savez(temporary / f"{count:05d}.npz", planes=planes, neighbours=neighbours, line=line, region=region)
            count += 1
        index = {"count": count, "variant": variant, "features": asdict(features)}
        (temporary / _INDEX).write_text(json.dumps(index))
    logger.info("kept %d of %d tiles of %d cells in %s", count, len(grids), TILE_CELLS**2, folder)
    return TileSet(Path(folder), count, variant, features)


def open_tiles(folder: str | Path) -> TileSet:
    """Open a folder of tiles.

    Raises
    ------
    InputError
        If there are none.
    """
    path = Path(folder) / _INDEX
    if not path.is_file():
        raise InputError("there are no tiles", where=folder, fix="prepare them first")
    index = json.loads(path.read_text(encoding="utf-8"))
    return TileSet(Path(folder), index["count"], index["variant"], FeatureOptions(**index["features"]))


def read_batch(tiles: TileSet, numbers: Sequence[int]) -> Batch:
    """Read tiles by number."""
    parts = []
    for number in numbers:
        with np.load(tiles.folder / f"{number:05d}.npz") as part:
            parts.append([part[name] for name in Batch._fields])
    return Batch(*(np.stack(arrays) for arrays in zip(*parts, strict=True)))


def _inner(bounds: NDArray[np.float64], resolution: float) -> tuple[float, float, float, float]:
    """Return bounds with the far sides moved inwards by half a cell, to leave out cells that only touch them."""
    left, bottom, right, top = (float(value) for value in bounds)
    return left, bottom, right - resolution / 2, top - resolution / 2


def _offsets(cells: int) -> list[int]:
    """Return where tiles start along a side."""
    return [int(at) for at in np.linspace(0, cells - TILE_CELLS, -(-cells // TILE_CELLS)).round()]
