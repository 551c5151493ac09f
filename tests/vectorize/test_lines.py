from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.features import rasterize

from probe2road.errors import InputError, OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.raster.counts import Grid
from probe2road.vectorize.lines import VectorizeOptions, vectorize
from probe2road.vectorize.skeleton import skeleton_pixels, skeletonize
from probe2road.vectorize.tracing import trace_pixels
from sketches import mask_of

HALF_DIAGONAL = 0.5**0.5  # px


def grid_of(rows: int, cols: int, *, resolution: float = 1.0) -> Grid:
    return Grid(448000.0, 4636000.0, resolution, rows, cols, CRS("EPSG:32616"))


def drawn(*lines: shapely.LineString, width: float = 7.0, size: int = 160) -> NDArray[np.bool_]:
    """Roads of a width, drawn in pixels: x is the column, y the row."""
    return rasterize([line.buffer(width / 2) for line in lines], (size, size)).astype(bool)


def lines_in_pixels(graph: RoadGraph, grid: Grid) -> NDArray[np.object_]:
    """Edges with x = column and y = row of the grid, pixel centres at whole numbers plus a half."""

    def to_pixels(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([(xy[:, 0] - grid.left), (grid.top - xy[:, 1])], axis=1) / grid.resolution

    return shapely.transform(graph.edges.geometry.to_numpy(), to_pixels)


CROSSING = drawn(
    shapely.LineString([(10, 20), (150, 140)]),
    shapely.LineString([(15, 130), (140, 30)]),
    shapely.Point(90, 60).buffer(30).exterior,
)


@pytest.mark.parametrize("resolution", [1.0, 0.2, 2.5])
@pytest.mark.parametrize("tolerance", [0.0, 0.5, 1.0, 3.0])
def test_edges_stay_within_their_tolerance(resolution: float, tolerance: float) -> None:
    skeleton, grid = skeletonize(CROSSING), grid_of(160, 160, resolution=resolution)
    exact = vectorize(skeleton, grid, options=VectorizeOptions(smoothing=0, simplify_tolerance=0))
    options = VectorizeOptions(simplify_tolerance=tolerance)
    graph = vectorize(skeleton, grid, options=options)
    lines = (table.edges.geometry.to_numpy() for table in (exact, graph))
    distance = shapely.hausdorff_distance(*lines, densify=0.05)
    assert distance.max() <= tolerance + HALF_DIAGONAL * resolution + 1e-6
    assert exact.nodes.geometry.equals(graph.nodes.geometry)
    check_graph(graph)


def test_pixel_centres_become_metres() -> None:
    graph = vectorize(mask_of("....", ".##.", "...."), grid_of(3, 4, resolution=2.0))
    assert list(graph.edges.geometry[0].coords) == [(448003.0, 4635997.0), (448005.0, 4635997.0)]
    assert graph.edges["origin"].tolist() == ["segmentation"]


@pytest.mark.parametrize("angle", [4, 11, 23, 38, 45, 61, 86])
def test_straight_roads_have_usable_headings(angle: float) -> None:
    along = 65 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    graph = vectorize(skeletonize(drawn(shapely.LineString([80 - along, 80 + along]))), grid_of(160, 160))
    line = max(lines_in_pixels(graph, grid_of(160, 160)), key=lambda geometry: geometry.length)
    steps = np.diff(shapely.get_coordinates(line), axis=0)
    inner = steps[np.hypot(*steps.T) > 10]  # the rounded ends of the drawing are no road
    off = np.abs((np.degrees(np.arctan2(inner[:, 1], inner[:, 0])) - angle + 90) % 180 - 90)
    assert len(inner) > 0
    assert off.max() < 3.5


@pytest.mark.parametrize("radius", [10, 20, 50])
def test_circles_keep_their_shape(radius: float) -> None:
    circle = shapely.Point(80.5, 80.5).buffer(radius, 64).exterior
    graph = vectorize(skeletonize(drawn(circle)), grid_of(160, 160))
    (ring,) = lines_in_pixels(graph, grid_of(160, 160))
    assert ring.hausdorff_distance(circle) < 1.8
    assert ring.length == pytest.approx(circle.length, rel=0.06)


def test_small_loops_are_not_simplified_away() -> None:
    ring = mask_of(".##.", "#..#", "#..#", ".##.")
    graph = vectorize(ring, grid_of(4, 4), options=VectorizeOptions(simplify_tolerance=10.0))
    assert graph.edges[["u", "v"]].to_numpy().tolist() == [[0, 0]]
    assert graph.length > 6
    check_graph(graph)


def test_score_is_the_mean_probability_along_an_edge() -> None:
    skeleton = mask_of("....", "####", "....")
    probability = np.array([[9, 9, 9, 9], [0.2, 0.4, 0.6, 1.0], [9, 9, 9, 9]], np.float32)
    graph = vectorize(skeleton, grid_of(3, 4), probability=probability)
    assert graph.edges["score"].tolist() == pytest.approx([0.55])
    assert np.isnan(vectorize(skeleton, grid_of(3, 4)).edges["score"]).all()


@pytest.mark.parametrize(("down", "right"), [(0, 1), (7, 0), (3, 12), (1001, 2003)])
def test_moving_the_mask_moves_the_graph(down: int, right: int) -> None:
    moved = np.zeros((CROSSING.shape[0] + down, CROSSING.shape[1] + right), bool)
    moved[down:, right:] = CROSSING
    grid = grid_of(*CROSSING.shape)
    one = vectorize(skeletonize(CROSSING), grid)
    other = vectorize(skeletonize(moved), replace(grid, rows=moved.shape[0], cols=moved.shape[1]))
    assert one.edges[["u", "v", "key"]].equals(other.edges[["u", "v", "key"]])
    # Coordinates of up to 4.6e6 m in steps of a third of a pixel are equal to their last digits.
    for table, twin in ((one.nodes, other.nodes), (one.edges, other.edges)):
        first, second = (shapely.get_coordinates(part.geometry.to_numpy()) for part in (table, twin))
        np.testing.assert_allclose(second - [right, -down], first, rtol=0, atol=1e-8)


def test_no_road_gives_an_empty_graph() -> None:
    assert len(vectorize(np.zeros((3, 4), bool), grid_of(3, 4)).edges) == 0


def test_errors_name_the_fault() -> None:
    with pytest.raises(InputError, match=r"skeleton: shape \(3, 4\) is not the grid's \(3, 5\)"):
        vectorize(np.zeros((3, 4), bool), grid_of(3, 5))
    with pytest.raises(InputError, match="probability"):
        vectorize(np.zeros((3, 4), bool), grid_of(3, 4), probability=np.zeros((4, 4)))
    with pytest.raises(OptionError, match="smoothing is -1"):
        VectorizeOptions(smoothing=-1)


def crossing_gap(width: int, angle: float, turn: float, *, method: str) -> float:
    """Distance between the junctions that thinning makes of one crossing, pixels."""
    legs = [(np.cos(np.radians(a)), np.sin(np.radians(a))) for a in (turn, turn + angle)]
    roads = [shapely.LineString([(130 - 120 * x, 130 - 120 * y), (130 + 120 * x, 130 + 120 * y)]) for x, y in legs]
    skeleton = skeletonize(drawn(*roads, width=width, size=260), method=method)  # type: ignore[arg-type]
    pixels = trace_pixels(*skeleton_pixels(skeleton))
    degree = np.bincount(np.append(pixels.start, pixels.stop))
    at = np.stack([pixels.node_row, pixels.node_col], axis=1)[degree >= 3]
    at = at[np.hypot(*(at - 130).T) < 80]
    return float(np.hypot(*(at[:, None] - at[None]).T).max())


def test_fake_edges_grow_with_width_and_with_small_angles() -> None:
    def mean_gap(width: int, angle: float, method: str = "guo_hall") -> float:
        return float(np.mean([crossing_gap(width, angle, turn, method=method) for turn in np.arange(12) * 15 + 3.7]))

    # Order of magnitude of METHOD 7.3, px; it does not say how its masks were drawn.
    measured = {(5, 30): 21.5, (5, 45): 10.8, (13, 45): 21.7, (13, 60): 11.9}
    for (width, angle), expected in measured.items():
        assert 0.65 * expected < mean_gap(width, angle) < 1.1 * expected
    assert mean_gap(5, 90) < 2
    assert mean_gap(5, 60) <= mean_gap(5, 60, "zhang_suen")
