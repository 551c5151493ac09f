"""Differences as work for mappers: an OsmChange file for JOSM, and tasks for MapRoulette.

Nothing here changes what is on the map already: a difference knows neither the version nor all members of a way. A
road that is missing, or lies elsewhere, is a new way with ``highway=road``; all else is a new node with a ``fixme`` at
its place, which says what to look at. Both are to be checked, and the nodes removed, before an upload.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from os import PathLike
from typing import Any
from xml.etree import ElementTree as Xml

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from probe2road.crs import WGS84
from probe2road.io.atomic import atomic_path
from probe2road.io.table_writer import TABLE_SUFFIXES, require_table_suffix, write_table

__all__ = ["DIFF_SUFFIXES", "osm_change", "require_diff_suffix", "task_lines", "write_diff"]

DIFF_SUFFIXES = (*TABLE_SUFFIXES, ".osc", ".geojsons")
_NO_WORK = ("confirmed", "undriven")  # what the map has, and what nobody knows
_WAYS = ("added", "moved")
_DECIMALS = 7
_RECORD_SEPARATOR = "\x1e"  # begins every line: RFC 7464
_WORDS = {
    "added": "Drives on a road that the map lacks.",
    "moved": "The road is {distance:.0f} m from where it is mapped.",
    "suspect_closed": "Nobody drove here, though {expected:.0f} drives would be expected: closed?",
    "direction_changed": "Driven {along:.0f} times along the way and {against:.0f} times against it: oneway={oneway}?",
    "connection_added": "{count:.0f} drives turned here, but the roads are not joined.",
    "connection_missing": "The roads are joined, but of {expected:.0f} expected drives nobody turned here.",
    "level_conflict": "The roads are joined, but one passes {clearance:.1f} m over the other.",
}


def write_diff(changes: gpd.GeoDataFrame, path: str | PathLike[str]) -> None:
    """Write differences to a file, in the format of its suffix; the file is complete or absent.

    Parameters
    ----------
    changes
        From `probe2road.diff`.
    path
        ``.osc`` for JOSM, ``.geojsons`` for MapRoulette (one task a line), or a suffix of
        `probe2road.io.table_writer.write_table` for the table with all rows.

    Raises
    ------
    OptionError
        If the suffix is of another format.
    OutputError
        If the file cannot be written.
    """
    suffix = require_diff_suffix(path)
    if suffix in TABLE_SUFFIXES:
        write_table(changes, path, layer="differences")
        return
    if suffix == ".osc":
        text = osm_change(changes)
    else:
        text = "".join(f"{_RECORD_SEPARATOR}{line}\n" for line in task_lines(changes))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def require_diff_suffix(path: str | PathLike[str]) -> str:
    """Return the suffix of a path in lower case, or refuse one that `write_diff` cannot write.

    Raises
    ------
    OptionError
        If it is not.

    Examples
    --------
    >>> require_diff_suffix("todo.OSC")
    '.osc'
    """
    return require_table_suffix(path, DIFF_SUFFIXES)


def osm_change(changes: gpd.GeoDataFrame) -> str:
    """Return the proposals as an OsmChange document with new, negative ids; ways that touch share no node.

    Examples
    --------
    >>> from probe2road.comparison.diff import diff
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (200, 0)], [(200, 0), (200, 99)]]
    >>> counts = pd.DataFrame({"support": [9, 9], "forward": [9, 9]})
    >>> ours = graph_from_lines(lines, crs="EPSG:32616", attributes=counts)
    >>> document = osm_change(diff(ours, graph_from_lines(lines[:1], crs="EPSG:32616")))
    >>> document.count("<node"), document.count("<way"), 'k="highway" v="road"' in document
    (2, 1, True)
    """
    work = _work(changes)
    root = Xml.Element("osmChange", version="0.6", generator="probe2road")
    create = Xml.SubElement(root, "create")
    nodes: list[Xml.Element] = []
    ways: list[Xml.Element] = []
    for row in work.to_dict("records"):
        places = shapely.get_coordinates(row["geometry"])
        if row["change"] in _WAYS:
            first = len(nodes) + 1
            nodes += [_node(first + rank, place) for rank, place in enumerate(places)]
            way = Xml.Element("way", id=str(-len(ways) - 1), version="1")
            for rank in range(len(places)):
                Xml.SubElement(way, "nd", ref=str(-first - rank))
            tags = {"highway": "road", **({"oneway": row["oneway"]} if isinstance(row["oneway"], str) else {})}
            ways.append(_tagged(way, tags | _tags(row)))
        else:
            middle = shapely.get_coordinates(shapely.line_interpolate_point(row["geometry"], 0.5, normalized=True))[0]
            nodes.append(_tagged(_node(len(nodes) + 1, middle), _tags(row)))
    create.extend([*nodes, *ways])
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def task_lines(changes: gpd.GeoDataFrame) -> list[str]:
    """Return one line of GeoJSON for each proposal: a task of a cooperative challenge, with the change attached.

    A line is a FeatureCollection in longitude and latitude, in two dimensions, without the record separator. Its
    ``cooperativeWork`` (version 2, type 2) holds the OsmChange document of that task alone, in base64.
    """
    work = _work(changes)
    lines = []
    for position in range(len(work)):
        one = work.iloc[[position]]
        row = one.to_dict("records")[0]
        coordinates = np.round(shapely.get_coordinates(row["geometry"]), _DECIMALS).tolist()
        feature = {
            "type": "Feature",
            "properties": _properties(row),
            "geometry": {"type": "LineString", "coordinates": coordinates},
        }
        content = base64.b64encode(osm_change(one).encode()).decode()
        file = {"type": "xml", "format": "osc", "encoding": "base64", "content": content}
        task = {
            "type": "FeatureCollection",
            "features": [feature],
            "cooperativeWork": {"meta": {"version": 2, "type": 2}, "file": file},
        }
        lines.append(json.dumps(task, separators=(",", ":"), allow_nan=False))
    return lines


def _work(changes: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return what mappers have to look at, the most probable first, in degrees."""
    work = changes[~changes["change"].isin(_NO_WORK)]
    return work.sort_values("probability", ascending=False, kind="stable").to_crs(WGS84)


