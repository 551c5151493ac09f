"""The pipeline of Biagioni and Eriksson (2012): fleet data in, road graph out.

Density of the trips, its gray-scale skeleton, a first map of that; then twice the same: trips are matched to the
map, and segments that they do not bear out are dropped. In between, short segments are collapsed.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from probe2road.baselines.biagioni.collapse import collapse_segments
from probe2road.baselines.biagioni.density import blur_kernel, level_ranks
from probe2road.baselines.biagioni.gray_skeleton import gray_skeleton
from probe2road.baselines.biagioni.pruning import prune_segments
from probe2road.baselines.biagioni.street_map import initial_map, straight_pieces
from probe2road.baselines.biagioni.traversals import Runs, TripPositions, good_runs, match_pieces, observe_trips
from probe2road.bounds import NotNegative, OneOf, Positive
from probe2road.fleet.contract import Fleet, TraceGaps
from probe2road.fleet.jumps import without_strays
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.models import PublishedModel
from probe2road.options import checked
from probe2road.raster.counts import dense_grid
from probe2road.raster.grid import Grid
from probe2road.run.progress import Progress, silent
from probe2road.run.stages import COLLAPSED, PRUNED, ROADS, SKELETON, VECTORIZED
from probe2road.run.workspace import Workspace, open_workspace

__all__ = ["FLEET", "SIGMAS", "BiagioniOptions", "build_biagioni"]

logger = logging.getLogger(__name__)

SIGMAS = {"code": (2.9, 8.0), "paper": (8.5, 26.0)}  # m: of the Gaussian, and where it is cut off


@dataclass(frozen=True)
@checked
class BiagioniOptions:
    """The parameters of METHOD 4.7; the defaults are those of the published program."""

    resolution: Positive[float] = 1.0  # m per cell
    sigma: Annotated[str, OneOf(*SIGMAS)] = "code"  # which Gaussian blurs the lines: one of SIGMAS
    gaps: TraceGaps = field(default_factory=TraceGaps)  # where trips are broken
    closing: NotNegative[float] = 8.0  # m, radius of the disk that closes the density
    simplify_tolerance: NotNegative[float] = 10.0  # m, Douglas-Peucker
    matcher: PublishedModel = field(default=PublishedModel())  # its step is the spacing of the observations
    blackout: NotNegative[float] = 30.0  # s around an observation without a road that are left out
    run_error: NotNegative[float] = 10.0  # m, largest root mean square distance of a good run from its segment
    min_runs: NotNegative[int] = 2  # good runs that keep a segment
    last_runs: bool = False  # whether the last run of a trip counts; the published program loses it
    collapse_length: NotNegative[float] = 50.0  # m, longest segment that is tried
    collapse_error: NotNegative[float] = 12.0  # m, largest root mean square distance of a run after a collapse


# For fleet data whose traces lie within a metre or two: carriageways stay apart, bends are not cut, and drives of few
# segments lose none. Chosen on training tiles by experiments/compare_biagioni.py; the published numbers are the
# defaults.
FLEET = BiagioniOptions(closing=0.0, simplify_tolerance=2.0, last_runs=True)


def build_biagioni(
    fleet: Fleet,
    *,
    options: BiagioniOptions | None = None,
    workspace: str | Path | None = None,
    progress: Progress | None = None,
) -> RoadGraph:
    """Build a road graph by the method of Biagioni and Eriksson, from traces only.

    Parameters
    ----------
    fleet
        From `probe2road.read_fleet`.
    options
        None takes the defaults.
    workspace
        Folder for what every stage makes. A run on the same fleet with the same options takes the skeleton and the
        result from it. Nothing is written if it is None.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    RoadGraph
        In the fleet's CRS; empty where no road has runs enough. ``forward`` and ``backward`` are good runs along an
        edge, ``support`` is their sum, ``score`` the mean level of the density. There are no turns.

    Raises
    ------
    InputError
        If the fleet has no fixes.
    OptionError
        If an option makes no sense.

    Notes
    -----
    METHOD 4. The restriction to observed turns and the geometry refinement of the paper are not in the published
    program, and not here.

    Examples
    --------
    >>> from probe2road.demo import demo_fleet
    >>> graph = build_biagioni(demo_fleet(n_drives=20))
    >>> graph.length > 2000
    True
    """
    options, report = options or BiagioniOptions(), progress or silent
    fleet = without_strays(fleet, options.gaps)
    grid = dense_grid(fleet, resolution=options.resolution)
    with open_workspace(workspace, fleet, options) as work:
        if (kept := work.read_graph(ROADS)) is not None:
            return kept
        return work.finish(ROADS, _built(fleet, grid, options, work, report))


def _built(fleet: Fleet, grid: Grid, options: BiagioniOptions, work: Workspace, report: Progress) -> RoadGraph:
    """Build the map of a fleet: initial map, pruning, collapse, and pruning again."""
    skeleton = _skeleton(fleet, grid, options, work, report)
    graph = initial_map(skeleton, grid, tolerance=options.simplify_tolerance)
    work.write_graph(VECTORIZED, graph)
    observations = observe_trips(fleet, step=options.matcher.step, gaps=options.gaps)
    report("matching", 0, 2)
    runs = _match(observations, graph, graph.edges["score"].to_numpy(), options)
    graph, runs = prune_segments(graph, runs, min_runs=options.min_runs)
    work.write_graph(PRUNED, graph)
    report("matching", 1, 2)
    graph = collapse_segments(graph, runs, max_length=options.collapse_length, max_error=options.collapse_error)
    work.write_graph(COLLAPSED, graph)
    # Members of a joined segment can have been driven in opposite directions only: its least numbers are then 0.
    weight = np.maximum(graph.edges["support"].to_numpy(np.float64), 1.0)
    runs = _match(observations, graph, weight, options)
    graph, _ = prune_segments(graph, runs, min_runs=options.min_runs)
    report("matching", 2, 2)
    return graph


def _skeleton(
    fleet: Fleet, grid: Grid, options: BiagioniOptions, work: Workspace, report: Progress
) -> NDArray[np.uint8]:
    """Thin the density of all trips."""
    if (kept := work.read_raster(SKELETON, grid)) is not None:
        return kept[:, :]
    report("density", 0, 1)
    sigma, cut = (length / options.resolution for length in SIGMAS[options.sigma])
    closing = round(options.closing / options.resolution)
    ranks = level_ranks(fleet, grid, blur_kernel(sigma, round(cut)), closing=closing, gaps=options.gaps)
    report("skeleton", 0, 1)
    skeleton = gray_skeleton(ranks)
    work.write_raster(SKELETON, skeleton, grid)
    return skeleton


def _match(
    observations: TripPositions, graph: RoadGraph, weight: NDArray[np.float64], options: BiagioniOptions
) -> Runs:
    """Match all trips to the straight pieces of a map, and return the good runs."""
    pieces = straight_pieces(graph)
    way, distance = match_pieces(observations, pieces, weight, options.matcher)
    return good_runs(
        observations,
        pieces,
        way,
        distance,
        blackout=options.blackout,
        max_error=options.run_error,
        last_runs=options.last_runs,
    )
