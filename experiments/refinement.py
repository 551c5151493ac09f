"""What each step of the refinement gives on the benchmark's test cities: the rows of the paper's Table V, and ours.

Usage: python experiments/refinement.py FOLDER [NAMES...] [--segmenter network] [--work WORK] [--pictures docs/img]

FOLDER holds the data sets that `probe2road benchmark prepare` and `align` made. Graphs are built from the aligned fleet
data, or are those that `probe2road benchmark run --work WORK` kept from before the refinement. Scores are against the
reference kept where at least four drives pass. `--poses modelled` takes the modelled data. Prints Markdown.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

from probe2road.benchmark.sets.recording import POSES, Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.crs import WGS84, transform
from probe2road.draw.picture import draw_graph
from probe2road.fleet.contract import Fleet
from probe2road.graph.clean import clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import points_path
from probe2road.io.graph_files import read_graph
from probe2road.matching.match import match
from probe2road.metrics import evaluate
from probe2road.recipe import BuildOptions, build
from probe2road.refinement.centreline import refine_centreline
from probe2road.refinement.evidence import add_evidence
from probe2road.refinement.faint import drop_faint
from probe2road.refinement.gaps.driven import add_driven_roads
from probe2road.refinement.gaps.fill import fill_gaps, gap_weights, prune_gaps
from probe2road.refinement.junctions.braids import open_braids
from probe2road.refinement.junctions.forks import move_forks
from probe2road.refinement.junctions.passages import passing_positions
from probe2road.refinement.junctions.split import DisambiguateOptions, split_false_junctions
from probe2road.refinement.undriven import RungOptions, drop_undriven
from probe2road.segmentation.options import SegmentationOptions

CITIES = ("boston", "hannover", "tokyo_shibuya")
# Latitude and longitude of the densest interchanges.
PLACES = {"boston": [(42.3678, -71.0632), (42.3686, -71.0259)], "hannover": [(52.4272, 9.8867)]}
REACH = 450.0  # m, half the side of a picture


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    step: str
    graph: RoadGraph
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=CITIES)
    parser.add_argument("--segmenter", default="density", choices=("density", "network"))
    parser.add_argument("--poses", default="aligned", choices=POSES)
    parser.add_argument("--work", type=Path, help="folder that benchmark run kept its work in")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the densest interchanges")
    arguments = parser.parse_args()
    for name in arguments.names:
        folder = arguments.folder / name
        path = Recording(folder).traces(arguments.poses)
        fleet = read_fleet(path, points_path(path))
        reference = labelled_reference(read_graph(folder / "reference.gpkg"))
        print(f"\n## {name}\n\n| step | GEO F1/P/R | iTOPO F1/P/R | TOPO F1 | nodes | km | s |\n|{'---|' * 7}")
        done = rows(fleet, arguments.segmenter, kept(arguments.work, f"{name}-{arguments.poses}", arguments.segmenter))
        for row in done:
            print(line(row, reference), flush=True)
        for number, place in enumerate(PLACES.get(name, ())) if arguments.pictures else ():
            area = around(place, fleet)
            for when, row in (("before", done[0]), ("after", done[-1])):
                path = arguments.pictures / f"refinement-{name}-{number + 1}-{when}.png"
                draw_graph(row.graph, path, fleet=fleet, reference=reference, bounds=area, width=6)


def around(place: tuple[float, float], fleet: Fleet) -> tuple[float, float, float, float]:
    """Return the bounds of a picture of a place."""
    x, y = transform([place[1]], [place[0]], WGS84, fleet.crs)
    return x[0] - REACH, y[0] - REACH, x[0] + REACH, y[0] + REACH


def kept(work: Path | None, name: str, segmenter: str) -> RoadGraph | None:
    """Return the graph that a run of the benchmark had before the refinement."""
    method = {"network": "probe2road", "density": "density"}[segmenter]
    return read_graph(work / name / method / "stages" / "5-cleaned.gpkg") if work else None


def rows(fleet: Fleet, segmenter: str, built: RoadGraph | None) -> list[Row]:
    """Refine step by step, what was built or what is built now."""
    done, started = [], time.perf_counter()

    def note(step: str, graph: RoadGraph) -> None:
        nonlocal started
        done.append(Row(step, graph, time.perf_counter() - started))
        started = time.perf_counter()

    if built is None:
        built = build(fleet, options=BuildOptions(segmentation=SegmentationOptions(segmenter=segmenter), refine=False))
    note("no post-processing", built)
    filled = fill_gaps(built)
    matches = match(filled, fleet, edge_weights=gap_weights(filled))
    graph = clean_graph(prune_gaps(filled, matches.steps))
    note("gap filling", graph)
    graph = add_driven_roads(graph, fleet)
    note("driven roads added", graph)
    matches = match(graph, fleet)
    for variant in ("literal", "guarded"):
        options = DisambiguateOptions(variant=variant)
        note(f"disambiguation, {variant}", split_false_junctions(graph, matches.steps, options=options))
    positions = passing_positions(graph, fleet, matches)
    split = split_false_junctions(graph, matches.steps, positions=positions)
    note("guarded, with heights", split)
    graph, matches = split, match(split, fleet)
    if segmenter == "network":
        graph = clean_graph(drop_undriven(graph, matches.steps, rungs=RungOptions()))
        matches = match(graph, fleet)
        note("undriven edges dropped", graph)
    graph = split_false_junctions(graph, matches.steps, positions=passing_positions(graph, fleet, matches))
    matches = match(graph, fleet)
    if segmenter == "network":
        graph = clean_graph(drop_undriven(graph, matches.steps, rungs=RungOptions()))
        matches = match(graph, fleet)
    note("split and dropped again", graph)
    graph = open_braids(graph, matches.steps)
    matches = match(graph, fleet)
    note("braids opened", graph)
    graph = move_forks(graph, fleet, matches)
    note("forks moved", graph)
    if segmenter == "network":
        note("faint edges dropped", clean_graph(drop_faint(graph, fleet, match(graph, fleet))))
    if segmenter == "density":
        matches = match(graph, fleet)
        note("centrelines moved", refine_centreline(add_evidence(graph, fleet, matches), fleet, matches))
    return done


def line(row: Row, reference: RoadGraph) -> str:
    """Score a graph."""
    plain = replace(row.graph, turns=row.graph.turns.iloc[:0])
    scores = evaluate(plain, reference, metrics=["geo", "itopo", "topo"]).itertuples()
    geo, itopo = (f"{score.f1:.4f}/{score.precision:.3f}/{score.recall:.3f}" for score in (next(scores), next(scores)))
    topo = f"{next(scores).f1:.4f}"
    size = f"{len(row.graph.nodes)} | {row.graph.length / 1000:.1f} | {row.seconds:.0f}"
    return f"| {row.step} | {geo} | {itopo} | {topo} | {size} |"


if __name__ == "__main__":
    main()
