"""Time map matching on a generated city, with one process.

python benchmarks/bench_mapmatch.py [--km 500] [--traces 400]

Drives of half an hour at 1 Hz and 12 m/s along random streets that never turn back, with errors of 3 m that
correlate over 20 s. The table gives fixes per CPU second, the set-up of the network included, and the share of fixes on
the edge that was driven; fixes within 10 m of a node count for either edge.
"""

from __future__ import annotations

import argparse
from time import process_time

import numpy as np
import pandas as pd
from bench_metrics import street_lines
from numpy.typing import NDArray

from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.matching.match import MatchOptions, match

SPEED = 12.0  # m/s
DURATION = 1800  # s
ERROR = 3.0  # m, 1 sigma on each axis
CORRELATION = 20.0  # s
NODE_REACH = 10.0  # m


def random_drives(graph: RoadGraph, n_traces: int, rng: np.random.Generator) -> tuple[Fleet, NDArray[np.int64]]:
    """Drive along random edges; return the fleet and the edge of every fix, -1 near nodes."""
    lines = [np.asarray(line.coords)[:, :2] for line in graph.edges.geometry]
    ends = graph.edges[["u", "v"]].to_numpy()
    at_node: list[list[int]] = [[] for _ in range(len(graph.nodes))]
    for edge, (u, v) in enumerate(ends):
        at_node[u].append(edge)
        at_node[v].append(edge)
    tables, truth = [], []
    for trace in range(n_traces):
        edge, forward = int(rng.integers(len(lines))), True
        parts, owners, driven = [], [], 0.0
        while driven < SPEED * DURATION:
            line = lines[edge] if forward else lines[edge][::-1]
            parts.append(line)
            owners.append(np.full(len(line), edge))
            driven += float(np.hypot(*np.diff(line, axis=0).T).sum())
            node = ends[edge][1 if forward else 0]
            onward = [other for other in at_node[node] if other != edge] or [edge]
            edge = int(rng.choice(onward))
            forward = bool(ends[edge][0] == node)
        line, owner = np.concatenate(parts), np.concatenate(owners)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        at = SPEED * np.arange(DURATION)
        xy = np.stack([np.interp(at, along, line[:, axis]) for axis in range(2)], axis=1)
        keep = np.exp(-1.0 / CORRELATION)
        noise = rng.normal(0, ERROR * np.sqrt(1 - keep**2), xy.shape)
        error = np.array([rng.normal(0, ERROR, 2)])
        for step in noise[1:]:
            error = np.append(error, [keep * error[-1] + step], axis=0)
        nodes = along[np.flatnonzero(np.diff(owner) != 0)]
        place = np.clip(np.searchsorted(nodes, at), 1, len(nodes) - 1)
        close = np.minimum(np.abs(at - nodes[place]), np.abs(at - nodes[place - 1])) < NODE_REACH
        truth.append(np.where(close, -1, owner[np.searchsorted(along, at, side="right") - 1]))
        tables.append(pd.DataFrame({"trace_id": trace, "t": np.arange(DURATION), "x": xy[:, 0], "y": xy[:, 1]}))
        tables[-1][["x", "y"]] += error
    return fleet_from_tables(pd.concat(tables), crs=graph.crs, target_crs=graph.crs), np.concatenate(truth)


def main() -> None:
    """Print one line for each profile and interval."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--km", type=float, default=500.0)
    parser.add_argument("--traces", type=int, default=400)
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    graph = graph_from_lines(street_lines(arguments.km, rng), crs="EPSG:32616")
    fleet, truth = random_drives(graph, arguments.traces, rng)
    print(f"{graph}\n{len(fleet.traces)} fixes of {fleet.n_traces} traces at 1 Hz")
    print(f"{'profile':<12}{'s':>4}{'fixes':>10}{'fixes/CPU-s':>14}{'right edge':>12}")
    for profile, interval in (("fleet", 1), ("sparse", 5), ("sparse", 30), ("published", 1)):
        rows = np.arange(len(truth)) % DURATION % interval == 0
        thinned = Fleet(fleet.traces[rows].reset_index(drop=True), fleet.points, fleet.crs)
        first = Fleet(thinned.traces[: DURATION // interval], fleet.points, fleet.crs)
        match(graph, first, options=MatchOptions(profile=profile))  # compile
        started = process_time()
        found = match(graph, thinned, options=MatchOptions(profile=profile))
        seconds = process_time() - started
        known = truth[rows] >= 0
        right = (found.fixes["edge"].to_numpy(np.int64, na_value=-1)[known] == truth[rows][known]).mean()
        print(f"{profile:<12}{interval:>4}{rows.sum():>10}{rows.sum() / seconds:>14,.0f}{right:>12.4f}")


if __name__ == "__main__":
    main()
