"""Slices of objectives: the same as the slow way, and highest where the motion is right."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from dvsviz.contrast import kernels
from dvsviz.contrast.iwe import vote, warp_points
from dvsviz.contrast.landscape import (
    Grid,
    contrast_landscape,
    edge_image,
    map_landscape,
    map_nodes,
    window_nodes,
)
from dvsviz.contrast.warp import map_warp, window_warp
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, map_to_world

CAMERA = Camera(width=120, height=90, fx=100.0, fy=104.0, cx=60.0, cy=44.0)
WALL = Plane(normal=se3.exp_so3([0.1, -0.15, 0.0]) @ np.array([0.0, 0.0, -1.0]), distance=1.1)
MOTION = np.array([0.4, -0.3, 0.8, 0.5, -0.2, 0.3])
DURATION_S = 0.04


@pytest.fixture(scope="module")
def events() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Events of points on a wall, each seen all the time by a camera that moves with `MOTION`."""
    rng = np.random.default_rng(4)
    points = rng.uniform([10, 10], [CAMERA.width - 10, CAMERA.height - 10], (60, 2))
    t_s = np.sort(rng.uniform(0, DURATION_S, 3000))
    start = CAMERA.bearings(points[rng.integers(0, 60, 3000)])
    nodes = window_warp(MOTION[:3], MOTION[3:], WALL, DURATION_S, np.eye(3), derivatives=False)
    bearings = np.empty((3000, 2), np.float32)
    for i, t in enumerate(t_s):
        k = min(int(t * nodes.scale), len(nodes.nodes) - 2)
        f = t * nodes.scale - k
        q = np.linalg.solve((1 - f) * nodes.nodes[k] + f * nodes.nodes[k + 1], [*start[i], 1.0])
        bearings[i] = q[:2] / q[2]
    weights = np.where(rng.random(3000) < 0.8, 1, -1).astype(np.float32)
    for column in (bearings, t_s, weights):
        column.flags.writeable = False
    return bearings, t_s, weights


