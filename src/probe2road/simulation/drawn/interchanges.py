"""Drawings of interchanges: the roads of each kind, for right-hand traffic, around the origin.

Each function draws one kind with random sizes. The motorway runs west to east; ``eastbound`` is its southern
carriageway. Ramps leave and join the outer lane tangentially; radii: loops 45 m to 60 m, direct ramps 130 m and more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from probe2road.simulation.drawn.curves import (
    Path,
    Pose,
    along,
    dubins,
    hermite,
    offset_path,
    path_length,
    polyline,
    resample,
)
from probe2road.simulation.drawn.roads import Gore, Road, carriageway, ramp, split_at
from probe2road.simulation.networks.road_classes import CLASS_DEFAULTS

__all__ = ["DRAWINGS", "divided", "draw_overpass"]

Drawing = Callable[[np.random.Generator], list[Road]]

_LOOP_SPEED = 40 / 3.6  # m/s
_FAST_RAMP = 70 / 3.6  # m/s
_LINK = CLASS_DEFAULTS["motorway_link"].lane_width


def divided(axis: Path, *, gap: float) -> tuple[Path, Path]:
    """Return the two carriageways of a road along an axis, the right one first, each in driving direction.

    Parameters
    ----------
    gap
        From the axis to the middle of a carriageway (m).
    """
    return offset_path(axis, gap), offset_path(axis, -gap)[::-1]


def _turned(path: Path, quarter: int) -> Path:
    """Rotate a path about the origin by quarters of a circle, counterclockwise."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter % 4]
    return np.asarray(path @ np.array([[c, s], [-s, c]], dtype=float))


def _diamond(rng: np.random.Generator) -> list[Road]:
    half, gap, lanes = 900.0, rng.uniform(9, 14), int(rng.integers(2, 4))
    angle = np.radians(rng.uniform(70, 110))
    away = rng.uniform(70, 110)  # m, from the motorway's axis to the ramp terminals
    over = bool(rng.random() < 0.6)
    east, west = divided(polyline((-half, 0), (half, 0)), gap=gap)
    c, s = np.cos(angle), np.sin(angle)
    crossing = Road(polyline((-600 * c, -600 * s), (600 * c, 600 * s)), "primary", 2, 2, level=1 if over else -1)
    roads = split_at(crossing, [600.0 - away, 600.0 + away])
    reach = rng.uniform(300, 360)
    for path, side in ((east, -1.0), (west, 1.0)):
        terminal = np.array([c, s]) * away * side
        pieces, exits, entries = carriageway(
            path, lanes=lanes, exits=[(half - reach, 180.0)], entries=[(half + reach, 220.0)]
        )
        # Ramps meet the crossing road squarely.
        facing = Pose(float(terminal[0]), float(terminal[1]), angle + side * np.pi / 2)
        roads += pieces
        roads.append(ramp(hermite(exits[0].lane, facing), exits[0]))
        roads.append(ramp(hermite(facing, entries[0].lane), None, entries[0]))
    return roads if over else [_raised(road) for road in roads]


def _raised(road: Road) -> Road:
    """Raise all levels by one, so that a road at level -1 becomes the ground and the other roads bridge over it."""
    return Road(
        road.line, road.highway, road.forward, road.backward, road.speed, road.level + 1, road.bridge, road.tunnel
    )


def _cloverleaf(rng: np.random.Generator) -> list[Road]:
    half, gap, radius = 1100.0, rng.uniform(10, 14), rng.uniform(45, 58)
    lanes = int(rng.integers(2, 4))
    outer = rng.uniform(430, 500)
    lateral = gap + (lanes - 1) * 1.825 + 3.65  # of the auxiliary lane
    loop = lateral + radius + rng.uniform(0, 15)
    roads: list[Road] = []
    exits: list[list[Gore]] = []
    entries: list[list[Gore]] = []
    for quarter in range(4):  # eastbound, northbound, westbound, southbound
        path = _turned(divided(polyline((-half, 0), (half, 0)), gap=gap)[0], quarter)
        pieces, out, into = carriageway(
            path,
            lanes=lanes,
            level=quarter % 2,
            exits=[(half - outer, 200.0), (half + loop, 2 * loop)],
            entries=[(half - loop, 2 * loop), (half + outer, 250.0)],
        )
        roads += pieces
        exits.append(out)
        entries.append(into)
    for quarter in range(4):
        left, right = (quarter + 1) % 4, (quarter + 3) % 4
        path = dubins(exits[quarter][1].lane, entries[left][0].lane, radius=radius, word="RR")
        roads.append(ramp(path, exits[quarter][1], entries[left][0], speed=_LOOP_SPEED))
        path = hermite(exits[quarter][0].lane, entries[right][1].lane)
        roads.append(ramp(path, exits[quarter][0], entries[right][1], speed=_FAST_RAMP))
    return roads


