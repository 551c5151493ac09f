"""Reading answers of Overpass in JSON, with the positions of nodes beside the ways or inside them."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.io.guard import parsing
from probe2road.io.osm_ways import OsmWays

__all__ = ["holds_osm_json", "read_json_heights", "read_json_ways"]

_HEAD = 4096  # bytes in which an answer says what it is
_ANSWER = re.compile(rb'"(osm3s|elements)"\s*:')
_NOWHERE = (np.nan, np.nan)
_DAMAGED = "cannot be read as an answer of Overpass"


def holds_osm_json(path: str | PathLike[str]) -> bool:
    """Tell whether a file ``.json`` is an answer of Overpass rather than GeoJSON, by its beginning."""
    if not str(path).lower().endswith("json"):
        return False
    with parsing(path, "cannot be read"), Path(path).open("rb") as file:
        head = file.read(_HEAD)
    return _ANSWER.search(head) is not None and b'"FeatureCollection"' not in head


def read_json_ways(path: str | PathLike[str], highways: Collection[str] | None) -> OsmWays:
    """Read the ways of some classes; see `probe2road.io.osm_ways.read_ways`.

    A way without references but with positions (``out skel geom`` of other programs) gets a node for each position.
    """
    ids, tags, counts = [], [], []
    refs: list[int] = []
    places: list[tuple[float, float]] = []
    with parsing(path, _DAMAGED):
        elements = _elements(path)
        nodes = {int(node["id"]): _position(node) for node in elements if node.get("type") == "node"}
        made: dict[tuple[float, float], int] = {}
        for way in elements:
            own = {str(key): str(value) for key, value in (way.get("tags") or {}).items()}
            if way.get("type") != "way" or "highway" not in own:
                continue
            if highways is not None and own["highway"] not in highways:
                continue
            inline = [_position(place) for place in way.get("geometry") or []]
            names = [int(name) for name in way.get("nodes") or []]
            names = names or [made.setdefault(place, -len(made) - 1) for place in inline]
            known = inline if len(inline) == len(names) else [_NOWHERE] * len(names)
            ids.append(int(way["id"]))
            tags.append(own)
            counts.append(len(names))
            refs += names
            places += [nodes.get(name, place) for name, place in zip(names, known, strict=True)]
        lon, lat = np.array(places, np.float64).reshape(-1, 2).T
        way_of_vertex = np.repeat(np.arange(len(ids)), counts)
        return OsmWays(np.array(ids, np.int64), tags, way_of_vertex, np.array(refs, np.int64), lon, lat)


def read_json_heights(path: str | PathLike[str], ways: OsmWays) -> NDArray[np.float64]:
    """Read the heights of nodes; see `probe2road.io.osm_ways.read_heights`."""
    with parsing(path, _DAMAGED):
        nodes = (node for node in _elements(path) if node.get("type") == "node")
        found = {int(node["id"]): (node.get("tags") or {}).get("ele") for node in nodes}
        text = pd.Series([found.get(ref) for ref in ways.refs.tolist()], dtype="str")
        return pd.to_numeric(text, errors="coerce").to_numpy(np.float64, na_value=np.nan)


def _elements(path: str | PathLike[str]) -> list[dict[str, Any]]:
    elements = json.loads(Path(path).read_bytes())["elements"]
    return [element for element in elements if isinstance(element, dict)]


def _position(place: Any) -> tuple[float, float]:
    """Return ``(lon, lat)``, null for a position outside the requested box."""
    if place is None or "lon" not in place:
        return _NOWHERE
    lon, lat = float(place["lon"]), float(place["lat"])
    if abs(lon) > 180 or abs(lat) > 90:
        raise ValueError(f"{lon:g}, {lat:g} is no longitude and latitude")
    return lon, lat
