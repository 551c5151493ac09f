"""Drawings of highway corridors: a motorway of random curvature, and the roads beside and across it."""

from __future__ import annotations

import numpy as np

from probe2road.simulation.drawn.curves import Path, along, hermite, offset_path, path_length, resample, wander
from probe2road.simulation.drawn.interchanges import divided
from probe2road.simulation.drawn.roads import Road, carriageway, ramp, split_at

__all__ = ["draw_corridor"]

_RAMP = 280.0  # m along the motorway from a gore to the road beside it
_JOINT = np.radians(7.0)  # between a ramp and the road beside, so that neither bend makes them cross
_HALF_LANE = 1.825  # m
_SPACING = 900.0  # m between the places where ramps may be


def draw_corridor(rng: np.random.Generator, length: float, lanes: tuple[int, int]) -> list[Road]:
    """Draw a motorway with ramps to a frontage road or a parallel carriageway on each side, and roads across it.

    A carriageway has from ``lanes[0]`` to ``lanes[1]`` through lanes.
    """
    axis = wander(rng, length, radius=900.0)
    axis = np.asarray(axis - axis.mean(axis=0))
    gap, width = rng.uniform(9, 14), int(rng.integers(lanes[0], lanes[1] + 1))
    gap += max(width - 4, 0) * _HALF_LANE  # so that more lanes leave the strip between the carriageways as it is
    roads: list[Road] = []
    for path in divided(axis, gap=gap):
        kind = rng.choice(["frontage", "parallel", "none"], p=[0.45, 0.35, 0.2])
        roads += _side(rng, resample(path), width, str(kind))
    return roads + _across(rng, axis)


def _side(rng: np.random.Generator, path: Path, lanes: int, kind: str) -> list[Road]:
    """Draw one carriageway and the one-way road beside it, with an entry or exit ramp at every possible place."""
    if kind == "none":
        return carriageway(path, lanes=lanes)[0]
    total = path_length(path)
    places = np.arange(500.0, total - 500.0, _SPACING)
    leaves = rng.random(len(places)) < 0.5
    exits = [(float(s), 160.0) for s in places[leaves]]
    entries = [(float(s), 200.0) for s in places[~leaves]]
    roads, out, into = carriageway(path, lanes=lanes, exits=exits, entries=entries)
    away = lanes * _HALF_LANE + (rng.uniform(24, 34) if kind == "frontage" else rng.uniform(15, 19))
    highway = "secondary" if kind == "frontage" else "motorway_link"
    beside = resample(offset_path(path, away))
    line = Road(beside, highway, 2, speed=60 / 3.6 if kind == "frontage" else 80 / 3.6)
    joints = []
    for gore in out:
        s = _nearest(beside, gore.lane.x, gore.lane.y) + _RAMP
        roads.append(ramp(hermite(gore.lane, along(beside, s).turned(-_JOINT)), gore))
        joints.append(s)
    for gore in into:
        s = _nearest(beside, gore.lane.x, gore.lane.y) - _RAMP
        roads.append(ramp(hermite(along(beside, s).turned(_JOINT), gore.lane), None, gore))
        joints.append(s)
    return roads + split_at(line, joints)


def _across(rng: np.random.Generator, axis: Path) -> list[Road]:
    """Draw overpasses at random angles, with enough distance between them for their approaches."""
    total = path_length(axis)
    places = np.arange(rng.uniform(300, 700), total - 300.0, rng.uniform(900, 1400))
    roads = []
    for s in places:
        angle = np.radians(rng.uniform(25, 90)) * rng.choice([-1, 1])
        middle = along(axis, float(s))
        direction = np.array([np.cos(middle.heading + angle), np.sin(middle.heading + angle)])
        reach = 450.0
        line = resample(np.array([middle.xy - reach * direction, middle.xy + reach * direction]))
        roads.append(Road(line, str(rng.choice(["primary", "secondary"])), 1, 1, level=1))
    return _apart(roads)


def _apart(roads: list[Road]) -> list[Road]:
    """Leave out overpasses that would meet an overpass drawn before."""
    kept: list[Road] = []
    for road in roads:
        ends = [other.line[[0, -1]] for other in kept]
        if all(not _cross(road.line[[0, -1]], segment) for segment in ends):
            kept.append(road)
    return kept


def _cross(a: Path, b: Path) -> bool:
    """Tell whether two straight segments cross or come within 60 m of each other's ends."""

    def side(segment: Path, point: Path) -> float:
        (x0, y0), (x1, y1) = segment
        return float((x1 - x0) * (point[1] - y0) - (y1 - y0) * (point[0] - x0))

    crossing = side(a, b[0]) * side(a, b[1]) < 0 and side(b, a[0]) * side(b, a[1]) < 0
    near = min(float(np.hypot(*(p - q))) for p in a for q in b) < 60.0
    return crossing or near


def _nearest(path: Path, x: float, y: float) -> float:
    """Return the distance along a path at which it is nearest to a position."""
    k = int(np.hypot(path[:, 0] - x, path[:, 1] - y).argmin())
    return path_length(path) * k / (len(path) - 1)
