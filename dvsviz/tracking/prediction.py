"""The prediction: where the camera will be, how sure that is, and what an aligned window teaches about its velocity.

A Kalman filter on the error of pose and velocity, driven by white acceleration whose strength follows the motion. One
window with few edges hardly tells turning from moving sideways; believed as it is, its noise goes into the velocity and
carries the pose away along what is not seen. The filter changes the velocity only as far as the window knows it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

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
        P, q = self.covariance, np.repeat(self.density, 3) * self.free
        F = np.eye(12)
        F[:6, 6:] = dt * np.eye(6)
        P = F @ P @ F.T
        i = np.arange(6)
        P[i, i] += q * dt**3 / 3 + self.free * c.FILTER_POSE_FLOOR**2
        P[i, i + 6] += q * dt**2 / 2
        P[i + 6, i] += q * dt**2 / 2
        P[i + 6, i + 6] += q * dt
        self.covariance = P
        return np.asarray(np.linalg.inv(P[:6, :6]), dtype=np.float64)

    def correct(self, moved: Array, information: Array, dt: float) -> Array:
        """Take in an aligned window; return by how much (6,) the velocities change.

        Args:
            moved: rotation and position (6,) from the predicted to the aligned pose, camera frame.
            information: (6, 6) of the window about its pose, without the prediction.
            dt: seconds since the last window.
        """
        P = self.covariance
        pose, cross = P[:6, :6], P[6:, :6]
        inverse = np.linalg.inv(pose)
        information = information * np.outer(self.free, self.free)
        after = np.linalg.inv(inverse + information / c.FILTER_CORRELATED)
        by_pose = cross @ inverse
        change = by_pose @ moved
        # What the window should have moved the pose by, on average, against what it did.
        expected = pose - after
        for k in range(2):
            block = slice(3 * k, 3 * k + 3)
            weight = np.linalg.inv(pose[block, block])
            told = float(np.trace(expected[block, block] @ weight))
            if told > c.FILTER_TOLD:
                ratio = float(moved[block] @ weight @ moved[block]) / told
                step = np.clip(c.FILTER_ADAPT * told * np.log(max(ratio, 1e-3)), -0.5, 1.0)
                self.density[k] = np.clip(self.density[k] * np.exp(step), *c.FILTER_DENSITY)
        P = np.empty_like(P)
        P[:6, :6] = after
        P[6:, :6] = by_pose @ after
        P[:6, 6:] = P[6:, :6].T
        P[6:, 6:] = self.covariance[6:, 6:] - by_pose @ expected @ by_pose.T
        self.covariance = 0.5 * (P + P.T)
        return np.asarray(change, dtype=np.float64)


def difference(T_before: Array, T_after: Array) -> Array:
    """Return rotation and position (6,) from one pose (4, 4) to another near it, in the camera frame."""
    R = T_before[:3, :3]
    return np.concatenate([se3.log_so3(R.T @ T_after[:3, :3]), R.T @ (T_after[:3, 3] - T_before[:3, 3])])
