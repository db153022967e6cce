"""Kabsch: exact on exact points, never a reflection, refuses what does not determine a motion; RANSAC."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvsviz.geometry import se3
from dvsviz.registration.kabsch import kabsch, kabsch_inliers, rounds_needed
from dvsviz.registration.records import RegistrationConfig, RegistrationError


def cloud(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in a, the same in b, and the true T_a_b."""
    rng = np.random.default_rng(seed)
    T = se3.pose(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    b = rng.normal(size=(count, 3)) + np.array([0, 0, 3])
    a = b @ T[:3, :3].T + T[:3, 3]
    for array in (a, b):
        array.setflags(write=False)
    return a, b, T


@given(st.integers(0, 10_000), st.integers(4, 200))
def test_noise_free_points_give_the_motion_to_1e_12(seed: int, count: int) -> None:
    a, b, T = cloud(seed, count)
    if np.linalg.svd(b - b.mean(0), compute_uv=False)[1] > 0.3:
        np.testing.assert_allclose(kabsch(a, b), T, atol=1e-12)


def test_three_points_and_planar_points_are_enough() -> None:
    rng = np.random.default_rng(0)
    T = se3.pose(se3.exp_so3([0.3, -2.0, 0.5]), [1.0, 2.0, 3.0])
    for b in (
        np.array([[0, 0, 1], [1, 0, 1], [0, 1, 2.0]]),
        np.column_stack([rng.normal(size=(50, 2)), np.ones(50)]),
    ):
        np.testing.assert_allclose(kabsch(b @ T[:3, :3].T + T[:3, 3], b), T, atol=1e-12)


def test_mirrored_points_get_the_best_rotation_not_a_reflection() -> None:
    rng = np.random.default_rng(1)
    b = rng.normal(size=(30, 3)) * [3.0, 2.0, 0.5]
    b -= b.mean(0)
    T = kabsch(b * [1.0, 1.0, -1.0], b)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    cost = np.sum((b @ T[:3, :3].T + T[:3, 3] - b * [1.0, 1.0, -1.0]) ** 2)
    for _ in range(200):
        R = se3.exp_so3(rng.normal(size=3) * 0.3) @ T[:3, :3]
        assert np.sum((b @ R.T - b * [1.0, 1.0, -1.0]) ** 2) >= cost - 1e-9


def test_weights_equal_repetition() -> None:
    a, b, _ = cloud(3, 12)
    a = a + np.random.default_rng(0).normal(size=a.shape) * 0.05
    counts = np.arange(12) % 3
    np.testing.assert_allclose(
        kabsch(a, b, counts.astype(float)), kabsch(np.repeat(a, counts, 0), np.repeat(b, counts, 0)), atol=1e-12
    )


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((0, 3)), "at least 3 points"),
        (np.eye(3)[:2], "at least 3 points"),
        (np.outer(np.arange(6.0), [1.0, 2.0, -1.0]) + 5, "one line"),
        (np.ones((5, 3)), "one line"),
    ],
)
def test_degenerate_points_are_refused_with_the_reason(points: np.ndarray, reason: str) -> None:
    with pytest.raises(RegistrationError, match=reason):
        kabsch(points, points)


def test_two_equally_good_rotations_are_refused() -> None:
    b = np.vstack([np.eye(3), -np.eye(3)])
    with pytest.raises(RegistrationError, match="equally well"):
        kabsch(-b, b)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="the same"):
        kabsch(np.zeros((4, 3)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match="finite"):
        kabsch(np.full((4, 3), np.nan), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="weights"):
        kabsch(np.eye(3), np.eye(3), -np.ones(3))


def test_ransac_finds_the_inliers_among_many_outliers() -> None:
    a, b, T = cloud(5, 100)
    rng = np.random.default_rng(6)
    a = a.copy()
    a[:60] += rng.normal(size=(60, 3))
    found = kabsch_inliers(a, b, np.full(100, 0.02), RegistrationConfig(), rng)
    assert found[60:].all()
    assert found[:60].sum() <= 2
    np.testing.assert_allclose(kabsch(a[60:], b[60:]), T, atol=1e-12)
    with pytest.raises(RegistrationError, match="depth in both frames, got 2"):
        kabsch_inliers(a[:2], b[:2], np.ones(2), RegistrationConfig(), rng)


def test_rounds_needed() -> None:
    # log(0.001) / log(1 - 0.5^3) = 51.7
    assert rounds_needed(0.5, 3, 0.999) == 52
    assert rounds_needed(1.0, 3, 0.999) == 1
    assert rounds_needed(0.0, 3, 0.999) > 10**9
