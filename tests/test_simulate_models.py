"""Motion models against closed forms: arcs, screws, free fall, hover, gyroscopic turning."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from dvsviz.geometry import se3
from dvsviz.simulate.models import drive, kinematics, quadrotor
from dvsviz.simulate.models.quadrotor import GRAVITY, Quadrotor, quadrotor_state

RNG = np.random.default_rng(7)
FLYER = Quadrotor()


def twist_matrix(zeta: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.hat(zeta[3:]), zeta[:3]
    return out


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.7, 3.0])
def test_pose_step_is_the_matrix_exponential(size: float) -> None:
    zeta = size * RNG.standard_normal((5, 6))
    T = kinematics.exp_se3(RNG.standard_normal((5, 6)))
    got = kinematics.pose_step(T, zeta, np.full(5, 0.8))
    for k in range(5):
        assert np.allclose(got[k], T[k] @ expm(0.8 * twist_matrix(zeta[k])), atol=1e-12)


def test_a_full_turn_of_a_screw_returns_to_its_axis() -> None:
    # Radius v / omega = 0.5 m, climbing 0.1 m a turn.
    zeta = np.array([0.5, 0, 0.1 / (2 * np.pi), 0, 0, 1.0])
    assert np.allclose(kinematics.pose_step(np.eye(4), zeta, 2 * np.pi)[:3, 3], [0, 0, 0.1])
    assert np.allclose(kinematics.pose_step(np.eye(4), zeta, np.pi)[:3, 3], [0, 1.0, 0.05])


def test_euler_step_errs_as_it_says_and_stays_a_pose() -> None:
    zeta = np.array([1.0, 0, 0, 0, 0, 1.0])
    for tau in (0.1, 0.01):
        exact, euler = kinematics.pose_step(np.eye(4), zeta, tau), kinematics.pose_step_euler(np.eye(4), zeta, tau)
        assert np.linalg.norm((exact - euler)[:3, 3]) == pytest.approx(tau**2 / 2, rel=0.02)
        assert np.allclose(exact[:3, :3], euler[:3, :3])
    assert np.allclose(kinematics.rotation_step(np.eye(3), zeta[3:], 0.3), se3.exp_so3([0, 0, 0.3]))


def test_quaternion_steps() -> None:
    q = se3.quaternion_from_rotation(se3.exp_so3(RNG.standard_normal((6, 3))))
    omega = RNG.standard_normal((6, 3))
    tau = np.linspace(0, 1.5, 6)
    moved = kinematics.quaternion_step(q, omega, tau)
    R = se3.rotation_from_quaternion(q) @ se3.exp_so3(tau[:, None] * omega)
    assert np.allclose(se3.rotation_from_quaternion(moved), R, atol=1e-12)
    assert np.allclose(np.linalg.norm(moved, axis=1), 1)
    euler = kinematics.quaternion_step_euler(q, omega, tau)
    angle = se3.rotation_angle(
        np.swapaxes(se3.rotation_from_quaternion(q), 1, 2) @ se3.rotation_from_quaternion(euler)
    )
    assert np.allclose(angle, 2 * np.arctan(np.linalg.norm(omega, axis=1) * tau / 2))
    i, j, k = np.eye(4)[1:]
    assert np.array_equal(kinematics.quaternion_product(i, j), k)
    assert np.array_equal(kinematics.quaternion_product(j, i), -k)


def test_odometry_chains_what_was_measured() -> None:
    Ts = kinematics.exp_se3(RNG.standard_normal((7, 6)))
    steps = se3.inverse(Ts[:-1]) @ Ts[1:]
    assert np.allclose(kinematics.odometry(Ts[0], steps), Ts, atol=1e-12)
    assert np.allclose(kinematics.odometry_step(Ts[:-1], steps), Ts[1:], atol=1e-12)


def test_differential_drive_runs_along_its_circle() -> None:
    # Radius 2 m: a quarter turn leads to (2, 2), a half to (0, 4), a whole back.
    for share, wanted in ((0.25, [2, 2, np.pi / 2]), (0.5, [0, 4, np.pi]), (1.0, [0, 0, 0])):
        got = drive.differential_drive_exact(np.zeros(3), 1.0, 0.5, share * 4 * np.pi)
        assert np.allclose(got, wanted, atol=1e-12)
    assert np.allclose(
        drive.differential_drive_exact([1, 2, 0.3], 2.0, 0.0, 1.5), [1 + 3 * np.cos(0.3), 2 + 3 * np.sin(0.3), 0.3]
    )
    states = RNG.standard_normal((4, 3))
    v, omega = RNG.standard_normal(4), RNG.standard_normal(4)
    got = drive.differential_drive_exact(states, v, omega, 0.9)
    for k in range(4):
        c, s = np.cos(states[k, 2]), np.sin(states[k, 2])
        T = np.array([[c, -s, states[k, 0]], [s, c, states[k, 1]], [0, 0, 1]])
        M = T @ expm(0.9 * np.array([[0, -omega[k], v[k]], [omega[k], 0, 0], [0, 0, 0]]))
        assert np.allclose(got[k], [M[0, 2], M[1, 2], np.arctan2(M[1, 0], M[0, 0])])


def test_many_euler_steps_come_to_the_exact_state() -> None:
    def distance(steps: int) -> float:
        state = np.zeros(3)
        for _ in range(steps):
            state = drive.differential_drive_euler(state, 1.0, 0.5, 2.0 / steps)
        return float(np.linalg.norm(state - drive.differential_drive_exact(np.zeros(3), 1.0, 0.5, 2.0)))

    assert np.array_equal(drive.differential_drive_euler(np.zeros(3), 1.0, 0.5, 2.0), [2.0, 0.0, 1.0])
    # First order: half the step, half the error.
    assert distance(200) == pytest.approx(2 * distance(400), rel=0.02)


def test_wheels_and_steering() -> None:
    v, omega = drive.body_velocity(0.8, 1.2, axle=0.5)
    assert (v, omega) == pytest.approx((1.0, 0.8))
    assert drive.wheel_velocities(v, omega, 0.5) == pytest.approx((0.8, 1.2))
    assert drive.ackermann_turn(2.0, np.pi / 4, 2.5) == pytest.approx(0.8)
    # Radius L / tan(phi) = 2.5 m.
    half = drive.ackermann_exact(np.zeros(3), 2.0, np.pi / 4, 2.5, np.pi / 0.8)
    assert np.allclose(half, [0, 5, np.pi])
    assert np.allclose(drive.ackermann_euler(np.zeros(3), 2.0, np.pi / 4, 2.5, 0.1), [0.2, 0, 0.08])
    with pytest.raises(ValueError, match="steering"):
        drive.ackermann_turn(1.0, np.pi / 2, 2.5)
    with pytest.raises(ValueError, match="axle"):
        drive.body_velocity(1.0, 1.0, 0.0)
    assert drive.wrap_angle([np.pi, -np.pi, 3 * np.pi, 0.1 - 2 * np.pi]) == pytest.approx(
        [np.pi, np.pi, np.pi, 0.1]
    )


def test_hover_needs_the_weight_and_stays() -> None:
    state = quadrotor_state(np.array([1.0, 2.0, 3.0]), 0.7)
    rate = quadrotor.quadrotor_rate(FLYER, state, FLYER.mass * GRAVITY, np.zeros(3))
    assert np.allclose(rate, 0, atol=1e-12)
    thrust, torque = quadrotor.velocity_control(FLYER, state, np.zeros(3), 0.7)
    assert thrust == pytest.approx(FLYER.mass * GRAVITY)
    assert np.allclose(torque, 0, atol=1e-12)


def test_free_fall_in_any_attitude() -> None:
    """Without thrust the path is the parabola, though the body tumbles about a main axis."""
    state = quadrotor_state(np.array([0.0, 0.0, 10.0]), 0.4)
    state[7:10], state[12] = [1.0, 2.0, 0.5], 3.0
    R = quadrotor.poses_of(state[None])[0, :3, :3]
    p, v = state[:3].copy(), R @ state[7:10]
    for _ in range(100):
        state = quadrotor.quadrotor_step(FLYER, state, 0.0, np.zeros(3), 0.01)
    assert np.allclose(state[:3], p + v - [0, 0, GRAVITY / 2], atol=1e-7)
    T = quadrotor.poses_of(state[None])[0]
    assert np.allclose(T[:3, :3], R @ se3.exp_so3([0, 0, 3.0]), atol=1e-7)


def test_free_tumbling_keeps_angular_momentum_and_energy() -> None:
    J = np.array(FLYER.inertia)
    state = quadrotor_state(np.zeros(3))
    state[10:13] = [1.0, 4.0, -2.0]

    def momentum(s: np.ndarray) -> np.ndarray:
        return quadrotor.poses_of(s[None])[0, :3, :3] @ (J * s[10:13])

    before, energy = momentum(state), J @ state[10:13] ** 2
    for _ in range(400):
        state = quadrotor.quadrotor_step(FLYER, state, 0.0, np.zeros(3), 0.005)
    assert np.allclose(momentum(state), before, rtol=1e-6)
    assert pytest.approx(energy, rel=1e-6) == J @ state[10:13] ** 2
    spin = quadrotor.quadrotor_rate(FLYER, quadrotor_state(np.zeros(3)), 0.0, np.array([0.0, 0.0, 0.022]))
    assert spin[12] == pytest.approx(1.0)


def test_runge_kutta_is_of_fourth_order() -> None:
    start = quadrotor_state(np.zeros(3))
    start[7:10], start[10:13] = [1.0, -0.5, 0.2], [2.0, 3.0, 1.0]

    def after(steps: int) -> np.ndarray:
        state = start
        for _ in range(steps):
            state = quadrotor.quadrotor_step(FLYER, state, 8.0, np.array([0.01, -0.02, 0.01]), 0.8 / steps)
        return state

    truth = after(640)
    errors = [float(np.linalg.norm(after(steps) - truth)) for steps in (20, 40)]
    assert 12 < errors[0] / errors[1] < 20


def test_controller_reaches_velocity_and_yaw() -> None:
    state = quadrotor_state(np.zeros(3))
    wanted = np.array([0.6, -0.3, 0.2])
    for _ in range(600):
        thrust, torque = quadrotor.velocity_control(FLYER, state, wanted, 1.0)
        state = quadrotor.quadrotor_step(FLYER, state, thrust, torque, 0.01)
    T = quadrotor.poses_of(state[None])[0]
    assert np.allclose(T[:3, :3] @ state[7:10], wanted, atol=1e-3)
    assert np.arctan2(T[1, 0], T[0, 0]) == pytest.approx(1.0, abs=1e-3)


def test_flight_lags_by_speed_over_gain() -> None:
    """Behind a target of constant speed, a proportional controller stays speed / gain behind."""
    t = np.arange(3000) * 0.01
    target = np.stack([0.1 * t, 0 * t, np.full(len(t), 1.5)], axis=1)
    states = quadrotor.fly(FLYER, target, np.zeros(len(t)), 0.01)
    assert states[-1, :3] == pytest.approx(target[-1] - [0.1, 0, 0], abs=2e-3)
    pushed = quadrotor.fly(FLYER, target, np.zeros(len(t)), 0.01, forces=np.tile([0.0, 0.36, 0.0], (3000, 1)))
    # A side wind of 0.3 m/s² is held where gain k_v x k_p times the distance equals it.
    assert pushed[-1, 1] == pytest.approx(0.1, abs=5e-3)
