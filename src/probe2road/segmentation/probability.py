"""Centreline probability of a whole fleet, window by window."""

from __future__ import annotations

import logging

from probe2road.fleet.contract import Fleet
from probe2road.raster.blocks import Blocks
from probe2road.raster.counts import rasterize_windows
from probe2road.raster.grid import Grid
from probe2road.run.progress import Progress, silent
from probe2road.run.stages import DENSITY, PROBABILITY, WINDOW
from probe2road.run.workspace import Workspace
from probe2road.segmentation.density import DensityOptions, density_segmenter
from probe2road.segmentation.network import network_segmenter
from probe2road.segmentation.options import SegmentationOptions
from probe2road.segmentation.segmenter import Segmenter
from probe2road.segmentation.tiling import Merger, is_empty, predict_window
from probe2road.segmentation.weights import Weights

__all__ = ["centreline_probability", "find_segmenter"]

logger = logging.getLogger(__name__)


def find_segmenter(
    fleet: Fleet,
    grid: Grid,
    *,
    options: SegmentationOptions,
    weights: Weights | None = None,
    workspace: Workspace | None = None,
) -> Segmenter:
    """Return the segmenter that the options name; the density segmenter estimates its bandwidth once per run.

    Parameters
    ----------
    fleet
        The fleet.
    grid
        Its grid.
    options
        Which segmenter, and how it works.
    weights
        Of the network; the density segmenter if it is None.
    workspace
        Where estimates are kept.
    """
    if weights is not None:
        return network_segmenter(weights, grid, options.network)
    work = workspace or Workspace()
    kept = work.read_record(DENSITY)
    density = options.density if kept is None else DensityOptions(**kept)
    segmenter = density_segmenter(fleet, grid, options=density, gaps=options.gaps)
    if kept is None:
        work.write_record(DENSITY, segmenter.parameters)
    return segmenter


def centreline_probability(
    fleet: Fleet,
    grid: Grid,
    segmenter: Segmenter,
    *,
    options: SegmentationOptions,
    workspace: Workspace | None = None,
    progress: Progress | None = None,
) -> Blocks:
    """Return the centreline probability of all pixels of a grid.

    Parameters
    ----------
    fleet
        The fleet.
    grid
        Its grid.
    segmenter
        How counts become probability.
    options
        Where traces are broken.
    workspace
        Keeps every window until the whole is there.
    progress
        Called after every window with the rows that are done.

    Returns
    -------
    Blocks of float32, shape (rows, cols)
        What nobody drove on takes no memory.
    """
    work, report = workspace or Workspace(), progress or silent
    if (kept := work.read_raster(PROBABILITY, grid)) is not None:
        return kept
    merger, seen = Merger(segmenter, grid.shape), 0
    for window, counts in rasterize_windows(fleet, grid, size=segmenter.window, halo=segmenter.halo, gaps=options.gaps):
        report("segmentation", window.row, grid.rows)
        if is_empty(segmenter, window, counts):
            continue
        part = f"{window.row}-{window.col}"
        arrays = work.read_arrays(WINDOW, part)
        if arrays is None:
            arrays = {"probability": predict_window(segmenter, window, counts, grid)}
            work.write_arrays(WINDOW, part, **arrays)
        merger.add(window, arrays["probability"])
        seen += 1
    probability = merger.probability()
    report("segmentation", grid.rows, grid.rows)
    total = -(-grid.rows // segmenter.window) * -(-grid.cols // segmenter.window)
    logger.info("segmented %d windows of %d of %d px (%s)", seen, total, segmenter.window, segmenter.name)
    work.write_raster(PROBABILITY, probability, grid)
    work.drop(WINDOW)
    return probability
