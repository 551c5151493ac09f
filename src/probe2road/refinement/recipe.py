"""Refinement of a graph with the fleet's own drives: traces show what the mask cannot.

A raster knows neither whether two ends of roads with a gap between them are one road, nor whether two roads
that cross also meet, nor where a ramp leaves its road. Traces are matched to the graph again and again: to tell which
filled gaps are driven, which junctions are real, what nobody drives, where forks belong, and at last how often every
edge and every turn was driven.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated

from probe2road.bounds import Above, AtMost, NotNegative
from probe2road.fleet.contract import Fleet
from probe2road.graph.clean import CleanOptions, clean_graph
from probe2road.graph.direction import in_driving_direction
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import Matches, MatchOptions, match
from probe2road.options import checked
from probe2road.refinement.centreline import CentrelineOptions, refine_centreline
from probe2road.refinement.evidence import EvidenceOptions, add_evidence
from probe2road.refinement.faint import FaintOptions, drop_faint
from probe2road.refinement.gaps.driven import DrivenOptions, add_driven_roads
from probe2road.refinement.gaps.fill import GapOptions, fill_gaps, gap_weights, prune_gaps
from probe2road.refinement.junctions.braids import BraidOptions, open_braids
from probe2road.refinement.junctions.forks import ForkOptions, move_forks
from probe2road.refinement.junctions.passages import passing_positions
from probe2road.refinement.junctions.split import DisambiguateOptions, split_false_junctions
from probe2road.refinement.strays import StrayOptions, drop_strays
from probe2road.refinement.undriven import RungOptions, drop_undriven
from probe2road.run.progress import Progress, silent
from probe2road.run.stages import GAPS_FILLED, Stage

__all__ = ["RefineOptions", "refine"]

logger = logging.getLogger(__name__)


# What refinement draws are straight lines between roads, metres off in places: they may move farther, and bend more.
_REDRAWING = CentrelineOptions(spacing=5.0, reach=15.0, max_shift=15.0, prior_sigma=10.0, fade=10.0)


@dataclass(frozen=True)
@checked
class RefineOptions:
    """How traces refine a graph."""

    min_traces: NotNegative[int] = 4  # traces that must drive through a filled gap, or it is removed
    gap_weight: Annotated[float, Above(0), AtMost(1)] = 0.1  # weight of turning into a gap edge; other edges have 1
    gaps: GapOptions = field(default_factory=GapOptions)  # which gaps are filled
    matching: MatchOptions = field(default_factory=MatchOptions)  # how traces are matched
    driven: DrivenOptions = field(default_factory=DrivenOptions)  # which roads are added that only traces show
    min_support: NotNegative[int] | None = None  # fewest traces on an edge; 0 keeps all; None: see `settled`
    rungs: RungOptions = field(default_factory=RungOptions)  # which edges need more than min_support
    junctions: DisambiguateOptions = field(default_factory=DisambiguateOptions)  # which junctions are split
    braids: BraidOptions = field(default_factory=BraidOptions)  # which chains of edges are roads side by side
    strays: StrayOptions = field(default_factory=StrayOptions)  # which dead ends are errors of positions
    forks: ForkOptions = field(default_factory=ForkOptions)  # which forks are moved to where traces part
    faint: FaintOptions = field(default_factory=FaintOptions)  # which stretches go at last, where cameras are
    evidence: EvidenceOptions = field(default_factory=EvidenceOptions)  # what counts as having driven an edge
    move: bool | None = None  # whether all edges move to the middle of what was driven; None: see `settled`
    centreline: CentrelineOptions = field(default_factory=CentrelineOptions)  # how far edges move
    redrawing: CentrelineOptions = field(default_factory=lambda: _REDRAWING)  # how far, where the mask has no line

    def settled(self, *, learned: bool) -> RefineOptions:
        """Replace options that are None by defaults for learned or unlearned segmentation.

        A network has learned where the middle of a road is, so edges move only where it drew none; its false lines are
        rungs and fragments without drives, which are removed. The lines from density lie where the traces are; where
        these are few, it may happen that none is matched, so edges without a match are kept.

        Faint roads go where there are a network and cameras: of a street that phones recorded, one trace may be all
        that there is.
        """
        return replace(
            self,
            move=not learned if self.move is None else self.move,
            min_support=int(learned) if self.min_support is None else self.min_support,
        )


@dataclass
class _Stand:
    """The input of a step: the current graph, and the fleet's matches to it, which are made when they are asked for."""

    graph: RoadGraph
    fleet: Fleet
    options: RefineOptions
    clean: CleanOptions | None
    drawn: RoadGraph  # what the refinement was given
    proposed: bool  # as of `_Step`
    found: Matches | None  # matches that the step before left valid

    @property
    def matches(self) -> Matches:
        """Return the fleet's matches; the cost of links that are only proposed is higher."""
        if self.found is None:
            weights = gap_weights(self.graph, gap=self.options.gap_weight) if self.proposed else None
            self.found = match(self.graph, self.fleet, options=self.options.matching, edge_weights=weights)
        return self.found


@dataclass(frozen=True)
class _Step:
    """One step of the refinement.

    Attributes
    ----------
    name
        Name of the step in the log.
    apply
        Returns another graph, or the same object where there was nothing to do.
    proposed
        Whether the graph holds links that are only proposed: driving through them then costs more.
    follows
        Whether the step is left out if the step before changed nothing.
    keeps_roads
        Whether edges and nodes stay the same, so that the matches stay valid.
    stage
        Stage of the workspace under which the graph is kept after this step.
    """

    name: str
    apply: Callable[[_Stand], RoadGraph]
    proposed: bool = False
    follows: bool = False
    keeps_roads: bool = False
    stage: Stage | None = None


