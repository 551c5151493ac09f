"""The recipe: from fleet data to a road graph."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, cast

from probe2road.bounds import OneOf
from probe2road.crs import extent_in_degrees
from probe2road.fleet.contract import Fleet
from probe2road.graph.clean import CleanOptions, clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.options import checked
from probe2road.raster.counts import fleet_grid
from probe2road.refinement.recipe import RefineOptions, refine
from probe2road.run.progress import Progress, silent
from probe2road.run.stages import CLEANED, MASK, ROADS, SKELETON, VECTORIZED
from probe2road.run.workspace import Workspace, open_workspace
from probe2road.segmentation.mask import MaskOptions, threshold_mask
from probe2road.segmentation.network import find_weights
from probe2road.segmentation.options import SegmentationOptions
from probe2road.segmentation.probability import centreline_probability, find_segmenter
from probe2road.segmentation.weights import Weights
from probe2road.vectorize.lines import VectorizeOptions, vectorize
from probe2road.vectorize.skeleton import METHODS, Method, skeletonize_windows

__all__ = ["BuildOptions", "build"]


logger = logging.getLogger(__name__)


@dataclass(frozen=True)
@checked
class BuildOptions:
    """All options that determine the resulting graph."""

    segmentation: SegmentationOptions = field(default_factory=SegmentationOptions)  # what the probability depends on
    mask: MaskOptions = field(default_factory=MaskOptions)  # which probability makes a road
    thinning: Annotated[str, OneOf(*METHODS)] = "guo_hall"  # how the mask becomes lines of one pixel; or zhang_suen
    vectorize: VectorizeOptions = field(default_factory=VectorizeOptions)  # how pixels become lines
    clean: CleanOptions = field(default_factory=CleanOptions)  # which parts of the graph count as flaws
    refine: bool = True  # whether the traces fill gaps, split false junctions and are counted
    refinement: RefineOptions = field(default_factory=RefineOptions)  # how the traces do this


def build(
    fleet: Fleet,
    *,
    options: BuildOptions | None = None,
    workspace: str | Path | None = None,
    progress: Progress | None = None,
) -> RoadGraph:
    """Build a road graph from fleet data.

    The fleet is rasterised window by window, and each window is segmented into centreline probability. A threshold
    gives a mask, which is thinned to a skeleton, traced into a graph, and cleaned. Then traces are matched to the graph
    to fill its gaps, to split its false junctions and to count drives. The result does not depend on the order of the
    traces. Memory grows with the driven area, not with its bounding box.

    Parameters
    ----------
    fleet
        From `probe2road.read_fleet`.
    options
        None takes the defaults.
    workspace
        Folder for the results of all stages (GeoTIFF and GeoPackage); None stores nothing. A later run on the same
        fleet with the same options reuses results of an earlier run, down to single windows; a run that differs only
        in options of the stages after the segmentation reuses the probability.
        `probe2road.run.workspace.resumable` gives a folder that is removed when the work is done.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    RoadGraph
        In the fleet's CRS; empty where no road is certain enough.

    Raises
    ------
    InputError
        If the fleet has no fixes, or the weights of the network are damaged or need channels that the fleet lacks.
    OptionError
        If an option has an invalid value.
    OutputError
        If the workspace cannot be written, is no workspace, or is held by another run.

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
    learned = options.segmentation.segmenter == "network"
    weights = find_weights(fleet, options.segmentation.network) if learned else None
    digest = weights.digest if weights else None
    with open_workspace(workspace, fleet, options, weights=digest, segmentation=options.segmentation) as work:
        if (kept := work.read_graph(ROADS)) is not None:
            return kept
        graph = work.finish(ROADS, _built(fleet, options, weights, work, report))
    if graph.edges.empty:
        logger.warning(
            "no road is certain enough: the graph is empty (%d fixes of %d traces at %s)",
            *(len(fleet.traces), fleet.n_traces, extent_in_degrees(fleet.bounds, fleet.crs)),
        )
    return graph


def _built(
    fleet: Fleet, options: BuildOptions, weights: Weights | None, work: Workspace, report: Progress
) -> RoadGraph:
    """Build the graph, stage by stage."""
    grid = fleet_grid(fleet, resolution=options.segmentation.resolution)
    segmenter = find_segmenter(fleet, grid, options=options.segmentation, weights=weights, workspace=work)
    probability = centreline_probability(
        fleet, grid, segmenter, options=options.segmentation, workspace=work, progress=report
    )
    threshold, seed_threshold = options.mask.of(segmenter)
    mask = threshold_mask(probability, threshold=threshold, seed_threshold=seed_threshold)
    work.write_raster(MASK, mask, grid)
    report("skeleton", 0, 1)
    skeleton = skeletonize_windows(mask, method=cast(Method, options.thinning))
    work.write_raster(SKELETON, skeleton, grid)
    report("graph", 0, 1)
    graph = vectorize(skeleton, grid, probability=probability, options=options.vectorize)
    work.write_graph(VECTORIZED, graph)
    graph = clean_graph(graph, options=options.clean)
    work.write_graph(CLEANED, graph)
    report("graph", 1, 1)
    if options.refine:
        graph = refine(
            graph,
            fleet,
            learned=weights is not None,
            options=options.refinement,
            clean=options.clean,
            keep=work.write_graph,
            progress=report,
        )
    return graph
