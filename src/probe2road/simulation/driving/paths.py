"""The path that a vehicle drives: lane by lane along its route, smooth in plan at every join.

Strategy
--------
Each link is sampled every two metres at the lateral offset of its lane, with lane changes as smooth steps. Where two
links continue each other, their ends may lie a little apart; the gap is closed by letting both fade towards its
middle. At a corner the two lanes are cut back and joined by the arc that touches both, so that a vehicle turns on a
circle and not on the spot. The joined line is resampled every metre and smoothed with a short Gaussian, which takes
out the corners of the polylines that maps draw curves with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from probe2road.simulation.driving.lane_choice import LinkLanes
from probe2road.simulation.driving.routes import LinkGraph
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["DrivenPath", "SectionShapes", "driven_path", "section_shapes"]

PATH_SPACING = 1.0  # m between samples of a driven path

_SPACING = 2.0  # m between samples of a link
_SMOOTHING = 3.0  # m, sigma of the Gaussian along the path
_TIGHT_SMOOTHING = 7.0  # m, the same where the path would bend more tightly than a car can
_TIGHTEST = (0.08, 0.16)  # 1/m, curvature at which the wider smoothing begins, and at which it is alone
_CORNER = 25.0  # degrees; sharper turns are driven on an arc
_TIGHT_RADIUS = 7.0  # m, of a turn towards the kerb (a car's turning circle is 5 to 6 m)
_WIDE_RADIUS = 12.0  # m, of a turn across the junction
_SHARE = 0.45  # of a link that may be cut back or faded at either end
_FADE_PER_METRE = 15.0  # m of link over which one metre of gap is closed
_MIN_FADE = 10.0  # m


class SectionShapes(NamedTuple):
    """The vertices of all section lines as flat arrays, with the data needed to walk along them.

    A named tuple, which compiled code takes whole.
    """

    xyz: NDArray[np.float64]  # (n, 3) m
    tangent: NDArray[np.float64]  # (n, 2) unit vector from u to v, the mean of both sides at a vertex
    along: NDArray[np.float64]  # (n,) m in plan from u
    indptr: NDArray[np.int64]  # (sections + 1,)

    @property
    def lengths(self) -> NDArray[np.float64]:
        """Return the length of every section in plan, m."""
        return self.along[self.indptr[1:] - 1]


@dataclass(frozen=True)
class DrivenPath:
    """A vehicle's path, one sample a metre."""

    xyz: NDArray[np.float64]  # (n, 3) m
    heading: NDArray[np.float64]  # (n,) radians clockwise from north
    curvature: NDArray[np.float64]  # (n,) 1/m, positive to the right
    position: NDArray[np.int64]  # (n,) index into the route of the link being driven
    lane: NDArray[np.int64]  # (n,) lane within the link, 0 the leftmost in the driving direction


class _Drive(NamedTuple):
    """A route of m links; see `driven_path`."""

    route: NDArray[np.int64]  # (m,)
    entered: NDArray[np.int64]  # (m,)
    left: NDArray[np.int64]  # (m,)
    change: NDArray[np.float64]  # (m, 2) m
    indptr: NDArray[np.int64]  # (m + 1,) link i has the samples indptr[i]:indptr[i + 1]


class _Links(NamedTuple):
    """The links of a network and the shapes of their lanes; see `LinkGraph` and `LinkLanes`."""

    section: NDArray[np.int64]
    direction: NDArray[np.int64]
    lane_indptr: NDArray[np.int64]
    lane_shape: NDArray[np.float64]


def section_shapes(network: RoadNetwork) -> SectionShapes:
    """Prepare the section lines of a network.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> shapes = section_shapes(network_from_sections([[(0, 0), (30, 0), (30, 40)]], crs="EPSG:32616"))
    >>> shapes.lengths.tolist(), shapes.tangent[0].tolist()
    ([70.0], [1.0, 0.0])
    """
    xyz, indptr = network.vertices()
    step = np.diff(xyz[:, :2], axis=0, append=xyz[-1:, :2])
    distance = np.hypot(step[:, 0], step[:, 1])
    last = np.zeros(len(xyz), bool)
    last[indptr[1:] - 1] = True
    distance[last] = 0.0
    unit = np.divide(step, distance[:, None], out=np.zeros_like(step), where=distance[:, None] > 0)
    before = np.roll(unit, 1, axis=0)
    before[indptr[:-1]] = 0.0
    tangent = unit + before
    size = np.hypot(tangent[:, 0], tangent[:, 1])
    tangent = np.divide(tangent, size[:, None], out=before.copy(), where=size[:, None] > 1e-9)
    walked = np.cumsum(distance) - distance
    return SectionShapes(xyz, tangent, walked - np.repeat(walked[indptr[:-1]], np.diff(indptr)), indptr)


