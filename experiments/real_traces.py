"""Build road graphs from the real public traces with the defaults and score them as the literature does.

Usage: python experiments/real_traces.py [--data ../shared/data] [--segmenter density] [--pictures docs/img]

Prints Markdown tables: our row beside the published ones (Tang et al. 2019, IJGI 8:411, and the programs they
compare), then the metrics of this project. Each build runs in a process of its own, from the raw file to the
GeoPackage, so that time and peak memory are those a user sees.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pandas as pd

from probe2road import evaluate, read_fleet, read_graph
from probe2road.draw.picture import draw_graph
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.metrics import GeoOptions

CITIES = {"chicago_shuttle": ("EPSG:32616", "trace_id=trip"), "athens_small": ("EPSG:2100", "trace_id=trip")}
JUNCTIONS = {"chicago_shuttle": 3, "athens_small": 0}  # pictures of the busiest
CLOSE = 120.0  # m, half the side of the picture of a junction
MIN_TRIPS = 4  # trips near an edge from which the reference counts as sufficiently driven

# F at 5, 10, 15 and 20 m against gt_traversed_tang, as published.
BUFFER_GEO: dict[str, dict[str, tuple[float | None, float, float, float, float]]] = {
    "chicago_shuttle": {
        "Tang 2019": (33.5, 0.589, 0.771, 0.883, 0.925),
        "CellNet 2018": (36.3, 0.488, 0.702, 0.816, 0.881),
        "Biagioni 2012": (24.0, 0.524, 0.727, 0.776, 0.801),
        "Kharita (offline)": (32.9, 0.478, 0.718, 0.839, 0.897),
        "Kharita* (online)": (86.2, 0.513, 0.766, 0.890, 0.931),
        "Edelkamp 2003": (84.7, 0.508, 0.726, 0.844, 0.886),
        "Karagiorgou 2012": (37.1, 0.619, 0.752, 0.793, 0.815),
        "Ahmed 2012": (27.6, 0.321, 0.556, 0.669, 0.734),
        "TrajMap 2017": (25.8, 0.347, 0.582, 0.719, 0.815),
    },
    "athens_small": {
        "Ahmed 2012": (None, 0.288, 0.530, 0.682, 0.773),
        "Biagioni 2012": (None, 0.271, 0.470, 0.580, 0.651),
        "Davies 2006": (None, 0.067, 0.102, 0.114, 0.118),
        "Karagiorgou 2012": (None, 0.310, 0.507, 0.635, 0.723),
        "Tang 2019": (None, 0.311, 0.527, 0.665, 0.747),
    },
}
# F at 5, 10 and 15 m against gt_traversed_graph, as published.
GRAPH_SAMPLING: dict[str, dict[str, tuple[float, float, float]]] = {
    "chicago_shuttle": {
        "Biagioni 2012": (0.501, 0.610, 0.641),
        "Tang 2019": (0.467, 0.649, 0.727),
        "CellNet": (0.382, 0.567, 0.661),
        "Kharita (offline)": (0.409, 0.581, 0.677),
        "Kharita*": (0.341, 0.495, 0.562),
        "Edelkamp 2003": (0.443, 0.526, 0.578),
    },
    "athens_small": {},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("PROBE2ROAD_DATA", str(Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--segmenter", default="network", choices=("network", "density"))
    parser.add_argument("--weights", type=Path, help="of the network; the shipped ones without it")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each city")
    arguments = parser.parse_args()
    for city in CITIES:
        folder = arguments.data / "traces" / city
        if not folder.is_dir():
            sys.exit(f"{folder}: there is no such folder; pass --data")
        report(city, folder, arguments)


def report(city: str, folder: Path, arguments: argparse.Namespace) -> None:
    """Build one city and print its tables."""
    ours_is, pictures = f"probe2road, {arguments.segmenter}", arguments.pictures
    graph, seconds, megabytes = timed_build(city, folder, arguments)
    lines = read_graph(folder / "gt_traversed_tang.geojson")
    traversed = read_graph(folder / "gt_traversed_graph.geojson")
    print(f"\n## {city}\n\n{graph.length / 1000:.1f} km, {len(graph.edges)} edges; {seconds:.1f} s and ", end="")
    print(f"{megabytes:.0f} MB from the raw file to the GeoPackage\n")

    ours = evaluate(graph, lines, metrics=["buffer_geo"])
    print("| map | km | 5 m | 10 m | 15 m | 20 m |\n|---|---|---|---|---|---|")
    print(f"| **{ours_is}** | {graph.length / 1000:.1f} | {' | '.join(triples(ours))} |")
    for name, (km, *scores) in BUFFER_GEO[city].items():
        print(f"| {name} | {'' if km is None else km} | {' | '.join(f'{score:.3f}' for score in scores)} |")

    ours = evaluate(graph, traversed, metrics=["graph_sampling"])
    print("\n| graph sampling | 5 m | 10 m | 15 m |\n|---|---|---|---|")
    print(f"| **{ours_is}** | {' | '.join(triples(ours))} |")
    for name, published in GRAPH_SAMPLING[city].items():
        print(f"| {name} | {' | '.join(f'{score:.3f}' for score in published)} |")

    references = {"gt_traversed_tang": lines, "gt_traversed_graph": traversed}
    if "trips_near" in traversed.edges:
        driven = traversed.edges[traversed.edges["trips_near"].astype(float) >= MIN_TRIPS]
        references[f"gt_traversed_graph, at least {MIN_TRIPS} trips"] = graph_from_lines(
            driven.geometry.to_numpy(), crs=traversed.crs, origin="reference"
        )
    own_metrics(graph, references)
    if pictures:
        fleet = read_fleet(folder / "traces.csv.gz", columns={"trace_id": "trip"}, crs=CITIES[city][0])
        draw_graph(graph, pictures / f"real-{city}.png", fleet=fleet, reference=lines)
        for number, (x, y) in enumerate(busiest_junctions(graph)[: JUNCTIONS[city]], start=1):
            area = (x - CLOSE, y - CLOSE, x + CLOSE, y + CLOSE)
            path = pictures / f"real-{city}-junction-{number}.png"
            draw_graph(graph, path, fleet=fleet, reference=lines, bounds=area, width=5)


def busiest_junctions(graph: RoadGraph) -> list[tuple[float, float]]:
    """Return the places of the junctions with the most turns, none within a picture of another."""
    driven = graph.turns.groupby("via_node")["count"].sum()
    degrees = graph.degrees()
    junctions = driven[degrees[driven.index] >= 3].sort_values(ascending=False, kind="stable")
    found: list[tuple[float, float]] = []
    for point in graph.nodes.geometry[junctions.index]:
        if all(max(abs(point.x - x), abs(point.y - y)) > 2 * CLOSE for x, y in found):
            found.append((point.x, point.y))
    return found


def own_metrics(graph: RoadGraph, references: dict[str, RoadGraph]) -> None:
    """Print the metrics of this project against several references."""
    metrics: list[Any] = ["geo", GeoOptions(radius=15.0), "topo", "itopo", "apls", "buffer_geo", "graph_sampling"]
    tables = {name: evaluate(graph, reference, metrics=metrics) for name, reference in references.items()}
    print(f"\n| metric, F/P/R | {' | '.join(tables)} |\n|---|{'---|' * len(tables)}")
    first = next(iter(tables.values()))
    for row, (metric, parameters) in enumerate(zip(first["metric"], first["parameters"], strict=True)):
        print(f"| {metric} `{parameters}` | {' | '.join(triples(table)[row] for table in tables.values())} |")


def triples(scores: pd.DataFrame) -> list[str]:
    """F/P/R of every row."""
    return [f"{row.f1:.3f}/{row.precision:.3f}/{row.recall:.3f}" for row in scores.itertuples()]


def timed_build(city: str, folder: Path, arguments: argparse.Namespace) -> tuple[RoadGraph, float, float]:
    """Run the command line on the raw file: the graph, seconds, and peak megabytes."""
    crs, columns = CITIES[city]
    with tempfile.TemporaryDirectory() as temporary:
        output = Path(temporary) / "roads.gpkg"
        words = ["-q", "build", folder / "traces.csv.gz", "--columns", columns, "--crs", crs, "--output", output]
        words += ["--segmenter", arguments.segmenter]
        words += ["--weights", arguments.weights] if arguments.weights is not None else []
        started = time.perf_counter()
        subprocess.run([Path(sys.executable).with_name("probe2road"), *map(str, words)], check=True)
        seconds = time.perf_counter() - started
        return read_graph(output), seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


if __name__ == "__main__":
    main()
