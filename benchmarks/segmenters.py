"""The learned segmenter against the density segmenter on the benchmark: the mask, and the graph of the whole recipe.

Usage: probe2road benchmark prepare columbus milan boston hannover tokyo_shibuya --output SETS
       python benchmarks/segmenters.py SETS [--names boston,...] [--segmenters density,gnss,gnss-vision]
           [--weights FOLDER] [--workspaces FOLDER] [--data aligned]

Prints the Markdown tables of docs/results/segmentation.md. All options have their defaults. Graphs are scored against
the roads that at least four drives passed. Soft F1 is pooled over the pixels of the area: of the mask as it is, against
lines of 3 pixels, and of the thinned mask against lines of 1 pixel. Columbus is scored split by split.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.features import geometry_mask
from rasterio.transform import from_origin

from probe2road import build, evaluate, read_fleet, read_graph
from probe2road.benchmark.datasets import DATASETS
from probe2road.benchmark.prepare import check_dataset, read_tiles
from probe2road.benchmark.recording import Recording
from probe2road.benchmark.reference import labelled_reference
from probe2road.benchmark.tiles import SPLITS, split_area
from probe2road.fleet import Fleet
from probe2road.fleet_tables import empty_points
from probe2road.grid import Grid, read_raster
from probe2road.io.fleet_writer import points_path
from probe2road.labels import label_mask
from probe2road.metrics.soft_f1 import soft_f1
from probe2road.recipe import BuildOptions
from probe2road.roadgraph import RoadGraph
from probe2road.segmentation.network import NetworkOptions

NAMES = "columbus,milan,boston,hannover,tokyo_shibuya"
METRICS = ("geo", "itopo", "topo", "apls")


@dataclass(frozen=True)
class Built:
    """What a segmenter made."""

    graph: RoadGraph
    mask: NDArray[np.uint8]  # (rows, cols)
    skeleton: NDArray[np.uint8]  # (rows, cols)
    grid: Grid
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, help="folder of the prepared data sets")
    parser.add_argument("--names", default=NAMES, help="comma-separated")
    parser.add_argument("--segmenters", default="density,gnss,gnss-vision", help="density, or names of weights")
    parser.add_argument("--weights", type=Path, help="folder of weights files; the shipped ones without it")
    parser.add_argument("--workspaces", type=Path, help="folder that keeps the stages; nothing is kept without it")
    parser.add_argument("--data", default="aligned", choices=("aligned", "raw"))
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    for name in options.names.split(","):
        check_dataset(options.sets / name)
        report(name, options)


def report(name: str, options: argparse.Namespace) -> None:
    """Build a set with every segmenter and print its table."""
    recording = Recording(options.sets / name)
    reference = labelled_reference(read_graph(recording.reference))
    path = recording.aligned if options.data == "aligned" else recording.drives
    fleet = read_fleet(path, points_path(path))
    areas: dict[str, shapely.Geometry | None] = {name: None}
    if DATASETS[name].splits:
        tiles = read_tiles(recording.folder)
        areas = {f"{name}, {split}": split_area(tiles, split) for split in SPLITS}
    print(f"\n### {name}, {options.data}\n")
    print(
        "| area | segmenter | soft F1/P/R, as it is | thinned | GEO F1/P/R | iTOPO F1/P/R | TOPO F1 | APLS | km | s |"
    )
    print(f"|{'---|' * 10}")
    for segmenter in options.segmenters.split(","):
        with tempfile.TemporaryDirectory() as scratch:
            kept = Path(scratch) if options.workspaces is None else options.workspaces
            made = run(segmenter, fleet, options.weights, kept / f"{name}-{options.data}-{segmenter}")
        for place, area in areas.items():
            print(f"| {place} | {segmenter} | {line(made, reference, area)} |", flush=True)


def run(segmenter: str, fleet: Fleet, weights: Path | None, workspace: Path) -> Built:
    """Build with a segmenter; one for traces alone does not get to see the points."""
    options = BuildOptions(segmenter="density")
    if segmenter != "density":
        file = None if weights is None else str(weights / f"{segmenter}.onnx")
        options = BuildOptions(segmenter="network", network=NetworkOptions(weights=file))
    if segmenter == "gnss":
        fleet = replace(fleet, points=empty_points(fleet.traces["trace_id"]))
    workspace.parent.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    graph = build(fleet, options, workspace=workspace)
    seconds = time.perf_counter() - started
    mask, grid = read_raster(workspace / "2-mask.tif")
    skeleton, _ = read_raster(workspace / "3-skeleton.tif")
    return Built(graph, mask[0], skeleton[0], grid, seconds)


def line(made: Built, reference: RoadGraph, area: shapely.Geometry | None) -> str:
    """Score mask and graph within an area."""
    cells = []
    for proposal, width in ((made.mask, 3), (made.skeleton, 1)):
        label = label_mask(reference, made.grid, width=width)
        proposals, references = [], []
        for window in made.grid.windows(1024):
            grid = window.grid(made.grid)
            if area is not None and not area.intersects(shapely.box(*grid.bounds)):
                continue
            inside = within(grid, area)
            proposals.append((proposal[window.core] != 0) & inside)
            references.append((label[window.core] != 0) & inside)
        score = soft_f1(proposals, references)
        cells.append(f"{score.f1:.3f}/{score.precision:.3f}/{score.recall:.3f}")
    plain = replace(made.graph, turns=made.graph.turns.iloc[:0])
    scores = {row.metric: row for row in evaluate(plain, reference, metrics=METRICS, area=area).itertuples()}
    for metric in ("geo", "itopo"):
        row = scores[metric]
        cells.append(f"{row.f1:.3f}/{row.precision:.3f}/{row.recall:.3f}")
    cells += [f"{scores['topo'].f1:.3f}", f"{scores['apls'].f1:.3f}"]
    return " | ".join([*cells, f"{made.graph.length / 1000:.0f}", f"{made.seconds:.0f}"])


def within(grid: Grid, area: shapely.Geometry | None) -> NDArray[np.bool_]:
    """Mark the pixels of a grid whose centre lies in an area."""
    if area is None:
        return np.ones(grid.shape, bool)
    transform = from_origin(grid.left, grid.top, grid.resolution, grid.resolution)
    return geometry_mask([area], grid.shape, transform, invert=True)


if __name__ == "__main__":
    main()
