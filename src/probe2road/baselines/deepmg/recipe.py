"""DeepMG from fleet data to road graph: features, T2RNet, mask, links, refinement by matching (METHOD 3)."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from probe2road.baselines.deepmg.features import Steps, thin_traces
from probe2road.baselines.deepmg.link_edges import add_links
from probe2road.baselines.deepmg.links import LinkOptions
from probe2road.baselines.deepmg.mask_graph import mask_graph
from probe2road.baselines.deepmg.pruning import PruneOptions, prune_graph
from probe2road.baselines.deepmg.traversals import MatcherOptions, count_traversals
from probe2road.baselines.deepmg.variants import VARIANTS, find_variant
from probe2road.bounds import OneOf, Probability
from probe2road.errors import MissingFileError, OptionError
from probe2road.fleet.contract import Fleet, TraceGaps
from probe2road.fleet.jumps import without_strays
from probe2road.graph.roadgraph import RoadGraph
from probe2road.options import checked
from probe2road.raster.counts import dense_grid
from probe2road.raster.grid import Grid
from probe2road.run.progress import Progress, silent
from probe2road.run.stages import LINKED, MASK, PROBABILITY, ROADS, VECTORIZED
from probe2road.run.workspace import Workspace, open_workspace
from probe2road.segmentation.mask import threshold_mask

__all__ = ["DeepMGOptions", "build_deepmg"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
@checked
class DeepMGOptions:
    """All options that determine the resulting graph."""

    weights: str = ""  # file of a trained network; it also says what the network was trained to see
    variant: Annotated[str, OneOf(*VARIANTS)] = "fixed"  # has to be that of the weights
    threshold: Probability = 0.5  # probability from which a cell is a centreline
    gaps: TraceGaps = field(default_factory=TraceGaps)  # where traces are broken
    links: LinkOptions = field(default_factory=LinkOptions)  # how roads are linked across interruptions
    matcher: MatcherOptions = field(default_factory=MatcherOptions)  # how traces are matched
    prune: PruneOptions = field(default_factory=PruneOptions)  # how often edges have to be driven


@dataclass(frozen=True)
class _Run:
    """The inputs of the stages of a run: the options, and the content of the weights file instead of its name."""

    options: DeepMGOptions
    digest: str


def build_deepmg(
    fleet: Fleet,
    *,
    options: DeepMGOptions | None = None,
    workspace: str | Path | None = None,
    progress: Progress | None = None,
) -> RoadGraph:
    """Build a road graph from fleet data with DeepMG.

    Only the traces are used. The network runs on the CPU, window by window.

    Parameters
    ----------
    fleet
        From `probe2road.read_fleet`.
    options
        With the file of the weights, which ``experiments/train_deepmg.py`` makes.
    workspace
        Folder for what the stages make, as for `probe2road.recipe.build`.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    RoadGraph
        In the fleet's CRS. ``forward`` and ``backward`` are traversals as the method counts them; ``support`` stays
        unknown, because it counts no traces.

    Raises
    ------
    InputError
        If the fleet has no fixes, or the weights cannot be read.
    OptionError
        If the weights are of the other variant.
    MissingExtraError
        If torch is not installed.

    Notes
    -----
    Ruan et al., "Learning to Generate Maps from Trajectories", AAAI 2020; METHOD 3.
    """
    options, report = options or DeepMGOptions(), progress or silent
    fleet = without_strays(fleet, options.gaps)
    with open_workspace(workspace, fleet, _Run(options, _digest(options.weights))) as work:
        if (kept := work.read_graph(ROADS)) is not None:
            return kept
        return work.finish(ROADS, _built(fleet, options, work, report))


def _built(fleet: Fleet, options: DeepMGOptions, work: Workspace, report: Progress) -> RoadGraph:
    """Build the graph of a fleet: mask, links, and the part that traces confirm."""
    variant = find_variant(options.variant)
    probability, grid, steps = _segment(fleet, options, work, report)
    mask = threshold_mask(probability, threshold=options.threshold)
    work.write_raster(MASK, mask, grid)
    report("graph", 0, 1)
    graph = mask_graph(mask, grid, variant)
    work.write_graph(VECTORIZED, graph)
    report("graph", 1, 1)
    graph = add_links(graph, variant, options.links)
    work.write_graph(LINKED, graph)
    report("matching", 0, 1)
    traversals = count_traversals(steps, graph, options.matcher, min_path=variant.min_path)
    graph = prune_graph(graph, traversals, options.prune)
    report("matching", 1, 1)
    return graph


def _segment(
    fleet: Fleet, options: DeepMGOptions, work: Workspace, report: Progress
) -> tuple[NDArray[np.float32], Grid, Steps]:
    """Return the centreline probability, its grid, and the thinned traces; cells without drives use no memory."""
    from probe2road.baselines.deepmg.prediction import load_network, predict_windows  # needs torch

    trained = load_network(options.weights)
    if trained.variant.name != options.variant:
        fault = f"the weights are of the variant {trained.variant.name}, not {options.variant}"
        raise OptionError(fault, where=options.weights, fix="name the variant that they were trained for")
    steps = thin_traces(fleet, trained.features, gaps=options.gaps)
    grid = dense_grid(fleet, resolution=trained.features.resolution)
    if (kept := work.read_raster(PROBABILITY, grid)) is not None:
        return kept[:, :], grid, steps
    probability = np.zeros(grid.shape, np.float32)
    for window, part in predict_windows(trained, steps, grid):
        report("segmentation", window.row, grid.rows)
        probability[window.core] = part
    report("segmentation", grid.rows, grid.rows)
    work.write_raster(PROBABILITY, probability, grid)
    return probability, grid, steps


def _digest(weights: str) -> str:
    """Return a digest of the weights file."""
    path = Path(weights)
    if not weights or not path.is_file():
        fix = "train a network with experiments/train_deepmg.py and name its weights.pt"
        raise MissingFileError("there is no such file of weights", where=weights or "DeepMGOptions", fix=fix)
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
