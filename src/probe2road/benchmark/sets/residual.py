"""The errors that an alignment leaves, added to true poses: aligned fleet data without running an alignment.

Alignment brings the drives together to decimetres and cannot know where the whole lies: what all receivers got
wrong at a place stays in the map. Both parts vary slowly, the first along each drive, the second over the plane.

Strategy: a smooth random function of one coordinate (metres along the drive) or two (a place) is a sum of cosine
waves with random directions, lengths and phases. Its covariance is a Gaussian of the distance, it needs no grid,
and any row can be computed without the rows before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from probe2road.bounds import NotNegative, Positive
from probe2road.options import checked

__all__ = ["ResidualModel", "align_drives"]

_STREAM = 3  # first key of the random streams; the simulator has 0 to 2
_PLACE, _DRIVE = 0, 1  # second key
_COURSE = 8.0  # poses over which headings are averaged, 20 m
_PLACE_WAVES, _DRIVE_WAVES = 64, 24  # waves in a sum; more are closer to a normal distribution, and slower


@dataclass(frozen=True)
@checked
class ResidualModel:
    """How far aligned poses are from the truth; each value is one sigma.

    Published systems that align camera points of fleets report less than 0.2 m at signs (Dabeer et al. 2017, 25
    journeys) and less than 0.5 m on average (Immel et al. 2023); a floor stays that the bias of GNSS sets
    (Stoven-Dubois et al. 2019). The matching of points to lines that does it has a deviation of 0.15 m to 0.3 m
    across the road and none along it, where only the ends of dashes and curves hold (METHOD 9.1, 9.2). Lengths
    are chosen: a few hundred metres are what odometry of 0.2 % carries to within these errors.
    """

    place_sigma: NotNegative[float] = 0.7  # m, east and north each, the same for all drives at a place
    place_height_sigma: NotNegative[float] = 0.8  # m, up, likewise
    place_length: Positive[float] = 1000.0  # m, scale over which the error of the place varies
    lateral_sigma: NotNegative[float] = 0.2  # m, across the road, of each drive for itself
    longitudinal_sigma: NotNegative[float] = 0.6  # m, along the road, likewise
    height_sigma: NotNegative[float] = 0.15  # m, up, likewise
    heading_sigma: NotNegative[float] = 0.1  # degrees, likewise
    drive_length: Positive[float] = 250.0  # m, scale over which the error of a drive varies

    @property
    def accuracy(self) -> float:
        """Return the horizontal error of a pose, one sigma in any direction, m."""
        return float(np.sqrt(self.place_sigma**2 + (self.lateral_sigma**2 + self.longitudinal_sigma**2) / 2.0))


def align_drives(
    traces: pd.DataFrame, points: pd.DataFrame, poses: pd.DataFrame, model: ResidualModel, *, seed: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the fleet data that an alignment of raw fleet data would leave.

    Every pose moves to the true one plus the residual error, and the points that the vehicle saw from it move with
    it as one rigid body: what the camera measured wrongly stays wrong.

    Parameters
    ----------
    traces, points
        Raw fleet data with ``heading``, as `probe2road.simulation.fleet_simulation.simulate` makes it. The points may
        be empty.
    poses
        The true poses, row by row those of ``traces``.
    model
        Size and scale of the errors.
    seed
        Decides the errors; those of a drive depend on it and on the ``trace_id`` alone, so that drives may be
        aligned in any portions.

    Returns
    -------
    traces, points
        New tables; ``accuracy`` is what the model says.

    Examples
    --------
    Without residual errors the truth comes out:

    >>> from probe2road.simulation.fleet_simulation import simulate
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> made = simulate(network_from_sections([[(0, 0), (2000, 0)]], crs="EPSG:32616"), n_drives=1)
    >>> none = ResidualModel(0.0, 0.0, 1000.0, 0.0, 0.0, 0.0, 0.0)
    >>> traces, points = align_drives(made.fleet.traces, made.fleet.points, made.poses, none, seed=1)
    >>> traces[["x", "y", "z", "heading"]].equals(made.poses[["x", "y", "z", "heading"]])
    True
    """
    xyz = poses[["x", "y", "z"]].to_numpy(np.float64)
    heading = poses["heading"].to_numpy(np.float64)
    numbers = poses["trace_id"].to_numpy(np.int64)
    place = _place_errors(xyz[:, :2], model, seed)
    own = np.zeros((len(poses), 4))  # right, ahead, up (m), heading (degrees)
    course = np.zeros(len(poses))
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    for first, last in zip(starts, np.append(starts[1:], len(numbers)), strict=True):
        own[first:last] = _drive_errors(xyz[first:last], model, _stream(seed, _DRIVE, int(numbers[first])))
        # The direction of the road: errors do not swing with a vehicle that weaves in its lane.
        course[first:last] = gaussian_filter1d(np.unwrap(np.radians(heading[first:last])), _COURSE, mode="nearest")
    sin, cos = np.sin(course), np.cos(course)
    shift = np.column_stack([own[:, 0] * cos + own[:, 1] * sin, own[:, 1] * cos - own[:, 0] * sin, own[:, 2]])
    moved = (xyz + place + shift).round(2)
    turned = (heading + own[:, 3]).round(2) % 360.0
    aligned = traces.assign(
        x=moved[:, 0], y=moved[:, 1], z=moved[:, 2], heading=turned, accuracy=round(model.accuracy, 2)
    )
    return aligned, _moved_points(points, traces, aligned)


