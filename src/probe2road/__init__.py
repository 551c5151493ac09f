"""Routable road graphs from fleet GNSS traces and camera-detected road features.

The public verbs, in pipeline order. They are imported on first use, so that ``import probe2road`` is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0.dev0"

if TYPE_CHECKING:
    from probe2road.draw.page import view
    from probe2road.errors import Probe2RoadError
    from probe2road.fleet.contract import Fleet, TraceGaps, fleet_from_tables
    from probe2road.graph.check import check_graph
    from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
    from probe2road.io.describe import describe_fleet
    from probe2road.io.fleet_reader import read_fleet
    from probe2road.io.fleet_writer import write_fleet
    from probe2road.io.formats import FleetFormat, GraphFormat
    from probe2road.io.graph_files import read_graph, write_graph
    from probe2road.io.graph_networkx import from_networkx, to_networkx
    from probe2road.matching.labels import label
    from probe2road.matching.match import Matches, MatchOptions, match
    from probe2road.metrics.evaluate import evaluate
    from probe2road.raster.counts import rasterize
    from probe2road.recipe import BuildOptions, build
    from probe2road.refinement.recipe import refine
    from probe2road.segmentation.options import SegmentationOptions

_HOME = {
    "Probe2RoadError": "errors",
    "Fleet": "fleet.contract",
    "TraceGaps": "fleet.contract",
    "fleet_from_tables": "fleet.contract",
    "read_fleet": "io.fleet_reader",
    "write_fleet": "io.fleet_writer",
    "FleetFormat": "io.formats",
    "GraphFormat": "io.formats",
    "describe_fleet": "io.describe",
    "RoadGraph": "graph.roadgraph",
    "check_graph": "graph.check",
    "graph_from_lines": "graph.roadgraph",
    "read_graph": "io.graph_files",
    "write_graph": "io.graph_files",
    "to_networkx": "io.graph_networkx",
    "from_networkx": "io.graph_networkx",
    "rasterize": "raster.counts",
    "MatchOptions": "matching.match",
    "Matches": "matching.match",
    "match": "matching.match",
    "refine": "refinement.recipe",
    "label": "matching.labels",
    "BuildOptions": "recipe",
    "SegmentationOptions": "segmentation.options",
    "build": "recipe",
    "evaluate": "metrics.evaluate",
    "view": "draw.page",
}

__all__ = [
    "BuildOptions",
    "Fleet",
    "FleetFormat",
    "GraphFormat",
    "MatchOptions",
    "Matches",
    "Probe2RoadError",
    "RoadGraph",
    "SegmentationOptions",
    "TraceGaps",
    "__version__",
    "build",
    "check_graph",
    "describe_fleet",
    "evaluate",
    "fleet_from_tables",
    "from_networkx",
    "graph_from_lines",
    "label",
    "match",
    "rasterize",
    "read_fleet",
    "read_graph",
    "refine",
    "to_networkx",
    "view",
    "write_fleet",
    "write_graph",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(f"probe2road.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'probe2road' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
