"""Rotations and rigid motions: exp and log of SO(3), the left Jacobian, quaternions, poses.

Every function is vectorised over leading axes. Quaternions are wxyz everywhere inside the
package; TUM files, scipy and rerun use xyzw: `xyzw_from_wxyz` and its twin are the only bridge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from dvsviz.geometry.rotation_kernels import exp_rotation, log_near

Array = NDArray[np.float64]

# Below this angle (rad) closed forms lose digits to cancellation and their series is exact to 1e-16.
_SMALL_ANGLE = 1e-4


def hat(vector: ArrayLike) -> Array:
    """Return the skew matrices (..., 3, 3) with `hat(a) @ b == cross(a, b)` (seed 000, eq. 2.9)."""
    v = np.asarray(vector, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _coefficients(angle: Array) -> tuple[Array, Array, Array]:
    """Return sin(a)/a, (1-cos a)/a², (a-sin a)/a³, each exact near zero."""
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    a = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - square / 24, 2 * np.sin(safe / 2) ** 2 / safe**2)
    # a - sin a cancels up to about 1e-2: its series is used there.
    mid = angle < 0.05
    safe_c = np.where(mid, 1.0, angle)
    c = np.where(
        mid,
        1 / 6 - square / 120 + square**2 / 5040 - square**3 / 362880,
        (safe_c - np.sin(safe_c)) / safe_c**3,
    )
    return a, b, c


def exp_so3(phi: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors `phi` (..., 3) in rad (eq. 2.8)."""
    phi = np.asarray(phi, dtype=np.float64)
    if phi.shape == (3,):
        # A copy: the kernel is compiled for one kind of array.
        return np.asarray(exp_rotation(np.array(phi)))
    k = hat(phi)
    a, b, _ = _coefficients(np.linalg.norm(phi, axis=-1))
    return np.eye(3) + a[..., None, None] * k + b[..., None, None] * (k @ k)


