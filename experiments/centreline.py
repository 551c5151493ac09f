"""Does centreline refinement bring edges nearer to the true centreline?

Usage: python experiments/centreline.py [--data ../shared/data] [--seed 11] [--only NAME]

Graphs are built from simulated fleets with all stages but this one, then moved by the same fleet, and compared with
the true centrelines; then the same on the real traces of Chicago against its references. The seeds are not those that
the options were chosen with (1 to 3). The tables of docs/results/centreline.md are the output; 5 minutes on one core.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road import build, evaluate, read_fleet, read_graph
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.frame import edge_lines, stations_along
from probe2road.matching.match import match
from probe2road.recipe import BuildOptions
from probe2road.refinement.centreline import CentrelineOptions, refine_centreline
from probe2road.refinement.recipe import RefineOptions
from probe2road.segmentation.options import SegmentationOptions
from probe2road.simulation.drawn.generate import generate_interchange, generate_town
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.networks.osm import read_network

CASES = ("cloverleaf", "diamond", "trumpet", "regular town", "irregular town", "tokyo_shibuya")
PRESETS = ("mixed", "phone")
UNMOVED = BuildOptions(segmentation=SegmentationOptions(segmenter="density"), refinement=RefineOptions(move=False))

_STEP = 5.0  # m between the places at which the error is measured
_FAR = 15.0  # m; what is farther from every true road running that way is a wrong road, not a wrong place
_ANGLE = 30.0  # degrees
_DRIVES = {"tokyo_shibuya": 400}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("PROBE2ROAD_DATA", str(Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--seed", type=int, default=12)
    parser.add_argument("--only", help="one of the cases, or chicago")
    arguments = parser.parse_args()
    cases = [arguments.only] if arguments.only in CASES else [] if arguments.only else list(CASES)
    print("| network | preset | km | mean, m | 95 %, m | within 1 m | without boundaries: mean | 95 % | 1 m |")
    print("|---|---|---|---|---|---|---|---|---|")
    for case in cases:
        network = network_of(case, arguments.data, arguments.seed)
        for preset in PRESETS:
            if network is not None:
                simulated(case, network, preset, arguments.seed)
    if arguments.only in (None, "chicago"):
        chicago(arguments.data / "traces" / "chicago_shuttle")


def network_of(case: str, data: Path, seed: int) -> RoadNetwork | None:
    """Draw or read a network; None where its file is absent."""
    rng = np.random.default_rng(seed)
    if case.endswith("town"):
        return generate_town(rng=rng, regular=case.startswith("regular"), blocks=5)
    if case.startswith("tokyo"):
        path = data / "osm" / f"{case}.osm.pbf"
        return read_network(path) if path.is_file() else None
    return generate_interchange(case, rng=rng)


def simulated(case: str, network: RoadNetwork, preset: str, seed: int) -> None:
    """Build and refine one graph and print its row."""
    result = simulate(network, preset=preset, n_drives=_DRIVES.get(case, 300), seed=seed)
    graph = build(result.fleet, options=UNMOVED)
    matches = match(graph, result.fleet)
    refined = refine_centreline(graph, result.fleet, matches)
    alone = refine_centreline(graph, result.fleet, matches, options=CentrelineOptions(boundaries=False))
    before, after, by_traces = (figures(lateral_errors(g, result.reference)) for g in (graph, refined, alone))
    cells = [f"{a:.2f} -> {b:.2f}" for a, b in zip(before, after, strict=True)]
    cells += [f"{c:.2f}" for c in by_traces]
    print(f"| {case} | {preset} | {graph.length / 1000:.1f} | {' | '.join(cells)} |", flush=True)


def lateral_errors(graph: RoadGraph, reference: RoadGraph) -> NDArray[np.float64]:
    """Distances (m) from places on a graph to the nearest true centreline that runs along it there."""
    lines, truth = edge_lines(graph), edge_lines(reference)
    places = stations_along(lines.length, _STEP)
    xyz, direction = lines.at(places.edge, places.along)
    points = shapely.points(xyz[:, :2])
    roads = reference.edges.geometry.to_numpy()
    place, road = shapely.STRtree(roads).query(points, predicate="dwithin", distance=_FAR)
    along = shapely.line_locate_point(shapely.force_2d(roads[road]), points[place])
    foot, other = truth.at(road.astype(np.int64), along)
    parallel = np.abs((direction[place] * other).sum(axis=1)) >= np.cos(np.radians(_ANGLE))
    away = pd.Series(np.hypot(*(xyz[place, :2] - foot[:, :2]).T)[parallel])
    return away.groupby(place[parallel]).min().to_numpy()


def figures(errors: NDArray[np.float64]) -> tuple[float, float, float]:
    """Mean, 95th percentile, and share within 1 m."""
    return float(errors.mean()), float(np.percentile(errors, 95)), float((errors <= 1.0).mean())


def chicago(folder: Path) -> None:
    """Refine the graph of the real traces and print its scores."""
    if not folder.is_dir():
        print(f"\n{folder} is not there")
        return
    fleet: Fleet = read_fleet(folder / "traces.csv.gz", columns={"trace_id": "trip"}, crs="EPSG:32616")
    graph = build(fleet, options=UNMOVED)
    start = process_time()
    matches = match(graph, fleet)
    middle = process_time()
    refined = refine_centreline(graph, fleet, matches)
    print(f"\nChicago: {len(fleet.traces):,} fixes, matching {middle - start:.1f} s, ", end="")
    print(f"refinement {process_time() - middle:.1f} s\n")
    print("| reference | graph | F at 5 m | 10 m | 15 m | 20 m | mean distance, m |\n|---|---|---|---|---|---|---|")
    for name in ("gt_traversed_tang", "gt_traversed_graph"):
        reference = read_graph(folder / f"{name}.geojson").to_crs(graph.crs)
        reference = replace(reference, edges=reference.edges.reset_index(drop=True))
        for label, candidate in (("built", graph), ("refined", refined)):
            scores = evaluate(candidate, reference, metrics=["buffer_geo"])["f1"]
            mean = lateral_errors(candidate, reference).mean()
            print(f"| {name} | {label} | {' | '.join(f'{f1:.3f}' for f1 in scores)} | {mean:.2f} |")


if __name__ == "__main__":
    main()
