"""The points that a forward camera reports: sparse and noisy, on lane markings and road boundaries.

Strategy
--------
The lines of the network are cut into pieces about as long as one dash and sorted into square cells. At each keyframe,
one every few metres, the cells under the field of view are visited. A piece may yield one point, at a random place on
it, with a probability that falls with range and with lateral distance; the point must then lie inside the field of
view, near the height of the road under the vehicle (a camera does not see the road above), and not behind another
vehicle. Noise follows from the geometry of one pixel seen along the road: it grows with the square of the range along
the line of sight, and with the range across it. Points are returned in the vehicle's own frame; whoever records them
puts them where the vehicle believes to be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.bounds import Above, AtLeast, Below, NotNegative, Positive
from probe2road.errors import OptionError
from probe2road.options import checked

__all__ = ["CameraModel", "Detections", "FeatureIndex", "feature_index", "see"]

LANE_MARKING, ROAD_BOUNDARY = 0, 1  # codes of the kinds, in the order of probe2road.fleet.contract.POINT_KINDS

_CELL = 20.0  # m, side of a cell of the index
_LONGEST_PIECE = 3.1  # m
_LONGEST_DASH = 12.0  # m; a longer marking is a solid line
_OCCLUDERS = 3  # the vehicle ahead, and one in the lane to either side


@dataclass(frozen=True)
@checked
class CameraModel:
    """A forward mono camera and its detector."""

    near: NotNegative[float]  # m, range at which the road comes into view above the bonnet
    far: Positive[float]  # m, range beyond which lines are not reported
    half_angle: Annotated[float, Above(0), Below(90)]  # degrees, half the horizontal field of view
    height: Positive[float]  # m above the road
    pixel: Positive[float]  # radians, angle of one pixel
    pixel_noise: NotNegative[float]  # pixels, 1 sigma, of a point's place in the image
    lateral_noise: NotNegative[float]  # m, 1 sigma, width of a painted line and its segmentation
    boundary_noise: NotNegative[float]  # the same for boundaries, as a multiple
    height_noise: NotNegative[float]  # m, 1 sigma of a point
    pitch_noise: NotNegative[float]  # degrees, 1 sigma, of the keyframe; shared by its points
    pitch_time: Positive[float]  # s, its time constant
    yaw_bias: NotNegative[float]  # degrees, 1 sigma over vehicles: mounting
    dash_points: NotNegative[float]  # expected points on a dash beside the own lane, in one pass with a clear view
    solid_points: NotNegative[float]  # on a metre of solid line: fewer than of dash, because ends are what is tracked
    boundary_points: NotNegative[float]  # on a metre of boundary
    range_decay: Positive[float]  # m, over which detection falls by e beyond the near range
    lane_reach: NotNegative[float]  # m to the side up to which markings are reported fully, those of the own lane
    lane_decay: Positive[float]  # m, sigma of the fall beyond
    boundary_reach: NotNegative[float]  # m, the same for boundaries
    boundary_decay: Positive[float]  # m
    boundary_found: Positive[float]  # m, mean length of road over which a boundary is followed
    boundary_lost: NotNegative[float]  # m, mean length over which it is not
    outage_every: Positive[float]  # m, mean distance between dropouts of the whole camera (glare, wiper, wet road)
    outage_length: NotNegative[float]  # m, mean
    traffic_share: Annotated[float, AtLeast(0), Below(1)]  # of the road with an occluding vehicle, each of three places
    traffic_length: Positive[float]  # m, mean length over which it stays
    false_rate: NotNegative[float]  # false points a metre driven
    altitude_gate: NotNegative[float]  # m of height difference beyond which a line is on another road
    altitude_slope: NotNegative[float]  # further allowance per metre of range

    def __post_init__(self) -> None:
        """Refuse cameras that cannot see anything."""
        if self.near >= self.far:
            raise OptionError(f"near is {self.near}, far is {self.far}", where="CameraModel", fix="use near < far")


class FeatureIndex(NamedTuple):
    """Pieces of lines, sorted by the cells in which they lie; n pieces, r x c cells.

    A named tuple, which compiled code takes whole.
    """

    pieces: NDArray[np.float32]  # (n, 6) x, y, z of both ends, relative to origin
    kind: NDArray[np.int8]  # (n,) LANE_MARKING or ROAD_BOUNDARY
    weight: NDArray[np.float32]  # (n,) expected points on the piece in one pass with a clear view
    feature: NDArray[np.int64]  # (n,) position of the line in the network's features
    cells: NDArray[np.int64]  # (r * c + 1,) cell k owns pieces cells[k]:cells[k + 1]
    columns: int
    origin: NDArray[np.float64]  # (3,) m, lower left corner and zero height


@dataclass(frozen=True)
class Detections:
    """The n points that a camera reported on one drive, in the frame of the vehicle."""

    keyframe: NDArray[np.int64]  # (n,) row of the pose
    body: NDArray[np.float64]  # (n, 3) m: forward, to the right, up from the road under the vehicle
    kind: NDArray[np.int8]  # (n,)
    feature: NDArray[np.int64]  # (n,) line that was seen; -1 for a false point


class _Keyframes(NamedTuple):
    """The n keyframes of a drive at which the camera detects points."""

    xyz: NDArray[np.float64]  # (n, 3) m, from the origin of the index
    heading: NDArray[np.float64]  # (n,) radians clockwise from north
    driven: NDArray[np.float64]  # (n,) m since the keyframe before
    working: NDArray[np.bool_]  # (n,) no dropout of the whole camera
    followed: NDArray[np.bool_]  # (2, n) whether boundaries to the left and to the right are followed
    vehicles: NDArray[np.float64]  # (3, n) m ahead, nearest faces of other vehicles, infinite where there is none


class _View(NamedTuple):
    """The part of a camera model that decides what is in view, in a form for compiled code."""

    near: float  # m
    far: float  # m
    slope: float  # tangent of the half angle
    range_decay: float  # m
    in_view: float  # m driven that count fully while a piece passes through the view
    lane_reach: float  # m
    lane_decay: float  # m
    boundary_reach: float  # m
    boundary_decay: float  # m
    altitude_gate: float  # m
    altitude_slope: float
    false_rate: float  # 1/m


def feature_index(
    coordinates: NDArray[np.float64],
    offsets: NDArray[np.int64],
    kind: NDArray[np.int8],
    model: CameraModel,
) -> FeatureIndex:
    """Cut lines into pieces, and sort the pieces into cells.

    Parameters
    ----------
    coordinates
        Vertices of all lines, shape ``(v, 3)``, metres.
    offsets
        Line i owns ``coordinates[offsets[i]:offsets[i + 1]]``, shape ``(lines + 1,)``.
    kind
        Kind of each line, shape ``(lines,)``.
    model
        Says how many points each line yields: on a marking shorter than 12 m (a dash) the same number whatever its
        length, on others by the metre.

    Examples
    --------
    >>> from probe2road.simulation.presets import PRESETS
    >>> line = np.array([[0.0, 0, 0], [100, 0, 0]])
    >>> index = feature_index(line, np.array([0, 2]), np.ones(1, np.int8), PRESETS["mixed"].camera)
    >>> len(index.pieces), round(float(index.weight.sum()), 3)
    (33, 70.0)
    """
    line = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    inner = np.flatnonzero(line[:-1] == line[1:]) if len(line) else np.zeros(0, np.int64)
    origin = coordinates.min(axis=0) if len(coordinates) else np.zeros(3)
    start, end = coordinates[inner] - origin, coordinates[inner + 1] - origin
    length = np.hypot(*(end - start)[:, :2].T)
    size = np.bincount(line[inner], weights=length, minlength=len(offsets) - 1)
    by_metre = np.where(size > _LONGEST_DASH, model.solid_points, model.dash_points / np.maximum(size, 1e-6))
    density = np.where(kind == ROAD_BOUNDARY, model.boundary_points, by_metre)
    parts = np.maximum(np.ceil(length / _LONGEST_PIECE - 1e-9), 1).astype(np.int64)
    owner = np.repeat(np.arange(len(inner)), parts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(parts) - parts, parts)
    share = np.stack([number / parts[owner], (number + 1) / parts[owner]])
    ends = [start[owner] + (end - start)[owner] * share[k][:, None] for k in (0, 1)]
    middle = (ends[0] + ends[1]) / 2.0
    column, row = (np.floor(middle[:, axis] / _CELL).astype(np.int64) for axis in (0, 1))
    columns, rows = (int(index.max()) + 1 if len(index) else 1 for index in (column, row))
    cell = row * columns + column
    order = np.argsort(cell, kind="stable")
    cells = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=columns * rows))]).astype(np.int64)
    feature = line[inner][owner][order]
    pieces = np.concatenate(ends, axis=1)[order].astype(np.float32)
    weight = (density[feature] * (length / parts)[owner][order]).astype(np.float32)
    return FeatureIndex(pieces, kind[feature], weight, feature, cells, columns, origin)


def see(
    xyz: NDArray[np.float64],
    heading: NDArray[np.float64],
    t: NDArray[np.float64],
    distance: NDArray[np.float64],
    index: FeatureIndex,
    model: CameraModel,
    *,
    rng: np.random.Generator,
    vehicle_rng: np.random.Generator,
) -> Detections:
    """Return the points that a camera detects along a drive.

    Parameters
    ----------
    xyz, heading, t, distance
        True poses: metres ``(n, 3)``, radians clockwise from north ``(n,)``, seconds ``(n,)``, metres driven ``(n,)``.
    index
        The lines that there are to see.
    model
        The camera.
    rng
        Randomness of the drive.
    vehicle_rng
        Randomness of the vehicle (how its camera is mounted).

    Returns
    -------
    Detections
        In the order of the keyframes. A vehicle that stands sees nothing new.
    """
    driven = np.diff(distance, prepend=distance[:1])
    steps = np.diff(t, prepend=t[:1])
    pitch = _pitch(steps, model.pitch_time, rng.standard_normal(len(t))) * np.radians(model.pitch_noise)
    yaw = np.radians(model.yaw_bias) * vehicle_rng.standard_normal()
    outage = _alternating(driven, model.outage_every, model.outage_length, rng)
    followed = np.stack([_alternating(driven, model.boundary_lost, model.boundary_found, rng) for _ in range(2)])
    vehicles = _vehicles(driven, model, rng)
    keyframes = _Keyframes(xyz - index.origin, heading, driven, ~outage, followed, vehicles)
    keyframe, body, kind, feature = _detect(keyframes, index, _view(model), rng)
    return Detections(keyframe, _with_noise(body, keyframe, kind, pitch, yaw, model, rng), kind, feature)


def _with_noise(
    body: NDArray[np.float64],
    keyframe: NDArray[np.int64],
    kind: NDArray[np.int8],
    pitch: NDArray[np.float64],
    yaw: float,
    model: CameraModel,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Add measurement errors to true points in the vehicle frame.

    One pixel of height in the image is range^2 / height of range on a flat road; lines seen at an angle are blurred
    more, by the square of the angle over the half field of view.
    """
    forward, right, up = body.T
    reach = np.hypot(forward, right)
    oblique = 1.0 + (np.arctan2(np.abs(right), forward) / np.radians(model.half_angle)) ** 2
    width = np.where(kind == ROAD_BOUNDARY, model.boundary_noise, 1.0)
    draw = rng.standard_normal(body.shape)
    along = model.pixel * model.pixel_noise * reach**2 / model.height * draw[:, 0] * width
    across = (model.lateral_noise + model.pixel * model.pixel_noise * reach) * oblique * width * draw[:, 1]
    lift = reach * pitch[keyframe] + model.height_noise * width * draw[:, 2]
    stretch = 1.0 + along / np.maximum(reach, 1e-6)
    # A point cannot be measured behind the camera, however wrong its range is.
    stretch = np.maximum(stretch, 0.3)
    return np.stack([forward * stretch - yaw * right, right * stretch + across + yaw * forward, up + lift], axis=1)


