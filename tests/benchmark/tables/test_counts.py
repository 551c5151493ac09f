import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.benchmark.tables.counts import geo_counts, itopo_counts, soft_counts
from probe2road.benchmark.tables.intervals import COUNTS, difference_interval, f1_interval
from probe2road.metrics.geo import GeoOptions, geo_networks
from probe2road.metrics.itopo import ItopoOptions, itopo_networks
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.soft_f1 import soft_f1
from probe2road.raster.drawing import label_mask
from probe2road.raster.grid import Grid
from sketches import UTM, graph_of

STREETS = [[(x, 100.0), (x, 2700.0)] for x in np.arange(300.0, 2700.0, 400.0)]
CROSSINGS = [[(x, y), (x + 400.0, y)] for x in np.arange(300.0, 2200.0, 400.0) for y in (600.0, 1500.0)]


def split_at_crossings(lines):
    """The street grid with a node at every crossing."""
    union = shapely.union_all([shapely.LineString(line) for line in lines])
    return graph_of(*(part.coords for part in union.geoms))


@pytest.fixture(scope="module")
def networks():
    """A town, and a proposal of it that is shifted by 3 m and lacks a fifth of the streets."""
    reference = split_at_crossings(STREETS + CROSSINGS)
    kept = [line for number, line in enumerate(STREETS + CROSSINGS) if number % 5]
    proposal = split_at_crossings([[(x + 3.0, y) for x, y in line] for line in kept])
    return comparable_networks(proposal, reference)


@pytest.mark.parametrize(
    ("counts", "score"),
    [
        (geo_counts, lambda *networks: geo_networks(*networks, GeoOptions())),
        (itopo_counts, lambda *networks: itopo_networks(*networks, ItopoOptions())),
    ],
)
def test_the_counts_of_all_tiles_are_those_of_the_score(networks, counts, score):
    tiles = counts(*networks)
    whole = score(*networks)
    assert len(tiles) == 9
    assert tiles.sum().tolist() == [getattr(whole, name) for name in COUNTS]
    assert f1_interval(tiles).value == pytest.approx(whole.f1)


def test_pixels_are_counted_in_the_tiles_of_the_crs():
    grid = Grid.from_bounds((850.0, 930.0, 1300.0, 1200.0), crs=UTM)
    reference = graph_of([(860.0, 940.0), (1250.0, 1150.0)])
    mask = np.roll(label_mask(reference, grid, width=3), 1, axis=1)
    tiles = soft_counts(mask, grid, reference, width=3)
    assert sorted(tiles.index) == ["0_0", "0_1", "1_1"]
    whole = soft_f1(mask, label_mask(reference, grid, width=3))
    # Dilation does not reach over the border of a tile, so a few pixels are missing.
    assert tiles["proposal"].sum() == pytest.approx(whole.proposal, rel=0.02)
    assert f1_interval(tiles).value == pytest.approx(whole.f1, abs=0.01)


def test_pixels_outside_an_area_do_not_count():
    grid = Grid.from_bounds((0.0, 0.0, 100.0, 50.0), crs=UTM)
    reference = graph_of([(5.5, 20.5), (95.5, 20.5)])
    area = shapely.box(0.0, 0.0, 50.0, 50.0)
    tiles = soft_counts(label_mask(reference, grid), grid, reference, width=1, area=area)
    assert tiles["reference"].tolist() == [2 * 46]  # 45 pixels and one of dilation, two rows of them


def test_the_interval_narrows_with_more_tiles_and_knows_certainty():
    rng = np.random.default_rng(1)

    def tiles(n):
        matched = rng.integers(50, 100, n)
        return pd.DataFrame({name: matched if "matched" in name else 100 for name in COUNTS})

    few, many = (f1_interval(tiles(n)) for n in (10, 400))
    assert few.low < few.value < few.high
    assert many.high - many.low < (few.high - few.low) / 3
    certain = f1_interval(pd.DataFrame([[8, 10, 8, 10]] * 5, columns=COUNTS))
    assert certain.low == certain.high == pytest.approx(0.8)


def test_a_tile_that_only_one_method_reaches_counts_for_the_difference():

    ours = pd.DataFrame([[10, 10, 10, 10], [10, 10, 10, 10]], columns=COUNTS, index=["0_0", "1_0"])
    theirs = pd.DataFrame([[10, 10, 10, 10], [0, 0, 0, 10]], columns=COUNTS, index=["0_0", "1_0"])
    difference = difference_interval(ours, theirs)
    assert difference.value == pytest.approx(1.0 - 2.0 / 3.0)
    assert (difference.low, difference.high) == pytest.approx((0.0, 1.0))
