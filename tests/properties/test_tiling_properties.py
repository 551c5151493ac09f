"""What must not change a merged probability: the order of the windows, and where the area lies."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from probe2road.segmentation.segmenter import Segmenter
from probe2road.segmentation.tiling import Merger, is_empty, predict_window, raster_windows, segment_raster
from sketches import grid_of


def blurred(counts, grid):
    """A network's stand-in: depends on the counts and on the place in the tile, as convolutions with padding do."""
    rows, cols = counts.shape[1:]
    place = np.sin(np.arange(rows))[:, None] * np.cos(np.arange(cols))
    return (1 / (1 + np.exp(place * 3 - counts.sum(axis=0, dtype=np.float64)))).astype(np.float32)


@st.composite
def rasters(draw):
    """Sparse counts, and a segmenter with tiles of some size and overlap."""
    rows, cols, window = draw(st.integers(1, 60)), draw(st.integers(1, 60)), draw(st.integers(1, 20))
    halo = draw(st.integers(0, window))
    counts = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).poisson(0.05, (3, rows, cols)).astype(np.uint32)
    return counts, Segmenter("test", blurred, window, halo, draw(st.booleans()), 0.5, 0.5, {})


@settings(max_examples=25, deadline=None)
@given(rasters(), st.randoms(use_true_random=False))
def test_the_order_of_the_windows_does_not_matter(raster, random):
    counts, segmenter = raster
    grid = grid_of(*counts.shape[1:])
    windows = list(raster_windows(counts, grid, size=segmenter.window, halo=segmenter.halo))
    random.shuffle(windows)
    merger = Merger(segmenter, grid.shape)
    for window, part in windows:
        if not is_empty(segmenter, window, part):
            merger.add(window, predict_window(segmenter, window, part, grid))
    shuffled = np.asarray(merger.probability())
    assert (shuffled == segment_raster(segmenter, counts, grid)).all()
    assert shuffled.max(initial=0) <= 1


@settings(max_examples=25, deadline=None)
@given(rasters(), st.integers(0, 3), st.integers(0, 3))
def test_empty_land_around_an_area_does_not_matter(raster, above, left):
    counts, segmenter = raster
    segmenter = replace(segmenter, window=8, halo=min(segmenter.halo, 8))
    rows, cols = counts.shape[1:]
    around = 8 * (above + 2), 8 * (left + 2)  # so far that no window at the border is driven in
    small = np.pad(counts, ((0, 0), (16, 16 + -rows % 8), (16, 16 + -cols % 8)))
    large = np.pad(counts, ((0, 0), (around[0], 40 + -rows % 8), (around[1], 40 + -cols % 8)))
    first, second = (segment_raster(segmenter, array, grid_of(*array.shape[1:])) for array in (small, large))
    inner = tuple(slice(first, first + length) for first, length in zip(around, (rows, cols), strict=True))
    assert (first[16 : 16 + rows, 16 : 16 + cols] == second[inner]).all()
