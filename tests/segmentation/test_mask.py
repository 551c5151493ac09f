import numpy as np
import pytest
from scipy import ndimage

from probe2road.errors import OptionError
from probe2road.segmentation.mask import MaskOptions, threshold_mask


def test_parts_without_a_seed_go():
    probability = np.array(
        [
            [0.6, 0.6, 0.0, 0.6],
            [0.0, 0.0, 0.8, 0.0],
            [0.6, 0.0, 0.0, 0.0],
        ]
    )
    mask = threshold_mask(probability, threshold=0.5, seed_threshold=0.7)
    assert mask.astype(int).tolist() == [[1, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0]]


@pytest.mark.parametrize("density", [0.1, 0.4, 0.6])
def test_it_agrees_with_labelling_the_whole_image(density):
    rng = np.random.default_rng(0)
    probability = rng.random((70, 50)).astype(np.float32)
    threshold, seed = 1 - density, 1 - density / 8
    labels, n = ndimage.label(probability >= threshold, np.ones((3, 3)))
    certain = np.zeros(n + 1, bool)
    certain[np.unique(labels[probability >= seed])] = True
    certain[0] = False
    np.testing.assert_array_equal(
        threshold_mask(probability, threshold=threshold, seed_threshold=seed), certain[labels]
    )


def test_one_threshold_is_a_plain_threshold():
    probability = np.random.default_rng(1).random((20, 20))
    np.testing.assert_array_equal(threshold_mask(probability, threshold=0.5), probability >= 0.5)


def test_nothing_gives_nothing():
    assert not threshold_mask(np.zeros((5, 5)), threshold=0.5, seed_threshold=0.7).any()


def test_thresholds_must_be_in_order():
    with pytest.raises(OptionError, match="below"):
        threshold_mask(np.zeros((2, 2)), threshold=0.5, seed_threshold=0.4)


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"threshold": 1.5}, "threshold is 1.5"),
        ({"seed_threshold": 0.0}, "seed_threshold is 0.0"),
        ({"threshold": 0.6, "seed_threshold": 0.5}, "threshold is 0.6, seed_threshold is 0.5"),
    ],
)
def test_mask_options_that_mean_nothing_are_refused(options: dict[str, float], fault: str) -> None:
    with pytest.raises(OptionError, match=fault):
        MaskOptions(**options)
