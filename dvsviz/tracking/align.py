"""Alignment of a window with the map: Gauss-Newton on the edge image, coarse to fine.

The pose at the middle of the window is solved for; the velocities that de-skew the window are held. To first order
this maximises the cross term of the joint variance of map and window (tracking notes, finding 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.plane import homography_map_camera, points_to_map
from dvsviz.geometry.rotation_kernels import exp_rotation
from dvsviz.tracking import constants as c
from dvsviz.tracking.kernels import still_written
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.pose_equations import pose_equations, turned

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agreement:
    """How well a window's events lie on the map.

    Attributes:
        score: (value at the events - value by chance) / (1 - value by chance): 0 is chance, 1 perfect.
        chance: mean of the edge image over the window's footprint.
        inside: share of the footprint that the map has seen.
    """

    score: float
    chance: float
    inside: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """A window aligned with the map.

    Attributes:
        T_world_camera: pose (4, 4) at the middle of the window.
        value: mean of the finest edge image at the sampled events inside the map.
        inside: share of the sampled events that fell inside the map.
        information: normal matrix (6, 6) of rotation and position (camera frame), events only, of the finest level,
            divided by the residual variance.
        iterations: Gauss-Newton steps taken.
        step_px: image displacement of the last step.
        agreed: what that is worth beyond chance, where it was asked for (`diagnose.agreement`).
    """

    T_world_camera: Array
    value: float
    inside: float
    information: Array
    iterations: int
    step_px: float
    agreed: Agreement | None = None


def free_parameters(motion: str) -> NDArray[np.bool_]:
    """Return the mask (6,) of rotation and position that a motion model solves for."""
    mask = np.ones(6, dtype=bool)
    if motion == "translation":
        mask[:3] = False
    elif motion == "rotation":
        mask[3:] = False
    return mask


def align(
    planar_map: PlanarMap,
    bearings: NDArray[np.float32],
    t_s: Array,
    T_world_camera: Array,
    omega: Array,
    velocity: Array,
    *,
    focal_px: float,
    free: NDArray[np.bool_],
    prior: Array | None = None,
    anchored: float = 0.0,
    view: NDArray[np.float32] | None = None,
    first_level: int = 0,
    iterations: tuple[int, ...] = c.ALIGN_ITERATIONS,
    to_lines: bool = False,
) -> Alignment:
    """Return the pose at time 0 of `t_s` that puts the events on the map's edges.

    Args:
        planar_map: the map.
        bearings: sampled events (N, 2) float32.
        t_s: their times (N,) relative to the pose, seconds, increasing.
        T_world_camera: predicted pose (4, 4) at time 0.
        omega: angular velocity (3,), rad/s, camera frame at time 0, held.
        velocity: linear velocity (3,), camera frame at time 0, held.
        focal_px: focal length, to express steps in px.
        free: mask (6,) of rotation and position to solve for.
        prior: information matrix (6, 6) of the prediction; the default constants' where None.
        anchored: information of a pull towards the world's origin: decides, always in the same way, between turning and
            moving sideways as long as the map cannot.
        view: rays (3, G) of `view_rays`: what the map would gain by chance from a camera nearer to the plane does not
            count where the map is still being written; None where it is not to be changed.
        first_level: 0 for the whole pyramid, more to start finer.
        iterations: steps at each level.
        to_lines: then bring the events' distances to the map's lines to their least, where most lie by one.
    """
    (found,) = align_each(
        planar_map,
        [bearings],
        [t_s],
        T_world_camera[None],
        omega[None],
        velocity[None],
        focal_px=focal_px,
        free=free,
        prior=prior,
        anchored=anchored,
        view=view,
        first_level=first_level,
        iterations=iterations,
        to_lines=to_lines,
    )
    return found


def align_each(
    planar_map: PlanarMap,
    bearings: Sequence[NDArray[np.float32]],
    t_s: Sequence[Array],
    Ts_world_camera: Array,
    omega: Array,
    velocity: Array,
    *,
    focal_px: float,
    free: NDArray[np.bool_],
    prior: Array | None = None,
    anchored: float = 0.0,
    view: NDArray[np.float32] | None = None,
    first_level: int = 0,
    iterations: tuple[int, ...] = c.ALIGN_ITERATIONS,
    to_lines: bool = False,
) -> list[Alignment]:
    """Return N windows, each aligned as by `align`; one without events keeps its pose.

    Args:
        planar_map: the map.
        bearings: sampled events (M, 2) of each window.
        t_s: their times (M,) relative to its pose.
        Ts_world_camera: predicted poses (N, 4, 4).
        omega: angular velocities (N, 3), held.
        velocity: linear velocities (N, 3), held.
        focal_px: as in `align`.
        free: as in `align`.
        prior: as in `align`, of every window.
        anchored: as in `align`.
        view: as in `align`, where the first window sees it.
        first_level: as in `align`.
        iterations: as in `align`.
        to_lines: as in `align`.
    """
    plane, count = planar_map.plane, len(Ts_world_camera)
    young = np.zeros((3, 0), dtype=np.float32)
    if view is not None:
        H = planar_map.projection @ homography_map_camera(Ts_world_camera[0], plane)
        young = still_written(view, H, planar_map.exposure, c.EXPOSURE_CELL_PX, planar_map.freeze_px)
    Ts, found, information = Ts_world_camera.copy(), np.zeros((count, 4)), np.zeros((count, 6, 6))
    _descend_each(
        # Three images of one kind, whichever are used: one compiled kernel.
        tuple(planar_map.level(max(i, first_level)) for i in range(len(c.ALIGN_BLURS_PX))),
        planar_map.smooth() if to_lines else planar_map.level(first_level),
        to_lines,
        view is not None and young.shape[1] >= c.LINE_YOUNG * view.shape[1],
        np.array(iterations),
        first_level,
        np.concatenate(bearings),
        np.concatenate(t_s),
        np.cumsum([0, *map(len, bearings)]),
        Ts,
        omega,
        velocity,
        plane.normal,
        plane.distance,
        planar_map.projection @ points_to_map(plane),
        free,
        default_prior() if prior is None else np.ascontiguousarray(prior),
        anchored,
        focal_px,
        young,
        0.0 if view is None else c.CHANCE_SHARE / view.shape[1],
        found,
        information,
    )
    return [
        Alignment(
            T_world_camera=Ts[k],
            value=float(found[k, 0]),
            inside=float(found[k, 1]),
            information=information[k],
            iterations=int(found[k, 2]),
            step_px=float(found[k, 3]),
        )
        for k in range(count)
    ]


def default_prior() -> Array:
    """Return the information (6, 6) of a constant-velocity prediction."""
    return np.diag([c.PRIOR_ROTATION_RAD**-2] * 3 + [c.PRIOR_POSITION**-2] * 3)


@numba.njit(cache=True, nogil=True)
def _descend(
    image,
    to_lines,
    keeps_depth,
    rays,
    t_s,
    R,
    p,
    R_prior,
    p_prior,
    velocity,
    normal,
    distance,
    target,
    free,
    prior,
    anchored,
    limit,
    focal_px,
    young,
    by_chance,
    information,
):
    """Take up to `limit` damped Gauss-Newton steps on one level, moving R and p in place."""
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    unused, chance, at_once = np.zeros((6, 6)), np.zeros(6), np.zeros(young.shape[1], dtype=np.float32)
    total, inside, taken, step_px = 0.0, 0, 0, 0.0
    robust = c.LINE_HUBER_PX if to_lines else c.ALIGN_ROBUST
    variance = c.LINE_VARIANCE_PX2 if to_lines else c.RESIDUAL_VARIANCE
    for _ in range(limit):
        hessian[:] = 0.0
        gradient[:] = 0.0
        total, inside = pose_equations(
            rays, t_s, R, p, velocity, normal, distance, target, image, robust, to_lines, hessian, gradient
        )
        information[:] = hessian / variance
        if not to_lines and young.shape[1] > 0:
            chance[:] = 0.0
            pose_equations(
                young, at_once, R, p, velocity, normal, distance, target, image, robust, to_lines, unused, chance
            )
            # Only along the normal, where events are drawn together.
            n = R.T @ normal
            gradient[3:] -= n * (by_chance * inside * (chance[3:] @ n))
        A = hessian + prior * variance
        # How far the pose has moved from the prediction, in the current camera frame: the prior pulls it back.
        offset = np.empty(6)
        D = R_prior.T @ R
        offset[0] = 0.5 * (D[2, 1] - D[1, 2])
        offset[1] = 0.5 * (D[0, 2] - D[2, 0])
        offset[2] = 0.5 * (D[1, 0] - D[0, 1])
        offset[3:] = R.T @ (p - p_prior)
        g = gradient + (prior * variance) @ offset
        if anchored > 0.0:
            # The same towards the identity.
            pull = anchored * variance
            g[0] += pull * 0.5 * (R[2, 1] - R[1, 2])
            g[1] += pull * 0.5 * (R[0, 2] - R[2, 0])
            g[2] += pull * 0.5 * (R[1, 0] - R[0, 1])
            g[3:] += pull * (R.T @ p)
            for q in range(6):
                A[q, q] += pull
        if keeps_depth:
            # Lines that are still being written go along with a camera that draws near.
            n = R.T @ normal
            g[3:] -= n * (g[3:] @ n)
            A[3:, 3:] += np.outer(n, n) * (1e3 * np.trace(A))
        for q in range(6):
            if not free[q]:
                A[q, :] = 0.0
                A[:, q] = 0.0
                A[q, q] = 1.0
                g[q] = 0.0
        step = -np.linalg.solve(A, g)
        size = 0.0
        for q in range(6):
            size = max(size, abs(step[q]))
        # A step of more than 0.1 rad or plane distances is a wrong linearisation: shortened.
        if size > 0.1:
            step *= 0.1 / size
            size = 0.1
        p += R @ step[3:]
        R[:] = R @ exp_rotation(step[:3])
        taken += 1
        step_px = size * focal_px
        if step_px < c.ALIGN_STEP_PX:
            break
    count = rays.shape[1]
    value = total / inside if inside > 0 else 0.0
    return value, inside / count, taken, step_px


@numba.njit(cache=True, nogil=True)
def _descend_each(
    images,
    smooth,
    to_lines,
    keeps_depth,
    limits,
    first_level,
    bearings,
    t_s,
    first,
    Ts,
    omega,
    velocity,
    normal,
    distance,
    target,
    free,
    prior,
    anchored,
    focal_px,
    young,
    by_chance,
    found,
    information,
):
    """Descend with each window (its events from `first[k]` on), level by level, moving its pose (4, 4) in place."""
    for k in range(Ts.shape[0]):
        a, b = first[k], first[k + 1]
        if a == b:
            continue
        rays, times = np.empty((3, b - a), dtype=np.float32), t_s[a:b].astype(np.float32)
        turned(bearings[a:b], t_s[a:b], omega[k], rays)
        R, p = Ts[k, :3, :3].copy(), Ts[k, :3, 3].copy()
        R0, p0 = R.copy(), p.copy()
        R_bright, p_bright, own = R, p, np.zeros((6, 6))
        # The lines come after the last level. One call for both: it is compiled once.
        for i in range(first_level, len(images) + (1 if to_lines else 0)):
            is_last = i == len(images)
            if is_last:
                R_bright, p_bright = R.copy(), p.copy()
            value, inside, taken, step_px = _descend(
                smooth if is_last else images[i],
                is_last,
                is_last and keeps_depth,
                rays,
                times,
                R,
                p,
                R0,
                p0,
                velocity[k],
                normal,
                distance,
                target,
                free,
                prior,
                anchored,
                c.LINE_ITERATIONS if is_last else limits[i],
                focal_px,
                young,
                by_chance,
                own,
            )
            found[k, 2] += taken
            if is_last and value < c.LINE_SHARE:
                R[:] = R_bright
                p[:] = p_bright
                continue
            information[k] = own
            found[k, 3] = step_px
            if not is_last:
                found[k, 0], found[k, 1] = value, inside
        Ts[k, :3, :3] = R
        Ts[k, :3, 3] = p
