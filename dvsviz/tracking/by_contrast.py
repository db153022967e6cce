"""A window by contrast alone and with the map: the two stages of seed 000, section 2.2.2.

The pose at the window's first event is what the last window's velocity made of it (eq. 2.15, 2.16) and is held; what is
found is the velocity (6 parameters): first by the contrast of the window on a blank canvas, with polarities, then by
the contrast of the map's texture and the window together, without. Slower than aligning with the map
(`tracking.align`), and the reference for it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.contrast.iwe import sample_indices, vote, warp_points
from dvsviz.contrast.objectives import Image
from dvsviz.contrast.solve import ContrastProblem, maximize_contrast
from dvsviz.contrast.warp import window_warp
from dvsviz.events.windows import EventWindow
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera, points_to_map
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import Alignment
from dvsviz.tracking.bootstrap import contrast_problem
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.pose_equations import pose_equations, turned
from dvsviz.tracking.state import Motion

Array = NDArray[np.float64]

_ONE = np.ones(1, dtype=np.float32)


def follow_by_contrast(
    camera: Camera,
    config: TrackerConfig,
    free: NDArray[np.bool_],
    motion: Motion,
    planar_map: PlanarMap,
    window: EventWindow,
    sampled: tuple[NDArray[np.float32], Array],
    mid_us: int,
) -> Alignment:
    """Return a window placed by the two stages; the velocities in `motion` become those at its middle.

    Args:
        camera: of the window.
        config: objective, seed, longest window.
        free: mask (6,) over rotation and translation.
        motion: last pose and velocities.
        planar_map: the map.
        window: its events.
        sampled: bearings (N, 2) and times (N,) that the placed window is judged by.
        mid_us: time of the pose that is returned.
    """
    # Through a gap without events the camera stood still.
    ahead_s = min((window.start_us - motion.t_us) * 1e-6, 2e-3 * config.max_window_ms)
    T_start = se3.propagate(motion.T_world_camera, motion.omega, motion.velocity, ahead_s)
    omega, velocity = motion.omega, se3.exp_so3(motion.omega * ahead_s).T @ motion.velocity
    seen = planar_map.plane.seen_from(T_start)
    evaluations = 0
    if seen.distance > c.PLANE_TOO_NEAR:
        alone = contrast_problem(
            camera, window, sample_indices(window, c.CONTRAST_EVENTS, config.seed), config.seed
        )
        prior = np.concatenate([omega, velocity])
        for stage in range(2):
            problem = alone if stage == 0 else with_map(alone, planar_map, T_start, seen, omega, velocity)
            solved = maximize_contrast(
                problem,
                seen,
                omega=omega,
                velocity=velocity,
                free=free,
                name=config.objective,
                blurs_px=c.STAGE_BLURS_PX,
                max_evaluations=c.STAGE_EVALUATIONS,
                ridge=c.STAGE_RIDGE,
                prior=prior,
            )
            omega, velocity = solved.omega, solved.velocity
            evaluations += solved.iterations
    mid_s = (mid_us - window.start_us) * 1e-6
    T = se3.propagate(T_start, omega, velocity, mid_s)
    motion.omega, motion.velocity = omega, se3.exp_so3(omega * mid_s).T @ velocity
    bearings, t_s = sampled
    return placed(planar_map, bearings, t_s - mid_s, T, motion.omega, motion.velocity, iterations=evaluations)


def with_map(
    alone: ContrastProblem,
    planar_map: PlanarMap,
    T_world_start: Array,
    seen: Plane,
    omega: Array,
    velocity: Array,
) -> ContrastProblem:
    """Return the joint contrast of a window and the part of the map before it, without polarities.

    Args:
        alone: the window on its own.
        planar_map: its saturated edge image is the texture, as strong as the window's own edges.
        T_world_start: pose (4, 4) at the first event.
        seen: the map's plane in that camera frame.
        omega: motion (3,) at which the window's edges are measured.
        velocity: the same (3,).
    """
    H = planar_map.projection @ homography_map_camera(T_world_start, planar_map.plane)
    warp = window_warp(omega, velocity, seen, alone.duration_s, H, derivatives=False)
    cells = warp_points(alone.bearings, alone.t_s, warp)
    fine = cells[np.isfinite(cells).all(axis=1)]
    if len(fine) == 0:
        return alone
    low = np.floor(np.percentile(fine, 0.5, axis=0)).astype(int) - c.STAGE_MARGIN_PX
    high = np.ceil(np.percentile(fine, 99.5, axis=0)).astype(int) + c.STAGE_MARGIN_PX
    largest = 4 * np.array([alone.camera.width, alone.camera.height])
    cols, rows = np.minimum(high - low, largest).tolist()
    own = vote((cells - low).astype(np.float32), _ONE, (rows, cols))
    strength = float(np.percentile(own[own > 0], 90)) if (own > 0).any() else 1.0
    shift = np.array([[1.0, 0, -low[0]], [0, 1.0, -low[1]], [0, 0, 1.0]])
    return replace(
        alone,
        weights=_ONE,
        target=shift @ H,
        texture=cut(planar_map.level(-1), int(low[1]), int(low[0]), rows, cols)
        * np.float32(c.STAGE_TEXTURE * strength),
    )


def cut(image: Image, row: int, col: int, rows: int, cols: int) -> Image:
    """Return a block (rows, columns) of an image from (row, col), zero where it reaches beyond."""
    out = np.zeros((rows, cols), dtype=np.float32)
    r0, c0 = max(0, row), max(0, col)
    r1, c1 = min(image.shape[0], row + rows), min(image.shape[1], col + cols)
    if r1 > r0 and c1 > c0:
        out[r0 - row : r1 - row, c0 - col : c1 - col] = image[r0:r1, c0:c1]
    return out


def placed(
    planar_map: PlanarMap,
    bearings: NDArray[np.float32],
    t_s: Array,
    T_world_camera: Array,
    omega: Array,
    velocity: Array,
    *,
    iterations: int,
) -> Alignment:
    """Return what the map says of a window at a pose, in the numbers of `tracking.align.align`.

    Args:
        planar_map: the map.
        bearings: sampled events (N, 2).
        t_s: their times (N,) relative to the pose, increasing.
        T_world_camera: pose (4, 4) at time 0.
        omega: angular velocity (3,), camera frame at time 0.
        velocity: linear velocity (3,), camera frame at time 0.
        iterations: evaluations that found the pose.
    """
    plane = planar_map.plane
    target = planar_map.projection @ points_to_map(plane)
    rays = np.empty((3, len(bearings)), dtype=np.float32)
    turned(bearings, t_s, omega, rays)
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    total, inside = pose_equations(
        rays,
        t_s.astype(np.float32),
        np.ascontiguousarray(T_world_camera[:3, :3]),
        np.ascontiguousarray(T_world_camera[:3, 3]),
        velocity,
        plane.normal,
        plane.distance,
        target,
        planar_map.level(-1),
        c.ALIGN_ROBUST,
        False,
        information,
        gradient,
    )
    return Alignment(
        T_world_camera=T_world_camera,
        value=total / inside if inside > 0 else 0.0,
        inside=inside / len(bearings),
        information=information / c.RESIDUAL_VARIANCE,
        iterations=iterations,
        step_px=0.0,
    )
