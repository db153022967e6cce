"""The inertial sensor on a moving camera: angular velocity and specific force along the optical axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.recording import Imu
from dvsviz.geometry import se3
from dvsviz.simulate.models.imu import imu, random_walk
from dvsviz.simulate.motion import Motion

# Gravity in the simulated world, whose y points down.
GRAVITY_WORLD = np.array([0.0, 9.81, 0.0])
_STEP_S = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuModel:
    """Noise, biases and place of an inertial sensor on the camera.

    Attributes:
        rate_hz: samples a second.
        gyro_sigma: rad/s, of each sample.
        accel_sigma: m/s², of each sample.
        gyro_bias_sigma: rad/s, of the bias of each axis at the start.
        accel_bias_sigma: m/s², of the bias of each axis at the start.
        gyro_walk: rad/s an sqrt(s), by which the biases walk.
        accel_walk: m/s² an sqrt(s), by which the biases walk.
        lever_arm: of the sensor from the camera's centre, along the optical axes, m.
    """

    rate_hz: float = 1000.0
    gyro_sigma: float = 0.003
    accel_sigma: float = 0.03
    gyro_bias_sigma: float = 0.01
    accel_bias_sigma: float = 0.05
    gyro_walk: float = 0.0
    accel_walk: float = 0.0
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)


def rates(motion: Motion, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the true angular velocity (N, 3), rad/s, and acceleration in the world (N, 3), m/s².

    Both by central differences of the motion (0.1 ms: errors below 1e-6 for the motions here).
    """
    before, now, after = motion(t_s - _STEP_S), motion(t_s), motion(t_s + _STEP_S)
    R = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    gyro = se3.log_so3(R) / (2 * _STEP_S)
    accel = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / _STEP_S**2
    return gyro, accel


def simulate_imu(
    model: ImuModel,
    motion: Motion,
    seconds: float,
    rng: np.random.Generator,
    gravity_world: NDArray[np.float64] = GRAVITY_WORLD,
) -> Imu:
    """Return the measurements over a recording: those of `models.imu.imu`, with noise and walking biases.

    Args:
        model: the sensor.
        motion: of the camera.
        seconds: duration.
        rng: for biases and noise.
        gravity_world: acceleration of a falling body (3,), m/s².
    """
    t_us = np.round(np.arange(int(seconds * model.rate_hz) + 1) * 1e6 / model.rate_hz).astype(np.int64)
    t_s = (t_us * 1e-6).astype(np.float64)
    omega, accel_world = rates(motion, t_s)
    alpha = (rates(motion, t_s + _STEP_S)[0] - rates(motion, t_s - _STEP_S)[0]) / (2 * _STEP_S)
    gyro, force = imu(
        motion(t_s)[:, :3, :3],
        omega,
        alpha,
        accel_world,
        T_body_imu=se3.pose(None, model.lever_arm),
        gravity_world=gravity_world,
    )
    n, tau = len(t_s), 1 / model.rate_hz
    gyro_bias = model.gyro_bias_sigma * rng.standard_normal(3)
    gyro_noise = model.gyro_sigma * rng.standard_normal((n, 3))
    accel_bias = model.accel_bias_sigma * rng.standard_normal(3)
    accel_noise = model.accel_sigma * rng.standard_normal((n, 3))
    gyro = gyro + random_walk(n, gyro_bias, model.gyro_walk, tau, rng) + gyro_noise
    force = force + random_walk(n, accel_bias, model.accel_walk, tau, rng) + accel_noise
    return Imu(t_us=t_us, gyro=gyro, accel=force)
