"""Options of the command line that describe input files: declared once, shared by all commands that read.

A group of options is a function: its parameters are the options, and it returns what was `Said`. `takes` puts the
options of a group in the place of one parameter of a verb, so that the help of the verb shows them and the verb gets
one object. The library speaks of arguments, ``crs="EPSG:32616"``; `spoken` puts its messages into flags.
"""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar, get_type_hints

import typer

from probe2road.errors import OptionError, Probe2RoadError

if TYPE_CHECKING:
    from probe2road.fleet.contract import Fleet
    from probe2road.graph.roadgraph import RoadGraph
    from probe2road.io.formats import FleetFormat, GraphFormat

__all__ = [
    "FLAGS",
    "Said",
    "chosen_format",
    "fleet_options",
    "four_numbers",
    "graph_options",
    "read_drives",
    "read_roads",
    "reference_options",
    "spoken",
    "takes",
]

Format = TypeVar("Format", "FleetFormat", "GraphFormat")

# What an argument of the library is called on the command line, unless a verb has several of its kind.
FLAGS: Mapping[str, str] = {
    "columns": "--columns",
    "point_columns": "--point-columns",
    "crs": "--crs",
    "target_crs": "--target-crs",
    "bbox": "--bbox",
    "delimiter": "--delimiter",
    "header": "--no-header",
    "time_format": "--time-format",
    "interval": "--interval",
    "invalid": "--invalid",
    "max_accuracy": "--max-accuracy",
    "max_speed": "--max-speed",
    "max_uncompressed": "--max-uncompressed",
    "layer": "--layer",
    "inner_junctions": "--no-inner-junctions",
    "segmenter": "--segmenter",
    "resolution": "--resolution",
    "data": "--data",
    "trim_ends": "--trim-ends",
    "min_vehicles": "--min-vehicles",
    "min_drives": "--min-drives",
    "refine": "--refine",
}

# An argument in a message, name=literal, such as crs="EPSG:32616". A path starts a message or has a slash before it.
_ARGUMENT = re.compile(r"""(?<=[\s(])(\w+)=("[^"]*"|'[^']*'|\{[^{}]*\}|\([^()]*\)|[\w.+-]*\w)""")

_FLEET, _GRAPH, _REFERENCE = "How to read the fleet data", "How to read the graph", "How to read the reference"


@dataclass(frozen=True)
class Said(Generic[Format]):
    """The description of the files of a fleet, or of a graph, on the command line."""

    kind: type[Format]
    table: str  # the table of a TOML file that says the rest
    fields: Mapping[str, Any]  # of the format; what is None was not said
    flags: Mapping[str, str]  # what the fields are called on the command line


