from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from probe2road.baselines.fringe import fringe_branches, trace_fringe
from sketches import mask_of

CROSS = mask_of(
    "....#....",
    "....#....",
    "....#....",
    "....#....",
    "#########",
    "....#....",
    "....#....",
    "....#....",
    "....#....",
)


def branches_of(skeleton: NDArray[np.bool_]) -> NDArray[np.int64]:
    image = np.zeros(skeleton.shape, np.int64)
    image[skeleton] = fringe_branches(skeleton)
    return image


class TestBranches:
    def test_cross_has_four_in_its_middle_and_beside_it(self) -> None:
        row = branches_of(CROSS)[4]
        # Around the pixels beside the middle, the ring still cuts all four arms.
        assert row.tolist() == [1, 1, 2, 4, 4, 4, 2, 1, 1]

    def test_isolated_pixel_has_none(self) -> None:
        assert fringe_branches(mask_of("...", ".#.", "...")).tolist() == [0]

    def test_fringe_pixel_without_a_bridge_does_not_count(self) -> None:
        assert fringe_branches(mask_of("#.#")).tolist() == [0, 0]

    def test_corner_of_the_fringe_needs_the_diagonal(self) -> None:
        assert branches_of(mask_of("#..", ".#.", "..#"))[2, 2] == 1
        assert branches_of(mask_of("#..", "..#", "..#"))[2, 2] == 0


class TestTrace:
    def test_cross_is_one_node_with_four_lines(self) -> None:
        graph = trace_fringe(CROSS)
        nodes = list(zip(graph.node_row.tolist(), graph.node_col.tolist(), strict=True))
        assert len(nodes) == 5
        middle = nodes.index((4.0, 4.0))
        assert sorted(np.concatenate([graph.start, graph.stop]).tolist()).count(middle) == 4

    def test_lines_lead_from_node_to_node_in_single_steps_of_the_skeleton(self) -> None:
        graph = trace_fringe(CROSS)
        for line in range(len(graph.start)):
            row, col = (part[graph.offsets[line] : graph.offsets[line + 1]] for part in (graph.row, graph.col))
            assert (row[0], col[0]) == (graph.node_row[graph.start[line]], graph.node_col[graph.start[line]])
            assert (row[-1], col[-1]) == (graph.node_row[graph.stop[line]], graph.node_col[graph.stop[line]])
            assert CROSS[row.astype(int), col.astype(int)].all()
            inner = np.hypot(np.diff(row[1:-1]), np.diff(col[1:-1]))
            assert (inner <= 1.5).all()

    def test_parallel_lines_are_both_found(self) -> None:
        ring = mask_of(
            "......######......",
            ".....#......#.....",
            "....#........#....",
            "####..........####",
            "....#........#....",
            ".....#......#.....",
            "......######......",
        )
        graph = trace_fringe(ring)
        pairs = sorted(zip(graph.start.tolist(), graph.stop.tolist(), strict=True))
        assert len([pair for pair in pairs if pairs.count(pair) > 1 or pairs.count(pair[::-1]) > 0]) == 2

    def test_ring_without_a_node_is_not_found(self) -> None:
        ring = np.zeros((9, 9), bool)
        ring[1:8, 1:8] = True
        ring[2:7, 2:7] = False
        ring[1, 1] = ring[1, 7] = ring[7, 1] = ring[7, 7] = False
        assert len(trace_fringe(ring).start) == 0

    def test_short_lines_are_dropped_with_their_nodes(self) -> None:
        line = mask_of("##########")
        assert len(trace_fringe(line, min_length=7.9).start) == 1
        dropped = trace_fringe(line, min_length=8.0)
        assert len(dropped.start) == len(dropped.node_row) == 0

    @pytest.mark.parametrize("shape", [(0, 0), (1, 1), (5, 7)])
    def test_nothing_gives_nothing(self, shape: tuple[int, int]) -> None:
        graph = trace_fringe(np.zeros(shape, bool))
        assert len(graph.node_row) == len(graph.start) == len(graph.row) == 0
        assert graph.offsets.tolist() == [0]

    def test_moves_with_its_pixels(self) -> None:
        moved = trace_fringe(np.pad(CROSS, ((3, 0), (5, 2))))
        still = trace_fringe(CROSS)
        np.testing.assert_array_equal(moved.row, still.row + 3)
        np.testing.assert_array_equal(moved.col, still.col + 5)
