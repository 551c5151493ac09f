from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from skimage.morphology import thin

from probe2road.errors import InputError, OptionError
from probe2road.vectorize.skeleton import (
    FIXED,
    SET,
    Method,
    skeleton_pixels,
    skeletonize,
    skeletonize_windows,
    thin_state,
)
from sketches import mask_of

Mask = NDArray[np.bool_]


def random_mask(seed: int) -> Mask:
    """Noise where the seed is odd, smooth blobs like roads where it is even; both touch the border."""
    rng = np.random.default_rng(seed)
    if seed % 2:
        return rng.random((23, 31)) < rng.uniform(0.2, 0.95)
    return gaussian_filter(rng.random((40, 50)), rng.uniform(0.7, 3)) > 0.5


def goes_guo_hall(p: list[int], step: int) -> bool:
    """Formula of METHOD 7.1; p[2] is north, p[3] north-east, and so on clockwise."""
    c = (
        (not p[2] and (p[3] or p[4]))
        + (not p[4] and (p[5] or p[6]))
        + (not p[6] and (p[7] or p[8]))
        + (not p[8] and (p[9] or p[2]))
    )
    n1 = (p[9] | p[2]) + (p[3] | p[4]) + (p[5] | p[6]) + (p[7] | p[8])
    n2 = (p[2] | p[3]) + (p[4] | p[5]) + (p[6] | p[7]) + (p[8] | p[9])
    m = (p[2] or p[3] or not p[5]) and p[4] if step == 0 else (p[6] or p[7] or not p[9]) and p[8]
    return c == 1 and 2 <= min(n1, n2) <= 3 and not m


def goes_zhang_suen(p: list[int], step: int) -> bool:
    """Formula of METHOD 7.2."""
    ring = p[2:10]
    rises = sum(not a and b for a, b in zip(ring, ring[1:] + ring[:1], strict=True))
    sides = (p[2] * p[4] * p[6], p[4] * p[6] * p[8]) if step == 0 else (p[2] * p[4] * p[8], p[2] * p[6] * p[8])
    return 2 <= sum(ring) <= 6 and rises == 1 and not any(sides)


FORMULAS = {"guo_hall": goes_guo_hall, "zhang_suen": goes_zhang_suen}


def thin_by_formula(mask: Mask, method: Method) -> Mask:
    """Thin pixel by pixel, in parallel sub-iterations, as the paper writes it."""
    image = np.pad(mask, 1).astype(int)
    clockwise = [(-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)]
    changed = True
    while changed:
        changed = False
        for step in range(2):
            gone = [
                (r, c)
                for r, c in np.argwhere(image)
                if FORMULAS[method]([0, 0] + [int(image[r + dr, c + dc]) for dr, dc in clockwise], step)
            ]
            for r, c in gone:
                image[r, c] = 0
            changed |= bool(gone)
    return image[1:-1, 1:-1] == 1


class TestSkeletonize:
    @pytest.mark.parametrize("method", ["guo_hall", "zhang_suen"])
    @pytest.mark.parametrize("seed", range(6))
    def test_equals_the_formula(self, method: Method, seed: int) -> None:
        mask = random_mask(seed)
        np.testing.assert_array_equal(skeletonize(mask, method=method), thin_by_formula(mask, method))

    @pytest.mark.parametrize("seed", range(40))
    def test_equals_scikit_image_with_background_outside(self, seed: int) -> None:
        mask = random_mask(seed)
        np.testing.assert_array_equal(skeletonize(mask), thin(np.pad(mask, 1))[1:-1, 1:-1])

    def test_road_that_leaves_the_mask_is_thinned_as_any_other_end(self) -> None:
        mask = mask_of("########", "########", "########")
        assert skeletonize(mask).tolist() == mask_of("........", ".######.", "........").tolist()

    def test_diagonals_two_pixels_wide_keep_their_length_only_with_guo_hall(self) -> None:
        stairs = np.eye(9, dtype=bool) | np.eye(9, k=1, dtype=bool)
        assert skeletonize(stairs).sum() == 9
        assert skeletonize(stairs, method="zhang_suen").sum() == 1

    def test_squares_of_two_survive_only_with_guo_hall(self) -> None:
        square = mask_of("....", ".##.", ".##.", "....")
        assert skeletonize(square).any()
        assert not skeletonize(square, method="zhang_suen").any()

    def test_any_number_but_zero_is_road_and_the_input_stays(self) -> None:
        mask = random_mask(2) * 255
        before = mask.copy()
        np.testing.assert_array_equal(skeletonize(mask), skeletonize(mask > 0))
        np.testing.assert_array_equal(mask, before)

    @pytest.mark.parametrize("shape", [(0, 0), (0, 5), (1, 1), (3, 4)])
    def test_nothing_gives_nothing(self, shape: tuple[int, int]) -> None:
        skeleton = skeletonize(np.zeros(shape))
        assert skeleton.shape == shape
        assert not skeleton.any()

    def test_errors_name_the_fault(self) -> None:
        with pytest.raises(InputError, match="3 dimensions"):
            skeletonize(np.zeros((3, 4, 4)))
        with pytest.raises(OptionError, match="lee"):
            skeletonize(np.zeros((4, 4)), method="lee")  # type: ignore[arg-type]


