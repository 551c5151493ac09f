"""Samples: squares of a scene, randomly rotated, thinned and disturbed, as count rasters with their labels.

Everything happens to the vectors before they are drawn, so that a sample has what real rasters have: lines one
pixel wide at any angle, and counts that are whole. Drives are left out before edges are counted, so that the
label of a thinned sample is what enough of the remaining drives passed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.benchmark.sets.tiles import TILE_SIZE
from probe2road.bounds import AtLeast, NotEmpty, NotNegative, Positive, Share
from probe2road.options import checked
from probe2road.raster.counts import count_pixels
from probe2road.raster.drawing import draw_lines
from probe2road.training.cameras import CameraOptions, Points, seen_points
from probe2road.training.scene import Scene, rows_around

__all__ = ["Sample", "SampleOptions", "Vectors", "draw_sample", "sample_vectors", "square", "square_vectors"]

# Places to columns and rows, turned by no, one, two and three right angles.
_TURNS = np.array([[[1, 0], [0, -1]], [[0, 1], [1, 0]], [[-1, 0], [0, 1]], [[0, -1], [-1, 0]]], np.float64)
_SEGMENT = 150.0  # m; a longer step is no segment (`probe2road.fleet.contract.TraceGaps.max_step`)
_LATE = 5.0  # s; a longer interval is a gap (`probe2road.fleet.contract.TraceGaps.max_interval`)
_LATE_INTERVALS = 3.0  # or as many times the interval between fixes, where that is more
_FAST = 40.0  # m/s; with sparse fixes a segment may be as long as what is driven so fast in one interval


@dataclass(frozen=True)
@checked
class SampleOptions:
    """The size of samples, and how they vary."""

    size: Annotated[int, AtLeast(32)] = 384  # pixels of 1 m
    min_drives: NotNegative[int] = 4  # distinct drives that make an edge a label; the N of the paper
    label_width: Positive[int] = 3  # pixels
    rotation: Literal["none", "right_angles", "any"] = "any"  # what samples are turned by
    flip: bool = True  # whether half of the samples are mirrored
    busy_share: Share = 0.5  # of the samples, centred near junctions and crossings
    jitter: Share = 0.3  # of the size, by which a centre lies beside the road
    tiles: bool = False  # whether centres are those of the tiles of the benchmark, each as likely, instead
    all_drives_share: Share = 0.4  # of the samples, with all drives
    least_drives: Share = 0.05  # share of the drives that the thinnest sample keeps
    intervals: Annotated[tuple[NotNegative[float], ...], NotEmpty()] = (0.0,)  # s between fixes, one drawn; 0 keeps all
    offsets: Annotated[tuple[NotNegative[float], ...], NotEmpty()] = (0.0,)  # m, 1 sigma of a drive's shift, one drawn
    least_points: Share = 0.3  # share of the semantic points that the poorest sample keeps
    cameras: CameraOptions = field(default_factory=CameraOptions)  # which points are seen at all


@dataclass(frozen=True)
class Sample:
    """The input of the network and its label."""

    counts: NDArray[np.uint32]  # (3, size, size)
    label: NDArray[np.uint8]  # (size, size), 1 on a centreline


@dataclass(frozen=True)
class Vectors:
    """The lines and points to draw in a sample, in its pixels; positions may lie outside.

    Letters: f fixes, p semantic points, v vertices of the edges that are the label.
    """

    size: int  # pixels
    row: NDArray[np.int64]  # (f,) of the fixes in driving order
    col: NDArray[np.int64]  # (f,)
    z: NDArray[np.float32]  # (f,) m
    breaks: NDArray[np.bool_]  # (f,) where no segment leads from the fix before
    point_row: NDArray[np.int64]  # (p,)
    point_col: NDArray[np.int64]  # (p,)
    point_kind: NDArray[np.int64]  # (p,) position in POINT_KINDS
    label_row: NDArray[np.int64]  # (v,)
    label_col: NDArray[np.int64]  # (v,)
    label_edge: NDArray[np.int64]  # (v,) edge of each vertex

    def drawn(self, label_width: int) -> Sample:
        """Draw the rasters of the sample."""
        shape = self.size, self.size
        points = self.point_row, self.point_col, self.point_kind
        counts = count_pixels(self.row, self.col, self.breaks, *points, shape)
        return Sample(counts, draw_lines(self.label_row, self.label_col, self.label_edge, shape, width=label_width))


@dataclass(frozen=True)
class _Traces:
    """The fixes around a frame, in driving order; coordinates in metres from the scene's origin."""

    xy: NDArray[np.float32]  # (f, 2)
    z: NDArray[np.float32]  # (f,)
    breaks: NDArray[np.bool_]  # (f,) where no segment leads from the fix before


