"""The recipe of the simulator: a road network in, fleet data and the truth behind it out.

Every drive has a random stream of its own, derived from the seed and the number of the drive alone. The outcome
therefore does not depend on how many workers share the drives, and drive 1000 can be made without the 999 before it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.errors import OptionError
from probe2road.fleet.contract import POINT_KINDS, Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.run.workers import in_processes
from probe2road.simulation.driving.traffic import TrafficWorld, TruePoses, drive, traffic_world
from probe2road.simulation.lanes.features import RoadFeatures, road_features
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.presets import Preset, RecordingModel, SurroundingsModel, find_preset
from probe2road.simulation.records import DriveLabels, RecordedPoses, count_drives, drive_tables
from probe2road.simulation.sensors.camera import ROAD_BOUNDARY, Detections, FeatureIndex, feature_index, see
from probe2road.simulation.sensors.gnss import gnss_errors
from probe2road.simulation.sensors.odometry import fuse

__all__ = [
    "FleetChunk",
    "FleetWorld",
    "SimulatedFleet",
    "fleet_world",
    "simulate",
    "simulate_chunks",
    "simulate_drive",
    "visible_features",
]

logger = logging.getLogger(__name__)

_WORLD, _DRIVE, _VEHICLE = 0, 1, 2  # first key of the random streams


@dataclass(frozen=True, eq=False)
class FleetChunk:
    """Several consecutive drives: raw fleet data, and their truth."""

    traces: pd.DataFrame  # as in `probe2road.fleet.contract.Fleet`
    points: pd.DataFrame  # the same
    poses: pd.DataFrame  # one row for each row of traces: see `SimulatedFleet`
    routes: pd.DataFrame  # one row for each section driven: see `SimulatedFleet`
    length: NDArray[np.float64]  # (drives,) m driven


@dataclass(frozen=True, eq=False)
class SimulatedFleet:
    """Fleet data as vehicles would record it, and its truth.

    Attributes
    ----------
    fleet
        Raw fleet data: biased, not aligned.
    poses
        True poses, row by row those of ``fleet.traces``: ``trace_id``, ``t``, ``x``, ``y``, ``z`` (m, on the road under
        the vehicle), ``heading`` (degrees clockwise from north), ``section`` (id), ``lane`` (number in
        `probe2road.simulation.lanes.lanes.lane_offsets`).
    routes
        ``trace_id``, ``position`` (0, 1, ... along the drive), ``section``, ``direction`` (+1 from u to v),
        ``via_node`` (node at which the section was entered; -1 for the first).
    reference
        The true road graph; ``support``, ``forward``, ``backward`` and the turn table are the true numbers of drives.
    """

    fleet: Fleet
    poses: pd.DataFrame
    routes: pd.DataFrame
    reference: RoadGraph

    def __repr__(self) -> str:
        return f"SimulatedFleet({self.fleet!r} on {self.reference!r})"

    def _repr_html_(self) -> str:
        """Show figures in a notebook, without any ids."""
        return f"<b>SimulatedFleet</b><br>{self.fleet._repr_html_()}{self.reference._repr_html_()}"


@dataclass(frozen=True)
class FleetWorld:
    """The data shared by all drives, sent once to each worker process."""

    preset: Preset
    seed: int
    traffic: TrafficWorld
    features: FeatureIndex | None
    exposure: NDArray[np.float64]  # (sections,) factor on the burst rate
    covered: NDArray[np.bool_]  # (sections,) no sky at all
    section_id: NDArray[np.int64]  # (sections,)


def simulate(
    network: RoadNetwork,
    *,
    preset: str | Path | Preset = "mixed",
    n_drives: int | None = None,
    drive_km: float | None = None,
    seed: int = 0,
    workers: int = 1,
) -> SimulatedFleet:
    """Simulate the drives of a vehicle fleet on a road network.

    Everything is held in memory; `simulate_chunks` yields the same drives piece by piece.

    Parameters
    ----------
    network
        The roads.
    preset
        Name of a preset, path of a TOML file, or a `Preset`.
    n_drives
        How many drives.
    drive_km
        How many kilometres in all: drives are added until they are reached. Give this or ``n_drives``.
    seed
        The same seed gives the same fleet, whatever the number of workers.
    workers
        Processes that share the work.

    Returns
    -------
    SimulatedFleet

    Raises
    ------
    OptionError
        If the amount is missing, given twice or not positive, or the preset is unknown.
    InputError
        If the network is empty.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> network = network_from_sections([[(0, 0), (2000, 0)]], crs="EPSG:32616", lanes_forward=2)
    >>> result = simulate(network, n_drives=2, seed=7)
    >>> result.fleet.n_traces, result.reference.edges["support"].tolist()
    (2, [2])
    >>> bool(len(result.fleet.points)), len(result.poses) == len(result.fleet.traces)
    (True, True)
    """
    chosen = find_preset(preset)
    chunks = list(
        simulate_chunks(network, preset=chosen, n_drives=n_drives, drive_km=drive_km, seed=seed, workers=workers)
    )
    traces, points, poses, routes = (
        pd.concat([getattr(chunk, name) for chunk in chunks], ignore_index=True)
        for name in ("traces", "points", "poses", "routes")
    )
    reference = count_drives(network.reference_graph(), routes)
    driven = sum(float(chunk.length.sum()) for chunk in chunks) / 1000.0
    logger.info(
        "simulated %d drives, %.0f km: %d poses, %d points",
        sum(len(chunk.length) for chunk in chunks), driven, len(traces), len(points),
    )  # fmt: skip
    return SimulatedFleet(Fleet(traces, points, network.crs), poses, routes, reference)


def simulate_chunks(
    network: RoadNetwork,
    *,
    preset: str | Path | Preset = "mixed",
    n_drives: int | None = None,
    drive_km: float | None = None,
    seed: int = 0,
    workers: int = 1,
    first_drive: int = 0,
    chunk_drives: int = 50,
) -> Iterator[FleetChunk]:
    """Yield the drives of a fleet in order and in chunks, with memory for only a few chunks.

    Parameters
    ----------
    network, preset, n_drives, drive_km, seed, workers
        As in `simulate`.
    first_drive
        Number of the first drive, which is also its ``trace_id``: a caller that has written the first k drives goes on
        with ``first_drive=k``, and ``n_drives`` or ``drive_km`` less what it has.
    chunk_drives
        Drives in a chunk; no influence on the drives.

    Yields
    ------
    FleetChunk

    Raises
    ------
    OptionError, InputError
        As in `simulate`.
    """
    if (n_drives is None) == (drive_km is None):
        raise OptionError("the amount must be given once", where="simulate", fix="give n_drives or drive_km")
    amounts = {"n_drives": n_drives, "drive_km": drive_km, "workers": workers, "chunk_drives": chunk_drives}
    for name, amount in amounts.items():
        if amount is not None and not amount > 0:
            raise OptionError(f"{name} is {amount}", where="simulate", fix="use a positive number")
    world = fleet_world(network, find_preset(preset), seed=seed)
    end = None if n_drives is None else first_drive + n_drives
    jobs = _jobs(first_drive, end, chunk_drives)
    results = (_chunk(world, *job) for job in jobs)
    if workers > 1:
        results = in_processes(_chunk_in_worker, jobs, workers, initializer=_start_worker, initargs=(world,))
    with closing(results):  # ends the workers where the caller stops early
        yield from _until(results, None if drive_km is None else drive_km * 1000.0)


def simulate_drive(world: FleetWorld, number: int) -> tuple[TruePoses, RecordedPoses, Detections | None]:
    """Simulate one drive.

    Parameters
    ----------
    world
        From `fleet_world`.
    number
        Number of the drive, 0 or more.

    Returns
    -------
    poses : TruePoses
        Truth.
    recorded : RecordedPoses
        What the vehicle believed.
    detections : Detections or None
        Points in the vehicle frame.
    """
    preset = world.preset
    rng = _stream(world.seed, _DRIVE, number)
    vehicle = number // preset.recording.drives_per_vehicle
    recording = preset.recording
    poses = drive(
        world.traffic, preset.demand, preset.driver, pose_spacing=recording.pose_spacing,
        standing_interval=recording.standing_interval, rng=rng,
    )  # fmt: skip
    covered, exposure = world.covered[poses.section], world.exposure[poses.section]
    if preset.fusion is None:
        rows = _fix_rows(poses, covered, recording, rng)
        raw = gnss_errors(poses.t[rows], preset.gnss, exposure=exposure[rows], rng=rng)
        return poses, RecordedPoses(rows, poses.xyz[rows] + raw.error, poses.heading[rows], raw.sigma), None
    gnss = gnss_errors(poses.t, preset.gnss, exposure=exposure, rng=rng)
    fused = fuse(
        poses, gnss, covered, preset.odometry, preset.fusion, rng=rng,
        vehicle_rng=_stream(world.seed, _VEHICLE, vehicle, 0),
    )  # fmt: skip
    recorded = RecordedPoses(np.arange(len(poses.t)), fused.xyz, fused.heading, fused.sigma)
    if preset.camera is None or world.features is None:
        return poses, recorded, None
    seen = see(
        poses.xyz, poses.heading, poses.t, poses.distance, world.features, preset.camera, rng=rng,
        vehicle_rng=_stream(world.seed, _VEHICLE, vehicle, 1),
    )  # fmt: skip
    return poses, recorded, seen


def fleet_world(network: RoadNetwork, preset: Preset, *, seed: int) -> FleetWorld:
    """Prepare a network for simulation: demand, lanes, features that cameras can see, and visibility of the sky."""
    traffic = traffic_world(network, preset.demand, rng=_stream(seed, _WORLD, 0))
    features = None
    if preset.camera is not None:
        lines = visible_features(network, seed=seed)
        kind = (lines.kind == POINT_KINDS[ROAD_BOUNDARY]).astype(np.int8)
        features = feature_index(lines.xyz, lines.offsets, kind, preset.camera)
    return FleetWorld(
        preset,
        seed,
        traffic,
        features,
        _exposures(network, preset.surroundings, _stream(seed, _WORLD, 2)),
        network.sections["tunnel"].to_numpy(bool),
        network.sections.index.to_numpy(np.int64),
    )


def visible_features(network: RoadNetwork, *, seed: int) -> RoadFeatures:
    """Return the markings and boundaries that the cameras of a simulated fleet can see.

    ``Detections.feature`` counts in them; the seed decides where boundaries have gaps.
    """
    return road_features(network, rng=_stream(seed, _WORLD, 1))


def _stream(seed: int, *keys: int) -> np.random.Generator:
    """Return the random stream of an object: a function of the seed and the keys of the object alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=keys))


