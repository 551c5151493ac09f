from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.vectorize.tracing import PixelGraph, trace_pixels


def trace(*rows: str) -> PixelGraph:
    return trace_pixels(*np.nonzero(np.array([[pixel == "#" for pixel in row] for row in rows])))


def ends(graph: PixelGraph) -> list[tuple[int, int]]:
    return sorted(zip(graph.start.tolist(), graph.stop.tolist(), strict=True))


def degrees(graph: PixelGraph) -> list[int]:
    return sorted(np.bincount(np.append(graph.start, graph.stop)).tolist())


def line(graph: PixelGraph, number: int) -> NDArray[np.float64]:
    part = slice(graph.offsets[number], graph.offsets[number + 1])
    return np.stack([graph.row[part], graph.col[part]], axis=1)


def test_t_has_one_junction_pixel() -> None:
    graph = trace(
        "#######",
        "...#...",
        "...#...",
        "...#...",
    )
    assert degrees(graph) == [1, 1, 1, 3]
    assert [graph.node_row[0], graph.node_col[1]] == [0, 3]
    assert len(graph.row) == 3 * 2 + 2 + 2 + 2


def test_x_of_diagonals_has_one_node() -> None:
    graph = trace(
        "#...#",
        ".#.#.",
        "..#..",
        ".#.#.",
        "#...#",
    )
    assert degrees(graph) == [1, 1, 1, 1, 4]


def test_touching_junction_pixels_are_one_node_at_their_centroid() -> None:
    graph = trace(
        "#....#",
        ".#..#.",
        "..##..",
        ".#..#.",
        "#....#",
    )
    assert degrees(graph) == [1, 1, 1, 1, 4]
    assert (2.0, 2.5) in set(zip(graph.node_row.tolist(), graph.node_col.tolist(), strict=True))


def test_square_of_two_with_arms_is_one_node() -> None:
    graph = trace(
        "#.....",
        ".#....",
        "..##..",
        "..##..",
        "....##",
    )
    assert degrees(graph) == [1, 1, 2]
    assert (2.5, 2.5) in set(zip(graph.node_row.tolist(), graph.node_col.tolist(), strict=True))


def test_staircase_is_one_line() -> None:
    graph = trace(
        "##....",
        ".##...",
        "..##..",
        "...###",
    )
    assert ends(graph) == [(0, 1)]
    assert len(graph.row) == 9


def test_ring_keeps_one_node_at_its_first_pixel() -> None:
    graph = trace(
        ".###.",
        "#...#",
        "#...#",
        ".###.",
    )
    assert ends(graph) == [(0, 0)]
    assert line(graph, 0)[[0, -1]].tolist() == [[0, 1], [0, 1]]
    assert len(graph.row) == 11


def test_loop_at_a_junction() -> None:
    graph = trace(
        ".###.....",
        "#...#....",
        "#...#####",
        "#...#....",
        ".###.....",
    )
    assert ends(graph) == [(0, 0), (0, 1)]


def test_theta_keeps_three_parallel_lines() -> None:
    graph = trace(
        ".#####.",
        "#.....#",
        "#######",
        "#.....#",
        ".#####.",
    )
    assert ends(graph) == [(0, 1), (0, 1), (0, 1)]


def test_parallel_lines_between_two_roads() -> None:
    graph = trace(
        "...###...",
        "###...###",
        "...###...",
    )
    assert degrees(graph) == [1, 1, 3, 3]
    assert len(graph.start) == 4


def test_spur_is_a_line_of_its_own() -> None:
    graph = trace(
        "...#...",
        "#######",
    )
    assert degrees(graph) == [1, 1, 1, 3]


def test_pair_of_pixels_is_a_line() -> None:
    assert ends(trace("##")) == [(0, 1)]


def test_isolated_spots_are_dropped_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    graph = trace(
        "#....##",
        ".....##",
        "..#....",
    )
    assert len(graph.node_row) == len(graph.start) == 0
    assert "dropped 3 isolated spots" in caplog.text


def test_hole_of_one_pixel_at_a_crossing_is_part_of_the_node() -> None:
    graph = trace(
        "...#...",
        "...#...",
        "..#.#..",
        "##...##",
        "..#.#..",
        "...#...",
    )
    assert graph.offsets[-1] == len(graph.row)
    assert max(degrees(graph)) <= 4


def test_wide_blob_loses_no_pixel() -> None:
    graph = trace(
        "......",
        ".####.",
        ".####.",
        ".####.",
        "......",
    )
    covered = {(r, c) for r, c in zip(graph.row.tolist(), graph.col.tolist(), strict=True)}
    assert covered == {(r, c) for r in (1, 2, 3) for c in (1, 2, 3, 4)}


def test_no_pixels() -> None:
    graph = trace("....")
    assert graph.offsets.tolist() == [0]


@pytest.mark.parametrize("pixels", [([1, 0], [0, 0]), ([0, 0], [3, 3]), ([0, 0], [3, 1])])
def test_unsorted_pixels_are_refused(pixels: tuple[list[int], list[int]]) -> None:
    with pytest.raises(InputError, match="not sorted"):
        trace_pixels(np.array(pixels[0]), np.array(pixels[1]))