def _stack(rng: np.random.Generator) -> list[Road]:
    half, gap, radius = 1700.0, rng.uniform(10, 13), rng.uniform(160, 190)
    far, beside = rng.uniform(740, 820), rng.uniform(15, 18)  # m, beside: from the outer lane to the left-turn ramp
    outer = far + 260.0
    roads: list[Road] = []
    exits: list[list[Gore]] = []
    entries: list[list[Gore]] = []
    for quarter in range(4):
        path = _turned(divided(polyline((-half, 0), (half, 0)), gap=gap)[0], quarter)
        pieces, out, into = carriageway(
            path,
            lanes=3,
            level=quarter % 2,
            exits=[(half - outer, 200.0), (half - far, 180.0)],
            entries=[(half + far, 180.0), (half + outer, 250.0)],
        )
        roads += pieces
        exits.append(out)
        entries.append(into)
    for quarter in range(4):
        left, right = (quarter + 1) % 4, (quarter + 3) % 4
        leave, join = exits[quarter][1], entries[left][0]
        a, b = leave.lane.moved(200.0, beside), join.lane.moved(-200.0, beside)
        # Straight on beside the motorway, once around the corner where both directions meet, straight on again.
        c, s = np.cos(a.heading), np.sin(a.heading)
        ahead = (b.x - a.x) * c + (b.y - a.y) * s
        turn = dubins(a.moved(ahead - radius), b.moved(radius - ahead), radius=radius, word="LL")
        path = np.concatenate([hermite(leave.lane, a), turn, hermite(b, join.lane)])
        roads.append(ramp(_joined(path), leave, join, speed=_FAST_RAMP, level=2 + quarter % 2))
        path = hermite(exits[quarter][0].lane, entries[right][1].lane)
        roads.append(ramp(path, exits[quarter][0], entries[right][1], speed=_FAST_RAMP))
    return roads


def _joined(path: Path) -> Path:
    """Drop repeated points of a path, and resample it."""
    step = np.hypot(*np.diff(path, axis=0).T)
    return resample(path[np.concatenate([[True], step > 1e-6])])


def _trumpet(rng: np.random.Generator) -> list[Road]:
    half, gap, radius = 1000.0, rng.uniform(9, 12), rng.uniform(48, 60)
    stem, south = rng.uniform(9, 12), 800.0
    lateral = gap + 1.825 + 3.65
    loop_x = -stem - radius  # centre of the loop
    top = lateral + radius
    east, west = divided(polyline((-half, 0), (half, 0)), gap=gap)
    roads, e_exit, e_entry = carriageway(east, exits=[(half - 330.0, 180.0)], entries=[(half + 330.0, 220.0)])
    w_roads, w_exit, w_entry = carriageway(
        west, exits=[(half - loop_x, 180.0)], entries=[(half - loop_x + 420.0, 220.0)]
    )
    n_roads, n_exit, _ = carriageway(
        polyline((stem, -south), (stem, top)), exits=[(south - 330.0, 180.0)], level=1, speed=80 / 3.6
    )
    s_roads, _, s_entry = carriageway(
        polyline((-stem, top), (-stem, -south)), entries=[(top + 330.0, 220.0)], level=1, speed=80 / 3.6
    )
    roads += w_roads + n_roads + s_roads
    roads.append(ramp(hermite(e_exit[0].lane, s_entry[0].lane), e_exit[0], s_entry[0]))
    roads.append(ramp(hermite(n_exit[0].lane, e_entry[0].lane), n_exit[0], e_entry[0]))
    # Westbound to south: three quarters of a circle; north to westbound: around the outside of it.
    loop = dubins(w_exit[0].lane, Pose(-stem, top, -np.pi / 2), radius=radius, word="RR")
    roads.append(ramp(loop, w_exit[0], speed=_LOOP_SPEED))
    around = dubins(Pose(stem, top, np.pi / 2), w_entry[0].lane, radius=radius + 2 * stem, word="LR")
    roads.append(ramp(around, None, w_entry[0], lanes=1, speed=50 / 3.6))
    return roads


