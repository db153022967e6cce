"""Homographies of a moving camera before a plane, at nodes in time, with their derivatives.

Appendix A of seed 000 with the corrections of the project's equations: the rotation's derivative by the exact left
Jacobian, the normal's by the corrected A.11 on a tangent basis of S².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.kernels import node_count, node_times
from dvsviz.geometry import se3
from dvsviz.geometry.plane import Plane, points_to_map, rotation_to_map_derivative

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Warp:
    """A homography that changes over a window, at equally spaced nodes.

    Attributes:
        nodes: bearings (x, y, 1) -> homogeneous target pixels (M, 3, 3).
        scale: nodes per second.
        d_nodes: derivatives by each parameter (P, M, 3, 3); P = 0 where they were not asked.
    """

    nodes: Array
    scale: float
    d_nodes: Array


def window_warp(
    omega: Array,
    velocity: Array,
    plane: Plane,
    duration_s: float,
    target: Array,
    *,
    d_normal: Array | None = None,
    derivatives: bool = True,
) -> Warp:
    """Return the warp of a window's events to its first event: P (I + v t n^T/d)^-1 R(t) (eq. 2.10, A.6).

    Parameters, in order: omega (3), velocity (3), and those of the normal where `d_normal` is given.

    Args:
        omega: angular velocity (3,), rad/s, camera frame.
        velocity: linear velocity (3,), units of the plane's distance per second, camera frame.
        plane: in the camera frame at the first event.
        duration_s: length of the window.
        target: fixed projection P (3, 3) applied last: K for the image.
        d_normal: derivative (3, Q) of the unit normal by Q parameters of its own (`plane.turn_normal_derivative`).
        derivatives: compute `d_nodes`.
    """
    t, scale = node_times(duration_s, node_count(float(np.linalg.norm(omega)) * duration_s))
    n, v = np.asarray(plane.normal), np.asarray(velocity, dtype=np.float64) / plane.distance
    R = se3.exp_so3(np.multiply.outer(t, omega))
    denominator = 1.0 + t * (n @ v)
    # Sherman-Morrison; a camera that would reach the plane inside the window is held just before it.
    denominator = np.where(denominator > 1e-3, denominator, 1e-3)
    A = np.eye(3) - (t / denominator)[:, None, None] * np.outer(v, n)
    PA = target @ A
    nodes = PA @ R
    if not derivatives:
        return Warp(nodes=nodes, scale=scale, d_nodes=np.zeros((0, *nodes.shape)))
    d_nodes = np.empty((6 + (0 if d_normal is None else d_normal.shape[1]), *nodes.shape))
    J = se3.left_jacobian_so3(np.multiply.outer(t, omega))
    nR = n @ R
    for i in range(3):
        # d R(t) / d omega_i = (J_l e_i t)^ R (exact; A.8 is its first order).
        d_nodes[i] = PA @ (se3.hat(J[:, :, i] * t[:, None]) @ R)
        # -t (n·y) / (1 + t n·v) P A e_i, y = R x (A.9), with v in plane distances.
        d_nodes[3 + i] = -(t / denominator)[:, None, None] * np.einsum("mq,mc->mqc", PA[:, :, i], nR)
        d_nodes[3 + i] /= plane.distance
    if d_normal is not None:
        PAv, AR = PA @ v, A @ R
        for i, axis in enumerate(d_normal.T):
            # -t (P A v) (A y)^T dn: the corrected A.11.
            d_nodes[6 + i] = -t[:, None, None] * np.einsum("mq,mc->mqc", PAv, axis @ AR)
    return Warp(nodes=nodes, scale=scale, d_nodes=d_nodes)


def map_warp(
    T_world_camera: Array,
    omega: Array,
    velocity: Array,
    plane_world: Plane,
    start_s: float,
    duration_s: float,
    target: Array,
    *,
    derivatives: bool = True,
) -> Warp:
    """Return the warp of events onto a world plane (eq. 2.11), for a pose known at one time of the window.

    Parameters, in order: rotation (3) by `R_world_camera exp(phi^)` and position (3) by `t + R_world_camera rho`,
    both at the time of the pose, in the camera frame; the velocities are held.

    Args:
        T_world_camera: pose (4, 4) at time 0.
        omega: angular velocity (3,), rad/s, camera frame at time 0.
        velocity: linear velocity (3,), camera frame at time 0.
        plane_world: the map's plane.
        start_s: time of the window's first event relative to the pose's time (negative for a pose inside it).
        duration_s: length of the window.
        target: affine map (3, 3) from plane coordinates (u, v, 1) to target pixels.
        derivatives: compute `d_nodes`.
    """
    t, scale = node_times(duration_s, node_count(float(np.linalg.norm(omega)) * duration_s))
    t = t + start_s
    R0, p0 = T_world_camera[:3, :3], T_world_camera[:3, 3]
    n, d = plane_world.normal, plane_world.distance
    E = se3.exp_so3(np.multiply.outer(t, omega))
    R = R0 @ E
    position = p0 + (t[:, None] * velocity) @ R0.T
    n_c = n @ R
    d_c = d + position @ n
    PM = target @ points_to_map(plane_world)
    nodes = PM @ (d_c[:, None, None] * R - position[:, :, None] * n_c[:, None, :])
    if not derivatives:
        return Warp(nodes=nodes, scale=scale, d_nodes=np.zeros((0, *nodes.shape)))
    d_nodes = np.empty((6, *nodes.shape))

    def by_position(dp: Array) -> Array:
        """Return the derivative by a shift `dp` (M, 3) of the position: P M ((dp·n) R - dp n_c^T)."""
        return PM @ ((dp @ n)[:, None, None] * R - dp[:, :, None] * n_c[:, None, :])

    for i in range(3):
        axis = np.eye(3)[i]
        # R0 exp(phi) E = R0 E exp((E^T phi)^): dH = H (E^T e_i)^, and the position R0 exp(phi) v t turns too.
        turned = np.multiply.outer(t, R0 @ np.cross(axis, velocity))
        d_nodes[i] = nodes @ se3.hat(E[:, i, :]) + by_position(turned)
        d_nodes[3 + i] = by_position(np.broadcast_to(R0[:, i], (len(t), 3)))
    return Warp(nodes=nodes, scale=scale, d_nodes=d_nodes)


def keyframe_warp(
    T_world_camera: Array,
    omega: Array,
    velocity: Array,
    plane_world: Plane,
    duration_s: float,
    target: Array,
    d_normal: Array,
) -> Warp:
    """Return the warp of a keyframe's events onto the map's plane (eq. 2.11) with the derivatives of section 2.2.3.

    Parameters, in order: rotation (3) and position (3) as in `map_warp`, omega (3), velocity (3), and those of the
    normal, which turns the plane under the camera and the map's frame (eq. 2.12, 2.13) with it.

    Args:
        T_world_camera: pose (4, 4) at the first event.
        omega: angular velocity (3,), rad/s, camera frame at the first event.
        velocity: linear velocity (3,), camera frame at the first event.
        plane_world: the map's plane.
        duration_s: length of the window.
        target: affine map (3, 3) from plane coordinates (u, v, 1) to target pixels.
        d_normal: derivative (3, Q) of the unit normal by its parameters.
    """
    posed = map_warp(T_world_camera, omega, velocity, plane_world, 0.0, duration_s, target)
    t = np.arange(len(posed.nodes)) / posed.scale
    R0, p0 = T_world_camera[:3, :3], T_world_camera[:3, 3]
    n, d = plane_world.normal, plane_world.distance
    flat = np.array([[1.0], [1.0], [d]])
    E = se3.exp_so3(np.multiply.outer(t, omega))
    R = R0 @ E
    position = p0 + (t[:, None] * velocity) @ R0.T
    n_c, d_c = n @ R, d + position @ n
    PM = target @ points_to_map(plane_world)
    onto = d_c[:, None, None] * R - position[:, :, None] * n_c[:, None, :]
    J = se3.left_jacobian_so3(np.multiply.outer(t, omega))
    d_nodes = np.empty((12 + d_normal.shape[1], *posed.nodes.shape))
    d_nodes[:6] = posed.d_nodes
    for i in range(3):
        # dE = (J_l e_i t)^ E, under (d_c I - p n^T).
        turned = R0 @ (se3.hat(J[:, :, i] * t[:, None]) @ E)
        d_nodes[6 + i] = PM @ (d_c[:, None, None] * turned - position[:, :, None] * (n @ turned)[:, None, :])
        moved = np.multiply.outer(t, R0[:, i])
        d_nodes[9 + i] = PM @ ((moved @ n)[:, None, None] * R - moved[:, :, None] * n_c[:, None, :])
    for i, axis in enumerate(d_normal.T):
        frame = target @ (rotation_to_map_derivative(n, axis) / flat)
        under = (position @ axis)[:, None, None] * R - position[:, :, None] * (axis @ R)[:, None, :]
        d_nodes[12 + i] = frame @ onto + PM @ under
    return Warp(nodes=posed.nodes, scale=posed.scale, d_nodes=d_nodes)
