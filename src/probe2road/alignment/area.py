"""The alignment of one area: from recorded drives to poses that agree.

Everything here is held in memory at once; `probe2road.alignment.tiling` cuts larger data into areas.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from probe2road.alignment.anchoring import anchored
from probe2road.alignment.floors import Floors, find_floors, floor_of, middles
from probe2road.alignment.graph import optimise
from probe2road.alignment.heights import solve_heights
from probe2road.alignment.hypotheses import Track
from probe2road.alignment.keyframes import Keyframes, Sightings, keyframes, moved_aside, recorded_aside, sightings
from probe2road.alignment.lines import Condensed, LineMatches, condense, match_lines
from probe2road.alignment.options import AlignOptions
from probe2road.alignment.profiles import ShiftSearch
from probe2road.alignment.reckoning import wrapped
from probe2road.alignment.registration import Chains, DriveEvidence, register
from probe2road.alignment.routes import route_heights
from probe2road.alignment.spines import CELL, OnSpines, Spines, find_spines, project
from probe2road.fleet.contract import Fleet

__all__ = ["AlignedArea", "align_area"]

logger = logging.getLogger(__name__)

_SEARCH_BIN = 0.25  # m, of the shifts tried in registration
_SEARCH_KERNEL = 0.3  # m
_SEARCH_DOUBT = 0.7  # keyframes
_SEARCH_TEMPER = 0.25  # weight of a point; low, because neighbouring keyframes see the same paint with the same camera
_TRIAL_ROUNDS = 2  # rounds before registration is repeated
_LEAST_MOVE = 0.1  # m, by which a shift may always change between keyframes
_LANE_GATE = 3.0  # lane sigmas beyond which a path does not belong to the middle of all


@dataclass(frozen=True)
class AlignedArea:
    """The keyframes of an area after alignment, and how the alignment went.

    Attributes
    ----------
    frames
        The keyframes as recorded.
    pose
        Aligned poses, m, m, radians, shape ``(k, 3)``.
    z
        Aligned heights, m, shape ``(k,)``.
    sights
        Points of each keyframe that lie on lines which others saw too, shape ``(k,)``.
    residual
        Of the matched points in the last round, m, shape ``(m,)``; their keyframes and what they would have been
        without alignment, shape ``(m,)`` each.
    rounds
        Median absolute residual of each round, m.
    """

    frames: Keyframes
    pose: NDArray[np.float64]
    z: NDArray[np.float64]
    sights: NDArray[np.int64]
    residual: NDArray[np.float64]
    residual_keyframe: NDArray[np.int64]
    residual_before: NDArray[np.float64]
    rounds: tuple[float, ...]


@dataclass(frozen=True)
class _Scene:
    """The inputs that stay the same while an area is aligned."""

    frames: Keyframes
    seen: Sightings
    held: NDArray[np.bool_]  # (k,) keyframes that stay
    chains: Chains  # best first
    options: AlignOptions


def align_area(fleet: Fleet, options: AlignOptions, *, held: NDArray[np.bool_] | None = None) -> AlignedArea:
    """Align the drives of one area.

    Parameters
    ----------
    fleet
        The drives, at least one; none of those that `probe2road.alignment.screening.screen_drives` rejects.
    options
        How.
    held
        Drives that are aligned already and must not move, shape ``(n_traces,)``.

    Returns
    -------
    AlignedArea
    """
    frames = keyframes(fleet, options)
    held = np.zeros(fleet.n_traces, bool) if held is None else held
    scene = _Scene(frames, sightings(fleet, frames), held[frames.drive], _chains(frames, held), options)
    pose = optimise(frames, frames.pose, _nothing(), np.zeros((0, 3)), options, held=scene.held)
    # Drives that were too far away to be registered at first are nearer the second time, on a map of all the others.
    for settled, gates in ((False, options.gates[:_TRIAL_ROUNDS]), (True, options.gates)):
        spines = find_spines(replace(frames, pose=pose), scene.chains.placing, options)
        pose, floors, level = _register(scene, pose, spines, settled=settled)
        pose, matches, rounds = _iterate(scene, pose, spines, floors, level, gates, robust_gnss=settled)
    on = project(spines, pose, options)
    floor = floor_of(floors, on.cell, spines.above(on.station, level), options)
    start = np.where(np.isfinite(level), level, frames.z)
    z = solve_heights(frames, floor, spines.z[np.maximum(on.station, 0)], options, held=scene.held, start=start)
    return _result(scene, pose, z, spines, matches, rounds)


def _iterate(
    scene: _Scene,
    pose: NDArray[np.float64],
    spines: Spines,
    floors: Floors,
    level: NDArray[np.float64],
    gates: tuple[float, ...],
    *,
    robust_gnss: bool,
) -> tuple[NDArray[np.float64], LineMatches, list[float]]:
    """Match and optimise in turn until the residuals converge: return poses, last matches, and residual by round."""
    rounds: list[float] = []
    for gate in gates:
        pose, matches = _round(scene, pose, spines, floors, level, gate, robust_gnss=robust_gnss)
        rounds.append(float(np.median(np.abs(matches.residual))) if len(matches.residual) else 0.0)
        if len(rounds) > 1 and gate == min(gates) and abs(rounds[-2] - rounds[-1]) < scene.options.converged:
            break
    return pose, matches, rounds


def _chains(frames: Keyframes, held: NDArray[np.bool_]) -> Chains:
    """Return the chains, sorted by their stated accuracy and then by length."""
    starts = frames.starts
    n = np.diff(starts)
    order = np.lexsort((-n, np.round(np.add.reduceat(frames.sigma, starts[:-1]) / n, 1)))
    return Chains(starts, order, held[frames.drive[starts[:-1]]])


def _nothing() -> Condensed:
    none = np.zeros(0, np.int64)
    return Condensed(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))


def _points_on_spines(scene: _Scene, pose: NDArray[np.float64], spines: Spines) -> OnSpines:
    """Project all points on the spines, each with the direction of its keyframe."""
    x, y, theta = pose[scene.seen.keyframe].T
    ahead, left = scene.seen.body.T
    cos, sin = np.cos(theta), np.sin(theta)
    world = np.column_stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left, theta])
    return project(spines, world, scene.options)


def _points_on_floors(
    scene: _Scene,
    pose: NDArray[np.float64],
    on: OnSpines,
    spines: Spines,
    floors: Floors,
    level: NDArray[np.float64],
) -> tuple[OnSpines, NDArray[np.int64]]:
    """Project all points, and return the floors of their keyframes; -1 for points beside another spine.

    What a keyframe sees of another spine says where it is across that one, not across its own.
    """
    frame = scene.seen.keyframe
    points = _points_on_spines(scene, pose, spines)
    alike = spines.spine_of(points.cell) == spines.spine_of(on.cell)[frame]
    floor = floor_of(floors, points.cell, spines.above(on.station, level)[frame], scene.options)
    return points, np.where(alike, floor, -1)


def _register(
    scene: _Scene, pose: NDArray[np.float64], spines: Spines, *, settled: bool
) -> tuple[NDArray[np.float64], Floors, NDArray[np.float64]]:
    """Register drives on each other, first in height, then across the road: return poses, floors and heights."""
    frames, options = scene.frames, scene.options
    on = project(spines, pose, options)
    level = route_heights(frames, on, spines, options, held=scene.held)
    above = spines.above(on.station, level)
    floors = find_floors(frames, on, above, spines, options)
    home = floor_of(floors, on.cell, above, options)
    if len(scene.seen.keyframe) == 0 or len(floors.cell) == 0:
        return pose, floors, level
    if settled:
        angle = spines.station[np.maximum(on.station, 0), 2]
        pose = anchored(frames, pose, angle, home, floors.places, options, held=scene.held)
        on = project(spines, pose, options)
        home = floor_of(floors, on.cell, spines.above(on.station, level), options)
    points, floor = _points_on_floors(scene, pose, on, spines, floors, level)
    found = floor >= 0
    seen = DriveEvidence(scene.seen.keyframe[found], floor[found], points.left[found], scene.seen.kind[found])
    angle = spines.station[np.maximum(on.station, 0), 2]
    recorded = recorded_aside(frames, pose, angle)
    track = Track(
        home, on.left, recorded, np.maximum(frames.motion_sigma[:, 1], _LEAST_MOVE),
        np.sqrt(2.0) * frames.sigma * frames.inflation(options),
    )  # fmt: skip
    search = ShiftSearch(
        options.search, _SEARCH_BIN, options.search + 20.0, _SEARCH_KERNEL, _SEARCH_DOUBT, _SEARCH_TEMPER
    )
    shift = register(seen, floors.places, scene.chains, track, search, settled=settled)
    return moved_aside(pose, angle, np.where(home >= 0, shift, 0.0)), floors, level


def _round(
    scene: _Scene,
    pose: NDArray[np.float64],
    spines: Spines,
    floors: Floors,
    level: NDArray[np.float64],
    gate: float,
    *,
    robust_gnss: bool,
) -> tuple[NDArray[np.float64], LineMatches]:
    """Match points to lines and optimise: return the new poses, and the matches that led to them."""
    options, frame = scene.options, scene.seen.keyframe
    on = project(spines, pose, options)
    points, floor = _points_on_floors(scene, pose, on, spines, floors, level)
    matches = match_lines(
        floor, points.along, points.left, scene.seen.kind, scene.frames.drive[frame], options, gate=gate
    )
    at = matches.point
    patch = floors.patch
    sigma = np.where(scene.seen.kind[at] == 0, options.marking_sigma, options.boundary_sigma)
    sights = condense(
        matches, frame[at], patch[floor[at]], scene.seen.body[at],
        spines.station[points.station[at], 2] - pose[frame[at], 2], sigma, gate=gate,
    )  # fmt: skip
    paths = _paths(scene, pose, on, spines, floors, level, np.unique(sights.keyframe))
    both = Condensed(*(np.concatenate(pair) for pair in zip(_fields(sights), _fields(paths), strict=True)))
    held_patches = np.zeros(len(patch), bool)
    held_patches[patch[floor[at]][scene.held[frame[at]]]] = True
    centre = _patch_poses(spines, floors)
    moved = optimise(
        scene.frames, pose, both, centre, options,
        held=scene.held, fixed_patch=held_patches, robust_gnss=robust_gnss,
    )  # fmt: skip
    return moved, matches


def _fields(condensed: Condensed) -> tuple[NDArray[np.generic], ...]:
    return condensed.keyframe, condensed.patch, condensed.correction, condensed.information


def _paths(
    scene: _Scene,
    pose: NDArray[np.float64],
    on: OnSpines,
    spines: Spines,
    floors: Floors,
    level: NDArray[np.float64],
    sighted: NDArray[np.int64],
) -> Condensed:
    """Pull drives whose camera saw nothing towards the middle of all paths: weakly, because lanes differ."""
    options = scene.options
    floor = floor_of(floors, on.cell, spines.above(on.station, level), options)
    blind = floor >= 0
    chain = scene.frames.chain
    blind &= ~np.isin(chain, chain[sighted])
    if not blind.any():
        return _nothing()
    usable = floor >= 0
    middle, drives = middles(floor[usable], on.left[usable], scene.frames.drive[usable], len(floors.cell))
    sigma = options.lane_sigma * scene.frames.inflation(options)
    off = on.left - np.where(usable, middle[floor], 0.0)
    k = np.flatnonzero(blind & (drives[floor] >= options.min_drives) & (np.abs(off) < _LANE_GATE * options.lane_sigma))
    floor = floor[k]
    angle = spines.station[on.station[k], 2] - pose[k, 2]
    normal = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(len(k))])
    information = normal[:, :, None] * normal[:, None, :] / sigma[k, None, None] ** 2 + np.diag([1e-6, 1e-6, 1e-4])
    return Condensed(k, floors.patch[floor], -normal * off[k, None], information)


def _patch_poses(spines: Spines, floors: Floors) -> NDArray[np.float64]:
    """Return the pose of the spine at the cell of each floor: shape ``(floors, 3)``."""
    station = np.searchsorted(spines.along, (floors.cell + 0.5) * CELL)
    return spines.station[np.clip(station, 0, len(spines.station) - 1)]


def _result(
    scene: _Scene,
    pose: NDArray[np.float64],
    z: NDArray[np.float64],
    spines: Spines,
    matches: LineMatches,
    rounds: list[float],
) -> AlignedArea:
    """Put the result together; residuals before alignment are measured to the same lines as those after it."""
    frames, at = scene.frames, matches.point
    keyframe = scene.seen.keyframe[at]
    sights = np.bincount(keyframe, minlength=len(frames.row))
    before = np.zeros(len(at))
    if len(at):
        points = _points_on_spines(scene, pose, spines)
        angle = spines.station[np.maximum(points.station[at], 0), 2] + matches.slope
        moved = frames.pose[keyframe] - pose[keyframe]
        x, y = scene.seen.body[at].T
        turn = wrapped(moved[:, 2])
        cos, sin = np.cos(pose[keyframe, 2]), np.sin(pose[keyframe, 2])
        # A rotation of the keyframe moves points ahead of it sideways.
        dx = moved[:, 0] - turn * (sin * x + cos * y)
        dy = moved[:, 1] + turn * (cos * x - sin * y)
        before = matches.residual - np.sin(angle) * dx + np.cos(angle) * dy
    return AlignedArea(frames, pose, z, sights, matches.residual, keyframe, before, tuple(rounds))
