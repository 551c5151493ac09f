"""Traffic: one drive after another, each of one vehicle on a route through the network.

What comes out are true poses. What the vehicle believes, and sees, is the business of the sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe2road.simulation.driving.lane_choice import LinkLanes, choose_lanes, link_lanes
from probe2road.simulation.driving.paths import PATH_SPACING, DrivenPath, SectionShapes, driven_path, section_shapes
from probe2road.simulation.driving.routes import DemandModel, LinkGraph, draw_route, link_graph, route_moves
from probe2road.simulation.driving.speeds import DriverModel, Journey, drive_along, lane_wander
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["TrafficWorld", "TruePoses", "drive", "traffic_world"]

_STOP_LINE = 9.0  # m before the node at which a vehicle waits
_SLOW = 4.0  # m/s below which weaving follows the distance driven, not time: a creeping car does not weave in place
_WINDOW = (0.1, 0.9)  # share of a link in which lanes are changed


@dataclass(frozen=True)
class TrafficWorld:
    """A network prepared for driving, as flat arrays that can be sent to worker processes."""

    graph: LinkGraph
    lanes: LinkLanes
    shapes: SectionShapes
    speed_limit: NDArray[np.float64]  # (sections,) m/s


@dataclass(frozen=True)
class TruePoses:
    """The true positions of a vehicle: n poses, one for each stretch driven, and more while it stood."""

    route: NDArray[np.int64]  # (m,) links in driving order
    t: NDArray[np.float64]  # (n,) s since departure
    xyz: NDArray[np.float64]  # (n, 3) m, on the road surface under the vehicle
    heading: NDArray[np.float64]  # (n,) radians clockwise from north
    speed: NDArray[np.float64]  # (n,) m/s
    distance: NDArray[np.float64]  # (n,) m driven since departure
    section: NDArray[np.int64]  # (n,) row in network.sections
    lane: NDArray[np.int64]  # (n,) lane number of lane_offsets

    @property
    def length(self) -> float:
        """Return the driven distance, metres."""
        return float(self.distance[-1]) if len(self.distance) else 0.0


def traffic_world(network: RoadNetwork, demand: DemandModel, *, rng: np.random.Generator) -> TrafficWorld:
    """Prepare a network for driving; ``rng`` draws its demand."""
    graph = link_graph(network, demand, rng=rng)
    limits = network.sections["speed_limit"].to_numpy(np.float64)
    return TrafficWorld(graph, link_lanes(network, graph), section_shapes(network), limits)


def drive(
    world: TrafficWorld,
    demand: DemandModel,
    driver: DriverModel,
    *,
    pose_spacing: float,
    standing_interval: float,
    rng: np.random.Generator,
) -> TruePoses:
    """Drive one route and return the true poses.

    Parameters
    ----------
    world
        The prepared network.
    demand, driver
        Models of where and how people drive.
    pose_spacing
        Metres between poses while the vehicle moves.
    standing_interval
        Seconds between poses while it stands.
    rng
        All randomness of this drive.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> network = network_from_sections([[(0, 0), (3000, 0)]], crs="EPSG:32616", lanes_forward=3)
    >>> rng = np.random.default_rng(1)
    >>> world = traffic_world(network, DemandModel(), rng=rng)
    >>> poses = drive(world, DemandModel(), DriverModel(), pose_spacing=2.5, standing_interval=1.0, rng=rng)
    >>> len(poses.t), bool(np.abs(poses.xyz[:, 1]).max() < 3 * 3.65 / 2)
    (1200, True)
    """
    route = draw_route(world.graph, demand, rng=rng)
    path = _path(world, route, driver, rng)
    limit = world.speed_limit[world.graph.section[route]][path.position]
    wait = _waits(world.graph, route, path, driver, rng)
    journey = drive_along(path.curvature, limit, wait, driver, spacing=PATH_SPACING, rng=rng)
    t, s = _pose_times(journey, pose_spacing, standing_interval)
    return _poses(world, route, path, journey, t, s, driver, rng)


def _path(world: TrafficWorld, route: NDArray[np.int64], driver: DriverModel, rng: np.random.Generator) -> DrivenPath:
    """Choose lanes along a route and draw the path through them."""
    graph = world.graph
    lengths = world.shapes.lengths[graph.section[route]]
    turns = graph.turn[route_moves(graph, route)]
    # The preferred lane lasts for stretches; most drivers keep to the middle and to the side of slow traffic.
    stretch = (np.cumsum(lengths) / driver.preference_length + rng.random()).astype(np.int64)
    preferred = rng.random(int(stretch[-1]) + 1)[stretch]
    entered, left = choose_lanes(route, turns, lengths, world.lanes, preferred)
    time = np.maximum(driver.lane_change_time + driver.lane_change_spread * rng.standard_normal(len(route)), 2.5)
    crossed = np.maximum(np.abs(entered - left), 1)
    low, high = _WINDOW[0] * lengths, _WINDOW[1] * lengths
    window = np.minimum(time * crossed * world.speed_limit[graph.section[route]], high - low)
    begin = low + rng.random(len(route)) * (high - low - window)
    change = np.stack([begin, begin + window], axis=1)
    return driven_path(route, entered, left, change, graph, world.lanes, world.shapes)


def _waits(
    graph: LinkGraph, route: NDArray[np.int64], path: DrivenPath, driver: DriverModel, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw where the vehicle stops, and for how many seconds: shape ``(n,)``, one value for each path sample."""
    wait = np.zeros(len(path.position))
    moves = route_moves(graph, route)
    draw, pause = rng.random(len(moves)), rng.exponential(size=len(moves))
    chance = np.where(graph.yields[moves], driver.yield_stop, driver.signal_stop * graph.crosses[moves])
    mean = np.where(graph.yields[moves], driver.yield_wait, driver.signal_wait)
    at = np.searchsorted(path.position, np.arange(1, len(route))) - round(_STOP_LINE / PATH_SPACING)
    stops = (draw < chance) & (at > 0)
    wait[at[stops]] = 1.0 + mean[stops] * pause[stops]
    return wait


