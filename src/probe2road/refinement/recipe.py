"""Centreline refinement with the fleet's own drives: what the mask cannot say, the traces can.

A raster knows neither whether two ends of roads with a gap between them are one road, nor whether two roads
that cross also meet, nor where a ramp leaves its road. Traces are matched to the graph again and again: to tell which
filled gaps are driven, which junctions are real, what nobody drives, where forks belong, and at last how often every
edge and every turn was driven.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.clean import CleanOptions, clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import Matches, MatchOptions, match
from probe2road.refinement.centreline import CentrelineOptions, refine_centreline
from probe2road.refinement.evidence import EvidenceOptions, add_evidence
from probe2road.refinement.gaps.fill import GapOptions, fill_gaps, fill_jumps, gap_weights, prune_gaps
from probe2road.refinement.junctions.braids import BraidOptions, open_braids
from probe2road.refinement.junctions.forks import ForkOptions, move_forks
from probe2road.refinement.junctions.passages import passing_positions
from probe2road.refinement.junctions.split import DisambiguateOptions, split_false_junctions
from probe2road.refinement.undriven import RungOptions, drop_undriven
from probe2road.run.progress import Progress, silent
from probe2road.run.workspace import Workspace

__all__ = ["RefineOptions", "refine"]

_SPLITS = 2  # how often junctions are split


@dataclass(frozen=True)
class RefineOptions:
    """How traces refine a graph."""

    min_traces: int = 4  # traces that must drive through a filled gap for it to stay
    gap_weight: float = 0.1  # of turning into a gap edge, where an edge of the segmentation has 1
    gaps: GapOptions = field(default_factory=GapOptions)  # which gaps are filled
    matching: MatchOptions = field(default_factory=MatchOptions)  # how traces are matched
    min_support: int | None = None  # traces that must drive on an edge for it to stay; 0 keeps all, None is as for move
    rungs: RungOptions = field(default_factory=RungOptions)  # which edges need more than min_support
    junctions: DisambiguateOptions = field(default_factory=DisambiguateOptions)  # which junctions are split
    braids: BraidOptions = field(default_factory=BraidOptions)  # which chains of edges are roads side by side
    forks: ForkOptions = field(default_factory=ForkOptions)  # which forks are moved to where traces part
    evidence: EvidenceOptions = field(default_factory=EvidenceOptions)  # what counts as having driven an edge
    move: bool | None = None  # whether edges move to the middle of what was driven; None: see `for_segmenter`
    centreline: CentrelineOptions = field(default_factory=CentrelineOptions)  # how far they may

    def __post_init__(self) -> None:
        """Refuse a gap weight that would make gaps as good as roads."""
        if not 0 < self.gap_weight <= 1:
            fix = "use a number above 0, up to 1"
            raise OptionError(f"gap_weight is {self.gap_weight}", where="RefineOptions", fix=fix)

    def for_segmenter(self, *, learned: bool) -> RefineOptions:
        """Settle what is None.

        A network has learned where the middle of a road is, and what it adds to the roads are rungs and fragments that
        nobody drives on. The lines of density lie where the traces do, and where these are few none may be matched.
        """
        return replace(
            self,
            move=not learned if self.move is None else self.move,
            min_support=int(learned) if self.min_support is None else self.min_support,
        )


def refine(
    graph: RoadGraph,
    fleet: Fleet,
    *,
    options: RefineOptions | None = None,
    clean: CleanOptions | None = None,
    workspace: Workspace | None = None,
    progress: Progress | None = None,
) -> RoadGraph:
    """Fill gaps, split false junctions, move forks and count drives, all by matching traces to the graph.

    Parameters
    ----------
    graph
        From `probe2road.vectorize.lines`, or any other without evidence.
    fleet
        The fleet, in the graph's CRS.
    options
        The defaults where it is None; what is None in them is settled as for the density segmenter.
    clean
        How the graph is cleaned once its gaps are filled.
    workspace
        Where the graph of every step is kept.
    progress
        Called as the work goes on.

    Returns
    -------
    RoadGraph
        With evidence on every edge and the turns that were driven. A graph without edges comes back as it is.

    Raises
    ------
    CRSError
        If fleet and graph are in different CRS.

    Notes
    -----
    Paper, section III-B; METHOD 0.1 rows 16 to 27, in the order of row 27.
    """
    options, work = (options or RefineOptions()).for_segmenter(learned=False), workspace or Workspace(None)
    report = progress or silent
    if graph.edges.empty:
        return graph
    report("matching", 0, 6)
    filled = fill_gaps(graph, options=options.gaps)
    matches = _matched(fleet, filled, options)
    jumped = fill_jumps(filled, matches.steps, options=options.gaps)
    if jumped is not filled:
        filled, matches = jumped, _matched(fleet, jumped, options)
    graph = clean_graph(prune_gaps(filled, matches.steps, min_traces=options.min_traces), options=clean)
    work.write_graph("6-gaps-filled", graph)

    # What is split and dropped the first time may have hidden further false junctions.
    matches = match(graph, fleet, options=options.matching)
    for turn in range(_SPLITS):
        report("matching", 1 + 2 * turn, 6)
        positions = passing_positions(graph, fleet, matches)
        split = split_false_junctions(graph, matches.steps, positions=positions, options=options.junctions)
        if turn and (len(split.nodes), len(split.edges)) == (len(graph.nodes), len(graph.edges)):
            break
        graph, matches = split, match(split, fleet, options=options.matching)
        report("matching", 2 + 2 * turn, 6)
        rungs = options.rungs if options.min_support else None
        driven = drop_undriven(graph, matches.steps, min_traces=options.min_support or 0, rungs=rungs)
        if driven is not graph:
            graph = clean_graph(driven, options=clean)
            matches = match(graph, fleet, options=options.matching)
    report("matching", 5, 6)
    opened = open_braids(graph, matches.steps, options=options.braids)
    if opened is not graph:
        graph, matches = opened, match(opened, fleet, options=options.matching)
    moved = move_forks(graph, fleet, matches, options=options.forks)
    if moved is not graph:
        graph, matches = moved, match(moved, fleet, options=options.matching)
    graph = add_evidence(graph, fleet, matches, options=options.evidence)
    if options.move:
        graph = refine_centreline(graph, fleet, matches, options=options.centreline)
    report("matching", 6, 6)
    return graph


def _matched(fleet: Fleet, graph: RoadGraph, options: RefineOptions) -> Matches:
    """Match to a graph with proposed links."""
    return match(graph, fleet, options=options.matching, edge_weights=gap_weights(graph, gap=options.gap_weight))
