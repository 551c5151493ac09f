"""What a vehicle believes about its pose: odometry that drifts, GNSS that pulls it back.

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

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.errors import OptionError
from probe2road.simulate.gnss import GnssErrors
from probe2road.simulate.traffic import TruePoses

__all__ = ["FusedPoses", "FusionModel", "OdometryModel", "fuse"]


@dataclass(frozen=True)
class OdometryModel:
    """Errors of wheel and inertial odometry that calibration on the road leaves."""

    scale_sigma: float  # of the distance driven, constant over a drive
    heading_sigma: float  # degrees, of the heading error while GNSS is there
    heading_time: float  # s, its time constant
    gyro_bias: float  # degrees/s, constant over a drive; turns the heading while GNSS is away
    gyro_walk: float  # degrees per square root of a second, while GNSS is away
    height_walk: float  # m per square root of a metre driven


@dataclass(frozen=True)
class FusionModel:
    """How GNSS and odometry become one pose."""

    pull_time: float  # s, time constant with which good GNSS pulls the horizontal error
    vertical_pull_time: float  # s, the same for the height
    gate: float  # m, a longer innovation counts as this long
    trusted_sigma: float  # m, GNSS whose standard deviation is larger pulls less, by the square of the ratio
    min_trust: float  # least share of the pull that poor GNSS keeps
    vehicle_bias: float  # m, each axis: antenna and mounting, constant over all drives of a vehicle

    def __post_init__(self) -> None:
        """Refuse filters that divide by zero."""
        for name in ("pull_time", "vertical_pull_time", "gate", "trusted_sigma"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} is {getattr(self, name)}", where="FusionModel", fix="use a positive number")


@dataclass(frozen=True)
class FusedPoses:
    """What the vehicle records, beside its true poses."""

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
    """Fuse odometry with GNSS along one drive.

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
    n = len(poses.t)
    steps = np.diff(poses.t, prepend=poses.t[:1])
    driven = np.diff(poses.distance, prepend=poses.distance[:1])
    bias = fusion.vehicle_bias * vehicle_rng.standard_normal(3)
    scale = odometry.scale_sigma * rng.standard_normal()
    gyro = np.radians(odometry.gyro_bias) * rng.standard_normal()
    error, turned, sigma = _filter(
        steps, driven, poses.heading, covered, gnss.error, gnss.sigma, scale, gyro,
        np.radians(odometry.heading_sigma), odometry.heading_time, np.radians(odometry.gyro_walk),
        odometry.height_walk, fusion.pull_time, fusion.vertical_pull_time, fusion.gate, fusion.trusted_sigma,
        fusion.min_trust, rng.standard_normal((n, 3)),
    )  # fmt: skip
    return FusedPoses(poses.xyz + error + bias, poses.heading + turned, sigma)


@njit(cache=True)
def _filter(
    steps: NDArray[np.float64],
    driven: NDArray[np.float64],
    heading: NDArray[np.float64],
    covered: NDArray[np.bool_],
    gnss: NDArray[np.float64],
    gnss_sigma: NDArray[np.float64],
    scale: float,
    gyro: float,
    heading_sigma: float,
    heading_time: float,
    gyro_walk: float,
    height_walk: float,
    pull_time: float,
    vertical_pull_time: float,
    gate: float,
    trusted_sigma: float,
    min_trust: float,
    normal: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Run the filter: position error ``(n, 3)``, heading error ``(n,)`` in radians, own sigma ``(n,)``."""
    n = len(steps)
    error, turned, sigma = np.zeros((n, 3)), np.zeros(n), np.zeros(n)
    e = np.zeros(3)
    weave, drift, own = heading_sigma * normal[0, 0], 0.0, min(gnss_sigma[0], gate)
    if n:
        # The filter has run before the drive begins, so it starts near the GNSS error, in a tunnel too.
        size = np.hypot(gnss[0, 0], gnss[0, 1])
        e[:] = gnss[0] * min(1.0, gate / max(size, 1e-9))
        e[2] = min(max(gnss[0, 2], -2.0 * gate), 2.0 * gate)
    for i in range(n):
        h, way = steps[i], driven[i]
        fade = np.exp(-h / heading_time)
        weave = fade * weave + heading_sigma * np.sqrt(1.0 - fade * fade) * normal[i, 0]
        if covered[i]:
            drift += gyro * h + gyro_walk * np.sqrt(h) * normal[i, 1]
        else:
            drift *= fade
        turned[i] = weave + drift
        sin, cos = np.sin(heading[i]), np.cos(heading[i])
        e[0] += way * (scale * sin + turned[i] * cos)
        e[1] += way * (scale * cos - turned[i] * sin)
        e[2] += height_walk * np.sqrt(way) * normal[i, 2]
        own += 0.5 * way * (heading_sigma + abs(scale)) if covered[i] else 0.0
        if not covered[i]:
            trust = max(min((trusted_sigma / gnss_sigma[i]) ** 2, 1.0), min_trust)
            pull = 1.0 - np.exp(-h * trust / pull_time)
            dx, dy = gnss[i, 0] - e[0], gnss[i, 1] - e[1]
            pull *= min(1.0, gate / max(np.hypot(dx, dy), 1e-9))
            e[0] += pull * dx
            e[1] += pull * dy
            dz = min(max(gnss[i, 2] - e[2], -2.0 * gate), 2.0 * gate)
            e[2] += (1.0 - np.exp(-h * trust / vertical_pull_time)) * dz
            own += pull * (min(gnss_sigma[i], 3.0 * gate) - own)
        error[i] = e
        sigma[i] = own
    return error, turned, sigma
