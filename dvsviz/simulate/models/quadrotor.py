"""A quadrotor as a rigid body with thrust and torque, and the controller that flies it at wanted velocities.

World: z up. Body: x forward, y left, z up. State (13,): position in the world, `q_world_body` wxyz, velocity and
angular velocity along the body's axes. Compiled, because a flight takes tens of thousands of steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dvsviz.geometry import se3

Array = NDArray[np.float64]
GRAVITY = 9.81


@dataclass(frozen=True, slots=True, kw_only=True)
class Quadrotor:
    """A quadrotor and the gains of its controller.

    Attributes:
        mass: kg.
        inertia: moments about the body's axes, kg m².
        velocity_gain: acceleration by velocity error, 1/s.
        attitude_gain: angular acceleration by attitude error, 1/s².
        rate_gain: angular acceleration by error of angular velocity, 1/s.
        max_tilt: rad, of the thrust the controller asks for.
    """

    mass: float = 1.2
    inertia: tuple[float, float, float] = (0.012, 0.013, 0.022)
    velocity_gain: float = 3.0
    attitude_gain: float = 80.0
    rate_gain: float = 16.0
    max_tilt: float = 0.5

    def __post_init__(self) -> None:
        if not (self.mass > 0 and min(self.inertia) > 0 and 0 < self.max_tilt < 1.5):
            raise ValueError("quadrotor: expected mass and inertia above 0, a tilt limit of 0 to 1.5 rad")


@njit(cache=True)
def _rotation(q):
    w, x, y, z = q[0], q[1], q[2], q[3]
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


@njit(cache=True)
def _cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True)
def _dynamics(state, thrust, torque, force, mass, inertia):
    q, v, w = state[3:7], state[7:10], state[10:13]
    R = _rotation(q / np.sqrt(np.sum(q * q)))
    out = np.empty(13)
    out[0:3] = R @ v
    out[3] = -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2])
    out[4] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1])
    out[5] = 0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2])
    out[6] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0])
    pull = force.copy()
    pull[2] -= mass * GRAVITY
    push = R.T @ pull
    push[2] += thrust
    out[7:10] = push / mass - _cross(w, v)
    out[10:13] = (torque - _cross(w, inertia * w)) / inertia
    return out


@njit(cache=True)
def _step(state, thrust, torque, force, mass, inertia, tau):
    k1 = _dynamics(state, thrust, torque, force, mass, inertia)
    k2 = _dynamics(state + tau / 2 * k1, thrust, torque, force, mass, inertia)
    k3 = _dynamics(state + tau / 2 * k2, thrust, torque, force, mass, inertia)
    k4 = _dynamics(state + tau * k3, thrust, torque, force, mass, inertia)
    out = state + tau / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    out[3:7] /= np.sqrt(np.sum(out[3:7] ** 2))
    return out


@njit(cache=True)
def _control(state, velocity, yaw, mass, inertia, velocity_gain, attitude_gain, rate_gain, max_tilt):
    q, w = state[3:7], state[10:13]
    R = _rotation(q / np.sqrt(np.sum(q * q)))
    wanted = velocity_gain * (velocity - R @ state[7:10])
    wanted[2] = max(wanted[2] + GRAVITY, 0.2 * GRAVITY)
    side, most = np.sqrt(wanted[0] ** 2 + wanted[1] ** 2), wanted[2] * np.tan(max_tilt)
    if side > most:
        wanted[0] *= most / side
        wanted[1] *= most / side
    R_wanted = np.empty((3, 3))
    up = wanted / np.sqrt(np.sum(wanted * wanted))
    left = _cross(up, np.array([np.cos(yaw), np.sin(yaw), 0.0]))
    left /= np.sqrt(np.sum(left * left))
    R_wanted[:, 0], R_wanted[:, 1], R_wanted[:, 2] = _cross(left, up), left, up
    D = R_wanted.T @ R
    error = 0.5 * np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    torque = inertia * (-attitude_gain * error - rate_gain * w) + _cross(w, inertia * w)
    thrust = mass * (wanted[0] * R[0, 2] + wanted[1] * R[1, 2] + wanted[2] * R[2, 2])
    return max(thrust, 0.0), torque


@njit(cache=True)
def _fly(state, position, yaw, forces, tau, gain, max_speed, mass, inertia, gains):
    states = np.empty((len(yaw), 13))
    for k in range(len(yaw)):
        states[k] = state
        # The outer loop of the source: the wanted velocity is proportional to the distance that is left.
        velocity = gain * (position[k] - state[:3])
        speed = np.sqrt(np.sum(velocity * velocity))
        if speed > max_speed:
            velocity *= max_speed / speed
        thrust, torque = _control(state, velocity, yaw[k], mass, inertia, gains[0], gains[1], gains[2], gains[3])
        state = _step(state, thrust, torque, forces[k], mass, inertia, tau)
    return states


def quadrotor_state(position: Array, yaw: float = 0.0) -> Array:
    """Return the state (13,) of hovering at a position (3,) in the world with a yaw in rad."""
    state = np.zeros(13)
    state[:3], state[3], state[6] = position, np.cos(yaw / 2), np.sin(yaw / 2)
    return state


def quadrotor_rate(
    model: Quadrotor, state: Array, thrust: float, torque: Array, force: Array | None = None
) -> Array:
    """Return the state's rate of change (13,).

    `p' = R v`, `q' = q ∘ [0, omega / 2]` (`R' = R omega^`), `m v' = -omega × m v + rho e3 - m g R^T e3 + R^T f`,
    `J omega' = -omega × J omega + tau`.

    Args:
        model: the quadrotor.
        state: (13,).
        thrust: rho along the body's z axis, N.
        torque: tau (3,) about the body's axes, N m.
        force: what else pulls, such as wind (3,), world frame, N; None for nothing.
    """
    f = np.zeros(3) if force is None else np.asarray(force, dtype=np.float64)
    inertia = np.array(model.inertia)
    return _dynamics(np.asarray(state, np.float64), thrust, np.asarray(torque, np.float64), f, model.mass, inertia)


def quadrotor_step(
    model: Quadrotor, state: Array, thrust: float, torque: Array, tau: float, force: Array | None = None
) -> Array:
    """Return the state (13,) after `tau` seconds of constant inputs: one Runge-Kutta step of fourth order."""
    f = np.zeros(3) if force is None else np.asarray(force, dtype=np.float64)
    inertia = np.array(model.inertia)
    return _step(np.asarray(state, np.float64), thrust, np.asarray(torque, np.float64), f, model.mass, inertia, tau)


def velocity_control(model: Quadrotor, state: Array, velocity: Array, yaw: float) -> tuple[float, Array]:
    """Return thrust (N) and torque (3,) (N m) that lead to a velocity (3,) in the world and a yaw.

    Wanted acceleration `a = k_v (v_d - R v) + g e3`, its tilt limited; `R_d` has its z axis along `a` and its x axis
    toward the yaw; `rho = m a · R e3`; `tau = J (-k_R e_R - k_w omega) + omega × J omega`,
    `e_R = vee(R_d^T R - R^T R_d) / 2`.
    """
    return _control(
        np.asarray(state, np.float64), np.asarray(velocity, np.float64), yaw, model.mass, np.array(model.inertia),
        model.velocity_gain, model.attitude_gain, model.rate_gain, model.max_tilt,
    )  # fmt: skip


def fly(
    model: Quadrotor,
    position: Array,
    yaw: Array,
    tau: float,
    *,
    forces: Array | None = None,
    position_gain: float = 1.0,
    max_speed: float = 1.0,
) -> Array:
    """Return the states (N, 13) of a flight along wanted positions and yaws, `tau` seconds apart.

    The wanted velocity is `position_gain (p_d - p)`, at most `max_speed`, and goes to `velocity_control`.

    Args:
        model: the quadrotor; it begins in hover at the first position.
        position: wanted (N, 3), world frame, m.
        yaw: wanted (N,), rad.
        tau: step, s; at most 0.02 for the default gains.
        forces: of the wind (N, 3), world frame, N; None for none.
        position_gain: 1/s.
        max_speed: m/s.
    """
    gains = np.array([model.velocity_gain, model.attitude_gain, model.rate_gain, model.max_tilt])
    forces = np.zeros((len(yaw), 3)) if forces is None else np.ascontiguousarray(forces, dtype=np.float64)
    return _fly(
        quadrotor_state(position[0], float(yaw[0])), np.ascontiguousarray(position, dtype=np.float64),
        np.ascontiguousarray(yaw, dtype=np.float64), forces, tau, position_gain, max_speed, model.mass,
        np.array(model.inertia), gains,
    )  # fmt: skip


def poses_of(states: Array) -> Array:
    """Return `T_world_body` (N, 4, 4) of states (N, 13)."""
    return se3.pose(se3.rotation_from_quaternion(states[:, 3:7]), states[:, :3])
