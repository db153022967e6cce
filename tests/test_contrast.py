"""Contrast: every derivative against central differences, kernels against slow references, the standard window."""

from __future__ import annotations

from typing import get_args

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dvsviz.contrast.iwe import image_of_warped_events, sample_window, vote, warp_points
from dvsviz.contrast.objectives import ObjectiveName, objective
from dvsviz.contrast.relief import ReliefProblem, grid_shape, maximize_relief_contrast
from dvsviz.contrast.solve import ContrastProblem, maximize_contrast
from dvsviz.contrast.warp import map_warp, window_warp
from dvsviz.events.events import Events
from dvsviz.events.windows import make_window
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import (
    Plane,
    homography_map_camera,
    rotation_to_map,
    turn_normal,
    turn_normal_derivative,
)
from dvsviz.tracking.pose_equations import pose_equations, turned

CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)
SMALL = Camera(width=48, height=32, fx=40.0, fy=42.0, cx=23.0, cy=16.5)
AHEAD = np.array([0.0, 0.0, -1.0])
OMEGA, VELOCITY = np.array([0.4, -0.6, 1.0]), np.array([0.5, -0.3, 0.4])
TILTED = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])


def small_window(
    seed: int = 0, count: int = 400
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    # Far from the border: an event that leaves the image is a jump that no derivative has.
    bearings = rng.uniform((-0.35, -0.22), (0.35, 0.22), (count, 2)).astype(np.float32)
    t_s = np.sort(rng.uniform(0, 0.2, count))
    t_s[0] = 0.0
    signs = np.where(rng.random(count) < 0.5, 1, -1).astype(np.float32)
    for array in (bearings, t_s, signs):
        array.setflags(write=False)
    return bearings, t_s, signs


def segments(count: int, duration_s: float, noise: float, seed: int = 0):
    """Events of 80 random segments on the plane (0, 0, -1) at distance 1, inside the image, and where they belong."""
    rng = np.random.default_rng(seed)
    centre, angle = rng.uniform((-0.55, -0.4), (0.55, 0.4), (80, 2)), rng.uniform(0, np.pi, 80)
    length = rng.uniform(0.1, 0.4, 80)
    which, along = rng.integers(0, 80, 2 * count), rng.uniform(-0.5, 0.5, 2 * count)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = np.column_stack(
        [centre[which] + (along * length[which])[:, None] * direction[which], np.ones(2 * count)]
    )
    t = np.sort(rng.uniform(0, duration_s, 2 * count))
    seen = np.einsum("nij,ni->nj", se3.exp_so3(t[:, None] * OMEGA), points - t[:, None] * VELOCITY)
    bearings = seen[:, :2] / seen[:, 2:]
    stray = rng.random(2 * count) < noise
    bearings[stray] = rng.uniform((-0.59, -0.44), (0.59, 0.44), (int(stray.sum()), 2))
    inside = (np.abs(bearings) < (0.595, 0.445)).all(axis=1)
    keep = np.flatnonzero(inside)[:count]
    t = t[keep] * duration_s / t[keep][-1]
    # The times were stretched to the whole window: the same events again at those times.
    seen = np.einsum("nij,ni->nj", se3.exp_so3(t[:, None] * OMEGA), points[keep] - t[:, None] * VELOCITY)
    bearings = np.where(stray[keep][:, None], bearings[keep], seen[:, :2] / seen[:, 2:])
    t[0] = 0.0
    home = points[keep][:, :2] * 200.0 + (119.5, 89.5)
    return bearings.astype(np.float32), t, home, ~stray[keep]


@pytest.mark.parametrize("parameter", range(8))
def test_window_warp_derivatives(parameter: int) -> None:
    theta = np.concatenate([OMEGA, VELOCITY, [0.1, -0.05]])

    def warp(theta: NDArray[np.float64]):
        plane = Plane(normal=turn_normal(TILTED, theta[6:]), distance=1.2)
        slope = turn_normal_derivative(TILTED, theta[6:])
        return window_warp(theta[:3], theta[3:6], plane, 0.3, CAMERA.matrix, d_normal=slope)

    step = np.zeros(8)
    step[parameter] = 1e-6
    numeric = (warp(theta + step).nodes - warp(theta - step).nodes) / 2e-6
    exact = warp(theta).d_nodes[parameter]
    assert np.abs(numeric - exact).max() < 1e-7 * np.abs(exact).max()


@pytest.mark.parametrize("parameter", range(6))
def test_map_warp_derivatives(parameter: int) -> None:
    T = se3.pose(se3.exp_so3([0.1, 0.2, -0.3]), [0.1, -0.2, 0.3])
    target = np.array([[200.0, 0, 50], [0, 200, 60], [0, 0, 1]])

    def warp(delta: NDArray[np.float64]):
        R = T[:3, :3]
        moved = se3.pose(R @ se3.exp_so3(delta[:3]), T[:3, 3] + R @ delta[3:])
        return map_warp(moved, OMEGA, VELOCITY, Plane(normal=TILTED, distance=1.1), -0.02, 0.05, target)

    step = np.zeros(6)
    step[parameter] = 1e-6
    numeric = (warp(step).nodes - warp(-step).nodes) / 2e-6
    exact = warp(np.zeros(6)).d_nodes[parameter]
    assert np.abs(numeric - exact).max() < 1e-7 * np.abs(exact).max()


def test_warps_agree_with_the_geometry() -> None:
    """A point on the plane, seen at time t, is taken to where the first camera sees it, and to its map coordinates."""
    plane = Plane(normal=TILTED, distance=1.3)
    T = se3.pose(se3.exp_so3([0.05, -0.1, 0.2]), [0.1, 0.05, -0.1])
    local = plane.seen_from(T)
    t = 0.15
    later = se3.propagate(T, OMEGA, VELOCITY, t)
    bearing = np.array([[0.12, -0.2]], dtype=np.float32)
    world = homography_map_camera(later, plane) @ np.append(bearing[0], 1.0)
    first = np.linalg.inv(homography_map_camera(T, plane)) @ world
    warp = window_warp(OMEGA, VELOCITY, local, 0.3, np.eye(3), derivatives=False)
    assert np.allclose(warp_points(bearing, np.array([t]), warp)[0], first[:2] / first[2], atol=2e-5)
    on_map = map_warp(T, OMEGA, VELOCITY, plane, 0.0, 0.3, np.eye(3), derivatives=False)
    assert np.allclose(warp_points(bearing, np.array([t]), on_map)[0], world[:2] / world[2], atol=2e-5)


@pytest.mark.parametrize("blur", [0.0, 1.5])
@pytest.mark.parametrize("name", get_args(ObjectiveName))
def test_objective_adjoints(name: ObjectiveName, blur: float) -> None:
    rng = np.random.default_rng(1)
    image = rng.normal(1.0, 1.0, (14, 19)).astype(np.float32)
    image.setflags(write=False)
    cost = objective(name, blur)
    _, adjoint = cost(image)
    direction = rng.normal(size=image.shape)
    # Float32 images: a wide step, and the quadratic objectives have no error of their own.
    h = 1e-3 if name == "michelson" else 1e-1
    up, down = (cost((image + s * h * direction).astype(np.float32))[0] for s in (1, -1))
    assert (up - down) / (2 * h) == pytest.approx(float((adjoint * direction).sum()), rel=2e-2, abs=1e-6)


def slow_contrast(theta: NDArray[np.float64], bearings, t_s, signs, blur: float) -> float:
    """Variance of the blurred IWE in float64, event by event, with the exact rotation at each event's own time."""
    plane = Plane(normal=turn_normal(TILTED, theta[6:]))
    image = np.zeros((SMALL.height, SMALL.width))
    for b, t, s in zip(bearings.astype(float), t_s, signs, strict=True):
        A = np.linalg.inv(np.eye(3) + t * np.outer(theta[3:6], plane.normal))
        q = SMALL.matrix @ A @ se3.exp_so3(theta[:3] * t) @ np.append(b, 1.0)
        x, y = q[:2] / q[2]
        c, r = int(x), int(y)
        fx, fy = x - c, y - r
        image[r : r + 2, c : c + 2] += s * np.outer([1 - fy, fy], [1 - fx, fx])
    return float(cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_CONSTANT).var())


