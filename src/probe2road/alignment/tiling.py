"""Tiles of a large fleet, aligned one by one and joined without seams.

Strategy
--------
The plane is cut into square tiles, each aligned with a margin of its neighbours' data, in any order and in any
process. A tile returns, for every fix in it, by how much to move it; where tiles reach into each other the moves are
averaged with weights that fall to zero at the border of each, so a drive crosses from tile to tile without a step.
Both sides of a seam saw nearly the same drives and the same GNSS there, which is why they agree to begin with. The
moves of a tile are one array in the workspace, so an interrupted run goes on with the tiles that are missing.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe2road.alignment.area import AlignedArea, align_area
from probe2road.alignment.options import AlignOptions
from probe2road.alignment.reckoning import wrapped
from probe2road.alignment.screening import rows_of_points
from probe2road.fleet.contract import Fleet
from probe2road.run.progress import Progress
from probe2road.run.stages import ALIGNED_TILE
from probe2road.run.workers import in_processes
from probe2road.run.workspace import Workspace

__all__ = ["Moves", "Tile", "align_tiles", "find_tiles", "moved_fleet"]

logger = logging.getLogger(__name__)

_LEAST_WEIGHT = 1e-3  # weight at the border of a tile


@dataclass(frozen=True)
class Tile:
    """A square of the plane and its margin."""

    name: str
    core: tuple[float, float, float, float]  # left, bottom, right, top, m
    margin: float  # m

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Return the square with its margin."""
        left, bottom, right, top = self.core
        return left - self.margin, bottom - self.margin, right + self.margin, top + self.margin


@dataclass(frozen=True)
class Moves:
    """The corrections that alignment applies to the n fixes of a fleet.

    Attributes
    ----------
    shift
        To add to x, y (m), the direction (radians counter-clockwise) and z (m) of each fix, shape ``(n, 4)``.
    residuals
        One row for each point on a line: row of its keyframe, residual before, residual after (m), shape ``(m, 3)``.
    sights
        Number of such points by fix (at keyframes), shape ``(n,)``.
    tiles
        Tiles that were aligned.
    """

    shift: NDArray[np.float64]
    residuals: NDArray[np.float64]
    sights: NDArray[np.int64]
    tiles: int


class TileMoves(NamedTuple):
    """The result of one tile: moves of the n fixes in it, and residuals of the m points that its keyframes saw."""

    row: NDArray[np.int64]  # (n,) of the fixes in the fleet
    shift: NDArray[np.float64]  # (n, 4) as in `Moves`
    weight: NDArray[np.float64]  # (n,) which falls to zero at the border
    seen_from: NDArray[np.int64]  # (m,) rows of the keyframes in the fleet
    residual: NDArray[np.float64]  # (m, 2) before and after, m


def find_tiles(fleet: Fleet, options: AlignOptions, *, touched: NDArray[np.bool_] | None = None) -> list[Tile]:
    """Return the tiles that hold fixes.

    Parameters
    ----------
    fleet
        The fleet.
    options
        Size and margin.
    touched
        Fixes that matter, shape ``(n,)``; all where not given. Tiles into which none of them reaches are left out.
    """
    xy = fleet.traces[["x", "y"]].to_numpy(np.float64)
    xy = xy if touched is None else xy[touched]
    # A fix also belongs to the tiles whose margin it is in.
    corners = [xy + np.array(offset) * options.margin for offset in ((-1, -1), (-1, 1), (1, -1), (1, 1))]
    found = np.unique(np.floor(np.concatenate(corners) / options.tile).astype(np.int64), axis=0)
    if touched is None:
        found = np.unique(np.floor(xy / options.tile).astype(np.int64), axis=0)
    return [
        Tile(f"{column}_{row}", _square(column, row, options.tile), options.margin) for column, row in found.tolist()
    ]