def fleet_options(
    columns: Annotated[
        str | None,
        typer.Option(
            help="Columns of the traces, ours=theirs: trace_id=trip,t=time,x=lon,y=lat,z=alt.", rich_help_panel=_FLEET
        ),
    ] = None,
    point_columns: Annotated[
        str | None,
        typer.Option(help="Columns of the semantic points, likewise; also kind=label.", rich_help_panel=_FLEET),
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="CRS of the coordinates, for example EPSG:32616.", rich_help_panel=_FLEET)
    ] = None,
    target_crs: Annotated[
        str | None, typer.Option(help="Metric CRS to work in; chosen from the data without it.", rich_help_panel=_FLEET)
    ] = None,
    bbox: Annotated[
        str | None,
        typer.Option(help="Only this area: left,bottom,right,top in the CRS of the file.", rich_help_panel=_FLEET),
    ] = None,
    delimiter: Annotated[
        str | None,
        typer.Option(help="Of text tables; told from the first line without it.", rich_help_panel=_FLEET),
    ] = None,
    no_header: Annotated[
        bool,
        typer.Option(
            "--no-header", help="Text tables have no line of names: columns are 0, 1, 2.", rich_help_panel=_FLEET
        ),
    ] = False,
    time_format: Annotated[
        str | None,
        typer.Option(help="How times are written, as for strptime: '%d.%m.%Y %H:%M:%S'.", rich_help_panel=_FLEET),
    ] = None,
    interval: Annotated[
        float | None,
        typer.Option(help="Seconds between the positions of a line that has a start time.", rich_help_panel=_FLEET),
    ] = None,
    layer: Annotated[
        str | None, typer.Option(help="Layer of the fixes, in a file of several.", rich_help_panel=_FLEET)
    ] = None,
    traces_layer: Annotated[
        str | None, typer.Option(help="Layer of the fixes, in a file of several.", rich_help_panel=_FLEET)
    ] = None,
    trim_ends: Annotated[
        float | None, typer.Option(help="Metres to leave out at both ends of every trace.", rich_help_panel=_FLEET)
    ] = None,
    invalid: Annotated[
        str | None,
        typer.Option(
            help="Rows without position or readable time: drop or refuse; without it, dropped up to 5 % of a file.",
            rich_help_panel=_FLEET,
        ),
    ] = None,
    max_accuracy: Annotated[
        float | None,
        typer.Option(help="Leave out fixes that say that they are less accurate, m.", rich_help_panel=_FLEET),
    ] = None,
    max_speed: Annotated[
        float | None,
        typer.Option(help="Leave out fixes faster than this from their neighbours, m/s.", rich_help_panel=_FLEET),
    ] = None,
    max_uncompressed: Annotated[
        float | None,
        typer.Option(help="Gigabytes that a compressed file may hold; 4 without it.", rich_help_panel=_FLEET),
    ] = None,
) -> Said[FleetFormat]:
    """Return what is said of the files of a fleet; verbs that take a graph, too, call the layer ``--traces-layer``."""
    from probe2road.io.formats import FleetFormat

    fields = {
        "columns": _column_map(columns, "--columns"),
        "point_columns": _column_map(point_columns, "--point-columns"),
        "crs": crs,
        "target_crs": target_crs,
        "bbox": four_numbers(bbox, "--bbox") if bbox else None,
        "delimiter": delimiter,
        "header": False if no_header else None,
        "time_format": time_format,
        "interval": interval,
        "layer": layer or traces_layer,
        "trim_ends": trim_ends,
        "invalid": invalid,
        "max_accuracy": max_accuracy,
        "max_speed": max_speed,
        "max_uncompressed": max_uncompressed,
    }
    return Said(FleetFormat, "format", fields, FLAGS)


def graph_options(
    graph_layer: Annotated[
        str | None, typer.Option("--layer", help="Layer of the roads, in a file of several.", rich_help_panel=_GRAPH)
    ] = None,
    graph_crs: Annotated[
        str | None,
        typer.Option(help="CRS of the graph's coordinates, where its file names none.", rich_help_panel=_GRAPH),
    ] = None,
    no_inner_junctions: Annotated[
        bool,
        typer.Option(
            "--no-inner-junctions",
            help="Lines of a GIS file meet at their ends only, not where one ends on an inner vertex of another.",
            rich_help_panel=_GRAPH,
        ),
    ] = False,
    max_uncompressed: Annotated[
        float | None,
        typer.Option(help="Gigabytes that a compressed file may hold; 4 without it.", rich_help_panel=_GRAPH),
    ] = None,
) -> Said[GraphFormat]:
    """Return the description of the file of a graph."""
    from probe2road.io.formats import GraphFormat

    flags = {
        "layer": "--layer",
        "crs": "--graph-crs",
        "inner_junctions": "--no-inner-junctions",
        "max_uncompressed": "--max-uncompressed",
    }
    inner = False if no_inner_junctions else None
    fields = {"layer": graph_layer, "crs": graph_crs, "inner_junctions": inner, "max_uncompressed": max_uncompressed}
    return Said(GraphFormat, "graph_format", fields, flags)