def test_contrast_and_gradient_against_a_slow_reference() -> None:
    """The adjoint through blur, vote and warp equals central differences of a slow float64 version."""
    bearings, t_s, signs = small_window(count=150)
    problem = ContrastProblem(bearings=bearings, t_s=t_s, weights=signs, camera=SMALL, duration_s=0.2)
    theta = np.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.15, 0.05, -0.1])
    plane = Plane(normal=turn_normal(TILTED, theta[6:]))
    slope = turn_normal_derivative(TILTED, theta[6:])
    value, gradient = problem.evaluate(theta[:3], theta[3:6], plane, objective("variance", 1.5), d_normal=slope)

    def slow(theta: NDArray[np.float64]) -> float:
        return slow_contrast(theta, bearings, t_s, signs, 1.5)

    assert value == pytest.approx(slow(theta), rel=1e-3)
    numeric = np.array([(slow(theta + s) - slow(theta - s)) / 2e-6 for s in 1e-6 * np.eye(8)])
    # Float32 positions and the nodes' interpolation: a few parts in a thousand.
    assert np.abs(gradient - numeric).max() < 0.01 * np.abs(numeric).max()


def test_vote_is_bilinear_and_keeps_the_sum() -> None:
    points = np.array([[1.25, 2.5], [3.0, 1.0], [-0.1, 2.0], [np.nan, 1.0], [6.5, 3.0]], dtype=np.float32)
    image = vote(points, np.array([2, 1, 5, 5, 5], dtype=np.float32), (5, 7))
    assert image.sum() == pytest.approx(3.0)
    assert image[2, 1] == pytest.approx(2 * 0.75 * 0.5)
    assert image[3, 2] == pytest.approx(2 * 0.25 * 0.5)
    assert image[1, 3] == pytest.approx(1.0)