def _prune_gaps(at: _Stand) -> RoadGraph:
    return clean_graph(prune_gaps(at.graph, at.matches.steps, min_traces=at.options.min_traces), options=at.clean)


def _add_driven(at: _Stand) -> RoadGraph:
    return add_driven_roads(at.graph, at.fleet, options=at.options.driven)


def _split_junctions(at: _Stand) -> RoadGraph:
    positions = passing_positions(at.graph, at.fleet, at.matches)
    split = split_false_junctions(at.graph, at.matches.steps, positions=positions, options=at.options.junctions)
    same = (len(split.nodes), len(split.edges)) == (len(at.graph.nodes), len(at.graph.edges))
    return at.graph if same else split


def _cleaned(at: _Stand, left: RoadGraph) -> RoadGraph:
    """Clean what a step has left of the graph, unless that is all of it."""
    return left if left is at.graph else clean_graph(left, options=at.clean)


def _drop_undriven(at: _Stand) -> RoadGraph:
    least = at.options.min_support or 0
    rungs = at.options.rungs if least else None
    return _cleaned(at, drop_undriven(at.graph, at.matches.steps, min_traces=least, rungs=rungs))


def _open_braids(at: _Stand) -> RoadGraph:
    return open_braids(at.graph, at.matches.steps, options=at.options.braids)


def _drop_strays(at: _Stand) -> RoadGraph:
    return _cleaned(at, drop_strays(at.graph, at.fleet, at.matches, options=at.options.strays))


def _move_forks(at: _Stand) -> RoadGraph:
    return move_forks(at.graph, at.fleet, at.matches, options=at.options.forks)


def _drop_faint(at: _Stand) -> RoadGraph:
    if not at.options.min_support or at.fleet.points.empty:
        return at.graph
    return _cleaned(at, drop_faint(at.graph, at.fleet, at.matches, options=at.options.faint))


def _add_evidence(at: _Stand) -> RoadGraph:
    return add_evidence(at.graph, at.fleet, at.matches, options=at.options.evidence)


def _move_edges(at: _Stand) -> RoadGraph:
    if at.options.move:
        return refine_centreline(at.graph, at.fleet, at.matches, options=at.options.centreline)
    return refine_centreline(at.graph, at.fleet, at.matches, options=at.options.redrawing, drawn=at.drawn)


# What is split and dropped the first time may have hidden further false junctions: both come twice.
_STEPS = (
    _Step("prune gaps", _prune_gaps, proposed=True, stage=GAPS_FILLED),
    _Step("add driven roads", _add_driven),
    _Step("split junctions", _split_junctions),
    _Step("drop undriven edges", _drop_undriven),
    _Step("split junctions again", _split_junctions),
    _Step("drop undriven edges again", _drop_undriven, follows=True),
    _Step("open braids", _open_braids),
    _Step("drop strays", _drop_strays),
    _Step("move forks", _move_forks),
    _Step("drop faint roads", _drop_faint),
    _Step("add evidence", _add_evidence, keeps_roads=True),
    _Step("move edges", _move_edges, keeps_roads=True),
)


def refine(
    graph: RoadGraph,
    fleet: Fleet,
    *,
    learned: bool,
    options: RefineOptions | None = None,
    clean: CleanOptions | None = None,
    keep: Callable[[Stage, RoadGraph], object] | None = None,
    progress: Progress | None = None,
) -> RoadGraph:
    """Fill gaps, split false junctions, move forks and count drives, all by matching traces to the graph.

    Parameters
    ----------
    graph
        From `probe2road.vectorize.lines.vectorize`, or any other without evidence.
    fleet
        The fleet, in the graph's CRS.
    learned
        Whether the lines come from a network that has learned where the middle of a road is, or from the density of
        traces. It decides the value of options that are None; see `RefineOptions.settled`.
    options
        None takes the defaults.
    clean
        How the graph is cleaned once its gaps are filled.
    keep
        Called with each stage of `probe2road.run.stages` that is reached, and the graph as it is then.
    progress
        Called with the number of steps that are done.

    Returns
    -------
    RoadGraph
        With evidence on every edge and the turns that were driven, one-way edges in their driving direction. A graph
        without edges comes back as it is.

    Raises
    ------
    CRSError
        If fleet and graph are in different CRS.

    Notes
    -----
    Paper, section III-B; METHOD 0.1 rows 16 to 27, in the order of row 27.

    Examples
    --------
    >>> from probe2road.demo import demo_fleet
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> fleet = demo_fleet(n_drives=20)
    >>> left, bottom, right, top = fleet.bounds
    >>> straight = graph_from_lines([[(left, bottom), (right, top)]], crs=fleet.crs)
    >>> refine(straight, fleet, learned=False).edges["support"].notna().tolist()
    [True]
    """
    options = (options or RefineOptions()).settled(learned=learned)
    report = progress or silent
    if graph.edges.empty:
        return graph
    report("refinement", 0, len(_STEPS))
    drawn = graph
    graph = fill_gaps(graph, options=options.gaps)
    matches: Matches | None = None
    weighted = changed = True
    for number, step in enumerate(_STEPS, start=1):
        if step.follows and not changed:
            continue
        valid = matches if weighted == step.proposed else None
        stand = _Stand(graph, fleet, options, clean, drawn, step.proposed, valid)
        result = step.apply(stand)
        matches, weighted = stand.found, step.proposed
        changed = result is not graph
        if changed and not step.keeps_roads:
            logger.info("%s: %d nodes and %d edges", step.name, len(result.nodes), len(result.edges))
            matches = None
        graph = result
        if step.stage is not None and keep is not None:
            keep(step.stage, graph)
        report("refinement", number, len(_STEPS))
    return replace(graph, edges=in_driving_direction(graph.edges))  # last, because matches follow the lines
