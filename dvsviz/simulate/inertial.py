"""The inertial sensor on a moving camera: angular velocity and specific force along the optical axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.recording import Imu
from dvsviz.geometry import se3
from dvsviz.simulate.motion import Motion

# Gravity in the simulated world, whose y points down.
GRAVITY_WORLD = np.array([0.0, 9.81, 0.0])
_STEP_S = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuModel:
    """White noise and constant biases of an inertial sensor at the camera's centre.

    Attributes:
        rate_hz: samples a second.
        gyro_sigma: rad/s, of each sample.
        accel_sigma: m/s², of each sample.
        gyro_bias_sigma: rad/s, of the constant bias of each axis.
        accel_bias_sigma: m/s², of the constant bias of each axis.
    """

    rate_hz: float = 1000.0
    gyro_sigma: float = 0.003
    accel_sigma: float = 0.03
    gyro_bias_sigma: float = 0.01
    accel_bias_sigma: float = 0.05


def rates(motion: Motion, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the true angular velocity (N, 3), rad/s, and acceleration in the world (N, 3), m/s².

    Both by central differences of the motion (0.1 ms: errors below 1e-6 for the motions here).
    """
    before, now, after = motion(t_s - _STEP_S), motion(t_s), motion(t_s + _STEP_S)
    R = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    gyro = se3.log_so3(R) / (2 * _STEP_S)
    accel = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / _STEP_S**2
    return gyro, accel


def simulate_imu(model: ImuModel, motion: Motion, seconds: float, rng: np.random.Generator) -> Imu:
    """Return the measurements over a recording: `w + b_g + n_g` and `R^T (a - g) + b_a + n_a`.

    Args:
        model: the sensor.
        motion: of the camera.
        seconds: duration.
        rng: for biases and noise.
    """
    t_us = np.round(np.arange(int(seconds * model.rate_hz) + 1) * 1e6 / model.rate_hz).astype(np.int64)
    t_s = (t_us * 1e-6).astype(np.float64)
    gyro, accel_world = rates(motion, t_s)
    R = motion(t_s)[:, :3, :3]
    force = np.einsum("nji,nj->ni", R, accel_world - GRAVITY_WORLD)
    n = len(t_s)
    gyro = gyro + model.gyro_bias_sigma * rng.standard_normal(3) + model.gyro_sigma * rng.standard_normal((n, 3))
    force = (
        force + model.accel_bias_sigma * rng.standard_normal(3) + model.accel_sigma * rng.standard_normal((n, 3))
    )
    return Imu(t_us=t_us, gyro=gyro, accel=force)