def test_pose_equations_against_a_slow_reference() -> None:
    bearings, t_s, _ = small_window(3, 60)
    rng = np.random.default_rng(2)
    image = rng.random((80, 90)).astype(np.float32)
    target = np.array([[60.0, 0, 45], [0, 60, 40], [0, 0, 1]])
    plane, start = Plane(normal=TILTED, distance=1.1), -0.08
    T = se3.pose(se3.exp_so3(np.array([0.05, -0.1, 0.2])), np.array([0.1, -0.05, 0.15]))
    warp = map_warp(T, OMEGA, VELOCITY, plane, start, 0.2, target)
    rays = np.empty((3, len(bearings)), dtype=np.float32)
    turned(bearings, start + t_s, np.array(OMEGA), rays)
    to_map = target @ (rotation_to_map(plane.normal) / np.array([[1.0], [1.0], [plane.distance]]))
    H, g = np.zeros((6, 6)), np.zeros(6)
    total, inside = pose_equations(
        rays, (start + t_s).astype(np.float32), T[:3, :3].copy(), T[:3, 3].copy(), np.array(VELOCITY), TILTED,
        plane.distance, to_map, image,
        0.7, False, H, g,
    )  # fmt: skip
    slow_H, slow_g, slow_total, slow_inside = np.zeros((6, 6)), np.zeros(6), 0.0, 0
    for b, t in zip(bearings.astype(float), t_s, strict=True):
        k = min(int(t * warp.scale), len(warp.nodes) - 2)
        f = t * warp.scale - k
        lerp = lambda a, k=k, f=f: (1 - f) * a[k] + f * a[k + 1]  # noqa: E731
        q = lerp(warp.nodes) @ np.append(b, 1.0)
        u, v = q[:2] / q[2]
        c, r = int(u), int(v)
        if not (0 <= u < 89 and 0 <= v < 79):
            continue
        fx, fy = u - c, v - r
        block = image[r : r + 2, c : c + 2].astype(float)
        value = np.array([1 - fy, fy]) @ block @ np.array([1 - fx, fx])
        slope = np.array(
            [np.array([1 - fy, fy]) @ block @ np.array([-1, 1]), np.array([-1, 1]) @ block @ np.array([1 - fx, fx])]
        )
        J = np.empty(6)
        for p in range(6):
            dq = lerp(warp.d_nodes[p]) @ np.append(b, 1.0)
            J[p] = -slope @ (dq[:2] / q[2] - q[:2] * dq[2] / q[2] ** 2)
        w = (0.49 / (0.49 + (1 - value) ** 2)) ** 2
        slow_H += w * np.outer(J, J)
        slow_g += w * J * (1 - value)
        slow_total, slow_inside = slow_total + value, slow_inside + 1
    assert inside == slow_inside > 30
    assert total == pytest.approx(slow_total, rel=1e-3)
    # The two interpolate the rotation in other places.
    assert np.allclose(H, slow_H, rtol=2e-3, atol=2e-3 * np.abs(slow_H).max())
    assert np.allclose(g, slow_g, rtol=2e-3, atol=2e-3 * np.abs(slow_g).max())