def driven_path(
    route: NDArray[np.int64],
    entered: NDArray[np.int64],
    left: NDArray[np.int64],
    change: NDArray[np.float64],
    graph: LinkGraph,
    lanes: LinkLanes,
    shapes: SectionShapes,
) -> DrivenPath:
    """Draw the path of a vehicle.

    Parameters
    ----------
    route
        Links, shape ``(m,)``, m at least 1.
    entered, left
        Lanes in which each link is entered and left, shape ``(m,)``.
    change
        Where each link's lane change begins and ends, metres along the link, shape ``(m, 2)``.
    graph, lanes, shapes
        The network.

    Returns
    -------
    DrivenPath
        At least two samples.
    """
    count = np.maximum(np.ceil(shapes.lengths[graph.section[route]] / _SPACING).astype(np.int64), 1) + 1
    indptr = np.concatenate([[0], np.cumsum(count)])
    links = _Links(graph.section, graph.direction, lanes.indptr, lanes.shape)
    raw, tangent, along = _sample_links(_Drive(route, entered, left, change, indptr), links, shapes)
    xyz, position = _join_links(raw, tangent, along, indptr)
    return _resampled(xyz, position, entered, left, change)


@njit(cache=True)
def _sample_links(
    drive: _Drive, links: _Links, shapes: SectionShapes
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Sample every link along its lane: points ``(k, 3)``, unit directions ``(k, 2)``, metres along the link."""
    route, entered, left, change, indptr = drive
    points = np.zeros((indptr[-1], 3))
    tangent = np.zeros((indptr[-1], 2))
    along = np.zeros(indptr[-1])
    for i in range(len(route)):
        section, forward = links.section[route[i]], links.direction[route[i]] > 0
        first, last = shapes.indptr[section], shapes.indptr[section + 1] - 1
        length = shapes.along[last]
        lane = links.lane_indptr[route[i]]
        entry_lane, exit_lane = links.lane_shape[lane + entered[i]], links.lane_shape[lane + left[i]]
        vertex = first if forward else last - 1
        n = indptr[i + 1] - indptr[i]
        for k in range(n):
            s = length * k / (n - 1)  # along the drive
            at = s if forward else length - s  # along the section
            while forward and vertex < last - 1 and shapes.along[vertex + 1] < at:
                vertex += 1
            while not forward and vertex > first and shapes.along[vertex] > at:
                vertex -= 1
            row = indptr[i] + k
            _place(shapes, vertex, at, forward, points[row], tangent[row])
            old, new = _lane_offset(entry_lane, s, length), _lane_offset(exit_lane, s, length)
            moved = _smooth_step((s - change[i, 0]) / max(change[i, 1] - change[i, 0], 1e-6))
            offset = old + (new - old) * moved
            points[row, 0] += offset * tangent[row, 1]
            points[row, 1] -= offset * tangent[row, 0]
            along[row] = s
    return points, tangent, along


@njit(cache=True)
def _place(
    shapes: SectionShapes,
    vertex: int,
    at: float,
    forward: bool,
    point: NDArray[np.float64],
    tangent: NDArray[np.float64],
) -> None:
    """Write a point of a section line after a given vertex, and its unit driving direction."""
    run = shapes.along[vertex + 1] - shapes.along[vertex]
    share = (at - shapes.along[vertex]) / run if run > 0 else 0.0
    for axis in range(3):
        point[axis] = shapes.xyz[vertex, axis] * (1 - share) + shapes.xyz[vertex + 1, axis] * share
    for axis in range(2):
        tangent[axis] = shapes.tangent[vertex, axis] * (1 - share) + shapes.tangent[vertex + 1, axis] * share
    size = max(np.hypot(tangent[0], tangent[1]), 1e-9) * (1.0 if forward else -1.0)
    tangent[0], tangent[1] = tangent[0] / size, tangent[1] / size


@njit(cache=True)
def _lane_offset(shape: NDArray[np.float64], s: float, length: float) -> float:
    """Return the lateral offset of one lane, as `probe2road.simulation.lanes.lanes.lateral_offset` does."""
    start = 1.0 - _smooth_step(s / max(shape[3], 1e-9))
    end = 1.0 - _smooth_step((length - s) / max(shape[4], 1e-9))
    return shape[0] + (shape[1] - shape[0]) * start + (shape[2] - shape[0]) * end


@njit(cache=True)
def _smooth_step(t: float) -> float:
    """Return a smooth step from 0 at 0 to 1 at 1."""
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(cache=True)
def _join_links(
    points: NDArray[np.float64], tangent: NDArray[np.float64], along: NDArray[np.float64], indptr: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Close gaps and round corners: return the joined line ``(k, 3)`` and the link of each vertex."""
    m = len(indptr) - 1
    moved = points.copy()
    cut_start, cut_end = np.zeros(m), np.zeros(m)
    corner = np.zeros(m, np.bool_)  # between link i - 1 and link i
    for i in range(1, m):
        a, b = indptr[i] - 1, indptr[i]
        room_a, room_b = _SHARE * along[a], _SHARE * along[indptr[i + 1] - 1]
        cross = tangent[a, 1] * tangent[b, 0] - tangent[a, 0] * tangent[b, 1]  # positive to the right
        turn = np.arctan2(cross, tangent[a, 0] * tangent[b, 0] + tangent[a, 1] * tangent[b, 1])
        if abs(turn) > np.radians(_CORNER):
            corner[i] = True
            cut_end[i - 1], cut_start[i] = _corner_cuts(points[a], tangent[a], points[b], tangent[b], turn, cross)
            cut_end[i - 1], cut_start[i] = min(cut_end[i - 1], room_a), min(cut_start[i], room_b)
            continue
        gap = points[b] - points[a]
        fade = max(_MIN_FADE, _FADE_PER_METRE * np.hypot(gap[0], gap[1]))
        _shift_tail(moved, along, indptr[i - 1], indptr[i], 0.5 * gap, min(fade, 2.0 * room_a))
        _shift_head(moved, along, indptr[i], indptr[i + 1], -0.5 * gap, min(fade, 2.0 * room_b))
    return _assemble(moved, tangent, along, indptr, corner, cut_start, cut_end)


@njit(cache=True)
def _corner_cuts(
    end: NDArray[np.float64],
    end_tangent: NDArray[np.float64],
    start: NDArray[np.float64],
    start_tangent: NDArray[np.float64],
    turn: float,
    cross: float,
) -> tuple[float, float]:
    """Return the lengths (m) to cut off before and after a corner, so that an arc touches both lanes.

    The arc's tangents meet where the two lanes would cross, which lies before the node for a turn towards the kerb
    and behind it for a turn across.
    """
    dx, dy = start[0] - end[0], start[1] - end[1]
    ahead = (dy * start_tangent[0] - dx * start_tangent[1]) / cross  # from the end of a to the crossing
    beyond = (dy * end_tangent[0] - dx * end_tangent[1]) / cross  # from the start of b to the crossing
    radius = _TIGHT_RADIUS if ahead < 0 else _WIDE_RADIUS
    reach = radius * np.tan(min(abs(turn), 2.6) / 2.0)
    return max(reach - ahead, 0.0), max(reach + beyond, 0.0)


@njit(cache=True)
def _shift_tail(
    points: NDArray[np.float64], along: NDArray[np.float64], i0: int, i1: int, shift: NDArray[np.float64], fade: float
) -> None:
    """Move the last stretch of a link sideways, most at its end."""
    for row in range(i0, i1):
        weight = _smooth_step(1.0 - (along[i1 - 1] - along[row]) / max(fade, 1e-6))
        for axis in range(2):
            points[row, axis] += weight * shift[axis]


@njit(cache=True)
def _shift_head(
    points: NDArray[np.float64], along: NDArray[np.float64], i0: int, i1: int, shift: NDArray[np.float64], fade: float
) -> None:
    """Move the first stretch of a link sideways, most at its start."""
    for row in range(i0, i1):
        weight = _smooth_step(1.0 - along[row] / max(fade, 1e-6))
        for axis in range(2):
            points[row, axis] += weight * shift[axis]


@njit(cache=True)
def _assemble(
    points: NDArray[np.float64],
    tangent: NDArray[np.float64],
    along: NDArray[np.float64],
    indptr: NDArray[np.int64],
    corner: NDArray[np.bool_],
    cut_start: NDArray[np.float64],
    cut_end: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Concatenate the links, with a Bezier arc at every corner."""
    m = len(indptr) - 1
    arc = 13  # vertices of an arc
    out = np.zeros((indptr[-1] + arc * m, 3))
    position = np.zeros(len(out), np.int64)
    n = 0
    previous = -1  # row of the last vertex kept
    for i in range(m):
        length = along[indptr[i + 1] - 1]
        joined = False
        for row in range(indptr[i], indptr[i + 1]):
            s = along[row]
            if s < cut_start[i] or s > length - cut_end[i]:
                continue
            if i > 0 and corner[i] and not joined and previous >= 0:
                for k in range(1, arc):
                    _bezier(points[previous], tangent[previous], points[row], tangent[row], k / arc, out[n])
                    position[n] = i - 1 if 2 * k < arc else i
                    n += 1
            joined = True
            out[n], position[n] = points[row], i
            previous = row
            n += 1
    return out[:n], position[:n]


@njit(cache=True)
def _bezier(
    a: NDArray[np.float64],
    a_tangent: NDArray[np.float64],
    b: NDArray[np.float64],
    b_tangent: NDArray[np.float64],
    t: float,
    out: NDArray[np.float64],
) -> None:
    """Return points of the cubic between a and b along their tangents; with equal cuts it is nearly a circular arc."""
    chord = np.hypot(b[0] - a[0], b[1] - a[1])
    cosine = min(max(a_tangent[0] * b_tangent[0] + a_tangent[1] * b_tangent[1], -1.0), 1.0)
    half = max(np.arccos(cosine) / 2.0, 1e-3)
    handle = chord * (4.0 / 3.0) * np.tan(half / 2.0) / (2.0 * np.sin(half))
    for axis in range(2):
        p1, p2 = a[axis] + handle * a_tangent[axis], b[axis] - handle * b_tangent[axis]
        out[axis] = (1 - t) ** 3 * a[axis] + 3 * (1 - t) ** 2 * t * p1 + 3 * (1 - t) * t * t * p2 + t**3 * b[axis]
    out[2] = a[2] + t * (b[2] - a[2])


def _resampled(
    xyz: NDArray[np.float64],
    position: NDArray[np.int64],
    entered: NDArray[np.int64],
    left: NDArray[np.int64],
    change: NDArray[np.float64],
) -> DrivenPath:
    """Resample the joined line at every metre and smooth it; return the link and the lane of each sample, too."""
    step = np.hypot(np.diff(xyz[:, 0]), np.diff(xyz[:, 1]))
    kept = np.concatenate([[True], step > 1e-3])
    xyz, position = xyz[kept], position[kept]
    walked = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(xyz[:, 0]), np.diff(xyz[:, 1])))])
    s = np.arange(0.0, max(walked[-1], 2.0 * PATH_SPACING), PATH_SPACING)
    line = np.stack([np.interp(s, walked, xyz[:, axis]) for axis in range(3)], axis=1)
    line = _smoothed(line)
    dx, dy = np.gradient(line[:, 0], PATH_SPACING), np.gradient(line[:, 1], PATH_SPACING)
    heading = np.unwrap(np.arctan2(dx, dy))
    link = position[np.searchsorted(walked, s, side="right") - 1]
    # A lane change counts from the middle of its window, measured in samples since the link was entered.
    begun = np.searchsorted(link, np.arange(len(entered)))
    middle = change.mean(axis=1)
    lane = np.where((np.arange(len(s)) - begun[link]) * PATH_SPACING < middle[link], entered[link], left[link])
    return DrivenPath(line, heading, np.gradient(heading, PATH_SPACING), link, lane)


def _smoothed(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth a line sampled at every metre, more strongly where it bends too tightly for a vehicle."""
    smooth = _gaussian(line, _SMOOTHING)
    heading = np.unwrap(np.arctan2(np.gradient(smooth[:, 0]), np.gradient(smooth[:, 1])))
    bend = np.abs(np.gradient(heading)) / PATH_SPACING
    if bend.max() <= _TIGHTEST[0]:
        return smooth
    weight = np.clip((bend - _TIGHTEST[0]) / (_TIGHTEST[1] - _TIGHTEST[0]), 0.0, 1.0)
    reach = int(_TIGHT_SMOOTHING / PATH_SPACING)
    weight = gaussian_filter1d(maximum_filter1d(weight, 2 * reach + 1), reach / 2.0)[:, None]
    return (1.0 - weight) * smooth + weight * _gaussian(line, _TIGHT_SMOOTHING)


def _gaussian(line: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Smooth a line that is mirrored at its end points, so that the ends keep their position and direction."""
    pad = min(int(4 * sigma / PATH_SPACING), len(line) - 1)
    head, tail = 2 * line[0] - line[pad:0:-1], 2 * line[-1] - line[-2 : -2 - pad : -1]
    padded = np.concatenate([head, line, tail])
    return gaussian_filter1d(padded, sigma / PATH_SPACING, axis=0, mode="nearest")[pad : pad + len(line)]
