from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from probe2road.draw.picture import Panel, draw_graph, write_filmstrip
from probe2road.errors import InputError, OptionError
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.raster.grid import Grid
from sketches import UTM, fleet_of, spaced

GRID = Grid.from_bounds((0.0, 0.0, 100.0, 60.0), crs=UTM)


@pytest.fixture
def graph() -> RoadGraph:
    return graph_from_lines([[(5, 30), (50, 30)], [(50, 30), (95, 55)], [(50, 30), (95, 5)]], crs=UTM)


def blue(picture: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mark the pixels in the colour of edges found by segmentation."""
    return np.abs(picture[:, :, :3] - np.array([0x1C, 0x7E, 0xD6]) / 255).max(axis=2) < 0.02


def test_the_filmstrip_has_a_panel_per_stage_of_the_same_area(graph: RoadGraph, tmp_path: Path) -> None:
    counts = np.zeros(GRID.shape, np.uint32)
    counts[30, 10:90] = 7
    stages = [
        Panel("Traces", counts, GRID, "7 traces"),
        Panel("Probability", (counts / 7).astype(np.float32), GRID),
        Panel("Skeleton", counts > 0, GRID),
        Panel("Graph", graph),
    ]
    write_filmstrip(stages, tmp_path / "strip.png", bounds=GRID.bounds)
    picture = imread(tmp_path / "strip.png")
    rows, cols = picture.shape[:2]
    assert cols > 3 * rows
    # The street lies half way up in every panel; only the last panel has the colour of edges.
    panels = np.array_split(picture, 4, axis=1)
    assert [bool(blue(panel).any()) for panel in panels] == [False, False, False, True]
    dark = [(panel[rows // 4 :, :, :3].mean(axis=2) < 0.4).any() for panel in panels[:3]]
    assert dark == [True, True, True]


def test_thin_lines_survive_when_the_raster_is_larger_than_the_panel(tmp_path: Path) -> None:
    grid = Grid.from_bounds((0.0, 0.0, 8000.0, 8000.0), crs=UTM)
    skeleton = np.zeros(grid.shape, bool)
    skeleton[4000, :] = True
    write_filmstrip([Panel("Skeleton", skeleton, grid)], tmp_path / "strip.png", bounds=grid.bounds)
    picture = imread(tmp_path / "strip.png")[:, :, :3].mean(axis=2)
    middle = picture[:, picture.shape[1] // 2]
    assert (middle < 0.6).any()


def test_equal_pictures_are_equal_files(graph: RoadGraph, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        draw_graph(graph, tmp_path / name, title="Twice")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_graph_is_drawn_over_traces_and_reference(graph: RoadGraph, tmp_path: Path) -> None:
    fleet = fleet_of(spaced((5, 20), (90, 20), spacing=5.0))
    reference = graph_from_lines([[(5, 50), (95, 50)]], crs=UTM, origin="reference")
    draw_graph(graph, tmp_path / "all.png", fleet=fleet, reference=reference)
    picture = imread(tmp_path / "all.png")[:, :, :3]
    band = np.abs(picture - np.array([0xBF, 0xE3, 0xC6]) / 255).max(axis=2) < 0.02
    assert blue(picture).any()
    assert band.any()
    # North is up: the reference, at 50 m, is above the stem of the graph, at 30 m.
    assert np.flatnonzero(band.any(axis=1)).mean() < np.flatnonzero(blue(picture).any(axis=1)).mean()


def test_nothing_to_draw_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is nothing to draw; pass bounds"):
        draw_graph(empty_graph(UTM), tmp_path / "nothing.png")
    with pytest.raises(OptionError, match="there is nothing to draw"):
        write_filmstrip([], tmp_path / "nothing.png")
    with pytest.raises(OptionError, match="the array of 'Mask' has no grid"):
        write_filmstrip([Panel("Mask", np.ones((2, 2), bool))], tmp_path / "nothing.png")
    draw_graph(empty_graph(UTM), tmp_path / "white.png", bounds=GRID.bounds)
    assert [path.name for path in tmp_path.iterdir()] == ["white.png"]
