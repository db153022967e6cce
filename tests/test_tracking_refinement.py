"""What a refinement brings down: distances on the sensor, which do not grow smaller by drawing near to the plane."""

import numpy as np
import pytest

from dvsviz.geometry import se3
from dvsviz.geometry.plane import Plane, homography_map_camera, rotation_to_map, turn_normal, turn_normal_derivative
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import free_parameters
from dvsviz.tracking.edges import ViewEvents
from dvsviz.tracking.refine import View, disagreement, refine
from dvsviz.tracking.sensor_distance import cells_per_bearing, cells_per_unit

FOCAL_PX = 200.0
ALL = free_parameters("planar")


def tilted(degrees: float, axis_degrees: float) -> Plane:
    axis = np.array([np.cos(np.radians(axis_degrees)), np.sin(np.radians(axis_degrees)), 0.0])
    return Plane(normal=se3.exp_so3(np.radians(degrees) * axis) @ np.array([0.0, 0.0, -1.0]))


def edges(rng: np.random.Generator, lines: int) -> np.ndarray:
    """Points (N, 2) of short lines, in units of the plane's map."""
    middle, angle = rng.uniform(-1.2, 1.2, (lines, 2)), rng.uniform(0, np.pi, lines)
    along = np.linspace(-0.12, 0.12, 48)
    step = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return (middle[:, None] + along[:, None] * step[:, None]).reshape(-1, 2)


def seen(points: np.ndarray, T: np.ndarray, plane: Plane, rng: np.random.Generator, noise_px: float) -> np.ndarray:
    """Bearings (M, 2) of plane points within a 60 degree view, with noise."""
    q = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(homography_map_camera(T, plane)).T
    b = (q[:, :2] / q[:, 2:])[q[:, 2] > 0]
    b = b[(np.abs(b) < (0.6, 0.45)).all(axis=1)]
    return np.repeat(b, 2, axis=0) + rng.normal(0, noise_px / FOCAL_PX, (2 * len(b), 2))


def path(k: int) -> np.ndarray:
    a = 0.35 * k
    R = se3.exp_so3(0.07 * np.array([np.sin(1.3 * a), np.sin(a), np.sin(0.7 * a)]))
    return se3.pose(R, 0.2 * np.array([np.sin(a), 1 - np.cos(a), 0.3 * np.sin(0.8 * a)]))


def test_the_derivative_of_a_lines_slope_on_the_sensor() -> None:
    rng = np.random.default_rng(1)
    count, views = 40, 4
    plane = tilted(25.0, 40.0)
    Rs = se3.exp_so3(rng.normal(0, 0.15, (views, 3)))
    ts = rng.normal(0, 0.15, (views, 3))
    bearings, view = rng.uniform(-0.5, 0.5, (count, 2)), rng.integers(0, views, count)
    angle = rng.uniform(0, np.pi, count)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    R_map_world = np.array(rotation_to_map(plane.normal))

    def log_slope(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        out, d_log = np.empty(count), np.empty((count, 8))
        n = turn_normal(plane.normal, x[6:])
        cells_per_bearing(
            bearings,
            view,
            se3.exp_so3(x[:3]) @ Rs,
            ts + x[3:6],
            n,
            1.0,
            R_map_world,
            FOCAL_PX,
            normals,
            turn_normal_derivative(plane.normal, np.zeros(2)),
            out,
            d_log,
        )
        return np.log(out), d_log

    value, d_log = log_slope(np.zeros(8))
    for k in range(8):
        step = np.zeros(8)
        step[k] = 1e-6
        central = (log_slope(step)[0] - log_slope(-step)[0]) / 2e-6
        assert d_log[:, k] == pytest.approx(central, abs=1e-6)
    # The slope itself: the distance to the line by a bearing that moves across it, whichever way is steepest.
    H = np.diag([FOCAL_PX, FOCAL_PX, 1.0]) @ homography_map_camera(se3.pose(Rs[view[0]], ts[view[0]]), plane)

    def distance(b: np.ndarray) -> float:
        q = H @ np.append(b, 1.0)
        return float(normals[0] @ q[:2] / q[2])

    slope = [(distance(bearings[0] + e) - distance(bearings[0] - e)) / 2e-6 for e in 1e-6 * np.eye(2)]
    assert np.exp(value[0]) == pytest.approx(np.hypot(slope[0], slope[1]), rel=1e-6)


def seen_along(
    points: np.ndarray, plane: Plane, count: int, rng: np.random.Generator
) -> tuple[list[View], np.ndarray]:
    """So many views along the path, with half a pixel of noise, and their true poses (N, 4, 4)."""
    truths = np.stack([path(k) for k in range(count)])
    views = [
        View(bearings=seen(points, T, plane, rng, 0.7), T_world_camera=T, t_s=0.05 * k)
        for k, T in enumerate(truths)
    ]
    return views, truths


def test_views_do_not_draw_near_to_the_plane_together() -> None:
    """Dense edges seen with half a pixel of noise, from the true poses on: they stay."""
    rng = np.random.default_rng(2)
    plane = tilted(12.0, 200.0)
    points = edges(rng, 160)
    views, truths = seen_along(points, plane, 40, rng)
    result = refine(views, plane, FOCAL_PX, free=ALL, rounds=8)
    drawn = (result.Ts_world_camera[:, :3, 3] - truths[:, :3, 3]) @ plane.normal
    assert abs(drawn.mean()) < 0.003
    assert np.degrees(np.arccos(min(1.0, result.plane.normal @ plane.normal))) < 0.5


def test_a_steep_plane_is_not_refused_for_the_size_of_its_map() -> None:
    """A plane at 45 degrees takes up twice as many cells as one straight ahead of the same pixels."""
    rng = np.random.default_rng(3)
    steep, ahead = tilted(45.0, 60.0), tilted(0.0, 0.0)
    points = edges(rng, 120)
    truths = np.stack([path(k) for k in range(12)])
    bearings = [seen(points, T, steep, rng, 0.7) for T in truths]
    assert cells_per_unit(ViewEvents.of(bearings), truths, steep, FOCAL_PX) < 0.8 * FOCAL_PX
    assert cells_per_unit(ViewEvents.of(bearings[:1]), truths[:1], ahead, FOCAL_PX) == pytest.approx(FOCAL_PX)
    # Noise of so many pixels is as large on the one plane as on the other.
    on_steep = disagreement(ViewEvents.of(bearings), truths, steep, FOCAL_PX)
    flat = [seen(points, T, ahead, rng, 0.7) for T in truths]
    assert on_steep == pytest.approx(disagreement(ViewEvents.of(flat), truths, ahead, FOCAL_PX), rel=0.15)


def test_an_early_refinement_goes_on_until_the_plane_is_found() -> None:
    """Dense edges at 20 degrees, taken for a plane straight ahead: six rounds leave it far off."""
    rng = np.random.default_rng(4)
    steep = tilted(20.0, 60.0)
    points = edges(rng, 250)
    views, _ = seen_along(points, steep, 14, rng)

    def off_deg(times: int) -> float:
        rounds = c.REFINE_ROUNDS_LATER * times
        closing = max(c.REFINE_CLOSING, rounds // 2)
        found = refine(views, tilted(0.0, 0.0), FOCAL_PX, free=ALL, rounds=rounds, closing=closing)
        return float(np.degrees(np.arccos(min(1.0, found.plane.normal @ steep.normal))))

    many, few = off_deg(c.REFINE_EARLY_ROUNDS), off_deg(1)
    assert few > 5.0
    assert many < 2.0