def draw_overpass(rng: np.random.Generator, angle: float | None = None) -> list[Road]:
    """Draw a road over a motorway at an angle (degrees), without ramps."""
    degrees = angle if angle is not None else rng.uniform(15, 90)
    turn, gap, half = np.radians(degrees) * rng.choice([-1, 1]), rng.uniform(9, 13), 700.0
    axis = polyline((-half, 0), (half, 0))
    east, west = divided(axis, gap=gap)
    lanes = int(rng.integers(2, 4))
    roads = carriageway(east, lanes=lanes)[0] + carriageway(west, lanes=lanes)[0]
    over = polyline((-half * np.cos(turn), -half * np.sin(turn)), (half * np.cos(turn), half * np.sin(turn)))
    if rng.random() < 0.4:
        first, second = divided(over, gap=gap)
        return roads + carriageway(first, level=1)[0] + carriageway(second, level=1)[0]
    return [*roads, Road(over, "secondary", 1, 1, level=1)]


def _double_deck(rng: np.random.Generator) -> list[Road]:
    half, gap, bend = 1000.0, rng.uniform(7.5, 8.5), rng.uniform(900, 1500) * rng.choice([-1, 1])
    s = np.linspace(-half, half, 1001)
    axis = np.column_stack([bend * np.sin(s / bend), bend * (1 - np.cos(s / bend))])
    right, left = divided(axis, gap=gap)
    # The upper deck is a little longer and half a metre aside, so that no node of one lies above a node of the other.
    total = path_length(right)
    roads, lower_exit, _ = carriageway(right, highway="trunk", exits=[(total * 0.25, 120.0)])
    roads += carriageway(left, highway="trunk")[0]
    s = np.linspace(-half - 25.0, half + 25.0, 1026)
    upper_axis = np.column_stack([bend * np.sin(s / bend), bend * (1 - np.cos(s / bend))])
    upper, back = divided(upper_axis, gap=gap + 0.5)
    pieces, _, upper_entry = carriageway(upper, entries=[(25.0 + total * 0.55, 220.0)], level=1, bridge=True)
    roads += pieces + carriageway(back, level=1, bridge=True)[0]
    # A ramp climbs beside the lower deck and joins the upper.
    leave, join = lower_exit[0], upper_entry[0]
    beside = offset_path(right, leave.inward + 14.0)
    a, b = along(beside, total * 0.25 + 130.0), along(beside, total * 0.55 - 130.0)
    middle = hermite(a, b)
    path = np.concatenate([hermite(leave.lane, a), middle, hermite(b, join.lane)])
    return [*roads, ramp(_joined(path), leave, join, speed=_FAST_RAMP, level=0)]


def _merge_beside_bridge(rng: np.random.Generator) -> list[Road]:
    half, gap = 800.0, rng.uniform(9, 13)
    at = rng.uniform(15, 50)  # m, from the bridge to the merge
    turn = np.radians(rng.uniform(60, 120))
    east, west = divided(polyline((-half, 0), (half, 0)), gap=gap)
    before = bool(rng.random() < 0.5)
    merge = half - at - 20.0 if before else half + at
    roads, _, entries = carriageway(east, entries=[(merge, 220.0)])
    start = Pose(merge - half - 520.0, -rng.uniform(50, 80), 0.0)
    middle = entries[0].lane.moved(-130.0, 12.0)
    path = np.concatenate([hermite(start, middle), hermite(middle, entries[0].lane)])
    roads.append(ramp(_joined(path), None, entries[0], speed=_FAST_RAMP))
    roads += carriageway(west)[0]
    c, s = np.cos(turn), np.sin(turn)
    return [*roads, Road(polyline((-600 * c, -600 * s), (600 * c, 600 * s)), "primary", 1, 1, level=1)]


