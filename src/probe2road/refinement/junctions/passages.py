"""Passages: how traces pass the junctions of a graph, from edge end to edge end, and where they were then.

Strategy
--------
An edge has two ends, as in `probe2road.graph.ends`: end ``2 e`` where edge row ``e`` starts, ``2 e + 1`` where it
stops. A passage is a trace's way over a junction, from the end it arrived by to the end it left by; steps name
directions, so that loops are not ambiguous. A junction is a node, or an edge short enough to be an artefact together
with both of its nodes: then the passages over that edge lead from outer end to outer end, and the edge itself is
inside. Junction ``n`` below the number of nodes is node row ``n``; junction ``n_nodes + e`` is edge row ``e`` with its
nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import Matches
from probe2road.matching.tables import step_rows

__all__ = [
    "Passages",
    "Places",
    "double_passages",
    "node_passages",
    "passing_positions",
    "places_around",
    "places_at_nodes",
]

_FAR = 60.0  # m; between two fixes farther apart, positions are not interpolated


@dataclass(frozen=True)
class Passages:
    """n passages over junctions, in the order of the steps."""

    junction: NDArray[np.int64]  # (n,)
    came: NDArray[np.int64]  # (n,) edge end
    went: NDArray[np.int64]  # (n,) edge end
    trace: NDArray[np.int64]  # (n,) number of the trace
    xyz: NDArray[np.float64]  # (n, 3) m, where the trace was; NaN where unknown
    step: NDArray[np.int64]  # (n,) row of the steps table, of the step after the junction

    def where(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Passages:
        """Return the passages that a mask or rows select."""
        return Passages(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))

    @classmethod
    def joined(cls, *parts: Passages) -> Passages:
        """Concatenate several tables of passages."""
        names = cls.__dataclass_fields__
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class Places:
    """m edge ends at junctions, sorted by junction and end."""

    junction: NDArray[np.int64]  # (m,)
    end: NDArray[np.int64]  # (m,)

    def where(self, kept: NDArray[np.bool_]) -> Places:
        """Return the places that a mask or rows select."""
        return Places(self.junction[kept], self.end[kept])

    def find(self, junction: NDArray[np.int64], end: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows of places that are known to be in the table."""
        size = int(self.end.max(initial=0)) + 1
        return np.searchsorted(self.junction * size + self.end, junction * size + end)


def places_at_nodes(graph: RoadGraph) -> Places:
    """Return the ends at every node."""
    node = graph.end_rows.ravel()
    order = np.argsort(node, kind="stable")
    return Places(node[order], order)