def test_standard_window() -> None:
    """50,000 events in 50 ms, 5 % noise: at most 0.1 px RMS from a zero start, the same bits every time."""
    bearings, t_s, home, real = segments(50_000, 0.05, 0.05)
    assert len(bearings) == 50_000
    problem = ContrastProblem(
        bearings=bearings, t_s=t_s, weights=np.ones(1, dtype=np.float32), camera=CAMERA, duration_s=0.05
    )
    before = np.sqrt(((bearings * 200.0 + (119.5, 89.5) - home)[real] ** 2).sum(axis=1).mean())
    assert before > 4.0
    solved = [maximize_contrast(problem, Plane(normal=AHEAD)) for _ in range(2)]
    warp = window_warp(
        solved[0].omega, solved[0].velocity, Plane(normal=AHEAD), 0.05, CAMERA.matrix, derivatives=False
    )
    error = (warp_points(bearings, t_s, warp) - home)[real]
    assert np.sqrt((error**2).sum(axis=1).mean()) <= 0.1
    assert solved[0].contrast_after > 1.5 * solved[0].contrast_before
    for name in ("omega", "velocity"):
        assert np.array_equal(getattr(solved[0], name), getattr(solved[1], name))


def test_truth_has_more_contrast_than_perturbed_motions() -> None:
    bearings, t_s, _, _ = segments(20_000, 0.05, 0.05, seed=4)
    one = np.ones(1, dtype=np.float32)
    problem = ContrastProblem(bearings=bearings, t_s=t_s, weights=one, camera=CAMERA, duration_s=0.05)
    cost = objective("variance", 1.0)
    best = problem.contrast(OMEGA, VELOCITY, Plane(normal=AHEAD), cost)
    for axis in np.eye(3):
        for sign in (-1, 1):
            assert problem.contrast(OMEGA + sign * 0.3 * axis, VELOCITY, Plane(normal=AHEAD), cost) < best
            assert problem.contrast(OMEGA, VELOCITY + sign * 0.3 * axis, Plane(normal=AHEAD), cost) < best