def _words(row: dict[str, Any]) -> str:
    return _WORDS[row["change"]].format(**{name: value for name, value in row.items() if name != "geometry"})


def _tags(row: dict[str, Any]) -> dict[str, str]:
    """Return the tags that say what to look at, and why."""
    tags = {"source": "probe2road", "fixme": _words(row)}
    tags["probe2road:change"] = row["change"]
    tags["probe2road:probability"] = f"{row['probability']:.2f}"
    if isinstance(row["osmid"], str):
        tags["probe2road:way"] = row["osmid"]
    if np.isfinite(row["support"]):
        tags["probe2road:support"] = f"{row['support']:.0f}"
    return tags


def _properties(row: dict[str, Any]) -> dict[str, Any]:
    """Return the properties of a task: the evidence that the row has, and the way that it is about."""
    evidence = {
        name: round(value, 3) if isinstance(value, float) else value
        for name, value in row.items()
        if name != "geometry" and not pd.isna(value)
    }
    named = {"@id": f"way/{row['osmid']}"} if isinstance(row["osmid"], str) else {}
    return {**named, "instruction": _words(row), **evidence}


def _node(number: int, place: Sequence[float] | np.ndarray) -> Xml.Element:
    lon, lat = (f"{value:.{_DECIMALS}f}" for value in place)
    return Xml.Element("node", id=str(-number), version="1", lat=lat, lon=lon)


def _tagged(element: Xml.Element, tags: dict[str, str]) -> Xml.Element:
    for key, value in tags.items():
        Xml.SubElement(element, "tag", k=key, v=value)
    return element
