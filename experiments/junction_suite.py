"""Junctions of every kind with a known number of drives for each movement: do these two edges connect here?

Run with ``python experiments/junction_suite.py``; ``--builds`` scores whole builds from traces. The tables of
docs/results/junctions.md are its output.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from probe2road.fleet.contract import Fleet
from probe2road.fleet.tables import empty_points
from probe2road.graph.clean import clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import split_edges
from probe2road.graph.tables import finish_edges
from probe2road.graph.topology import end_nodes
from probe2road.matching.match import Matches, match
from probe2road.recipe import BuildOptions, build
from probe2road.refinement.gaps.fill import fill_gaps, gap_weights, prune_gaps
from probe2road.refinement.junctions.passages import passing_positions
from probe2road.refinement.junctions.split import DisambiguateOptions, split_false_junctions
from probe2road.segmentation.options import SegmentationOptions
from probe2road.simulation.drawn.generate import generate_interchange, generate_town
from probe2road.simulation.driving.routes import LinkGraph, draw_route
from probe2road.simulation.fleet_simulation import FleetWorld, fleet_world, simulate_drive
from probe2road.simulation.networks.crossings import find_crossings
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.presets import find_preset
from probe2road.simulation.records import DriveLabels, drive_tables

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
    "guarded, artefacts": (replace(OFF, max_inner=DisambiguateOptions().max_inner), False),
    "with altitude": (replace(OFF, max_inner=DisambiguateOptions().max_inner), True),
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
    return Fleet(traces, empty_points(traces["trace_id"]), network.crs), pd.Series(repetition)


def confusion(graph: RoadGraph, plan: PlanGraph) -> tuple[int, int, int]:
    """Count true positives, false positives and false negatives of connected pairs of ends."""
    ends = graph.edges[["u", "v"]].reindex(plan.graph.edges.index, fill_value=-1).to_numpy().reshape(-1)
    truth = plan.truth
    said = (ends[truth["one"]] == ends[truth["other"]]) & (ends[truth["one"]] >= 0)
    true = truth["connected"].to_numpy()
    return int((said & true).sum()), int((said & ~true).sum()), int((~said & true).sum())


def of_repetitions(
    matches: Matches, positions: pd.DataFrame, repetition: pd.Series, k: int
) -> tuple[pd.DataFrame, ...]:
    """Return steps and positions of the first k repetitions."""
    chosen = repetition.index[repetition < k]
    return matches.steps[matches.steps["trace_id"].isin(chosen)], positions[positions["trace_id"].isin(chosen)]


def split_with(
    graph: RoadGraph,
    steps: pd.DataFrame,
    positions: pd.DataFrame,
    options: DisambiguateOptions,
    with_heights: bool,
) -> RoadGraph:
    """Split a graph, with or without the heights of the traces."""
    known = positions if with_heights else positions.assign(z=np.nan)
    return split_false_junctions(graph, steps, positions=known, options=options)


def score_plan(name: str, preset: str, counts: Iterable[int], *, seed: int) -> pd.DataFrame:
    """Score every variant on the plan graph of one network; tidy, one row for each count and variant."""
    network = network_of(name, seed)
    plan = plan_graph(network)
    counts = list(counts)
    fleet, repetition = drive_movements(network, preset, max(max(counts), 1), seed=seed)
    matches = match(plan.graph, fleet)
    positions = passing_positions(plan.graph, fleet, matches)
    rows = []
    for k in counts:
        steps, known = of_repetitions(matches, positions, repetition, k)
        for variant, (options, with_heights) in VARIANTS.items():
            split = plan.graph
            if options is not None:
                split = split_with(plan.graph, steps, known, options, with_heights)
            rows.append((name, preset, seed, k, variant, *confusion(split, plan)))
    return pd.DataFrame(rows, columns=["kind", "preset", "seed", "drives", "variant", "tp", "fp", "fn"])


def score_builds(name: str, preset: str, counts: Iterable[int], *, seed: int) -> pd.DataFrame:
    """Score every variant on whole builds of one network: density, gaps filled and pruned, junctions split."""
    network = network_of(name, seed)
    plan = plan_graph(network)
    arms = _arms(plan)
    fleet, repetition = drive_movements(network, preset, max(counts), seed=seed)
    rows = []
    for k in counts:
        chosen = fleet.traces["trace_id"].map(repetition) < k
        some = replace(fleet, traces=fleet.traces[chosen].reset_index(drop=True))
        built = build(some, options=BuildOptions(segmentation=SegmentationOptions(segmenter="density"), refine=False))
        filled = fill_gaps(built)
        joined = clean_graph(prune_gaps(filled, match(filled, some, edge_weights=gap_weights(filled)).steps))
        matches = match(joined, some)
        positions = passing_positions(joined, some, matches)
        graphs = {"segmentation": built}
        for variant, (options, with_heights) in VARIANTS.items():
            graphs[variant] = joined
            if options is not None:
                graphs[variant] = split_with(joined, matches.steps, positions, options, with_heights)
        rows += [(name, preset, seed, k, what, *_met(graph, arms, plan.truth)) for what, graph in graphs.items()]
    return pd.DataFrame(rows, columns=["kind", "preset", "seed", "drives", "variant", "tp", "fp", "fn"])


def _arms(plan: PlanGraph) -> pd.DataFrame:
    """Return a place on every edge end at a junction, and the direction there: end, x, y, dx, dy, reach (m)."""
    ends = np.unique(plan.truth[["one", "other"]])
    lines = plan.graph.edges.geometry.to_numpy()[ends // 2]
    length = shapely.length(lines)
    reach = np.minimum(_ARM, length / 2)
    along = np.where(ends % 2 == 0, reach, length - reach)
    here, next_ = (shapely.get_coordinates(shapely.line_interpolate_point(lines, at)) for at in (along, along + 0.5))
    vector = (next_ - here) / np.hypot(*(next_ - here).T)[:, None]
    columns = {"x": here[:, 0], "y": here[:, 1], "dx": vector[:, 0], "dy": vector[:, 1], "reach": reach}
    return pd.DataFrame(columns, index=ends)


def _met(graph: RoadGraph, arms: pd.DataFrame, truth: pd.DataFrame) -> tuple[int, int, int]:
    """Count true and false positives and false negatives: arms that a short way in the graph joins."""
    place = {end: _place(graph, arm) for end, arm in zip(arms.index, arms.itertuples(), strict=True)}
    row = {node: number for number, node in enumerate(graph.nodes.index)}
    u, v = (graph.edges[end].map(row).to_numpy(np.int64) for end in ("u", "v"))
    length = graph.edges["length"].to_numpy()
    shortest = pd.DataFrame({"u": u, "v": v, "m": length}).groupby(["u", "v"])["m"].min()
    at = tuple(shortest.index.get_level_values(level).to_numpy() for level in (0, 1))
    way = dijkstra(coo_array((shortest.to_numpy(), at), shape=(len(row), len(row))), directed=False)

    def joined(one: int, other: int) -> bool:
        first, second = place[one], place[other]
        if first is None or second is None:
            return False
        (i, s), (j, t) = first, second
        ways = [abs(s - t)] if i == j else []
        for a, from_a in ((u[i], s), (v[i], length[i] - s)):
            ways += [from_a + way[a, b] + from_b for b, from_b in ((u[j], t), (v[j], length[j] - t))]
        return bool(min(ways) <= 1.5 * (arms["reach"][one] + arms["reach"][other]) + 20.0)

    said = np.array([joined(*pair) for pair in truth[["one", "other"]].to_numpy()])
    true = truth["connected"].to_numpy()
    return int((said & true).sum()), int((said & ~true).sum()), int((~said & true).sum())


def _place(graph: RoadGraph, arm: Any) -> tuple[int, float] | None:
    """Find the edge that runs by an arm, its row and how far along (m), or nothing."""
    lines = graph.edges.geometry.to_numpy()
    point = shapely.Point(arm.x, arm.y)
    distance = shapely.distance(lines, point)
    for row in np.argsort(distance, kind="stable"):
        if distance[row] > _ARM_REACH:
            break
        along = float(shapely.line_locate_point(lines[row], point))
        a, b = (shapely.get_coordinates(lines[row].interpolate(max(along + d, 0.0)))[0] for d in (-2.0, 2.0))
        cosine = abs(float((b - a) @ [arm.dx, arm.dy])) / max(float(np.hypot(*(b - a))), 1e-9)
        if cosine >= np.cos(np.radians(_ARM_ANGLE)):
            return int(row), along
    return None


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
    parser.add_argument("--builds", action="store_true", help="whole builds from traces instead of plan graphs")
    parser.add_argument("--out", type=Path, help="CSV file of all counts")
    args = parser.parse_args()
    score = score_builds if args.builds else score_plan
    parts = []
    for preset in args.presets:
        for name in args.kinds:
            for seed in args.seeds:
                parts.append(score(name, preset, args.counts, seed=seed))
                print(f"{name}, {preset}, seed {seed}: done", flush=True)
    counted = pd.concat(parts, ignore_index=True)
    if args.out:
        counted.to_csv(args.out, index=False)
    for by in (["preset", "drives"], ["kind", "drives"]):
        print("\nF1 by", " and ".join(by))
        print(_table(counted, by, "f1"))
    for what in ("precision", "recall"):
        print(f"\n{what} by drives")
        print(_table(counted, ["drives"], what))


def _table(counted: pd.DataFrame, by: list[str], what: str) -> str:
    """Write one score with a column for each variant."""
    scores = with_scores(counted, [*by, "variant"]).reset_index()
    wide = scores.pivot_table(index=by, columns="variant", values=what, sort=False, dropna=False)
    return wide.round(3).to_string()


if __name__ == "__main__":
    main()