def _place_errors(xy: NDArray[np.float64], model: ResidualModel, seed: int) -> NDArray[np.float64]:
    """Return the errors that all drives share at positions: shape ``(n, 3)``, m east, north and up."""
    rng = _stream(seed, _PLACE)
    sigmas = (model.place_sigma, model.place_sigma, model.place_height_sigma)
    return np.column_stack([sigma * _smooth(xy / model.place_length, _PLACE_WAVES, rng) for sigma in sigmas])


def _drive_errors(xyz: NDArray[np.float64], model: ResidualModel, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the errors of one drive: shape ``(n, 4)``, m to the right, ahead and up, and degrees of heading."""
    step = np.hypot(np.diff(xyz[:, 0], prepend=xyz[0, 0]), np.diff(xyz[:, 1], prepend=xyz[0, 1]))
    along = np.cumsum(step)[:, None] / model.drive_length
    sigmas = (model.lateral_sigma, model.longitudinal_sigma, model.height_sigma, model.heading_sigma)
    return np.column_stack([sigma * _smooth(along, _DRIVE_WAVES, rng) for sigma in sigmas])


def _smooth(at: NDArray[np.float64], waves: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a smooth random function of variance 1 and scale 1 at positions ``(n, d)``: shape ``(n,)``."""
    frequency = rng.standard_normal((waves, at.shape[1]))
    phase = rng.uniform(0.0, 2.0 * np.pi, waves)
    return _sum_waves(np.ascontiguousarray(at), frequency, phase)


@njit(cache=True)
def _sum_waves(
    at: NDArray[np.float64], frequency: NDArray[np.float64], phase: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a sum of cosines, shape ``(n,)``, at positions ``(n, d)``; frequencies ``(k, d)``, phases ``(k,)``."""
    out = np.zeros(len(at))
    scale = np.sqrt(2.0 / len(phase))
    for i in range(len(at)):
        total = 0.0
        for k in range(len(phase)):
            angle = phase[k]
            for axis in range(at.shape[1]):
                angle += frequency[k, axis] * at[i, axis]
            total += np.cos(angle)
        out[i] = scale * total
    return out


def _moved_points(points: pd.DataFrame, old: pd.DataFrame, new: pd.DataFrame) -> pd.DataFrame:
    """Move points with the poses that they were seen from."""
    row = _rows_of_points(points, old)
    before, after = (table[["x", "y", "z"]].to_numpy(np.float64)[row] for table in (old, new))
    turn = np.radians(new["heading"].to_numpy(np.float64) - old["heading"].to_numpy(np.float64))[row]
    sin, cos = np.sin(turn), np.cos(turn)
    east, north, up = (points[["x", "y", "z"]].to_numpy(np.float64) - before).T
    # Headings count clockwise, so a positive turn moves what lies ahead to the right.
    moved = after + np.column_stack([east * cos + north * sin, north * cos - east * sin, up])
    return points.assign(**dict(zip("xyz", moved.round(2).T, strict=True)))


def _rows_of_points(points: pd.DataFrame, traces: pd.DataFrame) -> NDArray[np.int64]:
    """Return the row of the fix that each point was seen from: the fix of its drive at its time."""
    rows = pd.DataFrame({"trace_id": traces["trace_id"], "t": traces["t"], "row": np.arange(len(traces))})
    found = points[["trace_id", "t"]].merge(rows.drop_duplicates(["trace_id", "t"]), how="left")["row"]
    return found.to_numpy(np.int64)


def _stream(seed: int, *keys: int) -> np.random.Generator:
    """Return the random stream of a place or a drive: a function of the seed and the keys alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM, *keys)))
