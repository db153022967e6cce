"""The gyroscope as a prior: how the camera turned between two times, with a bias that is learnt while tracking well.

Camera rates are the sensor's less its bias; the bias is a Kalman filter of one variance for all three axes, fed with
the rotations that were tracked over half a second each.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.recording import Imu
from dvsviz.geometry import se3
from dvsviz.tracking import constants as c

Array = NDArray[np.float64]


class Gyro:
    """Rotations by a gyroscope.

    Args:
        imu: measurements along the camera's optical axes, on the events' clock.

    Attributes:
        bias: (3,), rad/s, that is subtracted.
        variance: of each of its axes, (rad/s)².
        trust: how often it lately agreed with what was seen; it is used above 0.
        seen_us: when a window last said something of its own; the prediction has grown old since then.
    """

    def __init__(self, imu: Imu) -> None:
        self._t_us, self._rates = imu.t_us, imu.gyro
        self.bias: Array = np.zeros(3)
        self.variance = c.GYRO_BIAS_RAD_S**2
        self.trust = 0
        self.seen_us = 0
        self._anchor_us = -1
        self._anchor: Array = np.eye(3)
        self._checked_us = -1
        self._checked: Array = np.eye(3)
        self._is_told = False

    def knows(self, start_us: int, end_us: int) -> bool:
        """Return whether what it says of the time in between is believed."""
        return self.trust > 0 and self.covers(start_us, end_us)

    def covers(self, start_us: int, end_us: int) -> bool:
        """Return whether there are samples all the way from one time to another."""
        i, j = np.searchsorted(self._t_us, (start_us, end_us), side="right")
        if i == 0 or j == len(self._t_us) or not np.isfinite(self._rates[i - 1 : j + 1]).all():
            return False
        return int(np.diff(self._t_us[i - 1 : j + 1]).max(initial=0)) <= c.GYRO_GAP_US

    def rate(self, t_us: int) -> Array:
        """Return the camera's angular velocity (3,), rad/s, camera frame, at a time."""
        return self._at(np.array([t_us], dtype=np.int64))[0]

    def _at(self, t_us: NDArray[np.int64]) -> Array:
        i = int(np.clip(np.searchsorted(self._t_us, t_us[0]) - 1, 0, len(self._t_us) - 1))
        j = int(np.searchsorted(self._t_us, t_us[-1])) + 1
        # Relative times: microseconds since 1970 have no digits to spare as floats.
        at, known = (t_us - self._t_us[i]).astype(np.float64), (self._t_us[i:j] - self._t_us[i]).astype(np.float64)
        rates = self._rates[i:j]
        return np.stack([np.interp(at, known, rates[:, k]) for k in range(3)], axis=-1) - self.bias

    def turn(self, start_us: int, end_us: int) -> Array:
        """Return `R_start_end` (3, 3): the camera's rotation at the end, seen from the camera at the start."""
        i, j = np.searchsorted(self._t_us, (start_us, end_us), side="right")
        t = np.concatenate([[start_us], self._t_us[i:j], [end_us]]).astype(np.int64)
        rates = self._at(t)
        steps = se3.exp_so3(0.5 * (rates[1:] + rates[:-1]) * (np.diff(t) * 1e-6)[:, None])
        R = np.eye(3)
        for step in steps:
            R = R @ step
        return R

    def deviation(self, seconds: float) -> float:
        """Return the standard deviation, rad, of a turn over so long, by the bias and the noise."""
        return float(np.sqrt(self.variance * seconds**2 + c.GYRO_NOISE_RAD_S2 * seconds))

    def learn(self, t_us: int, R_world_camera: Array) -> None:
        """Take a well-tracked orientation (3, 3); every half a second the bias follows."""
        seconds = (t_us - self._anchor_us) * 1e-6
        if self._anchor_us >= 0 and seconds < c.GYRO_LEARN_S:
            return
        if self._anchor_us >= 0 and seconds < 2 * c.GYRO_LEARN_S and self.covers(self._anchor_us, t_us):
            tracked = se3.log_so3(self._anchor.T @ R_world_camera)
            off = (se3.log_so3(self.turn(self._anchor_us, t_us)) - tracked) / seconds
            self.variance += c.GYRO_WALK**2 * seconds
            gain = self.variance / (self.variance + 2 * (c.GYRO_TRACKED_RAD / seconds) ** 2)
            self.bias = self.bias + gain * off
            self.variance *= 1.0 - gain
        self._anchor_us, self._anchor = t_us, R_world_camera.copy()

    def check(self, t_us: int, R_world_camera: Array) -> str:
        """Take a well-tracked orientation (3, 3); return what is to be said where trust was lost, mostly nothing."""
        seconds = (t_us - self._checked_us) * 1e-6
        if self._checked_us >= 0 and seconds < c.GYRO_CHECK_S:
            return ""
        said = ""
        if self._checked_us >= 0 and seconds < 2 * c.GYRO_CHECK_S and self.covers(self._checked_us, t_us):
            tracked = self._checked.T @ R_world_camera
            off = se3.rotation_angle(self.turn(self._checked_us, t_us).T @ tracked) / seconds
            bound = c.GYRO_OFF_RAD_S + c.GYRO_OFF_SHARE * se3.rotation_angle(tracked) / seconds
            if off <= bound:
                self.trust = min(self.trust + 1, c.GYRO_TRUST_MOST)
            else:
                said = self.doubt(f"turns {off:.2g} rad/s off what is seen")
        self._checked_us, self._checked = t_us, R_world_camera.copy()
        return said

    def doubt(self, why: str) -> str:
        """Trust it less; return what is to be said the first time that it is not used because of it."""
        least = 1 - c.GYRO_TRUST_AGAIN
        self.trust = least if self.trust == 1 else max(self.trust - 1, least)
        if self.trust > least:
            return ""
        told, self._is_told = self._is_told, True
        return "" if told else f"the gyroscope {why}: it is left out until it agrees again"

    def forget_anchor(self) -> None:
        """Begin the next half second anew: the poses were re-expressed, or nothing was seen."""
        self._anchor_us, self._checked_us = -1, -1

    def pack(self) -> dict[str, np.ndarray]:
        """Return the state as arrays."""
        return {
            "gyro_bias": np.array([*self.bias, self.variance]),
            "gyro_times": np.array([self.seen_us, self._anchor_us], dtype=np.int64),
            "gyro_anchor": self._anchor,
            "gyro_trust": np.array([self.trust, self._checked_us, self._is_told], dtype=np.int64),
            "gyro_checked": self._checked,
        }

    def unpack(self, state: Mapping[str, np.ndarray]) -> None:
        """Take a packed state over."""
        self.bias, self.variance = np.array(state["gyro_bias"][:3]), float(state["gyro_bias"][3])
        self.seen_us, self._anchor_us = (int(v) for v in state["gyro_times"])
        self._anchor = np.array(state["gyro_anchor"])
        # Of a version that believed every gyroscope.
        self.trust = c.GYRO_TRUST_MOST
        if "gyro_trust" in state and "gyro_checked" in state:
            self.trust, self._checked_us = (int(v) for v in state["gyro_trust"][:2])
            self._is_told, self._checked = bool(state["gyro_trust"][2]), np.array(state["gyro_checked"])


def prior_by_gyro(gyro: Gyro, seconds: float, unseen_s: float) -> Array:
    """Return the information (6, 6) of a pose whose rotation was predicted by a gyroscope.

    Args:
        gyro: knows its bias so well.
        seconds: since the pose it was predicted from.
        unseen_s: since a window last said something: until then the position was a guess.
    """
    turn = min(c.GYRO_POSE_RAD, c.PRIOR_ROTATION_RAD) + gyro.deviation(max(seconds, unseen_s))
    shift = c.PRIOR_POSITION + min(c.GYRO_DRIFT * max(unseen_s - seconds, 0.0), c.GYRO_DRIFT_MOST)
    return np.diag([turn**-2] * 3 + [shift**-2] * 3)
