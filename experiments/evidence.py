"""Are the counts, directions, heights and speeds that evidence writes into a graph true?

Usage: python experiments/evidence.py [--data ../shared/data] [--seed 21]

A simulated fleet is matched to the true centrelines, without their heights, directions and counts, and what evidence
says of every edge is compared with the truth. The table of docs/concepts/evidence.md is the output; about a minute.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import shapely

from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.frame import edge_lines, stations_along
from probe2road.matching.match import match
from probe2road.refinement.evidence import add_evidence
from probe2road.simulation.drawn.generate import generate_interchange, generate_town
from probe2road.simulation.fleet_simulation import SimulatedFleet, simulate
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.networks.osm import read_network

CASES = ("cloverleaf", "stack", "irregular town", "tokyo_shibuya")
PRESETS = ("mixed", "phone")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("PROBE2ROAD_DATA", str(Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--seed", type=int, default=21)
    arguments = parser.parse_args()
    print("| network | preset | support exact | off by | of | one-way: right | wrong | open |", end="")
    print(" false turns | height off by | 95 % | speed off by |\n|---|---|---|---|---|---|---|---|---|---|---|---|")
    for case in CASES:
        network = network_of(case, arguments.data, arguments.seed)
        if network is None:
            continue
        for preset in PRESETS:
            result = simulate(network, preset=preset, n_drives=300, seed=arguments.seed)
            print(f"| {case} | {preset} | {' | '.join(row(result))} |", flush=True)


def network_of(case: str, data: Path, seed: int) -> RoadNetwork | None:
    """Draw or read a network; None where its file is absent."""
    rng = np.random.default_rng(seed)
    if case.endswith("town"):
        return generate_town(rng=rng, regular=False, blocks=5)
    if case.startswith("tokyo"):
        path = data / "osm" / f"{case}.osm.pbf"
        return read_network(path) if path.is_file() else None
    return generate_interchange(case, rng=rng)


def row(result: SimulatedFleet) -> list[str]:
    """Compare evidence with truth."""
    truth = result.reference
    graph = bare(truth)
    found = add_evidence(graph, result.fleet, match(graph, result.fleet))
    support, true_support = (g.edges["support"].to_numpy(np.float64) for g in (found, truth))
    driven = true_support > 0
    off = np.abs(support - true_support)[driven]
    decided = (found.edges["oneway"].notna() & driven).to_numpy()
    right = ((found.edges["oneway"] != "no") == truth.edges["oneway"]).to_numpy()[decided]
    turns = found.turns.merge(truth.turns, how="left", on=["from_edge", "via_node", "to_edge"], suffixes=("", "_true"))
    false = turns["count"][turns["count_true"].isna()].sum() / turns["count"].sum()
    heights = height_errors(found, truth)
    speed = np.abs(found.edges["speed"] / true_speeds(result).reindex(found.edges.index) - 1)[driven]
    cells = [f"{(off == 0).mean():.2f}", f"{off.mean():.2f}", f"{true_support[driven].mean():.0f}"]
    cells += [str(int(right.sum())), str(int((~right).sum())), str(int(driven.sum() - decided.sum()))]
    return [
        *cells,
        f"{false:.1%}",
        f"{heights.mean():.2f} m",
        f"{np.percentile(heights, 95):.2f} m",
        f"{speed.median():.1%}",
    ]


def bare(reference: RoadGraph) -> RoadGraph:
    """Take heights, directions and counts out of a reference."""
    edges = reference.edges.set_geometry(shapely.force_2d(reference.edges.geometry.to_numpy()), crs=reference.crs)
    unknown = {name: pd.array([pd.NA] * len(edges), "Int64") for name in ("support", "forward", "backward")}
    return replace(reference, edges=edges.drop(columns="oneway").assign(**unknown), turns=reference.turns.iloc[:0])


def height_errors(graph: RoadGraph, reference: RoadGraph) -> np.ndarray:
    """Errors of heights (m) each 10 m, about their median, on edges with four traces or more."""
    places = stations_along(edge_lines(reference).length, 10.0)
    z, true_z = (edge_lines(g).at(places.edge, places.along)[0][:, 2] for g in (graph, reference))
    used = np.isfinite(z) & (graph.edges["support"].to_numpy(np.int64) >= 4)[places.edge]
    error = (z - true_z)[used]
    return np.asarray(np.abs(error - np.median(error)))


def true_speeds(result: SimulatedFleet) -> pd.Series:
    """Metres by seconds between true poses that follow each other on a section."""
    poses = result.poses
    step = poses.groupby("trace_id")[["x", "y"]].diff()
    seconds = poses.groupby("trace_id")["t"].diff().dt.total_seconds()
    same = poses["section"].eq(poses["section"].shift()) & (seconds > 0)
    total = pd.DataFrame({"m": np.hypot(step["x"], step["y"]), "s": seconds})[same].groupby(poses["section"]).sum()
    return total["m"] / total["s"]


if __name__ == "__main__":
    main()
