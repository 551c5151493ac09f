"""The recorded pose of a vehicle: odometry that drifts, corrected by GNSS.

Strategy
--------
The fused pose is the true pose plus an error that two forces move. Odometry pushes it: wheel scale along the vehicle,
heading error across it, in proportion to the distance driven. GNSS pulls it back towards its own error with a time
constant, slower where the receiver knows itself to be poor, and with a gate on the difference, so that a multipath
burst bends the trace and does not break it. Without GNSS nothing pulls: in a tunnel the error grows as odometry
drifts, and behind it the trace returns smoothly. This is the behaviour of a loosely coupled filter without its
algebra: smooth, locally accurate, metre-level absolute.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.bounds import NotNegative, Positive, Share
from probe2road.options import checked
from probe2road.simulation.driving.traffic import TruePoses
from probe2road.simulation.sensors.gnss import GnssErrors

__all__ = ["FusedPoses", "FusionModel", "OdometryModel", "fuse"]


@dataclass(frozen=True)
@checked
class OdometryModel:
    """Errors of wheel and inertial odometry that remain after calibration on the road."""

    scale_sigma: NotNegative[float]  # of the distance driven, constant over a drive
    heading_sigma: NotNegative[float]  # degrees, of the heading error while GNSS is there
    heading_time: Positive[float]  # s, its time constant
    gyro_bias: NotNegative[float]  # degrees/s, constant over a drive; turns the heading while GNSS is away
    gyro_walk: NotNegative[float]  # degrees per square root of a second, while GNSS is away
    height_walk: NotNegative[float]  # m per square root of a metre driven


@dataclass(frozen=True)
@checked
class FusionModel:
    """How GNSS and odometry are combined to one pose."""

    pull_time: Positive[float]  # s, time constant with which good GNSS pulls the horizontal error
    vertical_pull_time: Positive[float]  # s, the same for the height
    gate: Positive[float]  # m, a longer innovation counts as this long
    trusted_sigma: Positive[float]  # m, GNSS whose standard deviation is larger pulls less, by the square of the ratio
    min_trust: Share  # least share of the pull that poor GNSS keeps
    vehicle_bias: NotNegative[float]  # m, each axis: antenna and mounting, constant over all drives of a vehicle


@dataclass(frozen=True)
class FusedPoses:
    """The poses that a vehicle records of a drive."""

    xyz: NDArray[np.float64]  # (n, 3) m
    heading: NDArray[np.float64]  # (n,) radians clockwise from north
    sigma: NDArray[np.float64]  # (n,) m, the vehicle's own idea of its horizontal error, 1 sigma


def fuse(
    poses: TruePoses,
    gnss: GnssErrors,
    covered: NDArray[np.bool_],
    odometry: OdometryModel,
    fusion: FusionModel,
    *,
    rng: np.random.Generator,
    vehicle_rng: np.random.Generator,
) -> FusedPoses:
    """Combine odometry and GNSS along one drive.

    Parameters
    ----------
    poses
        The true poses.
    gnss
        GNSS errors at them.
    covered
        Poses without GNSS: in a tunnel. Shape ``(n,)``.
    odometry, fusion
        The models.
    rng
        Randomness of the drive.
    vehicle_rng
        Randomness of the vehicle: the same for all its drives.

    Returns
    -------
    FusedPoses
        A continuous line: from pose to pose the error moves by centimetres.
    """
    bias = fusion.vehicle_bias * vehicle_rng.standard_normal(3)
    tuning = _tuning(odometry, fusion, rng)
    steps = np.diff(poses.t, prepend=poses.t[:1])
    driven = np.diff(poses.distance, prepend=poses.distance[:1])
    fresh = rng.standard_normal((len(poses.t), 3))
    turned = _heading_error(steps, covered, tuning, fresh)
    error, sigma = _position_error(
        steps, driven, poses.heading, turned, covered, gnss.error, gnss.sigma, tuning, fresh[:, 2]
    )
    return FusedPoses(poses.xyz + error + bias, poses.heading + turned, sigma)


class _Tuning(NamedTuple):
    """Both models with the random constants of one drive, in radians, in a form for compiled code."""

    scale: float  # error of the distance driven
    gyro: float  # radians/s
    gyro_walk: float  # radians per square root of a second
    heading_sigma: float  # radians
    heading_time: float  # s
    height_walk: float  # m per square root of a metre
    pull_time: float  # s
    vertical_pull_time: float  # s
    gate: float  # m
    trusted_sigma: float  # m
    min_trust: float


def _tuning(odometry: OdometryModel, fusion: FusionModel, rng: np.random.Generator) -> _Tuning:
    """Draw the constants of one drive."""
    return _Tuning(
        scale=odometry.scale_sigma * float(rng.standard_normal()),
        gyro=float(np.radians(odometry.gyro_bias) * rng.standard_normal()),
        gyro_walk=float(np.radians(odometry.gyro_walk)),
        heading_sigma=float(np.radians(odometry.heading_sigma)),
        heading_time=odometry.heading_time,
        height_walk=odometry.height_walk,
        pull_time=fusion.pull_time,
        vertical_pull_time=fusion.vertical_pull_time,
        gate=fusion.gate,
        trusted_sigma=fusion.trusted_sigma,
        min_trust=fusion.min_trust,
    )


@njit(cache=True)
def _heading_error(
    steps: NDArray[np.float64], covered: NDArray[np.bool_], tuning: _Tuning, normal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the heading error (radians): a Gauss-Markov process, and gyroscope drift while GNSS is missing."""
    turned = np.zeros(len(steps))
    weave, drift = 0.0, 0.0
    for i in range(len(steps)):
        fade = np.exp(-steps[i] / tuning.heading_time) if i > 0 else 0.0
        weave = fade * weave + tuning.heading_sigma * np.sqrt(1.0 - fade * fade) * normal[i, 0]
        if covered[i]:
            drift += tuning.gyro * steps[i] + tuning.gyro_walk * np.sqrt(steps[i]) * normal[i, 1]
        else:
            drift *= fade
        turned[i] = weave + drift
    return turned


