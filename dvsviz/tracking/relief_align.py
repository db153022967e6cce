"""Alignment of a window with the landmarks of the relief map: point to line, event by event."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import vote
from dvsviz.events.windows import EventWindow
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.tracking import relief_constants as rc
from dvsviz.tracking.relief_kernels import associate, by_landmark, place_variances, pose_equations
from dvsviz.tracking.relief_landmarks import Landmarks

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """Events of a window, by the time of its pose.

    Attributes:
        bearings: (N, 2) float32, in time order.
        t_s: times (N,) since the time of the pose.
        is_positive: polarities (N,).
        mid_us: time of the pose: the middle of the window.
        duration_s: length of the window.
    """

    bearings: NDArray[np.float32]
    t_s: Array
    is_positive: NDArray[np.bool_]
    mid_us: int
    duration_s: float

    @classmethod
    def of(cls, window: EventWindow) -> Sample:
        """Return evenly taken events of a window."""
        stride = -(-len(window) // rc.RELIEF_MAP_EVENTS)
        mid_us = window.start_us + (window.end_us - window.start_us) // 2
        return cls(
            bearings=np.ascontiguousarray(window.bearings[::stride]),
            t_s=np.asarray((window.events.t_us[::stride] - mid_us) * 1e-6, dtype=np.float64),
            is_positive=np.ascontiguousarray(window.events.is_positive[::stride]),
            mid_us=mid_us,
            duration_s=window.duration_s,
        )

    def pixels(self, camera: Camera) -> NDArray[np.float32]:
        """Return where its events are on the sensor without distortion (N, 2) float32."""
        return (self.bearings * [camera.fx, camera.fy] + [camera.cx, camera.cy]).astype(np.float32)

    def gain(self, px: NDArray[np.float32], camera: Camera) -> float:
        """Return the contrast of its events moved to some pixels (N, 2), by their contrast without motion."""
        sign, shape = np.where(self.is_positive, np.float32(1), np.float32(-1)), (camera.height, camera.width)
        sharp, still = (
            float(cv2.GaussianBlur(vote(points, sign, shape), (0, 0), 1.0).var())
            for points in (px, self.pixels(camera))
        )
        return sharp / max(still, 1e-12)

    def thinned(self, most: int) -> Sample:
        """Return about `most` of its events."""
        stride = -(-len(self.t_s) // most)
        return replace(
            self,
            bearings=np.ascontiguousarray(self.bearings[::stride]),
            t_s=np.ascontiguousarray(self.t_s[::stride]),
            is_positive=np.ascontiguousarray(self.is_positive[::stride]),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moving:
    """A pose with its velocities.

    Attributes:
        T_world_camera: pose (4, 4).
        omega: angular velocity (3,), camera frame.
        velocity: linear velocity (3,), camera frame.
    """

    T_world_camera: Array
    omega: Array
    velocity: Array

    def at(self, dt: float) -> Array:
        """Return the pose (4, 4) a time later."""
        return se3.propagate(self.T_world_camera, self.omega, self.velocity, dt)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Owned:
    """Which landmarks the events of a sample belong to.

    Attributes:
        owner: (N,), -1 for none.
        residual_px: distance of each event from its landmark's line (N,).
    """

    owner: NDArray[np.int32]
    residual_px: Array

    @property
    def explained(self) -> float:
        """Share of the events that belong to a landmark."""
        return float((self.owner >= 0).mean())

    def cost(self, gate_px: float) -> float:
        """Return the mean squared distance, px², that of an event without a landmark being the gate."""
        off = np.where(self.owner >= 0, np.minimum(np.abs(self.residual_px), gate_px), gate_px)
        return float((off * off).mean())

    def means(self, landmarks: int) -> tuple[NDArray[np.int64], Array, Array]:
        """Return landmarks with events (M,), their mean distance (M,), px, and weight (M,), 1 / px²."""
        count, total = np.zeros(landmarks), np.zeros(landmarks)
        by_landmark(self.owner, self.residual_px, count, total)
        lines = np.flatnonzero(count > 0)
        n = count[lines]
        return lines, total[lines] / n, np.minimum(n, rc.RELIEF_MOST_EVENTS) / rc.RELIEF_VARIANCE_PX2


def own(
    landmarks: Landmarks,
    sample: Sample,
    moving: Moving,
    camera: Camera,
    gate_px: float,
    signed_px: float = rc.RELIEF_SIGNED_PX,
) -> Owned:
    """Return which landmarks a window's events belong to.

    Args:
        landmarks: those that may be in view.
        sample: the window.
        moving: pose and velocities at its middle.
        camera: of the window.
        gate_px: largest distance from the line.
        signed_px: motion across a line within the window above which its events have one polarity.
    """
    bounds = np.linspace(sample.t_s[0], sample.t_s[-1] + 1e-6, rc.RELIEF_SLICES + 1)
    seen = np.stack([landmarks.seen_from(moving.at(float(t))) for t in bounds])
    owner, residual = np.full(len(sample.t_s), -1, np.int32), np.zeros(len(sample.t_s))
    associate(
        sample.bearings, sample.t_s, sample.is_positive, bounds, seen, landmarks.sides, camera.matrix,
        np.array([camera.width, camera.height]), gate_px, rc.RELIEF_REACH_PX, signed_px, owner, residual,
    )  # fmt: skip
    return Owned(owner=owner, residual_px=residual)


def start(landmarks: Landmarks, sample: Sample, last: Moving, dt: float, camera: Camera) -> Moving:
    """Return where to start: the camera went on as it did, at half the speed, or stopped.

    A window lasts longer where fewer events come, which is what happens when a camera slows down.

    Args:
        landmarks: those that may be in view.
        sample: the window.
        last: pose and velocities of the window before.
        dt: time since then, s.
        camera: of the window.
    """
    best, found = np.inf, last
    gate = rc.RELIEF_GATES_PX[1]
    for share in rc.RELIEF_SPEEDS:
        tried = replace(last, omega=share * last.omega, velocity=share * last.velocity)
        tried = replace(tried, T_world_camera=tried.at(dt))
        cost = own(landmarks, sample, tried, camera, gate, signed_px=np.inf).cost(gate)
        if cost < rc.RELIEF_LEAD * best:
            best, found = cost, tried
    return found


def align_relief(
    landmarks: Landmarks,
    sample: Sample,
    predicted: Moving,
    last: Moving,
    dt: float,
    camera: Camera,
    free: NDArray[np.bool_],
    scale_px: float,
) -> Moving:
    """Return the pose of a window by its events' distances from the landmarks' lines, with its velocities.

    Gauss-Newton with a closing gate; a prediction is a weak prior. Landmarks count by how well their place is known.

    Args:
        landmarks: those that may be in view.
        sample: the window.
        predicted: where to start.
        last: the window before.
        dt: time since then, s.
        camera: of the window.
        free: mask (6,) of rotation and position.
        scale_px: image displacement of a unit of translation at the middle inverse depth.
    """
    focal, index, moving = camera.focal_px, np.flatnonzero(free), predicted
    T_predicted = predicted.T_world_camera
    moved = float(np.linalg.norm(T_predicted[:3, 3] - last.T_world_camera[:3, 3]))
    sigma_px = rc.RELIEF_PREDICTED_PX + rc.RELIEF_PREDICTED_SHARE * scale_px * moved
    prior = np.diag(np.r_[np.full(3, focal**2), np.full(3, scale_px**2)]) / sigma_px**2
    for gate in rc.RELIEF_GATES_PX:
        for _ in range(rc.RELIEF_ITERATIONS):
            T = moving.T_world_camera
            lines, mean, weight = own(landmarks, sample, moving, camera, gate).means(len(landmarks))
            seen, variances = landmarks.seen_from(T), np.empty(len(landmarks))
            R, p = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
            place_variances(landmarks.rays, landmarks.states, landmarks.information, seen, R, p, focal, variances)
            off = np.r_[se3.log_so3(R.T @ T_predicted[:3, :3]), T_predicted[:3, 3] - p]
            H, g = prior.copy(), prior @ off
            pose_equations(
                landmarks.rays, landmarks.states, variances, seen, R, p, focal, lines, mean, weight,
                rc.RELIEF_ROBUST_PX, H, g,
            )  # fmt: skip
            step = np.zeros(6)
            step[index] = np.linalg.solve(H[np.ix_(index, index)], g[index])
            T = se3.pose(R @ se3.exp_so3(step[:3]), p + step[3:])
            moving = between(last, T, dt) or replace(moving, T_world_camera=T)
            if np.abs(step * np.sqrt(np.diag(prior))).max() * sigma_px < rc.RELIEF_STEP_PX:
                break
    return moving


def between(last: Moving, T: Array, dt: float) -> Moving | None:
    """Return a pose (4, 4) with the mean velocities since (or, dt < 0, until) another one; None over a gap."""
    if not 0 < abs(dt) < rc.RELIEF_GAP_S:
        return None
    R_last, R = last.T_world_camera[:3, :3], T[:3, :3]
    return Moving(
        T_world_camera=T,
        omega=se3.log_so3(R_last.T @ R) / dt,
        velocity=R.T @ (T[:3, 3] - last.T_world_camera[:3, 3]) / dt,
    )
