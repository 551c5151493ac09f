"""Segments of Overture Maps as lines of a street map: cut at their connectors, with the tags of OpenStreetMap.

Overture draws a road past the junctions on it, and lists those as ``connectors`` with their position ``at`` along the
segment. Segments that cross without sharing a connector do not meet. What says which way a road may be driven stands in
``access_restrictions``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

__all__ = ["holds_segments", "segment_lines"]

_VEHICLES = {"vehicle", "motor_vehicle", "car"}
_OSM_RECORD = re.compile(r"w(\d+)")
_NESTED = ("connectors", "access_restrictions", "level_rules", "sources")


def holds_segments(table: pd.DataFrame) -> bool:
    """Tell whether a table has the columns of segments of Overture's theme *transportation*."""
    return {"id", "connectors", "subtype"} <= set(table)


def segment_lines(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the parts of road segments between their connectors, with plain columns.

    Parameters
    ----------
    table
        Segments, in longitude and latitude. Those that are no roads (``subtype``) are left out.

    Returns
    -------
    GeoDataFrame
        ``segment`` (the id), ``highway`` (the class), ``oneway``, ``layer`` (where one rule holds for the whole
        segment), ``osmid`` (where OpenStreetMap is its source), and the line. Connectors lie on vertices.

    Examples
    --------
    >>> road = shapely.LineString([(9, 48), (9.01, 48), (9.02, 48)])
    >>> connectors = [{"connector_id": name, "at": at} for name, at in (("a", 0.0), ("b", 0.5), ("c", 1.0))]
    >>> row = {"id": "s", "subtype": "road", "class": "primary", "connectors": connectors}
    >>> parts = segment_lines(gpd.GeoDataFrame([row], geometry=[road], crs="EPSG:4326"))
    >>> parts["highway"].tolist(), [len(line.coords) for line in parts.geometry]
    (['primary', 'primary'], [2, 2])
    """
    roads = table[(table["subtype"] == "road") & (table.geom_type == "LineString")]
    lines: list[shapely.LineString] = []
    rows: list[int] = []
    for row, (line, connectors) in enumerate(zip(roads.geometry, roads["connectors"], strict=True)):
        parts = _cut(line, [float(connector["at"]) for connector in _listed(connectors)])
        lines += parts
        rows += [row] * len(parts)
    nested = {name: roads[name] if name in roads else pd.Series(None, roads.index, dtype=object) for name in _NESTED}
    attributes = pd.DataFrame(
        {
            "segment": roads["id"].astype("str"),
            "highway": roads["class"].astype("str") if "class" in roads else None,
            "oneway": nested["access_restrictions"].map(_oneway),
            "layer": nested["level_rules"].map(_layer).astype("Int64"),
            "osmid": nested["sources"].map(_way),
        }
    )
    return gpd.GeoDataFrame(attributes.iloc[rows].reset_index(drop=True), geometry=lines, crs=table.crs)


def _cut(line: shapely.LineString, at: list[float]) -> list[shapely.LineString]:
    """Cut a line at the inner vertices nearest to positions from 0 to 1 along it."""
    places = shapely.get_coordinates(line)
    scale = np.array([np.cos(np.radians(places[:, 1].mean())), 1.0])  # so that lengths in degrees compare
    along: NDArray[np.float64] = np.concatenate([[0.0], np.cumsum(np.hypot(*(np.diff(places, axis=0) * scale).T))])
    share = along / max(along[-1], 1e-12)
    cuts = {int(np.abs(share - value).argmin()) for value in at} - {0, len(places) - 1}
    bounds = [0, *sorted(cuts), len(places) - 1]
    return [shapely.LineString(places[low : high + 1]) for low, high in pairwise(bounds)]


def _listed(values: Any) -> Iterable[dict[str, Any]]:
    """Return the entries of a nested column; none where it is missing."""
    return values if isinstance(values, list | np.ndarray) else []


def _oneway(restrictions: Any) -> str | None:
    """Return the one way open to vehicles at all times and all along, as OpenStreetMap says it; None if both are."""
    denied = set()
    for rule in _listed(restrictions):
        when = rule.get("when") or {}
        modes = when.get("mode")
        for_cars = modes is None or bool(_VEHICLES & set(modes))
        always = when.get("during") is None and rule.get("between") is None
        if rule.get("access_type") == "denied" and for_cars and always and when.get("heading"):
            denied.add(when["heading"])
    return {frozenset({"backward"}): "yes", frozenset({"forward"}): "-1"}.get(frozenset(denied))


def _layer(rules: Any) -> int | None:
    """Return the level of a segment that has one for its whole length."""
    whole = [rule for rule in _listed(rules) if rule.get("between") is None]
    return int(whole[0]["value"]) if whole and whole[0].get("value") is not None else None


def _way(sources: Any) -> str | None:
    """Return the id of the way of OpenStreetMap that a segment was made of."""
    for source in _listed(sources):
        found = _OSM_RECORD.match(str(source.get("record_id")))
        if source.get("dataset") == "OpenStreetMap" and found:
            return found[1]
    return None
