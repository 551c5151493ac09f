"""The verbs of `probe2road benchmark`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from probe2road.run.progress import progress_bar

__all__ = ["benchmark"]

benchmark = typer.Typer(name="benchmark", help="The open benchmark.", no_args_is_help=True)


@benchmark.command()
def prepare(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder that gets a folder for each data set.")],
    names: Annotated[
        list[str] | None, typer.Argument(help="Data sets, NAME-PRESET, or groups; all cities without any.")
    ] = None,
    data: Annotated[Path, typer.Option(help="Folder of the OpenStreetMap extracts.")] = Path("../shared/data/osm"),
    workers: Annotated[int, typer.Option(help="Processes; no influence on the result.")] = 1,
) -> None:
    """Make data sets of the open benchmark: simulated fleets on real roads, with the truth and fixed splits.

    An interrupted run goes on where it stopped when it is started again.
    """
    from probe2road.benchmark.sets.prepare import prepare as prepare_datasets

    with progress_bar() as progress:
        for folder in prepare_datasets(names or [], output, data=data, workers=workers, progress=progress):
            typer.echo(folder)


@benchmark.command()
def align(
    sets: Annotated[Path, typer.Argument(help="Folder of prepared data sets.")],
    names: Annotated[
        list[str] | None, typer.Option("--name", help="Data set or group; all cities without any.")
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes; no influence on the result beyond millimetres.")] = 1,
) -> None:
    """Align the raw fleets of data sets, and keep the aligned ones beside them.

    An interrupted run goes on where it stopped when it is started again; what is aligned is taken as it is.
    """
    from probe2road.benchmark.sets.aligning import align_dataset
    from probe2road.benchmark.sets.datasets import find_datasets

    with progress_bar() as progress:
        for data in find_datasets(names or []):
            typer.echo(align_dataset(sets / data.name, workers=workers, progress=progress))


@benchmark.command()
def run(
    sets: Annotated[Path, typer.Argument(help="Folder of prepared data sets.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables, cells and pictures.")],
    names: Annotated[list[str] | None, typer.Option("--name", help="Data set; may be repeated.")] = None,
    methods: Annotated[list[str] | None, typer.Option("--method", help="Method; may be repeated.")] = None,
    work: Annotated[Path | None, typer.Option(help="Folder that keeps graphs and scores.")] = None,
    poses: Annotated[str, typer.Option(help="aligned (by align), modelled (as after an alignment), raw.")] = "aligned",
    deepmg: Annotated[Path | None, typer.Option(help="Weights of DeepMG; left out without them.")] = None,
) -> None:
    """Build and score every method on every data set, and write the paper's tables.

    An interrupted run goes on where it stopped when it is started again.
    """
    from probe2road.benchmark.tables.run import CITIES, run_benchmark

    with progress_bar() as progress:
        run_benchmark(
            sets,
            output,
            names=names or CITIES,
            methods=methods or (),
            work=work,
            poses=poses,
            deepmg=deepmg,
            progress=progress,
        )
    typer.echo(output / "index.md")


@benchmark.command()
def ablate(
    sets: Annotated[Path, typer.Argument(help="Folder of prepared data sets.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for page, cells and figures.")],
    name: Annotated[str, typer.Option(help="Data set.")] = "milan",
    only: Annotated[list[str] | None, typer.Option(help="Ablation; may be repeated; all without it.")] = None,
    work: Annotated[Path | None, typer.Option(help="Folder that keeps graphs and scores.")] = None,
    poses: Annotated[str, typer.Option(help="aligned (by align), modelled (as after an alignment), raw.")] = "aligned",
    trainings: Annotated[Path | None, typer.Option(help="JSON of training experiments, to compare losses.")] = None,
) -> None:
    """Change one thing of the default at a time, score it, and draw a figure for each.

    An interrupted run goes on where it stopped when it is started again.
    """
    from probe2road.benchmark.tables.ablate import run_ablations

    with progress_bar() as progress:
        run_ablations(
            sets,
            output,
            name=name,
            only=only or (),
            work=work,
            poses=poses,
            trainings=trainings,
            progress=progress,
        )
    typer.echo(output / "index.md")
