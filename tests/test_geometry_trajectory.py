"""Trajectories: what they refuse, what they know about themselves, how they are read between poses."""

from __future__ import annotations

import numpy as np
import pytest

from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory

UNIX_US = 1_700_000_000_000_000


def square(start_us: int = 0) -> Trajectory:
    """Four corners of a square of side 2 m, a quarter turn at each."""
    t = start_us + np.arange(4, dtype=np.int64) * 1_000_000
    Ts = se3.pose(
        se3.exp_so3(np.outer(np.arange(4), [0, 0, np.pi / 2])),
        np.array([[0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1.0]]),
    )
    return Trajectory(t_us=t, Ts_world_camera=Ts)


def test_properties() -> None:
    path = square()
    assert len(path) == 4
    assert path.path_length == pytest.approx(6.0)
    np.testing.assert_allclose(path.positions[2], [2, 2, 1])
    assert path.rotations.shape == (4, 3, 3)
    np.testing.assert_allclose(path.quaternions_wxyz[1], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)


def test_quaternions_round_trip() -> None:
    path = square(UNIX_US)
    again = Trajectory.from_quaternions(path.t_us, path.positions, -2 * path.quaternions_wxyz)
    np.testing.assert_allclose(again.Ts_world_camera, path.Ts_world_camera, atol=1e-14)
    np.testing.assert_array_equal(again.t_us, path.t_us)
    assert again.t_us.dtype == np.int64


@pytest.mark.parametrize("start_us", [0, UNIX_US])
def test_reading_between_poses(start_us: int) -> None:
    path = square(start_us)
    middle = path.at(np.array([start_us + 500_000, start_us + 1_000_000]))
    np.testing.assert_allclose(middle.positions, [[1, 0, 1], [2, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(se3.log_so3(middle.rotations)[0], [0, 0, np.pi / 4], atol=1e-12)
    inside = path.covers(np.array([start_us - 1, start_us, start_us + 3_000_000, start_us + 3_000_001]))
    np.testing.assert_array_equal(inside, [False, True, True, False])
    with pytest.raises(ValueError, match="at_us"):
        path.at(np.array([start_us - 1]))


def test_empty_and_single() -> None:
    empty = Trajectory(t_us=np.zeros(0, np.int64), Ts_world_camera=np.zeros((0, 4, 4)))
    assert len(empty) == 0
    assert empty.path_length == 0
    assert empty.quaternions_wxyz.shape == (0, 4)
    assert not empty.covers(np.array([0])).any()
    one = Trajectory(t_us=np.array([7]), Ts_world_camera=np.eye(4)[None])
    assert one.path_length == 0
    np.testing.assert_array_equal(one.at(np.array([7])).positions, [[0, 0, 0]])


def test_impossible_trajectories_are_refused() -> None:
    path = square()
    with pytest.raises(ValueError, match=r"expected \(3, 4, 4\)"):
        Trajectory(t_us=path.t_us[:3], Ts_world_camera=path.Ts_world_camera)
    with pytest.raises(ValueError, match="strictly increasing"):
        Trajectory(t_us=path.t_us[[0, 2, 1, 3]], Ts_world_camera=path.Ts_world_camera)
    with pytest.raises(ValueError, match="strictly increasing"):
        Trajectory(t_us=path.t_us[[0, 1, 1, 3]], Ts_world_camera=path.Ts_world_camera)
    broken = path.Ts_world_camera.copy()
    broken[1, 0, 3] = np.nan
    with pytest.raises(ValueError, match="finite"):
        Trajectory(t_us=path.t_us, Ts_world_camera=broken)
