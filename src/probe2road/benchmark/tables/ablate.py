"""The run of all ablations: build, score, draw, and write a page with a table and a figure for each."""

from __future__ import annotations

import json
import logging
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from probe2road.benchmark.sets.datasets import find_dataset
from probe2road.benchmark.tables.ablations import Ablation, AblationValue, find_ablations
from probe2road.benchmark.tables.cells import FULL, Cell, build_cell, score_cells, write_cells
from probe2road.benchmark.tables.figures import Point, draw_points
from probe2road.benchmark.tables.intervals import DRAWS, Interval, f1_interval
from probe2road.benchmark.tables.source import Source
from probe2road.benchmark.tables.tables import ablation_table, markdown_table
from probe2road.errors import InputError
from probe2road.io.atomic import atomic_path, make_folder
from probe2road.run.progress import Progress, silent

__all__ = ["run_ablations"]

logger = logging.getLogger(__name__)

_NOTES = "notes.toml"  # in the output: what the numbers mean, by name of the ablation
_TRAININGS, _TRAININGS_TITLE = "loss", "Loss of the training"
# Runs of experiments/training_experiments.py that have another loss.
_LOSSES = {
    "base": "BCE + Dice",
    "cp_2x2": "CP-loss, buffer 2x2",
    "cp_3x3": "CP-loss, buffer 3x3",
    "cp_scratch": "CP-loss, 2x2, from step 1",
}


def run_ablations(
    sets: str | Path,
    output: str | Path,
    *,
    name: str = "milan",
    only: Sequence[str] = (),
    work: str | Path | None = None,
    poses: str = "aligned",
    trainings: str | Path | None = None,
    progress: Progress | None = None,
) -> dict[str, list[Cell]]:
    """Build and score the variants of every ablation, draw them, and write a page about them.

    Parameters
    ----------
    sets
        Folder of the data sets that `probe2road.benchmark.sets.prepare.prepare` made.
    output
        Folder for ``index.md``, ``cells.csv`` and a figure for each ablation; created where it does not exist. What
        stands in its ``notes.toml`` under the name of an ablation goes into the page.
    name
        Data set. Of one with splits, its validation tiles are scored.
    only
        Out of `probe2road.benchmark.tables.ablations.ABLATIONS`; all where there is none.
    work
        Folder that keeps graphs and scores, from which an interrupted run goes on; it may be that of
        `probe2road.benchmark.tables.run.run_benchmark`. ``work`` in the output without it.
    poses
        As for `probe2road.benchmark.tables.run.run_benchmark`.
    trainings
        JSON file of ``experiments/training_experiments.py``, from which the losses are compared.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    dict of list of Cell
        The scores of each ablation, in the order of its variants.

    Raises
    ------
    OptionError
        If there is no such data set, ablation or poses.
    InputError
        If the data set is not prepared, or trainings or notes cannot be read.
    OutputError
        If the folder cannot be created.
    """
    output, report = Path(output), progress or silent
    source = Source(Path(sets) / find_dataset(name).name, Path(work) if work is not None else output / "work", poses)
    ablations = find_ablations(only, source)
    _ = source.digest  # says what is missing before hours of work
    losses = {} if trainings is None else _read_losses(Path(trainings))
    notes = _read_notes(output / _NOTES)
    make_folder(output)

    if losses:
        draw_points(
            output / f"{_TRAININGS}.png",
            _loss_points(losses),
            title=_TRAININGS_TITLE,
            default=_LOSSES["base"],
            joined=False,
        )
    cells: dict[str, list[Cell]] = {}
    for number, ablation in enumerate(ablations):
        report("ablations", number, len(ablations))
        cells[ablation.name] = [_cell(variant) for variant in ablation.variants]
        _draw(ablation, cells[ablation.name], output)
        _write_page(ablations[: number + 1], cells, losses, notes, output)  # can be read while the rest runs
    report("ablations", 1, 1)
    return cells


def _cell(variant: AblationValue) -> Cell:
    """Build and score a variant; for a data set with splits, on the validation split."""
    build_cell(variant.source, variant.method, like=variant.like)
    full = [cell for cell in score_cells(variant.source, variant.method) if cell.stage == FULL]
    return next((cell for cell in full if cell.area.endswith("validation")), full[0])


def _draw(ablation: Ablation, cells: Sequence[Cell], output: Path) -> None:
    """Draw the figure of an ablation; with several series, only two scores are shown."""
    points = []
    for variant, cell in zip(ablation.variants, cells, strict=True):
        scores = {"GEO F1": f1_interval(cell.tiles["geo"]), "iTOPO F1": f1_interval(cell.tiles["itopo"])}
        if not variant.series:
            scores["junctions F1"] = _exact(cell.figures["junctions_f1"])
        points.append(Point(variant.label, scores, variant.series))
    path = output / f"{ablation.name}.png"
    default, joined = ablation.default, ablation.joined
    draw_points(path, points, title=ablation.title, axis=ablation.axis, default=default, joined=joined)