def _tunnel_under_junction(rng: np.random.Generator) -> list[Road]:
    half, gap = 900.0, rng.uniform(5.5, 6.5)
    side = gap + rng.uniform(7.5, 9.0)  # m, from the axis to the surface carriageways
    reach = rng.uniform(330, 400)
    roads: list[Road] = []
    corner = 600.0 - side
    cross = Road(polyline((0, -600), (0, 600)), "primary", 2, 2)
    roads += split_at(cross, [corner, corner + 2 * side])
    for quarter in (0, 2):
        path = _turned(divided(polyline((-half, 0), (half, 0)), gap=gap)[0], quarter)
        pieces, exits, entries = carriageway(
            path,
            highway="trunk",
            exits=[(half - reach, 120.0)],
            entries=[(half + reach, 150.0)],
            level=-1,
            speed=60 / 3.6,
        )
        roads += pieces
        x, y = _turned(np.array([[0.0, -side]]), quarter)[0]
        node = Pose(float(x), float(y), quarter * np.pi / 2)
        a, b = node.moved(-reach + 130.0), node.moved(reach - 130.0)
        arrive = np.concatenate([hermite(exits[0].lane, a), polyline((a.x, a.y), (node.x, node.y))])
        depart = np.concatenate([polyline((node.x, node.y), (b.x, b.y)), hermite(b, entries[0].lane)])
        roads.append(ramp(_joined(arrive), exits[0], highway="trunk_link"))
        roads.append(ramp(_joined(depart), None, entries[0], highway="trunk_link"))
    return roads


def _weaving(rng: np.random.Generator) -> list[Road]:
    half, gap, weave = 900.0, rng.uniform(9, 13), rng.uniform(180, 420)
    lanes = int(rng.integers(2, 4))
    roads: list[Road] = []
    for quarter in (0, 2):
        path = _turned(divided(polyline((-half, 0), (half, 0)), gap=gap)[0], quarter)
        pieces, exits, entries = carriageway(
            path, lanes=lanes, exits=[(half + weave / 2, weave)], entries=[(half - weave / 2, weave)]
        )
        away = rng.uniform(60, 110)
        heading = quarter * np.pi / 2
        start = Pose(entries[0].lane.x, entries[0].lane.y, heading).moved(-300.0, away)
        end = Pose(exits[0].lane.x, exits[0].lane.y, heading).moved(300.0, away)
        come = hermite(Pose(start.x, start.y, heading + np.radians(25)), entries[0].lane)
        go = hermite(exits[0].lane, Pose(end.x, end.y, heading - np.radians(25)))
        roads += [*pieces, ramp(come, None, entries[0]), ramp(go, exits[0])]
    return roads


def _roundabout(rng: np.random.Generator) -> list[Road]:
    arms, radius = int(rng.integers(3, 6)), rng.uniform(18, 32)
    spread = 2 * np.pi / arms
    angles = np.arange(arms) * spread + rng.uniform(-0.1, 0.1, arms) * spread + rng.uniform(0, 2 * np.pi)
    opening = min(
        np.arcsin(min(9.0 / radius, 0.5)), 0.27 * spread
    )  # half the angle between the exit and the entry of an arm
    roads: list[Road] = []
    stops = np.sort(np.concatenate([angles - opening, angles + opening]))
    for begin, end in zip(stops, np.append(stops[1:], stops[0] + 2 * np.pi), strict=True):
        t = np.linspace(begin, end, 24)
        ring = radius * np.column_stack([np.cos(t), np.sin(t)])
        roads.append(Road(ring, "secondary", 1, speed=30 / 3.6, roundabout=True))
    for angle in angles:
        apart = radius + rng.uniform(28, 40)
        node = Pose(apart * np.cos(angle), apart * np.sin(angle), angle)
        end = node.moved(rng.uniform(250, 400))
        roads.append(Road(polyline((end.x, end.y), (node.x, node.y)), "secondary", 1, 1, speed=50 / 3.6))
        inward = Pose(node.x, node.y, angle + np.pi)
        # Traffic goes round counterclockwise: it leaves before the arm's axis and enters behind it.
        enter, leave = (Pose(radius * np.cos(a), radius * np.sin(a), 0.0) for a in (angle + opening, angle - opening))
        into = Pose(enter.x, enter.y, angle + opening + np.pi / 2 + np.radians(55))
        out = Pose(leave.x, leave.y, angle - opening + np.pi / 2 - np.radians(55))
        roads.append(Road(hermite(inward, into, stretch=0.7), "secondary", 1, speed=30 / 3.6))
        roads.append(Road(hermite(out, Pose(node.x, node.y, angle), stretch=0.7), "secondary", 1, speed=30 / 3.6))
    return roads


DRAWINGS: Mapping[str, Drawing] = {
    "diamond": _diamond,
    "cloverleaf": _cloverleaf,
    "stack": _stack,
    "trumpet": _trumpet,
    "shallow_overpass": draw_overpass,
    "double_deck": _double_deck,
    "merge_beside_bridge": _merge_beside_bridge,
    "tunnel_under_junction": _tunnel_under_junction,
    "weaving": _weaving,
    "roundabout": _roundabout,
}
