"""Junctions of every kind with a known number of drives for each movement: do these two edges connect here?

Run with ``python benchmarks/junction_suite.py`` (about 10 minutes on one core; ``--density`` for whole builds,
``--pictures FOLDER`` for drawings). The tables of docs/results/junctions.md are its output.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from probe2road.disambiguate import DisambiguateOptions, split_false_junctions
from probe2road.fleet import Fleet
from probe2road.gaps import fill_gaps, gap_weights, prune_gaps
from probe2road.mapmatch import Matches, match
from probe2road.passages import junction_altitudes
from probe2road.recipe import build
from probe2road.roadgraph import RoadGraph, finish_edges
from probe2road.simulate.crossings import find_crossings
from probe2road.simulate.fleet_simulation import FleetWorld, fleet_world, simulate_drive
from probe2road.simulate.generate import generate_interchange, generate_town
from probe2road.simulate.network import RoadNetwork
from probe2road.simulate.presets import find_preset
from probe2road.simulate.records import DriveLabels, drive_tables
from probe2road.simulate.routes import LinkGraph, draw_route
from probe2road.splitting import split_edges
from probe2road.topology import end_nodes

KINDS: Mapping[str, Mapping[str, float | str]] = {
    "diamond": {"kind": "diamond"},
    "cloverleaf": {"kind": "cloverleaf"},
    "stack": {"kind": "stack"},
    "trumpet": {"kind": "trumpet"},
    "overpass 20 deg": {"kind": "shallow_overpass", "angle": 20.0},
    "overpass 45 deg": {"kind": "shallow_overpass", "angle": 45.0},
    "overpass 90 deg": {"kind": "shallow_overpass", "angle": 90.0},
    "double deck": {"kind": "double_deck"},
    "merge beside bridge": {"kind": "merge_beside_bridge"},
    "tunnel under junction": {"kind": "tunnel_under_junction"},
    "weaving": {"kind": "weaving"},
    "roundabout": {"kind": "roundabout"},
    "town": {"kind": "town"},
}
OFF = DisambiguateOptions(merge=False, max_inner=0.0)
VARIANTS: Mapping[str, tuple[DisambiguateOptions | None, bool]] = {
    "none": (None, False),
    "literal": (replace(OFF, variant="literal"), False),
    "guarded": (OFF, False),
    "guarded, artefacts": (replace(OFF, max_inner=40.0), False),
    "with altitude": (replace(OFF, max_inner=40.0), True),
}
COUNTS = (0, 1, 2, 4, 8, 50, 200)

_APPROACH = 400.0  # m that a drive begins before, and ends behind, the movement it is made for
_ARM = 35.0  # m from a junction at which its arms are looked up in a graph built from traces
_ARM_REACH = 10.0  # m from there to an edge
_ARM_ANGLE = 30.0  # degrees between the two


@dataclass(frozen=True)
class PlanGraph:
    """A network as a mask shows it: without heights, and with a node wherever two sections cross in plan."""

    graph: RoadGraph
    truth: pd.DataFrame  # node, one, other (edge ends), connected


def network_of(name: str, seed: int) -> RoadNetwork:
    """Draw a network of the suite."""
    rng = np.random.default_rng(seed)
    what = dict(KINDS[name])
    if what["kind"] == "town":
        return generate_town(rng=rng, blocks=3)
    angle = what.get("angle")
    return generate_interchange(str(what["kind"]), rng=rng, angle=None if angle is None else float(angle))


def plan_graph(network: RoadNetwork) -> PlanGraph:
    """Cut sections where they cross in plan, and join the four parts in a node."""
    reference = network.reference_graph()
    edges = reference.edges.set_geometry(shapely.force_2d(reference.edges.geometry.to_numpy()), crs=reference.crs)
    nodes = reference.nodes.set_geometry(shapely.force_2d(reference.nodes.geometry.to_numpy()), crs=reference.crs)
    graph = replace(reference, nodes=nodes, edges=edges)
    table = find_crossings(network).table
    table = table[table["kind"] == "crossing"]
    place = shapely.points(table["x"], table["y"])
    section = np.concatenate([table["upper"], table["lower"]]).astype(np.int64)
    along = shapely.line_locate_point(edges.geometry[section].to_numpy(), np.tile(place, 2))
    true_nodes = set(graph.nodes.index)
    if len(section):
        graph, made = split_edges(graph, section, along)
        same = pd.Series(made[: len(table)], index=made[len(table) :])
        renamed = {end: graph.edges[end].map(lambda node: same.get(node, node)) for end in ("u", "v")}
        graph = replace(
            graph, nodes=graph.nodes.drop(index=same.index), edges=finish_edges(graph.edges.assign(**renamed))
        )
    return PlanGraph(graph, _truth(graph, true_nodes))


def _truth(graph: RoadGraph, true_nodes: set[int]) -> pd.DataFrame:
    """List every pair of edge ends at every junction, and whether they really meet there."""
    node = end_nodes(graph.edges["u"].to_numpy(), graph.edges["v"].to_numpy())
    ends = pd.DataFrame({"node": node, "end": np.arange(len(node))})
    ends["section"] = graph.edges["section"].to_numpy()[ends["end"] // 2]
    pairs = ends.merge(ends, on="node", suffixes=("_one", "_other"))
    pairs = pairs[pairs["end_one"] < pairs["end_other"]]
    pairs = pairs[pairs["node"].map(ends["node"].value_counts()) >= 3]
    connected = pairs["node"].isin(true_nodes) | (pairs["section_one"] == pairs["section_other"])
    return pd.DataFrame(
        {"node": pairs["node"], "one": pairs["end_one"], "other": pairs["end_other"], "connected": connected}
    ).reset_index(drop=True)


def movement_routes(network: RoadNetwork, world: FleetWorld) -> list[FleetWorld]:
    """Choose drives so that every movement and every link is driven by one of them at least."""
    graph = world.traffic.graph
    start = np.repeat(np.arange(graph.n), np.diff(graph.indptr))
    wanted = [(int(a), int(b)) for a, b in zip(start, graph.indices, strict=True)]
    wanted += [(link, link) for link in range(graph.n)]
    length = network.sections.length.to_numpy()[graph.section]
    driven: set[tuple[int, int]] = set()
    worlds = []
    for first, last in wanted:
        if (first, last) in driven:
            continue
        for reach in (_APPROACH, 0.0):
            begin, end = _extended(graph, length, first, -reach), _extended(graph, length, last, reach)
            one = _one_way(world, begin, end)
            route = draw_route(one.traffic.graph, one.preset.demand, rng=np.random.default_rng(0))
            passed = set(zip(route[:-1].tolist(), route[1:].tolist(), strict=True)) | {(k, k) for k in route.tolist()}
            if (first, last) in passed:
                break
        driven |= passed
        worlds.append(one)
    return worlds


def _extended(graph: LinkGraph, length: NDArray[np.float64], link: int, reach: float) -> int:
    """Follow the straightest movements from a link, backwards for a negative reach (m); return the last link."""
    start = np.repeat(np.arange(graph.n), np.diff(graph.indptr))
    here, there = (start, graph.indices) if reach > 0 else (graph.indices, start)
    seen = {link}
    covered = 0.0
    while covered < abs(reach):
        moves = np.flatnonzero(here == link)
        moves = moves[[int(there[move]) not in seen for move in moves]] if len(moves) else moves
        if not len(moves):
            break
        link = int(there[moves[np.abs(graph.turn[moves]).argmin()]])
        seen.add(link)
        covered += float(length[link])
    return link


def _one_way(world: FleetWorld, begin: int, end: int) -> FleetWorld:
    """Return the world in which every drive goes from one link to another, by the shortest way."""
    graph = world.traffic.graph
    origin, attraction = np.zeros(graph.n), np.zeros(graph.n)
    origin[begin] = attraction[end] = 1.0
    demand = replace(world.preset.demand, min_trip_time=0.0, cost_spread=0.0)
    traffic = replace(world.traffic, graph=replace(graph, origin=origin, attraction=attraction))
    return replace(world, traffic=traffic, preset=replace(world.preset, demand=demand))


def drive_movements(network: RoadNetwork, preset: str, count: int, *, seed: int) -> tuple[Fleet, pd.Series]:
    """Drive every route of the suite ``count`` times; also return which repetition each trace is."""
    chosen = replace(find_preset(preset), camera=None)
    world = fleet_world(network, chosen, seed=seed)
    worlds = movement_routes(network, world)
    tables = []
    repetition = {}
    for number, (k, one) in enumerate((k, one) for k in range(count) for one in worlds):
        # Every repetition of a route is another vehicle.
        drive = number * chosen.recording.drives_per_vehicle
        poses, recorded, _ = simulate_drive(one, drive)
        labels = DriveLabels(drive, number, np.datetime64("2024-03-04T00:00:00", "ms") + np.timedelta64(number, "h"))
        tables.append(drive_tables(one.traffic.graph, one.section_id, labels, poses, recorded, None)["traces"])
        repetition[drive] = k
    traces = pd.concat(tables, ignore_index=True)
    points = pd.DataFrame({"trace_id": [], "t": [], "x": [], "y": [], "z": [], "kind": []})
    return Fleet(traces, points, network.crs), pd.Series(repetition)


def confusion(graph: RoadGraph, truth: pd.DataFrame) -> tuple[int, int, int]:
    """Count true positives, false positives and false negatives of connected pairs of ends."""
    node = end_nodes(graph.edges["u"].to_numpy(), graph.edges["v"].to_numpy())
    said = node[truth["one"]] == node[truth["other"]]
    true = truth["connected"].to_numpy()
    return int((said & true).sum()), int((said & ~true).sum()), int((~said & true).sum())


def of_repetitions(matches: Matches, heights: pd.DataFrame, repetition: pd.Series, k: int) -> tuple[pd.DataFrame, ...]:
    """Return steps and heights of the first k repetitions."""
    chosen = repetition.index[repetition < k]
    return matches.steps[matches.steps["trace_id"].isin(chosen)], heights[heights["trace_id"].isin(chosen)]


def score_plan(name: str, preset: str, counts: Iterable[int], *, seed: int) -> pd.DataFrame:
    """Score every variant on the plan graph of one network; tidy, one row for each count and variant."""
    network = network_of(name, seed)
    plan = plan_graph(network)
    counts = list(counts)
    fleet, repetition = drive_movements(network, preset, max(max(counts), 1), seed=seed)
    matches = match(fleet, plan.graph)
    heights = junction_altitudes(fleet, matches, plan.graph)
    rows = []
    for k in counts:
        steps, known = of_repetitions(matches, heights, repetition, k)
        for variant, (options, with_heights) in VARIANTS.items():
            split = plan.graph
            if options is not None:
                split = split_false_junctions(
                    plan.graph, steps, heights=known if with_heights else None, options=options
                )
            rows.append((name, preset, seed, k, variant, *confusion(split, plan.truth)))
    return pd.DataFrame(rows, columns=["kind", "preset", "seed", "drives", "variant", "tp", "fp", "fn"])


def with_scores(counted: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Pool counts and add precision, recall and F1."""
    pooled = counted.groupby(by, sort=False)[["tp", "fp", "fn"]].sum()
    precision = pooled["tp"] / (pooled["tp"] + pooled["fp"])
    recall = pooled["tp"] / (pooled["tp"] + pooled["fn"])
    f1 = 2 * pooled["tp"] / (2 * pooled["tp"] + pooled["fp"] + pooled["fn"])
    return pooled.assign(precision=precision, recall=recall, f1=f1)


def main() -> None:
    """Run the suite and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--presets", nargs="+", default=["open_sky", "mixed"])
    parser.add_argument("--counts", nargs="+", type=int, default=list(COUNTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--out", type=Path, help="CSV file of all counts")
    args = parser.parse_args()
    parts = []
    for preset in args.presets:
        for name in args.kinds:
            for seed in args.seeds:
                parts.append(score_plan(name, preset, args.counts, seed=seed))
                print(with_scores(parts[-1], ["kind", "preset", "drives", "variant"])["f1"].unstack("variant").round(3))
    counted = pd.concat(parts, ignore_index=True)
    if args.out:
        counted.to_csv(args.out, index=False)
    order = [*VARIANTS]
    print("\nF1 by drives per movement")
    print(with_scores(counted, ["preset", "drives", "variant"])["f1"].unstack("variant")[order].round(3))
    print("\nprecision / recall by drives per movement")
    scores = with_scores(counted, ["drives", "variant"])
    print(scores[["precision", "recall"]].unstack("variant").round(3).to_string())


if __name__ == "__main__":
    main()
