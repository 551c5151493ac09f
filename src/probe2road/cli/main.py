"""The command line: every verb reads files, calls one function of the library, and writes files."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe2road.cli.benchmark import benchmark
from probe2road.cli.reading import (
    Said,
    chosen_format,
    fleet_options,
    four_numbers,
    graph_options,
    read_drives,
    read_roads,
    reference_options,
    spoken,
    takes,
)
from probe2road.errors import OptionError, OutputError, Probe2RoadError
from probe2road.run.progress import progress_bar

if TYPE_CHECKING:
    import pandas as pd

    from probe2road.io.formats import FleetFormat, GraphFormat
    from probe2road.segmentation.network import NetworkOptions

__all__ = ["app", "main"]

logger = logging.getLogger("probe2road")

_NOTHING = 3  # exit code: the work was done and the files are there, but there is nothing in them
_TABLES = ".csv, .parquet, or with places .geoparquet, .gpkg, .geojson"
_VOLUME = ("-v", "--verbose", "-q", "--quiet")

app = typer.Typer(
    name="probe2road",
    help="Road graphs from fleet GNSS traces and camera-detected road features.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

app.add_typer(benchmark)


@app.callback()
def _common(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say more, and show tracebacks.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only warnings and errors.")] = False,
) -> None:
    """Set up the log, which goes to standard error."""
    from rich.console import Console
    from rich.logging import RichHandler

    level = logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO
    handler = RichHandler(console=Console(stderr=True), show_path=False, log_time_format="%H:%M:%S", markup=False)
    logger.handlers[:] = [handler]
    logger.setLevel(level)
    logger.propagate = False


@app.command()
@takes(fleet_format=fleet_options, without=["traces_layer"])
def build(
    traces: Annotated[list[Path], typer.Argument(help="Files or folders: Parquet, GeoParquet, CSV, GPX.")],
    output: Annotated[
        list[Path], typer.Option("--output", "-o", help="Graph to write; the suffix decides. May be repeated.")
    ],
    *,
    points: Annotated[Path | None, typer.Option(help="Semantic points: a file or a folder.")] = None,
    fleet_format: Said[FleetFormat],
    segmenter: Annotated[str | None, typer.Option(help="network or density.")] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Weights file of the network; the shipped one without it.")
    ] = None,
    device: Annotated[str | None, typer.Option(help="Device of the network: cpu or cuda.")] = None,
    resolution: Annotated[float | None, typer.Option(help="Metres per pixel.")] = None,
    refine: Annotated[bool, typer.Option(help="Let the traces fill gaps and split false junctions.")] = True,
    min_vehicles: Annotated[int, typer.Option(help="Vehicles that an edge needs to be written.")] = 1,
    min_drives: Annotated[int, typer.Option(help="Drives that an edge needs to be written.")] = 1,
    first_id: Annotated[int, typer.Option(help="First id in OSM files for routing engines (.osm.pbf).")] = 1,
    ids_from: Annotated[
        Path | None, typer.Option(help="Earlier graph, whose ids are kept where the road is the same.")
    ] = None,
    first_new_id: Annotated[
        int | None, typer.Option(help="With --ids-from: new ids are at least this; above all earlier ones without it.")
    ] = None,
    id_changes: Annotated[
        Path | None, typer.Option(help="With --ids-from: table of what was kept, split, merged, moved, new and gone.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file with build options, and how to read.")] = None,
    keep_intermediate: Annotated[
        Path | None, typer.Option(help="Folder that keeps what every stage made, and a picture of it.")
    ] = None,
) -> None:
    """Build a road graph from fleet data.

    An interrupted run goes on where it stopped when it is started again.
    """
    from probe2road.comparison.identity import keep_ids
    from probe2road.draw.stages import draw_stages
    from probe2road.graph.disclosure import withhold
    from probe2road.io.fleet_reader import read_fleet
    from probe2road.io.graph_files import graph_format, read_graph, write_graph
    from probe2road.io.osm_writer import OsmOptions
    from probe2road.io.table_writer import require_table_suffix, write_table
    from probe2road.options import options_from_table, read_toml
    from probe2road.recipe import BuildOptions
    from probe2road.recipe import build as build_graph
    from probe2road.run.workspace import resumable

    _require_places(*output, id_changes)
    if id_changes is not None:
        require_table_suffix(id_changes)
    if ids_from is None and (id_changes is not None or first_new_id is not None):
        raise OptionError("there are no earlier ids", where="build", fix="name the earlier graph with --ids-from")
    for path in output:
        graph_format(path)
    _require_folders(keep_intermediate)
    table = read_toml(config) if config else {}
    format = chosen_format(fleet_format, table, where=config)
    options, osm = options_from_table(table, BuildOptions, where=config), OsmOptions(first_id=first_id)
    chosen: dict[str, Any] = {"segmenter": segmenter, "resolution": resolution}
    if weights or device:
        chosen |= _network_choice(options.segmentation.network, segmenter, weights, device)
    given = {name: value for name, value in chosen.items() if value is not None}
    options = replace(options, segmentation=replace(options.segmentation, **given), refine=options.refine and refine)

    earlier = read_graph(ids_from) if ids_from else None
    fleet = read_fleet(traces, points, format=format)
    keeping = nullcontext(keep_intermediate) if keep_intermediate else resumable(output[0])
    with keeping as workspace, progress_bar() as progress:
        graph = build_graph(fleet, options=options, workspace=workspace, progress=progress)
        graph = withhold(graph, min_vehicles=min_vehicles, min_drives=min_drives)
        if earlier is not None:
            graph, changes = keep_ids(graph, earlier, first_new=first_new_id)
            if id_changes is not None:
                write_table(changes, id_changes, layer="changes")
        for path in output:
            write_graph(graph, path, osm=osm)
    if keep_intermediate:
        draw_stages(keep_intermediate, fleet, keep_intermediate / "stages.png")
    if graph.edges.empty:
        raise typer.Exit(_NOTHING)


@app.command()
@takes(fleet_format=fleet_options, without=["traces_layer"])
def align(
    traces: Annotated[list[Path], typer.Argument(help="Raw fleet data: files or folders.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parquet file for the aligned traces.")],
    *,
    points: Annotated[Path | None, typer.Option(help="Semantic points: a file or a folder.")] = None,
    add_to: Annotated[Path | None, typer.Option(help="Aligned fleet data that the drives are added to.")] = None,
    report: Annotated[Path | None, typer.Option(help="Folder for figures, lists and a picture.")] = None,
    fleet_format: Said[FleetFormat],
    drop_rejected: Annotated[bool, typer.Option("--drop-rejected", help="Leave out what cannot be aligned.")] = False,
    config: Annotated[Path | None, typer.Option(help="TOML file with alignment options, and how to read.")] = None,
    workers: Annotated[int, typer.Option(help="Processes; no influence on the result.")] = 1,
) -> None:
    """Align the drives of a fleet: move poses and points to where they agree.

    An interrupted run goes on where it stopped when it is started again.
    """
    from probe2road.alignment.align import AlignOptions, add_drives
    from probe2road.alignment.align import align as align_fleet
    from probe2road.alignment.report import draw_alignment, write_report
    from probe2road.io.fleet_reader import read_fleet, read_fleet_files
    from probe2road.io.fleet_writer import require_fleet_suffix, write_fleet
    from probe2road.options import options_from_table, read_toml
    from probe2road.run.workspace import resumable

    _require_places(output)
    require_fleet_suffix(output)
    _require_folders(report)
    table = read_toml(config) if config else {}
    format = chosen_format(fleet_format, table, where=config)
    options = options_from_table(table, AlignOptions, where=config)
    options = replace(options, keep_rejected=False) if drop_rejected else options
    base = read_fleet_files(add_to) if add_to else None
    format = replace(format, target_crs=base.crs) if base else format
    fleet = read_fleet(traces, points, format=format)
    with resumable(output) as workspace, progress_bar() as progress:
        kept: dict[str, Any] = {"workspace": workspace, "workers": workers, "progress": progress}
        result = (
            add_drives(base, fleet, options=options, **kept) if base else align_fleet(fleet, options=options, **kept)
        )
        write_fleet(result.fleet, output)
    if report:
        write_report(result.report, report)
        draw_alignment(fleet, result.fleet, report / "alignment.png")
    typer.echo(json.dumps(result.report.summary, indent=1))


@app.command()
@takes(fleet_format=fleet_options, graph_format=graph_options, without=["point_columns", "layer"])
def match(
    traces: Annotated[Path, typer.Argument(help="Fleet data: a file or a folder.")],
    graph: Annotated[Path, typer.Argument(help="Road graph, in any format that build writes, or OSM.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="File for the matches, a row for each fix; the suffix decides: " + _TABLES),
    ],
    *,
    steps: Annotated[Path | None, typer.Option(help="File for the paths, a row for each edge driven.")] = None,
    trips: Annotated[Path | None, typer.Option(help="File for the lines driven, a row for each trip.")] = None,
    roads: Annotated[Path | None, typer.Option(help="Graph to write, whose edges the matches name.")] = None,
    profile: Annotated[str | None, typer.Option(help="auto, fleet, sparse or published.")] = None,
    fleet_format: Said[FleetFormat],
    graph_format: Said[GraphFormat],
    config: Annotated[Path | None, typer.Option(help="TOML file with matching options, and how to read.")] = None,
) -> None:
    """Match traces to the edges of a road graph."""
    from probe2road.io.graph_files import graph_format as format_of_graph
    from probe2road.io.graph_files import write_graph
    from probe2road.io.table_writer import GEO_SUFFIXES, require_table_suffix, write_table
    from probe2road.matching.match import MatchOptions
    from probe2road.matching.match import match as match_fleet
    from probe2road.matching.places import matched_edges, matched_points, trip_lines
    from probe2road.options import options_from_table, read_toml

    _require_places(output, steps, trips, roads)
    for path in (output, steps, trips):
        if path is not None:
            require_table_suffix(path)
    if roads is not None:
        format_of_graph(roads)
    table = read_toml(config) if config else {}
    format = chosen_format(fleet_format, table, where=config)
    roads_format = chosen_format(graph_format, table, where=config)
    options = options_from_table(table, MatchOptions, where=config)
    options = replace(options, profile=profile) if profile else options
    network = read_roads(graph, graph_format, format=roads_format, target_crs=format.target_crs)
    fleet = read_drives(traces, format=format, target_crs=network.crs)
    matches = match_fleet(network, fleet, options=options)
    placed = output.suffix.lower() in GEO_SUFFIXES
    write_table(matched_points(matches, network) if placed else matches.fixes, output, layer="matches")
    if steps is not None:
        driven = matched_edges(matches, network)
        placed = steps.suffix.lower() in GEO_SUFFIXES
        write_table(driven if placed else driven.drop(columns="geometry"), steps, layer="steps")
    if trips is not None:
        write_table(trip_lines(matches, network), trips, layer="trips")
    if roads is not None:
        write_graph(network, roads)
    if not matches.fixes["edge"].notna().any():
        raise typer.Exit(_NOTHING)


@app.command()
@takes(graph_format=graph_options, reference_format=reference_options)
def evaluate(
    proposal: Annotated[Path, typer.Argument(help="Road graph to score.")],
    reference: Annotated[Path, typer.Argument(help="Road graph to score against.")],
    *,
    graph_format: Said[GraphFormat],
    reference_format: Said[GraphFormat],
    metrics: Annotated[
        str | None, typer.Option(help="Comma-separated: geo, itopo, topo, apls, buffer_geo, ...")
    ] = None,
    area: Annotated[str | None, typer.Option(help="Clip both to left,bottom,right,top in the reference's CRS.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File for the scores; the suffix decides: .csv or .parquet.")
    ] = None,
) -> None:
    """Score a road graph against a reference; both may be in any format that build writes, or OSM."""
    from probe2road.io.table_writer import require_table_suffix, write_table
    from probe2road.metrics import DEFAULT_METRICS
    from probe2road.metrics import evaluate as score

    if output:
        _require_places(output)
        require_table_suffix(output, (".csv", ".parquet"))
    target = read_roads(reference, reference_format)
    names = metrics.split(",") if metrics else DEFAULT_METRICS
    box = four_numbers(area, "--area") if area else None
    scores = score(read_roads(proposal, graph_format), target, metrics=names, area=box)
    if output:
        write_table(scores, output)
    _print_scores(scores)
    if not scores[["precision", "recall"]].any(axis=None):
        raise typer.Exit(_NOTHING)


@app.command()
@takes(graph_format=graph_options, reference_format=reference_options)
def diff(
    graph: Annotated[Path, typer.Argument(help="Road graph built from drives.")],
    base: Annotated[Path, typer.Argument(help="Map to compare it with: OSM, a GIS file, or another road graph.")],
    output: Annotated[
        list[Path],
        typer.Option(
            "--output",
            "-o",
            help="File to write: .osc for JOSM, .geojsons for MapRoulette, or a table. May be repeated. " + _TABLES,
        ),
    ],
    *,
    graph_format: Said[GraphFormat],
    reference_format: Said[GraphFormat],
    min_probability: Annotated[
        float | None, typer.Option(help="Of a difference, from which on it is listed; 0.5 without it.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file with options of the comparison.")] = None,
) -> None:
    """Compare a road graph with a map: what it confirms, what the map lacks, and what may be wrong on it."""
    from probe2road.comparison.diff import DIFFERENCES, DiffOptions
    from probe2road.comparison.diff import diff as compare
    from probe2road.comparison.proposals import require_diff_suffix, write_diff
    from probe2road.options import options_from_table, read_toml

    _require_places(*output)
    for path in output:
        require_diff_suffix(path)
    options = options_from_table(read_toml(config) if config else {}, DiffOptions, where=config)
    options = replace(options, min_probability=min_probability) if min_probability is not None else options
    ours = read_roads(graph, graph_format)
    changes = compare(ours, read_roads(base, reference_format), options=options)
    for path in output:
        write_diff(changes, path)
    for name in DIFFERENCES:
        rows = changes[changes["change"] == name]
        kilometres = f"{rows['length'].sum() / 1000:9.1f} km" if "connection" not in name else ""
        typer.echo(f"{name:20}{len(rows):7}{kilometres}")


@app.command()
@takes(
    fleet_format=fleet_options,
    graph_format=graph_options,
    without=["point_columns", "graph_crs", "graph_layer", "traces_layer"],
)
def info(
    file: Annotated[Path, typer.Argument(help="Fleet data or a road graph.")],
    fleet_format: Said[FleetFormat],
    graph_format: Said[GraphFormat],
) -> None:
    """Describe fleet data or a road graph in figures."""
    from probe2road.io.describe import describe_file

    format = chosen_format(fleet_format)  # there is one file: its CRS and layer are said in one way, whatever it holds
    roads_format = replace(
        chosen_format(graph_format), crs=format.crs, target_crs=format.target_crs, layer=format.layer
    )
    typer.echo(json.dumps(describe_file(file, format=format, graph_format=roads_format), indent=1))


@app.command()
@takes(fleet_format=fleet_options, graph_format=graph_options, reference_format=reference_options, without=["layer"])
def view(
    graph: Annotated[Path, typer.Argument(help="Road graph.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML file, or PNG.")],
    *,
    traces: Annotated[Path | None, typer.Option(help="Fleet data to show under it.")] = None,
    points: Annotated[Path | None, typer.Option(help="Semantic points to show under it.")] = None,
    reference: Annotated[Path | None, typer.Option(help="Road graph to compare with; only in a PNG.")] = None,
    title: Annotated[str | None, typer.Option(help="Heading; the file's name without it.")] = None,
    min_drives: Annotated[int, typer.Option(help="Drives that an edge, and a pixel of traces, needs.")] = 1,
    fleet_format: Said[FleetFormat],
    graph_format: Said[GraphFormat],
    reference_format: Said[GraphFormat],
) -> None:
    """Draw a road graph over its traces: one HTML page that needs no network, or a picture."""
    from probe2road.draw.view import require_drawable
    from probe2road.draw.view import view as draw

    require_drawable(output)
    _require_places(output)
    format = chosen_format(fleet_format)
    roads = read_roads(graph, graph_format, target_crs=format.target_crs)
    fleet = read_drives(traces, points, format=format, target_crs=roads.crs) if traces else None
    compared = read_roads(reference, reference_format) if reference else None
    draw(roads, output, fleet=fleet, reference=compared, title=title or graph.name, min_drives=min_drives)


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder to write to.")] = Path("demo-output"),
) -> None:
    """Run the main job on a simulated cloverleaf, offline, and say which files to open."""
    from probe2road.demo import run_demo

    _require_folders(folder)
    with progress_bar() as progress:
        files, scores = run_demo(folder, progress=progress)
    _print_scores(scores)
    typer.echo("\nOpen these:")
    for path, what in files.items():
        typer.echo(f"  {path}  {what}")


@app.command()
def simulate(
    network: Annotated[Path, typer.Argument(help="Road network: .osm or .osm.pbf.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write to.")],
    preset: Annotated[str, typer.Option(help="open_sky, mixed, urban_canyon, phone, or a TOML file.")] = "mixed",
    seed: Annotated[int, typer.Option(help="The same seed makes the same fleet.")] = 0,
    drives: Annotated[int | None, typer.Option(help="How many drives.")] = None,
    kilometres: Annotated[float | None, typer.Option(help="How many kilometres in all, instead of drives.")] = None,
    modelled: Annotated[bool, typer.Option("--modelled", help="Also write what an alignment would leave.")] = False,
    workers: Annotated[int, typer.Option(help="Processes; no influence on the result.")] = 1,
) -> None:
    """Simulate a vehicle fleet on a road network: raw fleet data, true poses, and the true road graph.

    An interrupted run goes on where it stopped when it is started again.
    """
    from probe2road.benchmark.sets.recording import record_fleet
    from probe2road.benchmark.sets.residual import ResidualModel
    from probe2road.simulation.networks.osm import read_network
    from probe2road.simulation.presets import find_preset

    _require_folders(output)
    if (drives is None) == (kilometres is None):
        raise OptionError("the amount must be given once", where="simulate", fix="pass --drives or --kilometres")
    chosen = find_preset(preset)
    with progress_bar() as progress:
        record_fleet(
            read_network(network),
            output,
            preset=chosen,
            n_drives=drives,
            drive_km=kilometres,
            seed=seed,
            workers=workers,
            residual=ResidualModel() if modelled else None,
            progress=progress,
        )


@app.command()
def train(
    config: Annotated[str, typer.Argument(help="TOML file, or a shipped one: gnss-vision, gnss, paper.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the run; a run in it goes on.")],
    sets: Annotated[Path, typer.Option(help="Folder of prepared data sets, see benchmark prepare.")],
    device: Annotated[str, typer.Option(help="cpu, cuda, or auto: cuda where there is one.")] = "auto",
    threads: Annotated[int | None, typer.Option(help="Of the CPU; all cores without it.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop at the first validation after so long.")] = None,
) -> None:
    """Train the segmentation network and write its weights file, which build --weights takes.

    An interrupted run goes on where it stopped when it is started again. Needs the extra 'train'.
    """
    _require_folders(output)
    from probe2road.training.config import load_config
    from probe2road.training.finish import export_best
    from probe2road.training.loop import is_first, use_threads
    from probe2road.training.loop import train as run_training

    chosen = load_config(config)
    if threads is not None:
        use_threads(threads)
    stop_after = None if minutes is None else 60.0 * minutes
    with progress_bar() as progress:
        state = run_training(chosen, output, sets=sets, device=device, stop_after=stop_after, progress=progress)
    if not is_first():
        return
    if state.step < chosen.steps:
        typer.echo(f"stopped after step {state.step} of {chosen.steps}; start again to go on")
    typer.echo(export_best(chosen, state, output, sets=sets))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; an error of ours gives one message and exit code 2, an empty result exit code 3."""
    # How much to say is said to the program, but may stand anywhere.
    arguments = sorted(sys.argv[1:] if arguments is None else arguments, key=lambda word: word not in _VOLUME)
    try:
        app(arguments)
    except Probe2RoadError as error:
        if logger.isEnabledFor(logging.DEBUG):
            raise
        typer.secho(f"error: {spoken(str(error))}", fg="red", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.secho("interrupted; start again to go on", err=True)
        sys.exit(130)


def _require_places(*outputs: Path | None) -> None:
    """Refuse output paths that cannot be written, and two outputs of one name, before any work."""
    from probe2road.io.atomic import require_place

    named = [path for path in outputs if path is not None]
    for path in named:
        require_place(path)
    for number, path in enumerate(named):
        if path.absolute() in [other.absolute() for other in named[:number]]:
            raise OptionError("is named twice as an output", where=path, fix="name a file for each")


def _require_folders(*outputs: Path | None) -> None:
    """Refuse a file in the place of an output folder; a missing folder is created when it is written."""
    for path in outputs:
        if path is not None and path.exists() and not path.is_dir():
            raise OutputError("is a file, and a folder would be written", where=path, fix="choose another name")


def _network_choice(
    network: NetworkOptions, segmenter: str | None, weights: Path | None, device: str | None
) -> dict[str, Any]:
    """Return the build options that follow from weights or a device on the command line."""
    if segmenter not in (None, "network"):
        option = "--weights" if weights else "--device"
        raise OptionError(f"segmenter {segmenter} runs no network", where=option, fix="use --segmenter network")
    file = str(weights) if weights else network.weights
    return {"segmenter": "network", "network": replace(network, weights=file, device=device or network.device)}


def _print_scores(scores: pd.DataFrame) -> None:
    """Print scores as a table, each with its parameters."""
    from rich.console import Console
    from rich.table import Table

    table = Table("metric", "precision", "recall", "F1", "parameters", box=None)
    for row in scores.itertuples():
        table.add_row(row.metric, f"{row.precision:.3f}", f"{row.recall:.3f}", f"{row.f1:.3f}", row.parameters)
    Console().print(table)
