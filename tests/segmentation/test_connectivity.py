from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy import ndimage

from probe2road.errors import InputError, OptionError
from probe2road.segmentation.connectivity import connectivity_weights, dilate, distances, proximity, wrong_skeletons
from probe2road.vectorize.skeleton import skeletonize

masks = arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=12))


def line(row: int, size: int = 9) -> np.ndarray:
    mask = np.zeros((size, size), bool)
    mask[row] = True
    return mask


def test_the_small_buffer_grows_up_and_left_as_in_scipy():
    mask = np.zeros((7, 7), bool)
    mask[3, 3] = True
    assert np.argwhere(dilate(mask, "2x2")).tolist() == [[2, 2], [2, 3], [3, 2], [3, 3]]


@settings(max_examples=25, deadline=None)
@given(masks, st.sampled_from([2, 3]))
def test_dilation_agrees_with_scipy(mask, size):
    np.testing.assert_array_equal(
        dilate(mask, f"{size}x{size}"), ndimage.binary_dilation(mask, np.ones((size, size), bool))
    )


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("shift", "missed", "ghosts"), [(-1, 9, 0), (1, 0, 9)])
def test_a_shift_by_one_pixel_is_wrong_in_one_set_with_the_small_buffer(shift, missed, ghosts, axis):
    reference = line(4) if axis == 0 else line(4).T
    wrong = wrong_skeletons(np.roll(reference, shift, axis=axis), reference, buffer="2x2")
    assert (wrong.missed.sum(), wrong.ghost.sum()) == (missed, ghosts)


@pytest.mark.parametrize("shift", [-1, 1])
def test_the_wide_buffer_forgives_a_shift_by_one_pixel_to_either_side(shift):
    wrong = wrong_skeletons(line(4 + shift), line(4), buffer="3x3")
    assert not wrong.missed.any()
    assert not wrong.ghost.any()


@pytest.mark.parametrize("buffer", ["2x2", "3x3"])
def test_a_shift_by_two_pixels_is_wrong_on_both_sides(buffer):
    wrong = wrong_skeletons(line(6), line(4), buffer=buffer)
    np.testing.assert_array_equal(wrong.missed, line(4))
    np.testing.assert_array_equal(wrong.ghost, line(6))


def test_a_hole_is_missed_and_a_spur_is_a_ghost():
    reference = line(4)
    prediction = line(4)
    prediction[4, 3:6] = False
    prediction[6:, 0] = True
    wrong = wrong_skeletons(prediction, reference, buffer="3x3")
    assert np.argwhere(wrong.missed).tolist() == [[4, 4]]
    assert np.argwhere(wrong.ghost).tolist() == [[6, 0], [7, 0], [8, 0]]


@pytest.mark.parametrize("thinning", ["zhang_suen", "guo_hall"])
def test_wide_references_and_predictions_are_thinned(thinning):
    wide = ndimage.binary_dilation(line(4), np.ones((5, 1)))
    wrong = wrong_skeletons(wide, np.zeros_like(wide), thinning=thinning)
    np.testing.assert_array_equal(wrong.ghost, skeletonize(wide, method=thinning))
    assert not wrong_skeletons(wide, wide, thinning=thinning).missed.any()


def test_nothing_and_nothing_agree():
    nothing = np.zeros((1, 5, 6), bool)
    missed, wrong = connectivity_weights(nothing, nothing)
    assert missed.shape == wrong.shape == (1, 5, 6)
    assert not missed.any()
    assert not wrong.any()


def test_no_images_have_no_weights():
    none = np.zeros((0, 5, 6), bool)
    assert [weight.shape for weight in connectivity_weights(none, none)] == [(0, 5, 6)] * 2


@settings(max_examples=50, deadline=None)
@given(masks)
def test_distances_are_exact(mask):
    expected = ndimage.distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, np.inf)
    np.testing.assert_array_equal(distances(mask), expected.astype(np.float32))


def test_distances_are_exact_in_a_large_sparse_image():
    mask = np.random.default_rng(0).random((300, 700)) < 1e-4
    np.testing.assert_array_equal(distances(mask), ndimage.distance_transform_edt(~mask).astype(np.float32))


def test_proximity_fades_as_published():
    near = proximity(np.arange(301)[None] == 0, sigma=100)
    assert near.dtype == np.float32
    np.testing.assert_allclose(near[0, [0, 10, 50, 100, 200]], [1, 0.905, 0.61, 0.37, 0.135], atol=4e-3)


def test_weights_are_the_proximity_to_missed_and_to_all_wrong_skeletons():
    rng = np.random.default_rng(1)
    prediction, reference = (ndimage.gaussian_filter(rng.random((2, 60, 80)), (0, 3, 3)) > 0.51 for _ in range(2))
    with ThreadPoolExecutor(2) as pool:
        pooled = connectivity_weights(prediction, reference, sigma=30, pool=pool)
    for image in range(2):
        wrong = wrong_skeletons(prediction[image], reference[image])
        for weight, mask in zip(pooled, (wrong.missed, wrong.missed | wrong.ghost), strict=True):
            expected = np.exp(-ndimage.distance_transform_edt(~mask) / 30)
            np.testing.assert_allclose(weight[image], expected, rtol=1e-5)
    np.testing.assert_array_equal(pooled, connectivity_weights(prediction, reference, sigma=30))


def test_bad_input_is_refused():
    mask = np.zeros((4, 4), bool)
    with pytest.raises(InputError, match=r"shape \(4, 4\), the reference \(4, 3\)"):
        wrong_skeletons(mask, mask[:, :3])
    with pytest.raises(InputError, match="images, rows, cols"):
        connectivity_weights(mask, mask)
    with pytest.raises(OptionError, match="use one of 2x2, 3x3"):
        dilate(mask, "5x5")
    with pytest.raises(OptionError, match="sigma"):
        proximity(mask, sigma=0)
