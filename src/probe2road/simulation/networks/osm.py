"""Read a road network for the simulator from an OpenStreetMap file.

Ways of the wanted classes are split where they meet, one-way ways are turned into their driving direction, lanes and
speeds come from tags or from the class, and heights are solved, because OpenStreetMap has none: its ``layer`` is only
the order of roads at a crossing. Whatever is wrong in the file is repaired or left out, counted, and logged.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import osmium
import pandas as pd
import shapely

from probe2road.crs import WGS84, local_crs, parse_crs, require_metric, transform
from probe2road.errors import InputError, MissingFileError
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
_TRUE = ("yes", "true", "1")


@dataclass
class _Extract:
    """The parts of an OSM file that matter, as they were read."""

    way_ids: list[int] = field(default_factory=list)
    refs: list[list[int]] = field(default_factory=list)  # node ids of each way
    tags: list[dict[str, str]] = field(default_factory=list)
    positions: dict[int, tuple[float, float]] = field(default_factory=dict)  # node id to (lon, lat)
    restrictions: list[tuple[str, dict[str, list[int]]]] = field(default_factory=list)  # value, role to members


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
    extract = _read_extract(Path(path), tuple(highways))
    lon, lat = np.array(
        [extract.positions[ref] for refs in extract.refs for ref in refs if ref in extract.positions]
        or np.zeros((0, 2))
    ).T
    ways, counts = _usable_ways(extract)
    if not ways:
        raise InputError(
            f"no road of class {', '.join(highways)} with two positions or more",
            where=path,
            fix="check that the extract covers the area and has complete ways",
        )
    side, land = _guess_country(float(np.median(lon)), float(np.median(lat)))
    target = require_metric(parse_crs(crs)) if crs is not None else local_crs(lon, lat)
    sections, defaulted, bad = _sections(extract, ways, target)
    restrictions, unusable = _restrictions(extract, sections)
    report = NetworkReport(
        ways=len(extract.way_ids),
        missing_nodes=counts["missing"],
        short_ways=counts["short"],
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


def _read_extract(path: Path, highways: tuple[str, ...]) -> _Extract:
    """Read ways of the wanted classes, positions, and turn restrictions."""
    if not path.is_file():
        raise MissingFileError("no such file", where=path, fix="check the path")
    extract, wanted = _Extract(), set(highways)
    try:
        for item in osmium.FileProcessor(str(path)):
            _take(item, extract, wanted)
    except RuntimeError as error:  # what libosmium raises on malformed files
        raise InputError(
            f"cannot be read as OSM data ({error})", where=path, fix="check that the file is complete"
        ) from error
    return extract


def _take(item: Any, extract: _Extract, wanted: set[str]) -> None:
    """Add one OSM object to the extract."""
    if item.is_node():
        if item.location.valid():
            extract.positions[item.id] = (item.location.lon, item.location.lat)
    elif item.is_way():
        if item.tags.get("highway") in wanted:
            extract.way_ids.append(item.id)
            extract.refs.append([node.ref for node in item.nodes])
            extract.tags.append({tag.k: tag.v for tag in item.tags})
    elif item.is_relation() and item.tags.get("type") == "restriction":
        members: dict[str, list[int]] = {}
        for member in item.members:
            members.setdefault(f"{member.role}_{member.type}", []).append(member.ref)
        extract.restrictions.append((item.tags.get("restriction", ""), members))


def _usable_ways(extract: _Extract) -> tuple[list[tuple[int, list[int]]], Counter[str]]:
    """Return (row, node ids with a position) of each way with two or more, and count what was left out."""
    counts: Counter[str] = Counter()
    ways = []
    for row, refs in enumerate(extract.refs):
        known = [ref for ref in refs if ref in extract.positions]
        counts["missing"] += len(refs) - len(known)
        places = [extract.positions[ref] for ref in known]
        known = [ref for i, ref in enumerate(known) if i == 0 or (ref != known[i - 1] and places[i] != places[i - 1])]
        if len(known) < 2:
            counts["short"] += 1
            continue
        if _oneway(extract.tags[row]) == -1:
            known.reverse()
        ways.append((row, known))
    return ways, counts


def _sections(
    extract: _Extract, ways: list[tuple[int, list[int]]], crs: Any
) -> tuple[gpd.GeoDataFrame, Counter[str], Counter[str]]:
    """Split ways at shared nodes and attach what their tags say."""
    row = np.repeat([way for way, _ in ways], [len(refs) for _, refs in ways])
    ref = np.array([node for _, refs in ways for node in refs], dtype=np.int64)
    lonlat = np.array([extract.positions[node] for node in ref.tolist()])
    x, y = transform(lonlat[:, 0], lonlat[:, 1], WGS84, crs)
    first = np.flatnonzero(np.diff(np.repeat(np.arange(len(ways)), [len(refs) for _, refs in ways]), prepend=-1))
    last = np.append(first[1:], len(ref)) - 1
    _, code, uses = np.unique(ref, return_inverse=True, return_counts=True)
    cut = uses[code] > 1
    cut[first], cut[last] = True, True
    # A vertex that is cut inside a way ends one section and starts the next: it appears twice.
    inner = cut.copy()
    inner[first], inner[last] = False, False
    index = np.repeat(np.arange(len(ref)), 1 + inner)
    starts = np.zeros(len(index), dtype=bool)
    starts[np.searchsorted(index, first)] = True
    starts[np.flatnonzero(np.diff(index) == 0) + 1] = True
    section = np.cumsum(starts) - 1
    lines = shapely.linestrings(np.column_stack([x, y])[index], indices=section)
    head = np.flatnonzero(starts)
    tail = np.append(head[1:], len(index)) - 1
    defaulted: Counter[str] = Counter()
    bad: Counter[str] = Counter()
    columns = {way: _columns(extract.tags[way], defaulted, bad) for way, _ in ways}
    table = pd.DataFrame([columns[way] for way in row[index[head]].tolist()])
    table = table.assign(u=ref[index[head]], v=ref[index[tail]], osm_way=np.array(extract.way_ids)[row[index[head]]])
    return gpd.GeoDataFrame(table, geometry=lines, crs=crs), defaulted, bad


def _columns(tags: Mapping[str, str], defaulted: Counter[str], bad: Counter[str]) -> dict[str, Any]:
    """Return the section columns that the tags of one way give; count defaults and nonsense."""
    kind = CLASS_DEFAULTS[tags["highway"]]
    one_way = _oneway(tags) != 0
    forward, backward = _lanes(tags, one_way, defaulted, bad)
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


def _oneway(tags: Mapping[str, str]) -> int:
    """Return 1 where one-way as drawn, -1 where against it, 0 where two-way."""
    value = tags.get("oneway", "")
    if value in ("-1", "reverse"):
        return -1
    implied = tags["highway"] in ("motorway", "motorway_link") or tags.get("junction") in ("roundabout", "circular")
    return int(value in _TRUE or (implied and value not in ("no", "false", "0")))


def _lanes(tags: Mapping[str, str], one_way: bool, defaulted: Counter[str], bad: Counter[str]) -> tuple[int, int]:
    """Return the lanes in each direction; ``lanes`` counts both directions of a two-way road."""
    kind = CLASS_DEFAULTS[tags["highway"]]
    total, forward, backward = (_integer(tags, key, bad, low=1) for key in ("lanes", "lanes:forward", "lanes:backward"))
    if _oneway(tags) == -1:
        forward, backward = backward, forward
    if total is None and forward is None:
        defaulted["lanes"] += 1
    if one_way:
        return total or forward or kind.lanes_oneway, 0
    if forward is None:
        total = total or kind.lanes_twoway
        # An odd lane belongs to neither direction in particular; the forward one gets it.
        forward = max(1, total - backward) if backward else max(1, (total + 1) // 2)
    if backward is None:
        backward = max(1, (total or kind.lanes_twoway) - forward)
    return forward, backward


def _speed(tags: Mapping[str, str], defaulted: Counter[str], bad: Counter[str]) -> float | None:
    """Return the speed limit (m/s), None where the class decides."""
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
    """Return a whole number, None where the tag is absent or makes no sense (counted)."""
    value = tags.get(key)
    if value is None:
        return None
    if not re.fullmatch(r"\s*[+-]?\d{1,3}\s*", value) or (low is not None and not low <= int(value) <= _MAX_LANES):
        bad[f"{key}={value}"] += 1
        return None
    return int(value)


def _guess_country(lon: float, lat: float) -> tuple[str, str]:
    """Return (driving side, country of the marking style) at a position."""
    for country, west, south, east, north, side in _COUNTRIES:
        if west <= lon <= east and south <= lat <= north:
            return side, country
    left = any(west <= lon <= east and south <= lat <= north for west, south, east, north in _LEFT_HAND)
    return ("left", "GB") if left else ("right", "DE")


def _restrictions(extract: _Extract, sections: gpd.GeoDataFrame) -> tuple[pd.DataFrame, int]:
    """Return the forbidden turns between sections, and the number of relations that could not be used."""
    ends = pd.concat([sections[[end, "osm_way"]].rename(columns={end: "node"}) for end in ("u", "v")])
    at_node = ends.groupby("node")["osm_way"]
    rows: list[tuple[int, int, int]] = []
    unusable = 0
    for value, members in extract.restrictions:
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
