"""Map matching: which edges of a road graph a fleet drove.

Three profiles behind one function. ``fleet``, for dense traces, and ``sparse``, for fixes 5 s apart and more, find
the most likely route over candidate points (Newson and Krumm, METHOD 5.1); they share their code and differ in
their numbers.
``published`` is the matcher of Biagioni and Eriksson (METHOD 4.4), which the paper uses.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.bounds import OneOf, Positive
from probe2road.crs import extent_in_degrees, require_metric, require_same_crs
from probe2road.fleet.contract import Fleet
from probe2road.fleet.jumps import stray_fixes
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import TURN_DTYPES
from probe2road.matching.chains import Paths, match_over_routes
from probe2road.matching.models import FLEET, SPARSE, PublishedModel, RouteModel
from probe2road.matching.network import States, build_follow, build_states, edge_weight_array
from probe2road.matching.observe import observe, sampling_interval, seconds
from probe2road.matching.published import match_published
from probe2road.matching.tables import fix_table, joined_paths, step_rows, step_table, with_strays
from probe2road.matching.viterbi import Problem, parameters
from probe2road.notebook import figures_table
from probe2road.options import checked

__all__ = ["PROFILES", "MatchOptions", "Matches", "match", "turn_counts"]

logger = logging.getLogger(__name__)

PROFILES = ("auto", "fleet", "sparse", "published")


@dataclass(frozen=True)
@checked
class MatchOptions:
    """How traces are matched to the edges of a graph."""

    profile: Annotated[str, OneOf(*PROFILES)] = "auto"  # "auto" chooses "fleet" or "sparse" for each trace
    sparse_interval: Positive[float] = 5.0  # s, median time between fixes from which "auto" chooses "sparse"
    respect_oneway: bool = True  # whether edges that driving_direction calls one-way are closed the other way
    fleet: RouteModel = field(default=FLEET)
    sparse: RouteModel = field(default=SPARSE)
    published: PublishedModel = field(default=PublishedModel())


@dataclass(frozen=True, eq=False)
class Matches:
    """The result of `match`: where every fix is on the graph, and which edges every trace drove.

    Attributes
    ----------
    fixes
        One row per fix, in the order of the traces: ``trace_id``, ``t``, ``edge`` (Int64, NA where unmatched),
        ``offset`` (m along the edge from u, in plan), ``at`` (the same in 0 to 1: with ``edge`` and ``forward`` a
        reference that outlives a small change of the line, see `probe2road.keep_ids`), ``distance`` (m), ``forward``
        (boolean: driven from u to v), ``reason`` (category: why there is no edge; missing where there is one).
    steps
        The matched paths, one row per traversal of an edge: ``trace_id``, ``position`` (0, 1, ... in the trace),
        ``edge``, ``forward``, ``entered`` (the trace came over the start node of the traversal), ``left`` (it went on
        over the end node), ``via_node`` (Int64: the node entered over, NA where not entered), ``t_first`` and
        ``t_last`` (of the fixes on it; NaT where the edge was passed between two fixes), ``part``. A new part begins
        where the trace left the network or jumped; within a part each traversal starts where the one before ended.
    """

    fixes: pd.DataFrame
    steps: pd.DataFrame

    def __repr__(self) -> str:
        return f"Matches({', '.join(f'{count} {name}' for name, count in self._figures().items())})"

    def _repr_html_(self) -> str:
        """Show figures in a notebook, without any ids."""
        return figures_table("Matches", self._figures())

    def _figures(self) -> dict[str, int]:
        matched = self.fixes["edge"].notna()
        return {
            "traces": self.fixes["trace_id"].nunique(),
            "fixes": len(self.fixes),
            "fixes matched": int(matched.sum()),
            "steps": len(self.steps),
            "edges driven": self.steps["edge"].nunique(),
        }


def match(
    graph: RoadGraph, fleet: Fleet, *, options: MatchOptions | None = None, edge_weights: pd.Series | None = None
) -> Matches:
    """Find the edge of every fix, and the path of every trace.

    Traces are matched one by one; their order does not matter. Ties go to the lower row of the edge table, then to
    the direction from u to v. A fix without an edge near, or in a stretch that fits no road, has no edge and a
    reason; so has one that nobody can have driven to and back from, and the path goes on past it. A graph without edges
    leaves every fix unmatched.

    Parameters
    ----------
    graph
        Road graph in the same CRS. Edges can be driven both ways unless `driving_direction` says otherwise.
    fleet
        Traces; headings, speeds, accuracies and altitudes are used where they are there.
    options
        None takes the defaults.
    edge_weights
        Positive weight of every edge, indexed by edge: the alphas of the paper's equation 1. All equal where it
        is None. Only ratios at one node matter.

    Returns
    -------
    Matches

    Raises
    ------
    CRSError
        If fleet and graph are in different CRS, or not in metres.
    InputError
        If an edge has no positive weight.

    Notes
    -----
    METHOD 4.4, 5.1 and 0.1 rows 19 to 23.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 80)], [(100, 0), (200, 0)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(5), "x": [20.0, 60, 90, 101, 500], "y": [1.0, 0, 2, 40, 500]})
    >>> found = match(graph, fleet_from_tables(table, crs="EPSG:32616", keep_crs=True))
    >>> found.fixes["edge"].tolist()
    [0, 0, 0, 1, <NA>]
    >>> found.fixes["reason"].iloc[-1]
    'no edge within 60 m'
    >>> found.steps[["edge", "forward", "entered", "left", "via_node"]].values.tolist()
    [[0, True, False, True, <NA>], [1, True, True, False, 1]]
    """
    options = options or MatchOptions()
    require_metric(graph.crs, where="graph")
    require_same_crs(fleet.crs, graph.crs, where="match")
    states = build_states(graph, respect_oneway=options.respect_oneway)
    weight = edge_weight_array(graph, edge_weights)
    stray = stray_fixes(fleet)
    driven = replace(fleet, traces=fleet.traces[~stray]) if stray.any() else fleet
    profile = _profiles(driven, options)
    found = []
    for name in np.unique(profile):
        traces = np.flatnonzero(profile == name)
        found.append((traces, _match_profile(_with_traces(driven, traces), states, weight, str(name), options)))
    paths = with_strays(joined_paths(found, driven.owner), stray)
    radius = np.array([_radius(str(name), options) for name in profile])
    matches = Matches(fix_table(graph, fleet, states, paths, radius, stray), step_table(graph, fleet, states, paths))
    logger.info(
        "matched %d of %d fixes of %d traces to %d of %d edges",
        int(matches.fixes["edge"].notna().sum()), len(matches.fixes), fleet.n_traces,
        matches.steps["edge"].nunique(), len(graph.edges),
    )  # fmt: skip
    _warn_of_nothing(graph, fleet, matches)
    return matches


def _warn_of_nothing(graph: RoadGraph, fleet: Fleet, matches: Matches) -> None:
    """Warn if no fix is on the graph: usually the two are in different places, or one has a wrong CRS."""
    if len(fleet.traces) == 0 or matches.fixes["edge"].notna().any():
        return
    if graph.edges.empty:
        logger.warning("no fix is matched: the graph has no edges")
        return
    logger.warning(
        "no fix of %d is matched: the graph is at %s, the traces at %s",
        len(fleet.traces),
        extent_in_degrees(graph.bounds, graph.crs),
        extent_in_degrees(fleet.bounds, fleet.crs),
    )


def turn_counts(matches: Matches, graph: RoadGraph) -> pd.DataFrame:
    """Count how often traces went from one edge over a node to another.

    Parameters
    ----------
    matches
        Result of `match` on this graph.
    graph
        The graph, whose turn table has the same columns.

    Returns
    -------
    DataFrame
        ``from_edge``, ``via_node``, ``to_edge``, ``count``, for ordered pairs that were driven at least once,
        sorted. An edge follows itself where a trace turned back at a node, or drove around a loop twice.

    Notes
    -----
    METHOD 0.1 row 23, before pooling both directions: a break or a stretch off the network is no turn.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (200, 0)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(4), "x": [130.0, 110, 90, 70], "y": 0.0})
    >>> found = match(graph, fleet_from_tables(table, crs="EPSG:32616", keep_crs=True))
    >>> turn_counts(found, graph).values.tolist()
    [[1, 1, 0, 1]]
    """
    steps = matches.steps
    onto = np.flatnonzero(steps["entered"].to_numpy())
    edge = graph.edges.index.to_numpy()[step_rows(graph, steps, where="turn_counts")]
    via = steps["via_node"].to_numpy(np.int64, na_value=-1)
    turns = pd.DataFrame({"from_edge": edge[onto - 1], "via_node": via[onto], "to_edge": edge[onto]})
    counted = turns.value_counts(sort=False).rename("count").reset_index()
    return counted.sort_values(list(TURN_DTYPES)[:3], ignore_index=True).astype(TURN_DTYPES)


def _profiles(fleet: Fleet, options: MatchOptions) -> NDArray[np.str_]:
    """Return the name of the matching profile of every trace."""
    if options.profile != "auto":
        return np.full(fleet.n_traces, options.profile)
    interval = sampling_interval(seconds(fleet), fleet.starts)
    return np.where(interval >= options.sparse_interval, "sparse", "fleet")


def _with_traces(fleet: Fleet, traces: NDArray[np.int64]) -> Fleet:
    """Return the fleet with only some of its traces, given by ascending number."""
    if len(traces) == fleet.n_traces:
        return fleet
    chosen = np.zeros(fleet.n_traces, bool)
    chosen[traces] = True
    return replace(fleet, traces=fleet.traces[chosen[fleet.owner]])


def _match_profile(
    fleet: Fleet, states: States, weight: NDArray[np.float64], name: str, options: MatchOptions
) -> Paths:
    """Match a fleet with one matching profile."""
    if name == "published":
        return match_published(fleet, states, weight, options.published)
    model = options.sparse if name == "sparse" else options.fleet
    follow = build_follow(states, weight, uturn_cost=model.uturn_cost, turn_cost=model.turn_cost)
    observed = observe(fleet, seconds(fleet), states, model)
    return match_over_routes(Problem(states, follow, observed, parameters(model)), fleet.starts)


def _radius(name: str, options: MatchOptions) -> float:
    """Return the distance within which a matching profile looks for edges, m."""
    if name == "published":
        return options.published.cutoff
    return options.sparse.radius if name == "sparse" else options.fleet.radius
