"""Rigid-body kinematics: how a pose moves under a constant body-frame velocity.

All functions work on leading axes. A twist is `zeta = (v, omega)`: linear velocity, m/s, and angular velocity, rad/s,
both along the body's own axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.geometry import se3

Array = NDArray[np.float64]


def exp_se3(xi: ArrayLike) -> Array:
    """Return `exp(xi^)` (..., 4, 4) of `xi = (rho, phi)` (..., 6): `[exp(phi^), J_l(phi) rho; 0, 1]`."""
    xi = np.asarray(xi, dtype=np.float64)
    rho, phi = xi[..., :3], xi[..., 3:]
    return se3.pose(se3.exp_so3(phi), (se3.left_jacobian_so3(phi) @ rho[..., None])[..., 0])


def rotation_step(R_world_body: ArrayLike, omega: ArrayLike, tau: ArrayLike) -> Array:
    """Return `R_{k+1} = R_k exp(tau omega^)`, exact for a constant `omega`.

    Args:
        R_world_body: rotations (..., 3, 3).
        omega: angular velocity (..., 3), body frame, rad/s.
        tau: duration (...), s.
    """
    return np.asarray(R_world_body) @ se3.exp_so3(np.asarray(tau)[..., None] * np.asarray(omega))


def pose_step(T_world_body: ArrayLike, twist: ArrayLike, tau: ArrayLike) -> Array:
    """Return `T_{k+1} = T_k exp(tau zeta^)`, exact for a constant twist: the body moves along a screw.

    Args:
        T_world_body: poses (..., 4, 4).
        twist: `(v, omega)` (..., 6), body frame, m/s and rad/s.
        tau: duration (...), s.
    """
    return np.asarray(T_world_body) @ exp_se3(np.asarray(tau)[..., None] * np.asarray(twist))


def pose_step_euler(T_world_body: ArrayLike, twist: ArrayLike, tau: ArrayLike) -> Array:
    """Return `p_{k+1} = p_k + tau R_k v`, `R_{k+1} = R_k exp(tau omega^)`: Euler's rule in the position.

    The rotation stays a rotation. Error of the position: `|omega| |v| tau² / 2` to first order.
    """
    T, zeta, tau = np.asarray(T_world_body), np.asarray(twist), np.asarray(tau, dtype=np.float64)
    R = T[..., :3, :3]
    p = T[..., :3, 3] + tau[..., None] * (R @ zeta[..., :3, None])[..., 0]
    return se3.pose(rotation_step(R, zeta[..., 3:], tau), p)


def quaternion_product(a_wxyz: ArrayLike, b_wxyz: ArrayLike) -> Array:
    """Return `a ∘ b = [a_s b_s - a_v·b_v, a_s b_v + b_s a_v + a_v × b_v]` (..., 4), wxyz."""
    a, b = np.broadcast_arrays(np.asarray(a_wxyz, dtype=np.float64), np.asarray(b_wxyz, dtype=np.float64))
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def quaternion_exp(q_wxyz: ArrayLike) -> Array:
    """Return `exp([q_s, q_v]) = e^{q_s} [cos|q_v|, (q_v / |q_v|) sin|q_v|]` (..., 4)."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    angle = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    # numpy's sinc(x) is sin(pi x) / (pi x), which is 1 at zero.
    return np.exp(q[..., :1]) * np.concatenate([np.cos(angle), q[..., 1:] * np.sinc(angle / np.pi)], axis=-1)


def quaternion_step(q_world_body_wxyz: ArrayLike, omega: ArrayLike, tau: ArrayLike) -> Array:
    """Return `q_{k+1} = q_k ∘ exp([0, tau omega / 2])`, exact for a constant `omega`.

    Args:
        q_world_body_wxyz: unit quaternions (..., 4).
        omega: angular velocity (..., 3), body frame, rad/s.
        tau: duration (...), s.
    """
    half = np.asarray(tau)[..., None] * np.asarray(omega, dtype=np.float64) / 2
    return quaternion_product(q_world_body_wxyz, quaternion_exp(np.insert(half, 0, 0.0, axis=-1)))


def quaternion_step_euler(q_world_body_wxyz: ArrayLike, omega: ArrayLike, tau: ArrayLike) -> Array:
    """Return `q_k + tau q_k ∘ [0, omega / 2]`, brought back to length 1: turns by `2 atan(|omega| tau / 2)`."""
    q = np.asarray(q_world_body_wxyz, dtype=np.float64)
    pure = np.insert(np.asarray(omega, dtype=np.float64) / 2, 0, 0.0, axis=-1)
    moved = q + np.asarray(tau)[..., None] * quaternion_product(q, pure)
    return moved / np.linalg.norm(moved, axis=-1, keepdims=True)


def odometry_step(T_world_body: ArrayLike, T_body_next: ArrayLike) -> Array:
    """Return `x_{t+1} = T_t u_t` (..., 4, 4), `u_t` the pose of the body at t + 1 seen from itself at t."""
    return np.asarray(T_world_body) @ np.asarray(T_body_next)


def odometry(T_world_first: Array, Ts_body_next: Array) -> Array:
    """Return the poses `x_0, x_0 u_0, x_0 u_0 u_1, …` (N + 1, 4, 4) of N odometry measurements (N, 4, 4)."""
    Ts = np.empty((len(Ts_body_next) + 1, 4, 4))
    Ts[0] = T_world_first
    for k, u in enumerate(Ts_body_next):
        Ts[k + 1] = odometry_step(Ts[k], u)
    return Ts
