"""The recipe: fleet data in, road graph out."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet, TraceGaps
from probe2road.graph.clean import CleanOptions, clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.raster.counts import fleet_grid, rasterize_windows
from probe2road.raster.grid import Grid, sparse_zeros
from probe2road.refinement.recipe import RefineOptions, refine
from probe2road.run.progress import Progress, silent
from probe2road.run.workspace import Workspace, open_workspace
from probe2road.segmentation.density import DensityOptions, density_segmenter
from probe2road.segmentation.mask import threshold_mask
from probe2road.segmentation.network import NetworkOptions, find_weights, network_segmenter
from probe2road.segmentation.segmenter import Segmenter
from probe2road.segmentation.tiling import add_window, predict_window
from probe2road.segmentation.weights import Weights
from probe2road.vectorize.lines import VectorizeOptions, vectorize
from probe2road.vectorize.skeleton import METHODS, Method, skeletonize_windows

__all__ = ["SEGMENTERS", "BuildOptions", "Progress", "Segmentation", "build"]

logger = logging.getLogger(__name__)

SEGMENTERS = ("network", "density")


@dataclass(frozen=True)
class BuildOptions:
    """Everything that decides which graph comes out."""

    resolution: float = 1.0  # m per pixel
    segmenter: str = "network"  # one of SEGMENTERS
    gaps: TraceGaps = field(default_factory=TraceGaps)  # where traces are broken
    network: NetworkOptions = field(default_factory=NetworkOptions)  # of the learned segmenter
    density: DensityOptions = field(default_factory=DensityOptions)  # of the density segmenter
    thinning: str = "guo_hall"  # how the mask becomes lines of one pixel; or zhang_suen
    vectorize: VectorizeOptions = field(default_factory=VectorizeOptions)  # how pixels become lines
    clean: CleanOptions = field(default_factory=CleanOptions)  # what counts as a flaw
    refine: bool = True  # whether the traces fill gaps, split false junctions and are counted
    refinement: RefineOptions = field(default_factory=RefineOptions)  # how they do

    def __post_init__(self) -> None:
        """Refuse an unknown segmenter."""
        if self.segmenter not in SEGMENTERS:
            raise OptionError(f"there is no segmenter {self.segmenter!r}", fix=f"use {', '.join(SEGMENTERS)}")
        if self.thinning not in METHODS:
            raise OptionError(f"there is no thinning {self.thinning!r}", fix=f"use {' or '.join(METHODS)}")


@dataclass(frozen=True)
class Segmentation:
    """What the probability depends on, out of the build options."""

    resolution: float
    segmenter: str
    gaps: TraceGaps
    network: NetworkOptions
    density: DensityOptions

    @classmethod
    def of(cls, options: BuildOptions) -> Segmentation:
        """Take what counts; the thresholds of the network come after the probability."""
        network = replace(options.network, threshold=None, seed_threshold=None)
        return cls(options.resolution, options.segmenter, options.gaps, network, options.density)


def build(
    fleet: Fleet,
    *,
    options: BuildOptions | None = None,
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
        options takes from it what an earlier run completed, down to single windows; one with other options behind
        the segmentation takes the probability. Nothing is written where it is None.
    progress
        Called as the work goes on.

    Returns
    -------
    RoadGraph
        In the fleet's CRS; empty where no road is certain enough.

    Raises
    ------
    InputError
        If the fleet has no fixes, or the weights of the network are bad or look at what it does not have.
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
    options, report = options or BuildOptions(), progress or silent
    grid = fleet_grid(fleet, resolution=options.resolution)
    learned = options.segmenter == "network"
    weights = find_weights(fleet, options.network) if learned else None
    digest = weights.digest if weights else None
    work = open_workspace(workspace, fleet, options, weights=digest, first=Segmentation.of(options))
    if (graph := work.read_graph("7-roads")) is not None:
        return graph

    segmenter = _segmenter(fleet, grid, options, weights, work)
    probability = _segment(fleet, grid, segmenter, options.gaps, work, report)
    mask = threshold_mask(probability, threshold=segmenter.threshold, seed_threshold=segmenter.seed_threshold)
    work.write_raster("2-mask", mask, grid)
    report("skeleton", 0, 1)
    skeleton = skeletonize_windows(mask, method=cast(Method, options.thinning))
    work.write_raster("3-skeleton", skeleton, grid)
    report("graph", 0, 1)
    graph = vectorize(skeleton, grid, probability=probability, options=options.vectorize)
    work.write_graph("4-vectorized", graph)
    graph = clean_graph(graph, options=options.clean)
    work.write_graph("5-cleaned", graph)
    report("graph", 1, 1)
    if options.refine:
        refinement = options.refinement.for_segmenter(learned=weights is not None)
        graph = refine(graph, fleet, options=refinement, clean=options.clean, workspace=work, progress=report)
    work.write_graph("7-roads", graph)
    return graph


def _segmenter(fleet: Fleet, grid: Grid, options: BuildOptions, weights: Weights | None, work: Workspace) -> Segmenter:
    """Return the segmenter of the options; what the density segmenter estimates is estimated once per run."""
    if weights is not None:
        return network_segmenter(weights, grid, options.network)
    kept = work.read_record("1-density")
    density = options.density if kept is None else DensityOptions(**kept)
    segmenter = density_segmenter(fleet, grid, options=density, gaps=options.gaps)
    if kept is None:
        work.write_record("1-density", segmenter.parameters)
    return segmenter


def _segment(
    fleet: Fleet, grid: Grid, segmenter: Segmenter, gaps: TraceGaps, work: Workspace, report: Progress
) -> NDArray[np.float32]:
    """Centreline probability of the whole grid ``(rows, cols)``; pages nobody drove on are never touched."""
    if (kept := work.read_raster("1-probability", grid)) is not None:
        return kept
    probability = sparse_zeros(grid.shape, np.float32)
    driven = 0
    for window, counts in rasterize_windows(fleet, grid, size=segmenter.window, halo=segmenter.halo, gaps=gaps):
        report("segmentation", window.row, grid.rows)
        name = f"window-{window.row}-{window.col}"
        part = work.read_array(name)
        if part is None:
            part = predict_window(segmenter, window, counts, grid)
            work.write_array(name, part)
        add_window(probability, part, window, segmenter)
        driven += 1
    report("segmentation", grid.rows, grid.rows)
    total = len(grid.windows(segmenter.window))
    logger.info("segmented %d windows of %d of %d px (%s)", driven, total, segmenter.window, segmenter.name)
    work.write_raster("1-probability", probability, grid)
    work.drop_arrays()
    return probability
