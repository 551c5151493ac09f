"""Plane curves that a road can follow, as arrays of points about two metres apart.

Headings here are mathematical: radians counterclockwise from east. Every curve leaves and arrives tangentially.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe2road.errors import OptionError

__all__ = ["Pose", "along", "dubins", "hermite", "offset_path", "path_length", "polyline", "resample", "wander"]

Path = NDArray[np.float64]  # (k, 2)

_STEP = 2.0  # m between the points of a curve


@dataclass(frozen=True)
class Pose:
    """A position (m) and a heading (rad, counterclockwise from east)."""

    x: float
    y: float
    heading: float

    def moved(self, ahead: float, right: float = 0.0) -> Pose:
        """Return the pose moved in its own frame (m)."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return Pose(float(self.x + ahead * c + right * s), float(self.y + ahead * s - right * c), self.heading)

    def turned(self, left: float) -> Pose:
        """Return the pose turned to the left (rad)."""
        return Pose(self.x, self.y, self.heading + left)

    @property
    def xy(self) -> Path:
        """Return the position, shape ``(2,)``."""
        return np.array([self.x, self.y])


def polyline(*points: tuple[float, float]) -> Path:
    """Return straight lines through points."""
    return resample(np.array(points, dtype=float))


def resample(path: Path, step: float = _STEP) -> Path:
    """Return points at equal distances of at most ``step`` (m) along a path, including its ends.

    Examples
    --------
    >>> resample(np.array([[0.0, 0.0], [3.0, 0.0]])).tolist()
    [[0.0, 0.0], [1.5, 0.0], [3.0, 0.0]]
    """
    s = _arc(path)
    at = np.linspace(0.0, s[-1], max(int(np.ceil(s[-1] / step)), 1) + 1)
    return np.column_stack([np.interp(at, s, path[:, 0]), np.interp(at, s, path[:, 1])])


def path_length(path: Path) -> float:
    """Return the length of a path (m)."""
    return float(_arc(path)[-1])


def along(path: Path, s: float, *, right: float = 0.0) -> Pose:
    """Return the pose at a distance along a path, moved to the right (m).

    Examples
    --------
    >>> along(polyline((0, 0), (10, 0)), 4.0, right=1.0)
    Pose(x=4.0, y=-1.0, heading=0.0)
    """
    arc, (dx, dy) = _arc(path), _tangents(path).T
    heading = np.arctan2(np.interp(s, arc, dy), np.interp(s, arc, dx))
    x, y = np.interp(s, arc, path[:, 0]), np.interp(s, arc, path[:, 1])
    return Pose(float(x), float(y), float(heading)).moved(0.0, right)


def offset_path(path: Path, right: ArrayLike) -> Path:
    """Move a path to the right by one distance (m), or by one for each of its points."""
    tangent = _tangents(path)
    return np.asarray(path + np.column_stack([tangent[:, 1], -tangent[:, 0]]) * np.reshape(right, (-1, 1)))


def hermite(start: Pose, end: Pose, *, stretch: float = 1.0) -> Path:
    """Return the cubic curve between two poses; with ``stretch`` 1 it is close to a circular arc, if one fits.

    Examples
    --------
    A quarter circle of 100 m keeps its radius to 1 %:

    >>> quarter = hermite(Pose(0, 0, 0.0), Pose(100, 100, np.pi / 2))
    >>> bool(np.abs(np.hypot(quarter[:, 0], quarter[:, 1] - 100) - 100).max() < 1.0)
    True
    """
    turn = abs((end.heading - start.heading + np.pi) % (2 * np.pi) - np.pi)
    # The handle of a circular arc of this turn over this chord; a third of the chord for a straight line.
    chord = float(np.hypot(*(end.xy - start.xy)))
    handle = stretch * chord * (2 / 3) / (1 + np.cos(turn / 2))
    p0, p3 = start.xy, end.xy
    p1, p2 = start.moved(handle).xy, end.moved(-handle).xy
    t = np.linspace(0.0, 1.0, max(int(chord), 8) + 1)[:, None]
    curve = (1 - t) ** 3 * p0 + 3 * t * (1 - t) ** 2 * p1 + 3 * t**2 * (1 - t) * p2 + t**3 * p3
    return resample(curve)


def dubins(start: Pose, end: Pose, *, radius: float, word: str) -> Path:
    """Return a path of an arc, a straight line and an arc between two poses.

    Parameters
    ----------
    radius
        Of both arcs (m).
    word
        Turn of the first arc and of the second: ``"LL"``, ``"RR"``, ``"LR"``, ``"RL"``.

    Raises
    ------
    OptionError
        If the poses are too close for a path with these turns.

    Examples
    --------
    >>> loop = dubins(Pose(60, 0, 0.0), Pose(0, -60, np.pi / 2), radius=60.0, word="RR")
    >>> round(path_length(loop) / 60.0 / np.pi, 2)
    1.5
    """
    side = {"L": 1.0, "R": -1.0}
    first, second = side[word[0]], side[word[1]]
    c0, c1 = (pose.moved(0.0, -turn * radius).xy for pose, turn in ((start, first), (end, second)))
    dx, dy = c1 - c0
    distance, angle = float(np.hypot(dx, dy)), float(np.arctan2(dy, dx))
    if first != second:
        if distance < 2 * radius:
            raise OptionError(f"no {word} path of radius {radius:.0f} m", where="dubins", fix="use a smaller radius")
        angle += first * np.arcsin(2 * radius / distance)
    if distance < 1e-9:
        angle = end.heading
    arcs = []
    for pose, turn, centre, to in ((start, first, c0, angle), (end, second, c1, end.heading)):
        begin = pose.heading if pose is start else angle
        sweep = (turn * (to - begin)) % (2 * np.pi)
        sweep = 0.0 if sweep > 2 * np.pi - 1e-6 else sweep
        heading = begin + turn * np.linspace(0.0, sweep, int(np.ceil(radius * sweep / _STEP)) + 1)
        arcs.append(centre + turn * radius * np.column_stack([np.sin(heading), -np.cos(heading)]))
    return resample(np.concatenate(arcs))


def wander(rng: np.random.Generator, length: float, *, radius: float, start: Pose | None = None) -> Path:
    """Return a random road of clothoids: curvature changes linearly between random values.

    Parameters
    ----------
    length
        Of the path (m).
    radius
        Smallest radius (m).
    """
    start = start or Pose(0.0, 0.0, 0.0)
    s = np.arange(0.0, length + _STEP, _STEP)
    knots = np.arange(0.0, length + 800.0, 400.0)
    curvature = rng.uniform(-1.0, 1.0, len(knots)) / radius * (rng.random(len(knots)) < 0.7)
    heading = start.heading + np.cumsum(np.interp(s, knots, curvature)) * _STEP
    xy = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]) * _STEP, axis=0)
    return np.asarray(start.xy + xy - xy[0])


def _arc(path: Path) -> NDArray[np.float64]:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])


def _tangents(path: Path) -> Path:
    """Return unit tangents of a path at its points."""
    tangent = np.gradient(path, axis=0)
    return np.asarray(tangent / np.maximum(np.hypot(*tangent.T), 1e-12)[:, None])
