"""Mode `contrast`: derivatives of the keyframes' joint contrast, its parts on known answers, and a whole run."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from dvsviz.contrast.joint import (
    Canvas,
    KeyframeEvents,
    canvas_of,
    common_image,
    joint_contrast,
    maximize_joint_contrast,
)
from dvsviz.contrast.objectives import ObjectiveName, objective
from dvsviz.contrast.solve import ContrastProblem, maximize_contrast
from dvsviz.contrast.warp import keyframe_warp
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import (
    Plane,
    homography_map_camera,
    rotation_to_map,
    rotation_to_map_derivative,
    turn_normal,
    turn_normal_derivative,
)

CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)
OMEGA, VELOCITY = np.array([0.4, -0.6, 1.0]), np.array([0.5, -0.3, 0.4])
TILTED = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
ALL = np.ones(6, dtype=bool)
TARGET = np.array([[60.0, 0, 50], [0, 60, 40], [0, 0, 1]])


def moved(T: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pose after a local step (6,): rotation, then position."""
    R = T[:3, :3]
    return se3.pose(R @ se3.exp_so3(x[:3]), T[:3, 3] + R @ x[3:6])


def test_derivative_of_the_rotation_to_the_map() -> None:
    basis = turn_normal_derivative(TILTED, np.zeros(2))
    for i in range(2):
        step = 1e-6 * np.eye(2)[i]
        numeric = (rotation_to_map(turn_normal(TILTED, step)) - rotation_to_map(turn_normal(TILTED, -step))) / 2e-6
        assert np.abs(numeric - rotation_to_map_derivative(TILTED, basis[:, i])).max() < 1e-8


@pytest.mark.parametrize("parameter", range(14))
def test_keyframe_warp_derivatives(parameter: int) -> None:
    T = se3.pose(se3.exp_so3([0.1, 0.2, -0.3]), [0.1, -0.2, 0.3])
    at = np.array([0.02, -0.03])

    def warp(x: NDArray[np.float64]):
        plane = Plane(normal=turn_normal(TILTED, at + x[12:]), distance=1.1)
        slope = turn_normal_derivative(TILTED, at + x[12:])
        return keyframe_warp(moved(T, x), OMEGA + x[6:9], VELOCITY + x[9:12], plane, 0.2, TARGET, slope)

    step = np.zeros(14)
    step[parameter] = 1e-6
    numeric = (warp(step).nodes - warp(-step).nodes) / 2e-6
    exact = warp(np.zeros(14)).d_nodes[parameter]
    assert np.abs(numeric - exact).max() < 1e-7 * np.abs(exact).max()
