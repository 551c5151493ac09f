"""Tiles of one square kilometre, and splits of them that have no road in common.

Strategy: validation and test tiles are compact blocks of neighbours. Around each block every tile of another split
is left out, so that at least one whole tile lies between any two splits. The blocks are drawn many times over; of
the draws that leave enough tiles for training, the one is taken whose blocks resemble the whole most in how much
motorway, how much ramp and how many crossings a tile holds.
"""

from __future__ import annotations

from collections.abc import Mapping

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.errors import InputError, OptionError
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["SPLITS", "TILE_SIZE", "motorway_tiles", "split_area", "split_tiles"]

SPLITS = ("train", "validation", "test")
TILE_SIZE = 1000.0  # m

_SAMPLE = 5.0  # m; a road is assigned to tiles in pieces of this length
_BLOCK = 6  # tiles that are drawn together; larger blocks have fewer tiles around them that are lost

_Tile = tuple[int, int]


def motorway_tiles(network: RoadNetwork, *, size: float = TILE_SIZE) -> gpd.GeoDataFrame:
    """List the tiles of a network that contain motorways or their ramps.

    Tiles are aligned to multiples of their size in the network's CRS.

    Parameters
    ----------
    network
        Any road network; empty of motorways, it has no tiles.
    size
        Side of a tile, m.

    Returns
    -------
    GeoDataFrame
        Index ``tile`` (``"column_row"``, counted from the origin of the CRS), ``column``, ``row``, ``motorway`` and
        ``ramp`` (m of carriageway, to the nearest 5 m for each section), ``crossings`` (places where any two roads
        cross without meeting), ``geometry`` (the square); ordered by column and row.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> network = network_from_sections([[(500, 20), (2200, 20)]], crs="EPSG:32616")
    >>> motorway_tiles(network)["motorway"].to_dict()
    {'0_0': 500.0, '1_0': 1000.0, '2_0': 200.0}
    """
    sections = network.sections[network.sections["highway"].isin(("motorway", "motorway_link"))]
    lengths = sections.length.to_numpy()
    pieces = np.maximum(np.rint(lengths / _SAMPLE).astype(np.int64), 1)
    owner = np.repeat(np.arange(len(sections)), pieces)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    middle = (number + 0.5) / pieces[owner]
    points = shapely.line_interpolate_point(sections.geometry.to_numpy()[owner], middle, normalized=True)
    place = np.floor(shapely.get_coordinates(points).reshape(-1, 2) / size).astype(np.int64)
    table = pd.DataFrame({"column": place[:, 0], "row": place[:, 1], "length": (lengths / pieces)[owner]})
    table["kind"] = np.where(sections["highway"].to_numpy()[owner] == "motorway", "motorway", "ramp")
    tiles = table.pivot_table("length", ["column", "row"], "kind", "sum", fill_value=0.0).reset_index()
    tiles = tiles.reindex(columns=["column", "row", "motorway", "ramp"], fill_value=0.0).rename_axis(columns=None)
    crossing = np.floor(_crossings(network) / size).astype(np.int64)
    counted = pd.Series(list(map(tuple, crossing.tolist())), dtype=object).value_counts()
    tiles["crossings"] = [int(counted.get(place, 0)) for place in zip(tiles["column"], tiles["row"], strict=True)]
    left, bottom = (tiles[["column", "row"]].to_numpy(np.float64) * size).T
    tiles.index = pd.Index([f"{c}_{r}" for c, r in zip(tiles["column"], tiles["row"], strict=True)], name="tile")
    squares = shapely.box(left, bottom, left + size, bottom + size)
    return gpd.GeoDataFrame(tiles.round({"motorway": 3, "ramp": 3}), geometry=squares, crs=network.crs)


