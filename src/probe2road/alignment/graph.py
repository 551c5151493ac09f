"""The factor graph of METHOD 9.2, in GTSAM: poses of keyframes and of patches of road.

Strategy
--------
A drive is a chain of poses held together by odometry. GNSS pulls weakly at each of them: its errors are alike for a
kilometre, so each fix of the kilometre gets the share of one observation, and a robust kernel for the whole drive's
sake; but not before all have been brought to where GNSS is on average, or else a road that registration put aside with
all its drives would stay there, every fix of it an outlier. A patch of road is a pose as well, and everything that a
keyframe saw of it is one factor between the two. What several drives see of one patch ties them together; where the
patch lies is decided by all of them and their GNSS, so that no drive is the reference. Where the patch must not move,
because the map around it is finished, the factor becomes a prior on the keyframe. Every factor is built in: none calls
back into Python.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from probe2road.alignment.keyframes import Keyframes
from probe2road.alignment.lines import Condensed
from probe2road.alignment.options import AlignOptions
from probe2road.errors import needs_extra

__all__ = ["optimise"]

_GNSS_KERNEL = 4.0  # sigmas of one fix beyond which GNSS counts less (Cauchy)
_SIGHT_KERNEL = 10.0  # sigmas of a condensed factor beyond which it counts less (Cauchy)
_HEADING_SIGMA = 3.0  # degrees, of the recorded heading; weak, it only keeps patches from turning
_PATCH_SIGMA = (20.0, 20.0, 0.1)  # m, m, radians; weak prior of a patch at its start position
_ITERATIONS = 15
_TOLERANCE = 1e-4  # relative decrease of the error, below which the solver stops


def optimise(
    frames: Keyframes,
    pose: NDArray[np.float64],
    condensed: Condensed,
    patch_pose: NDArray[np.float64],
    options: AlignOptions,
    *,
    held: NDArray[np.bool_] | None = None,
    fixed_patch: NDArray[np.bool_] | None = None,
    robust_gnss: bool = True,
) -> NDArray[np.float64]:
    """Find the poses that fit odometry, GNSS and camera observations best.

    Parameters
    ----------
    frames
        Keyframes: recorded poses and the motion between them.
    pose
        Where they are thought to be, m, m, radians, shape ``(k, 3)``.
    condensed
        Factors between keyframes and patches.
    patch_pose
        Where the patches are, shape ``(patches, 3)``; those that no factor names are not looked at.
    options
        The sigmas.
    held
        Keyframes that do not move, shape ``(k,)``.
    fixed_patch
        Patches that do not move, shape ``(patches,)``.
    robust_gnss
        Whether fixes that are far off count less.

    Returns
    -------
    ndarray, shape (k, 3)
        The new poses.

    Raises
    ------
    MissingExtraError
        If GTSAM is not installed.
    """
    with needs_extra("align", feature="aligning a fleet"):
        import gtsam
    held = np.zeros(len(pose), bool) if held is None else held
    fixed = np.zeros(len(patch_pose), bool) if fixed_patch is None else fixed_patch
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    moving = np.flatnonzero(~held)
    for k in moving.tolist():
        values.insert(k, gtsam.Pose2(*pose[k]))
    _add_motion(graph, frames, held)
    _add_gnss(graph, frames, moving, options, robust=robust_gnss)
    used = _add_sights(graph, pose, condensed, patch_pose, held, fixed)
    spread = gtsam.noiseModel.Diagonal.Sigmas(np.array(_PATCH_SIGMA))
    for patch in used.tolist():
        at = gtsam.Pose2(*patch_pose[patch])
        values.insert(len(pose) + patch, at)
        graph.add(gtsam.PriorFactorPose2(len(pose) + patch, at, spread))
    if len(moving) == 0:
        return pose.copy()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    parameters.setRelativeErrorTol(_TOLERANCE)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    moved = pose.copy()
    # The poses come back in the order of their keys: keyframes, then patches.
    moved[moving] = gtsam.utilities.extractPose2(result)[: len(moving)]
    return moved


def _add_motion(graph: object, frames: Keyframes, held: NDArray[np.bool_]) -> None:
    """Add a factor between each keyframe and the one before; drives are not connected."""
    import gtsam

    for k in np.flatnonzero(~frames.first & ~held).tolist():
        if held[k - 1]:
            continue
        noise = gtsam.noiseModel.Diagonal.Sigmas(frames.motion_sigma[k])
        graph.add(gtsam.BetweenFactorPose2(k - 1, k, gtsam.Pose2(*frames.motion[k]), noise))  # type: ignore[attr-defined]


def _add_gnss(
    graph: object, frames: Keyframes, moving: NDArray[np.int64], options: AlignOptions, *, robust: bool
) -> None:
    """Add a factor for the recorded position and heading of every keyframe, weaker because neighbours share errors."""
    import gtsam

    inflation = frames.inflation(options)
    turn = gtsam.noiseModel.Isotropic.Sigma(1, np.radians(_HEADING_SIGMA))
    for k in moving.tolist():
        at = gtsam.Pose2(*frames.pose[k])
        noise: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Sigma(2, frames.sigma[k] * inflation[k])
        if robust:
            kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(_GNSS_KERNEL / inflation[k])
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        graph.add(gtsam.PoseTranslationPrior2D(k, at, noise))  # type: ignore[attr-defined]
        graph.add(gtsam.PoseRotationPrior2D(k, at, turn))  # type: ignore[attr-defined]


def _add_sights(
    graph: object,
    pose: NDArray[np.float64],
    condensed: Condensed,
    patch_pose: NDArray[np.float64],
    held: NDArray[np.bool_],
    fixed: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Add factors between keyframes and the patches that they saw; return the patches that may move."""
    import gtsam

    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(_SIGHT_KERNEL)
    for q in np.flatnonzero(~held[condensed.keyframe]).tolist():
        k, patch = int(condensed.keyframe[q]), int(condensed.patch[q])
        wanted = gtsam.Pose2(*pose[k]).compose(gtsam.Pose2.Expmap(condensed.correction[q]))
        noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Information(condensed.information[q]))
        if fixed[patch]:
            graph.add(gtsam.PriorFactorPose2(k, wanted, noise))  # type: ignore[attr-defined]
        else:
            between = gtsam.Pose2(*patch_pose[patch]).between(wanted)
            graph.add(gtsam.BetweenFactorPose2(len(pose) + patch, k, between, noise))  # type: ignore[attr-defined]
    return np.setdiff1d(condensed.patch[~held[condensed.keyframe]], np.flatnonzero(fixed))
