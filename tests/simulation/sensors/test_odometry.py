"""The fused pose: smooth, metre-level, adrift in tunnels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probe2road.simulation.driving.traffic import TruePoses
from probe2road.simulation.presets import PRESETS
from probe2road.simulation.sensors.gnss import GnssErrors, gnss_errors
from probe2road.simulation.sensors.odometry import fuse

PRESET = PRESETS["mixed"]


def straight_drive(length, *, speed=25.0, spacing=2.5):
    s = np.arange(0.0, length, spacing)
    zero = np.zeros(len(s), np.int64)
    xyz = np.stack([s, np.zeros_like(s), np.zeros_like(s)], axis=1)
    return TruePoses(zero[:1], s / speed, xyz, np.full(len(s), np.pi / 2), np.full(len(s), speed), s, zero, zero)


def fused_error(poses, gnss, covered, seed=0, fusion=PRESET.fusion):
    rng, vehicle = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    fused = fuse(poses, gnss, covered, PRESET.odometry, fusion, rng=rng, vehicle_rng=vehicle)
    return fused.xyz - poses.xyz, fused


def test_the_fused_pose_is_smooth_although_fixes_jump():
    poses = straight_drive(10000)
    gnss = gnss_errors(poses.t, PRESETS["phone"].gnss, rng=np.random.default_rng(1))
    error, _ = fused_error(poses, gnss, np.zeros(len(poses.t), bool))
    steps = np.hypot(*np.diff(error[:, :2], axis=0).T)
    jumps = np.hypot(*np.diff(gnss.error[:, :2], axis=0).T)
    assert jumps.max() > 5.0
    assert steps.max() < 0.15  # m, over 2.5 m


def test_odometry_drifts_in_a_tunnel_and_returns_without_a_jump():
    poses = straight_drive(8000)
    covered = (poses.distance > 2000) & (poses.distance < 6000)
    perfect = GnssErrors(np.zeros((len(covered), 3)), np.ones(len(covered)), np.zeros(len(covered), bool))
    still = replace(PRESET.fusion, vehicle_bias=0.0)
    exits, steps, ends = [], [], []
    for seed in range(40):
        error, fused = fused_error(poses, perfect, covered, seed, still)
        size = np.hypot(error[:, 0], error[:, 1])
        exits.append(size[covered][-1])
        ends.append(size[-1])
        steps.append(np.abs(np.diff(size)).max())
        assert fused.sigma[covered][-1] > 2 * fused.sigma[poses.distance < 2000][-1]
    assert 3.0 < np.median(exits) < 40.0  # m behind 4 km of tunnel
    assert np.median(ends) < 0.2 * np.median(exits)
    assert max(steps) < 1.0


def test_vehicle_bias_is_the_same_on_every_drive_of_a_vehicle():
    poses = straight_drive(1000)
    perfect = GnssErrors(np.zeros((len(poses.t), 3)), np.ones(len(poses.t)), np.zeros(len(poses.t), bool))
    still = replace(PRESET.odometry, scale_sigma=0.0, heading_sigma=0.0, height_walk=0.0)
    open_air = np.zeros(len(poses.t), bool)
    drives = [
        fuse(
            poses, perfect, open_air, still, PRESET.fusion,
            rng=np.random.default_rng(seed), vehicle_rng=np.random.default_rng(99),
        ).xyz - poses.xyz
        for seed in (1, 2)
    ]  # fmt: skip
    assert np.allclose(drives[0], drives[1])
    assert np.ptp(drives[0], axis=0) == pytest.approx([0, 0, 0])
