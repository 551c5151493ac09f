"""Reading of OpenStreetMap files: extracts as reference graphs, and what `probe2road.io.osm_writer` wrote."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import replace
from os import PathLike
from typing import Any

import geopandas as gpd
import numpy as np
import osmium
import pandas as pd
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import WGS84, parse_crs, transform, working_crs
from probe2road.errors import InputError
from probe2road.graph.direction import (
    DIRECTION_TAGS,
    ONEWAY_TAGS,
    in_driving_direction,
    tagged_direction,
    told_direction,
)
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.io.graph_tables import OWN_COLUMNS, graph_from_edge_table, typed_column
from probe2road.io.guard import parsing
from probe2road.io.osm_json import holds_osm_json, read_json_heights, read_json_ways
from probe2road.io.osm_ways import OsmWays, osm_errors, placed_parts, read_heights, read_ways, split_at_shared_nodes
from probe2road.io.osm_writer import GENERATOR, KEPT_TAGS, PREFIX

__all__ = ["DRIVABLE", "read_osm"]

logger = logging.getLogger(__name__)

_CLASSES = ("motorway", "trunk", "primary", "secondary", "tertiary")
DRIVABLE = frozenset(
    [
        *_CLASSES,
        *(f"{name}_link" for name in _CLASSES),
        "unclassified",
        "residential",
        "living_street",
        "service",
        "road",
    ]
)  # values of the highway tag that cars drive on


def read_osm(
    path: str | PathLike[str], *, target_crs: Any = None, highways: Collection[str] | None = DRIVABLE
) -> RoadGraph:
    """Read the roads of an OSM extract (``.osm``, ``.osm.pbf`` and other formats of osmium).

    Ways are split where they share a node, so that a bridge stays apart from the road below. Of a way that an extract
    cuts, the parts inside are kept; what an editor has marked for deletion is gone. Positions may stand at the nodes or
    at the ways (``out geom`` of Overpass), in XML, PBF or Overpass JSON. A file written
    by `probe2road.io.osm_writer.write_osm` comes back as the graph it was, to the 1 cm of the format.

    Parameters
    ----------
    path
        The file.
    target_crs
        Metric CRS to work in; otherwise the recorded one, or a local one.
    highways
        Values of the ``highway`` tag to keep; None keeps every way that has one. Files written by us are
        read whole.

    Returns
    -------
    RoadGraph
        With the tags ``highway``, ``oneway``, ``layer``, ``bridge``, ``tunnel``, ``lanes``, ``name`` and the
        way's id ``osmid`` as columns. ``oneway`` is filled in for roundabouts and motorways, which imply it. Parts
        of a way that is driven against its course (``oneway=-1``) are turned, and say ``yes``.

    Raises
    ------
    InputError
        If the file is damaged or holds no road of these classes.
    """
    json = holds_osm_json(path)
    recorded = None if json else _recorded_crs(path)
    read = read_json_ways if json else read_ways
    ways = _usable(read(path, None if recorded is not None else highways))
    if recorded is None and not len(ways.ids):
        classes = "any highway tag" if highways is None else f"highway = {', '.join(sorted(highways))}"
        raise InputError(f"holds no way with {classes}", where=path, fix="check the extract, or choose other classes")
    if recorded is None:
        ways = _inside(ways, path)
    placed = ways.placed
    target = working_crs(
        WGS84,
        ways.lon[placed],
        ways.lat[placed],
        target_crs=target_crs or recorded,
        own=recorded is not None,
        where=path,
    )
    if recorded is not None:
        return _restored(ways, target, path)
    return _split_at_junctions(ways, target, path)


def _inside(ways: OsmWays, path: str | PathLike[str]) -> OsmWays:
    """Keep the parts of ways whose nodes are in the file."""
    beyond = np.unique(ways.way[~ways.placed])
    parts = placed_parts(ways)
    if not len(parts.ids):
        fix = "make the extract with complete ways, or with positions (out geom; osmium add-locations-to-ways)"
        raise InputError("no way has its nodes in the file", where=path, fix=fix)
    if len(beyond):
        left = len(beyond) - np.isin(ways.ids[beyond], parts.ids).sum()
        logger.warning(
            "%s: %d ways reach beyond the extract; the parts inside are kept, %d have none", path, len(beyond), left
        )
    return parts


def _recorded_crs(path: str | PathLike[str]) -> CRS | None:
    """Return the metric CRS in the header of our own file, None for other files."""
    with osm_errors(path), osmium.io.Reader(str(path), osmium.osm.osm_entity_bits.NOTHING) as reader:
        generator = reader.header().get("generator")
    return parse_crs(generator.removeprefix(GENERATOR), where=path) if generator.startswith(GENERATOR) else None


def _usable(ways: OsmWays) -> OsmWays:
    """Drop nodes that a way names twice in a row, then areas and ways with fewer than two nodes."""
    repeated = (np.diff(ways.refs, prepend=0) == 0) & (np.diff(ways.way, prepend=-1) == 0)
    ways = ways.select_vertices(~repeated)
    area = np.array([tags.get("area") == "yes" for tags in ways.tags], bool)
    return ways.select_ways(~area & (ways.n_nodes > 1))


def _lines(ways: OsmWays, path: str | PathLike[str], owner: NDArray[np.int64], crs: CRS) -> NDArray[Any]:
    """Make lines from vertices, in three dimensions if every node of the line has a height."""
    x, y = transform(ways.lon, ways.lat, WGS84, crs)
    heights = (read_json_heights if holds_osm_json(path) else read_heights)(path, ways)
    if not (np.isfinite(x) & np.isfinite(y)).all():
        raise InputError(f"positions cannot be projected to {crs.name}", where=path, fix="name another target_crs")
    lines = shapely.linestrings(np.column_stack([x, y, heights]), indices=owner)
    in_plan = np.zeros(len(lines), bool)
    in_plan[owner[np.isnan(heights)]] = True
    return np.where(in_plan, shapely.force_2d(lines), lines)


def _split_at_junctions(ways: OsmWays, target: CRS, path: str | PathLike[str]) -> RoadGraph:
    """Cut ways at the nodes they share."""
    parts = split_at_shared_nodes(ways)
    lines = _lines(ways.select_vertices(parts.vertex), path, parts.part, target)
    tags = ways.tag_table([*KEPT_TAGS, *DIRECTION_TAGS])
    kept = tags.reindex(columns=KEPT_TAGS).assign(oneway=_oneway(tags))
    kept.insert(0, "osmid", ways.ids)
    attributes = kept.iloc[ways.way[parts.vertex[parts.first]]]
    graph = graph_from_lines(lines, crs=target, origin="reference", snap=1e-6, attributes=attributes)
    logger.info("%s: %d ways became %s", path, len(ways.ids), graph)
    return replace(graph, edges=in_driving_direction(graph.edges))


def _oneway(tags: pd.DataFrame) -> pd.Series:
    """Return the oneway tag; without one, "yes" if the class or the junction implies it."""
    tag = tags.get("oneway", pd.Series(np.nan, tags.index, dtype="str"))
    return tag.mask(told_direction(tag).isna() & tagged_direction(tags).notna(), ONEWAY_TAGS[1])


def _restored(ways: OsmWays, target: CRS, path: str | PathLike[str]) -> RoadGraph:
    """Return the graph that `probe2road.io.osm_writer.write_osm` wrote."""
    if not ways.placed.all():
        raise InputError("some nodes of its ways are missing", where=path, fix="write it again")
    lines = _lines(ways, path, ways.way, target)
    keys = dict.fromkeys(key for tags in ways.tags for key in tags if key.startswith(PREFIX))
    ours = ways.tag_table(keys).rename(columns=lambda name: name.removeprefix(PREFIX))
    with parsing(path, "the tags of its ways are damaged", fix="write it again"):
        table = gpd.GeoDataFrame(ours.apply(typed_column), geometry=lines, crs=target)
    if not set(OWN_COLUMNS) <= set(table):
        table = table.reindex(columns=[*OWN_COLUMNS, "geometry"])
    return graph_from_edge_table(table, where=path)