def reference_options(
    reference_layer: Annotated[
        str | None, typer.Option(help="Layer of the roads, in a file of several.", rich_help_panel=_REFERENCE)
    ] = None,
    reference_crs: Annotated[
        str | None,
        typer.Option(help="CRS of the reference's coordinates, where its file names none.", rich_help_panel=_REFERENCE),
    ] = None,
    no_reference_inner_junctions: Annotated[
        bool,
        typer.Option(
            "--no-reference-inner-junctions",
            help="Lines of a GIS file meet at their ends only, not where one ends on an inner vertex of another.",
            rich_help_panel=_REFERENCE,
        ),
    ] = False,
    max_uncompressed: Annotated[
        float | None,
        typer.Option(help="Gigabytes that a compressed file may hold; 4 without it.", rich_help_panel=_REFERENCE),
    ] = None,
) -> Said[GraphFormat]:
    """Return the description of the file of a reference graph."""
    from probe2road.io.formats import GraphFormat

    flags = {
        "layer": "--reference-layer",
        "crs": "--reference-crs",
        "inner_junctions": "--no-reference-inner-junctions",
        "max_uncompressed": "--max-uncompressed",
    }
    inner = False if no_reference_inner_junctions else None
    fields = {
        "layer": reference_layer,
        "crs": reference_crs,
        "inner_junctions": inner,
        "max_uncompressed": max_uncompressed,
    }
    return Said(GraphFormat, "reference_format", fields, flags)


