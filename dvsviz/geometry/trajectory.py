"""A trajectory: times and poses `T_world_camera`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses over time.

    Attributes:
        t_us: strictly increasing times (N,), int64 microseconds of the recording's own clock.
        Ts_world_camera: poses (N, 4, 4).
    """

    t_us: NDArray[np.int64]
    Ts_world_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.Ts_world_camera.shape != (len(self.t_us), 4, 4):
            raise ValueError(
                f"Ts_world_camera: expected ({len(self.t_us)}, 4, 4), got {self.Ts_world_camera.shape}"
            )
        if not np.all(np.isfinite(self.Ts_world_camera)):
            raise ValueError("Ts_world_camera: expected finite poses")
        if len(self.t_us) > 1 and np.any(np.diff(self.t_us) <= 0):
            raise ValueError("t_us: expected strictly increasing times")

    def __len__(self) -> int:
        return len(self.t_us)

    @classmethod
    def from_quaternions(
        cls, t_us: NDArray[np.int64], position: NDArray[np.float64], quaternion_wxyz: NDArray[np.float64]
    ) -> Trajectory:
        """Return a trajectory from positions (N, 3) and quaternions (N, 4) wxyz."""
        R = se3.rotation_from_quaternion(np.asarray(quaternion_wxyz).reshape(-1, 4))
        return cls(
            t_us=np.asarray(t_us, dtype=np.int64),
            Ts_world_camera=se3.pose(R, np.asarray(position).reshape(-1, 3)),
        )

    @property
    def positions(self) -> NDArray[np.float64]:
        """Camera positions (N, 3) in the world."""
        return self.Ts_world_camera[:, :3, 3]

    @property
    def rotations(self) -> NDArray[np.float64]:
        """`R_world_camera` (N, 3, 3)."""
        return self.Ts_world_camera[:, :3, :3]

    @property
    def quaternions_wxyz(self) -> NDArray[np.float64]:
        """`q_world_camera` (N, 4) wxyz, w >= 0."""
        return se3.quaternion_from_rotation(self.rotations)

    @property
    def path_length(self) -> float:
        """Length of the polyline through all positions."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=-1).sum())

    def covers(self, t_us: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return a mask (M,) of the times that lie between the first and the last pose."""
        t = np.asarray(t_us)
        if len(self) == 0:
            return np.zeros(t.shape, dtype=bool)
        return (t >= self.t_us[0]) & (t <= self.t_us[-1])

    def at(self, t_us: NDArray[np.int64]) -> Trajectory:
        """Return the trajectory at times (M,) inside it: linear in position, slerp in rotation."""
        t = np.asarray(t_us, dtype=np.int64)
        return Trajectory(t_us=t, Ts_world_camera=se3.interpolate(self.t_us, self.Ts_world_camera, t))