def test_each_cell_is_the_contrast_of_its_motion(events: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    bearings, t_s, weights = events
    grid = Grid.around((1, 3), (0.7, 0.9), 5)
    variance = contrast_landscape(bearings, t_s, weights, CAMERA, MOTION, WALL, grid)
    gradient = contrast_landscape(bearings, t_s, weights, CAMERA, MOTION, WALL, grid, measure="gradient")
    assert variance is not None
    assert gradient is not None
    kernel = np.array([0.25, 0.5, 0.25])
    for r, c in ((0, 0), (2, 2), (4, 1)):
        m = MOTION + grid.row(r)[c]
        warp = window_warp(m[:3], m[3:], WALL, float(t_s[-1]), CAMERA.matrix, derivatives=False)
        image = vote(warp_points(bearings, t_s, warp), weights, (CAMERA.height, CAMERA.width))
        smooth = cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
        columns = cv2.sepFilter2D(image, -1, np.ones(1), kernel, borderType=cv2.BORDER_REPLICATE)
        smooth[:, [0, -1]] = columns[:, [0, -1]]
        assert variance[r, c] == pytest.approx(smooth.var(dtype=np.float64), rel=1e-4)
        dx, dy = 0.5 * (smooth[1:-1, 2:] - smooth[1:-1, :-2]), 0.5 * (smooth[2:, 1:-1] - smooth[:-2, 1:-1])
        assert gradient[r, c] == pytest.approx(float((dx**2 + dy**2).sum()) / image.size, rel=1e-4)


@pytest.mark.parametrize("axes", [(0, 1), (2, 5), (4, 3)])
@pytest.mark.parametrize("measure", ["variance", "gradient"])
def test_the_true_motion_is_the_summit(
    axes: tuple[int, int], measure: str, events: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    bearings, t_s, weights = events
    grid = Grid.around(axes, (1.5, 1.5), 9)
    values = contrast_landscape(
        bearings,
        t_s,
        weights,
        CAMERA,
        MOTION,
        WALL,
        grid,
        measure="gradient" if measure == "gradient" else "variance",
    )
    assert values is not None
    assert np.unravel_index(int(values.argmax()), values.shape) == (4, 4)


def test_nodes_of_many_warps_are_those_of_each() -> None:
    motions = MOTION + np.random.default_rng(2).normal(0, 0.5, (4, 6))
    nodes, scale = window_nodes(motions, WALL, DURATION_S, CAMERA.matrix)
    Ts = se3.pose(se3.exp_so3(motions[:, :3] * 0.1), motions[:, 3:] * 0.1)
    on_map, map_scale = map_nodes(Ts, MOTION, WALL, -0.01, DURATION_S, CAMERA.matrix)
    for i, (m, T) in enumerate(zip(motions, Ts, strict=True)):
        one = window_warp(m[:3], m[3:], WALL, DURATION_S, CAMERA.matrix, derivatives=False)
        if one.scale == scale:  # a slower turn alone has fewer nodes
            np.testing.assert_allclose(nodes[i], one.nodes, rtol=1e-9)
        np.testing.assert_allclose(nodes[i][[0, -1]], one.nodes[[0, -1]], rtol=1e-9, atol=1e-9)
        two = map_warp(T, MOTION[:3], MOTION[3:], WALL, -0.01, DURATION_S, CAMERA.matrix, derivatives=False)
        assert map_scale == two.scale
        np.testing.assert_allclose(on_map[i], two.nodes, rtol=1e-9)


@pytest.mark.parametrize("axes", [(0, 4), (2, 3), (5, 1)])
def test_the_true_pose_agrees_best_with_the_map(axes: tuple[int, int]) -> None:
    # Crosses on the wall, and events of their arms seen from a pose.
    rng = np.random.default_rng(7)
    px_per_unit, origin = 80.0, np.array([-1.0, -0.8])
    texture = np.zeros((130, 160), np.uint8)
    for x, y in rng.uniform([10, 10], [150, 120], (25, 2)).astype(int):
        texture[y, x - 6 : x + 7] = texture[y - 6 : y + 7, x] = 255
    rows, columns = np.nonzero(texture)
    T = se3.pose(se3.exp_so3([0.03, -0.04, 0.2]), [0.05, -0.1, 0.1])
    p = map_to_world(origin + np.column_stack([columns, rows]) / px_per_unit, WALL)
    q = (p - T[:3, 3]) @ T[:3, :3]
    bearings = (q[:, :2] / q[:, 2:]).astype(np.float32)
    t_s = np.linspace(0, 0.02, len(bearings))
    target = np.array(
        [[px_per_unit, 0, -px_per_unit * origin[0]], [0, px_per_unit, -px_per_unit * origin[1]], [0, 0, 1]]
    )
    values = map_landscape(
        bearings, t_s, T, np.zeros(6), WALL, edge_image(texture), target, 0.1, Grid.around(axes, (0.08, 0.08), 9)
    )
    assert values is not None
    assert np.unravel_index(int(np.nanargmax(values)), values.shape) == (4, 4)
    assert 0.6 < values[4, 4] <= 1
    far = map_landscape(
        bearings, t_s, T, np.zeros(6), WALL, edge_image(texture), target, 0.1, Grid.around((3, 4), (90.0, 90.0), 3)
    )
    assert far is not None
    assert np.isnan(far[0, 0])


def test_it_stops_when_it_is_told_to(events: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    asked: list[int] = []

    def cancelled() -> bool:
        asked.append(1)
        return len(asked) > 3

    grid = Grid.around((0, 1), (1.0, 1.0), 33)
    assert contrast_landscape(*events, CAMERA, MOTION, WALL, grid, cancelled=cancelled) is None
    assert len(asked) == 4


@pytest.mark.parametrize("axes", [(1, 1), (-1, 2), (0, 6)])
def test_axes_are_two_of_six(axes: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="axes"):
        Grid.around(axes, (1.0, 1.0), 3)


def test_occupied_pixels_are_counted() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.integers(0, 20, 500), rng.integers(0, 11, 500)
    starts = np.array([0, 120, 120, 500])
    out = np.empty(3, np.int64)
    kernels.occupied(x.astype(np.uint16), y.astype(np.uint16), starts, np.full((11, 20), -1), out)
    expected = [len({*zip(x[a:b], y[a:b], strict=True)}) for a, b in itertools.pairwise(starts)]
    assert out.tolist() == expected
