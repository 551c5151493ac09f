"""Features of cells, computed by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from probe2road.baselines.deepmg.features import PLANES, FeatureOptions, Steps, extract_features, thin_traces
from probe2road.baselines.deepmg.variants import find_variant
from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.raster.grid import Grid
from sketches import UTM

PUBLISHED, FIXED = find_variant("as_published"), find_variant("fixed")
GRID = Grid.from_bounds((0, 0, 79, 39), resolution=2.0, crs=UTM)  # 20 rows, 40 columns


def fleet(*traces: list[tuple[float, float, float]]) -> Fleet:
    """Return a fleet of traces given as (t, x, y)."""
    rows = [(name, *fix) for name, trace in enumerate(traces) for fix in trace]
    table = pd.DataFrame(rows, columns=["trace_id", "t", "x", "y"])
    return fleet_from_tables(table, crs=UTM, keep_crs=True)


def steps(*traces: list[tuple[float, float, float]]) -> Steps:
    return thin_traces(fleet(*traces))


EAST = [(0.0, 1.0, 21.0), (1.0, 21.0, 21.0), (2.0, 41.0, 21.0)]  # 20 m/s; cells (9, 0), (9, 10), (9, 20)


def plane(name: str, planes: np.ndarray) -> np.ndarray:
    return planes[PLANES.index(name)]


def test_fixes_fill_a_cell_by_halves_as_published_and_by_logarithm_when_fixed() -> None:
    standing = steps(EAST, EAST, EAST[1:])
    published, _ = extract_features(standing, GRID, PUBLISHED)
    fixed, _ = extract_features(standing, GRID, FIXED)
    assert plane("points", published)[9, [0, 10, 20, 5]].tolist() == [1.0, 1.0, 1.0, 0.0]
    np.testing.assert_allclose(plane("points", fixed)[9, [0, 10, 5]], [np.log10(3), np.log10(4), 0.0], rtol=1e-6)
    alone, _ = extract_features(steps(EAST), GRID, PUBLISHED)
    assert plane("points", alone)[9, 0] == 0.5


def test_every_trace_adds_one_line_however_often_it_comes_by() -> None:
    there_and_back = [*EAST, (3.0, 21.0, 21.0), (4.0, 1.0, 21.0)]
    published, _ = extract_features(steps(there_and_back, EAST), GRID, PUBLISHED)
    lines = plane("lines", published) * 255
    np.testing.assert_allclose(lines[9, :21], 32.0, rtol=1e-6)
    assert lines.sum() == pytest.approx(21 * 32.0, rel=1e-5)


def test_lines_are_full_at_sixteen_traces_as_published() -> None:
    planes, _ = extract_features(steps(*[EAST] * 20), GRID, PUBLISHED)
    assert plane("lines", planes).max() == 1.0
    planes, _ = extract_features(steps(*[EAST] * 20), GRID, FIXED)
    assert plane("lines", planes).max() == pytest.approx(np.log10(21))


def test_a_line_on_the_border_of_two_rows_inks_both_by_half() -> None:
    planes, _ = extract_features(steps([(t, x, 20.0) for t, x, _ in EAST]), GRID, PUBLISHED)
    np.testing.assert_allclose(plane("lines", planes)[8:12, 5] * 255, [0, 8, 8, 0], rtol=1e-6)


def test_speed_is_the_mean_over_steps_that_start_in_the_cell() -> None:
    slow = [(0.0, 1.0, 21.0), (2.0, 21.0, 21.0)]  # 10 m/s
    too_fast = [(0.0, 1.0, 21.0), (1.0, 41.0, 21.0)]  # 40 m/s: left out
    planes, _ = extract_features(steps(EAST, slow, too_fast), GRID, FIXED)
    speed = plane("speed", planes)
    assert speed[9, 0] == pytest.approx((15 / 34 - 0.5) * 2)
    assert speed[9, 10] == pytest.approx((20 / 34 - 0.5) * 2)
    assert speed[9, 20] == speed[0, 0] == -1.0


def test_speed_is_unknown_without_a_clock() -> None:
    table = pd.DataFrame({"trace_id": 0, "x": [1.0, 21.0], "y": [21.0, 21.0]})
    planes, _ = extract_features(thin_traces(fleet_from_tables(table, crs=UTM, keep_crs=True)), GRID, FIXED)
    assert (plane("speed", planes) == -1.0).all()
    assert plane("direction_e", planes)[9, 0] == 1.0


@pytest.mark.parametrize(
    ("step", "name"), [((0, 10), "n"), ((10, 10), "ne"), ((10, 4), "e"), ((-4, -10), "s"), ((-10, 9), "nw")]
)
def test_directions_fall_into_bins_around_the_eight_winds(step: tuple[float, float], name: str) -> None:
    planes, _ = extract_features(steps([(0.0, 41.0, 21.0), (1.0, 41.0 + step[0], 21.0 + step[1])]), GRID, FIXED)
    directions = planes[3:, 9, 20]
    assert PLANES[3 + int(directions.argmax())] == f"direction_{name}"
    assert directions.sum() == 1.0


def test_bytes_of_directions_start_again_at_zero_as_published() -> None:
    north = [(0.0, 1.0, 21.0), (1.0, 1.0, 31.0)]
    many = steps(*[EAST[:2]] * 256, north)
    assert extract_features(many, GRID, PUBLISHED)[0][3:6, 9, 0].tolist() == [1.0, 0.0, 0.0]
    np.testing.assert_allclose(extract_features(many, GRID, FIXED)[0][3:6, 9, 0], [1 / 257, 0, 256 / 257], rtol=1e-6)


def test_neighbours_are_recorded_on_a_coarse_grid_around_the_cell() -> None:
    _, packed = extract_features(steps(EAST), GRID, FIXED)
    flags = np.unpackbits(packed, axis=0)
    # 20 m east: column floor((20 + 300) / 75) = 4, row floor(300 / 75) = 4. 20 m west: column 3.
    assert np.flatnonzero(flags[:, 9, 0]).tolist() == [4 * 8 + 4]
    assert np.flatnonzero(flags[:, 9, 10]).tolist() == [4 * 8 + 4, 64 + 4 * 8 + 3]
    assert np.flatnonzero(flags[:, 9, 20]).tolist() == [64 + 4 * 8 + 3]
    assert flags.sum() == 4


def test_no_neighbour_is_recorded_as_published() -> None:
    """The corner that is recorded, 8 of 300 cells wide, is farther away than the longest step."""
    _, packed = extract_features(steps(EAST, [(0.0, 1.0, 21.0), (9.0, -200.0, 220.0)]), GRID, PUBLISHED)
    assert not packed.any()


def test_a_window_sees_what_the_whole_sees() -> None:
    rng = np.random.default_rng(3)
    traces = [[(float(t), *xy) for t, xy in enumerate(rng.uniform(-50, 100, (20, 2)))] for _ in range(5)]
    whole = extract_features(steps(*traces), GRID, FIXED)
    part = extract_features(steps(*traces), GRID.window(4, 8, 16, 16), FIXED)
    for one, other in zip(whole, part, strict=True):
        np.testing.assert_array_equal(one[:, 4:20, 8:24], other)


def test_thinning_keeps_the_first_fix_behind_a_gap_and_what_is_far_enough() -> None:
    trace = [(float(t), 3.0 * t, 0.0) for t in range(6)] + [(60.0 + t, 1000.0 + 3.0 * t, 0.0) for t in range(3)]
    thinned = thin_traces(fleet(trace), FeatureOptions(spacing=6.0))
    assert thinned.x.tolist() == [0.0, 6.0, 12.0, 1000.0, 1006.0]
    assert thinned.valid.tolist() == [False, True, True, False, True]
    assert thinned.starts.tolist() == [0, 3, 5]
    np.testing.assert_array_equal(thinned.seconds, [np.nan, 2.0, 2.0, np.nan, 2.0])


def test_dense_traces_show_nothing_without_thinning() -> None:
    """At ten fixes a second no step is longer than 5 m: the trap that thinning is there for."""
    dense = fleet([(0.1 * t, 2.0 * t, 21.0) for t in range(40)])
    raw, _ = extract_features(thin_traces(dense, FeatureOptions(spacing=0.0)), GRID, FIXED)
    thinned, _ = extract_features(thin_traces(dense), GRID, FIXED)
    assert not plane("lines", raw).any()
    assert (plane("lines", thinned)[9, :35] > 0).all()


def test_options_out_of_order_are_refused() -> None:
    with pytest.raises(OptionError, match="min_step < max_step"):
        FeatureOptions(min_step=300.0)
