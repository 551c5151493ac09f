"""The recipe: fleet data in, road graph out."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from probe2road.clean import CleanOptions, clean_graph
from probe2road.errors import OptionError
from probe2road.export import read_graph
from probe2road.fleet import Fleet, TraceGaps
from probe2road.grid import Grid, read_raster
from probe2road.picture import Stage, write_filmstrip
from probe2road.raster import fleet_grid, rasterize, rasterize_windows
from probe2road.refinement import RefineOptions, refine_graph
from probe2road.roadgraph import RoadGraph
from probe2road.segmentation.density import DensityOptions, density_segmenter
from probe2road.segmentation.mask import threshold_mask
from probe2road.segmentation.segmenter import Segmenter
from probe2road.skeleton import skeletonize_windows
from probe2road.vectorize import VectorizeOptions, vectorize
from probe2road.workspace import Progress, Workspace, open_workspace

__all__ = ["SEGMENTERS", "BuildOptions", "Progress", "build", "draw_stages"]

logger = logging.getLogger(__name__)

SEGMENTERS = ("density",)

_WINDOW = 1024  # pixels; side of the windows that are rasterised and segmented one at a time


@dataclass(frozen=True)
class BuildOptions:
    """Everything that decides which graph comes out."""

    resolution: float = 1.0  # m per pixel
    segmenter: str = "density"  # one of SEGMENTERS
    gaps: TraceGaps = field(default_factory=TraceGaps)  # where traces are broken
    density: DensityOptions = field(default_factory=DensityOptions)  # of the density segmenter
    vectorize: VectorizeOptions = field(default_factory=VectorizeOptions)  # how pixels become lines
    clean: CleanOptions = field(default_factory=CleanOptions)  # what counts as a flaw
    refine: bool = True  # whether the traces fill gaps, split false junctions and are counted
    refinement: RefineOptions = field(default_factory=RefineOptions)  # how they do

    def __post_init__(self) -> None:
        """Refuse an unknown segmenter."""
        if self.segmenter not in SEGMENTERS:
            raise OptionError(f"there is no segmenter {self.segmenter!r}", fix=f"use {' or '.join(SEGMENTERS)}")


def build(
    fleet: Fleet,
    options: BuildOptions | None = None,
    *,
    workspace: str | Path | None = None,
    progress: Progress | None = None,
) -> RoadGraph:
    """Build a road graph from fleet data.

    Rasterises the fleet window by window, segments each into centreline probability, thresholds, thins to a
    skeleton, traces it into a graph and cleans that; then matches the traces to the graph to fill its gaps, to
    split its false junctions and to count what was driven. The result does not depend on the order of the
    traces. Memory follows the area that was driven, not its bounding box.

    Parameters
    ----------
    fleet
        From `probe2road.read_fleet`.
    options
        The defaults where it is None.
    workspace
        Folder for what every stage makes (GeoTIFF and GeoPackage). A run on the same fleet with the same
        options takes from it what an earlier run completed, down to single windows. Nothing is written where
        it is None.
    progress
        Called as the work goes on.

    Returns
    -------
    RoadGraph
        In the fleet's CRS; empty where no road is certain enough.

    Raises
    ------
    InputError
        If the fleet has no fixes.
    OptionError
        If an option makes no sense.

    Notes
    -----
    Paper, section III.

    Examples
    --------
    >>> from probe2road.demo import demo_fleet
    >>> graph = build(demo_fleet(n_drives=40))
    >>> graph.length > 3000
    True
    """
    options, report = options or BuildOptions(), progress or _silent
    grid = fleet_grid(fleet, resolution=options.resolution)
    work = open_workspace(workspace, fleet, options)
    if (graph := work.read_graph("7-roads")) is not None:
        return graph

    probability, segmenter = _segment(fleet, grid, options, work, report)
    mask = threshold_mask(probability, threshold=segmenter.threshold, seed_threshold=segmenter.seed_threshold)
    work.write_raster("2-mask", mask, grid)
    report("skeleton", 0, 1)
    skeleton = skeletonize_windows(mask)
    work.write_raster("3-skeleton", skeleton, grid)
    report("graph", 0, 1)
    graph = vectorize(skeleton, grid, probability=probability, options=options.vectorize)
    work.write_graph("4-vectorized", graph)
    graph = clean_graph(graph, options.clean)
    work.write_graph("5-cleaned", graph)
    report("graph", 1, 1)
    if options.refine:
        graph = refine_graph(graph, fleet, options.refinement, clean=options.clean, work=work, report=report)
    work.write_graph("7-roads", graph)
    return graph


def _segment(
    fleet: Fleet, grid: Grid, options: BuildOptions, work: Workspace, report: Progress
) -> tuple[NDArray[np.float32], Segmenter]:
    """Centreline probability of the whole grid ``(rows, cols)``; pages nobody drove on are never touched."""
    segmenter = density_segmenter(fleet, grid, options.density, gaps=options.gaps)
    if (kept := work.read_raster("1-probability", grid)) is not None:
        return kept, segmenter
    probability = np.zeros(grid.shape, np.float32)
    driven = 0
    parts = rasterize_windows(fleet, grid, size=_WINDOW, halo=segmenter.halo, gaps=options.gaps)
    for window, counts in parts:
        report("segmentation", window.row, grid.rows)
        name = f"window-{window.row}-{window.col}"
        part = work.read_array(name)
        if part is None:
            part = segmenter.predict(counts, window.grid(grid))[window.inner]
            work.write_array(name, part)
        probability[window.core] = part
        driven += 1
    report("segmentation", grid.rows, grid.rows)
    logger.info("segmented %d windows of %d of %d px (%s)", driven, len(grid.windows(_WINDOW)), _WINDOW, segmenter.name)
    work.write_raster("1-probability", probability, grid)
    work.drop_arrays()
    return probability, segmenter


def draw_stages(folder: str | Path, fleet: Fleet, path: str | Path) -> None:
    """Draw what the stages of a run left in its workspace, side by side, as a PNG.

    Parameters
    ----------
    folder
        Workspace of a finished `build`.
    fleet
        The fleet it was built from.
    path
        The picture.

    Raises
    ------
    InputError
        If a stage is missing.
    """
    folder = Path(folder)
    probability, grid = read_raster(folder / "1-probability.tif")
    skeleton, _ = read_raster(folder / "3-skeleton.tif")
    traces = rasterize(fleet, grid)[0]
    panels = [
        Stage("Traces", traces, grid, f"{fleet.n_traces:,} traces, {len(fleet.traces):,} fixes"),
        Stage("Probability", probability[0], grid, "of a centreline"),
        Stage("Skeleton", skeleton[0].astype(bool), grid, f"{int(skeleton.sum()):,} pixels"),
        Stage("Graph", read_graph(folder / "4-vectorized.gpkg")),
        Stage("Roads", read_graph(folder / "7-roads.gpkg")),
    ]
    write_filmstrip(panels, path)


def _silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""
