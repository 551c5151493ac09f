"""Descriptions of files in figures: fleet data or a road graph."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from probe2road.crs import WGS84, transform
from probe2road.fleet.columns import POINT_KINDS
from probe2road.fleet.contract import Fleet, TraceGaps, trace_breaks
from probe2road.fleet.jumps import without_strays
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.formats import FleetFormat, GraphFormat
from probe2road.io.graph_files import READABLE, read_graph
from probe2road.io.layers import holds_fixes
from probe2road.io.sources import FORMATS, format_of

__all__ = ["describe_file", "describe_fleet", "describe_graph"]


def describe_file(
    path: str | Path, *, format: FleetFormat | None = None, graph_format: GraphFormat | None = None
) -> dict[str, Any]:
    """Describe a file of fleet data or a road graph.

    Parameters
    ----------
    path
        File or folder.
    format
        What the user says of the file, for fleet data.
    graph_format
        Likewise, for a road graph.

    Returns
    -------
    dict
        ``content`` (``fleet data`` or ``road graph``) and the figures of
        `probe2road.io.describe.describe_fleet` or `describe_graph`.

    Raises
    ------
    Probe2RoadError
        If the file cannot be read as either.
    """
    if _holds_graph(Path(path), format.layer if format else None):
        return {"content": "road graph", **describe_graph(read_graph(path, format=graph_format))}
    return {"content": "fleet data", **describe_fleet(path, format=format)}


def describe_graph(graph: RoadGraph) -> dict[str, Any]:
    """Describe a road graph in figures.

    Returns
    -------
    dict
        ``nodes``, ``junctions`` (degree 3 and more), ``dead_ends``, ``edges``, ``length_km``, ``edge_median``
        and ``edge_longest`` (m, None in an empty graph), ``origins`` (edges by origin), ``matched_edges``
        (with support), ``turns``, ``heights`` (whether edges have Z), ``bbox`` (left, bottom, right, top in
        degrees, None in an empty graph) and ``crs``.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> figures = describe_graph(graph_from_lines([[(446000, 4636000), (446100, 4636000)]], crs="EPSG:32616"))
    >>> figures["dead_ends"], figures["length_km"], figures["bbox"]
    (2, 0.1, [-87.650..., 41.874..., -87.649..., 41.874...])
    """
    degree, lengths = graph.degrees(), graph.edges["length"]
    empty = graph.edges.empty
    return {
        "nodes": len(graph.nodes),
        "junctions": int((degree >= 3).sum()),
        "dead_ends": int((degree == 1).sum()),
        "edges": len(graph.edges),
        "length_km": round(graph.length / 1000, 3),
        "edge_median": None if empty else round(float(lengths.median()), 1),
        "edge_longest": None if empty else round(float(lengths.max()), 1),
        "origins": {str(origin): int(count) for origin, count in graph.edges["origin"].value_counts().items()},
        "matched_edges": int(graph.edges["support"].notna().sum()),
        "turns": len(graph.turns),
        "heights": bool(graph.edges.geometry.has_z.any()),
        "bbox": None if empty else [round(float(x), 6) for x in graph.edges.to_crs(WGS84).total_bounds],
        "crs": graph.crs.name,
    }


def _holds_graph(path: Path, layer: str | None) -> bool:
    """Whether a file is one of a road graph: by its suffix, for Parquet by its columns, in GIS files by the layers."""
    name = path.name.lower()
    if name.endswith((".parquet", ".geoparquet")):
        import pyarrow.parquet as pq

        try:
            return {"u", "v", "key"} <= set(pq.read_schema(path).names)
        except (OSError, ValueError):
            return False  # the fleet reader says what is wrong with it
    if path.is_file() and path.suffix.lower() in FORMATS:
        return {"layer": not holds_fixes(path, layer)}.get(format_of(path), False)
    return name.endswith(tuple(READABLE))


def describe_fleet(
    fleet: Fleet | str | PathLike[str] | Sequence[str | PathLike[str]],
    *,
    gaps: TraceGaps | None = None,
    **read_options: Any,
) -> dict[str, Any]:
    """Describe traces and semantic points in figures; fixes that jump aside and back are left out, with a warning.

    Parameters
    ----------
    fleet
        A fleet, or what `probe2road.read_fleet` reads.
    gaps
        Where traces are broken.
    **read_options
        Further arguments of `probe2road.read_fleet`, where files are given.

    Returns
    -------
    dict
        ``traces``, ``fixes``, ``lane_marking``, ``road_boundary`` (numbers); ``start``, ``end`` (ISO times,
        None without clock); ``interval_median``, ``interval_p95`` (s), ``step_median``, ``step_p95`` (m) of
        consecutive fixes within unbroken stretches (None where there are none); ``length_km`` of these;
        ``gaps`` (breaks within traces) and ``gap_share`` (of all steps within traces); ``share_without_z``;
        ``bbox`` (left, bottom, right, top in degrees) and ``crs``.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": [0, 1, 2, 60], "x": [446e3, 446009, 446018, 446999], "y": 4636e3})
    >>> figures = describe_fleet(fleet_from_tables(table, crs="EPSG:32616"))
    >>> figures["traces"], figures["step_median"], figures["gaps"], figures["length_km"]
    (1, 9.0, 1, 0.018)
    """
    data = without_strays(fleet if isinstance(fleet, Fleet) else read_fleet(fleet, **read_options), gaps)
    table = data.traces
    first = np.zeros(len(table), bool)
    first[data.starts[:-1]] = True
    broken = trace_breaks(data, gaps)
    n_gaps, n_steps = int((broken & ~first).sum()), int((~first).sum())
    step = np.hypot(*(np.diff(table[axis].to_numpy(), prepend=np.nan) for axis in "xy"))[~broken]
    interval = table["t"].diff().dt.total_seconds().to_numpy()[~broken]
    kinds = data.points["kind"].value_counts()
    start, end = table["t"].min(), table["t"].max()
    return {
        "traces": data.n_traces,
        "fixes": len(table),
        **{kind: int(kinds[kind]) for kind in POINT_KINDS},
        "start": None if pd.isna(start) else start.isoformat(),
        "end": None if pd.isna(end) else end.isoformat(),
        "interval_median": _quantile(interval, 0.5),
        "interval_p95": _quantile(interval, 0.95),
        "step_median": _quantile(step, 0.5),
        "step_p95": _quantile(step, 0.95),
        "length_km": round(float(step.sum()) / 1000, 3),
        "gaps": n_gaps,
        "gap_share": round(n_gaps / n_steps, 6) if n_steps else 0.0,
        "share_without_z": round(float(table["z"].isna().mean()), 4) if len(table) else None,
        "bbox": _degrees(data) if len(table) else None,
        "crs": _crs_name(data),
    }


def _quantile(values: np.ndarray[Any, Any], share: float) -> float | None:
    """Return a quantile of the finite values, None where there are none."""
    finite = values[np.isfinite(values)]
    return round(float(np.quantile(finite, share)), 3) if finite.size else None


def _degrees(fleet: Fleet) -> tuple[float, ...]:
    """Return the bounding box in degrees, from the corners and edges of the metric one."""
    left, bottom, right, top = fleet.bounds
    along = np.linspace(0.0, 1.0, 11)
    x = np.concatenate([left + along * (right - left)] * 2 + [np.full(11, left), np.full(11, right)])
    y = np.concatenate([np.full(11, bottom), np.full(11, top)] + [bottom + along * (top - bottom)] * 2)
    lon, lat = transform(x, y, fleet.crs, WGS84)
    return tuple(round(float(value), 6) for value in (lon.min(), lat.min(), lon.max(), lat.max()))


def _crs_name(fleet: Fleet) -> str:
    """Return the code of the CRS where it has one, else its name."""
    authority = fleet.crs.to_authority()
    return ":".join(authority) if authority else str(fleet.crs.name)
