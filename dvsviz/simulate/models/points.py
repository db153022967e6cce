"""What a sensor measures of a point: position, range, bearing, and the lidar's range, azimuth and elevation.

The sensor stands at `T_world_sensor` (..., 4, 4), the point at `m` (..., 3) in the world; functions work on leading
axes. `p_sensor = R^T (m - p)` is the point in the sensor's frame. Jacobians come in pairs: with respect to `xi = (rho,
phi)` of the pose `T exp(xi^)` (..., k, 6), and with respect to the point (..., k, 3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.geometry import se3
from dvsviz.simulate.models.drive import wrap_angle

Array = NDArray[np.float64]
Jacobians = tuple[Array, Array]


def with_noise(z: ArrayLike, sigma: ArrayLike, rng: np.random.Generator) -> Array:
    """Return `z + n` with Gaussian noise of standard deviation `sigma`, which is broadcast to the shape of `z`."""
    z = np.asarray(z, dtype=np.float64)
    return z + np.asarray(sigma) * rng.standard_normal(z.shape)


def position(T_world_sensor: ArrayLike, m: ArrayLike) -> Array:
    """Return the position sensor's `z = R^T (m - p)` (..., 3)."""
    T = np.asarray(T_world_sensor, dtype=np.float64)
    return (np.swapaxes(T[..., :3, :3], -1, -2) @ (np.asarray(m) - T[..., :3, 3])[..., None])[..., 0]


def position_jacobians(T_world_sensor: ArrayLike, m: ArrayLike) -> Jacobians:
    """Return `[-I, z^]` (..., 3, 6) and `R^T` (..., 3, 3)."""
    T = np.asarray(T_world_sensor, dtype=np.float64)
    z = position(T, m)
    by_point = np.broadcast_to(np.swapaxes(T[..., :3, :3], -1, -2), (*z.shape, 3))
    by_pose = np.concatenate([np.broadcast_to(-np.eye(3), (*z.shape, 3)), se3.hat(z)], axis=-1)
    return by_pose, by_point


def through_position(local: Array, T_world_sensor: ArrayLike, m: ArrayLike) -> Jacobians:
    """Return both Jacobians of `h(p_sensor)`, by the chain rule from its own `local` one (..., k, 3)."""
    by_pose, by_point = position_jacobians(T_world_sensor, m)
    return local @ by_pose, local @ by_point


def distance(T_world_sensor: ArrayLike, m: ArrayLike) -> Array:
    """Return the range sensor's `z = |R^T (m - p)| = |m - p|` (...)."""
    return np.linalg.norm(np.asarray(m) - np.asarray(T_world_sensor, dtype=np.float64)[..., :3, 3], axis=-1)


def distance_jacobians(T_world_sensor: ArrayLike, m: ArrayLike) -> Jacobians:
    """Return the Jacobians (..., 1, 6) and (..., 1, 3): `dz/dp_sensor = p_sensor^T / z`; not defined at `m = p`."""
    p = position(T_world_sensor, m)
    return through_position(
        (p / _not_zero(np.linalg.norm(p, axis=-1, keepdims=True)))[..., None, :], T_world_sensor, m
    )


def bearing(state: ArrayLike, m: ArrayLike) -> Array:
    """Return the planar bearing `z = atan2(m_2 - p_2, m_1 - p_1) - theta` (...), in (-pi, pi].

    Args:
        state: `(p_1, p_2, theta)` (..., 3).
        m: point (..., 2).
    """
    s = np.asarray(state, dtype=np.float64)
    to = np.asarray(m, dtype=np.float64) - s[..., :2]
    return wrap_angle(np.arctan2(to[..., 1], to[..., 0]) - s[..., 2])


def bearing_jacobians(state: ArrayLike, m: ArrayLike) -> Jacobians:
    """Return `dz/dstate = (d_2 / r², -d_1 / r², -1)` (..., 3) and `dz/dm = (-d_2 / r², d_1 / r²)`, `d = m - p`."""
    s = np.asarray(state, dtype=np.float64)
    d = np.asarray(m, dtype=np.float64) - s[..., :2]
    by_point = np.stack([-d[..., 1], d[..., 0]], axis=-1) / _not_zero(np.sum(d * d, axis=-1, keepdims=True))
    return np.concatenate([-by_point, np.full((*by_point.shape[:-1], 1), -1.0)], axis=-1), by_point


def lidar(T_world_sensor: ArrayLike, m: ArrayLike) -> Array:
    """Return `(r, azimuth, elevation)` (..., 3): `r = |p|`, `atan2(p_y, p_x)`, `asin(p_z / r)`, `p = R^T (m - p_0)`.

    The lidar's axes are x forward, y left, z up.
    """
    p = position(T_world_sensor, m)
    r = np.linalg.norm(p, axis=-1)
    return np.stack(
        [r, np.arctan2(p[..., 1], p[..., 0]), np.arcsin(np.clip(p[..., 2] / _not_zero(r), -1, 1))], axis=-1
    )


def lidar_inverse(T_world_sensor: ArrayLike, z: ArrayLike) -> Array:
    """Return the point `m = R (r cos a cos e, r sin a cos e, r sin e) + p_0` (..., 3) of `z = (r, a, e)`."""
    T, z = np.asarray(T_world_sensor, dtype=np.float64), np.asarray(z, dtype=np.float64)
    r, a, e = z[..., 0], z[..., 1], z[..., 2]
    p = np.stack([r * np.cos(a) * np.cos(e), r * np.sin(a) * np.cos(e), r * np.sin(e)], axis=-1)
    return (T[..., :3, :3] @ p[..., None])[..., 0] + T[..., :3, 3]


def lidar_jacobians(T_world_sensor: ArrayLike, m: ArrayLike) -> Jacobians:
    """Return the Jacobians (..., 3, 6) and (..., 3, 3); not defined on the lidar's z axis.

    With `q² = x² + y²`: rows `p / r`, `(-y, x, 0) / q²`, `(-x z, -y z, q²) / (r² q)`.
    """
    p = position(T_world_sensor, m)
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    q2, r2 = _not_zero(x * x + y * y), np.sum(p * p, axis=-1)
    q = np.sqrt(q2)
    rows = (
        p / np.sqrt(r2)[..., None],
        np.stack([-y / q2, x / q2, np.zeros_like(x)], axis=-1),
        np.stack([-x * z / q, -y * z / q, q], axis=-1) / r2[..., None],
    )
    return through_position(np.stack(rows, axis=-2), T_world_sensor, m)


def _not_zero(length: Array) -> Array:
    if np.any(length == 0):
        raise ValueError("m: expected a point away from the sensor, where the measurement is defined")
    return length