class TestThinState:
    @pytest.mark.parametrize("seed", range(4))
    def test_equals_thinning_the_mask_where_nothing_is_fixed(self, seed: int) -> None:
        mask = np.pad(random_mask(seed), 1)
        state = mask.astype(np.uint8) * SET
        thin_state(state, method="zhang_suen")
        np.testing.assert_array_equal(state == SET, skeletonize(mask, method="zhang_suen"))

    @pytest.mark.parametrize("seed", range(4))
    def test_fixed_pixels_stay_and_nothing_is_added(self, seed: int) -> None:
        mask = np.pad(random_mask(seed), 1)
        fixed = mask & (np.random.default_rng(seed).random(mask.shape) < 0.05)
        state = np.where(fixed, FIXED, mask.astype(np.uint8) * SET)
        thin_state(state)
        assert (state[fixed] == FIXED).all()
        assert not state[~mask].any()
        assert set(np.unique(state)) <= {0, int(SET), int(FIXED)}


class TestSkeletonizeWindows:
    @pytest.mark.parametrize("seed", range(12))
    @pytest.mark.parametrize("method", ["guo_hall", "zhang_suen"])
    def test_equals_the_whole(self, seed: int, method: Method) -> None:
        mask = random_mask(seed)
        parts = skeletonize_windows(mask, window=11, halo=2, method=method)
        np.testing.assert_array_equal(parts, skeletonize(mask, method=method))

    def test_halo_grows_until_it_holds_a_wide_place(self, caplog: pytest.LogCaptureFixture) -> None:
        mask = np.zeros((90, 130), bool)
        mask[10:80, 10:80] = True
        mask[44:47, 80:125] = True
        caplog.set_level("INFO")
        np.testing.assert_array_equal(skeletonize_windows(mask, window=16, halo=4), skeletonize(mask))
        assert "halo of 64 pixels" in caplog.text

    def test_memory_maps(self, tmp_path: Path) -> None:
        mask = np.memmap(tmp_path / "mask", np.uint8, "w+", shape=(40, 50))
        mask[:] = random_mask(4)
        out = np.memmap(tmp_path / "skeleton", np.bool_, "w+", shape=(40, 50))
        assert skeletonize_windows(mask, out, window=16, halo=4) is out
        np.testing.assert_array_equal(np.asarray(out), skeletonize(np.asarray(mask)))

    def test_errors_name_the_fault(self) -> None:
        with pytest.raises(OptionError, match="halo is 0"):
            skeletonize_windows(np.zeros((4, 4)), halo=0)
        with pytest.raises(InputError, match="out has shape"):
            skeletonize_windows(np.zeros((4, 4)), np.zeros((4, 5), bool))


def test_pixels_of_strips_are_those_of_the_whole() -> None:
    skeleton = random_mask(1)
    for got, expected in zip(skeleton_pixels(skeleton, strip=5), np.nonzero(skeleton), strict=True):
        np.testing.assert_array_equal(got, expected)
