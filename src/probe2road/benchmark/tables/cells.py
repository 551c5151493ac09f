"""The result of one method on one data set: built in a separate process, scored by area, and stored in files.

Strategy: all is kept under the folder of the work, in `DATASET-POSES/METHOD/`: the workspace of the build, the graph,
what it took, and its scores. Each file names the key that made it: method, options, weights, data set, poses, version.
A file with another key is made anew, so that a run which was interrupted, or in which one thing changed, does again
only what it must.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import shapely

from probe2road import __version__
from probe2road.benchmark.sets.datasets import find_dataset
from probe2road.benchmark.tables.counts import geo_counts, itopo_counts, soft_counts
from probe2road.benchmark.tables.intervals import COUNTS
from probe2road.benchmark.tables.measured import measure
from probe2road.benchmark.tables.methods import Method
from probe2road.benchmark.tables.source import Source, make_fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import points_path
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.metrics.evaluate import evaluate
from probe2road.metrics.normalise import comparable_networks
from probe2road.raster.grid import read_raster
from probe2road.run.stages import MASK, SKELETON
from probe2road.run.workspace import copy_segmentation

__all__ = ["FULL", "STAGES", "Cell", "build_cell", "read_built", "score_cells", "score_graph", "write_cells"]

logger = logging.getLogger(__name__)

FULL = "full"  # stage of the finished graph
STAGES = "stages"  # workspace of a build, in its folder

_GRAPH, _RECORD = "graph.gpkg", "build.json"
_METRICS = ("geo", "itopo", "topo", "apls", "junctions", "lateral")
_LABEL_WIDTH = 3  # px, of the lines that the network learned


@dataclass(frozen=True)
class Cell:
    """The scores of one graph in one area."""

    area: str
    method: str
    stage: str
    poses: str
    tiles: Mapping[str, pd.DataFrame]  # of geo, itopo, and of soft_f1 and soft_f1_thinned where there is a mask
    figures: Mapping[str, float | None]  # all else: scores without intervals, size, cost; None is not defined
    key: Mapping[str, Any]  # what made it

    def as_row(self) -> dict[str, Any]:
        """Return the cell as a row of a table, with the configuration that made it."""
        names = {"area": self.area, "method": self.method, "stage": self.stage, "poses": self.poses}
        return {**names, **self.figures, "config": json.dumps(dict(self.key))}


def build_cell(source: Source, method: Method, *, like: Method | None = None) -> Path:
    """Build the graph of a method, unless it exists; return its folder.

    Parameters
    ----------
    source
        The fleet.
    method
        What is built.
    like
        Method that differs behind the segmentation alone. It is built first, and its probability is taken.
    """
    folder = source.place / method.name
    _ = source.digest  # says what is missing
    make_fleet(source)
    key = _key(source, method)
    if (kept := _read(folder / _RECORD)) is not None and kept["key"] == key:
        return folder
    if kept is not None:
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if like is not None:
        copy_segmentation(build_cell(source, like) / STAGES, folder / STAGES)
    resumed = (folder / STAGES).exists()  # then the seconds are not those of a whole build
    logger.info("building %s with %s", source.place.name, method.label)
    made = measure(_build, method, source.fleet_file, folder)
    record = {"key": key, "seconds": made.result, "megabytes": made.megabytes, "resumed": resumed}
    _write(folder / _RECORD, record)
    return folder


def read_built(source: Source, method: Method) -> RoadGraph:
    """Return the graph that `build_cell` has made."""
    return read_graph(build_cell(source, method) / _GRAPH)


def score_cells(source: Source, method: Method) -> list[Cell]:
    """Score the results of `build_cell`: every stage in every area."""
    folder = build_cell(source, method)
    built = _read(folder / _RECORD) or {}
    key = {**built["key"], "min_drives": source.min_drives}
    cells = []
    for stage in (*method.stages, FULL):
        for area in source.areas:
            name = f"scores-{stage}-{area}-{source.min_drives}.json"
            path = folder / name.replace(" ", "_").replace(",", "")
            kept = _read(path)
            if kept is None or kept["key"] != key:
                logger.info("scoring %s, %s, in %s", method.label, stage, area)
                kept = {"key": key, **_score(source, method, folder, stage, area)}
                if stage == FULL:
                    kept["figures"] |= {name: built[name] for name in ("seconds", "megabytes", "resumed")}
                _write(path, kept)
            tiles = {name: _table(rows) for name, rows in kept["tiles"].items()}
            cells.append(Cell(area, method.name, stage, source.poses, tiles, kept["figures"], kept["key"]))
    return cells


def score_graph(
    graph: RoadGraph, reference: RoadGraph, *, area: shapely.Geometry | None = None
) -> tuple[dict[str, pd.DataFrame], dict[str, float | None]]:
    """Score a graph with all metrics of the tables.

    Returns
    -------
    tiles
        Counts of GEO and iTOPO, tile by tile; see `probe2road.benchmark.tables.counts`.
    figures
        Precision, recall and F1 of every metric, ``median_m`` and ``p95_m`` of the lateral error, nodes, kilometres.
    """
    graph = replace(graph, turns=graph.turns.iloc[:0])
    networks = comparable_networks(graph, reference, area=area)
    tiles = {"geo": geo_counts(*networks), "itopo": itopo_counts(*networks)}
    figures: dict[str, float | None] = {}
    for row in evaluate(graph, reference, metrics=_METRICS, area=area).itertuples():
        figures |= {f"{row.metric}_{what}": getattr(row, what) for what in ("precision", "recall", "f1")}
        details = json.loads(row.details)
        if row.metric == "itopo":
            figures |= {"nodes": details["proposal_nodes"], "km": details["proposal_km"]}
        if row.metric == "lateral":
            figures |= {name: details[name] for name in ("median_m", "p95_m")}
    return tiles, figures


def write_cells(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write rows of `Cell.as_row` as CSV; missing values stay empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def _key(source: Source, method: Method) -> dict[str, Any]:
    """Return all that determines the result of a build, as JSON."""
    key = {
        "method": method.name,
        "options": asdict(method.options),
        "weights": hashlib.sha256(method.weights.read_bytes()).hexdigest()[:16] if method.weights else None,
        "points": method.points,
        "dataset": source.name,
        "digest": source.digest,
        "aligned": source.aligned_digest,
        "seed": find_dataset(source.name).seed,
        "poses": source.poses,
        "drives": source.drives,
        "version": __version__,
    }
    return dict(json.loads(json.dumps(key)))


def _build(method: Method, path: Path, folder: Path) -> float:
    """Read the fleet, build the graph and write it; return the seconds of the build."""
    fleet = read_fleet(path, points_path(path) if method.points else None)
    started = time.perf_counter()
    graph = method.builder(fleet, options=method.options, workspace=folder / STAGES)
    seconds = time.perf_counter() - started
    write_graph(graph, folder / _GRAPH)
    return seconds


def _score(source: Source, method: Method, folder: Path, stage: str, area: str) -> dict[str, Any]:
    """Score one graph, and its mask, in one area; return the content of a file."""
    path = folder / _GRAPH if stage == FULL else folder / STAGES / method.stages[stage].file()
    extent = source.areas[area]
    tiles, figures = score_graph(read_graph(path), source.reference, area=extent)
    if method.mask and stage == FULL:
        for name, raster, width in (("soft_f1", MASK, _LABEL_WIDTH), ("soft_f1_thinned", SKELETON, 1)):
            mask, grid = read_raster(folder / STAGES / raster.file())
            tiles[name] = soft_counts(mask[0], grid, source.reference, width=width, area=extent)
    return {"tiles": {name: _rows(table) for name, table in tiles.items()}, "figures": figures}


def _rows(table: pd.DataFrame) -> list[list[Any]]:
    """Return a table of counts in a form for JSON."""
    return [[tile, *map(int, counts)] for tile, *counts in table[COUNTS].itertuples()]


def _table(rows: list[list[Any]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["tile", *COUNTS]).set_index("tile")


def _read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _write(path: Path, record: Mapping[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record), encoding="utf-8")
