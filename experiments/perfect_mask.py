"""What cleaning and refinement make of a perfect mask: GEO, iTOPO and junction scores after each of the two.

Usage: python experiments/perfect_mask.py FOLDER [NAMES...] [--resolution 1] [--width 3] [--short-edge 15] [--keep WORK]

FOLDER holds the data sets that `probe2road benchmark prepare` made. The roads of the reference that at least four
drives passed are drawn as lines of some pixels into the grid of the fleet, then thinned, traced, cleaned, and refined
with the modelled drives as if a network had drawn them. What is lost is what these steps do to a right mask. Prints
Markdown. WORK is filled with the graphs, NAME-vectorized, NAME-cleaned and NAME-refined, for other ways to go on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.fleet.contract import Fleet
from probe2road.graph.clean import CleanOptions, clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.metrics.evaluate import evaluate
from probe2road.raster.counts import fleet_grid
from probe2road.raster.drawing import label_mask
from probe2road.refinement.recipe import refine
from probe2road.vectorize.lines import vectorize
from probe2road.vectorize.skeleton import skeletonize_windows

CITIES = ("milan", "columbus", "boston")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=CITIES)
    parser.add_argument("--resolution", type=float, default=1.0, help="metres per pixel")
    parser.add_argument("--width", type=int, default=3, help="pixels of a line")
    parser.add_argument("--short-edge", type=float, default=CleanOptions().short_edge, help="metres")
    parser.add_argument("--keep", type=Path, help="folder for the graphs")
    arguments = parser.parse_args()
    clean = CleanOptions(short_edge=arguments.short_edge)
    print(f"| city | graph | GEO F1/P/R | iTOPO F1/P/R | junctions F1/P/R | nodes | km |\n|{'---|' * 7}")
    for name in arguments.names:
        folder = arguments.folder / name
        fleet = read_fleet(Recording(folder).traces("modelled"))
        reference = labelled_reference(read_graph(folder / "reference.gpkg"))
        graphs = {"vectorized": drawn(reference, fleet, arguments.resolution, arguments.width)}
        graphs["cleaned"] = clean_graph(graphs["vectorized"], options=clean)
        graphs["refined"] = refine(graphs["cleaned"], fleet, learned=True, clean=clean)
        for stage, graph in graphs.items():
            print(f"| {name} | {stage} | {scored(graph, reference)} |", flush=True)
            if arguments.keep:
                arguments.keep.mkdir(parents=True, exist_ok=True)
                write_graph(graph, arguments.keep / f"{name}-{stage}.gpkg")


def drawn(reference: RoadGraph, fleet: Fleet, resolution: float, width: int) -> RoadGraph:
    """Return the graph of a mask on which the reference is drawn."""
    grid = fleet_grid(fleet, resolution=resolution)
    mask = label_mask(reference, grid, width=width).astype(bool)
    return vectorize(skeletonize_windows(mask), grid)


def scored(graph: RoadGraph, reference: RoadGraph) -> str:
    """Return the cells of a line of the table."""
    scores = evaluate(graph, reference, metrics=["geo", "itopo", "junctions"]).itertuples()
    cells = [f"{score.f1:.4f}/{score.precision:.3f}/{score.recall:.3f}" for score in scores]
    return " | ".join([*cells, str(len(graph.nodes)), f"{graph.length / 1000:.1f}"])


if __name__ == "__main__":
    main()
