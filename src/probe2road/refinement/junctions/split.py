"""False junctions: nodes split where traces show that the roads only cross in plan.

Strategy
--------
Everything is decided between edge ends. For every junction (see `probe2road.refinement.junctions.passages`) the
passages are counted for each pair of ends, both directions together. Pairs driven often enough are joined, and the
connected ends are groups. This is done for all junctions at once; only those left with more than one group, or with
heights that could tell more, are then looked at one by one (`probe2road.refinement.junctions.groups`). The outcome is a
group number per edge end, from which the graph is rebuilt (`probe2road.graph.splitting`).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.bounds import NotNegative, OneOf
from probe2road.graph.clean import merge_degree_two_nodes
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import TURN_DTYPES
from probe2road.options import checked
from probe2road.refinement.junctions.groups import (
    GroupingRules,
    connected_ends,
    evidence,
    proven_groups,
)
from probe2road.refinement.junctions.passages import (
    Passages,
    Places,
    double_passages,
    node_passages,
    places_around,
    places_at_nodes,
)
from probe2road.refinement.junctions.take_apart import open_artefacts, split_nodes

__all__ = ["VARIANTS", "DisambiguateOptions", "split_false_junctions"]

logger = logging.getLogger(__name__)

VARIANTS = ("guarded", "literal")

_SURE = 1.5  # factor on the confidence where only height tells an artefact from a real road


@dataclass(frozen=True)
@checked
class DisambiguateOptions:
    """When edges that meet at a junction count as unconnected."""

    variant: Annotated[str, OneOf(*VARIANTS)] = "guarded"
    min_count: NotNegative[int] = 4  # passages from which two edge ends are connected (METHOD 0.1 row 23)
    min_share: NotNegative[float] = 0.05  # least share in the passages of the less driven end; less is an error
    max_inner: NotNegative[float] = 60.0  # m; shorter edges between junctions may be artefacts; 0 trusts all
    min_apart: NotNegative[float] = 3.0  # m between traces at both nodes of an artefact; on one road they coincide
    min_height: NotNegative[float] = 4.0  # m between traces on stacked roads
    confidence: NotNegative[float] = 2.0  # standard errors by which a height difference must differ from none
    merge: bool = True  # whether nodes of degree 2 are merged afterwards


def split_false_junctions(
    graph: RoadGraph,
    steps: pd.DataFrame,
    *,
    positions: pd.DataFrame | None = None,
    options: DisambiguateOptions | None = None,
) -> RoadGraph:
    """Split junctions where no traces connect the edges that meet there.

    The literal variant is the paper's: edge ends with ``min_count`` passages between them, in both directions together,
    are connected, directly or by way of others, and every node is split into its groups of connected ends. An end that
    nobody drove is cut off.

    The guarded variant splits a node only into groups that traces prove: two groups at least must hold a connected
    pair. Every other end stays with the group that traces connect it to most often, or else with the group that it
    continues most nearly straight. Where positions are given, it also

    * looks at each edge up to ``max_inner`` between two junctions as if it and its nodes were one junction. Where
      traces use it in two ways that never mix, and are apart at both of its nodes or ``min_height`` above each other,
      it is an artefact of roads that cross: it is removed, and both roads are led straight on without a common node;
    * uses the heights of the traces. A road with fewer than ``min_count`` passages is split off if its traces are
      ``min_height`` above or below the others, and roads that cross at one level stay connected.

    Parameters
    ----------
    graph
        Any road graph.
    steps
        Paths matched on it: `probe2road.matching.match.Matches.steps`.
    positions
        Result of `probe2road.refinement.junctions.passages.passing_positions`; only the guarded variant uses them.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        Edges keep ids and attributes. The turn table holds the passages that remain possible. Nodes of degree 2 are
        merged, see `probe2road.graph.clean.merge_degree_two_nodes`.

    Raises
    ------
    InputError
        If the steps name an edge that is not in the graph.

    Notes
    -----
    Paper, section III-B; METHOD 0.1 rows 23, 24, and 7.3.

    Examples
    --------
    Two roads cross, and nobody turns:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> arms = [[(-90, 0), (0, 0)], [(0, 0), (90, 0)], [(0, -90), (0, 0)], [(0, 0), (0, 90)]]
    >>> graph = graph_from_lines(arms, crs="EPSG:32616")
    >>> drives = [{"trace_id": k, "edge": k % 2 * 2 + j, "entered": j == 1} for k in range(8) for j in range(2)]
    >>> steps = pd.DataFrame(drives).assign(forward=True, part=0)
    >>> for line in split_false_junctions(graph, steps).edges.geometry:
    ...     print(line)
    LINESTRING (-90 0, 0 0, 90 0)
    LINESTRING (0 -90, 0 0, 0 90)
    """
    options = options or DisambiguateOptions()
    if options.variant == "literal":
        single = node_passages(graph, steps)
        group = connected_ends(evidence(places_at_nodes(graph), single), min_count=options.min_count)
        passages, result = single, split_nodes(graph, places_at_nodes(graph), group)
        n_removed = 0
    else:
        passages, result, n_removed = _guarded(graph, node_passages(graph, steps, positions), options)
    result = replace(result, turns=_turns(graph, result, passages))
    logger.info(
        "split false junctions: %d nodes became %d, %d artefact edges removed",
        len(graph.nodes), len(result.nodes), n_removed,
    )  # fmt: skip
    return merge_degree_two_nodes(result) if options.merge else result


def _guarded(graph: RoadGraph, single: Passages, options: DisambiguateOptions) -> tuple[Passages, RoadGraph, int]:
    """Split with every guard; return the passages that count, the graph, and the number of removed artefacts."""
    rules = GroupingRules(options.min_count, options.min_share, options.min_height, options.confidence)
    at_nodes = places_at_nodes(graph)
    group = proven_groups(graph, evidence(at_nodes, single), rules)

    groups = pd.Series(group).groupby(at_nodes.junction).nunique().reindex(np.arange(len(graph.nodes)), fill_value=1)
    inner = _possible_artefacts(graph, options.max_inner)
    inner = inner[(groups.to_numpy()[graph.end_rows[inner]] == 1).all(axis=1)]  # what splits by itself is no artefact
    double, at_ends = double_passages(graph, single, inner)
    around = places_around(graph, inner)
    found = evidence(around, double)
    outer_group = proven_groups(graph, found, rules)
    removed = _artefacts(graph, around, outer_group, double, at_ends, found.spread, options)

    # Nodes of a removed artefact are not split one by one as well.
    ends = graph.edges[["u", "v"]].to_numpy()[removed].ravel()
    taken = np.isin(graph.nodes.index, ends)
    group = np.where(taken[at_nodes.junction], at_nodes.junction + len(group), group)
    result = split_nodes(graph, at_nodes, group)
    row = around.junction - len(graph.nodes)
    chosen = np.isin(row, removed)
    result = open_artefacts(result, row[chosen], around.end[chosen], outer_group[chosen])
    passages = Passages.joined(
        single.where(~taken[single.junction]), double.where(np.isin(double.junction - len(graph.nodes), removed))
    )
    return passages, result, len(removed)


def _possible_artefacts(graph: RoadGraph, max_length: float) -> NDArray[np.int64]:
    """Return the rows of the edges between two junctions up to a length (m)."""
    degree = graph.degrees()
    between = (degree[graph.edges["u"]].to_numpy() >= 3) & (degree[graph.edges["v"]].to_numpy() >= 3)
    short = (graph.edges["length"] <= max_length) & (graph.edges["u"] != graph.edges["v"])
    return np.flatnonzero(between & short.to_numpy())


def _artefacts(
    graph: RoadGraph,
    around: Places,
    group: NDArray[np.int64],
    double: Passages,
    at_ends: NDArray[np.float64],
    spread: float,
    options: DisambiguateOptions,
) -> NDArray[np.int64]:
    """Return the edges that separate groups of ends pass over; of two with a common node, only the shorter."""
    over = slice(0, len(at_ends))
    came, went = (group[around.find(double.junction[over], ends[over])] for ends in (double.came, double.went))
    table = pd.DataFrame(at_ends.reshape(-1, 4)).assign(
        z=double.xyz[over, 2], row=double.junction[over] - len(graph.nodes), group=came
    )
    of_group = table[came == went].groupby(["row", "group"])
    traces = of_group["z"].count()
    # The heights of a single trace may all be wrong by metres.
    middle = of_group.median().assign(error=(spread / np.sqrt(traces)).where(traces > 1, np.inf))
    found = [row for row, groups in middle.groupby(level="row") if _are_apart(groups, options)]
    u, v = graph.edges[["u", "v"]].to_numpy().T
    length = graph.edges["length"].to_numpy()
    centre = shapely.line_interpolate_point(graph.edges.geometry.to_numpy()[found], 0.5, normalized=True)
    order = np.lexsort([*shapely.get_coordinates(centre).T, length[found]]) if found else np.zeros(0, np.int64)
    taken: set[int] = set()
    removed = []
    for row in np.array(found, np.int64)[order]:
        if u[row] not in taken and v[row] not in taken:
            taken |= {u[row], v[row]}
            removed.append(row)
    return np.array(removed, np.int64)


def _are_apart(groups: pd.DataFrame, options: DisambiguateOptions) -> bool:
    """Tell whether all groups are apart from each other, either in plan at both nodes or in height.

    The columns are x, y, x, y at the nodes, then z and its standard error, m; heights may be unknown.
    """
    one, other = np.triu_indices(len(groups), 1)
    places, z, error = groups.iloc[:, :4].to_numpy(), groups["z"].to_numpy(), groups["error"].to_numpy()
    away = (places[one] - places[other]).reshape(-1, 2, 2)
    beside = (np.hypot(away[..., 0], away[..., 1]) >= options.min_apart).all(axis=1)
    least = np.maximum(options.min_height, _SURE * options.confidence * np.hypot(error[one], error[other]))
    above = np.abs(z[one] - z[other]) >= least
    return len(one) > 0 and bool((beside | above).all())


def _turns(before: RoadGraph, after: RoadGraph, passages: Passages) -> pd.DataFrame:
    """Count the passages whose two ends still meet."""
    ids = before.edges.index.to_numpy()
    ends = after.edges[["u", "v"]]
    came, went = (
        ends.loc[ids[end // 2]].to_numpy()[np.arange(len(end)), end % 2] for end in (passages.came, passages.went)
    )
    turns = pd.DataFrame({"from_edge": ids[passages.came // 2], "via_node": came, "to_edge": ids[passages.went // 2]})
    counted = turns[came == went].value_counts(sort=False).rename("count").reset_index()
    return counted.sort_values(list(TURN_DTYPES)[:3], ignore_index=True).astype(TURN_DTYPES)
