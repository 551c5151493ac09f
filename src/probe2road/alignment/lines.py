"""Lines that several drives saw, points matched to them, and one factor for all matches of a keyframe to a patch.

Strategy
--------
Once drives are registered, the markings at a place form sharp peaks across the road. Each peak of a cell is a line,
straight over its ten metres, with a slope of its own because a spine may change lanes. A point belongs to the nearest
line of its floor and kind within the gate, and its residual is the distance across (point to line, METHOD 9.2). What
all points of a keyframe say about its pose relative to a patch of road is a quadratic form of three variables, so
hundreds of thousands of residuals become one 3 x 3 information matrix for each pair of keyframe and patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from probe2road.alignment.options import AlignOptions

__all__ = ["Condensed", "LineMatches", "condense", "match_lines"]

_BIN = 0.1  # m, of the profile in which peaks are found
_HALF_WIDTH = 25.0  # m, to either side of a spine
_PEAK_APART = 1.2  # m; of two peaks nearer than this, only the higher one is a line: the other may be misplaced drives
_LEAST_POINTS = 5.0  # fewest points of a line
_STEEPEST = 0.1  # m of slope per metre along
_INDEPENDENT = 8.0  # points of a keyframe that count; more share their errors
_LOOSE = np.diag([1e-4, 1e-4, 1e-2])  # information that keeps a factor regular: 100 m, 6 degrees


@dataclass(frozen=True)
class LineMatches:
    """m points matched to lines."""

    point: NDArray[np.int64]  # (m,) index of the point
    line: NDArray[np.int64]  # (m,)
    residual: NDArray[np.float64]  # (m,) m to the left of the line
    slope: NDArray[np.float64]  # (m,) of the line against the spine, radians


@dataclass(frozen=True)
class Condensed:
    """Measurements of the poses of keyframes relative to patches: q pairs, one row for each."""

    keyframe: NDArray[np.int64]  # (q,)
    patch: NDArray[np.int64]  # (q,)
    correction: NDArray[np.float64]  # (q, 3) m forward, m to the left, radians: to be applied to the keyframe
    information: NDArray[np.float64]  # (q, 3, 3) of that correction, in the frame of the keyframe


def match_lines(
    floor: NDArray[np.int64],
    along: NDArray[np.float64],
    left: NDArray[np.float64],
    kind: NDArray[np.int8],
    drive: NDArray[np.int64],
    options: AlignOptions,
    *,
    gate: float,
) -> LineMatches:
    """Find the lines that enough drives saw, and match points to them.

    Parameters
    ----------
    floor, along, left
        Where the points are: floor (-1 for none), m along their cell's spine, m to its left. Shape ``(p,)``.
    kind
        What they are; unlike kinds do not share a line.
    drive
        Who saw them.
    options
        How many drives make a line.
    gate
        Distance to a line within which a point belongs to it, m.

    Returns
    -------
    LineMatches

    Examples
    --------
    >>> left = np.array([0.0, 0.1, 0.0, 0.1, 0.05, 3.0])
    >>> zeros = np.zeros(6, np.int64)
    >>> drive = np.array([0, 0, 0, 1, 1, 1])
    >>> matches = match_lines(zeros, np.arange(6.0), left, zeros.astype(np.int8), drive, AlignOptions(), gate=0.5)
    >>> matches.point.tolist()
    [0, 1, 2, 3, 4]
    """
    usable = np.flatnonzero((floor >= 0) & (np.abs(left) < _HALF_WIDTH))
    group = floor[usable] * 2 + kind[usable]
    peak_group, peak_left = _peaks(group, left[usable], gate)
    line = _nearest_peak(peak_group, peak_left, group, left[usable], gate)
    point, line = usable[line >= 0], line[line >= 0]
    if len(point) == 0:
        return LineMatches(point, line, np.zeros(0), np.zeros(0))
    residual, slope = _residuals(line, along[point], left[point])
    pairs = np.unique(line * (int(drive.max()) + 1) + drive[point]) // (int(drive.max()) + 1)
    drives = np.bincount(pairs, minlength=len(peak_left))
    kept = (drives[line] >= options.min_drives) & (np.bincount(line)[line] >= _LEAST_POINTS)
    kept &= np.abs(residual) < gate
    return LineMatches(point[kept], line[kept], residual[kept], slope[line[kept]])


def condense(
    matches: LineMatches,
    keyframe: NDArray[np.int64],
    patch: NDArray[np.int64],
    body: NDArray[np.float64],
    spine_angle: NDArray[np.float64],
    sigma: NDArray[np.float64],
    *,
    gate: float,
) -> Condensed:
    """Sum up what the points of a keyframe measure about its pose relative to each patch.

    Parameters
    ----------
    matches
        The matched points.
    keyframe, patch
        Of each match, shape ``(m,)``.
    body
        Where each matched point is in the frame of its keyframe, m forward and to the left, shape ``(m, 2)``.
    spine_angle
        Direction of the spine there in the frame of the keyframe, radians, shape ``(m,)``.
    sigma
        Of each point across its line, m, shape ``(m,)``.
    gate
        Residuals of half the gate lose three quarters of their weight (Geman-McClure).

    Returns
    -------
    Condensed
    """
    angle = spine_angle + matches.slope
    normal = np.column_stack([-np.sin(angle), np.cos(angle)])
    lever = body[:, 0] * normal[:, 1] - body[:, 1] * normal[:, 0]
    jacobian = np.column_stack([normal, lever])
    scale = (gate / 2.0) ** 2
    weight = (scale / (scale + matches.residual**2)) ** 2 / sigma**2

    span = int(patch.max(initial=0)) + 1
    pair, index = np.unique(keyframe * span + patch, return_inverse=True)
    points = np.bincount(keyframe, minlength=int(keyframe.max(initial=0)) + 1)[keyframe]
    weight *= np.minimum(1.0, _INDEPENDENT / np.maximum(points, 1))
    information = np.empty((len(pair), 3, 3))
    gradient = np.empty((len(pair), 3))
    for i in range(3):
        gradient[:, i] = np.bincount(index, weight * jacobian[:, i] * matches.residual, len(pair))
        for j in range(3):
            information[:, i, j] = np.bincount(index, weight * jacobian[:, i] * jacobian[:, j], len(pair))
    information += _LOOSE
    correction = np.asarray(-np.linalg.solve(information, gradient[:, :, None])[:, :, 0], np.float64)
    return Condensed(pair // span, pair % span, correction, information)


def _peaks(
    group: NDArray[np.int64], left: NDArray[np.float64], gate: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the peaks of the point density across the road in each group: return group and offset (m), sorted."""
    n_bins = int(2 * _HALF_WIDTH / _BIN)
    groups, index = np.unique(group, return_inverse=True)
    bins = np.clip(((left + _HALF_WIDTH) / _BIN).astype(np.int64), 0, n_bins - 1)
    density = np.bincount(index * n_bins + bins, minlength=len(groups) * n_bins).reshape(-1, n_bins).astype(np.float32)
    width = gate / 5.0  # wide in the first rounds, when drives still scatter
    density = gaussian_filter1d(density, width / _BIN, axis=1, mode="constant")
    least = 0.5 * _LEAST_POINTS * _BIN / (width * np.sqrt(2.0 * np.pi))
    apart = 2 * round(_PEAK_APART / _BIN) + 1
    density += np.linspace(0.0, 0.02, n_bins, dtype=np.float32)  # so that one of two equal peaks is higher
    row, at = np.nonzero((density == maximum_filter1d(density, apart, axis=1)) & (density > least))
    return groups[row], np.asarray((at + 0.5) * _BIN - _HALF_WIDTH, np.float64)


