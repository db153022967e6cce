"""Smooth motion: what poses that follow each other in time say of one another in the joint refinement.

A hand accelerates at random, and evenly: between two stretches of time the mean velocity changes by a normal number
whose variance is the acceleration's spectral density by a third of both stretches together. Before few edges this
decides between turning and moving sideways, which look alike in any one window, but not over many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.tracking import constants as c

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmoothMotion:
    """Poses tied to the one before and the one after.

    Attributes:
        middle: their numbers (T,).
        tie: coefficients (T, 3) of before, middle and after: together the change of the mean velocity.
        information: of that change in rotation (rad/s) and position (T, 6), both in the world.
    """

    middle: NDArray[np.int64]
    tie: Array
    information: Array

    @classmethod
    def between(cls, t_s: Array, Ts_world_camera: Array) -> SmoothMotion:
        """Return the ties of poses (K, 4, 4) at times (K,), as stiff as their own motion allows.

        Across a gap, and where several poses have one time, there is none.
        """
        dt = np.diff(t_s)
        known = (dt > 0) & (dt < c.SMOOTH_GAP_S)
        middle = 1 + np.flatnonzero(known[:-1] & known[1:])
        before, after = 1.0 / dt[middle - 1], 1.0 / dt[middle]
        tie = np.stack([before, -before - after, after], axis=-1)
        by_density = (dt[middle - 1] + dt[middle])[:, None] / 3.0
        one = cls(middle=middle, tie=tie, information=np.ones((len(middle), 6)))
        squares = one.changes(Ts_world_camera) ** 2 / by_density
        information = np.empty((len(middle), 6))
        for part in (slice(0, 3), slice(3, 6)):
            # The median of a chi squared of three numbers is 2.37 times their variance.
            density = np.median(squares[:, part].sum(axis=1)) / 2.37 if len(middle) else 0.0
            density = np.clip(c.SMOOTH_MARGIN * density, *c.FILTER_DENSITY)
            information[:, part] = 1.0 / (density * by_density)
        return cls(middle=middle, tie=tie, information=information)

    def changes(self, Ts_world_camera: Array) -> Array:
        """Return the changes (T, 6) of the mean velocities between poses (K, 4, 4)."""
        R, p = Ts_world_camera[:, :3, :3], Ts_world_camera[:, :3, 3]
        step = np.concatenate([se3.log_so3(R[1:] @ np.swapaxes(R[:-1], 1, 2)), np.diff(p, axis=0)], axis=1)
        return self.tie[:, 2:] * step[self.middle] - self.tie[:, :1] * step[self.middle - 1]

    def gradient(self, Ts_world_camera: Array) -> Array:
        """Return the gradient (6 K,) of half the weighted squares of the changes, by the poses moved in the world."""
        out = np.zeros((len(Ts_world_camera), 6))
        pull = self.information * self.changes(Ts_world_camera)
        for k in range(3):
            np.add.at(out, self.middle - 1 + k, self.tie[:, k : k + 1] * pull)
        return out.ravel()