def split_tiles(
    tiles: gpd.GeoDataFrame, counts: Mapping[str, int], *, rng: np.random.Generator, attempts: int = 20_000
) -> gpd.GeoDataFrame:
    """Choose tiles for training, validation and test so that no two splits touch.

    Parameters
    ----------
    tiles
        From `motorway_tiles`.
    counts
        Tiles of each of `SPLITS`.
    rng
        Draws the blocks.
    attempts
        Draws to choose from.

    Returns
    -------
    GeoDataFrame
        The tiles with a column ``split``: one of `SPLITS`, or empty for the tiles between splits and those that are
        left over, which hold the least road.

    Raises
    ------
    OptionError
        If the counts name another split, or no draw leaves enough tiles.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> network = network_from_sections([[(0, 20), (20000, 20)]], crs="EPSG:32616")
    >>> counts = {"train": 6, "validation": 4, "test": 4}
    >>> rng = np.random.default_rng(1)
    >>> split = split_tiles(motorway_tiles(network), counts, rng=rng, attempts=100)["split"]
    >>> split.value_counts().to_dict() == {**counts, "": 6}
    True
    """
    if set(counts) != set(SPLITS):
        raise OptionError(f"splits are {', '.join(counts)}", where="split_tiles", fix=f"give {', '.join(SPLITS)}")
    places = list(zip(tiles["column"].tolist(), tiles["row"].tolist(), strict=True))
    road = (tiles["motorway"] + tiles["ramp"]).to_numpy()
    features = tiles[["motorway", "ramp", "crossings"]].to_numpy(np.float64)
    features = features / np.maximum(features.mean(axis=0), 1e-9)
    row_of = {place: row for row, place in enumerate(places)}
    best, least = None, np.inf
    for _ in range(attempts):
        drawn = _draw(places, counts, rng)
        if drawn is None:
            continue
        blocks, free = drawn
        if len(free) < counts["train"]:
            continue
        rows = {split: [row_of[place] for place in block] for split, block in blocks.items()}
        unlike = sum(np.abs(features[chosen].mean(axis=0) - features.mean(axis=0)).sum() for chosen in rows.values())
        if unlike < least:
            spare = sorted((row_of[place] for place in free), key=lambda row: (-road[row], row))
            best, least = {**rows, "train": spare[: counts["train"]]}, unlike
    if best is None:
        raise OptionError(
            f"{len(tiles)} tiles are too few for {dict(counts)} with a tile between splits",
            where="split_tiles", fix="ask for fewer, or use a larger network",
        )  # fmt: skip
    split = np.full(len(tiles), "", object)
    for name, rows_of_split in best.items():
        split[rows_of_split] = name
    return tiles.assign(split=split.astype(str))


def split_area(tiles: gpd.GeoDataFrame, split: str, *, inset: float = 0.0) -> shapely.Geometry:
    """Return the area of a split as a polygon or several polygons, for clipping.

    Parameters
    ----------
    tiles
        From `split_tiles`, or the layer of that name in a data set.
    split
        One of `SPLITS`.
    inset
        Metres left out along the border.

    Raises
    ------
    InputError
        If there is no such split, or nothing is left of it.

    Examples
    --------
    >>> squares = [shapely.box(0, 0, 9, 9), shapely.box(9, 0, 18, 9)]
    >>> tiles = gpd.GeoDataFrame({"split": ["test", "test"]}, geometry=squares)
    >>> split_area(tiles, "test").bounds, split_area(tiles, "test", inset=2).area
    ((0.0, 0.0, 18.0, 9.0), 70.0)
    """
    area = shapely.union_all(tiles.geometry.to_numpy()[(tiles["split"] == split).to_numpy()])
    if inset:
        area = shapely.buffer(area, -inset, join_style="mitre")
    if area.is_empty:
        raise InputError(f"there is no area of split {split!r}", where="tiles", fix=f"use one of {', '.join(SPLITS)}")
    return area


def _crossings(network: RoadNetwork) -> NDArray[np.float64]:
    """Return the places where two sections without a common node cross in plan: shape ``(n, 2)``, m."""
    lines = network.sections.geometry.to_numpy()
    ends = network.sections[["u", "v"]].to_numpy()
    i, j = shapely.STRtree(lines).query(lines, predicate="crosses")
    apart = (i < j) & ~(ends[i][:, :, None] == ends[j][:, None, :]).any(axis=(1, 2))
    points = shapely.get_parts(shapely.intersection(lines[i[apart]], lines[j[apart]]))
    return shapely.get_coordinates(shapely.centroid(points)).reshape(-1, 2)


def _draw(
    places: list[_Tile], counts: Mapping[str, int], rng: np.random.Generator
) -> tuple[dict[str, list[_Tile]], set[_Tile]] | None:
    """Draw blocks for test and validation: return the tiles of each, and those that no block touches."""
    free = set(places)
    drawn: dict[str, list[_Tile]] = {}
    for split in ("test", "validation"):
        drawn[split] = []
        around: set[_Tile] = set()
        while len(drawn[split]) < counts[split]:
            block = _grow(sorted(free), min(_BLOCK, counts[split] - len(drawn[split])), rng)
            if block is None:
                return None
            drawn[split] += block
            free -= set(block)
            around |= {place for tile in block for place in _neighbours(tile)}
        free -= around
    return drawn, free


def _grow(free: list[_Tile], size: int, rng: np.random.Generator) -> list[_Tile] | None:
    """Grow a block of adjacent tiles from a random tile; return None if there is not enough space."""
    if not free:
        return None
    available = set(free)
    block = [free[int(rng.integers(len(free)))]]
    while len(block) < size:
        border = sorted({place for tile in block for place in _neighbours(tile)} & available - set(block))
        if not border:
            return None
        block.append(border[int(rng.integers(len(border)))])
    return block


def _neighbours(tile: _Tile) -> list[_Tile]:
    """List the eight tiles around a tile."""
    return [(tile[0] + i, tile[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
