"""Trajectories: splines go through their poses, flights fly what was planned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvsviz.errors import FormatError
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import write_tum
from dvsviz.simulate.flights import FLIGHTS, camera_mount, circle_plan, flight, fly_plan, legs_plan
from dvsviz.simulate.inertial import rates
from dvsviz.simulate.spline import SplineMotion, tum_motion


def sampled(seconds: float = 4.0, hz: float = 50.0, start_us: int = 1_700_000_000_000_000) -> Trajectory:
    t = np.arange(round(seconds * hz) + 1) / hz
    p = np.stack([np.sin(t), np.cos(2 * t), 0.3 * t], axis=1)
    R = se3.exp_so3(np.stack([0.3 * np.sin(t), 0.5 * t, 0.2 * np.cos(t)], axis=1))
    return Trajectory(t_us=start_us + np.round(t * 1e6).astype(np.int64), Ts_world_camera=se3.pose(R, p))


def test_spline_goes_through_its_poses_and_between_them() -> None:
    known = sampled()
    motion = SplineMotion(known)
    assert motion.seconds == 4.0
    t = (known.t_us - known.t_us[0]) * 1e-6
    assert np.allclose(motion(t), known.Ts_world_camera, atol=1e-9)
    between = np.array([0.511, 2.003])
    p = np.stack([np.sin(between), np.cos(2 * between), 0.3 * between], axis=1)
    assert np.allclose(motion(between)[:, :3, 3], p, atol=1e-6)
    # Twice differentiable: what an inertial sensor feels is right too.
    _, accel = rates(motion, between)
    assert np.allclose(accel[:, 0], -np.sin(between), atol=2e-3)
    gyro, _ = rates(motion, between)
    R = motion(between)[:, :3, :3]
    later = motion(between + 1e-4)[:, :3, :3]
    assert np.allclose(gyro, se3.log_so3(np.swapaxes(R, 1, 2) @ later) / 1e-4, atol=1e-3)


def test_tum_file_as_a_motion(tmp_path: Path) -> None:
    known = sampled()
    write_tum(tmp_path / "a.tum", known)
    own = tum_motion(tmp_path / "a.tum", relative=False)
    assert np.allclose(own(np.array([1.0])), known.Ts_world_camera[50], atol=1e-6)
    seen = tum_motion(tmp_path / "a.tum")
    assert np.allclose(seen(np.zeros(1))[0], np.eye(4), atol=1e-8)
    assert np.allclose(known.Ts_world_camera[0] @ seen(np.array([1.0]))[0], known.Ts_world_camera[50], atol=1e-6)
    write_tum(tmp_path / "b.tum", Trajectory(t_us=known.t_us[:1], Ts_world_camera=known.Ts_world_camera[:1]))
    with pytest.raises(FormatError, match="fewer than two poses"):
        tum_motion(tmp_path / "b.tum")


def test_circle_is_flown_inwards_at_its_height() -> None:
    motion = flight("circle")
    assert motion.seconds == pytest.approx(80.0)
    t = np.linspace(10, 80, 500)
    Ts = motion(t) @ se3.inverse(camera_mount())
    radius = np.hypot(Ts[:, 0, 3], Ts[:, 1, 3])
    # A lag of 1 s behind a target that turns at 2 pi / 40 rad/s: r / sqrt(1 + (w / k)²), and the inner loop's lag.
    assert radius == pytest.approx(1 / np.sqrt(1 + (2 * np.pi / 40) ** 2), abs=0.01)
    assert Ts[:, 2, 3] == pytest.approx(1.5, abs=2e-3)
    ahead = Ts[:, :2, 0]
    # Position lags by 9 degrees behind the yaw.
    inwards = -np.sum(ahead * Ts[:, :2, 3], axis=1) / radius
    assert inwards.min() > np.cos(np.radians(12))
    # The camera looks 45 degrees down.
    assert motion(t)[:, 2, 2] == pytest.approx(-np.sqrt(0.5), abs=0.02)
    path = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(2 * np.pi * 0.988 * 70 / 40, rel=0.01)


@pytest.mark.parametrize(("name", "corners"), [("rectangle", (1.0, 0.5)), ("lawnmower", (1.0, 0.5))])
def test_legs_are_flown_within_their_bounds(name: str, corners: tuple[float, float]) -> None:
    motion = flight(name, np.random.default_rng(1))
    p = (motion(np.arange(0, motion.seconds, 0.05)) @ se3.inverse(camera_mount()))[:, :3, 3]
    assert np.abs(p[:, 0]).max() == pytest.approx(corners[0], abs=0.15)
    assert np.abs(p[:, 1]).max() == pytest.approx(corners[1], abs=0.15)
    assert np.abs(p[:, 2] - 1.5).max() < 0.15
    # The flights of the study last 150 and 195 s.
    assert motion.seconds == pytest.approx({"rectangle": 150, "lawnmower": 195}[name], rel=0.06)


def test_rectangle_looks_across_its_motion_and_lawnmower_ahead() -> None:
    for name, wanted in (("rectangle", 0.0), ("lawnmower", 1.0)):
        motion = flight(name)
        t = np.arange(5.0, motion.seconds - 5.0, 0.5)
        Ts = motion(t) @ se3.inverse(camera_mount())
        v = (motion(t + 0.01) - motion(t - 0.01))[:, :2, 3] / 0.02
        moving = np.linalg.norm(v, axis=1) > 0.095
        straight = np.linalg.norm(rates(motion, t)[0], axis=1) < 0.01
        along = np.sum(Ts[:, :2, 0] * v, axis=1)[moving & straight] / 0.1
        assert np.median(along) == pytest.approx(wanted, abs=0.05)


def test_turns_are_made_in_place() -> None:
    p, yaw = legs_plan([(0, 0), (1, 0), (1, 1)], [0.0, np.pi / 2], speed=0.5, turn_s=2.0)
    assert len(yaw) == 200 * (2 + 2 + 2)
    turning = np.diff(yaw, prepend=0.0) != 0
    assert np.all(p[turning, :2] == [1, 0])
    assert yaw[-1] == np.pi / 2


def test_wind_is_felt_and_comes_from_the_generator() -> None:
    plan = circle_plan(turn_s=20.0, turns=0.25)
    still, windy = fly_plan(*plan), fly_plan(*plan, np.random.default_rng(4))
    again = fly_plan(*plan, np.random.default_rng(4))
    t = np.linspace(0, 5, 40)
    apart = np.linalg.norm(still(t)[:, :3, 3] - windy(t)[:, :3, 3], axis=1).max()
    assert 0.002 < apart < 0.3
    assert np.array_equal(windy(t), again(t))
    with pytest.raises(ValueError, match=", ".join(FLIGHTS)):
        flight("loop")
