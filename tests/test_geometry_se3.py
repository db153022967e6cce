"""Rotations and rigid motions: group axioms over batch shapes, dtypes and angles from 1e-9 to pi."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from dvsviz.geometry import se3

BATCHES = [(), (1,), (4,), (2, 3), (0,)]
ANGLES = [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 9.9e-5, 1.01e-4, 1e-3, 0.0499, 0.0501, 0.3, 1.0, 2.0, 3.0, np.pi - 1e-6]
UNIX_US = 1_700_000_000_000_000


def rotation_vectors(
    rng: np.random.Generator, batch: tuple[int, ...], angle: float, dtype: type = np.float64
) -> np.ndarray:
    axis = rng.normal(size=(*batch, 3))
    phi = (axis / np.linalg.norm(axis, axis=-1, keepdims=True) * angle).astype(dtype)
    phi.setflags(write=False)
    return phi


def random_poses(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    T = se3.pose(se3.exp_so3(rng.normal(size=(*batch, 3))), rng.normal(size=(*batch, 3)) * 10)
    T.setflags(write=False)
    return T


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_gives_rotations_and_log_returns(batch: tuple[int, ...], dtype: type, angle: float) -> None:
    phi = rotation_vectors(np.random.default_rng(1), batch, angle, dtype)
    R = se3.exp_so3(phi)
    assert R.shape == (*batch, 3, 3)
    assert R.dtype == np.float64
    np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), np.ones(batch), atol=1e-14)
    # float32 input is taken as it is: its own rounding is not part of the round trip.
    np.testing.assert_allclose(se3.log_so3(R), phi.astype(np.float64), rtol=1e-9, atol=4e-16)
    np.testing.assert_allclose(
        se3.rotation_angle(R), np.linalg.norm(phi.astype(np.float64), axis=-1), rtol=1e-9, atol=4e-16
    )


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_equals_the_matrix_exponential(angle: float) -> None:
    phi = rotation_vectors(np.random.default_rng(2), (), angle)
    np.testing.assert_allclose(se3.exp_so3(phi), expm(se3.hat(phi)), atol=3e-15)


def test_log_of_half_turns_has_the_right_axis_up_to_sign() -> None:
    for axis in np.vstack([np.eye(3), np.ones((1, 3)) / np.sqrt(3), [[0.6, 0.0, -0.8]]]):
        half_turn = 2 * np.outer(axis, axis) - np.eye(3)
        phi = se3.log_so3(half_turn)
        assert np.linalg.norm(phi) == pytest.approx(np.pi, abs=1e-12)
        np.testing.assert_allclose(np.cross(phi, axis), 0, atol=1e-7)


def test_hat_is_the_cross_product() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(5, 2, 3)), rng.normal(size=(5, 2, 3))
    np.testing.assert_allclose((se3.hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize("batch", BATCHES)
def test_group_axioms(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    A, B, C = (random_poses(rng, batch) for _ in range(3))
    identity = np.broadcast_to(np.eye(4), A.shape)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    np.testing.assert_allclose(A @ se3.inverse(A), identity, atol=1e-12)
    np.testing.assert_allclose(se3.inverse(A) @ A, identity, atol=1e-12)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(se3.inverse(A)), A, atol=1e-12)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.sampled_from([1e-9, 1e-6, 1e-3, 1.0]))
def test_rotations_compose_like_their_matrices(values: list[float], scale: float) -> None:
    a, b = np.array(values[:3]) * scale, np.array(values[3:])
    R = se3.exp_so3(a) @ se3.exp_so3(b)
    np.testing.assert_allclose(se3.exp_so3(se3.log_so3(R)), R, atol=1e-13)
    np.testing.assert_allclose(se3.exp_so3(-a), se3.exp_so3(a).T, atol=1e-15)


@pytest.mark.parametrize("angle", [1e-9, 1e-5, 9.9e-5, 1.01e-4, 1e-2, 0.0499, 0.0501, 0.7, 2.5, 3.1])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_left_jacobian_against_central_differences(angle: float, batch: tuple[int, ...]) -> None:
    phi = rotation_vectors(np.random.default_rng(5), batch, angle)
    J = se3.left_jacobian_so3(phi)
    h = 1e-5
    back = np.swapaxes(se3.exp_so3(phi), -1, -2)
    for i in range(3):
        d = np.zeros(3)
        d[i] = h
        ahead = se3.log_so3(se3.exp_so3(phi + d) @ back)
        behind = se3.log_so3(se3.exp_so3(phi - d) @ back)
        np.testing.assert_allclose(J[..., i], (ahead - behind) / (2 * h), atol=2e-10)


def test_first_order_jacobian_would_fail_the_check_above() -> None:
    """The check has teeth: the identity in the place of J_l is off by half the angle."""
    phi = np.array([0.0, 0.0, 0.2])
    assert np.abs(se3.left_jacobian_so3(phi) - np.eye(3)).max() > 0.09


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES)
def test_quaternion_round_trip(batch: tuple[int, ...], angle: float) -> None:
    R = se3.exp_so3(rotation_vectors(np.random.default_rng(6), batch, angle))
    q = se3.quaternion_from_rotation(R)
    assert q.shape == (*batch, 4)
    assert np.all(q[..., 0] >= 0)
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), np.ones(batch), atol=1e-14)
    np.testing.assert_allclose(se3.rotation_from_quaternion(q), R, atol=1e-14)
    np.testing.assert_allclose(se3.rotation_from_quaternion(-3.0 * q), R, atol=1e-14)
    np.testing.assert_array_equal(se3.wxyz_from_xyzw(se3.xyzw_from_wxyz(q)), q)


def test_quaternion_order_is_wxyz() -> None:
    quarter_turn_about_z = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    R = se3.rotation_from_quaternion(quarter_turn_about_z)
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(se3.quaternion_from_rotation(R), quarter_turn_about_z, atol=1e-15)
    np.testing.assert_array_equal(se3.xyzw_from_wxyz([1.0, 2.0, 3.0, 4.0]), [2.0, 3.0, 4.0, 1.0])


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]])
def test_impossible_quaternions_are_refused(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="q_wxyz: expected finite, non-zero"):
        se3.rotation_from_quaternion([[1, 0, 0, 0], bad])


def test_pose_moves_points_from_camera_to_world() -> None:
    T_world_camera = se3.pose(se3.exp_so3([0, 0, np.pi / 2]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(T_world_camera @ [1.0, 0.0, 5.0, 1.0], [1.0, 3.0, 8.0, 1.0], atol=1e-15)
    np.testing.assert_array_equal(se3.pose(), np.eye(4))
    assert se3.pose(np.eye(3), np.zeros((7, 3))).shape == (7, 4, 4)


def test_propagate_follows_the_slow_sum_of_small_steps() -> None:
    """Decoupled motion: the rotation turns about the body's axes, the position moves on a straight line."""
    T = random_poses(np.random.default_rng(7), ())
    omega, velocity = np.array([0.4, -0.9, 0.3]), np.array([0.2, 0.1, -0.5])
    R = T[:3, :3]
    steps = 1000
    for _ in range(steps):
        R = R @ se3.exp_so3(omega * 0.8 / steps)
    after = se3.propagate(T, omega, velocity, 0.8)
    np.testing.assert_allclose(after[:3, :3], R, atol=1e-12)
    np.testing.assert_allclose(after[:3, 3], T[:3, 3] + 0.8 * T[:3, :3] @ velocity, atol=1e-14)
    np.testing.assert_allclose(se3.propagate(T, omega, velocity, 0.0), T, atol=1e-15)