def _view(model: CameraModel) -> _View:
    """Return the parameters that decide whether a point is in view."""
    in_view = model.range_decay * (1.0 - np.exp((model.near - model.far) / model.range_decay))
    same = {name: getattr(model, name) for name in _View._fields if name not in ("slope", "in_view")}
    return _View(slope=float(np.tan(np.radians(model.half_angle))), in_view=float(in_view), **same)


@njit(cache=True)
def _pitch(steps: NDArray[np.float64], time: float, normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a unit Gauss-Markov process over the keyframes, made from white normal numbers."""
    out = normal.copy()
    for i in range(1, len(out)):
        fade = np.exp(-steps[i] / time)
        out[i] = fade * out[i - 1] + np.sqrt(1.0 - fade * fade) * normal[i]
    return out


@njit(cache=True)
def _alternating(
    driven: NDArray[np.float64], off_length: float, on_length: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Draw two alternating states along the road with exponential lengths of given means (m); True is on."""
    state = np.zeros(len(driven), np.bool_)
    on = rng.random() < on_length / (on_length + off_length)
    for i in range(len(driven)):
        mean = on_length if on else off_length
        if rng.random() > np.exp(-driven[i] / mean):
            on = not on
        state[i] = on
    return state


def _vehicles(driven: NDArray[np.float64], model: CameraModel, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw other vehicles: the nearest face ``(3, n)`` in metres ahead, infinity for none.

    The first is in the own lane and keeps its distance, the others in the lanes to the left and right.
    """
    ahead = np.full((_OCCLUDERS, len(driven)), np.inf)
    share = model.traffic_share
    for place in range(_OCCLUDERS):
        if share <= 0:
            break
        there = _alternating(driven, model.traffic_length * (1.0 - share) / share, model.traffic_length, rng)
        begun = np.cumsum(np.diff(there, prepend=False) & there)
        if place == 0:
            distances = 8.0 + rng.gamma(2.0, 12.0, size=int(begun[-1]) + 1 if len(begun) else 1)
        else:
            distances = rng.uniform(2.0, 30.0, size=int(begun[-1]) + 1 if len(begun) else 1)
        ahead[place] = np.where(there, distances[begun], np.inf)
    return ahead


@njit(cache=True)
def _detect(
    keyframes: _Keyframes, index: FeatureIndex, view: _View, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int8], NDArray[np.int64]]:
    """Detect points from every keyframe: return their keyframe, true place in the vehicle frame, kind and line."""
    codes = [(0, 0, 0) for _ in range(0)]  # keyframe, kind, line; empty lists whose types the compiler can tell
    places = [(0.0, 0.0, 0.0) for _ in range(0)]
    pieces, kind, driven = index.pieces, index.kind, keyframes.driven
    for i in range(len(driven)):
        if not keyframes.working[i] or driven[i] <= 0:
            continue
        sin, cos = np.sin(keyframes.heading[i]), np.cos(keyframes.heading[i])
        x, y, z = keyframes.xyz[i]
        c0, c1, r0, r1 = _cells_in_view(x, y, sin, cos, view, index)
        for row in range(r0, r1):
            for k in range(index.cells[row * index.columns + c0], index.cells[row * index.columns + c1]):
                u = rng.random()
                px = pieces[k, 0] + u * (pieces[k, 3] - pieces[k, 0]) - x
                py = pieces[k, 1] + u * (pieces[k, 4] - pieces[k, 1]) - y
                up = pieces[k, 2] + u * (pieces[k, 5] - pieces[k, 2]) - z
                forward, right = px * sin + py * cos, px * cos - py * sin
                if kind[k] == ROAD_BOUNDARY and not keyframes.followed[0 if right < 0 else 1, i]:
                    continue
                chance = driven[i] * index.weight[k] * _visibility(forward, right, up, kind[k], view)
                if rng.random() < chance and not _hidden(forward, right, keyframes.vehicles[:, i]):
                    codes.append((i, int(kind[k]), index.feature[k]))
                    places.append((forward, right, up))
        if rng.random() < view.false_rate * driven[i]:
            forward = view.near + (view.far - view.near) * rng.random()
            right = (2.0 * rng.random() - 1.0) * view.slope * forward
            codes.append((i, LANE_MARKING if rng.random() < 0.5 else ROAD_BOUNDARY, -1))
            places.append((forward, right, 0.0))
    body = np.zeros((len(places), 3))
    for row in range(len(places)):
        body[row, 0], body[row, 1], body[row, 2] = places[row]
    return (
        np.array([code[0] for code in codes], np.int64),
        body,
        np.array([code[1] for code in codes], np.int8),
        np.array([code[2] for code in codes], np.int64),
    )


@njit(cache=True)
def _visibility(forward: float, right: float, up: float, kind: int, view: _View) -> float:
    """Return the expected points on a piece of unit weight for each metre driven; 0 if it is out of view."""
    if forward < view.near or forward > view.far or abs(right) > view.slope * forward:
        return 0.0
    if abs(up) > view.altitude_gate + view.altitude_slope * forward:
        return 0.0
    reach, fall = view.lane_reach, view.lane_decay
    if kind == ROAD_BOUNDARY:
        reach, fall = view.boundary_reach, view.boundary_decay
    beyond = max(abs(right) - reach, 0.0) / fall
    return np.exp((view.near - forward) / view.range_decay - 0.5 * beyond * beyond) / view.in_view


@njit(cache=True)
def _cells_in_view(
    x: float, y: float, sin: float, cos: float, view: _View, index: FeatureIndex
) -> tuple[int, int, int, int]:
    """Return columns ``c0:c1`` and rows ``r0:r1`` of the cells that may hold a piece in the field of view."""
    columns, rows = index.columns, (len(index.cells) - 1) // index.columns
    low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
    for forward in (view.near, view.far):
        for side in (-1.0, 1.0):
            right = side * view.slope * forward
            px, py = x + forward * sin + right * cos, y + forward * cos - right * sin
            low_x, high_x, low_y, high_y = min(low_x, px), max(high_x, px), min(low_y, py), max(high_y, py)
    margin = _LONGEST_PIECE / 2.0  # a piece lies in the cell of its middle
    c0 = min(max(int(np.floor((low_x - margin) / _CELL)), 0), columns)
    c1 = min(max(int(np.floor((high_x + margin) / _CELL)) + 1, 0), columns)
    r0 = min(max(int(np.floor((low_y - margin) / _CELL)), 0), rows)
    r1 = min(max(int(np.floor((high_y + margin) / _CELL)) + 1, 0), rows)
    return c0, max(c0, c1), r0, r1


@njit(cache=True)
def _hidden(forward: float, right: float, vehicles: NDArray[np.float64]) -> bool:
    """Tell whether another vehicle interrupts the line of sight to a point.

    A vehicle is the face that it turns to the camera: 1.8 m wide, in the middle of its lane, 3.5 m from lane to lane.
    """
    for place in range(len(vehicles)):
        ahead = vehicles[place]
        if ahead >= forward:
            continue
        middle = 0.0 if place == 0 else (-3.5 if place == 1 else 3.5)
        crossing = right * ahead / forward
        if abs(crossing - middle) < 0.9:
            return True
        # Beside the vehicle's length its flank hides what lies beyond.
        if place > 0 and crossing * middle > 0 and abs(crossing) < abs(middle):
            rear = right * min(ahead + 4.5, forward) / forward
            if abs(rear) > abs(middle) - 0.9:
                return True
    return False
