"""Motions through given poses: cubic splines, so that velocity and acceleration are smooth too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from dvsviz.errors import FormatError
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import read_tum

Array = NDArray[np.float64]


class SplineMotion:
    """A motion (see `motion`) through poses: cubic in position, with continuous angular acceleration in rotation.

    Args:
        trajectory: at least two poses; the motion's time 0 is the first one's.

    Attributes:
        seconds: from the first pose to the last.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        if len(trajectory) < 2:
            raise ValueError(f"trajectory: expected at least two poses, got {len(trajectory)}")
        t_s = (trajectory.t_us - trajectory.t_us[0]) * 1e-6
        self.seconds = float(t_s[-1])
        self._position = CubicSpline(t_s, trajectory.positions)
        self._rotation = RotationSpline(t_s, Rotation.from_matrix(trajectory.rotations))

    def __call__(self, t_s: ArrayLike) -> Array:
        """Return poses (N, 4, 4) at times (N,), s; a little outside the poses the ends go on as they were."""
        t = np.asarray(t_s, dtype=np.float64)
        return se3.pose(self._rotation(t).as_matrix(), self._position(t))


def tum_motion(path: Path, *, relative: bool = True) -> SplineMotion:
    """Return the motion of a TUM file's poses.

    Args:
        path: the file; poses whose times do not increase are dropped.
        relative: True for poses as seen from the first one, so that the motion begins where the scene wants a
            camera; False for the file's own world.

    Raises:
        FormatError: it cannot be read, or holds fewer than two poses.
    """
    poses = read_tum(path, repair=True)
    if len(poses) < 2:
        message = "holds fewer than two poses whose times increase"
        raise FormatError(message, path=path, hint="give a trajectory of at least two poses, sorted by time")
    if relative:
        Ts = se3.inverse(poses.Ts_world_camera[0]) @ poses.Ts_world_camera
        poses = Trajectory(t_us=poses.t_us, Ts_world_camera=Ts)
    return SplineMotion(poses)