def places_around(graph: RoadGraph, inner: NDArray[np.int64]) -> Places:
    """Return the edge ends around edges that count as one junction with their nodes; their own ends are left out."""
    at_nodes = places_at_nodes(graph)
    ends = pd.DataFrame({"node": at_nodes.junction, "end": at_nodes.end})
    near = pd.DataFrame({"node": graph.end_rows[inner].T.ravel(), "edge": np.tile(inner, 2)}).merge(ends)
    near = near[near["end"] // 2 != near["edge"]].sort_values(["edge", "end"])
    return Places(near["edge"].to_numpy(np.int64) + len(graph.nodes), near["end"].to_numpy(np.int64))


def passing_positions(graph: RoadGraph, fleet: Fleet, matches: Matches) -> pd.DataFrame:
    """Return the position of every trace at the moment it passed a node.

    Positions are those of the traces themselves, interpolated between the fixes around the node. One trace is
    metres off, most of all in height, and by nearly the same all along its drive: positions at one junction are to be
    compared between many traces, not believed one by one.

    Parameters
    ----------
    graph
        The graph.
    fleet
        The fleet that was matched.
    matches
        Its matches on ``graph``.

    Returns
    -------
    DataFrame
        ``trace_id``, ``position`` (of the step after the node), ``via_node``, ``x``, ``y``, ``z`` (m; NaN where the
        trace has no clock or no fixes near the node, ``z`` also where it has no heights).

    Raises
    ------
    InputError
        If the matches are of another graph.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.matching.match import match
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (200, 0)]], crs="EPSG:32616")
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(4), "x": [70.0, 90, 110, 130], "y": 0.0, "z": [4.0, 5, 7, 8]})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> passing_positions(graph, fleet, match(graph, fleet)).values.tolist()
    [[1.0, 1.0, 1.0, 100.0, 0.0, 6.0]]
    """
    steps = matches.steps
    entered = steps["entered"].to_numpy(bool)
    via = steps["via_node"].to_numpy(np.int64, na_value=-1)
    if not np.isin(via[entered], graph.nodes.index).all():
        raise InputError("the matches name nodes that are not in the graph", where="passing_positions")
    first, last = (steps[name].to_numpy("datetime64[ns]") for name in ("t_first", "t_last"))
    trace = steps["trace_id"]
    before = pd.Series(last).groupby(trace.to_numpy()).ffill().shift(1).to_numpy()
    after = pd.Series(first).groupby(trace.to_numpy()).bfill().to_numpy()
    known = entered & ~np.isnat(before) & ~np.isnat(after)
    xyz = np.full((len(steps), 3), np.nan)
    middle = before[known] + (after[known] - before[known]) // 2
    place = shapely.get_coordinates(graph.nodes.geometry[via[known]].to_numpy())
    xyz[known] = _interpolated(fleet, trace[known], middle, place)
    table = (
        steps[["trace_id", "position", "via_node"]]
        .assign(**dict(zip("xyz", xyz.T, strict=True)))[entered]
        .reset_index(drop=True)
    )
    return table.astype({"via_node": "int64"})


def node_passages(graph: RoadGraph, steps: pd.DataFrame, positions: pd.DataFrame | None = None) -> Passages:
    """Return the passages over single nodes: one for each step that enters its edge over a node.

    Raises
    ------
    InputError
        If the steps name an edge that is not in the graph.
    """
    row = step_rows(graph, steps, where="node_passages")
    forward = steps["forward"].to_numpy(bool)
    onto = np.flatnonzero(steps["entered"].to_numpy(bool))
    went = 2 * row + np.where(forward, 0, 1)
    came = 2 * row + np.where(forward, 1, 0)
    node = graph.end_rows.ravel()
    xyz = np.full((len(onto), 3), np.nan)
    if positions is not None:
        keys = ["trace_id", "position"]
        known = steps.iloc[onto][keys].merge(positions[[*keys, *"xyz"]], on=keys, how="left")
        xyz = known[[*"xyz"]].to_numpy(np.float64)
    trace = pd.factorize(steps["trace_id"])[0][onto]
    return Passages(node[went[onto]], came[onto - 1], went[onto], trace, xyz, onto)


def double_passages(
    graph: RoadGraph, single: Passages, inner: NDArray[np.int64]
) -> tuple[Passages, NDArray[np.float64]]:
    """Return the passages over edges that count as one junction together with their two nodes.

    Parameters
    ----------
    graph
        The graph.
    single
        Its `node_passages`.
    inner
        Rows of edges; they may share nodes.

    Returns
    -------
    Passages
        First those over the inner edge from outer end to outer end, then those past it at one of its nodes. A trace
        that begins, ends or turns back on the inner edge does not count.
    ndarray of float64
        Shape (k, 2, 2): x and y (m) of the traces of the first k passages, those over the inner edge, when they passed
        its start and when they passed its end.
    """
    n_nodes = len(graph.nodes)
    is_inner = np.zeros(len(graph.edges), bool)
    is_inner[inner] = True
    onto = np.flatnonzero(is_inner[single.went // 2])
    onto = onto[onto + 1 < len(single.step)]
    off = onto + 1
    through = (single.step[off] == single.step[onto] + 1) & (single.came[off] == single.went[onto] ^ 1)
    through &= (single.came[onto] // 2 != single.went[onto] // 2) & (single.went[off] // 2 != single.came[off] // 2)
    onto, off = onto[through], off[through]
    over = replace(
        single.where(off),
        junction=n_nodes + single.went[onto] // 2,
        came=single.came[onto],
        xyz=(single.xyz[onto] + single.xyz[off]) / 2,
    )
    at_ends = np.stack([single.xyz[onto, :2], single.xyz[off, :2]], axis=1)
    backwards = single.went[onto] % 2 == 1
    at_ends[backwards] = at_ends[backwards, ::-1]
    near = pd.DataFrame({"node": graph.end_rows[inner].T.ravel(), "edge": np.tile(inner, 2)})
    past = pd.DataFrame({"node": single.junction, "at": np.arange(len(single.junction))}).merge(near, on="node")
    at, edge = past["at"].to_numpy(), past["edge"].to_numpy()
    outside = (single.came[at] // 2 != edge) & (single.went[at] // 2 != edge)
    beside = replace(single.where(at[outside]), junction=n_nodes + edge[outside])
    return Passages.joined(over, beside), at_ends


def _interpolated(
    fleet: Fleet, trace_id: pd.Series, moment: NDArray[np.datetime64], place: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate traces at given moments, nearest to given places; NaN where no fixes are near; shape (n, 3)."""
    trace = fleet.ids.get_indexer(trace_id)
    clock = fleet.traces["t"].to_numpy("datetime64[ns]")
    fixes = pd.DataFrame({"trace": fleet.owner, "t": clock}).assign(row=np.arange(len(clock)))
    wanted = pd.DataFrame({"trace": trace, "t": moment}).assign(order=np.arange(len(trace))).sort_values("t")
    # A trace without a clock has NaT as every time: its fixes are neither before nor after a moment.
    fixes = fixes[~np.isnat(clock)].sort_values("t", kind="stable")
    row_before = pd.merge_asof(wanted, fixes, on="t", by="trace").set_index("order")["row"]
    row_after = pd.merge_asof(wanted, fixes, on="t", by="trace", direction="forward").set_index("order")["row"]
    row_before, row_after = (rows.sort_index().to_numpy(np.float64) for rows in (row_before, row_after))
    known = np.isfinite(row_before) & np.isfinite(row_after)
    result = np.full((len(moment), 3), np.nan)
    before, after = row_before[known].astype(np.int64), row_after[known].astype(np.int64)
    xyz = fleet.traces[["x", "y", "z"]].to_numpy(np.float64)
    # The position is that of the nearest place to the node, between the two fixes around the moment.
    ahead, to_node = xyz[after, :2] - xyz[before, :2], place[known] - xyz[before, :2]
    square = (ahead**2).sum(axis=1)
    share = np.divide((ahead * to_node).sum(axis=1), square, out=np.zeros(len(before)), where=square > 0).clip(0.0, 1.0)
    near = np.hypot(*ahead.T) <= _FAR
    near &= np.hypot(*to_node.T) <= _FAR
    result[known] = np.where(near[:, None], xyz[before] + share[:, None] * (xyz[after] - xyz[before]), np.nan)
    return result
