"""Absolute and relative errors of associated poses, one number a pose or a pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.evaluate.associate import nearest_indices
from dvsviz.geometry import se3

Array = NDArray[np.float64]


def rmse(errors: Array) -> float | None:
    """Return the root mean square of errors (N,), None where there are none."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else None


def position_errors(p_truth: Array, p_aligned: Array) -> Array:
    """Return distances (N,) between true and aligned positions (N, 3)."""
    return np.linalg.norm(p_truth - p_aligned, axis=-1)


def rotation_errors_deg(Rs_truth: Array, Rs_aligned: Array) -> Array:
    """Return angles (N,) in degrees between true and aligned rotations (N, 3, 3)."""
    return np.rad2deg(se3.rotation_angle(np.swapaxes(Rs_truth, -1, -2) @ Rs_aligned))


def pairs_after(
    t_us: NDArray[np.int64], delta_us: int, tolerance_us: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return indices (M,) of all pairs of poses that are `delta_us` apart.

    Every pose that is at least `delta_us` before the last starts a pair, which ends at the pose nearest to then, if
    that is within the tolerance.

    Args:
        t_us: increasing times (N,).
        delta_us: time between the two, above the tolerance.
        tolerance_us: largest deviation from it.
    """
    if len(t_us) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    # Starts later than this would all end at the last pose and be shorter than asked.
    starts = t_us[t_us + delta_us <= t_us[-1]]
    return nearest_indices(starts + delta_us, t_us, tolerance_us)


def relative_pose_errors(
    Ts_truth: Array, Ts_aligned: Array, first: NDArray[np.intp], second: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Return the errors of relative motions: distances (M,) in metres and angles (M,) in degrees.

    `E = (T_truth_i⁻¹ T_truth_j)⁻¹ (T_i⁻¹ T_j)`: independent of where the two worlds lie, not of their scale.

    Args:
        Ts_truth: true poses (N, 4, 4).
        Ts_aligned: estimated poses (N, 4, 4), their positions in metres.
        first: indices (M,) of the poses i.
        second: indices (M,) of the poses j.
    """
    motion_truth = se3.inverse(Ts_truth[first]) @ Ts_truth[second]
    motion = se3.inverse(Ts_aligned[first]) @ Ts_aligned[second]
    E = se3.inverse(motion_truth) @ motion
    if len(E) == 0:
        return np.zeros(0), np.zeros(0)
    return np.linalg.norm(E[:, :3, 3], axis=-1), np.rad2deg(se3.rotation_angle(E[:, :3, :3]))
