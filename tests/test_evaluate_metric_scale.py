"""The metre from the accelerometer: a known scale is found again, what cannot be known is refused with the reason."""

from __future__ import annotations

import numpy as np
import pytest

from dvsviz.errors import EvaluationError
from dvsviz.evaluate.metric_scale import MetricScale, metric_scale
from dvsviz.events.recording import Imu
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.simulate.inertial import ImuModel, simulate_imu
from dvsviz.simulate.motion import Motion, handheld, shake, slider

METRES = 1.7


def poses(motion: Motion, seconds: float, noise: float, seed: int = 1) -> Trajectory:
    """A trajectory in units of 1.7 m, in a world of its own, every 25 to 35 ms."""
    rng = np.random.default_rng(seed)
    t_us = np.cumsum(rng.integers(25_000, 35_000, int(seconds * 30))).astype(np.int64)
    t_us = t_us[t_us < seconds * 1e6]
    Ts = motion(t_us * 1e-6).copy()
    Ts[:, :3, 3] = Ts[:, :3, 3] / METRES + noise * rng.standard_normal((len(t_us), 3))
    Ts[:, :3, :3] = Ts[:, :3, :3] @ se3.exp_so3(noise * rng.standard_normal((len(t_us), 3)))
    world = se3.pose(se3.exp_so3([0.3, -0.7, 0.4]), [1.0, 2.0, 3.0])
    return Trajectory(t_us=t_us, Ts_world_camera=world @ Ts)


def measured(motion: Motion, seconds: float) -> Imu:
    model = ImuModel(lever_arm=(0.02, -0.01, 0.03))
    return simulate_imu(model, motion, seconds, np.random.default_rng(5))


def found(motion: Motion, seconds: float = 20.0, noise: float = 0.0) -> MetricScale:
    return metric_scale(poses(motion, seconds, noise), measured(motion, seconds))


@pytest.mark.parametrize(("noise", "within"), [(0.0, 0.002), (0.002, 0.02)])
def test_a_known_scale_is_found_again(noise: float, within: float) -> None:
    hand = handheld(np.random.default_rng(1), 20.0)
    scale = found(hand, noise=noise)
    assert scale.metres_per_unit == pytest.approx(METRES, rel=within)
    assert abs(scale.metres_per_unit / METRES - 1) < 3 * scale.deviation
    assert np.linalg.norm(scale.gravity_world) == pytest.approx(9.81, abs=0.1)


def test_a_fast_motion_tells_it_through_noisy_poses() -> None:
    scale = found(shake(np.random.default_rng(2), 20.0), noise=0.01)
    assert scale.metres_per_unit == pytest.approx(METRES, rel=0.03)
    assert scale.deviation < 0.03


def test_gaps_in_the_poses_are_left_out() -> None:
    motion = shake(np.random.default_rng(3), 20.0)
    whole = poses(motion, 20.0, 0.001)
    keep = (whole.t_us < 6_000_000) | (whole.t_us > 9_000_000)
    # A tracker that was lost may come back to a wrong place; nothing may be concluded across the gap.
    part = Trajectory(t_us=whole.t_us[keep], Ts_world_camera=whole.Ts_world_camera[keep])
    scale = metric_scale(part, measured(motion, 20.0))
    assert scale.metres_per_unit == pytest.approx(METRES, rel=0.02)
    assert scale.seconds < 17.0


def test_axes_that_are_not_the_cameras_are_refused() -> None:
    motion = shake(np.random.default_rng(3), 20.0)
    imu = measured(motion, 20.0)
    turned = Imu(t_us=imu.t_us, gyro=imu.gyro, accel=imu.accel[:, [1, 2, 0]])
    with pytest.raises(EvaluationError, match=r"explain .* of the way's bends"):
        metric_scale(poses(motion, 20.0, 0.0), turned)


def test_an_even_motion_tells_nothing() -> None:
    motion = slider(speed=0.1)
    with pytest.raises(EvaluationError, match=r"explain|known to|hardly accelerated"):
        metric_scale(poses(motion, 10.0, 0.001), measured(motion, 10.0))


@pytest.mark.parametrize("which", ["none measured", "another clock", "two poses"])
def test_what_is_missing_is_said(which: str) -> None:
    motion = handheld(np.random.default_rng(1), 5.0)
    trajectory, imu = poses(motion, 5.0, 0.0), measured(motion, 5.0)
    if which == "none measured":
        imu = Imu(t_us=imu.t_us, gyro=imu.gyro, accel=np.full_like(imu.accel, np.nan))
    elif which == "another clock":
        imu = Imu(t_us=imu.t_us + 1_000_000_000, gyro=imu.gyro, accel=imu.accel)
    else:
        trajectory = Trajectory(t_us=trajectory.t_us[:2], Ts_world_camera=trajectory.Ts_world_camera[:2])
    with pytest.raises(EvaluationError, match="accelerations"):
        metric_scale(trajectory, imu)


def test_a_clock_that_jumps_by_years_costs_nothing() -> None:
    motion = shake(np.random.default_rng(3), 20.0)
    whole, later = poses(motion, 20.0, 0.0), 3 * 365 * 86_400_000_000
    t_us = whole.t_us + np.where(np.arange(len(whole)) < 400, 0, later)
    scale = metric_scale(Trajectory(t_us=t_us, Ts_world_camera=whole.Ts_world_camera), measured(motion, 20.0))
    assert scale.metres_per_unit == pytest.approx(METRES, rel=0.02)
    assert scale.seconds < 14.0


def test_single_absurd_samples_are_left_out_and_a_whole_stream_of_them_is_refused() -> None:
    motion = shake(np.random.default_rng(3), 20.0)
    trajectory, imu = poses(motion, 20.0, 0.0), measured(motion, 20.0)
    accel = imu.accel.copy()
    accel[5000] = 1e300
    scale = metric_scale(trajectory, Imu(t_us=imu.t_us, gyro=imu.gyro, accel=accel))
    assert scale.metres_per_unit == pytest.approx(METRES, rel=0.01)
    with pytest.raises(EvaluationError, match="no accelerations"):
        metric_scale(trajectory, Imu(t_us=imu.t_us, gyro=imu.gyro, accel=1e300 * imu.accel))


def test_a_camera_that_stood_still_or_flew_beyond_measure_tells_nothing() -> None:
    motion = shake(np.random.default_rng(3), 20.0)
    trajectory, imu = poses(motion, 20.0, 0.0), measured(motion, 20.0)
    for factor, match in ((0.0, "hardly accelerated"), (1e200, "beyond measure")):
        Ts = trajectory.Ts_world_camera.copy()
        Ts[:, :3, 3] *= factor
        with pytest.raises(EvaluationError, match=match):
            metric_scale(Trajectory(t_us=trajectory.t_us, Ts_world_camera=Ts), imu)
