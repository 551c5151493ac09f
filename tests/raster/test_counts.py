import numpy as np
import pandas as pd
import pytest

from probe2road.errors import CRSError, InputError
from probe2road.fleet.contract import Fleet, TraceGaps
from probe2road.raster.counts import count_pixels, fleet_grid, rasterize, rasterize_windows
from probe2road.raster.drawing import draw_lines
from probe2road.raster.grid import Grid
from sketches import fleet_of

ORIGIN = np.array([446000.0, 4636000.0])


def fleet_in_pixels(*traces, points=()):
    """A fleet whose traces are lists of (x, y) pixels east and north of the origin, one second apart."""
    semantic = None
    if points:
        semantic = pd.DataFrame(points, columns=["x", "y", "kind"]).assign(trace_id=0, t=0)
        semantic[["x", "y"]] += 0.5 + ORIGIN
    return fleet_of(*(np.array(trace) + 0.5 + ORIGIN for trace in traces), points=semantic)


def counts_of(fleet, cols, rows, **options):
    grid = Grid(ORIGIN[0], ORIGIN[1] + rows, 1.0, rows, cols, fleet.crs)
    return rasterize(fleet, grid, **options)


def test_a_line_is_drawn_once_however_many_fixes_it_has():
    sparse = counts_of(fleet_in_pixels([(0, 0), (8, 0)]), 9, 1)[0]
    dense = counts_of(fleet_in_pixels([(x, 0) for x in range(9)]), 9, 1)[0]
    assert sparse.tolist() == dense.tolist() == [[1] * 9]


def test_a_trace_that_comes_back_counts_again():
    there_and_back = counts_of(fleet_in_pixels([(0, 0), (4, 0), (0, 0)]), 5, 1)[0]
    assert there_and_back.tolist() == [[2, 2, 2, 2, 1]]


def test_standing_still_counts_once():
    assert counts_of(fleet_in_pixels([(2, 0)] * 5), 5, 1)[0].tolist() == [[0, 0, 1, 0, 0]]


def test_a_gap_is_not_bridged():
    counts = counts_of(fleet_in_pixels([(0, 0), (3, 0), (190, 0), (193, 0)]), 194, 1)[0]
    assert counts.sum() == 8
    bridged = counts_of(
        fleet_in_pixels([(0, 0), (3, 0), (190, 0), (193, 0)]), 194, 1, gaps=TraceGaps(max_step=500, max_speed=500)
    )
    assert bridged[0].sum() == 194


@pytest.mark.parametrize("end", [(7, 0), (7, 3), (7, 7), (3, 7), (0, 7)])
def test_bresenham_takes_one_pixel_a_step_within_half_a_pixel_of_the_line(end):
    counts = counts_of(fleet_in_pixels([(0, 0), end]), 8, 8)[0]
    row, col = np.nonzero(counts)
    across = np.abs((7 - row) * end[0] - col * end[1]) / max(end)
    assert counts.max() == 1
    assert counts.sum() == max(end) + 1
    assert across.max() <= 0.5


def test_direction_does_not_matter():
    rng = np.random.default_rng(3)
    walk = rng.integers(0, 40, (30, 2)).tolist()
    there, back = (counts_of(fleet_in_pixels(path), 40, 40)[0] for path in (walk, walk[::-1]))
    np.testing.assert_array_equal(there, back)


def test_points_are_counted_by_kind():
    points = [(1, 0, "lane_marking"), (1, 0, "lane_marking"), (2, 0, "road_boundary"), (99, 0, "road_boundary")]
    counts = counts_of(fleet_in_pixels([(0, 0), (3, 0)], points=points), 4, 1)
    assert counts[1].tolist() == [[0, 2, 0, 0]]
    assert counts[2].tolist() == [[0, 0, 1, 0]]


def test_windows_agree_with_the_whole():
    rng = np.random.default_rng(4)
    walks = [np.cumsum(rng.integers(-9, 10, (200, 2)), axis=0) + 60 for _ in range(5)]
    fleet = fleet_in_pixels(*walks, points=[(x, x, "lane_marking") for x in range(100)])
    grid = fleet_grid(fleet, margin=3)
    whole = rasterize(fleet, grid)
    padded = np.pad(whole, ((0, 0), (7, 7), (7, 7)))
    seen = np.zeros_like(whole)
    for window, counts in rasterize_windows(fleet, grid, size=37, halo=7):
        rows, cols = counts.shape[1:]
        expected = padded[:, window.row : window.row + rows, window.col : window.col + cols]
        inside = expected.copy()
        # What lies in the halo beyond the grid is drawn too; the whole raster cannot tell.
        beyond = ~np.pad(np.ones(grid.shape, bool), 7)[window.row : window.row + rows, window.col : window.col + cols]
        inside[:, beyond] = counts[:, beyond]
        np.testing.assert_array_equal(counts, inside)
        seen[:, *window.core] = counts[:, *window.inner]
    np.testing.assert_array_equal(seen, whole)


def test_a_finer_grid_keeps_the_number_of_traces():
    fleet = fleet_in_pixels([(0, 0), (20, 0)])
    fine = rasterize(fleet, Grid.from_bounds(fleet.bounds, resolution=0.2, crs=fleet.crs))[0]
    assert fine.max() == 1
    assert fine.sum() == 101


def test_an_empty_fleet_has_no_grid():
    fleet = fleet_in_pixels([(0, 0)])
    with pytest.raises(InputError, match="no fixes"):
        fleet_grid(Fleet(fleet.traces.iloc[:0], fleet.points, fleet.crs))


def test_the_grid_must_be_in_the_fleets_crs():
    fleet = fleet_in_pixels([(0, 0)])
    with pytest.raises(CRSError, match="to_crs"):
        rasterize(fleet, Grid(0.0, 0.0, 1.0, 1, 1, fleet.to_crs("EPSG:32617").crs))


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_a_mask_has_the_pixels_that_are_counted_widened(width):
    """Short and long lines, many of them across the border or outside."""
    rng = np.random.default_rng(width)
    row, col = rng.integers(-40, 70, (2, 400))
    owner = np.sort(rng.integers(0, 150, 400))
    breaks = np.diff(owner, prepend=-1) > 0
    none = np.zeros(0, np.int64)
    margin = 5  # so that lines outside the mask that reach into it are counted
    wider = (30 + 2 * margin, 20 + 2 * margin)
    counts = count_pixels(row + margin, col + margin, breaks, none, none, none, wider)[0]
    alone = breaks & np.append(breaks[1:], True)
    for r, c in zip(row[alone] + margin, col[alone] + margin, strict=True):
        if 0 <= r < wider[0] and 0 <= c < wider[1]:
            counts[r, c] -= 1
    before, after = width // 2, (width - 1) // 2
    expected = np.zeros((30, 20), np.uint8)
    for down in range(-before, after + 1):
        for right in range(-before, after + 1):
            top, left = margin - down, margin - right
            expected |= (counts[top : top + 30, left : left + 20] > 0).astype(np.uint8)
    np.testing.assert_array_equal(draw_lines(row, col, owner, (30, 20), width=width), expected)
