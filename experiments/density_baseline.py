"""Build road graphs from the benchmark's data sets with the density segmenter and score them against the truth.

Usage: probe2road benchmark prepare boston hannover tokyo_shibuya columbus milan --output SETS
       python experiments/density_baseline.py SETS [--names boston,...] [--pictures docs/img]

Prints the Markdown tables of docs/results/density-baseline.md. Every set is built from raw and from modelled fleet
data, with the default options but without refinement, and scored against the roads that at least four drives
passed and against all. Columbus is scored in its test tiles only.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road import build, evaluate, read_fleet, read_graph
from probe2road.benchmark.sets.datasets import DATASETS
from probe2road.benchmark.sets.prepare import check_dataset, read_tiles
from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.benchmark.sets.tiles import split_area
from probe2road.crs import WGS84, transform
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_writer import points_path
from probe2road.metrics.normalise import clip_graph
from probe2road.recipe import BuildOptions
from probe2road.segmentation.options import SegmentationOptions

METRICS = ("geo", "itopo", "topo")
NAMES = {"geo": "GEO", "itopo": "iTOPO", "topo": "TOPO"}
MIN_DRIVES = 4
# Densest interchange of each extract: longitude, latitude.
PLACES = {
    "boston": (-71.0632, 42.3678),
    "hannover": (9.8867, 52.4272),
    "tokyo_shibuya": (139.6950, 35.6540),
    "columbus": (-82.9840, 39.9738),
    "milan": (9.2512, 45.4621),
    "rhein_neckar": (8.4427, 49.4873),
    "porto": (-8.6041, 41.1264),
}
HALF = 300.0  # m, half the side of a picture
SHOWN = 150  # drives in the first panel; more would cover each other
COLOURS = {"lane_marking": "limegreen", "road_boundary": "red"}


@dataclass(frozen=True)
class Built:
    """A graph and what it took."""

    name: str
    source: str  # "raw" or "modelled"
    graph: RoadGraph
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, help="folder of the prepared data sets")
    parser.add_argument("--names", default=",".join(PLACES), help="comma-separated")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each data set")
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    for name in options.names.split(","):
        check_dataset(options.sets / name)
        report(name, Recording(options.sets / name), options.pictures)


def report(name: str, recording: Recording, pictures: Path | None) -> None:
    """Build a set from raw and from modelled data, print its table, draw its picture."""
    reference = read_graph(recording.reference)
    driven = labelled_reference(reference, min_drives=MIN_DRIVES)
    area = split_area(read_tiles(recording.folder), "test") if DATASETS[name].splits else None
    place = f"{name}, test tiles" if area is not None else name
    counts = recording.run["counts"]
    print(f"\n### {place}\n\n{counts['drives']:,} drives, {counts['km']:,.0f} km. ", end="")
    print(
        f"Reference: {km(driven, area):.1f} km with {MIN_DRIVES} drives or more, {km(reference, area):.1f} km in all.\n"
    )
    columns = [f"{NAMES[metric]} F1/P/R" for metric in METRICS]
    print(f"| fleet data | built | s | against | {' | '.join(columns)} |\n|---|---|---|---|{'---|' * len(columns)}")
    for source, path in (("modelled", recording.modelled), ("raw", recording.drives)):
        fleet = read_fleet(path, points_path(path))
        made = timed_build(name, source, fleet)
        for against, truth in ((f"{MIN_DRIVES} drives", driven), ("all", reference)):
            scores = triples(evaluate(made.graph, truth, metrics=METRICS, area=area))
            print(
                f"| {source} | {km(made.graph, area):.1f} km | {made.seconds:.0f} | {against} | {' | '.join(scores)} |"
            )
        if pictures is not None and source == "modelled":
            draw_tiles(recording, reference, pictures)
            draw(name, fleet, reference, made.graph, pictures / f"benchmark-{name}.png")


def timed_build(name: str, source: str, fleet: Fleet) -> Built:
    """Build with the defaults, but without the stages that match traces to the graph."""
    started = time.perf_counter()
    graph = build(fleet, options=BuildOptions(segmentation=SegmentationOptions(segmenter="density"), refine=False))
    return Built(name, source, graph, time.perf_counter() - started)


def km(graph: RoadGraph, area: shapely.Geometry | None) -> float:
    """Length of a graph within an area."""
    return (graph if area is None else clip_graph(graph, area)).length / 1000.0


def triples(scores: pd.DataFrame) -> list[str]:
    """F1/precision/recall of every row."""
    return [f"{row.f1:.3f}/{row.precision:.3f}/{row.recall:.3f}" for row in scores.itertuples()]


def draw(name: str, fleet: Fleet, reference: RoadGraph, graph: RoadGraph, path: Path) -> None:
    """Draw the densest interchange: fleet data, the reference over the traces, the graph over the reference."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    (x,), (y,) = transform([PLACES[name][0]], [PLACES[name][1]], WGS84, fleet.crs)
    box = (x - HALF, y - HALF, x + HALF, y + HALF)
    figure, axes = plt.subplots(1, 3, figsize=(15, 5.2), layout="constrained")
    shown = inside(fleet.traces, box)
    shown = shown[shown["trace_id"].isin(shown["trace_id"].drop_duplicates().iloc[:SHOWN])]
    seen = inside(fleet.points[fleet.points["trace_id"].isin(shown["trace_id"])], box)
    for kind, colour in COLOURS.items():
        points = seen[seen["kind"] == kind]
        axes[0].plot(points["x"], points["y"], ",", color=colour)
    for axis, colour, width in ((axes[0], "blue", 0.3), (axes[1], "lightsteelblue", 0.3)):
        for line in driven_lines(shown if axis is axes[0] else inside(fleet.traces, box)):
            axis.plot(*line.T, color=colour, lw=width)
    for axis, lines, colour, width in (
        (axes[1], reference, "black", 1.0), (axes[2], reference, "0.75", 3.0), (axes[2], graph, "tab:orange", 1.2),
    ):  # fmt: skip
        for line in lines.edges.geometry[lines.edges.intersects(shapely.box(*box))]:
            axis.plot(*shapely.get_coordinates(line).T, color=colour, lw=width)
    degree = graph.degrees()
    nodes = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    for chosen, colour in ((degree >= 3, "black"), (degree == 1, "red")):
        axes[2].plot(*nodes[chosen.to_numpy()].T, ".", color=colour, ms=4)
    titles = (
        f"boundaries, markings, traces of {SHOWN} drives",
        "reference over traces",
        "density graph over reference",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xlim=box[0::2], ylim=box[1::2], xticks=[], yticks=[], aspect="equal", title=title)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    with Image.open(path) as image:  # few colours: a third of the size
        image.convert("RGB").quantize(96).save(path, optimize=True)


