"""Build road graphs from the real public traces with every method and score them as the literature does.

Usage: python experiments/baselines.py [--data ../shared/data] [--deepmg WEIGHTS] [--pictures docs/img]

Prints the Markdown tables of docs/results/baselines.md: the rows of all methods beside those of the published
programs, and the metrics of this project. Each build runs in a process of its own, from the raw file to the graph.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

from real_traces import BUFFER_GEO, CITIES, GRAPH_SAMPLING, MIN_TRIPS, triples

from probe2road import build, evaluate, read_fleet, read_graph
from probe2road.baselines.biagioni.recipe import BiagioniOptions, build_biagioni
from probe2road.baselines.deepmg.recipe import DeepMGOptions, build_deepmg
from probe2road.baselines.kde import build_kde
from probe2road.benchmark.tables.measured import measure
from probe2road.draw.picture import draw_graph
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.metrics.evaluate import MetricOptions
from probe2road.recipe import BuildOptions
from probe2road.segmentation.options import SegmentationOptions

PUBLISHED = "Biagioni 2012"
METRICS: list[str | MetricOptions] = ["geo", "itopo", "topo", "apls"]


def biagioni(fleet: Fleet) -> RoadGraph:
    """With the defaults: as published."""
    return build_biagioni(fleet)


def biagioni_last_runs(fleet: Fleet) -> RoadGraph:
    """With the last run of every trip."""
    return build_biagioni(fleet, options=BiagioniOptions(last_runs=True))


def biagioni_paper_sigma(fleet: Fleet) -> RoadGraph:
    """With the Gaussian that the paper states."""
    return build_biagioni(fleet, options=BiagioniOptions(sigma="paper"))


def kde(fleet: Fleet) -> RoadGraph:
    """With the defaults."""
    return build_kde(fleet)


def probe2road(fleet: Fleet) -> RoadGraph:
    """With the defaults: the network for traces alone."""
    return build(fleet)


def probe2road_density(fleet: Fleet) -> RoadGraph:
    """With the density segmenter."""
    return build(fleet, options=BuildOptions(segmentation=SegmentationOptions(segmenter="density")))


METHODS: dict[str, Callable[[Fleet], RoadGraph]] = {
    "Probe2Road": probe2road,
    "Probe2Road, density segmenter": probe2road_density,
    "Biagioni": biagioni,
    "Biagioni, last runs kept": biagioni_last_runs,
    "Biagioni, sigma of the paper": biagioni_paper_sigma,
    "KDE": kde,
}
DEEPMG = "DeepMG"
PICTURED = {"Biagioni": "biagioni", "KDE": "kde"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("PROBE2ROAD_DATA", str(Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--deepmg", type=Path, help="weights of DeepMG; it is left out without them")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each city and method")
    arguments = parser.parse_args()
    for city in CITIES:
        folder = arguments.data / "traces" / city
        if not folder.is_dir():
            sys.exit(f"{folder}: there is no such folder; pass --data")
        report(city, folder, arguments.pictures, arguments.deepmg)


def report(city: str, folder: Path, pictures: Path | None, weights: Path | None) -> None:
    """Build one city with all methods, print its tables, draw its pictures."""
    lines = read_graph(folder / "gt_traversed_tang.geojson")
    traversed = read_graph(folder / "gt_traversed_graph.geojson")
    driven = traversed.edges[traversed.edges["trips_near"].astype(float) >= MIN_TRIPS]
    fair = graph_from_lines(driven.geometry.to_numpy(), crs=traversed.crs, origin="reference")
    names = [*METHODS, *([DEEPMG] if weights else [])]
    builds = {name: measure(build_city, name, city, folder, weights) for name in names}

    print(f"\n## {city}\n\n| map | km | s | MB | 5 m | 10 m | 15 m | 20 m |\n|---|---|---|---|---|---|---|---|")
    for name, built in builds.items():
        scores = triples(evaluate(built.result, lines, metrics=["buffer_geo"]))
        figures = f"{built.result.length / 1000:.1f} | {built.seconds:.0f} | {built.megabytes:.0f}"
        print(f"| **{name}** | {figures} | {' | '.join(scores)} |")
    km, *published = BUFFER_GEO[city][PUBLISHED]
    print(f"| {PUBLISHED}, published program | {km or ''} | | | {' | '.join(f'{f1:.3f}' for f1 in published)} |")

    print("\n| graph sampling | 5 m | 10 m | 15 m |\n|---|---|---|---|")
    for name, built in builds.items():
        print(f"| **{name}** | {' | '.join(triples(evaluate(built.result, traversed, metrics=['graph_sampling'])))} |")
    if PUBLISHED in GRAPH_SAMPLING[city]:
        row = " | ".join(f"{f1:.3f}" for f1 in GRAPH_SAMPLING[city][PUBLISHED])
        print(f"| {PUBLISHED}, published program | {row} |")

    print("\n| F/P/R | GEO | iTOPO | TOPO | APLS |\n|---|---|---|---|---|")
    for name, built in builds.items():
        print(f"| **{name}** | {' | '.join(triples(evaluate(built.result, fair, metrics=METRICS)))} |", flush=True)
    if pictures:
        fleet = read_city(city, folder)
        for name, stem in PICTURED.items():
            draw_graph(builds[name].result, pictures / f"{stem}-{city}.png", fleet=fleet, reference=lines)


def build_city(name: str, city: str, folder: Path, weights: Path | None) -> RoadGraph:
    """Read the traces and build."""
    if name == DEEPMG:
        return build_deepmg(read_city(city, folder), options=DeepMGOptions(weights=str(weights)))
    return METHODS[name](read_city(city, folder))


def read_city(city: str, folder: Path) -> Fleet:
    """Read the traces of a city."""
    return read_fleet(folder / "traces.csv.gz", columns={"trace_id": "trip"}, crs=CITIES[city][0])


if __name__ == "__main__":
    main()
