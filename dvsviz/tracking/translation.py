"""Translation before a scene that is not a plane: odometry on a coarse relief, without a map.

In `translation` mode the tracker begins with both, the planar map and this. When the relief of the first windows is no
plane, the map is given up as a reference, the velocities come from here, and the log says so.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.relief import Relief, ReliefProblem, grid_shape, maximize_relief_contrast
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.tracking import constants as c

Array = NDArray[np.float64]


class ReliefOdometry:
    """Velocity and relief from window to window.

    Attributes:
        velocity: last velocity (3,), camera frame, mean distances per second.
        relief: last log inverse depth (rows, columns).
        windows: windows seen.
        seen: windows with enough motion to show depth.
        unevenness: largest relative deviation of their reliefs from a plane.
        not_a_plane: None while undecided.
        gain: contrast of the last window by its contrast without motion.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.velocity: Array = np.zeros(3)
        self.relief: Array = np.zeros(grid_shape(camera))
        self.windows = 0
        self.seen = 0
        self.unevenness = 0.0
        self.not_a_plane: bool | None = None
        self.gain = 1.0

    def pack(self) -> dict[str, np.ndarray]:
        """Return the state as arrays that `unpack` reads."""
        decided = -1 if self.not_a_plane is None else int(self.not_a_plane)
        return {
            "relief": self.relief,
            "relief_velocity": self.velocity,
            "relief_numbers": np.array([self.windows, self.seen, self.unevenness, decided], dtype=np.float64),
        }

    def unpack(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a packed state."""
        self.relief, self.velocity = np.array(state["relief"]), np.array(state["relief_velocity"])
        windows, seen, self.unevenness, decided = (float(v) for v in state["relief_numbers"])
        self.windows, self.seen = int(windows), int(seen)
        self.not_a_plane = None if decided < 0 else decided > 0

    def look(self, window: EventWindow) -> str:
        """Advance by a window; return what it decided about the scene, or ""."""
        undecided = self.not_a_plane is None
        solved = self.step(window)
        self.gain = solved.contrast_after / max(solved.contrast_before, 1e-12)
        if not undecided or self.not_a_plane is None:
            return ""
        percent = f"inverse depth {100 * self.unevenness:.0f} % off the best plane"
        if self.not_a_plane:
            return f"the scene is not a plane ({percent}): odometry on a relief, without a map to come back to"
        return f"the scene is a plane ({percent})"

    def step(self, window: EventWindow) -> Relief:
        """Return the translation and relief of a window, referred to its middle."""
        stride = max(1, len(window) // c.RELIEF_EVENTS)
        problem = ReliefProblem(
            window.bearings[::stride],
            window.t_s[::stride] - 0.5 * window.duration_s,
            np.where(window.events.is_positive[::stride], np.float32(1), np.float32(-1)),
            self.camera,
        )
        first = self.windows == 0
        solved = maximize_relief_contrast(
            problem,
            window.duration_s,
            velocity=self.velocity,
            log_inverse_depth=self.relief,
            prior=None if first else self.relief,
            blurs_px=c.RELIEF_BLURS_START_PX if first else c.RELIEF_BLURS_PX,
            max_evaluations=c.RELIEF_EVALUATIONS,
        )
        self.velocity, self.relief = solved.velocity, solved.log_inverse_depth
        self.windows += 1
        speed = float(np.hypot(*solved.velocity[:2])) * self.camera.fx
        if speed * window.duration_s >= 0.5 * c.RELIEF_DISPLACEMENT_PX:
            # A window with less motion shows no depth, and counts for neither side.
            self.seen += 1
            self.unevenness = max(self.unevenness, deviation_from_plane(self.relief))
        if self.not_a_plane is None and self.seen >= c.RELIEF_WINDOWS:
            self.not_a_plane = self.unevenness > c.RELIEF_UNEVEN
        return solved


def deviation_from_plane(log_inverse_depth: Array) -> float:
    """Return the RMS deviation of an inverse depth grid from the best plane, by its mean.

    The inverse depth of a plane is linear in the image, so that the best plane is a linear fit.
    """
    rho = np.exp(log_inverse_depth)
    y, x = np.indices(rho.shape)
    A = np.column_stack([np.ones(rho.size), x.ravel(), y.ravel()])
    fit = A @ np.linalg.lstsq(A, rho.ravel(), rcond=None)[0]
    return float(np.sqrt(np.mean((rho.ravel() - fit) ** 2)) / rho.mean())