def align_tiles(
    fleet: Fleet,
    usable: NDArray[np.bool_],
    tiles: list[Tile],
    options: AlignOptions,
    *,
    held: NDArray[np.bool_],
    workspace: Workspace,
    workers: int = 1,
    progress: Progress | None = None,
) -> Moves:
    """Align every tile and join the results.

    Parameters
    ----------
    fleet
        The whole fleet.
    usable
        Drives to align or to align with, shape ``(n_traces,)``.
    tiles
        From `find_tiles`.
    options
        How.
    held
        Drives that must not move, shape ``(n_traces,)``.
    workspace
        Keeps what each tile gave.
    workers
        Processes; no influence on the result beyond the tolerance of the solver, millimetres.
    progress
        Called with the number of tiles done.

    Returns
    -------
    Moves
    """
    n = len(fleet.traces)
    total, weight, sights = np.zeros((n, 4)), np.zeros(n), np.zeros(n, np.int64)
    residuals = []
    done = 0
    for tile, moves in _results(fleet, usable[fleet.owner], held, tiles, options, workspace, workers):
        total[moves.row] += moves.weight[:, None] * moves.shift
        weight[moves.row] += moves.weight
        # A point counts in one tile only: the one in whose core its keyframe is.
        left, bottom, right, top = tile.core
        x, y = (fleet.traces[axis].to_numpy()[moves.seen_from] for axis in "xy")
        own = (x >= left) & (x < right) & (y >= bottom) & (y < top)
        residuals.append(np.column_stack([moves.seen_from[own], moves.residual[own]]))
        sights += np.bincount(moves.seen_from[own], minlength=n)
        done += 1
        if progress is not None:
            progress("aligning tiles", done, len(tiles))
    moved = weight > 0
    total[moved] /= weight[moved, None]
    return Moves(total, np.concatenate(residuals) if residuals else np.zeros((0, 3)), sights, done)


def moved_fleet(fleet: Fleet, shift: NDArray[np.float64]) -> Fleet:
    """Return a fleet with its poses moved; each point moves rigidly with the pose that it was seen from.

    Parameters
    ----------
    fleet
        The fleet; not changed.
    shift
        As in `Moves`.

    Returns
    -------
    Fleet
        The same rows. Points that no fix accounts for stay where they are.
    """
    old = fleet.traces[["x", "y"]].to_numpy(np.float64)
    new = old + shift[:, :2]
    columns = {"x": new[:, 0], "y": new[:, 1], "z": fleet.traces["z"].to_numpy(np.float64) + shift[:, 3]}
    if "heading" in fleet.traces:
        columns["heading"] = (fleet.traces["heading"].to_numpy(np.float64) - np.degrees(shift[:, 2])) % 360.0
    traces = fleet.traces.assign(**columns)
    if fleet.points.empty:
        return replace(fleet, traces=traces)
    rows = rows_of_points(fleet)
    seen = rows >= 0
    at = rows[seen]
    world = fleet.points[["x", "y", "z"]].to_numpy(np.float64)
    away = world[seen, :2] - old[at]
    cos, sin = np.cos(shift[at, 2]), np.sin(shift[at, 2])
    world[seen, 0] = new[at, 0] + cos * away[:, 0] - sin * away[:, 1]
    world[seen, 1] = new[at, 1] + sin * away[:, 0] + cos * away[:, 1]
    world[seen, 2] += shift[at, 3]
    points = fleet.points.assign(x=world[:, 0], y=world[:, 1], z=world[:, 2])
    return replace(fleet, traces=traces, points=points)


def _square(column: int, row: int, size: float) -> tuple[float, float, float, float]:
    return column * size, row * size, (column + 1) * size, (row + 1) * size


def _results(
    fleet: Fleet,
    usable: NDArray[np.bool_],
    held: NDArray[np.bool_],
    tiles: list[Tile],
    options: AlignOptions,
    workspace: Workspace,
    workers: int,
) -> Iterator[tuple[Tile, TileMoves]]:
    """Yield the result of every tile: first those kept by an earlier run, then new ones as they are made."""
    missing = []
    for tile in tiles:
        kept = workspace.read_arrays(ALIGNED_TILE, tile.name)
        if kept is None:
            missing.append(tile)
        else:
            yield tile, TileMoves(**kept)
    if len(missing) < len(tiles):
        logger.info("taking %d of %d tiles from an earlier run", len(tiles) - len(missing), len(tiles))
    xy = fleet.traces[["x", "y"]].to_numpy(np.float64)
    point_rows = rows_of_points(fleet)
    squares = (
        _Squares.of(xy, np.flatnonzero(usable), options.tile),
        _Squares.of(xy[point_rows], np.flatnonzero(np.append(usable, False)[point_rows]), options.tile),
    )
    jobs = ((tile, *_cut(fleet, held, point_rows, squares, tile), options) for tile in missing)
    made = (_align_tile(*job) for job in jobs) if workers == 1 else in_processes(_align_tile, jobs, workers)
    for tile, moves in zip(missing, made, strict=True):
        workspace.write_arrays(ALIGNED_TILE, tile.name, **moves._asdict())
        yield tile, moves