@njit(cache=True)
def _position_error(
    steps: NDArray[np.float64],
    driven: NDArray[np.float64],
    heading: NDArray[np.float64],
    turned: NDArray[np.float64],
    covered: NDArray[np.bool_],
    gnss: NDArray[np.float64],
    gnss_sigma: NDArray[np.float64],
    tuning: _Tuning,
    normal: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the position error ``(n, 3)`` and the accuracy that the filter assumes ``(n,)``, m."""
    error, sigma = np.zeros((len(steps), 3)), np.zeros(len(steps))
    x, y, z, own = 0.0, 0.0, 0.0, 0.0
    if len(steps):
        # The filter has run before the drive begins, so it starts near the GNSS error, in a tunnel too.
        near = min(1.0, tuning.gate / max(np.hypot(gnss[0, 0], gnss[0, 1]), 1e-9))
        x, y, z = near * gnss[0, 0], near * gnss[0, 1], _clipped(gnss[0, 2], 2.0 * tuning.gate)
        own = min(gnss_sigma[0], tuning.gate)
    for i in range(len(steps)):
        sin, cos = np.sin(heading[i]), np.cos(heading[i])
        x += driven[i] * (tuning.scale * sin + turned[i] * cos)
        y += driven[i] * (tuning.scale * cos - turned[i] * sin)
        z += tuning.height_walk * np.sqrt(driven[i]) * normal[i]
        if covered[i]:
            own += 0.5 * driven[i] * (tuning.heading_sigma + abs(tuning.scale))
        else:
            trust = max(min((tuning.trusted_sigma / gnss_sigma[i]) ** 2, 1.0), tuning.min_trust)
            away = np.hypot(gnss[i, 0] - x, gnss[i, 1] - y)
            pull = 1.0 - np.exp(-steps[i] * trust / tuning.pull_time)
            pull *= min(1.0, tuning.gate / max(away, 1e-9))
            x, y = x + pull * (gnss[i, 0] - x), y + pull * (gnss[i, 1] - y)
            rise = 1.0 - np.exp(-steps[i] * trust / tuning.vertical_pull_time)
            z += rise * _clipped(gnss[i, 2] - z, 2.0 * tuning.gate)
            own += pull * (min(gnss_sigma[i], 3.0 * tuning.gate) - own)
        error[i, 0], error[i, 1], error[i, 2], sigma[i] = x, y, z, own
    return error, sigma


@njit(cache=True)
def _clipped(value: float, limit: float) -> float:
    """Return a value clipped to ``[-limit, limit]``."""
    return min(max(value, -limit), limit)
