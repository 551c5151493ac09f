"""Masks to graphs, drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest

from probe2road.baselines.deepmg.mask_graph import mask_graph
from probe2road.baselines.deepmg.variants import find_variant
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.raster.grid import Grid
from sketches import UTM


def graph_of_mask(mask: np.ndarray, variant: str) -> RoadGraph:
    grid = Grid.from_bounds((0, 0, 2 * mask.shape[1] - 1, 2 * mask.shape[0] - 1), resolution=2.0, crs=UTM)
    graph = mask_graph(mask, grid, find_variant(variant))
    check_graph(graph)
    return graph


def crossing() -> np.ndarray:
    mask = np.zeros((61, 61), bool)
    mask[29:32, 5:56] = True
    mask[5:56, 29:32] = True
    return mask


def two_ways() -> np.ndarray:
    """Return a road that parts into two ways, which meet again."""
    mask = np.zeros((61, 101), bool)
    mask[30, 5:31] = mask[30, 70:96] = True
    mask[15, 30:71] = mask[45, 30:71] = True
    mask[15:46, 30] = mask[15:46, 70] = True
    return mask


@pytest.mark.parametrize("variant", ["as_published", "fixed"])
def test_a_crossing_is_one_node_with_four_roads(variant: str) -> None:
    graph = graph_of_mask(crossing(), variant)
    assert sorted(graph.degrees()) == [1, 1, 1, 1, 4]
    centre = graph.nodes.geometry[graph.degrees().idxmax()]
    assert (centre.x, centre.y) == pytest.approx((61.0, 61.0), abs=2.0)


def test_only_the_fixed_variant_keeps_both_ways_between_two_nodes() -> None:
    assert len(graph_of_mask(two_ways(), "as_published").edges) == 3
    fixed = graph_of_mask(two_ways(), "fixed")
    assert len(fixed.edges) == 4
    assert sorted(fixed.edges["key"]) == [0, 0, 0, 1]


def test_only_the_fixed_variant_keeps_a_ring() -> None:
    mask = np.zeros((41, 41), bool)
    mask[10, 10:31] = mask[30, 10:31] = True
    mask[10:31, 10] = mask[10:31, 30] = True
    assert len(graph_of_mask(mask, "as_published").edges) == 0
    assert len(graph_of_mask(mask, "fixed").edges) == 1


def test_lines_are_simplified_by_ten_metres_as_published() -> None:
    mask = np.zeros((41, 101), bool)
    columns = np.arange(10, 90)
    mask[20 + np.rint(3.4 * np.sin(columns / 8)).astype(int), columns] = True  # 6.8 m to each side
    assert len(graph_of_mask(mask, "as_published").edges.geometry.iloc[0].coords) == 2
    assert len(graph_of_mask(mask, "fixed").edges.geometry.iloc[0].coords) > 4


def test_an_empty_mask_gives_an_empty_graph() -> None:
    for variant in ("as_published", "fixed"):
        assert len(graph_of_mask(np.zeros((30, 30), bool), variant).edges) == 0