@dataclass(frozen=True)
class _Squares:
    """Rows sorted by squares of the plane, so that a tile can be cut without a pass over all rows."""

    size: float  # m
    rows: dict[tuple[int, int], NDArray[np.int64]]

    @classmethod
    def of(cls, xy: NDArray[np.float64], rows: NDArray[np.int64], size: float) -> _Squares:
        """Return the index of squares for positions, shape ``(n, 2)``."""
        column, row = np.floor(xy[rows] / size).astype(np.int64).T
        order = np.lexsort((row, column))
        ends = np.flatnonzero((np.diff(column[order]) != 0) | (np.diff(row[order]) != 0)) + 1
        parts = np.split(order, ends) if len(order) else []
        return cls(size, {(int(column[part[0]]), int(row[part[0]])): rows[part] for part in parts})

    def touching(self, box: tuple[float, float, float, float]) -> NDArray[np.int64]:
        """Return the rows of all squares that a box overlaps, ascending."""
        left, bottom, right, top = (int(np.floor(edge / self.size)) for edge in box)
        places = ((column, row) for column in range(left, right + 1) for row in range(bottom, top + 1))
        parts = [self.rows[place] for place in places if place in self.rows]
        return np.sort(np.concatenate(parts)) if parts else np.zeros(0, np.int64)


def _cut(
    fleet: Fleet,
    held: NDArray[np.bool_],
    point_rows: NDArray[np.int64],
    squares: tuple[_Squares, _Squares],
    tile: Tile,
) -> tuple[Fleet, NDArray[np.int64], NDArray[np.bool_]]:
    """Return the part of a fleet inside a tile and its margin, its rows, and which of its drives do not move.

    The squares are those of the usable fixes and of the points seen from them.
    """
    left, bottom, right, top = tile.box
    x, y = (fleet.traces[axis].to_numpy() for axis in "xy")

    def inside(rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        return (x[rows] >= left) & (x[rows] < right) & (y[rows] >= bottom) & (y[rows] < top)

    fixes, points = (part.touching(tile.box) for part in squares)
    rows, seen = fixes[inside(fixes)], points[inside(point_rows[points])]
    part = Fleet(
        fleet.traces.iloc[rows].reset_index(drop=True), fleet.points.iloc[seen].reset_index(drop=True), fleet.crs
    )
    return part, rows, held[fleet.owner[rows[part.starts[:-1]]]]


def _align_tile(
    tile: Tile, part: Fleet, rows: NDArray[np.int64], held: NDArray[np.bool_], options: AlignOptions
) -> TileMoves:
    """Align one tile."""
    if part.n_traces == 0:
        none = np.zeros(0, np.int64)
        return TileMoves(none, np.zeros((0, 4)), np.zeros(0), none, np.zeros((0, 2)))
    area = align_area(part, options, held=held)
    shift = _fix_moves(part, area)
    left, bottom, right, top = tile.box
    x, y = (part.traces[axis].to_numpy() for axis in "xy")
    inwards = np.minimum.reduce([x - left, right - x, y - bottom, top - y])
    weight = np.clip(inwards / (2.0 * tile.margin), _LEAST_WEIGHT, 1.0)
    seen_from = rows[area.frames.row[area.residual_keyframe]]
    return TileMoves(rows, shift, weight, seen_from, np.column_stack([area.residual_before, area.residual]))


def _fix_moves(part: Fleet, area: AlignedArea) -> NDArray[np.float64]:
    """Interpolate the move of every fix (n, 4) from the moves of the keyframes around it."""
    frames = area.frames
    n = len(part.traces)
    before = np.searchsorted(frames.row, np.arange(n), side="right") - 1
    after = np.minimum(before + 1, len(frames.row) - 1)
    after = np.where(frames.chain[after] == frames.chain[before], after, before)
    gap = frames.distance[after] - frames.distance[before]
    share = np.where(gap > 0, (frames.fix_distance - frames.distance[before]) / np.maximum(gap, 1e-9), 0.0)
    xy = part.traces[["x", "y"]].to_numpy(np.float64)
    dz = np.nan_to_num(area.z - frames.z)
    shift = np.zeros((n, 4))
    for k, weight in ((before, 1.0 - share), (after, share)):
        turn = wrapped(area.pose[k, 2] - frames.pose[k, 2])
        away = xy - frames.pose[k, :2]
        cos, sin = np.cos(turn), np.sin(turn)
        shift[:, 0] += weight * (area.pose[k, 0] + cos * away[:, 0] - sin * away[:, 1] - xy[:, 0])
        shift[:, 1] += weight * (area.pose[k, 1] + sin * away[:, 0] + cos * away[:, 1] - xy[:, 1])
        shift[:, 2] += weight * turn
        shift[:, 3] += weight * dz[k]
    return shift
