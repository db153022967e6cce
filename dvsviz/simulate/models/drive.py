"""Vehicles on wheels in the plane: differential drive and Ackermann steering.

State `(x, y, theta)` (..., 3): position in m and yaw in rad, wrapped to (-pi, pi]; all functions work on leading axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def wrap_angle(angle: ArrayLike) -> Array:
    """Return angles (...) in rad brought to (-pi, pi]."""
    a = np.asarray(angle, dtype=np.float64)
    return np.pi - np.mod(np.pi - a, 2 * np.pi)


def differential_drive_rate(state: ArrayLike, v: ArrayLike, omega: ArrayLike) -> Array:
    """Return `(x', y', theta') = (v cos theta, v sin theta, omega)` (..., 3).

    Args:
        state: (..., 3).
        v: forward velocity (...), m/s.
        omega: yaw rate (...), rad/s.
    """
    theta = np.asarray(state, dtype=np.float64)[..., 2]
    v, omega = np.asarray(v), np.asarray(omega)
    return np.stack(np.broadcast_arrays(v * np.cos(theta), v * np.sin(theta), omega), axis=-1)


def differential_drive_euler(state: ArrayLike, v: ArrayLike, omega: ArrayLike, tau: ArrayLike) -> Array:
    """Return `x_{t+1} = x_t + tau (v cos theta, v sin theta, omega)`: Euler's rule over `tau` seconds."""
    s = np.asarray(state, dtype=np.float64)
    moved = s + np.asarray(tau)[..., None] * differential_drive_rate(s, v, omega)
    moved[..., 2] = wrap_angle(moved[..., 2])
    return moved


def differential_drive_exact(state: ArrayLike, v: ArrayLike, omega: ArrayLike, tau: ArrayLike) -> Array:
    """Return the state after `tau` seconds of constant velocities, along an arc of radius `v / omega`.

    `x_{t+1} = x_t + tau (v sinc(h) cos(theta + h), v sinc(h) sin(theta + h), omega)`, `h = omega tau / 2`,
    `sinc(h) = sin(h) / h`: the exponential of the planar twist `(v, 0, omega)`.
    """
    s = np.asarray(state, dtype=np.float64)
    half = np.asarray(omega) * np.asarray(tau) / 2
    chord = np.asarray(v) * np.asarray(tau) * np.sinc(half / np.pi)
    theta = s[..., 2] + half
    x, y = s[..., 0] + chord * np.cos(theta), s[..., 1] + chord * np.sin(theta)
    return np.stack(np.broadcast_arrays(x, y, wrap_angle(theta + half)), axis=-1)


def body_velocity(v_left: ArrayLike, v_right: ArrayLike, axle: float) -> tuple[Array, Array]:
    """Return `v = (v_R + v_L) / 2` and `omega = (v_R - v_L) / axle` of wheel velocities (...), m/s."""
    left, right = np.asarray(v_left, dtype=np.float64), np.asarray(v_right, dtype=np.float64)
    return (right + left) / 2, (right - left) / _length(axle, "axle")


def wheel_velocities(v: ArrayLike, omega: ArrayLike, axle: float) -> tuple[Array, Array]:
    """Return `v_L = v - omega axle / 2` and `v_R = v + omega axle / 2`, m/s."""
    v, turn = np.asarray(v, dtype=np.float64), np.asarray(omega) * _length(axle, "axle") / 2
    return v - turn, v + turn


def ackermann_turn(v: ArrayLike, steering: ArrayLike, wheelbase: float) -> Array:
    """Return the yaw rate `omega = v tan(phi) / L` (...), rad/s.

    Args:
        v: forward velocity (...) of the rear axle, m/s.
        steering: angle phi (...) of the front wheels, rad, below pi/2 in magnitude.
        wheelbase: distance L of the axles, m.

    Raises:
        ValueError: the wheels stand across, or the wheelbase is not above 0.
    """
    phi = np.asarray(steering, dtype=np.float64)
    if np.any(np.abs(phi) >= np.pi / 2):
        raise ValueError("steering: expected angles below pi/2")
    return np.asarray(v) * np.tan(phi) / _length(wheelbase, "wheelbase")


def ackermann_euler(state: ArrayLike, v: ArrayLike, steering: ArrayLike, wheelbase: float, tau: ArrayLike) -> Array:
    """Return `x_t + tau (v cos theta, v sin theta, v tan(phi) / L)`: Euler's rule."""
    return differential_drive_euler(state, v, ackermann_turn(v, steering, wheelbase), tau)


def ackermann_exact(state: ArrayLike, v: ArrayLike, steering: ArrayLike, wheelbase: float, tau: ArrayLike) -> Array:
    """Return the state after an arc of radius `L / tan(phi)`: differential drive with `omega = v tan(phi) / L`."""
    return differential_drive_exact(state, v, ackermann_turn(v, steering, wheelbase), tau)


def _length(value: float, name: str) -> float:
    if not value > 0:
        raise ValueError(f"{name}: expected a length above 0, got {value}")
    return value
