"""What must hold for every mask and every graph between thinning and cleaning."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pyproj import CRS
from scipy.ndimage import gaussian_filter, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.graph.check import check_graph
from probe2road.graph.clean import CleanOptions, clean_graph, collapse_short_edges, merge_degree_two_nodes
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.raster.counts import Grid
from probe2road.vectorize.lines import VectorizeOptions, vectorize
from probe2road.vectorize.skeleton import skeletonize, skeletonize_windows

PIXELS = VectorizeOptions(smoothing=0.0, simplify_tolerance=0.0)
ONE_STEP = 2**0.5 + 1e-6  # px; from a pixel to its farthest neighbour


@st.composite
def masks(draw: st.DrawFn) -> NDArray[np.bool_]:
    """Noise of any density, from single pixels to blobs with holes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    noise = rng.random((draw(st.integers(1, 40)), draw(st.integers(1, 40))))
    smooth = gaussian_filter(noise, draw(st.sampled_from([0.0, 0.8, 1.5, 3.0])))
    return smooth >= np.quantile(smooth, draw(st.floats(0.05, 0.95)))


@st.composite
def graphs(draw: st.DrawFn) -> RoadGraph:
    """Random streets cut where they cross; some cuts are missing, as at bridges, and some ends coincide."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    ends = np.round(rng.uniform(0, draw(st.sampled_from([40, 100, 300])), (draw(st.integers(1, 14)), 2, 2)))
    streets = [shapely.LineString(pair) for pair in ends if (pair[0] != pair[1]).any()]
    cut = shapely.get_parts(shapely.unary_union(streets[::2])) if streets else []
    ring = shapely.Point(*rng.uniform(0, 40, 2)).buffer(rng.uniform(1, 20), 4).exterior
    return graph_from_lines([*cut, *streets[1::2], shapely.LineString(ring)], crs="EPSG:32616", snap=0.5)


def grid_of(mask: NDArray[np.bool_]) -> Grid:
    return Grid(0.0, float(mask.shape[0]), 1.0, *mask.shape, CRS("EPSG:32616"))


def cycles(graph: RoadGraph) -> int:
    """Count the independent cycles."""
    row = {node: number for number, node in enumerate(graph.nodes.index)}
    u, v = (graph.edges[end].map(row).to_numpy(int) for end in ("u", "v"))
    n_nodes = len(row)
    parts, _ = connected_components(coo_array((np.ones(len(u)), (u, v)), shape=(n_nodes, n_nodes)), directed=False)
    return len(u) - n_nodes + int(parts)


@settings(max_examples=40, deadline=None)
@given(masks())
def test_no_pixel_of_the_skeleton_is_lost(mask: NDArray[np.bool_]) -> None:
    skeleton = skeletonize(mask)
    graph = vectorize(skeleton, grid_of(mask), options=PIXELS)
    check_graph(graph)
    parts, _ = label(skeleton, np.ones((3, 3)))
    rows, cols = np.nonzero(skeleton)
    centres = shapely.points(*grid_of(mask).xy(rows, cols))
    roads = shapely.union_all(graph.edges.geometry.to_numpy())
    lost = ~shapely.dwithin(centres, roads, ONE_STEP)
    # Only spots without direction may be missing: single pixels and squares of 2 x 2.
    for part in np.unique(parts[rows, cols][lost]):
        at = np.argwhere(parts == part)
        assert np.ptp(at, axis=0).max() <= 1


@settings(max_examples=40, deadline=None)
@given(masks())
def test_no_road_is_made_up(mask: NDArray[np.bool_]) -> None:
    skeleton = skeletonize(mask)
    graph = vectorize(skeleton, grid_of(mask), options=PIXELS)
    rows, cols = np.nonzero(skeleton)
    covered = shapely.union_all(shapely.buffer(shapely.points(*grid_of(mask).xy(rows, cols)), 1.5))
    assert shapely.covers(covered, graph.edges.geometry.to_numpy()).all()


@settings(max_examples=25, deadline=None)
@given(masks(), st.integers(1, 20), st.integers(2, 12))
def test_windows_are_the_whole(mask: NDArray[np.bool_], window: int, halo: int) -> None:
    np.testing.assert_array_equal(skeletonize_windows(mask, window=window, halo=halo), skeletonize(mask))


@settings(max_examples=40, deadline=None)
@given(graphs())
def test_merging_keeps_geometry_and_cycles(graph: RoadGraph) -> None:
    merged = merge_degree_two_nodes(graph)
    check_graph(merged)
    assert merge_degree_two_nodes(merged) is merged
    assert cycles(merged) == cycles(graph)
    np.testing.assert_allclose(merged.length, graph.length, atol=1e-6)
    before, after = (
        np.unique(shapely.get_coordinates(part.edges.geometry.to_numpy()), axis=0) for part in (graph, merged)
    )
    np.testing.assert_array_equal(before, after)


@settings(max_examples=60, deadline=None)
@given(graphs(), st.sampled_from([0.0, 5.0, 15.0, 40.0]))
def test_cleaning_twice_changes_nothing(graph: RoadGraph, limit: float) -> None:
    options = CleanOptions(short_edge=limit, dead_end=limit, component=limit)
    clean = clean_graph(graph, options=options)
    check_graph(clean)
    assert clean_graph(clean, options=options) is clean
    degree = clean.degrees()
    loops = clean.edges.loc[clean.edges["u"] == clean.edges["v"], "u"]
    assert degree[degree == 2].index.isin(loops).all()
    tips = clean.edges["u"].map(degree).eq(1) | clean.edges["v"].map(degree).eq(1)
    assert (clean.edges.loc[tips, "length"] >= limit).all()


@settings(max_examples=40, deadline=None)
@given(graphs(), st.sampled_from([0.5, 3.0, 8.0]))
def test_no_collapse_moves_a_line_by_more_than_it_may(graph: RoadGraph, limit: float) -> None:
    """Each round collapses edges that share no node; the lines after it are compared with those before."""
    before, after = graph, collapse_short_edges(graph, max_length=15.0, max_shift=limit)
    rounds = len(before.nodes) - len(after.nodes)
    old, new = (shapely.union_all(part.edges.geometry.to_numpy()) for part in (merge_degree_two_nodes(before), after))
    if not new.is_empty and rounds:
        assert shapely.hausdorff_distance(shapely.segmentize(old, 0.5), shapely.segmentize(new, 0.5)) <= rounds * (
            limit + 0.5
        )


@settings(max_examples=25, deadline=None)
@given(masks(), st.integers(-2000, 2000), st.integers(-2000, 2000))
def test_vectorising_depends_on_the_pixels_only(mask: NDArray[np.bool_], east: int, north: int) -> None:
    grid = grid_of(mask)
    moved = Grid(grid.left + east, grid.top + north, 1.0, grid.rows, grid.cols, grid.crs)
    one, other = (vectorize(skeletonize(mask), place) for place in (grid, moved))
    np.testing.assert_allclose(
        shapely.get_coordinates(other.edges.geometry.to_numpy()) - [east, north],
        shapely.get_coordinates(one.edges.geometry.to_numpy()),
        rtol=0,
        atol=1e-9,
    )
