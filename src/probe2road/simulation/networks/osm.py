"""Reading of road networks for the simulator from OpenStreetMap files.

Ways of the wanted classes are split where they meet, one-way ways are turned into their driving direction, lanes and
speeds come from tags or from the class, and heights are solved, because OpenStreetMap has none: its ``layer`` is only
the order of roads at a crossing. Whatever is wrong in the file is repaired or left out, counted, and logged.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from probe2road.crs import WGS84, local_crs, parse_crs, require_metric, transform
from probe2road.errors import InputError, MissingFileError
from probe2road.graph.direction import DIRECTION_TAGS, tagged_direction
from probe2road.io.compressed import require_bounded
from probe2road.io.formats import GraphFormat
from probe2road.io.osm_ways import OsmWays, read_restrictions, read_ways, split_at_shared_nodes
from probe2road.simulation.networks.altitude import solve_heights
from probe2road.simulation.networks.network import NetworkReport, RoadNetwork, network_from_sections
from probe2road.simulation.networks.profile import ProfileOptions
from probe2road.simulation.networks.road_classes import CLASS_DEFAULTS

__all__ = ["DRIVABLE", "read_network"]

logger = logging.getLogger(__name__)

DRIVABLE = tuple(
    f"{kind}{link}" for kind in ("motorway", "trunk", "primary", "secondary") for link in ("", "_link")
)  # the classes that the reader takes by default

# (country, west, south, east, north, driving side) in degrees, the first that holds the data's centre wins. Boxes of
# the countries whose marking style is known; elsewhere traffic keeps right, unless a left-hand box below holds it.
_COUNTRIES = (
    ("GB", -8.7, 49.8, 1.8, 60.9, "left"),
    ("JP", 129.5, 30.0, 146.0, 45.6, "left"),
    ("PT", -9.6, 36.9, -6.2, 42.2, "right"),
    ("IT", 6.6, 36.6, 18.6, 46.2, "right"),
    ("DE", 5.8, 47.2, 15.1, 55.1, "right"),
    ("US", -125.0, 24.4, -66.9, 49.4, "right"),
)
_LEFT_HAND = (  # Ireland, Australia with New Zealand, southern Africa, India to Sri Lanka, Thailand to Indonesia
    (-10.6, 51.3, -5.3, 55.5),
    (112.0, -48.0, 179.0, -10.0),
    (11.0, -35.0, 41.0, -8.0),
    (68.0, 5.0, 89.0, 30.0),
    (95.0, -11.0, 119.0, 20.0),
)
_SPEED = re.compile(r"^\s*(\d+(?:\.\d+)?)\s*(mph|km/h|kmh|kph)?\s*$")
_SPEED_WORDS = {"none": 130 / 3.6, "walk": 7 / 3.6}  # m/s; Germany's advised speed where there is no limit
_SPEED_UNKNOWN = ("signals", "variable", "national")  # values that say: look at the class
_MAX_LANES = 12  # a carriageway has no more lanes than this


def read_network(
    path: str | Path,
    *,
    highways: Sequence[str] = DRIVABLE,
    driving_side: str | None = None,
    country: str | None = None,
    crs: Any = None,
    rng: np.random.Generator | None = None,
    heights: ProfileOptions | None = None,
) -> RoadNetwork:
    """Read the roads of an OSM file as a network with lanes and heights.

    Way nodes without a position are skipped, ways of fewer than two positions left out, tag values that make no sense
    replaced by the default of the class; all is counted in ``network.report`` and logged.

    Parameters
    ----------
    path
        An ``.osm`` or ``.osm.pbf`` file, in any form that libosmium reads.
    highways
        Highway classes to take.
    driving_side
        ``"right"`` or ``"left"``; guessed from the position where not given.
    country
        Country code of the marking style; guessed from the position, and ``"DE"`` where there is no style for it.
    crs
        Metric CRS; chosen from the extent where not given.
    rng
        Shapes the terrain; seed 0 where not given.
    heights
        Options of the height profile.

    Returns
    -------
    RoadNetwork
        Sections in file order, each with the ``osm_way`` it came from.

    Raises
    ------
    InputError
        If the file cannot be read, or holds no road of the wanted classes.

    Examples
    --------
    >>> read_network("nowhere.osm")
    Traceback (most recent call last):
        ...
    probe2road.errors.MissingFileError: nowhere.osm: no such file; check the path
    """
    if not Path(path).is_file():
        raise MissingFileError("no such file", where=path, fix="check the path")
    require_bounded(path, GraphFormat().max_uncompressed)
    found = read_ways(path, highways)
    placed = found.select_vertices(found.placed)
    ways = _usable_ways(placed)
    if not len(ways.ids):
        raise InputError(
            f"no road of class {', '.join(highways)} with two positions or more",
            where=path,
            fix="check that the extract covers the area and has complete ways",
        )
    side, land = _guess_country(float(np.median(placed.lon)), float(np.median(placed.lat)))
    target = require_metric(parse_crs(crs)) if crs is not None else local_crs(placed.lon, placed.lat)
    sections, defaulted, bad = _sections(ways, target)
    restrictions, unusable = _restrictions(read_restrictions(path), sections)
    report = NetworkReport(
        ways=len(found.ids),
        missing_nodes=len(found.refs) - len(placed.refs),
        short_ways=len(found.ids) - len(ways.ids),
        defaulted=dict(defaulted),
        bad_tags=dict(bad),
        restrictions=len(restrictions),
        bad_restrictions=unusable,
    )
    network = network_from_sections(
        sections,
        driving_side=driving_side or side,
        markings=country or land,
        restrictions=restrictions,
        report=report,
    )
    _log_report(path, network)
    return solve_heights(network, rng=rng if rng is not None else np.random.default_rng(0), options=heights)


def _usable_ways(ways: OsmWays) -> OsmWays:
    """Drop repeated vertices, then ways with fewer than two; reverse ways that run against the traffic."""
    same_way = np.diff(ways.way, prepend=-1) == 0
    same_node = np.diff(ways.refs, prepend=0) == 0
    same_place = (np.diff(ways.lon, prepend=0.0) == 0) & (np.diff(ways.lat, prepend=0.0) == 0)
    ways = ways.select_vertices(~(same_way & (same_node | same_place)))
    ways = ways.select_ways(ways.n_nodes > 1)
    against = (tagged_direction(ways.tag_table(DIRECTION_TAGS)) == -1).fillna(False).to_numpy(bool)
    place = np.arange(len(ways.refs))
    return ways.select_vertices(np.lexsort((np.where(against[ways.way], -place, place), ways.way)))


def _sections(ways: OsmWays, crs: Any) -> tuple[gpd.GeoDataFrame, Counter[str], Counter[str]]:
    """Split ways at shared nodes, and add the values of their tags."""
    parts = split_at_shared_nodes(ways)
    drawn = ways.select_vertices(parts.vertex)
    x, y = transform(drawn.lon, drawn.lat, WGS84, crs)
    lines = shapely.linestrings(np.column_stack([x, y]), indices=parts.part)
    defaulted: Counter[str] = Counter()
    bad: Counter[str] = Counter()
    directions = tagged_direction(ways.tag_table(DIRECTION_TAGS)).fillna(0).tolist()
    columns = [_columns(tags, direction, defaulted, bad) for tags, direction in zip(ways.tags, directions, strict=True)]
    way_of_section = drawn.way[parts.first]
    table = pd.DataFrame(columns).iloc[way_of_section].reset_index(drop=True)
    table = table.assign(u=drawn.refs[parts.first], v=drawn.refs[parts.last], osm_way=ways.ids[way_of_section])
    return gpd.GeoDataFrame(table, geometry=lines, crs=crs), defaulted, bad


def _columns(tags: Mapping[str, str], direction: int, defaulted: Counter[str], bad: Counter[str]) -> dict[str, Any]:
    """Return the section columns from the tags and direction of a way, and count defaults and invalid values."""
    kind = CLASS_DEFAULTS[tags["highway"]]
    forward, backward = _lanes(tags, direction, defaulted, bad)
    speed = _speed(tags, defaulted, bad)
    layer = _integer(tags, "layer", bad)
    bridge, tunnel = (tags.get(key, "no") != "no" for key in ("bridge", "tunnel"))
    if layer is None:
        layer = int(bridge) - int(tunnel)
    return {
        "highway": tags["highway"],
        "lanes_forward": forward,
        "lanes_backward": backward,
        "lane_width": kind.lane_width,
        "speed_limit": kind.speed_limit if speed is None else speed,
        "layer": layer,
        "bridge": bridge,
        "tunnel": tunnel,
        "roundabout": tags.get("junction") in ("roundabout", "circular"),
        "name": tags.get("name") or tags.get("ref") or "",
    }


def _lanes(tags: Mapping[str, str], direction: int, defaulted: Counter[str], bad: Counter[str]) -> tuple[int, int]:
    """Return the lanes in each direction; ``lanes`` of a two-way road counts both directions."""
    kind = CLASS_DEFAULTS[tags["highway"]]
    total, forward, backward = (_integer(tags, key, bad, low=1) for key in ("lanes", "lanes:forward", "lanes:backward"))
    if direction == -1:
        forward, backward = backward, forward
    if total is None and forward is None:
        defaulted["lanes"] += 1
    if direction:
        return total or forward or kind.lanes_oneway, 0
    if forward is None:
        total = total or kind.lanes_twoway
        # An odd lane belongs to neither direction in particular; the forward one gets it.
        forward = max(1, total - backward) if backward else max(1, (total + 1) // 2)
    if backward is None:
        backward = max(1, (total or kind.lanes_twoway) - forward)
    return forward, backward


def _speed(tags: Mapping[str, str], defaulted: Counter[str], bad: Counter[str]) -> float | None:
    """Return the speed limit (m/s), None if it follows from the class."""
    value = tags.get("maxspeed") or tags.get("maxspeed:forward")
    if value is None or value in _SPEED_UNKNOWN or ":" in value:
        defaulted["maxspeed"] += 1
        return None
    if value in _SPEED_WORDS:
        return _SPEED_WORDS[value]
    match = _SPEED.match(value)
    if match is None or not float(match[1]) > 0:
        bad[f"maxspeed={value}"] += 1
        return None
    return float(match[1]) * (0.44704 if match[2] == "mph" else 1 / 3.6)


def _integer(tags: Mapping[str, str], key: str, bad: Counter[str], *, low: int | None = None) -> int | None:
    """Return a whole number, None if the tag is missing or invalid (which is counted)."""
    value = tags.get(key)
    if value is None:
        return None
    if not re.fullmatch(r"\s*[+-]?\d{1,3}\s*", value) or (low is not None and not low <= int(value) <= _MAX_LANES):
        bad[f"{key}={value}"] += 1
        return None
    return int(value)


def _guess_country(lon: float, lat: float) -> tuple[str, str]:
    """Return the driving side, and the country whose marking style is used, at a position."""
    for country, west, south, east, north, side in _COUNTRIES:
        if west <= lon <= east and south <= lat <= north:
            return side, country
    left = any(west <= lon <= east and south <= lat <= north for west, south, east, north in _LEFT_HAND)
    return ("left", "GB") if left else ("right", "DE")


def _restrictions(
    relations: list[tuple[str, dict[str, list[int]]]], sections: gpd.GeoDataFrame
) -> tuple[pd.DataFrame, int]:
    """Return the forbidden turns between sections, and the number of relations that could not be used."""
    ends = pd.concat([sections[[end, "osm_way"]].rename(columns={end: "node"}) for end in ("u", "v")])
    at_node = ends.groupby("node")["osm_way"]
    rows: list[tuple[int, int, int]] = []
    unusable = 0
    for value, members in relations:
        via, origin, target = (members.get(role, []) for role in ("via_n", "from_w", "to_w"))
        known = len(via) == 1 and via[0] in at_node.groups and origin and target
        if not known or not value.startswith(("no_", "only_")):
            unusable += 1
            continue
        here = at_node.get_group(via[0])
        sources, goals = (here.index[here.isin(ways)].tolist() for ways in (origin, target))
        if value.startswith("only_"):
            goals = here.index[~here.isin([*target, *origin])].tolist() if goals else []
        unusable += not (sources and (goals or value.startswith("only_")))
        rows += [(source, via[0], goal) for source in sources for goal in goals]
    table = pd.DataFrame(rows, columns=["from_section", "via_node", "to_section"])
    return table.drop_duplicates(ignore_index=True), unusable


def _log_report(path: str | Path, network: RoadNetwork) -> None:
    report = network.report
    logger.info(
        "read %s: %d ways, %d sections, %.1f km; %d positions missing, %d ways too short, %d tag values without sense, "
        "%d turn restrictions (%d unusable)",
        Path(path).name,
        report.ways,
        len(network.sections),
        network.length / 1000,
        report.missing_nodes,
        report.short_ways,
        sum(report.bad_tags.values()),
        report.restrictions,
        report.bad_restrictions,
    )
    if report.bad_tags:
        worst = sorted(report.bad_tags.items(), key=lambda item: -item[1])[:5]
        logger.warning("replaced by class defaults: %s", ", ".join(f"{tag} ({count})" for tag, count in worst))
