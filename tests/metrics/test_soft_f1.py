from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from probe2road.errors import InputError
from probe2road.metrics import soft_f1


def line(row: int, width: int = 1) -> np.ndarray:
    mask = np.zeros((20, 30), np.uint8)
    mask[row : row + width] = 1
    return mask


def test_the_square_grows_towards_low_rows_and_columns() -> None:
    mask = np.zeros((7, 7), bool)
    mask[3, 3] = True
    assert np.argwhere(binary_dilation(mask, np.ones((2, 2)))).tolist() == [[2, 2], [2, 3], [3, 2], [3, 3]]
    assert soft_f1(mask, mask).proposal == 4
    assert soft_f1(mask, mask, size=3).proposal == 9


@pytest.mark.parametrize(("shift", "expected"), [(0, 1.0), (1, 0.5), (2, 0.0)])
def test_a_shifted_line(shift: int, expected: float) -> None:
    score = soft_f1(line(10 + shift), line(10))
    assert (score.precision, score.recall, score.f1) == (expected, expected, expected)


def test_the_symmetric_square_tolerates_more() -> None:
    assert soft_f1(line(11), line(10), size=3).f1 == pytest.approx(2 / 3)


def test_a_wide_prediction_loses_precision() -> None:
    score = soft_f1(line(9, width=3), line(10))
    assert (score.precision, score.recall) == (0.5, 1.0)


def test_tiles_are_pooled() -> None:
    """60 of 70 pixels are right, where the mean over the tiles would be a half."""
    small, large = np.zeros((20, 30), bool), np.zeros((20, 30), bool)
    small[5, 5:9], large[10, :] = True, True
    score = soft_f1([large, small], [large, np.zeros_like(small)])
    assert (score.matched_proposal, score.proposal, score.reference) == (60, 70, 60)


def test_empty_masks_score_zero() -> None:
    nothing = np.zeros((20, 30))
    for proposal, reference in ((nothing, line(3)), (line(3), nothing), (nothing, nothing)):
        assert soft_f1(proposal, reference).f1 == 0.0


def test_masks_of_different_shape_are_refused() -> None:
    with pytest.raises(InputError, match="differ"):
        soft_f1(np.zeros((3, 3)), np.zeros((4, 3)))
