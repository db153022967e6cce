"""Alignment of a window with the map: Gauss-Newton on the edge image, coarse to fine.

The pose at the middle of the window is solved for; the velocities that de-skew the window are held. To first order
this maximises the cross term of the joint variance of map and window (tracking notes, finding 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.kernels import normal_equations
from dvsviz.geometry import se3
from dvsviz.geometry.plane import rotation_to_map
from dvsviz.tracking import constants as c
from dvsviz.tracking.planar_map import PlanarMap

Array = NDArray[np.float64]

# Nodes a window: the homography is interpolated linearly between them; 4 intervals keep a turn of 0.1 rad in one
# window exact to 1e-4 rad.
_NODES = 5


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
    """

    T_world_camera: Array
    value: float
    inside: float
    information: Array
    iterations: int
    step_px: float


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
    first_level: int = 0,
    iterations: tuple[int, ...] = c.ALIGN_ITERATIONS,
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
        first_level: 0 for the whole pyramid, more to start finer.
        iterations: steps at each level.
    """
    levels = planar_map.pyramid()
    plane = planar_map.plane
    target = planar_map.projection @ (rotation_to_map(plane.normal) / np.array([[1.0], [1.0], [plane.distance]]))
    if prior is None:
        prior = default_prior()
    R, p = T_world_camera[:3, :3].copy(), T_world_camera[:3, 3].copy()
    R0, p0 = R.copy(), p.copy()
    information = np.zeros((6, 6))
    value, inside, steps, step_px = 0.0, 0.0, 0, 0.0
    start, end = float(t_s[0]), float(t_s[-1])
    for i in range(first_level, len(levels)):
        value, inside, taken, step_px = _descend(
            levels[i],
            bearings,
            t_s - start,
            R,
            p,
            R0,
            p0,
            omega,
            velocity,
            plane.normal,
            plane.distance,
            target,
            start,
            max(end - start, 1e-6),
            free,
            prior,
            anchored,
            iterations[i],
            focal_px,
            information,
        )
        steps += taken
    return Alignment(
        T_world_camera=se3.pose(R, p),
        value=value,
        inside=inside,
        information=information / c.RESIDUAL_VARIANCE,
        iterations=steps,
        step_px=step_px,
    )


def default_prior() -> Array:
    """Return the information (6, 6) of a constant-velocity prediction."""
    return np.diag([c.PRIOR_ROTATION_RAD**-2] * 3 + [c.PRIOR_POSITION**-2] * 3)


@numba.njit(cache=True, nogil=True)
def exp_rotation(v):
    """Return exp(v^) (3, 3) of one rotation vector (3,): `se3.exp_so3` inside kernels."""
    a2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if a2 < 1e-10:
        s, k = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        a = np.sqrt(a2)
        s, k = np.sin(a) / a, (1.0 - np.cos(a)) / a2
    x, y, z = v[0], v[1], v[2]
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1 - k * (y * y + z * z), k * x * y - s * z, k * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = k * x * y + s * z, 1 - k * (x * x + z * z), k * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = k * x * z - s * y, k * y * z + s * x, 1 - k * (x * x + y * y)
    return out


@numba.njit(cache=True, nogil=True)
def map_nodes(R0, p0, omega, velocity, normal, distance, target, start, duration, nodes, d_nodes):
    """Write the homographies (M, 3, 3) and derivatives (6, M, 3, 3) of `contrast.warp.map_warp`, without allocating.

    `target` is the projection to cells times the rotation to the map, its last row divided by the distance.
    """
    m = nodes.shape[0]
    v_world = R0 @ velocity
    step = np.empty((3, 3))
    for k in range(m):
        t = start + duration * k / (m - 1)
        E = exp_rotation(omega * t)
        R = R0 @ E
        position = p0 + v_world * t
        n_c = normal @ R
        d_c = distance + position @ normal
        for a in range(3):
            for b in range(3):
                step[a, b] = d_c * R[a, b] - position[a] * n_c[b]
        H = target @ step
        nodes[k] = H
        for i in range(3):
            # dp by the position along R0 e_i; the rotation turns R0 v t as well.
            for kind in range(2):
                if kind == 0:
                    dx = R0[0, i]
                    dy = R0[1, i]
                    dz = R0[2, i]
                else:
                    # R0 (e_i x v) t
                    cx = 0.0
                    cy = 0.0
                    cz = 0.0
                    if i == 0:
                        cy, cz = -velocity[2], velocity[1]
                    elif i == 1:
                        cx, cz = velocity[2], -velocity[0]
                    else:
                        cx, cy = -velocity[1], velocity[0]
                    dx = (R0[0, 0] * cx + R0[0, 1] * cy + R0[0, 2] * cz) * t
                    dy = (R0[1, 0] * cx + R0[1, 1] * cy + R0[1, 2] * cz) * t
                    dz = (R0[2, 0] * cx + R0[2, 1] * cy + R0[2, 2] * cz) * t
                dn = dx * normal[0] + dy * normal[1] + dz * normal[2]
                for b in range(3):
                    step[0, b] = dn * R[0, b] - dx * n_c[b]
                    step[1, b] = dn * R[1, b] - dy * n_c[b]
                    step[2, b] = dn * R[2, b] - dz * n_c[b]
                D = target @ step
                if kind == 0:
                    d_nodes[3 + i, k] = D
                else:
                    # H (E^T e_i)^
                    w0, w1, w2 = E[i, 0], E[i, 1], E[i, 2]
                    for a in range(3):
                        h0, h1, h2 = H[a, 0], H[a, 1], H[a, 2]
                        d_nodes[i, k, a, 0] = h1 * w2 - h2 * w1 + D[a, 0]
                        d_nodes[i, k, a, 1] = h2 * w0 - h0 * w2 + D[a, 1]
                        d_nodes[i, k, a, 2] = h0 * w1 - h1 * w0 + D[a, 2]


@numba.njit(cache=True, nogil=True)
def _descend(
    image,
    bearings,
    t_rel,
    R,
    p,
    R_prior,
    p_prior,
    omega,
    velocity,
    normal,
    distance,
    target,
    start,
    duration,
    free,
    prior,
    anchored,
    limit,
    focal_px,
    information,
):
    """Take up to `limit` damped Gauss-Newton steps on one level, moving R and p in place."""
    nodes = np.empty((_NODES, 3, 3))
    d_nodes = np.empty((6, _NODES, 3, 3))
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    scale = (_NODES - 1) / duration
    total, inside, taken, step_px = 0.0, 0, 0, 0.0
    for _ in range(limit):
        map_nodes(R, p, omega, velocity, normal, distance, target, start, duration, nodes, d_nodes)
        hessian[:] = 0.0
        gradient[:] = 0.0
        total, inside = normal_equations(
            bearings, t_rel, nodes, d_nodes, scale, image, c.ALIGN_ROBUST, hessian, gradient
        )
        information[:] = hessian
        A = hessian + prior * c.RESIDUAL_VARIANCE
        # How far the pose has moved from the prediction, in the current camera frame: the prior pulls it back.
        offset = np.empty(6)
        D = R_prior.T @ R
        offset[0] = 0.5 * (D[2, 1] - D[1, 2])
        offset[1] = 0.5 * (D[0, 2] - D[2, 0])
        offset[2] = 0.5 * (D[1, 0] - D[0, 1])
        offset[3:] = R.T @ (p - p_prior)
        g = gradient + (prior * c.RESIDUAL_VARIANCE) @ offset
        if anchored > 0.0:
            # The same towards the identity.
            pull = anchored * c.RESIDUAL_VARIANCE
            g[0] += pull * 0.5 * (R[2, 1] - R[1, 2])
            g[1] += pull * 0.5 * (R[0, 2] - R[2, 0])
            g[2] += pull * 0.5 * (R[1, 0] - R[0, 1])
            g[3:] += pull * (R.T @ p)
            for q in range(6):
                A[q, q] += pull
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
    count = bearings.shape[0]
    value = total / inside if inside > 0 else 0.0
    return value, inside / count, taken, step_px
