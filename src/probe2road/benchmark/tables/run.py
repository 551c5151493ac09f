"""The run of all tables: build, score, and write the paper's tables for open data."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from probe2road.benchmark.sets.datasets import find_dataset
from probe2road.benchmark.tables.cells import Cell, read_built, score_cells, write_cells
from probe2road.benchmark.tables.intervals import DRAWS
from probe2road.benchmark.tables.methods import Method, find_methods
from probe2road.benchmark.tables.pictures import busiest_places, draw_place
from probe2road.benchmark.tables.source import Source
from probe2road.benchmark.tables.tables import (
    cost_table,
    difference_table,
    methods_table,
    soft_table,
    stages_table,
    vision_table,
)
from probe2road.io.atomic import atomic_path, make_folder
from probe2road.io.fleet_reader import read_fleet
from probe2road.run.progress import Progress, silent

__all__ = ["CITIES", "run_benchmark"]

logger = logging.getLogger(__name__)

CITIES = ("columbus", "boston", "hannover", "tokyo_shibuya")  # training and test by tile; then test only

_TABLES = "index.md"
_PLACES = 2  # pictures of each test city


def run_benchmark(
    sets: str | Path,
    output: str | Path,
    *,
    names: Sequence[str] = CITIES,
    methods: Sequence[str] = (),
    work: str | Path | None = None,
    poses: str = "aligned",
    deepmg: str | Path | None = None,
    progress: Progress | None = None,
) -> list[Cell]:
    """Build and score every method on every data set, and write the tables of the paper.

    Parameters
    ----------
    sets
        Folder of the data sets that `probe2road.benchmark.sets.prepare.prepare` made.
    output
        Folder for ``index.md`` (all tables), ``cells.csv`` (every cell with its configuration and seed) and pictures of
        the busiest places; created where it does not exist.
    names
        Data sets.
    methods
        Out of `probe2road.benchmark.tables.methods.METHODS`; all that can run where there is none.
    work
        Folder that keeps graphs and scores, from which an interrupted run goes on; ``work`` in the output without it.
    poses
        ``aligned`` (by `probe2road.alignment.align.align`, which runs first where it has to), ``modelled`` (what an
        alignment would leave), or ``raw``.
    deepmg
        File of DeepMG's weights; without it the method is left out.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    list of Cell
        All scores.

    Raises
    ------
    OptionError
        If there is no such data set, method or poses.
    InputError
        If a data set is not prepared or not as it was made.
    OutputError
        If the folder cannot be created.

    Notes
    -----
    Paper, section IV. A build runs in a process of its own; its seconds are those of the build alone, on as many cores
    as numba takes, its memory is the peak of that process, in which the fleet is read, too.
    """
    output, report = Path(output), progress or silent
    work = Path(work) if work is not None else output / "work"
    chosen = find_methods(methods, deepmg=deepmg)
    sources = [Source(Path(sets) / find_dataset(name).name, work, poses) for name in names]
    for source in sources:
        _ = source.digest  # says what is missing before hours of work
    make_folder(output)

    cells: list[Cell] = []
    for number, source in enumerate(sources):
        for turn, method in enumerate(chosen):
            report("benchmark", number * len(chosen) + turn, len(sources) * len(chosen))
            cells += score_cells(source, method)
            _write_tables(cells, output, poses)  # what is done can be read while the rest runs
        _draw_places(source, chosen, output)
    report("benchmark", 1, 1)
    logger.info("%d cells in %s", len(cells), output)
    return cells


def _write_tables(cells: Sequence[Cell], output: Path, poses: str) -> None:
    """Write all tables, and the cells from which they are made."""
    areas = list(dict.fromkeys(cell.area for cell in cells))
    us = [area for area in areas if area.startswith(("columbus", "boston"))]
    others = [area for area in areas if area not in us]
    tests = [area for area in areas if not area.startswith("columbus")]
    parts = {
        "Table I: graphs, United States": methods_table(cells, us),
        "Table II: graphs, elsewhere": methods_table(cells, others),
        "Table III: soft F1 of the segmentation": soft_table(cells),
        "Table IV: with and without the camera": "\n".join(vision_table(cells, area) for area in tests),
        "Table V: post-processing": stages_table(cells, tests),
        "Differences": difference_table(cells, areas),
        "Further metrics, size and cost": cost_table(cells),
    }
    head = (
        "# The paper's tables on open data\n\n"
        f"Written by `probe2road benchmark run`, poses: {poses}. Intervals hold 95 % of {DRAWS} draws of tiles of "
        "1 km by 1 km. References are the roads that at least four drives passed.\n"
    )
    sections = [f"## {title}\n\n{table}" for title, table in parts.items() if table.count("\n") > 2]
    pictures = [f"![{path.stem}]({path.name})\n" for path in sorted(output.glob("place-*.png"))]
    with atomic_path(output / _TABLES) as temporary:
        temporary.write_text("\n".join([head, *sections, *pictures]), encoding="utf-8")
    write_cells([cell.as_row() for cell in cells], output / "cells.csv")


def _draw_places(source: Source, methods: Sequence[Method], output: Path) -> None:
    """Draw the busiest places of a city that is only used for tests."""
    if find_dataset(source.name).splits:
        return
    graphs = {method.label: read_built(source, method) for method in methods}
    crs = source.reference.crs
    for number, bounds in enumerate(busiest_places(source.reference, _PLACES), start=1):
        path = output / f"place-{source.name}-{number}.png"
        fleet = read_fleet(source.fleet_file, bbox=bounds)
        draw_place(path, bounds, fleet.to_crs(crs), source.reference, {k: g.to_crs(crs) for k, g in graphs.items()})