@dataclass(frozen=True)
class _Frame:
    """The frame of a sample: pixel = turn @ (place - centre) + size / 2."""

    centre: tuple[float, float]  # m from the scene's origin
    turn: NDArray[np.float64]  # (2, 2): place to (column, row)
    size: int

    def pixels(self, xy: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and columns of places ``(n, 2)``."""
        moved = (xy - np.asarray(self.centre)) @ self.turn.T + self.size / 2
        col, row = np.floor(moved).astype(np.int64).T
        return np.ascontiguousarray(row), np.ascontiguousarray(col)


def draw_sample(scene: Scene, rng: np.random.Generator, options: SampleOptions) -> Sample:
    """Return the rasters of a random sample; see `sample_vectors`."""
    return sample_vectors(scene, rng, options).drawn(options.label_width)


def square(scene: Scene, centre: tuple[float, float], options: SampleOptions) -> Sample:
    """Return the rasters of the square around a place, without any change; see `square_vectors`."""
    return square_vectors(scene, centre, options).drawn(options.label_width)


def sample_vectors(scene: Scene, rng: np.random.Generator, options: SampleOptions) -> Vectors:
    """Choose a place, a rotation and drives at random, and return what these drives recorded there.

    Parameters
    ----------
    scene
        Where from.
    rng
        Decides everything that is random.
    options
        How.

    Returns
    -------
    Vectors
    """
    frame = _Frame(_centre(scene, rng, options), _turn(rng, options), options.size)
    kept = _kept_drives(scene, rng, options)
    offset = rng.normal(0.0, rng.choice(options.offsets), (scene.n_drives, 2)).astype(np.float32)
    reach = options.size * 0.75 + 4 * float(np.abs(offset).max(initial=0.0)) + _SEGMENT
    interval, phase = float(rng.choice(options.intervals)), rng.random(scene.n_drives).astype(np.float32)
    fixes, late = _fixes(scene, frame, kept, reach), max(_LATE, _LATE_INTERVALS * interval)
    fixes = fixes[_sampled(scene.fix_drive[fixes], scene.fix_time[fixes], interval, phase)]
    traces = _traces(scene, fixes, offset, late)
    camera = rng.random(scene.n_drives) < rng.uniform(options.cameras.least_drives, 1.0)
    recorded = _points(scene, frame, kept & camera, reach, offset)
    seen = seen_points(recorded, traces.xy, traces.breaks, camera[scene.fix_drive[fixes]], rng, options.cameras)
    seen = seen.chosen(rng.random(len(seen.kind)) < rng.uniform(options.least_points, 1.0))
    return _vectors(scene, frame, traces, seen, _labelled(scene, kept, options))


def square_vectors(scene: Scene, centre: tuple[float, float], options: SampleOptions) -> Vectors:
    """Return the contents of the square around a place without any change: north up, all drives.

    Parameters
    ----------
    scene
        Where from.
    centre
        ``(x, y)`` in metres from the scene's origin.
    options
        Only ``size`` and ``min_drives`` are used.
    """
    frame = _Frame(centre, _TURNS[0], options.size)
    kept = np.ones(scene.n_drives, bool)
    reach = options.size / 2 + _SEGMENT
    offset = np.zeros((scene.n_drives, 2), np.float32)
    traces = _traces(scene, _fixes(scene, frame, kept, reach), offset, _LATE)
    return _vectors(scene, frame, traces, _points(scene, frame, kept, reach, offset), _labelled(scene, kept, options))


def _turn(rng: np.random.Generator, options: SampleOptions) -> NDArray[np.float64]:
    """Draw a rotation from places to columns and rows, by any angle or by right angles, perhaps with a reflection."""
    if options.rotation == "any":
        angle = rng.uniform(0.0, 2 * np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [-np.sin(angle), -np.cos(angle)]])
    else:
        turn = _TURNS[rng.integers(4) if options.rotation == "right_angles" else 0].copy()
    if options.flip and rng.random() < 0.5:
        turn[0] = -turn[0]
    return turn


def _centre(scene: Scene, rng: np.random.Generator, options: SampleOptions) -> tuple[float, float]:
    """Choose a place beside a road, or a tile with a road in it."""
    if options.tiles:
        tile = rng.choice(np.unique(np.floor((scene.spots + scene.origin) / TILE_SIZE), axis=0))
        x, y = (tile + 0.5) * TILE_SIZE - scene.origin
        return float(x), float(y)
    busy = np.flatnonzero(scene.spot_busy) if rng.random() < options.busy_share else np.zeros(0, np.int64)
    spot = int(rng.choice(busy)) if len(busy) else int(rng.integers(len(scene.spots)))
    aside = rng.uniform(-0.5, 0.5, 2) * options.jitter * options.size
    return float(scene.spots[spot, 0] + aside[0]), float(scene.spots[spot, 1] + aside[1])


def _kept_drives(scene: Scene, rng: np.random.Generator, options: SampleOptions) -> NDArray[np.bool_]:
    """Draw which drives are kept; their share is uniform on a logarithmic scale: shape ``(n_drives,)``."""
    if rng.random() < options.all_drives_share or options.least_drives == 1.0:
        return np.ones(scene.n_drives, bool)
    share = np.exp(rng.uniform(np.log(max(options.least_drives, 1e-3)), 0.0))
    return rng.random(scene.n_drives) < share


def _fixes(scene: Scene, frame: _Frame, kept: NDArray[np.bool_], reach: float) -> NDArray[np.int32]:
    """List the fixes of kept drives around a frame, in driving order."""
    fixes = np.sort(scene.fix_rows[rows_around(scene.fix_cells, scene.table, frame.centre, reach)])
    return fixes[kept[scene.fix_drive[fixes]]]


def _points(scene: Scene, frame: _Frame, kept: NDArray[np.bool_], reach: float, offset: NDArray[np.float32]) -> Points:
    """Return the semantic points of kept drives around a frame; each drive is moved by its offset."""
    rows = rows_around(scene.point_cells, scene.table, frame.centre, reach)
    rows = rows[kept[scene.point_drive[rows]]]
    return Points(scene.point_xy[rows] + offset[scene.point_drive[rows]], scene.point_kind[rows].astype(np.int64))


def _traces(scene: Scene, fixes: NDArray[np.int32], offset: NDArray[np.float32], late: float) -> _Traces:
    """Return fixes of a scene; each drive is moved by its offset."""
    drive, xyz = scene.fix_drive[fixes], scene.fix_xyz[fixes]
    xy = xyz[:, :2] + offset[drive]
    return _Traces(xy, xyz[:, 2], _breaks(drive, scene.fix_time[fixes], xy, late))


def _labelled(scene: Scene, kept: NDArray[np.bool_], options: SampleOptions) -> NDArray[np.int64]:
    """List the vertices of the edges that at least ``min_drives`` of the kept drives drove on."""
    total = np.concatenate([[0], np.cumsum(kept[scene.edge_drives])])
    support = total[scene.edge_starts[1:]] - total[scene.edge_starts[:-1]]
    return np.flatnonzero((support >= options.min_drives)[scene.vertex_edge])


def _vectors(scene: Scene, frame: _Frame, traces: _Traces, points: Points, vertices: NDArray[np.int64]) -> Vectors:
    """Transform traces, points and the vertices of the label to the pixels of a frame."""
    row, col = frame.pixels(traces.xy)
    point_row, point_col = frame.pixels(points.xy)
    label_row, label_col = frame.pixels(scene.vertex_xy[vertices])
    return Vectors(
        size=frame.size,
        row=row, col=col, z=traces.z, breaks=traces.breaks,
        point_row=point_row, point_col=point_col, point_kind=points.kind,
        label_row=label_row, label_col=label_col, label_edge=scene.vertex_edge[vertices].astype(np.int64),
    )  # fmt: skip


@njit(cache=True)
def _sampled(
    drive: NDArray[np.int32], time: NDArray[np.float32], interval: float, phase: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Keep the first fix of each drive in every interval; the intervals of each drive begin at a random time."""
    chosen = np.ones(len(drive), np.bool_)
    if interval <= 0.0:
        return chosen
    for i in range(1, len(drive)):
        if drive[i] == drive[i - 1]:
            now = np.floor(time[i] / interval + phase[drive[i]])
            chosen[i] = now != np.floor(time[i - 1] / interval + phase[drive[i]])
    return chosen


def _breaks(
    drive: NDArray[np.int32], time: NDArray[np.float32], xy: NDArray[np.float32], late: float
) -> NDArray[np.bool_]:
    """Mark fixes with no segment from the fix before: another drive, a gap in time, or too long a step."""
    breaks = np.ones(len(drive), bool)
    step = np.hypot(*np.diff(xy, axis=0).T)
    limit = max(_SEGMENT, _FAST * late / _LATE_INTERVALS)
    breaks[1:] = (np.diff(drive) != 0) | (np.diff(time) > late) | (step > limit)
    return breaks
