"""What a file holds, in figures: fleet data or a road graph."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from probe2road.crs import WGS84
from probe2road.export import READABLE, read_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_summary import describe_fleet

__all__ = ["describe_file", "describe_graph"]


def describe_file(path: str | Path, **read_options: Any) -> dict[str, Any]:
    """Describe a file of fleet data or a road graph.

    Parameters
    ----------
    path
        File or folder.
    **read_options
        Arguments of `probe2road.read_fleet`, for fleet data.

    Returns
    -------
    dict
        ``content`` (``fleet data`` or ``road graph``) and the figures of
        `probe2road.io.fleet_summary.describe_fleet` or `describe_graph`.

    Raises
    ------
    Probe2RoadError
        If the file cannot be read as either.
    """
    if _holds_graph(Path(path)):
        return {"content": "road graph", **describe_graph(read_graph(path))}
    return {"content": "fleet data", **describe_fleet(path, **read_options)}


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


def _holds_graph(path: Path) -> bool:
    """Whether a file is one of a road graph: by its suffix, and for Parquet by its columns."""
    name = path.name.lower()
    if name.endswith((".parquet", ".geoparquet")):
        import pyarrow.parquet as pq

        try:
            return {"u", "v", "key"} <= set(pq.read_schema(path).names)
        except (OSError, ValueError):
            return False  # the fleet reader says what is wrong with it
    return name.endswith(tuple(READABLE))
