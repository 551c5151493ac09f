"""The counts behind a score, tile by tile, from which intervals are computed.

Strategy: the metrics run over the whole area, and only then is each sample, junction or pixel put down to the tile of
one square kilometre that it lies in. So nothing is cut at the borders of tiles, and the counts of all tiles add up to
those of the score.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.features import geometry_mask

from probe2road.benchmark.sets.tiles import TILE_SIZE
from probe2road.benchmark.tables.intervals import COUNTS
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.geo import GeoOptions, geo_samples
from probe2road.metrics.itopo import ItopoOptions, itopo_pairs
from probe2road.metrics.network import Network
from probe2road.metrics.soft_f1 import soft_f1
from probe2road.raster.drawing import label_mask
from probe2road.raster.grid import Grid

__all__ = ["geo_counts", "itopo_counts", "soft_counts"]


def geo_counts(proposal: Network, reference: Network, options: GeoOptions | None = None) -> pd.DataFrame:
    """Count the samples of GEO in each tile.

    Returns
    -------
    DataFrame
        Index ``tile`` (``"column_row"``, as in `probe2road.benchmark.sets.tiles`), columns `COUNTS`.

    Examples
    --------
    >>> from probe2road.metrics.normalise import comparable_networks
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graphs = [graph_from_lines([[(900, 10), (end, 10)]], crs="EPSG:32616") for end in (1010, 1120)]
    >>> geo_counts(*comparable_networks(*graphs))[["proposal", "reference"]].to_dict("index")
    {'0_0': {'proposal': 10, 'reference': 10}, '1_0': {'proposal': 1, 'reference': 11}}
    """
    samples = geo_samples(proposal, reference, options=options or GeoOptions())
    one, other = samples.proposal_matched, samples.reference_matched
    return pd.concat(
        [
            _tiles(samples.proposal_xy, matched_proposal=one, proposal=np.ones_like(one)),
            _tiles(samples.reference_xy, matched_reference=other, reference=np.ones_like(other)),
        ]
    ).pipe(_pooled)


def itopo_counts(proposal: Network, reference: Network, options: ItopoOptions | None = None) -> pd.DataFrame:
    """Count the samples of iTOPO in each tile; a pair belongs to the tile of its node. See `geo_counts`."""
    pairs = itopo_pairs(proposal, reference, options=options or ItopoOptions())
    tables = [
        _tiles(
            network.node_xy[side.node],
            matched_proposal=side.matched,
            proposal=side.proposal,
            matched_reference=side.matched,
            reference=side.reference,
        )
        for network, side in zip((proposal, reference), pairs, strict=True)
    ]
    return pd.concat(tables).pipe(_pooled)


def soft_counts(
    mask: NDArray[np.uint8], grid: Grid, reference: RoadGraph, *, width: int, area: shapely.Geometry | None = None
) -> pd.DataFrame:
    """Count the pixels of soft F1 in each tile.

    Parameters
    ----------
    mask
        Shape (rows, cols); nonzero is road.
    grid
        Where it lies.
    reference
        The roads; drawn as the labels of the training are.
    width
        Of the reference's lines, px.
    area
        Count only here.

    Returns
    -------
    DataFrame
        As `geo_counts`; tiles without a pixel of either are left out.
    """
    label = label_mask(reference, grid, width=width)
    step = round(TILE_SIZE / grid.resolution)
    rows = []
    # Tiles are those of the CRS, so the first ones may be cut by the border of the grid.
    first_col = int(np.floor(grid.left / TILE_SIZE))
    first_row = int(np.ceil(grid.top / TILE_SIZE)) - 1
    col_start = round((first_col * TILE_SIZE - grid.left) / grid.resolution)
    row_start = round((grid.top - (first_row + 1) * TILE_SIZE) / grid.resolution)
    for down, top in enumerate(range(row_start, grid.rows, step)):
        for along, left in enumerate(range(col_start, grid.cols, step)):
            window = slice(max(top, 0), top + step), slice(max(left, 0), left + step)
            inside = _inside(area, grid, window)
            score = soft_f1((mask[window] != 0) & inside, (label[window] != 0) & inside)
            if score.proposal or score.reference:
                rows.append(
                    [f"{first_col + along}_{first_row - down}", *(int(getattr(score, name)) for name in COUNTS)]
                )
    return pd.DataFrame(rows, columns=["tile", *COUNTS]).set_index("tile")


def _inside(area: shapely.Geometry | None, grid: Grid, window: tuple[slice, slice]) -> NDArray[np.bool_] | np.bool_:
    """Mark the pixels of a window whose centre lies in an area; all pixels if there is no area."""
    if area is None:
        return np.True_
    rows, cols = (part.indices(size) for part, size in zip(window, grid.shape, strict=True))
    left, top = grid.left + cols[0] * grid.resolution, grid.top - rows[0] * grid.resolution
    transform = Affine(grid.resolution, 0.0, left, 0.0, -grid.resolution, top)
    return np.asarray(geometry_mask([area], (rows[1] - rows[0], cols[1] - cols[0]), transform, invert=True))


def _tiles(xy: NDArray[np.float64], **counts: NDArray[np.generic]) -> pd.DataFrame:
    """Return the counts of places in a table, with the tile of each place."""
    column, row = np.floor(xy / TILE_SIZE).astype(np.int64).T
    return pd.DataFrame(
        {"column": column, "row": row, **{name: part.astype(np.int64) for name, part in counts.items()}}
    )


def _pooled(table: pd.DataFrame) -> pd.DataFrame:
    """Sum the counts of each tile."""
    sums = table.groupby(["column", "row"]).sum().reindex(columns=COUNTS, fill_value=0).astype(np.int64)
    sums.index = pd.Index([f"{column}_{row}" for column, row in sums.index], name="tile")
    return sums
