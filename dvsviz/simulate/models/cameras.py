"""The geometry of cameras: pinhole with distortion, radial distortion alone, stereo.

Frames and Jacobians as in `points`; optical axes: x right, y down, z forward.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.geometry.camera import Camera
from dvsviz.simulate.models.points import Jacobians, position, through_position

Array = NDArray[np.float64]

# Camera axes in a body with x forward, y left, z up: `p_body = R_BODY_OPTICAL p_optical`.
R_BODY_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def pinhole(T_world_camera: ArrayLike, camera: Camera, m: ArrayLike) -> Array:
    """Return the pixels `z = P K d(pi(R^T (m - p)))` (..., 2), `pi(x) = x / x_3`, `d` the lens's distortion.

    `d(x, y) = (x s + 2 p1 x y + p2 (r² + 2 x²), y s + p1 (r² + 2 y²) + 2 p2 x y)`, `s = 1 + k1 r² + k2 r⁴ + k3 r⁶`.

    Args:
        T_world_camera: poses (..., 4, 4).
        camera: calibration.
        m: points (..., 3) in the world; NaN is returned for those that are not in front of the camera.
    """
    p = _in_front(position(T_world_camera, m))
    b = p[..., :2] / p[..., 2:]
    return camera.project(b).reshape(b.shape)


def pinhole_jacobians(T_world_camera: ArrayLike, camera: Camera, m: ArrayLike) -> Jacobians:
    """Return the Jacobians of `pinhole` (..., 2, 6) and (..., 2, 3)."""
    p = _in_front(position(T_world_camera, m))
    b = p[..., :2] / p[..., 2:]
    local = distortion_jacobian(camera, b) @ _projection_jacobian(p)
    return through_position(np.array([[camera.fx], [camera.fy]]) * local, T_world_camera, m)


def spherical(T_world_camera: ArrayLike, m: ArrayLike) -> Array:
    """Return the directions `z = π_s(R^T (m - p))` (..., 3), `π_s(x) = x / |x|`: points on a sphere, behind too.

    Args:
        T_world_camera: poses (..., 4, 4).
        m: points (..., 3) in the world; NaN is returned for one at the camera's centre.
    """
    p = position(T_world_camera, m)
    length = np.linalg.norm(p, axis=-1, keepdims=True)
    return np.where(length > 0, p / np.where(length > 0, length, 1.0), np.nan)


def spherical_jacobians(T_world_camera: ArrayLike, m: ArrayLike) -> Jacobians:
    """Return the Jacobians of `spherical` (..., 3, 6) and (..., 3, 3): `(I - z z^T) / |x|` through the position."""
    z = spherical(T_world_camera, m)
    length = np.linalg.norm(position(T_world_camera, m), axis=-1)[..., None, None]
    across = (np.eye(3) - z[..., :, None] * z[..., None, :]) / length
    return through_position(across, T_world_camera, m)


def distortion_jacobian(camera: Camera, bearings: ArrayLike) -> Array:
    """Return the derivative (..., 2, 2) of the distorted bearing by the ideal one (..., 2)."""
    b = np.asarray(bearings, dtype=np.float64)
    x, y = b[..., 0], b[..., 1]
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    s, ds = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * k3 * r2)
    cross = 2 * x * y * ds + 2 * p1 * x + 2 * p2 * y
    xx = s + 2 * x * x * ds + 2 * p1 * y + 6 * p2 * x
    yy = s + 2 * y * y * ds + 6 * p1 * y + 2 * p2 * x
    return np.stack([np.stack([xx, cross], axis=-1), np.stack([cross, yy], axis=-1)], axis=-2)


def undistort_radial(distorted: ArrayLike, a1: float, a2: float) -> Array:
    """Return `(x, y) = (x_d, y_d) (1 + a1 r² + a2 r⁴)` (..., 2), `r² = x_d² + y_d²`: the polynomial that undistorts.

    It is not the one of `Camera`, whose polynomial distorts.
    """
    d = np.asarray(distorted, dtype=np.float64)
    r2 = np.sum(d * d, axis=-1, keepdims=True)
    return d * (1 + r2 * (a1 + a2 * r2))


def undistort_radial_jacobian(distorted: ArrayLike, a1: float, a2: float) -> Array:
    """Return `s I + (2 a1 + 4 a2 r²) d d^T` (..., 2, 2), `s = 1 + a1 r² + a2 r⁴`."""
    d = np.asarray(distorted, dtype=np.float64)
    r2 = np.sum(d * d, axis=-1)[..., None, None]
    return (1 + r2 * (a1 + a2 * r2)) * np.eye(2) + (2 * a1 + 4 * a2 * r2) * d[..., :, None] * d[..., None, :]


def distort_radial(ideal: ArrayLike, a1: float, a2: float) -> Array:
    """Return the (x_d, y_d) (..., 2) that `undistort_radial` takes to `ideal`: Newton's method on the radius.

    Raises:
        ValueError: no radius on the polynomial's rising branch gives a point.
    """
    u = np.asarray(ideal, dtype=np.float64)
    wanted = np.linalg.norm(u, axis=-1)
    r = wanted.copy()
    for _ in range(60):
        slope = 1 + r * r * (3 * a1 + 5 * a2 * r * r)
        # Half way back where a step would leave the branch that rises from zero.
        r = np.where(
            slope > 0.05, r - (r * (1 + r * r * (a1 + a2 * r * r)) - wanted) / np.maximum(slope, 0.05), r / 2
        )
    left = np.abs(r * (1 + r * r * (a1 + a2 * r * r)) - wanted)
    if np.any(~(left < 1e-10 * (1 + wanted))):
        raise ValueError("ideal: expected points within the reach of the distortion")
    return u * np.where(wanted > 0, r / np.where(wanted > 0, wanted, 1.0), 1.0)[..., None]


def stereo(T_world_camera: ArrayLike, camera: Camera, baseline: float, m: ArrayLike) -> Array:
    """Return `(u_L, v_L, d)` (..., 3): pixel of the left camera and disparity `d = u_L - u_R = fx b / z`.

    Args:
        T_world_camera: poses (..., 4, 4) of the left camera.
        camera: calibration of both, without distortion.
        baseline: b, m: the right camera stands at `(b, 0, 0)` of the left one.
        m: points (..., 3) in the world; NaN for those not in front.
    """
    _check_stereo(camera, baseline)
    p = _in_front(position(T_world_camera, m))
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return np.stack([u, v, camera.fx * baseline / z], axis=-1)


def stereo_jacobians(T_world_camera: ArrayLike, camera: Camera, baseline: float, m: ArrayLike) -> Jacobians:
    """Return the Jacobians of `stereo` (..., 3, 6) and (..., 3, 3)."""
    _check_stereo(camera, baseline)
    p = _in_front(position(T_world_camera, m))
    z = p[..., 2]
    by_depth = np.stack([0 * z, 0 * z, -camera.fx * baseline / z**2], axis=-1)
    rows = np.array([[camera.fx], [camera.fy]]) * _projection_jacobian(p)
    return through_position(np.concatenate([rows, by_depth[..., None, :]], axis=-2), T_world_camera, m)


def stereo_inverse(T_world_camera: ArrayLike, camera: Camera, baseline: float, z: ArrayLike) -> Array:
    """Return the point (..., 3) in the world of `(u_L, v_L, d)`: depth `fx b / d`, along the pixel's bearing."""
    _check_stereo(camera, baseline)
    T, z = np.asarray(T_world_camera, dtype=np.float64), np.asarray(z, dtype=np.float64)
    depth = camera.fx * baseline / np.where(z[..., 2] > 0, z[..., 2], np.nan)
    p = np.stack(
        [(z[..., 0] - camera.cx) / camera.fx, (z[..., 1] - camera.cy) / camera.fy, np.ones_like(depth)], -1
    )
    return (T[..., :3, :3] @ (p * depth[..., None])[..., None])[..., 0] + T[..., :3, 3]


def _projection_jacobian(p: Array) -> Array:
    """Return the derivative (..., 2, 3) of `(x / z, y / z)`."""
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    zero = np.zeros_like(z)
    rows = (np.stack([1 / z, zero, -x / z**2], axis=-1), np.stack([zero, 1 / z, -y / z**2], axis=-1))
    return np.stack(rows, axis=-2)


def _in_front(p: Array) -> Array:
    return np.where(p[..., 2:] > 0, p, np.nan)


def _check_stereo(camera: Camera, baseline: float) -> None:
    if camera.has_distortion or not baseline > 0:
        raise ValueError(f"stereo: expected rectified cameras and a baseline above 0, got {baseline}")