def log_so3(rotation: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3) in rad, angle at most pi, of matrices (..., 3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    one = np.empty(3)
    if r.shape == (3, 3) and log_near(np.array(r, order="C"), one):
        return one
    return Rotation.from_matrix(r.reshape(-1, 3, 3)).as_rotvec().reshape(*r.shape[:-2], 3)


def left_jacobian_so3(phi: ArrayLike) -> Array:
    """Return J_l (..., 3, 3): `exp(phi + d) ~ exp(J_l(phi) d) exp(phi)` for small d."""
    phi = np.asarray(phi, dtype=np.float64)
    k = hat(phi)
    _, b, c = _coefficients(np.linalg.norm(phi, axis=-1))
    return np.eye(3) + b[..., None, None] * k + c[..., None, None] * (k @ k)


def rotation_angle(rotation: ArrayLike) -> Array:
    """Return the angles (...) in rad, in [0, pi], of rotation matrices (..., 3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    # atan2 of sine and cosine keeps its digits near 0 and near pi, where the arc cosine of the trace loses them.
    sine = 0.5 * np.sqrt(
        (r[..., 2, 1] - r[..., 1, 2]) ** 2 + (r[..., 0, 2] - r[..., 2, 0]) ** 2 + (r[..., 1, 0] - r[..., 0, 1]) ** 2
    )
    cosine = 0.5 * (np.trace(r, axis1=-2, axis2=-1) - 1.0)
    return np.arctan2(sine, cosine)


def rotation_from_quaternion(q_wxyz: ArrayLike) -> Array:
    """Return matrices (..., 3, 3) of quaternions (..., 4) wxyz, normalised first.

    Raises:
        ValueError: a quaternion is zero or not finite.
    """
    q = np.asarray(q_wxyz, dtype=np.float64)
    norm = np.linalg.norm(q, axis=-1)
    if not np.all(np.isfinite(norm)) or np.any(norm < 1e-12):
        raise ValueError("q_wxyz: expected finite, non-zero quaternions")
    flat = xyzw_from_wxyz(q).reshape(-1, 4)
    return Rotation.from_quat(flat).as_matrix().reshape(*q.shape[:-1], 3, 3)


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Return quaternions (..., 4) wxyz with w >= 0 of rotation matrices (..., 3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    flat = Rotation.from_matrix(r.reshape(-1, 3, 3)).as_quat(canonical=True)
    return wxyz_from_xyzw(flat).reshape(*r.shape[:-2], 4)


def xyzw_from_wxyz(q_wxyz: ArrayLike) -> Array:
    """Return the same quaternions (..., 4) in xyzw order."""
    return np.roll(np.asarray(q_wxyz, dtype=np.float64), -1, axis=-1)


def wxyz_from_xyzw(q_xyzw: ArrayLike) -> Array:
    """Return the same quaternions (..., 4) in wxyz order."""
    return np.roll(np.asarray(q_xyzw, dtype=np.float64), 1, axis=-1)


def pose(rotation: ArrayLike | None = None, position: ArrayLike | None = None) -> Array:
    """Return `T_world_camera` (..., 4, 4) from `R_world_camera` (..., 3, 3) and `t_world_camera` (..., 3)."""
    r = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    t = np.zeros(3) if position is None else np.asarray(position, dtype=np.float64)
    shape = np.broadcast_shapes(r.shape[:-2], t.shape[:-1])
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = r, t, 1.0
    return out


def checked_pose(T_a_b: ArrayLike, name: str) -> Array:
    """Return a copy of a pose (4, 4) whose rotation is one to the last digit.

    Args:
        T_a_b: a rigid transform, its rotation good to a thousandth.
        name: how errors call it.

    Raises:
        ValueError: it has another shape, is not finite, or no rigid transform: scaled, sheared or mirrored.
    """
    T = np.array(T_a_b, dtype=np.float64)
    if T.shape != (4, 4):
        raise ValueError(f"{name}: expected a pose (4, 4), got {T.shape}")
    if not np.isfinite(T).all():
        raise ValueError(f"{name}: expected finite numbers")
    R = T[:3, :3]
    is_rigid = np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0
    if not is_rigid or np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
        raise ValueError(f"{name}: expected a rotation and a position, got a matrix that scales, shears or mirrors")
    return pose(Rotation.from_matrix(R).as_matrix(), T[:3, 3])


def inverse(T_a_b: ArrayLike) -> Array:
    """Return `T_b_a` (..., 4, 4) of rigid transforms `T_a_b` (..., 4, 4)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    R_b_a = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(R_b_a, -(R_b_a @ T[..., :3, 3:])[..., 0])


def propagate(T_world_camera: Array, omega: Array, velocity: Array, dt_s: float) -> Array:
    """Return the pose (4, 4) after `dt_s` of constant velocity (seed 000, eq. 2.15 and 2.16).

    Args:
        T_world_camera: pose (4, 4) at the start.
        omega: angular velocity (3,) in the camera frame at the start, rad/s.
        velocity: linear velocity (3,) in the camera frame at the start, units of the pose per second.
        dt_s: time in seconds, of either sign.
    """
    R = T_world_camera[:3, :3]
    return pose(R @ exp_so3(omega * dt_s), T_world_camera[:3, 3] + R @ velocity * dt_s)


def interpolate(t_us: ArrayLike, Ts_world_camera: ArrayLike, at_us: ArrayLike) -> Array:
    """Return poses (M, 4, 4) at times `at_us` (M,): linear in position, slerp in rotation.

    Args:
        t_us: strictly increasing times (N,) in microseconds, N >= 1.
        Ts_world_camera: poses (N, 4, 4).
        at_us: times (M,) inside `[t_us[0], t_us[-1]]`.

    Raises:
        ValueError: a time lies outside the poses.
    """
    t = np.asarray(t_us, dtype=np.int64)
    Ts = np.asarray(Ts_world_camera, dtype=np.float64)
    at = np.atleast_1d(np.asarray(at_us, dtype=np.int64))
    if at.size == 0:
        return np.zeros((0, 4, 4))
    if at.min() < t[0] or at.max() > t[-1]:
        raise ValueError(f"at_us: expected times in [{t[0]}, {t[-1]}], got [{at.min()}, {at.max()}]")
    if len(t) == 1:
        return np.repeat(Ts[:1], len(at), axis=0)
    # Only the poses beside the times are looked at: of a long trajectory often one time is asked for.
    before = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    first, second = Ts[before], Ts[before + 1]
    # Whole microseconds first: Unix time (1.7e15) keeps all its digits.
    share = (at - t[before]) / (t[before + 1] - t[before])
    turn = log_so3(np.swapaxes(first[:, :3, :3], -1, -2) @ second[:, :3, :3])
    R = first[:, :3, :3] @ exp_so3(share[:, None] * turn)
    p = first[:, :3, 3] + share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    return pose(R, p)
