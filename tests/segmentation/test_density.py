import numpy as np
import pytest
from scipy import ndimage

from probe2road.errors import OptionError
from probe2road.raster.counts import fleet_grid, rasterize, rasterize_windows
from probe2road.segmentation.density import DensityOptions, density_probability, density_segmenter
from sketches import fleet_of, grid_of


def fleet_of_lines(offsets, n_traces, *, noise=0.0, length=900.0, seed=0):
    """Traces along straight roads at these offsets north of the origin, each with its own lateral offset."""
    rng = np.random.default_rng(seed)
    x = 446000 + np.arange(0.0, length, 20.0)
    y = 4636000 + np.repeat(offsets, n_traces) + rng.normal(0, noise, len(offsets) * n_traces)
    return fleet_of(*(np.stack([x, np.full(len(x), north)], axis=1) for north in y))


def rows_of(probability, threshold=0.5):
    """Number of separate roads that a cut across the middle meets."""
    return ndimage.label(probability[:, probability.shape[1] // 2] >= threshold)[1]


def test_a_busy_road_does_not_swallow_its_quiet_neighbour():
    counts = np.zeros((81, 200), np.uint32)
    counts[25], counts[55] = 300, 1
    probability = density_probability(counts, grid_of(*counts.shape), options=DensityOptions(bandwidth=5.0))
    assert rows_of(probability) == 2
    assert probability[25, 100] == probability[:, 100].max()
    assert probability[40, 100] == 0.0


def test_the_probability_of_a_road_does_not_depend_on_how_busy_it_is_but_grows_with_it():
    levels = []
    for n in (1, 2, 5, 50):
        counts = np.zeros((61, 100), np.uint32)
        counts[30] = n
        levels.append(density_probability(counts, grid_of(61, 100), options=DensityOptions(bandwidth=4.0))[30, 50])
    assert levels == sorted(levels)
    assert levels[0] == pytest.approx(0.5, abs=0.01)
    assert levels[1] == pytest.approx(np.log2(3) / (np.log2(3) + 1), abs=0.01)
    assert levels[-1] < 1


def test_windows_with_a_halo_agree_with_the_whole():
    fleet = fleet_of_lines([0.0, 40.0, 90.0], 4, noise=3.0)
    grid = fleet_grid(fleet)
    segmenter = density_segmenter(fleet, grid, options=DensityOptions(bandwidth=6.0))
    whole = segmenter.predict(rasterize(fleet, grid), grid)
    for window, counts in rasterize_windows(fleet, grid, size=97, halo=segmenter.halo):
        part = segmenter.predict(counts, window.grid(grid))[window.inner]
        inner = (slice(2, -2), slice(2, -2))  # the whole raster cannot see beyond its border, a window can
        rows, cols = window.core
        core = whole[rows, cols]
        at_border = rows.start == 0 or cols.start == 0 or rows.stop == grid.rows or cols.stop == grid.cols
        where = inner if at_border else (slice(None), slice(None))
        np.testing.assert_allclose(part[where], core[where], atol=1e-6)


def test_no_traces_give_no_road():
    counts = np.zeros((50, 50), np.uint32)
    assert not density_probability(counts, grid_of(50, 50), options=DensityOptions(bandwidth=5.0)).any()


@pytest.mark.parametrize("options", [{"bandwidth": 0.0}, {"bandwidth": -1.0}])
def test_options_that_mean_nothing_are_refused(options):
    with pytest.raises(OptionError, match="DensityOptions"):
        DensityOptions(**options)


def test_a_bandwidth_is_needed():
    with pytest.raises(OptionError, match="density_segmenter"):
        density_probability(np.zeros((5, 5), np.uint32), grid_of(5, 5), options=DensityOptions())
