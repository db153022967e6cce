"""When a simulation draws its images: so often that nothing moves far from one to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.simulate.motion import Motion
from dvsviz.simulate.relief import ReliefView

Array = NDArray[np.float64]

# Largest image motion between two rendered images, px: an edge is a few pixels wide, so a straight line between
# images puts events within a few hundredths of a pixel.
STEP_PX = 0.4
LONGEST_STEP_S = 5e-3
# So many images are ten hours of a still camera; their poses and homographies take 2 GB.
_MOST_STEPS = 10_000_000
# At 80,000 px/s a hand's shake is beyond every lens; only views of nearly 180 degrees move as fast.
_MOST_STEPS_A_SECOND = 200_000
# Long motions are looked at in parts of so many poses.
PART = 1 << 17
# The camera does not come nearer to a surface of a scene with depth.
_NEAREST_M = 0.08


def border_bearings(camera: Camera, count: int = 9) -> Array:
    """Return bearings (M, 3) along the border of the image and at its centre."""
    x, y = np.linspace(0, camera.width - 1, count), np.linspace(0, camera.height - 1, count)
    px = [(a, b) for a in x for b in (0, camera.height - 1)] + [(a, b) for a in (0, camera.width - 1) for b in y]
    b = camera.bearings([*px, ((camera.width - 1) / 2, (camera.height - 1) / 2)])
    return np.column_stack([b, np.ones(len(b))])


def image_speed(
    motion: Motion, camera: Camera, plane_world: Plane | None, t_s: Array, relief: ReliefView | None = None
) -> Array:
    """Return the largest speed (N,), px/s, of the scene's points over the image; a panorama without a plane."""
    if len(t_s) > PART:
        parts = [t_s[k : k + PART] for k in range(0, len(t_s), PART)]
        return np.concatenate([image_speed(motion, camera, plane_world, part, relief) for part in parts])
    b = border_bearings(camera) if relief is None else inner_bearings(camera)
    dt = 5e-4
    T0, T1 = motion(t_s), motion(t_s + dt)
    T_10 = se3.inverse(T1) @ T0
    inverse_depth = np.zeros((len(t_s), len(b)))
    if plane_world is not None:
        n = np.einsum("nji,j->ni", T0[:, :3, :3], plane_world.normal)
        d = plane_world.distance + T0[:, :3, 3] @ plane_world.normal
        inverse_depth = np.clip(-(n @ b.T) / np.maximum(d, 1e-3)[:, None], 0, None)
    if relief is not None:
        inverse_depth = 1 / np.stack([np.nan_to_num(relief.depth(T, b[:, :2]), nan=np.inf) for T in T0])
        if inverse_depth.max() > 1 / _NEAREST_M:
            raise ValueError(f"motion: the camera comes within {1 / inverse_depth.max():.3f} m of a surface")
    p = np.einsum("nij,mj->nmi", T_10[:, :3, :3], b) + inverse_depth[:, :, None] * T_10[:, None, :3, 3]
    moved = p[:, :, :2] / p[:, :, 2:] - b[:, :2]
    return np.hypot(moved[..., 0] * camera.fx, moved[..., 1] * camera.fy).max(axis=1) / dt


def inner_bearings(camera: Camera, columns: int = 13, rows: int = 10) -> Array:
    """Return bearings (M, 3) all over the image: the nearest surface of a scene with depth may be anywhere."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows))
    b = camera.bearings(np.column_stack([x.ravel(), y.ravel()]))
    return np.column_stack([b, np.ones(len(b))])


def step_times(speed: Array, t_s: Array, longest_s: float = LONGEST_STEP_S) -> Array:
    """Return times from the first to the last of `t_s`, between which the image moves at most `STEP_PX`."""
    # The largest of neighbours: speed between two samples is not above it by more than its curvature.
    peak = np.maximum(speed, np.maximum(np.roll(speed, 1), np.roll(speed, -1)))
    per_s = np.maximum(peak * 1.05 / STEP_PX, 1 / longest_s)
    steps = np.concatenate([[0.0], np.cumsum((per_s[1:] + per_s[:-1]) / 2 * np.diff(t_s))])
    most = min(_MOST_STEPS, 1000 + _MOST_STEPS_A_SECOND * (t_s[-1] - t_s[0]))
    if not steps[-1] <= most:
        raise ValueError(
            f"motion, size: {steps[-1]:,.0f} images would be needed, at most {most:,.0f} are drawn: the image moves "
            "too fast, or for too long"
        )
    return np.interp(np.linspace(0, steps[-1], int(np.ceil(steps[-1])) + 1), steps, t_s)