def test_iwe_without_motion_is_the_undistorted_window() -> None:
    camera = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=19.0, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))
    events = Events(
        t_us=np.arange(5, dtype=np.int64) + 1_700_000_000_000_000,
        x_px=np.full(5, 30, dtype=np.uint16),
        y_px=np.full(5, 19, dtype=np.uint16),
        is_positive=np.ones(5, dtype=bool),
    )
    window = make_window(camera, events)
    image = image_of_warped_events(window.bearings, window.t_s, None, camera)
    # The principal point stays where it is under any distortion; float32 bearings move it by less than 1e-4 px.
    assert image[18:21, 29:32].sum() == pytest.approx(5.0)
    assert image.shape == (40, 60)


def test_sample_is_seeded_ordered_and_spread() -> None:
    n = 10_000
    events = Events(
        t_us=np.arange(n, dtype=np.int64),
        x_px=(np.arange(n) % 48).astype(np.uint16),
        y_px=(np.arange(n) % 32).astype(np.uint16),
        is_positive=np.ones(n, dtype=bool),
    )
    window = make_window(SMALL, events, index=7)
    (b1, t1), (b2, t2) = sample_window(window, 500, 3), sample_window(window, 500, 3)
    assert np.array_equal(b1, b2)
    assert np.array_equal(t1, t2)
    assert len(t1) == 500
    assert np.all(np.diff(t1) > 0)
    assert not np.array_equal(sample_window(window, 500, 4)[1], t1)


def test_relief_gradient_and_direction() -> None:
    """A wavy scene, translating: derivative by central differences, direction of travel within 3 degrees."""
    rng = np.random.default_rng(0)
    v = np.array([0.8, 0.1, 0.3])
    n = 12_000
    home = np.column_stack([rng.uniform(-0.55, 0.55, 60), rng.uniform(-0.4, 0.4, 60)])
    which = rng.integers(0, 60, n)
    offset = rng.uniform(-0.06, 0.06, n)
    angle = rng.uniform(0, np.pi, 60)
    x = home[which] + offset[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[which]
    rho = 1.0 + 0.5 * np.sin(4.0 * x[:, 0])
    t = np.sort(rng.uniform(-0.03, 0.03, n))
    s = (rho * t)[:, None]
    seen = x - s * v[:2] + s * v[2] * x
    inside = (np.abs(seen) < (0.58, 0.43)).all(axis=1)
    b, t = seen[inside].astype(np.float32), t[inside]
    problem = ReliefProblem(b, t, np.ones(len(b), dtype=np.float32), CAMERA)
    cost = objective("variance", 2.0)
    depth = rng.normal(0, 0.1, grid_shape(CAMERA))
    _, by_v, by_depth = problem.evaluate(v, depth, cost)
    for i in range(3):
        step = np.eye(3)[i] * 2e-3
        numeric = (problem.evaluate(v + step, depth, cost)[0] - problem.evaluate(v - step, depth, cost)[0]) / 4e-3
        assert by_v[i] == pytest.approx(numeric, rel=0.05, abs=0.02 * np.abs(by_v).max())
    cell = np.zeros_like(depth)
    cell[2, 3] = 5e-3
    numeric = (problem.evaluate(v, depth + cell, cost)[0] - problem.evaluate(v, depth - cell, cost)[0]) / 1e-2
    assert by_depth.reshape(depth.shape)[2, 3] == pytest.approx(
        numeric, rel=0.05, abs=0.02 * np.abs(by_depth).max()
    )
    # Weak blur at the end: a strong one draws events together and bends v_z.
    found = maximize_relief_contrast(
        problem,
        0.06,
        velocity=np.zeros(3),
        log_inverse_depth=np.zeros(grid_shape(CAMERA)),
        blurs_px=(2.0, 1.0, 0.5),
        max_evaluations=80,
    )
    cosine = found.velocity @ v / np.linalg.norm(found.velocity) / np.linalg.norm(v)
    assert np.degrees(np.arccos(cosine)) < 3.0
    assert found.log_inverse_depth[:, -1].mean() > found.log_inverse_depth[:, 0].mean() + 0.3
