"""From curves to a network: carriageways with auxiliary lanes, ramps from the outer lane, and structures.

Strategy
--------
A generator thinks in the paths that lanes follow; a network needs the middle of all lanes of a section. A carriageway
is therefore given as the middle of its through lanes, with exits and entries along it. Before an exit and behind an
entry runs an auxiliary lane on the outer side; there the section line moves outwards by half a lane, along the same
taper that `lanes` uses, so that the through lanes stay straight. A ramp is given as the path of its lane, from the
outer lane; its line starts in the node, the middle of the carriageway, and moves out along the taper likewise. At the
end, every road that crosses one of a lower level is cut around the crossing, and that piece becomes a bridge (or the
lower a tunnel). All is drawn for right-hand traffic and mirrored for left-hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import ops

from probe2road.simulation.drawn.curves import Path, Pose, along, offset_path, path_length, resample
from probe2road.simulation.lanes.lanes import fade, taper_length
from probe2road.simulation.networks.altitude import solve_heights
from probe2road.simulation.networks.network import RoadNetwork, network_from_sections
from probe2road.simulation.networks.profile import ProfileOptions
from probe2road.simulation.networks.road_classes import CLASS_DEFAULTS

__all__ = ["Gore", "Road", "carriageway", "finish", "ramp", "split_at"]

_COMMON_END = 4.0  # m; roads whose ends are this close to their crossing meet there
_ABUTMENT = 10.0  # m, from the border of the lower road to the end of the bridge


@dataclass(frozen=True)
class Road:
    """A future section of the network, with its level: the order at crossings."""

    line: Path
    highway: str
    forward: int = 1
    backward: int = 0
    speed: float | None = None  # m/s; the class decides where None
    level: int = 0
    bridge: bool = False  # a bridge over its whole length
    tunnel: bool = False
    roundabout: bool = False

    @property
    def width(self) -> float:
        """Return the width of the carriageway, metres."""
        return (self.forward + self.backward) * CLASS_DEFAULTS[self.highway].lane_width

    @property
    def speed_limit(self) -> float:
        """Return the speed limit, m/s."""
        return self.speed if self.speed is not None else CLASS_DEFAULTS[self.highway].speed_limit


@dataclass(frozen=True)
class Gore:
    """The place where a ramp leaves or joins a carriageway."""

    lane: Pose  # in the middle of the outermost lane
    inward: float  # m, from there to the left, to the node

    def lane_at(self, count: int, width: float) -> Pose:
        """Return the pose in the middle of a ramp of several lanes."""
        return self.lane.moved(0.0, -(count - 1) * width / 2.0)


def carriageway(
    path: Path,
    *,
    highway: str = "motorway",
    lanes: int = 2,
    exits: Sequence[tuple[float, float]] = (),
    entries: Sequence[tuple[float, float]] = (),
    speed: float | None = None,
    level: int = 0,
    bridge: bool = False,
) -> tuple[list[Road], list[Gore], list[Gore]]:
    """Cut a one-way carriageway into sections.

    Parameters
    ----------
    path
        The middle of its through lanes, in driving direction.
    exits, entries
        Distance along the path and length of the auxiliary lane before or behind it (m; 0 for none).

    Returns
    -------
    roads, exits, entries
        Sections in driving order; gores in the given order.
    """
    total, width = path_length(path), CLASS_DEFAULTS[highway].lane_width
    base = Road(path, highway, lanes, speed=speed, level=level, bridge=bridge)
    spans = [(max(s - aux, 0.0), s) for s, aux in exits if aux] + [
        (s, min(s + aux, total)) for s, aux in entries if aux
    ]
    at_gores = [s for s, _ in (*exits, *entries)]
    snap = _snapped([0.0, *at_gores, total, *(s for span in spans for s in span)])
    spans = [(snap[low], snap[high]) for low, high in spans]
    gores = {snap[s]: any(snap[s] in span for span in spans) for s in at_gores}
    cuts = sorted(set(snap.values()))
    roads = []
    for begin, end in pairwise(cuts):
        extra = int(any(low <= begin and end <= high for low, high in spans))
        piece = _between(path, begin, end)
        s = np.linspace(0.0, end - begin, len(piece))
        taper = taper_length(base.speed_limit, end - begin)
        at_ends = [width / 2 if gores.get(cut, False) else 0.0 for cut in (begin, end)]
        own = extra * width / 2
        shift = own + (at_ends[0] - own) * fade(s / taper) + (at_ends[1] - own) * fade((s[-1] - s) / taper)
        tangent = along(path, begin), along(path, end)
        roads.append(replace(base, line=_offset_between(piece, shift, tangent), forward=lanes + extra))
    out: list[list[Gore]] = []
    for events in (exits, entries):
        out.append([])
        for at in (snap[s] for s, _ in events):
            extra = int(gores[at])
            lateral = (lanes - 1) * width / 2 + extra * width
            out[-1].append(Gore(along(path, at, right=lateral), lateral - extra * width / 2))
    return roads, out[0], out[1]


def ramp(
    path: Path,
    start: Gore | None = None,
    end: Gore | None = None,
    *,
    highway: str = "motorway_link",
    lanes: int = 1,
    speed: float | None = None,
    level: int = 0,
) -> Road:
    """Return the ramp whose lanes follow a path from gore to gore; without a gore, the path itself ends in a node."""
    road = Road(path, highway, lanes, speed=speed, level=level)
    s = np.linspace(0.0, path_length(path), len(path))
    taper = taper_length(road.speed_limit, s[-1])
    widths = (lanes - 1) * CLASS_DEFAULTS[highway].lane_width / 2
    inward = [gore.inward - widths if gore else 0.0 for gore in (start, end)]
    shift = -inward[0] * fade(s / taper) - inward[1] * fade((s[-1] - s) / taper)
    poses = tuple(gore.lane if gore else along(path, at) for gore, at in ((start, 0.0), (end, s[-1])))
    return replace(road, line=_offset_between(path, shift, (poses[0], poses[1])))


def split_at(road: Road, distances: Sequence[float]) -> list[Road]:
    """Cut a road at distances along it (m) where others join it; its ends are ignored."""
    cuts = [0.0, *sorted(distances), path_length(road.line)]
    return [replace(road, line=_between(road.line, begin, end)) for begin, end in pairwise(cuts)]


def finish(
    roads: Sequence[Road],
    *,
    rng: np.random.Generator,
    driving_side: str,
    country: str,
    crs: str,
    heights: ProfileOptions | None = None,
) -> RoadNetwork:
    """Cut bridges and tunnels, mirror the roads for left-hand traffic, build the network, and compute its heights."""
    pieces = _structures(list(roads))
    mirror = np.array([1.0, -1.0]) if driving_side == "left" else np.array([1.0, 1.0])
    lines = [shapely.LineString(_thin(road.line) * mirror) for road in pieces]
    table = gpd.GeoDataFrame(
        {
            "highway": [road.highway for road in pieces],
            "lanes_forward": [road.forward for road in pieces],
            "lanes_backward": [road.backward for road in pieces],
            "speed_limit": [road.speed_limit for road in pieces],
            "layer": [road.level if road.bridge or road.tunnel else 0 for road in pieces],
            "bridge": [road.bridge for road in pieces],
            "tunnel": [road.tunnel for road in pieces],
            "roundabout": [road.roundabout for road in pieces],
        },
        geometry=lines,
        crs=crs,
    )
    network = network_from_sections(table, driving_side=driving_side, markings=country, snap=0.05)
    return solve_heights(network, rng=rng, options=heights)


def _structures(roads: list[Road]) -> list[Road]:
    """Cut every road around its crossings with roads of another level."""
    lines = [shapely.LineString(road.line) for road in roads]
    spans: dict[int, list[tuple[float, float]]] = {}
    for a, b in combinations(range(len(roads)), 2):
        if roads[a].level == roads[b].level or not lines[a].intersects(lines[b]):
            continue
        low, high = sorted((a, b), key=lambda i: roads[i].level)
        cut, other = (low, high) if roads[low].level < 0 else (high, low)
        if roads[cut].bridge or roads[cut].tunnel:
            continue
        ends = [shapely.Point(road.line[k]) for road in (roads[a], roads[b]) for k in (0, -1)]
        for place in shapely.get_parts(lines[a].intersection(lines[b])):
            near = [i for i, end in enumerate(ends) if place.distance(end) < _COMMON_END]
            if place.geom_type == "Point" and not (min(near, default=9) < 2 <= max(near, default=0)):
                spans.setdefault(cut, []).append(_span(lines[cut], lines[other], roads[cut], roads[other], place))
    pieces = []
    for i, road in enumerate(roads):
        pieces += _cut_structure(road, lines[i], spans[i]) if i in spans else [road]
    return pieces


def _span(
    line: shapely.LineString, other: shapely.LineString, road: Road, below: Road, place: shapely.Point
) -> tuple[float, float]:
    """Return where the structure of a road must begin and end to pass over or under another road at a crossing."""
    s, t = line.project(place), other.project(place)
    directions = []
    for curve, at in ((line, s), (other, t)):
        a, b = curve.interpolate(max(at - 3.0, 0.0)), curve.interpolate(at + 3.0)
        directions.append(np.arctan2(b.y - a.y, b.x - a.x))
    angle = directions[0] - directions[1]
    sine, cosine = max(abs(np.sin(angle)), 0.2), abs(np.cos(angle))
    reach = (below.width / 2 + road.width / 2 * cosine) / sine + _ABUTMENT
    return s - reach, s + reach


def _cut_structure(road: Road, line: shapely.LineString, spans: list[tuple[float, float]]) -> list[Road]:
    """Cut a road into open pieces and structures; those nearer than 40 m to each other, or to an end, are joined."""
    total, merged = line.length, list[list[float]]()
    for begin, end in sorted(spans):
        if merged and begin < merged[-1][1] + 40.0:
            merged[-1][1] = max(merged[-1][1], end)
        else:
            merged.append([begin, end])
    cuts = [0.0]
    flags = []
    for begin, end in merged:
        begin, end = (0.0 if begin < 20.0 else begin), (total if end > total - 20.0 else end)
        if begin > 0.0:
            cuts.append(begin)
            flags.append(False)
        cuts.append(end)
        flags.append(True)
    if cuts[-1] < total:
        cuts.append(total)
        flags.append(False)
    pieces = []
    for (begin, end), flag in zip(pairwise(cuts), flags, strict=True):
        part = shapely.get_coordinates(ops.substring(line, begin, end))
        pieces.append(replace(road, line=part, bridge=flag and road.level > 0, tunnel=flag and road.level < 0))
    return pieces


def _snapped(distances: Sequence[float]) -> dict[float, float]:
    """Map each distance to itself, or to the one before it if that is within a metre."""
    snapped: dict[float, float] = {}
    last = -np.inf
    for s in sorted(distances):
        last = s if s > last + 1.0 else last
        snapped[s] = float(last)
    return snapped


def _between(path: Path, begin: float, end: float) -> Path:
    return resample(shapely.get_coordinates(ops.substring(shapely.LineString(path), begin, end)))


def _offset_between(path: Path, right: NDArray[np.float64], ends: tuple[Pose, Pose]) -> Path:
    """Offset a path, but its ends along the normals of given poses, so that paths that meet there have the same end."""
    line = offset_path(path, right)
    for k, pose in ((0, ends[0]), (-1, ends[1])):
        normal = np.array([np.sin(pose.heading), -np.cos(pose.heading)])
        line[k] = path[k] + normal * right[k]
    return line


def _thin(line: Path) -> Path:
    """Drop vertices that a straight line approximates to within 3 cm."""
    return shapely.get_coordinates(shapely.simplify(shapely.LineString(line), 0.03))