def _pose_times(
    journey: Journey, spacing: float, standing_interval: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times (s) and path distances (m) of the poses, ascending in both."""
    s = np.arange(len(journey.time)) * PATH_SPACING
    stops = np.flatnonzero(journey.wait > 0)
    arrivals = journey.time[stops] - journey.wait[stops]
    # Each stop is two points of the distance-time line, at one place.
    clock = np.insert(journey.time, stops, arrivals)
    place = np.insert(s, stops, s[stops] - 1e-6)
    moving_s = np.arange(0.0, s[-1], spacing)
    moving_t = np.interp(moving_s, place, clock)
    counts = np.floor(journey.wait[stops] / standing_interval).astype(np.int64)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    standing_t = np.repeat(arrivals, counts) + (number + 0.5) * standing_interval
    t = np.concatenate([moving_t, standing_t])
    order = np.argsort(t, kind="stable")
    return t[order], np.concatenate([moving_s, np.repeat(s[stops], counts)])[order]


def _poses(
    world: TrafficWorld,
    route: NDArray[np.int64],
    path: DrivenPath,
    journey: Journey,
    t: NDArray[np.float64],
    s: NDArray[np.float64],
    driver: DriverModel,
    rng: np.random.Generator,
) -> TruePoses:
    """Place the vehicle on its path, with a lateral offset that varies along it."""
    grid = np.arange(len(path.heading)) * PATH_SPACING
    heading = np.interp(s, grid, path.heading)
    speed = np.interp(s, grid, journey.speed)
    driven = np.diff(s, prepend=s[:1])
    aside = lane_wander(driven / np.maximum(speed, _SLOW), driver, rng=rng)
    xyz = np.stack([np.interp(s, grid, path.xyz[:, axis]) for axis in range(3)], axis=1)
    xyz[:, 0] += aside * np.cos(heading)
    xyz[:, 1] -= aside * np.sin(heading)
    drift = np.divide(np.diff(aside, prepend=aside[:1]), driven, out=np.zeros_like(aside), where=driven > 0.5)
    sample = np.minimum(np.rint(s / PATH_SPACING).astype(np.int64), len(grid) - 1)
    link = route[path.position[sample]]
    lane = world.lanes.lane[world.lanes.indptr[link] + path.lane[sample]]
    standing = np.diff(t, prepend=t[:1] - 1.0) > 0
    speed = np.where(standing & (driven == 0) & (s > 0), 0.0, speed)
    return TruePoses(route, t, xyz, heading + np.arctan(drift), speed, s, world.graph.section[link], lane)
