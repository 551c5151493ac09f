"""From matched paths to the tables of `probe2road.matching.match.Matches`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.chains import Paths
from probe2road.matching.network import States

__all__ = ["fix_table", "joined_paths", "step_rows", "step_table", "with_strays"]


def joined_paths(found: list[tuple[NDArray[np.int64], Paths]], owner: NDArray[np.int64]) -> Paths:
    """Concatenate the paths of groups of traces, in the order of all traces.

    Parameters
    ----------
    found
        For each group, the numbers of its traces, ascending, and its paths; together all traces.
    owner
        Number of the trace of every fix: `Fleet.owner`.
    """
    if len(found) == 1:
        return found[0][1]
    trace = np.concatenate([traces[paths.trace] for traces, paths in found])
    order = np.argsort(trace, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    fixes = np.argsort(np.concatenate([np.flatnonzero(np.isin(owner, traces)) for traces, _ in found]))
    offset, step = 0, []
    for _, paths in found:
        moved = np.full(len(paths.step), -1, np.int64)
        on = paths.step >= 0
        moved[on] = rank[paths.step[on] + offset]
        step.append(moved)
        offset += len(paths.state)

    def of_fixes(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(paths, name) for _, paths in found])[fixes]

    def of_steps(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(paths, name) for _, paths in found])[order]

    return Paths(
        step=np.concatenate(step)[fixes],
        along=of_fixes("along"),
        distance=of_fixes("distance"),
        near=of_fixes("near"),
        state=of_steps("state"),
        trace=trace[order],
        part=of_steps("part"),
        entered=of_steps("entered"),
    )


def with_strays(paths: Paths, stray: NDArray[np.bool_]) -> Paths:
    """Insert the fixes that were not matched into paths again: they lie on no step, shape (fixes,)."""
    if not stray.any():
        return paths

    def spread(values: NDArray[Any], nothing: Any) -> NDArray[Any]:
        result = np.full(len(stray), nothing, values.dtype)
        result[~stray] = values
        return result

    return paths._replace(
        step=spread(paths.step, -1),
        along=spread(paths.along, np.nan),
        distance=spread(paths.distance, np.nan),
        near=spread(paths.near, False),
    )


def fix_table(
    graph: RoadGraph,
    fleet: Fleet,
    states: States,
    paths: Paths,
    radius: NDArray[np.float64],
    stray: NDArray[np.bool_],
) -> pd.DataFrame:
    """Return the table of fixes: one row for each fix.

    ``radius`` (m), shape (traces,), is what its trace was searched within; ``stray``, shape (fixes,), are those that
    were not looked at.
    """
    matched = paths.step >= 0
    state = np.zeros(len(matched), np.int64)
    state[matched] = paths.state[paths.step[matched]]
    edge_id = graph.edges.index.to_numpy()
    edge = np.zeros(len(matched), np.int64)
    edge[matched] = edge_id[state[matched] >> 1]
    length = np.full(len(matched), np.nan)
    length[matched] = np.maximum(states.length[state[matched] >> 1], 1e-9)  # an edge may be a point
    return pd.DataFrame(
        {
            "trace_id": fleet.traces["trace_id"].array,
            "t": fleet.traces["t"].array,
            "edge": pd.arrays.IntegerArray(edge, ~matched),
            "offset": np.where(matched, paths.along, np.nan),
            "at": np.where(matched, np.clip(paths.along / length, 0.0, 1.0), np.nan),
            "distance": np.where(matched, paths.distance, np.nan),
            "forward": pd.arrays.BooleanArray(state & 1 == 0, ~matched),
            "reason": _reasons(fleet, states, paths, radius, stray),
        },
    )


def _reasons(
    fleet: Fleet, states: States, paths: Paths, radius: NDArray[np.float64], stray: NDArray[np.bool_]
) -> pd.Categorical:
    """Return the reason why a fix has no edge, for every fix; it is missing for fixes with an edge."""
    names = [f"no edge within {value:g} m" for value in np.unique(radius)]
    fits_none, no_edges = len(names), len(names) + 1
    code = np.searchsorted(np.unique(radius), radius)[fleet.owner]
    code[paths.near] = fits_none
    if not len(states.length):
        code[:] = no_edges
    code[stray] = no_edges + 1
    code[paths.step >= 0] = -1
    reasons = (*names, "edges near, but none fits", "the graph has no edges", "could not have been driven to")
    return pd.Categorical.from_codes(code, reasons)


def step_table(graph: RoadGraph, fleet: Fleet, states: States, paths: Paths) -> pd.DataFrame:
    """Return the table of steps: one row for each traversal of an edge."""
    n_steps = len(paths.state)
    node_id = graph.nodes.index.to_numpy(np.int64)
    via = np.where(paths.entered, node_id[states.tail[paths.state]], 0) if n_steps else np.zeros(0, np.int64)
    counts = np.bincount(paths.trace, minlength=fleet.n_traces)
    position = np.arange(n_steps) - np.repeat(np.cumsum(counts) - counts, counts)
    first, last = _first_and_last_fix(paths)
    times = fleet.traces["t"]
    return pd.DataFrame(
        {
            "trace_id": fleet.ids[paths.trace].array,
            "position": position,
            "edge": graph.edges.index.to_numpy(np.int64)[paths.state >> 1],
            "forward": paths.state & 1 == 0,
            "entered": paths.entered,
            "left": np.append(paths.entered[1:], False)[:n_steps],
            "via_node": pd.arrays.IntegerArray(via, ~paths.entered),
            "t_first": _times_at(times, first),
            "t_last": _times_at(times, last),
            "part": paths.part,
        }
    )


def step_rows(graph: RoadGraph, steps: pd.DataFrame, *, where: str) -> NDArray[np.int64]:
    """Return the row of the edge of each step.

    Parameters
    ----------
    graph
        The graph that was matched on.
    steps
        Matched paths: a table with a column ``edge``.
    where
        Who asks, for the message.

    Raises
    ------
    InputError
        If the steps name an edge that is not in the graph.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (9, 0)]], crs="EPSG:32616")
    >>> step_rows(graph, pd.DataFrame({"edge": [0, 7]}), where="match")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: match: edge 7 of the matches is not in the graph; pass the graph that was matched on
    """
    row = graph.edges.index.get_indexer(steps["edge"]).astype(np.int64)
    if (row < 0).any():
        fault = f"edge {steps['edge'].to_numpy()[row < 0][0]} of the matches is not in the graph"
        raise InputError(fault, where=where, fix="pass the graph that was matched on")
    return row


def _first_and_last_fix(paths: Paths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of the first and last fix on every step, -1 where there is none; shape (S,) each."""
    first, last = np.full(len(paths.state), -1, np.int64), np.full(len(paths.state), -1, np.int64)
    rows = np.flatnonzero(paths.step >= 0)
    last[paths.step[rows]] = rows
    first[paths.step[rows[::-1]]] = rows[::-1]
    return first, last


def _times_at(times: pd.Series, rows: NDArray[np.int64]) -> pd.Series:
    """Return the times of fixes, given by row; NaT for row -1."""
    taken = times.take(np.maximum(rows, 0)).reset_index(drop=True)
    return taken.mask(rows < 0)