def _nearest_peak(
    peak_group: NDArray[np.int64],
    peak_left: NDArray[np.float64],
    group: NDArray[np.int64],
    left: NDArray[np.float64],
    gate: float,
) -> NDArray[np.int64]:
    """Return the nearest peak of its group for each point, -1 if none is within the gate."""
    if len(peak_group) == 0:
        return np.full(len(group), -1, np.int64)
    span = 4.0 * _HALF_WIDTH  # groups lie this far apart on one axis, so that one search serves all
    key, wanted = peak_group * span + peak_left, group * span + left
    after = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(key[after] - wanted) < np.abs(key[before] - wanted), after, before)
    return np.where(np.abs(key[nearest] - wanted) <= gate, nearest, -1)


def _residuals(
    line: NDArray[np.int64], along: NDArray[np.float64], left: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a straight line to the points of each line: return the residual of each point (m,), and the slopes."""
    count = np.maximum(np.bincount(line), 1)
    mean_along, mean_left = (np.bincount(line, values) / count for values in (along, left))
    da, dl = along - mean_along[line], left - mean_left[line]
    # One square metre for each point keeps short stretches of line from rotating.
    slope = np.bincount(line, da * dl) / (np.bincount(line, da * da) + count)
    slope = np.clip(slope, -_STEEPEST, _STEEPEST)
    return dl - slope[line] * da, slope
