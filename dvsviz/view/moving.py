"""Events with the motion that is believed of them: one window or several, voted into one camera's image.

Each window is moved back to its own start by its own velocity and from there, over the plane, into the camera that is
looked from. So several windows are laid on each other by their poses, and what is blurred in the sum is what the poses
do not explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import vote, warp_points
from dvsviz.contrast.warp import window_warp
from dvsviz.events.windows import EventWindow
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

# A camera nearer to the plane than this (or behind it: a lost pose) has no homography.
_NEAREST = 1e-3
# A window of a millisecond holds no two poses of the truth: its velocity is taken over this at least.
_TRUTH_STEP_US = 20_000


class Polarities(StrEnum):
    """Which events are drawn."""

    BOTH = "both"
    ON = "on"
    OFF = "off"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovingWindow:
    """Events of a window with its motion.

    Attributes:
        window: the events.
        T_world_camera: pose (4, 4) at the window's start.
        omega: angular velocity (3,), rad/s, camera frame.
        velocity: linear velocity (3,), plane distances per second, camera frame.
    """

    window: EventWindow
    T_world_camera: Array
    omega: Array
    velocity: Array


def votes_of(
    moving: Sequence[MovingWindow],
    T_world_camera: Array,
    plane_world: Plane,
    grid: Camera,
    *,
    positive: bool | None = None,
) -> NDArray[np.float32]:
    """Return the image (height, width) float32 of the events as a camera sees them on the plane.

    Args:
        moving: windows with their motions.
        T_world_camera: pose (4, 4) of the camera that is looked from.
        plane_world: where the events come from.
        grid: its K and size make the image; its distortion is not used.
        positive: only events of this polarity; both where None.
    """
    image = np.zeros((grid.height + 1, grid.width + 1), dtype=np.float32)
    for part in moving:
        plane = plane_world.seen_from(part.T_world_camera)
        if plane.distance > _NEAREST:
            D = se3.inverse(T_world_camera) @ part.T_world_camera
            # On the plane n·p = -d, so that p' = R p + t is (R - t n^T / d) p.
            over = D[:3, :3] - np.outer(D[:3, 3], plane.normal) / plane.distance
        else:
            plane, over = Plane(normal=np.array([0.0, 0.0, -1.0])), np.eye(3)
        bearings, t_s = part.window.bearings, part.window.t_s
        if positive is not None:
            chosen = part.window.events.is_positive == positive
            bearings, t_s = bearings[chosen], t_s[chosen]
        if len(t_s) == 0:
            continue
        warp = window_warp(part.omega, part.velocity, plane, float(t_s[-1]), grid.matrix @ over, derivatives=False)
        image += vote(warp_points(bearings, t_s, warp), None, (grid.height + 1, grid.width + 1))
    return image[: grid.height, : grid.width]


def true_motion(truth: Trajectory, start_us: int, end_us: int) -> tuple[Array, Array, Array] | None:
    """Return the true pose (4, 4) at a window's start, and omega and velocity (3,) over it; None outside the truth.

    Args:
        truth: in the session's world.
        start_us: start of the window.
        end_us: its end.
    """
    at = np.array([start_us], dtype=np.int64)
    if not truth.covers(at)[0]:
        return None
    T = truth.at(at).Ts_world_camera[0]
    wider_us = max(0, _TRUTH_STEP_US - (end_us - start_us)) // 2
    ends = np.clip(
        np.array([start_us - wider_us, end_us + wider_us], dtype=np.int64), truth.t_us[0], truth.t_us[-1]
    )
    if ends[1] <= ends[0]:
        return T, np.zeros(3), np.zeros(3)
    before, after = truth.at(ends).Ts_world_camera
    seconds = (ends[1] - ends[0]) * 1e-6
    omega = se3.log_so3(before[:3, :3].T @ after[:3, :3]) / seconds
    return T, omega, before[:3, :3].T @ (after[:3, 3] - before[:3, 3]) / seconds
