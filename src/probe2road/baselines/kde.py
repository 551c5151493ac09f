"""The paper's own baseline ("Woven"): kernel density estimation in three dimensions.

Traces become a volume of counts, a Gaussian smooths it to a density, a threshold makes it binary, and the lines that
three-dimensional thinning leaves are the roads.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

from probe2road.baselines.volume import count_voxels, dense_pillars
from probe2road.baselines.volume_graph import graph_from_volume
from probe2road.baselines.volume_skeleton import thin_volume
from probe2road.bounds import NotNegative, Positive
from probe2road.fleet.contract import Fleet, TraceGaps
from probe2road.fleet.jumps import without_strays
from probe2road.graph.clean import CleanOptions, clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.options import checked
from probe2road.raster.counts import fleet_grid
from probe2road.raster.grid import Grid
from probe2road.run.progress import Progress, silent
from probe2road.run.stages import ROADS, VECTORIZED
from probe2road.run.workspace import Workspace, open_workspace

__all__ = ["KdeOptions", "build_kde"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
@checked
class KdeOptions:
    """The parameters of the method; the paper publishes none of them.

    The three that make the density were chosen by ``experiments/fit_kde.py``.
    """

    resolution: Positive[float] = 1.0  # m, side of a voxel in plan
    height: Positive[float] = 3.0  # m, of a voxel
    sigma: Positive[float] = 1.5  # m, of the Gaussian in plan
    sigma_vertical: Positive[float] = 2.0  # m, of the Gaussian in height
    threshold: Positive[float] = 2.0  # traces on one line whose density is enough
    gaps: TraceGaps = field(default_factory=TraceGaps)  # where traces are broken
    simplify_tolerance: NotNegative[float] = 1.0  # m, Douglas-Peucker
    clean: CleanOptions | None = field(default_factory=CleanOptions)  # what counts as a flaw; None cleans nothing


def build_kde(
    fleet: Fleet,
    *,
    options: KdeOptions | None = None,
    workspace: str | Path | None = None,
    progress: Progress | None = None,
) -> RoadGraph:
    """Build a road graph by kernel density estimation in three dimensions, from traces only.

    Parameters
    ----------
    fleet
        From `probe2road.read_fleet`. Fixes without altitude are left out, unless none has one.
    options
        None takes the defaults.
    workspace
        Folder for what every stage makes. A run on the same fleet with the same options takes the result from it.
        Nothing is written if it is None.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    RoadGraph
        In the fleet's CRS, with heights; empty where the density is too low. Nothing is matched, so there are neither
        counts nor turns.

    Raises
    ------
    InputError
        If the fleet has no fixes.
    OptionError
        If an option makes no sense.

    Notes
    -----
    Paper, section IV "Comparison to other methods"; METHOD 10, last point. Roads above each other stay apart where
    their traces do.

    Examples
    --------
    >>> from probe2road.demo import demo_fleet
    >>> graph = build_kde(demo_fleet(n_drives=40))
    >>> graph.length > 2000
    True
    """
    options, report = options or KdeOptions(), progress or silent
    fleet = without_strays(fleet, options.gaps)
    grid = fleet_grid(fleet, resolution=options.resolution)
    with open_workspace(workspace, fleet, options) as work:
        if (kept := work.read_graph(ROADS)) is not None:
            return kept
        return work.finish(ROADS, _built(fleet, grid, options, work, report))


def _built(fleet: Fleet, grid: Grid, options: KdeOptions, work: Workspace, report: Progress) -> RoadGraph:
    """Build the graph of a fleet from its density in three dimensions."""
    report("density", 0, 1)
    counts = count_voxels(fleet, grid, height=options.height, gaps=options.gaps)
    pillars = dense_pillars(
        counts, sigma=options.sigma, sigma_vertical=options.sigma_vertical, threshold=options.threshold
    )
    report("skeleton", 0, 1)
    skeleton = thin_volume(pillars)
    report("graph", 0, 1)
    graph = graph_from_volume(
        skeleton, grid, floor=counts.floor, height=counts.height, tolerance=options.simplify_tolerance
    )
    work.write_graph(VECTORIZED, graph)
    if options.clean is not None:
        graph = clean_graph(graph, options=options.clean)
    report("graph", 1, 1)
    return graph