def _exposures(network: RoadNetwork, model: SurroundingsModel, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the factor on the burst rate of every section; its mean is that of the road class."""
    by_class = network.sections["highway"].map(lambda name: model.exposure.get(name, model.other_exposure))
    local = np.exp(model.spread * rng.standard_normal(len(by_class)) - model.spread**2 / 2.0)
    return by_class.to_numpy(np.float64) * local


def _fix_rows(
    poses: TruePoses, covered: NDArray[np.bool_], recording: RecordingModel, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return the rows of the poses that a phone records: one in each interval, none where there is no sky."""
    low, high = np.log(recording.fix_interval)
    interval = np.exp(rng.uniform(low, high))
    slot = np.floor((poses.t - poses.t[0]) / interval + rng.random())
    first = np.flatnonzero(np.diff(slot, prepend=slot[:1] - 1.0) > 0)
    open_sky = first[~covered[first]]
    return open_sky if len(open_sky) else first[:1]


def _jobs(first: int, end: int | None, size: int) -> Iterator[tuple[int, int]]:
    """Return ranges of drives: the first number, and the number after the last."""
    for start in count(first, size):
        if end is not None and start >= end:
            return
        yield start, start + size if end is None else min(start + size, end)


def _chunk(world: FleetWorld, start: int, end: int) -> FleetChunk:
    """Simulate the drives from start to end - 1."""
    tables: dict[str, list[pd.DataFrame]] = {"traces": [], "points": [], "poses": [], "routes": []}
    lengths = []
    for number in range(start, end):
        poses, recorded, seen = simulate_drive(world, number)
        labels = DriveLabels(number, number // world.preset.recording.drives_per_vehicle, _departure(world, number))
        for name, table in drive_tables(world.traffic.graph, world.section_id, labels, poses, recorded, seen).items():
            tables[name].append(table)
        lengths.append(poses.length)
    joined = {name: pd.concat(parts, ignore_index=True) for name, parts in tables.items()}
    return FleetChunk(**joined, length=np.array(lengths))


def _departure(world: FleetWorld, number: int) -> np.datetime64:
    """Draw the start time of a drive within the weeks of the fleet, from a random stream of its own."""
    recording = world.preset.recording
    first = pd.Timestamp(recording.first_day).tz_convert("UTC").tz_localize(None).to_datetime64()
    seconds = _stream(world.seed, _DRIVE, number, 1).random() * recording.days * 86400.0
    return np.datetime64(first, "ms") + np.timedelta64(round(seconds * 1000.0), "ms")


def _until(chunks: Iterable[FleetChunk], length: float | None) -> Iterator[FleetChunk]:
    """Yield chunks until a driven distance (m) is reached; the last chunk ends with the drive that reaches it."""
    driven = 0.0
    for chunk in chunks:
        total = driven + np.cumsum(chunk.length)
        if length is not None and total[-1] >= length:
            yield _first_drives(chunk, int(np.searchsorted(total, length)) + 1)
            return
        driven = float(total[-1])
        yield chunk


def _first_drives(chunk: FleetChunk, n: int) -> FleetChunk:
    """Return the first n drives of a chunk."""
    last = chunk.routes["trace_id"].iloc[0] + n
    tables = {name: getattr(chunk, name) for name in ("traces", "points", "poses", "routes")}
    cut = {name: table[table["trace_id"] < last].reset_index(drop=True) for name, table in tables.items()}
    return FleetChunk(**cut, length=chunk.length[:n])


_worker_world: FleetWorld | None = None


def _start_worker(world: FleetWorld) -> None:
    """Store the shared data in a worker process, so that it is sent once and not with every chunk."""
    global _worker_world
    _worker_world = world


def _chunk_in_worker(start: int, end: int) -> FleetChunk:
    if _worker_world is None:
        raise RuntimeError("the worker process has not been started by in_processes")
    return _chunk(_worker_world, start, end)
