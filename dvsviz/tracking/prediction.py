"""The prediction: where the camera will be, how sure that is, and what an aligned window teaches about its velocity.

A Kalman filter on the error of pose and velocity, driven by white acceleration whose strength follows the motion. One
window with few edges hardly tells turning from moving sideways; believed as it is, its noise goes into the velocity and
carries the pose away along what is not seen. The filter changes the velocity only as far as the window knows it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.tracking import constants as c

Array = NDArray[np.float64]

# Variance of what a motion model holds: as good as none, and still to be inverted.
_HELD = 1e-16


def _unknown(free: NDArray[np.bool_], speed: float) -> Array:
    start = np.array([c.FILTER_POSE_START**2] * 6 + [speed**2] * 6)
    return np.diag(np.where(np.tile(free, 2), start, _HELD))


def _all_free() -> NDArray[np.bool_]:
    return np.ones(6, dtype=bool)


@dataclass(slots=True, kw_only=True, eq=False)
class MotionFilter:
    """What is known of the errors of pose and velocity.

    Attributes:
        free: mask (6,) of rotation and position that the motion model solves for.
        covariance: (12, 12) of rotation, position (rad, plane distances, camera frame) and their velocities.
        density: acceleration's spectral density (2,) of rotation and position, rad²/s³ and distances²/s³.
    """

    free: NDArray[np.bool_] = field(default_factory=_all_free)
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    density: Array = field(default_factory=lambda: np.full(2, c.FILTER_DENSITY_START))

    def __post_init__(self) -> None:
        if self.covariance.size == 0:
            self.covariance = _unknown(self.free, c.FILTER_SPEED_START)

    def forget(self) -> None:
        """Begin anew, after a loss: the velocity may be anything."""
        self.covariance = _unknown(self.free, c.FILTER_SPEED_LOST)

    def predict(self, dt: float) -> Array:
        """Move the uncertainty on by `dt` seconds; return the information (6, 6) of the predicted pose."""
        self.covariance, information = _predicted(self.covariance, self.density, self.free, dt)
        return information

    def correct(self, moved: Array, information: Array, dt: float) -> Array:
        """Take in an aligned window; return by how much (6,) the velocities change.

        Args:
            moved: rotation and position (6,) from the predicted to the aligned pose, camera frame.
            information: (6, 6) of the window about its pose, without the prediction.
            dt: seconds since the last window.
        """
        self.covariance, self.density, change = _corrected(
            self.covariance, self.density, self.free, moved, information
        )
        return change


@numba.njit(cache=True, nogil=True)
def _predicted(P, density, free, dt):
    """Return the covariance (12, 12) after `dt` seconds and the information (6, 6) of the predicted pose."""
    F = np.eye(12)
    for i in range(6):
        F[i, i + 6] = dt
    P = F @ P @ F.T
    for i in range(6):
        q = density[i // 3] if free[i] else 0.0
        P[i, i] += q * dt**3 / 3 + (c.FILTER_POSE_FLOOR**2 if free[i] else 0.0)
        P[i, i + 6] += q * dt**2 / 2
        P[i + 6, i] += q * dt**2 / 2
        P[i + 6, i + 6] += q * dt
    return P, np.linalg.inv(np.ascontiguousarray(P[:6, :6]))


@numba.njit(cache=True, nogil=True)
def _corrected(P, density, free, moved, information):
    """Return covariance (12, 12), density (2,) and change of the velocities (6,) after an aligned window."""
    pose, cross = np.ascontiguousarray(P[:6, :6]), np.ascontiguousarray(P[6:, :6])
    inverse = np.linalg.inv(pose)
    told = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            if free[i] and free[j]:
                told[i, j] = information[i, j] / c.FILTER_CORRELATED
    after = np.linalg.inv(inverse + told)
    by_pose = cross @ inverse
    # What the window should have moved the pose by, on average, against what it did.
    expected = pose - after
    density = density.copy()
    for k in range(2):
        block = slice(3 * k, 3 * k + 3)
        weight = np.linalg.inv(np.ascontiguousarray(pose[block, block]))
        share = np.trace(np.ascontiguousarray(expected[block, block]) @ weight)
        if share > c.FILTER_TOLD:
            m = np.ascontiguousarray(moved[block])
            ratio = (m @ weight @ m) / share
            step = min(max(c.FILTER_ADAPT * share * np.log(max(ratio, 1e-3)), -0.5), 1.0)
            density[k] = min(max(density[k] * np.exp(step), c.FILTER_DENSITY[0]), c.FILTER_DENSITY[1])
    out = np.empty_like(P)
    out[:6, :6] = after
    out[6:, :6] = by_pose @ after
    out[:6, 6:] = out[6:, :6].T
    out[6:, 6:] = P[6:, 6:] - by_pose @ expected @ by_pose.T
    return 0.5 * (out + out.T), density, by_pose @ moved


def difference(T_before: Array, T_after: Array) -> Array:
    """Return rotation and position (6,) from one pose (4, 4) to another near it, in the camera frame."""
    R = T_before[:3, :3]
    return np.concatenate([se3.log_so3(R.T @ T_after[:3, :3]), R.T @ (T_after[:3, 3] - T_before[:3, 3])])
