"""Relative and absolute errors of a registered trajectory (seed 002, section 8.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepErrors:
    """Errors of each registered frame.

    Attributes:
        rotation_rad: angle (N,) in [0, pi] between estimated and true rotation.
        translation_m: distance (N,) between estimated and true position.
    """

    rotation_rad: Array
    translation_m: Array

    def summary(self) -> dict[str, float]:
        """Return mean and standard deviation of both; NaN where there are no steps."""
        if len(self.rotation_rad) == 0:
            return dict.fromkeys(
                ("rotation_rad", "rotation_std_rad", "translation_m", "translation_std_m"), float("nan")
            )
        return {
            "rotation_rad": float(self.rotation_rad.mean()),
            "rotation_std_rad": float(self.rotation_rad.std()),
            "translation_m": float(self.translation_m.mean()),
            "translation_std_m": float(self.translation_m.std()),
        }


def pose_errors(Ts_estimated: Array, Ts_true: Array) -> StepErrors:
    """Return the errors of poses (N, 4, 4) against true ones in the same world."""
    turn = np.swapaxes(Ts_true[:, :3, :3], 1, 2) @ Ts_estimated[:, :3, :3]
    return StepErrors(
        rotation_rad=se3.rotation_angle(turn),
        translation_m=np.linalg.norm(Ts_estimated[:, :3, 3] - Ts_true[:, :3, 3], axis=1),
    )


def relative_errors(Ts_estimated: Array, Ts_true: Array) -> StepErrors:
    """Return the errors (N - 1) of each estimated step, applied to the true pose before it."""
    steps = se3.inverse(Ts_estimated[:-1]) @ Ts_estimated[1:]
    return pose_errors(Ts_true[:-1] @ steps, Ts_true[1:])


def absolute_errors(Ts_estimated: Array, Ts_true: Array) -> StepErrors:
    """Return the errors (N - 1) of the chained trajectory, which starts at the true pose."""
    chained = Ts_true[0] @ se3.inverse(Ts_estimated[0]) @ Ts_estimated
    return pose_errors(chained[1:], Ts_true[1:])
