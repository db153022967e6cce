"""The motion filter: what a window does not know does not go into the velocity."""

from __future__ import annotations

import numpy as np
import pytest

from dvsviz.tracking import constants as c
from dvsviz.tracking.prediction import MotionFilter, difference

DT = 0.03


def _run(weak: float, seconds: float, seed: int, *, gain: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Errors of position (N, 6) and velocity (N, 6) of a camera that stands still, seen with noise.

    Five directions are seen to 0.3 mrad, the sixth to `weak`; the noise is what the filter takes it for.
    """
    rng = np.random.default_rng(seed)
    sigma = np.array([3e-4] * 5 + [weak])
    information = np.diag(c.FILTER_CORRELATED / sigma**2)
    motion = MotionFilter()
    pose, speed, poses, speeds = np.zeros(6), np.zeros(6), [], []
    for _ in range(round(seconds / DT)):
        predicted = pose + DT * speed
        prior = motion.predict(DT)
        measured = rng.normal(scale=sigma)
        aligned = np.linalg.solve(prior + np.diag(sigma**-2), prior @ predicted + measured / sigma**2)
        change = motion.correct(aligned - predicted, information, DT)
        speed = speed + change if gain is None else speed + gain * ((aligned - pose) / DT - speed)
        pose = aligned
        poses.append(pose)
        speeds.append(speed)
    return np.array(poses), np.array(speeds)


def test_a_direction_that_is_hardly_seen_is_not_carried_away() -> None:
    poses, speeds = _run(0.02, 30.0, seed=3)
    # A fixed gain believes the noise of each window: its velocity walks, and the pose with it.
    by_gain, speeds_by_gain = _run(0.02, 30.0, seed=3, gain=0.6)
    assert np.sqrt(np.mean(poses[100:, 5] ** 2)) < 0.9 * np.sqrt(np.mean(by_gain[100:, 5] ** 2))
    assert np.sqrt(np.mean(speeds[100:, 5] ** 2)) < 0.5 * np.sqrt(np.mean(speeds_by_gain[100:, 5] ** 2))
    assert np.sqrt(np.mean(poses[100:, 5] ** 2)) < 0.7 * 0.02
    assert np.sqrt(np.mean(poses[100:, :5] ** 2)) < 5e-4


def test_the_density_rises_with_the_motion_and_falls_with_it() -> None:
    motion = MotionFilter()
    information = np.diag(np.full(6, c.FILTER_CORRELATED / 3e-4**2))

    def step(size: float) -> None:
        prior = motion.predict(DT)
        after = np.linalg.inv(prior + information / c.FILTER_CORRELATED)
        # A jump of the pose as the window shows it, damped by the prediction.
        moved = after @ (information / c.FILTER_CORRELATED) @ np.full(6, size)
        motion.correct(moved, information, DT)

    for k in range(200):
        step(0.02 if k % 2 else -0.02)
    shaken = motion.density.copy()
    for _ in range(600):
        step(0.0)
    assert np.all(shaken > 10 * c.FILTER_DENSITY_START)
    assert motion.density == pytest.approx(c.FILTER_DENSITY[0])


def test_the_covariance_stays_one() -> None:
    rng = np.random.default_rng(0)
    motion = MotionFilter()
    for _ in range(500):
        A = rng.normal(size=(6, 3))
        motion.predict(float(rng.uniform(1e-6, 0.1)))
        motion.correct(rng.normal(scale=0.01, size=6), 1e5 * A @ A.T, DT)
        assert motion.covariance == pytest.approx(motion.covariance.T)
        assert np.linalg.eigvalsh(motion.covariance).min() > 0


def test_what_a_window_says_nothing_about_stays() -> None:
    motion = MotionFilter()
    motion.predict(DT)
    before = motion.covariance.copy()
    assert motion.correct(np.zeros(6), np.zeros((6, 6)), DT) == pytest.approx(np.zeros(6))
    assert motion.covariance == pytest.approx(before)


def test_the_difference_of_poses_is_in_the_camera_frame() -> None:
    turned = np.eye(4)
    turned[:3, :3] = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = turned.copy()
    moved[:3, 3] = [0.0, 0.1, 0.0]
    assert difference(turned, moved) == pytest.approx([0, 0, 0, 0.1, 0, 0])


def test_what_the_model_holds_is_never_moved() -> None:
    rng = np.random.default_rng(1)
    free = np.array([True] * 3 + [False] * 3)
    motion, alone = MotionFilter(free=free), MotionFilter(free=free)
    for _ in range(100):
        A = rng.normal(size=(6, 6))
        information = 1e5 * A @ A.T
        turned = np.concatenate([rng.normal(scale=0.01, size=3), np.zeros(3)])
        motion.predict(DT)
        alone.predict(DT)
        change = motion.correct(turned, information, DT)
        # How a movement would have looked does not matter where there is none.
        information[3:], information[:, 3:] = 0.0, 0.0
        assert change == pytest.approx(alone.correct(turned, information, DT))
        assert change[3:] == pytest.approx(np.zeros(3), abs=1e-9)
