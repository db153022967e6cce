"""Planes, their homographies, and the flat coordinates of a planar map.

A plane in frame a: `normal_a · p_a + distance_a = 0`, distance > 0, the normal pointing at the camera:
a wall straight ahead has normal (0, 0, -1) (equations, "Planar warp").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plane:
    """A plane `normal · p + distance = 0` in one frame.

    Attributes:
        normal: unit vector (3,).
        distance: from the frame's origin to the plane, > 0, in the frame's units.
    """

    normal: Array
    distance: float = 1.0

    def seen_from(self, T_world_camera: Array) -> Plane:
        """Return this world plane in the camera frame: n_c = R_cw n_w, d_c = d_w + t_wc · n_w.

        The distance is not positive where the camera is on or behind the plane.
        """
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
        return Plane(normal=R.T @ self.normal, distance=float(self.distance + t @ self.normal))


def rotation_to_map(normal_world: Array) -> Array:
    """Return `R_map_world` (3, 3), the least rotation that takes the normal to (0, 0, -1) (eq. 2.12, 2.13).

    Raises:
        ValueError: the normal is (0, 0, 1), where the rotation is not defined.
    """
    return _rotation_to_map(tuple(np.asarray(normal_world, dtype=np.float64).tolist()))


@lru_cache(maxsize=64)
def _rotation_to_map(normal_world: tuple[float, ...]) -> Array:
    n = np.array(normal_world)
    z = np.array([0.0, 0.0, -1.0])
    c = 1.0 + n @ z
    if c < 1e-9:
        raise ValueError("normal_world: expected a plane that faces the first camera, got (0, 0, 1)")
    K = se3.hat(np.cross(n, z))
    R = np.eye(3) + K + K @ K / c
    R.flags.writeable = False
    return R


def points_to_map(plane_world: Plane) -> Array:
    """Return (3, 3): plane point in the world -> homogeneous map point (u, v, 1), for `homography_map_camera`."""
    return _points_to_map(plane_world.distance, *np.asarray(plane_world.normal, dtype=np.float64).tolist())


@lru_cache(maxsize=64)
def _points_to_map(distance: float, *normal_world: float) -> Array:
    to_map = _rotation_to_map(normal_world) / np.array([[1.0], [1.0], [distance]])
    to_map.flags.writeable = False
    return to_map


def rotation_to_map_derivative(normal_world: Array, d_normal: Array) -> Array:
    """Return the derivative (3, 3) of `rotation_to_map` as the normal moves along `d_normal` (3,)."""
    z = np.array([0.0, 0.0, -1.0])
    c, dc = 1.0 + normal_world @ z, d_normal @ z
    K, dK = se3.hat(np.cross(normal_world, z)), se3.hat(np.cross(d_normal, z))
    return dK + (dK @ K + K @ dK) / c - (dc / c**2) * (K @ K)


def tangent_basis(normal: Array) -> Array:
    """Return two unit vectors (3, 2) that span the tangent plane of S² at `normal`, without singularity.

    The basis replaces the angles of eq. A.13, which are singular where a camera faces the plane.
    """
    n = np.asarray(normal, dtype=np.float64)
    axis = np.zeros(3)
    axis[int(np.argmin(np.abs(n)))] = 1.0
    first = np.cross(n, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(n, first)], axis=-1)


def turn_normal(normal: Array, delta: Array) -> Array:
    """Return the unit normal (3,) moved along the tangent basis by `delta` (2,) rad."""
    n = np.asarray(normal, dtype=np.float64) + tangent_basis(normal) @ np.asarray(delta, dtype=np.float64)
    return n / np.linalg.norm(n)


def turn_normal_derivative(normal: Array, delta: Array) -> Array:
    """Return the derivative (3, 2) of `turn_normal(normal, delta)` by `delta`."""
    B = tangent_basis(normal)
    moved = np.asarray(normal, dtype=np.float64) + B @ np.asarray(delta, dtype=np.float64)
    length = np.linalg.norm(moved)
    n = moved / length
    return (B - np.outer(n, n @ B)) / length


def homography_map_camera(T_world_camera: Array, plane_world: Plane) -> Array:
    """Return `H_map_camera` (3, 3): bearing (x, y, 1) -> homogeneous map point (u, v, 1), eq. 2.11 and 2.14.

    (u, v) are the plane point's coordinates in the map frame, `R_map_world p_world = (u, v, distance)`, in the
    world's units; `(u, v) / distance` are the bearings of eq. 2.11.
    """
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    n_camera, d_camera = R.T @ plane_world.normal, plane_world.distance + t @ plane_world.normal
    # A bearing b meets the plane at depth s = d_c / (-n_c · b): p_map = R_mw (R s b + t), scaled by -n_c · b / d.
    return points_to_map(plane_world) @ (d_camera * R - t[:, None] * n_camera)


def map_to_world(points_map: Array, plane_world: Plane) -> Array:
    """Return plane points (N, 3) in the world of map coordinates (u, v) (N, 2)."""
    uv = np.asarray(points_map, dtype=np.float64)
    p = np.column_stack([uv, np.full(len(uv), plane_world.distance)])
    return p @ rotation_to_map(plane_world.normal)
