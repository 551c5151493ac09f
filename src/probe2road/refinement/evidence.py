"""Evidence: what the matched drives say about every edge and every turn.

Only numbers leave here: how many traces, drives and vehicles, never which, and never when.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.bounds import NotNegative
from probe2road.crs import require_same_crs
from probe2road.fleet.contract import Fleet
from probe2road.graph.direction import (
    ONEWAY_TAGS,
    WAYS,
    DirectionOptions,
    counted_direction,
    oneway_probabilities,
    told_direction,
)
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.frame import FramedFixes, Traversals, edge_lines, frame, robust_sigma
from probe2road.matching.match import Matches, turn_counts
from probe2road.options import checked
from probe2road.refinement.heights import HeightOptions, with_heights

__all__ = ["EVIDENCE_COLUMNS", "EvidenceOptions", "add_evidence", "drive_numbers"]

logger = logging.getLogger(__name__)

EVIDENCE_COLUMNS = (
    "support",  # distinct traces
    "drive_support",  # distinct drives
    "vehicle_support",  # distinct vehicles; NA where the fleet does not name them
    "forward",  # traversals from u to v
    "backward",  # traversals from v to u
    "oneway",  # "yes" from u to v, "-1" from v to u, "no", or missing where the counts leave it open
    "oneway_confidence",  # probability of that value, or of the most probable one
    "speed",  # m/s, metres driven by seconds spent, stops included
    "spread",  # m, 1 sigma of the fixes across the road
    "height_spread",  # m, 1 sigma of the heights about the profile
)


@dataclass(frozen=True)
@checked
class EvidenceOptions:
    """When an edge counts as driven, and how the properties of edges are estimated."""

    min_cover: NotNegative[float] = 15.0  # m of an edge, or half of a shorter one, that a traversal has to cover
    drive_pause: NotNegative[float] = 300.0  # s; traces of one vehicle that follow each other sooner are one drive
    max_interval: NotNegative[float] = 60.0  # s; longer intervals between fixes do not count for the speed
    direction: DirectionOptions = field(default_factory=DirectionOptions)  # when counts give oneway a value
    heights: HeightOptions = field(default_factory=HeightOptions)  # how heights are estimated


def add_evidence(
    graph: RoadGraph, fleet: Fleet, matches: Matches, *, options: EvidenceOptions | None = None
) -> RoadGraph:
    """Write into a graph what the matched drives say about its edges and turns.

    Counts are 0, and measured values missing, where nobody drove. A value of ``oneway`` that the graph has already is
    kept, because a sign outranks traffic; its ``oneway_confidence`` then says how well traffic agrees. Heights replace
    those of the graph where the fleet has any, and vertices are added where the profile bends; the course in plan
    stays the same to the last bit. No edge is turned, because the matches say where on its line a fix lies: an edge
    that is driven from v to u only says ``-1`` here, until `probe2road.graph.direction.in_driving_direction` turns it.

    Parameters
    ----------
    graph
        The graph that was matched on.
    fleet
        The fleet that was matched.
    matches
        From `probe2road.matching.match.match`.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        With `EVIDENCE_COLUMNS` and the turn table filled in.

    Raises
    ------
    CRSError
        If fleet and graph are in different CRS.
    InputError
        If the matches belong to another fleet or graph.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.matching.match import match
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 80)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(4), "x": [80.0, 60, 40, 20], "y": 0.0, "z": 7.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> known = add_evidence(graph, fleet, match(graph, fleet))
    >>> known.edges[["support", "forward", "backward", "speed"]].values.tolist()
    [[1, 0, 1, 20.0], [0, 0, 0, nan]]
    >>> print(known.edges.geometry[0])
    LINESTRING Z (0 0 7, 100 0 7)
    """
    options = options or EvidenceOptions()
    require_same_crs(fleet.crs, graph.crs, where="add_evidence")
    driven, fixes = frame(graph, fleet, matches)
    counted = _counts(graph, fleet, driven, options)
    measured = {
        "speed": _speeds(graph, fleet, driven, fixes, options.max_interval),
        "spread": robust_sigma(fixes.left, driven.edge[fixes.traversal], len(graph.edges)),
    }
    edges = graph.edges.assign(**counted, **measured)
    known = replace(graph, edges=edges.assign(**_oneway(edges, options.direction)), turns=turn_counts(matches, graph))
    known = with_heights(known, fleet, driven, fixes, options=options.heights)
    logger.info(
        "%d of %d edges and %d turns were driven; %d edges are one-way, %d are not",
        int((edges["support"] > 0).sum()), len(edges), len(known.turns),
        int(known.edges["oneway"].isin(["yes", "-1"]).sum()), int((known.edges["oneway"] == "no").sum()),
    )  # fmt: skip
    return known


def drive_numbers(fleet: Fleet, *, pause: float = 300.0) -> NDArray[np.int64]:
    """Return the drive of every trace: traces of one vehicle with at most a pause (s) between them are one drive.

    Fleets often cut a drive into several traces. Where vehicles or times are unknown, every trace is a drive.

    Returns
    -------
    ndarray of int64, shape (traces,)

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> times = pd.to_datetime(["08:00", "08:10", "08:12", "08:20", "09:00", "09:10"], format="%H:%M", utc=True)
    >>> table = pd.DataFrame({"trace_id": [1, 1, 2, 2, 3, 3], "vehicle_id": "A", "t": times, "x": 500.0, "y": 0.0})
    >>> fleet = fleet_from_tables(table.assign(x=table.index + 500.0), crs="EPSG:32616", keep_crs=True)
    >>> drive_numbers(fleet).tolist()
    [0, 0, 1]
    """
    starts = fleet.starts
    table = fleet.traces
    number = np.arange(len(starts) - 1)
    if "vehicle_id" not in table or not len(number):
        return number
    spans = pd.DataFrame(
        {
            "vehicle": table["vehicle_id"].to_numpy()[starts[:-1]],
            "begin": table["t"].to_numpy("datetime64[ns]")[starts[:-1]],
            "end": table["t"].to_numpy("datetime64[ns]")[starts[1:] - 1],
        }
    ).sort_values(["vehicle", "begin"], kind="stable", na_position="first")
    ended = spans.groupby("vehicle")["end"].cummax().shift(1)
    follows = spans["vehicle"].eq(spans["vehicle"].shift(1)) & spans["vehicle"].notna()
    follows &= (spans["begin"] - ended) <= pd.Timedelta(seconds=pause)  # False for unknown times
    drive = pd.Series((~follows).cumsum(), index=spans.index).sort_index()
    return pd.factorize(drive)[0].astype(np.int64)


def _counts(
    graph: RoadGraph, fleet: Fleet, driven: Traversals, options: EvidenceOptions
) -> dict[str, pd.arrays.IntegerArray]:
    """Count, for every edge, the distinct traces, drives and vehicles, and the traversals in each direction."""
    length = edge_lines(graph).length[driven.edge]
    enough = driven.high - driven.low >= np.minimum(options.min_cover, length / 2)
    edge, trace, forward = driven.edge[enough], driven.trace[enough], driven.forward[enough]
    n = len(graph.edges)

    def distinct(who: NDArray[np.int64]) -> NDArray[np.int64]:
        pairs = np.unique(np.stack([edge, who]), axis=1)
        return np.bincount(pairs[0, pairs[1] >= 0], minlength=n)

    drives = drive_numbers(fleet, pause=options.drive_pause)
    counts = {
        "support": distinct(trace),
        "drive_support": distinct(drives[trace]),
        "forward": np.bincount(edge[forward], minlength=n),
        "backward": np.bincount(edge[~forward], minlength=n),
    }
    columns = {name: pd.array(count, dtype="Int64") for name, count in counts.items()}
    vehicles = pd.array([pd.NA] * n, dtype="Int64")
    if "vehicle_id" in fleet.traces:
        vehicle = pd.factorize(fleet.traces["vehicle_id"].to_numpy()[fleet.starts[:-1]])[0]
        vehicles = pd.array(distinct(vehicle[trace].astype(np.int64)), dtype="Int64")
    return {**columns, "vehicle_support": vehicles}


def _oneway(edges: pd.DataFrame, options: DirectionOptions) -> dict[str, Any]:
    """Decide the direction of every edge, in the words of OpenStreetMap; a known direction is kept."""
    direction = counted_direction(edges, options=options)
    if "oneway" in edges:
        direction = told_direction(edges["oneway"]).fillna(direction)
    forward, backward = (edges[name].to_numpy(np.float64) for name in ("forward", "backward"))
    probability = oneway_probabilities(forward, backward, options=options)
    column = direction.map({way: place for place, way in enumerate(WAYS)}).astype("Int64")
    chosen = column.fillna(pd.Series(probability.argmax(axis=1), index=edges.index)).to_numpy(np.int64)
    confidence = probability[np.arange(len(edges)), chosen]
    return {
        "oneway": direction.map(ONEWAY_TAGS).astype("str"),
        "oneway_confidence": np.where(forward + backward == 0, np.nan, confidence),
    }


def _speeds(
    graph: RoadGraph, fleet: Fleet, driven: Traversals, fixes: FramedFixes, longest: float
) -> NDArray[np.float64]:
    """Return the mean speed on every edge (m/s), from pairs of consecutive fixes on it; shape (E,).

    Edges with no two such fixes take the mean of the column ``speed`` of their fixes.
    """
    n = len(graph.edges)
    edge = driven.edge[fixes.traversal]
    clock = fleet.traces["t"].to_numpy("datetime64[ns]")[fixes.row]
    seconds = np.diff(clock, prepend=clock[:1]) / np.timedelta64(1, "s")
    metres = np.diff(fixes.along, prepend=fixes.along[:1]) * np.where(driven.forward[fixes.traversal], 1.0, -1.0)
    same = np.diff(fixes.traversal, prepend=-1) == 0
    used = same & (seconds > 0) & (seconds <= longest)
    spent = np.bincount(edge[used], seconds[used], n)
    covered = np.bincount(edge[used], metres[used], n)
    speed = np.divide(covered, spent, out=np.full(n, np.nan), where=(spent > 0) & (covered > 0))
    if "speed" in fleet.traces:
        told = fleet.traces["speed"].to_numpy(np.float64)[fixes.row]
        told_edge, told = edge[np.isfinite(told)], told[np.isfinite(told)]
        count = np.bincount(told_edge, minlength=n)
        mean = np.divide(np.bincount(told_edge, told, n), count, out=np.full(n, np.nan), where=count > 0)
        speed = np.where(np.isfinite(speed), speed, mean)
    return speed
