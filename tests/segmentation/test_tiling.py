import numpy as np
import pytest

from probe2road.errors import InputError
from probe2road.segmentation.segmenter import Segmenter
from probe2road.segmentation.tiling import Merger, raster_windows, segment_raster
from sketches import grid_of


def segmenter(predict, *, window=8, halo=4, blend=True):
    return Segmenter("test", predict, window, halo, blend, threshold=0.5, seed_threshold=0.5, parameters={})


def always(value):
    return lambda counts, grid: np.full(counts.shape[1:], value, np.float32)


def test_weights_fall_from_the_centre_to_the_border():
    # Two tiles of 16 pixels that overlap by 8: one says 1, the other 0.
    counts = np.zeros((1, 8, 16), np.uint32)
    counts[0, 0, 0] = counts[0, 0, 15] = 1
    first = segmenter(lambda counts, grid: np.full(counts.shape[1:], grid.left < 446000, np.float32))
    share = segment_raster(first, counts, grid_of(8, 16))[4]
    offset = np.abs(np.arange(4, 12) + 0.5 - 4)  # of columns 4 to 11 from the centres, and from the middle row
    here, there = (1 - 0.5 * np.maximum(np.abs(d), 0.5) / 8 for d in (offset, 8 - offset))
    np.testing.assert_allclose(share[4:12], here / (here + there), atol=1 / 256)
    assert (share[:4] == 1).all()
    assert (share[12:] == 0).all()


@pytest.mark.parametrize(("window", "halo"), [(8, 4), (8, 0), (4, 6), (2, 7), (16, 3)])
@pytest.mark.parametrize("value", [1.0, 0.5, 0.123])
def test_where_all_tiles_agree_nothing_changes(window, halo, value):
    agreed = segment_raster(segmenter(always(value), window=window, halo=halo), np.ones((1, 37, 21)), grid_of(37, 21))
    np.testing.assert_allclose(agreed, np.float32(value), atol=1e-5)
    assert len(np.unique(agreed)) == 1


def test_an_area_nobody_drove_in_is_empty_and_never_looked_at():
    def refuse(counts, grid):
        raise AssertionError("looked at")

    counts = np.zeros((3, 40, 40), np.uint32)
    assert not segment_raster(segmenter(refuse), counts, grid_of(40, 40)).any()


@pytest.mark.parametrize("blend", [True, False])
def test_windows_nobody_drove_in_have_no_say_where_their_halo_reaches(blend):
    counts = np.zeros((1, 8, 48), np.uint32)
    counts[0, 4, 6] = 1  # only the first window, whose halo reaches column 11; the second sees it in its halo
    looked = []

    def certain(counts, grid):
        looked.append(grid.left)
        return np.ones(counts.shape[1:], np.float32)

    probability = segment_raster(segmenter(certain, blend=blend), counts, grid_of(8, 48))
    assert len(looked) == (1 if blend else 2)
    assert np.flatnonzero(probability[4]).tolist() == list(range(12 if blend else 16))
    assert (probability[4] == 1).sum() == (12 if blend else 16)


def test_without_blending_windows_answer_for_themselves():
    counts = np.ones((1, 20, 20), np.uint32)
    shapes = []

    def corner(counts, grid):
        shapes.append(counts.shape[1:])
        return np.full(counts.shape[1:], grid.left % 1000 / 1000, np.float32)

    probability = segment_raster(segmenter(corner, halo=3, blend=False), counts, grid_of(20, 20))
    assert shapes == [(8 + 6, 8 + 6)] * 2 + [(8 + 6, 4 + 6)] + [(8 + 6, 8 + 6)] * 2 + [(8 + 6, 4 + 6)] + [
        (4 + 6, 8 + 6)
    ] * 2 + [(4 + 6, 4 + 6)]
    np.testing.assert_allclose(
        probability[0, [0, 7, 8, 15, 16, 19]], [0.997, 0.997, 0.005, 0.005, 0.013, 0.013], atol=1e-5
    )


def test_windows_see_zeros_beyond_the_border():
    counts = np.arange(1, 13).reshape(1, 3, 4)
    (window, part), *_ = raster_windows(counts, grid_of(3, 4), size=2, halo=1)
    assert (window.row, window.col) == (0, 0)
    assert part[0].tolist() == [[0, 0, 0, 0], [0, 1, 2, 3], [0, 5, 6, 7], [0, 9, 10, 11]]


@pytest.mark.parametrize("bad", [np.nan, -1.0, np.inf])
def test_rasters_that_are_no_counts_are_refused(bad):
    counts = np.ones((3, 10, 10))
    counts[1, 2, 3:5] = bad
    with pytest.raises(InputError, match="raster: 2 values are negative, NaN or infinite; give counts"):
        segment_raster(segmenter(always(0.5)), counts, grid_of(10, 10))


@pytest.mark.parametrize("shape", [(10, 10), (3, 10, 11)])
def test_rasters_that_do_not_fit_the_grid_are_refused(shape):
    with pytest.raises(InputError, match="do not fit a grid of"):
        segment_raster(segmenter(always(0.5)), np.ones(shape), grid_of(10, 10))


def test_merging_changes_only_the_window_and_its_halo():
    window = grid_of(40, 40).windows(8, halo=4)[6]  # rows 8 to 16, columns 8 to 16
    merger = Merger(segmenter(always(1.0)), (40, 40))
    merger.add(window, np.ones((16, 16), np.float32))
    touched = np.argwhere(np.asarray(merger.probability()) > 0)
    assert touched.min() == 4
    assert touched.max() == 19


def test_a_hundred_tiles_on_a_pixel_do_not_overflow():
    dense = segmenter(always(1.0), window=4, halo=18)  # 40 px that overlap by nine tenths
    assert (segment_raster(dense, np.ones((1, 80, 80)), grid_of(80, 80)) == 1).all()
