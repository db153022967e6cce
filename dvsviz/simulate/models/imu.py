"""The inertial measurement unit: angular velocity and specific force, with lever arm, biases and noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.geometry import se3

Array = NDArray[np.float64]
# A world whose z points up, as the quadrotor's.
GRAVITY_DOWN_Z = np.array([0.0, 0.0, -9.81])


def imu(
    R_world_body: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    accel_world: ArrayLike,
    *,
    T_body_imu: ArrayLike | None = None,
    gyro_bias: ArrayLike = 0.0,
    accel_bias: ArrayLike = 0.0,
    gravity_world: ArrayLike = GRAVITY_DOWN_Z,
) -> tuple[Array, Array]:
    """Return what gyroscope and accelerometer measure (..., 3) each, without noise.

    `z_w = R_BI^T omega + b_g`
    `z_a = R_BI^T (a - R^T g_w + alpha^ p_BI + omega^² p_BI) + b_a`, `a = R^T a_w`

    The accelerometer feels the specific force: at rest it shows `-R^T g_w`, which is +9.81 m/s² along up.

    Args:
        R_world_body: rotations (..., 3, 3).
        omega: angular velocity (..., 3), body frame, rad/s.
        alpha: angular acceleration (..., 3), body frame, rad/s².
        accel_world: acceleration (..., 3) of the body's origin, world frame, m/s².
        T_body_imu: the sensor's pose (4, 4) on the body; None where it is the body's own.
        gyro_bias: (..., 3), rad/s.
        accel_bias: (..., 3), m/s².
        gravity_world: acceleration of a falling body (3,), m/s².
    """
    R, w = np.asarray(R_world_body, dtype=np.float64), np.asarray(omega, dtype=np.float64)
    T = np.eye(4) if T_body_imu is None else np.asarray(T_body_imu, dtype=np.float64)
    R_BI, p_BI = T[:3, :3], T[:3, 3]
    force_world = np.asarray(accel_world, dtype=np.float64) - np.asarray(gravity_world)
    force = (np.swapaxes(R, -1, -2) @ force_world[..., None])[..., 0]
    w_hat = se3.hat(w)
    force = force + (se3.hat(alpha) + w_hat @ w_hat) @ p_BI
    return w @ R_BI + np.asarray(gyro_bias), force @ R_BI + np.asarray(accel_bias)


def imu_jacobians(
    R_world_body: ArrayLike,
    omega: ArrayLike,
    accel_world: ArrayLike,
    *,
    T_body_imu: ArrayLike | None = None,
    gravity_world: ArrayLike = GRAVITY_DOWN_Z,
) -> dict[str, Array]:
    """Return the derivatives (3, 3) of one measurement, named `measurement_variable`.

    `gyro_omega = R_BI^T`; `accel_rotation = R_BI^T (R^T (a_w - g_w))^` for `R exp(phi^)`;
    `accel_omega = R_BI^T (omega · p I + omega p^T - 2 p omega^T)`; `accel_alpha = -R_BI^T p^`;
    `accel_accel = R_BI^T R^T`; those by the biases are the identity.
    """
    R, w = np.asarray(R_world_body, dtype=np.float64), np.asarray(omega, dtype=np.float64)
    T = np.eye(4) if T_body_imu is None else np.asarray(T_body_imu, dtype=np.float64)
    R_IB, p = T[:3, :3].T, T[:3, 3]
    felt = R.T @ (np.asarray(accel_world, dtype=np.float64) - np.asarray(gravity_world))
    return {
        "gyro_omega": R_IB,
        "accel_rotation": R_IB @ se3.hat(felt),
        "accel_omega": R_IB @ ((w @ p) * np.eye(3) + np.outer(w, p) - 2 * np.outer(p, w)),
        "accel_alpha": -R_IB @ se3.hat(p),
        "accel_accel": R_IB @ R.T,
    }


def random_walk(count: int, start: ArrayLike, density: float, tau: float, rng: np.random.Generator) -> Array:
    """Return a bias (count, 3) that drifts: `b_{k+1} = b_k + density sqrt(tau) n_k`, `b_0 = start`.

    Its standard deviation grows by `density sqrt(t)`.
    """
    steps = density * np.sqrt(tau) * rng.standard_normal((max(count - 1, 0), 3))
    return np.asarray(start) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[:count]