def _write_page(
    ablations: Sequence[Ablation],
    cells: Mapping[str, Sequence[Cell]],
    losses: Mapping[str, Mapping[str, Any]],
    notes: Mapping[str, str],
    output: Path,
) -> None:
    """Write the page, and the cells from which it is made."""
    first = ablations[0]
    made = dict(zip((variant.label for variant in first.variants), cells[first.name], strict=True))
    base = made.get(first.default, cells[first.name][0])
    head = (
        "# What matters: ablations beyond the paper\n\n"
        f"Written by `probe2road benchmark ablate` from {base.area}, poses: {base.poses}. Each table changes one "
        "thing of Probe2Road with GNSS and vision. Intervals, and the bars of the figures, hold 95 % of "
        f"{DRAWS} draws of tiles of 1 km by 1 km. A difference from the default is drawn from the same tiles for "
        "both, and is known better than either score.\n"
    )
    sections = [
        _section(ablation.name, ablation.title, _tables(ablation, cells[ablation.name]), notes)
        for ablation in ablations
    ]
    if losses:
        sections.append(_section(_TRAININGS, _TRAININGS_TITLE, _loss_table(losses), notes))
    with atomic_path(output / "index.md") as temporary:
        temporary.write_text("\n".join([head, *sections]), encoding="utf-8")
    rows = [
        {"ablation": ablation.name, "series": variant.series, "value": variant.label, **cell.as_row()}
        for ablation in ablations
        for variant, cell in zip(ablation.variants, cells[ablation.name], strict=True)
    ]
    write_cells(rows, output / "cells.csv")


def _section(name: str, title: str, table: str, notes: Mapping[str, str]) -> str:
    """Return the text of the page about one ablation."""
    parts = [f"## {title}", notes.get(name, "").strip(), f"![{title}]({name}.png)", table]
    return "\n\n".join(part for part in parts if part)


def _tables(ablation: Ablation, cells: Sequence[Cell]) -> str:
    """Return a table for every series; each is compared with its own default, if it has one."""
    pairs = list(zip(ablation.variants, cells, strict=True))
    tables = []
    for series in dict.fromkeys(variant.series for variant in ablation.variants):
        chosen = {variant.label: cell for variant, cell in pairs if variant.series == series}
        default = chosen[ablation.default]
        rows = [(f"**{label}**" if cell is default else label, cell, default) for label, cell in chosen.items()]
        tables.append(ablation_table(f"{ablation.axis} {series}".strip(), rows))
    return "\n".join(tables)


def _read_losses(path: Path) -> dict[str, dict[str, Any]]:
    """Read the results of the runs with different losses, by label."""
    try:
        runs = json.loads(path.read_text(encoding="utf-8"))
        losses = {label: runs[run] for run, label in _LOSSES.items() if run in runs}
        _loss_table(losses)  # all that is needed is there
    except (OSError, ValueError, TypeError, KeyError) as error:
        fix = "name a file that experiments/training_experiments.py wrote"
        raise InputError(f"cannot be read as trainings ({error!r})", where=path, fix=fix) from error
    if not losses:
        raise InputError("has none of the runs of losses", where=path, fix=f"train {', '.join(_LOSSES)}")
    return losses


def _loss_points(losses: Mapping[str, Mapping[str, Any]]) -> list[Point]:
    names = {"GEO F1": "geo_f1", "iTOPO F1": "itopo_f1", "soft F1": "soft_f1"}
    return [Point(label, {score: _exact(run[name]) for score, name in names.items()}) for label, run in losses.items()]


def _loss_table(losses: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of the results of each loss on the validation squares of the training."""
    rows = [
        [point.label, *(f"{score.value:.3f}" for score in point.scores.values()), str(losses[point.label]["steps"])]
        for point in _loss_points(losses)
    ]
    return markdown_table(["loss", "GEO F1", "iTOPO F1", "soft F1", "steps"], rows)


def _read_notes(path: Path) -> dict[str, str]:
    """Read the remarks on ablations; none if the file is missing."""
    if not path.exists():
        return {}
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"is not TOML: {error}", where=path) from error


def _exact(value: float | None) -> Interval:
    """Return a figure without an interval; 0 if it is not defined."""
    return Interval(value or 0.0, value or 0.0, value or 0.0)
