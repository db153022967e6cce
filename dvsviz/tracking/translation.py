"""Translation before a scene that is not a plane: odometry on a coarse relief, without a map.

In `translation` mode the tracker begins with both, the planar map and this. When the relief of the first windows is no
plane, the map is given up as a reference, the velocities come from here, and the log says so.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dvsviz.contrast.relief import Relief, ReliefProblem, grid_shape, maximize_relief_contrast
from dvsviz.events.windows import EventWindow
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.tracking import constants as c

Array = NDArray[np.float64]


class ReliefOdometry:
    """Velocity and relief from window to window.

    Args:
        camera: gives the grid of depths.
        uneven: relative deviation of the relief from a plane from which the scene is none.

    Attributes:
        velocity: last velocity (3,), camera frame, mean distances per second.
        relief: last log inverse depth (rows, columns).
        windows: windows seen.
        seen: windows with enough motion to show depth.
        unevenness: largest relative deviation of their reliefs from a plane.
        not_a_plane: None while undecided.
        T_world_camera: pose (4, 4) at the middle of the last window, in mean distances.
        mid_us: its time.
        poses: (window, pose (4, 4) at its start) of the windows before it was decided.
        gain: contrast of the last window by its contrast without motion.
    """

    def __init__(self, camera: Camera, uneven: float = c.RELIEF_UNEVEN) -> None:
        self.camera = camera
        self.uneven = uneven
        self.velocity: Array = np.zeros(3)
        self.relief: Array = np.zeros(grid_shape(camera))
        self.windows = 0
        self.seen = 0
        self.unevenness = 0.0
        self.not_a_plane: bool | None = None
        self.gain = 1.0
        self.T_world_camera: Array = np.eye(4)
        self.mid_us = 0
        self.poses: list[tuple[int, Array]] = []

    @property
    def is_asked(self) -> bool:
        """True while it is undecided whether the scene is a plane; after a while nobody asks any more."""
        return self.not_a_plane is None and self.windows < c.RELIEF_PATIENCE

    def pack(self) -> dict[str, np.ndarray]:
        """Return the state as arrays that `unpack` reads."""
        decided = -1 if self.not_a_plane is None else int(self.not_a_plane)
        return {
            "relief": self.relief,
            "relief_velocity": self.velocity,
            "relief_pose": self.T_world_camera,
            "relief_time": np.array([self.mid_us], dtype=np.int64),
            "relief_windows": np.array([k for k, _ in self.poses], dtype=np.int64),
            "relief_poses": np.array([T for _, T in self.poses]).reshape(-1, 4, 4),
            "relief_numbers": np.array([self.windows, self.seen, self.unevenness, decided], dtype=np.float64),
        }

    def unpack(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a packed state."""
        self.relief, self.velocity = np.array(state["relief"]), np.array(state["relief_velocity"])
        self.T_world_camera, self.mid_us = np.array(state["relief_pose"]), int(state["relief_time"][0])
        poses = zip(state["relief_windows"].tolist(), state["relief_poses"], strict=True)
        self.poses = [(int(k), np.array(T)) for k, T in poses]
        windows, seen, self.unevenness, decided = (float(v) for v in state["relief_numbers"])
        self.windows, self.seen = int(windows), int(seen)
        self.not_a_plane = None if decided < 0 else decided > 0

    def look(self, window: EventWindow) -> str:
        """Advance by a window; return what it decided about the scene, or ""."""
        undecided = self.not_a_plane is None
        before = self.velocity
        solved = self.step(window)
        # The pose moves on by the mean of two velocities, from middle to middle; a gap is not bridged.
        mid_us = window.start_us + (window.end_us - window.start_us) // 2
        if self.windows > 1:
            dt = min((mid_us - self.mid_us) * 1e-6, c.RELIEF_GAP_S)
            self.T_world_camera = se3.propagate(
                self.T_world_camera, np.zeros(3), 0.5 * (before + self.velocity), dt
            )
        self.mid_us = mid_us
        if undecided:
            half_s = (mid_us - window.start_us) * 1e-6
            self.poses.append(
                (window.index, se3.propagate(self.T_world_camera, np.zeros(3), self.velocity, -half_s))
            )
        self.gain = solved.contrast_after / max(solved.contrast_before, 1e-12)
        if not undecided or self.not_a_plane is None:
            return ""
        percent = f"inverse depth {100 * self.unevenness:.0f} % off the best plane"
        if self.not_a_plane:
            return f"the scene is not a plane: {percent}"
        return f"the scene is a plane: {percent}"

    def _moved(self, dt: float) -> Array:
        """Return the relief (rows, columns) as it lies in the image `dt` seconds later: depth moves with its things."""
        rows, cols = self.relief.shape
        y, x = np.indices(self.relief.shape).astype(np.float64)
        rho = np.exp(self.relief)
        cells = np.array([self.camera.fx * (cols - 1) / (self.camera.width - 1),
                          self.camera.fy * (rows - 1) / (self.camera.height - 1)])  # fmt: skip
        before = [y + rho * self.velocity[1] * dt * cells[1], x + rho * self.velocity[0] * dt * cells[0]]
        moved = ndimage.map_coordinates(self.relief, before, order=1, mode="nearest")
        return moved - np.log(np.maximum(1.0 - np.exp(moved) * self.velocity[2] * dt, 0.5))

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
        mid_us = window.start_us + (window.end_us - window.start_us) // 2
        if not first:
            self.relief = self._moved(min((mid_us - self.mid_us) * 1e-6, c.RELIEF_GAP_S))
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
            # A depth that is there grows out of the plane step by step; one that jumps is events drawn together.
            found = deviation_from_plane(self.relief)
            if found < self.unevenness + c.RELIEF_JUMP:
                self.unevenness = max(self.unevenness, found)
        # A relief grows out of a plane over some windows; a plane never becomes one.
        if self.not_a_plane is None and self.seen >= c.RELIEF_WINDOWS_MIN and self.unevenness > self.uneven:
            self.not_a_plane = True
        elif self.not_a_plane is None and self.seen >= c.RELIEF_WINDOWS:
            self.not_a_plane = False
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