def draw_tiles(recording: Recording, reference: RoadGraph, pictures: Path) -> None:
    """Draw the tiles of a set that has them, coloured by split."""
    import matplotlib.pyplot as plt

    if not DATASETS[recording.folder.name].splits:
        return
    tiles = read_tiles(recording.folder)
    figure, axis = plt.subplots(figsize=(11, 5.6), layout="constrained")
    for split, colour in (("train", "#a5c8f0"), ("validation", "#f5b45a"), ("test", "#e0584f"), ("", "#eeeeee")):
        tiles[tiles["split"] == split].plot(ax=axis, color=colour, edgecolor="white")
    reference.edges.plot(ax=axis, lw=0.6, color="black")
    axis.set(xticks=[], yticks=[])
    figure.savefig(pictures / f"benchmark-{recording.folder.name}-tiles.png", dpi=80)
    plt.close(figure)


def inside(table: pd.DataFrame, box: tuple[float, float, float, float]) -> pd.DataFrame:
    """Rows within a box."""
    return table[table["x"].between(box[0], box[2]) & table["y"].between(box[1], box[3])]


def driven_lines(traces: pd.DataFrame) -> list[NDArray[np.float64]]:
    """Lines of the traces of a small area, one for each visit."""
    xy = traces[["x", "y"]].to_numpy()
    new = np.diff(traces["trace_id"].to_numpy(), prepend=-1) != 0
    new |= np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T) > 50.0
    return np.split(xy, np.flatnonzero(new)[1:])


if __name__ == "__main__":
    main()