@pytest.mark.parametrize("start_us", [0, -5_000_000, UNIX_US])
def test_interpolation_keeps_a_microsecond_at_any_clock(start_us: int) -> None:
    t = start_us + np.array([0, 1_000_000, 3_000_000])
    turns = np.array([[0, 0, 0], [0, 0, 0.5], [0, 0, 1.5]])
    Ts = se3.pose(se3.exp_so3(turns), np.array([[0, 0, 0], [1, 0, 0], [3, 2, 0.0]]))
    for array in (t, Ts):
        array.setflags(write=False)
    at = start_us + np.array([0, 1, 250_000, 1_000_000, 2_000_000, 2_999_999, 3_000_000])
    s = (at - start_us) * 1e-6
    out = se3.interpolate(t, Ts, at)
    np.testing.assert_allclose(out[:, 0, 3], s, atol=1e-12)
    np.testing.assert_allclose(out[:, 1, 3], np.maximum(0, s - 1), atol=1e-12)
    np.testing.assert_allclose(se3.log_so3(out[:, :3, :3])[:, 2], s * 0.5, atol=1e-12)


def test_interpolation_takes_the_short_way_and_returns_the_nodes() -> None:
    rng = np.random.default_rng(8)
    Ts = se3.pose(se3.exp_so3(rng.normal(size=(6, 3))), rng.normal(size=(6, 3)))
    t = np.array([0, 10, 11, 500, 1000, 99_999])
    np.testing.assert_allclose(se3.interpolate(t, Ts, t), Ts, atol=1e-13)
    half = se3.interpolate([0, 2], se3.pose(se3.exp_so3([[0, 0, 3.0], [0, 0, -3.0]])), [1])[0]
    assert se3.rotation_angle(half[:3, :3]) == pytest.approx(np.pi, abs=1e-9)


def test_interpolation_outside_is_refused_and_one_pose_is_enough() -> None:
    T = se3.pose(position=[1.0, 2.0, 3.0])
    np.testing.assert_array_equal(se3.interpolate([5], T[None], [5, 5]), np.stack([T, T]))
    assert se3.interpolate([5], T[None], []).shape == (0, 4, 4)
    for at in (4, 6):
        with pytest.raises(ValueError, match=r"at_us: expected times in \[5, 5\]"):
            se3.interpolate([5], T[None], [at])