def takes(
    *, without: Collection[str] = (), **groups: Callable[..., Said[Any]]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command options in groups: typer sees all options, the command gets one object for each group.

    An option that several groups declare is one option, which is said to all of them.

    Parameters
    ----------
    without
        Options that mean nothing to this verb, and are not offered.
    **groups
        Parameter of the verb to the function that declares the options in its place.

    Examples
    --------
    >>> @takes(graph=graph_options, without=["graph_crs"])
    ... def show(path: str, graph: Said) -> None:
    ...     print(path, graph.fields["layer"])
    >>> list(signature(show).parameters)
    ['path', 'graph_layer', 'no_inner_junctions', 'max_uncompressed']
    >>> show(path="roads.gpkg", graph_layer="streets")
    roads.gpkg streets
    """

    def decorate(verb: Callable[..., None]) -> Callable[..., None]:
        shown: list[Parameter] = []
        options: dict[str, list[str]] = {}
        for parameter in _parameters(verb, unseen=groups):
            if parameter.name in groups:
                group = [option for option in _parameters(groups[parameter.name]) if option.name not in without]
                options[parameter.name] = [option.name for option in group]
                shown += [option for option in group if option.name not in {other.name for other in shown}]
            else:
                shown.append(parameter)

        @wraps(verb)
        def run(**words: Any) -> None:
            said = {
                name: groups[name](**{option: words[option] for option in names if option in words})
                for name, names in options.items()
            }
            ours = {option for names in options.values() for option in names}
            verb(**{name: value for name, value in words.items() if name not in ours}, **said)

        run.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
        run.__signature__ = Signature(shown)  # type: ignore[attr-defined]  # where inspect.signature looks first
        return run

    return decorate


def chosen_format(said: Said[Format], config: dict[str, Any] | None = None, *, where: object = None) -> Format:
    """Return the format from a TOML file, with fields replaced by those from the command line.

    Parameters
    ----------
    said
        What the command line says.
    config
        Content of the TOML file; the table of the format is taken out, so that the rest are options of the stage.
    where
        The TOML file, for messages.

    Raises
    ------
    OptionError
        If the table sets what is no field of the format, or a field makes no sense.
    """
    from probe2road.io.formats import adjusted
    from probe2road.options import options_from_table

    table, place = (config or {}).pop(said.table, {}), f"{where}: {said.table}"
    if not isinstance(table, dict):
        raise OptionError(f"{table!r} is no table", where=place, fix=f"start it with the line [{said.table}]")
    return adjusted(options_from_table(table, said.kind, where=place), **said.fields)


def read_roads(
    path: Path, said: Said[GraphFormat], *, format: GraphFormat | None = None, target_crs: Any = None
) -> RoadGraph:
    """Read a road graph; errors name the options of this graph, because a command may read several graphs.

    Parameters
    ----------
    path
        The file.
    said
        What the command line says of it.
    format
        That and what a TOML file says; without it, what the command line says.
    target_crs
        Metric CRS to work in, where the format names none.
    """
    from probe2road.io.graph_files import read_graph

    format = format or chosen_format(said)
    try:
        return read_graph(path, format=replace(format, target_crs=format.target_crs or target_crs))
    except Probe2RoadError as error:
        error.args = (spoken(str(error), said.flags),)
        raise


def read_drives(traces: Path, points: Path | None = None, *, format: FleetFormat, target_crs: Any = None) -> Fleet:
    """Read fleet data for a verb that takes a graph as well; errors name the flags of the fleet.

    Parameters
    ----------
    traces, points
        Files or folders.
    format
        What the command line and a TOML file say of them.
    target_crs
        Metric CRS to work in, in the place of the format's.
    """
    from probe2road.io.fleet_reader import read_fleet

    try:
        return read_fleet(traces, points, format=format, target_crs=target_crs)
    except Probe2RoadError as error:
        error.args = (spoken(str(error), {**FLAGS, "layer": "--traces-layer"}),)
        raise


def spoken(message: str, flags: Mapping[str, str] = FLAGS) -> str:
    """Replace the names of arguments in a message of the library by options of the command line.

    Arguments stand in messages as a Python caller writes them. Other arguments, and what only looks like one, stay.

    Examples
    --------
    >>> spoken('no CRS; say which one it is, for example crs="EPSG:32616"')
    'no CRS; say which one it is, for example --crs EPSG:32616'
    >>> spoken('say which, for example columns={"t": "gps time"} (header=False)')
    "say which, for example --columns 't=gps time' (--no-header)"
    """

    def flag(found: re.Match[str]) -> str:
        name, literal = found.groups()
        try:
            return f"{flags[name]}{_word(ast.literal_eval(literal))}"
        except (KeyError, ValueError, TypeError, SyntaxError):
            return found[0]

    return _ARGUMENT.sub(flag, message)


def four_numbers(text: str, option: str) -> tuple[float, float, float, float]:
    """Read ``left,bottom,right,top``.

    Raises
    ------
    OptionError
        If these are not four numbers.
    """
    try:
        left, bottom, right, top = (float(part) for part in text.split(","))
    except ValueError as error:
        raise OptionError(f"{text!r} is not left,bottom,right,top", where=option) from error
    return left, bottom, right, top


def _parameters(function: Callable[..., Any], *, unseen: Collection[str] = ()) -> list[Parameter]:
    """Return the parameters of a function as keyword-only, with annotations resolved except those hidden from typer.

    Unseen ones, and what the function returns, have types that are not imported before a verb runs.
    """
    texts = {name: hint for name, hint in function.__annotations__.items() if name not in {*unseen, "return"}}
    hints = get_type_hints(SimpleNamespace(__annotations__=texts), function.__globals__, include_extras=True)
    return [
        parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints.get(name, Any))
        for name, parameter in signature(function).parameters.items()
    ]


def _column_map(text: str | None, option: str) -> dict[str, str] | None:
    """Read ``ours=theirs,ours=theirs``."""
    if not text:
        return None
    pairs = [pair.partition("=") for pair in text.split(",")]
    if bad := [name for name, equals, _ in pairs if not equals]:
        raise OptionError(f"{bad[0]!r} has no =", where=option, fix="write ours=theirs, for example trace_id=trip")
    return {name.strip(): theirs.strip() for name, _, theirs in pairs}


def _word(value: Any) -> str:
    """Return a value in the form for an option, with a space before it; a switch has no value."""
    if isinstance(value, bool):
        return ""
    if isinstance(value, dict):
        value = ",".join(f"{name}={theirs}" for name, theirs in value.items())
    elif isinstance(value, tuple | list):
        value = ",".join(map(str, value))
    return f" {shlex.quote(str(value))}"
