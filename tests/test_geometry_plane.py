"""Planes and their homographies against explicit ray-plane intersections."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvsviz.geometry import plane as planes
from dvsviz.geometry import se3
from dvsviz.geometry.plane import Plane

UNIT = st.floats(-1, 1)
VECTORS = st.tuples(UNIT, UNIT, UNIT).map(np.array)


def facing_plane(tilt: np.ndarray, distance: float) -> Plane:
    normal = se3.exp_so3(tilt * [1.0, 1.0, 0.0] * 0.8) @ [0.0, 0.0, -1.0]
    normal.setflags(write=False)
    return Plane(normal=normal, distance=distance)


@given(VECTORS, VECTORS, VECTORS, st.floats(0.5, 4))
def test_homography_equals_ray_plane_intersection(
    tilt: np.ndarray, turn: np.ndarray, position: np.ndarray, distance: float
) -> None:
    plane = facing_plane(tilt, distance)
    T = se3.pose(se3.exp_so3(turn * 0.4), position * 0.3 * distance)
    H = planes.homography_map_camera(T, plane)
    R_map_world = planes.rotation_to_map(plane.normal)
    for bearing in ([0.0, 0.0, 1.0], [0.1, -0.05, 1.0], [-0.2, 0.15, 1.0]):
        ray = T[:3, :3] @ bearing
        depth = -(plane.distance + plane.normal @ T[:3, 3]) / (plane.normal @ ray)
        p_world = T[:3, 3] + depth * ray
        expected = R_map_world @ p_world
        assert expected[2] == pytest.approx(distance, abs=1e-9)
        got = H @ bearing
        np.testing.assert_allclose(got[:2] / got[2], expected[:2], atol=1e-9 * (1 + np.abs(expected).max()))
        back = planes.map_to_world((got[:2] / got[2])[None], plane)[0]
        np.testing.assert_allclose(back, p_world, atol=1e-9 * (1 + np.abs(p_world).max()))


def test_first_camera_facing_a_wall_sees_the_map_as_its_bearings() -> None:
    wall = Plane(normal=np.array([0.0, 0.0, -1.0]), distance=2.0)
    H = planes.homography_map_camera(np.eye(4), wall)
    np.testing.assert_allclose(H / H[2, 2], np.diag([2.0, 2.0, 1.0]), atol=1e-15)


@given(VECTORS, VECTORS, VECTORS, st.floats(0.5, 4))
def test_plane_seen_from_a_camera_holds_the_same_points(
    tilt: np.ndarray, turn: np.ndarray, position: np.ndarray, distance: float
) -> None:
    plane = facing_plane(tilt, distance)
    T = se3.pose(se3.exp_so3(turn), position * 0.3)
    seen = plane.seen_from(T)
    p_world = planes.map_to_world(np.array([[0.0, 0.0], [1.0, -0.5], [-2.0, 0.7]]), plane)
    np.testing.assert_allclose(p_world @ plane.normal + plane.distance, 0, atol=1e-12)
    p_camera = (p_world - T[:3, 3]) @ T[:3, :3]
    np.testing.assert_allclose(p_camera @ seen.normal + seen.distance, 0, atol=1e-12)
    assert np.linalg.norm(seen.normal) == pytest.approx(1, abs=1e-12)


def test_seen_from_behind_has_a_negative_distance() -> None:
    wall = Plane(normal=np.array([0.0, 0.0, -1.0]), distance=1.0)
    assert wall.seen_from(se3.pose(position=[0.0, 0.0, 0.25])).distance == 0.75
    assert wall.seen_from(se3.pose(position=[0.0, 0.0, 1.5])).distance == -0.5


@given(VECTORS)
def test_rotation_to_map_is_the_least_rotation(vector: np.ndarray) -> None:
    norm = np.linalg.norm(vector)
    normal = vector / norm if norm > 1e-3 else np.array([0.0, 0.0, -1.0])
    if normal[2] > 0.999:
        normal = -normal
    R = planes.rotation_to_map(normal)
    np.testing.assert_allclose(R @ normal, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-12)
    angle = np.arctan2(np.linalg.norm(normal[:2]), -normal[2])
    assert se3.rotation_angle(R) == pytest.approx(angle, abs=1e-7)


def test_rotation_to_map_refuses_the_one_plane_behind_the_camera() -> None:
    with pytest.raises(ValueError, match="normal_world"):
        planes.rotation_to_map(np.array([0.0, 0.0, 1.0]))


@given(VECTORS)
def test_tangent_basis_is_orthonormal_everywhere(vector: np.ndarray) -> None:
    norm = np.linalg.norm(vector)
    normal = vector / norm if norm > 1e-6 else np.array([0.0, 0.0, -1.0])
    normal.setflags(write=False)
    frame = np.column_stack([planes.tangent_basis(normal), normal])
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_tangent_basis_at_the_poles(axis: int, sign: float) -> None:
    normal = np.zeros(3)
    normal[axis] = sign
    frame = np.column_stack([planes.tangent_basis(normal), normal])
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-15)


@given(VECTORS, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_turned_normal_is_a_unit_vector_that_moved_by_delta(vector: np.ndarray, a: float, b: float) -> None:
    norm = np.linalg.norm(vector)
    normal = vector / norm if norm > 1e-3 else np.array([0.0, 0.0, -1.0])
    turned = planes.turn_normal(normal, np.array([a, b]))
    assert np.linalg.norm(turned) == pytest.approx(1, abs=1e-12)
    # Moving along the tangent plane by |delta| and normalising turns by atan(|delta|).
    angle = np.arctan2(np.linalg.norm(np.cross(normal, turned)), normal @ turned)
    assert angle == pytest.approx(np.arctan(np.hypot(a, b)), abs=1e-9)


def test_turn_normal_has_the_tangent_basis_as_derivative() -> None:
    normal = np.array([0.2, -0.3, -0.9])
    normal /= np.linalg.norm(normal)
    h = 1e-6
    for i, d in enumerate(np.eye(2) * h):
        slope = (planes.turn_normal(normal, d) - planes.turn_normal(normal, -d)) / (2 * h)
        np.testing.assert_allclose(slope, planes.tangent_basis(normal)[:, i], atol=1e-9)
