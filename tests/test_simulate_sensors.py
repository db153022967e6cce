"""Observation models against closed forms, their Jacobians against central differences, their noise by statistics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.simulate.event_camera import EventCamera, EventCameraModel
from dvsviz.simulate.models import cameras, imu, light, points, wheels
from dvsviz.simulate.models.kinematics import exp_se3

RNG = np.random.default_rng(11)
WIDE = Camera(
    width=346, height=260, fx=190.0, fy=193.0, cx=171.0, cy=131.0, distortion=(-0.32, 0.11, 4e-4, -3e-4, -0.01)
)
IDEAL = Camera(width=640, height=480, fx=500.0, fy=510.0, cx=319.5, cy=239.5)
# Standing at (1, 2, 0.5), looking along the world's x axis, z up.
FORWARD = se3.pose(cameras.R_BODY_OPTICAL, [1.0, 2.0, 0.5])


def differences(function: Callable[[np.ndarray], np.ndarray], size: int, step: float = 1e-6) -> np.ndarray:
    """Central differences (k, size) of a function at zero."""
    columns = [(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(size)]
    return np.stack([np.atleast_1d(c) for c in columns], axis=-1)


def poses_and_points(count: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Random poses (N, 4, 4) with points (N, 3) one to three metres in front of their z axis."""
    Ts = exp_se3(RNG.standard_normal((count, 6)))
    local = np.column_stack([RNG.uniform(-0.7, 0.7, (count, 2)), RNG.uniform(1, 3, count)])
    return Ts, (Ts[:, :3, :3] @ local[..., None])[..., 0] + Ts[:, :3, 3]


MODELS = {
    "position": (points.position, points.position_jacobians),
    "range": (points.distance, points.distance_jacobians),
    "lidar": (points.lidar, points.lidar_jacobians),
    "spherical": (cameras.spherical, cameras.spherical_jacobians),
    "pinhole": (
        lambda T, m: cameras.pinhole(T, WIDE, m),
        lambda T, m: cameras.pinhole_jacobians(T, WIDE, m),
    ),
    "stereo": (
        lambda T, m: cameras.stereo(T, IDEAL, 0.12, m),
        lambda T, m: cameras.stereo_jacobians(T, IDEAL, 0.12, m),
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_jacobians_are_central_differences(name: str) -> None:
    model, jacobians = MODELS[name]
    Ts, ms = poses_and_points()
    by_pose, by_point = jacobians(Ts, ms)
    for k in range(len(Ts)):
        T, m = Ts[k], ms[k]
        numeric = differences(lambda xi, T=T, m=m: model(T @ exp_se3(xi), m), 6)
        assert by_pose[k] == pytest.approx(numeric, rel=1e-6, abs=1e-6)
        assert by_point[k] == pytest.approx(differences(lambda d, T=T, m=m: model(T, m + d), 3), rel=1e-6, abs=1e-6)


def test_position_and_range() -> None:
    # Two metres ahead, one to the left, half a metre up: optical (-1, -0.5, 2).
    m = np.array([3.0, 3.0, 1.0])
    assert points.position(FORWARD, m) == pytest.approx([-1, -0.5, 2])
    assert points.distance(FORWARD, m) == pytest.approx(np.sqrt(5.25))
    with pytest.raises(ValueError, match="away"):
        points.distance_jacobians(FORWARD, FORWARD[:3, 3])


def test_bearing_and_its_jacobians() -> None:
    state = np.array([1.0, 1.0, np.pi / 2])
    assert points.bearing(state, [1.0, 5.0]) == pytest.approx(0)
    assert points.bearing(state, [0.0, 1.0]) == pytest.approx(np.pi / 2)
    # Behind a robot that looks along -x the angle is wrapped.
    assert points.bearing([0, 0, np.pi], [-1.0, -1e-9]) == pytest.approx(1e-9, abs=1e-12)
    assert points.bearing([0, 0, -3.0], [-1.0, 0.5]) == pytest.approx(np.arctan2(0.5, -1) + 3.0 - 2 * np.pi)
    states, ms = RNG.standard_normal((5, 3)), RNG.standard_normal((5, 2)) + 4
    by_state, by_point = points.bearing_jacobians(states, ms)
    for k in range(5):
        s, m = states[k], ms[k]
        assert by_state[k] == pytest.approx(
            differences(lambda d, s=s, m=m: points.bearing(s + d, m), 3)[0], abs=1e-8
        )
        assert by_point[k] == pytest.approx(
            differences(lambda d, s=s, m=m: points.bearing(s, m + d), 2)[0], abs=1e-8
        )


def test_lidar_and_its_inverse() -> None:
    origin = np.eye(4)
    assert points.lidar(origin, [0.0, 2.0, 0.0]) == pytest.approx([2, np.pi / 2, 0])
    assert points.lidar(origin, [1.0, 0.0, 1.0]) == pytest.approx([np.sqrt(2), 0, np.pi / 4])
    assert points.lidar(origin, [-1.0, -1.0, 0.0]) == pytest.approx([np.sqrt(2), -3 * np.pi / 4, 0])
    Ts, ms = poses_and_points(50)
    assert points.lidar_inverse(Ts, points.lidar(Ts, ms)) == pytest.approx(ms)


def test_noise_has_the_spread_that_was_asked_for() -> None:
    z = np.zeros((20_000, 3))
    noisy = points.with_noise(z, [0.1, 0.02, 0.0], np.random.default_rng(3))
    assert noisy.std(axis=0) == pytest.approx([0.1, 0.02, 0.0], rel=0.02)
    assert np.array_equal(noisy, points.with_noise(z, [0.1, 0.02, 0.0], np.random.default_rng(3)))
    assert not z.any()


def test_pinhole_sees_left_as_left_and_up_as_up() -> None:
    m = np.array([3.0, 3.0, 1.0])
    assert cameras.pinhole(FORWARD, IDEAL, m) == pytest.approx([319.5 - 250, 239.5 - 127.5])
    assert np.isnan(cameras.pinhole(FORWARD, IDEAL, [0.0, 2.0, 0.5])).all()
    # k1 r² = -0.32 x 0.25: an eighth of the way to the centre less.
    lens = Camera(width=346, height=260, fx=190.0, fy=190.0, cx=170.0, cy=130.0, distortion=(-0.32, 0, 0, 0, 0))
    assert cameras.pinhole(np.eye(4), lens, [0.5, 0.0, 1.0]) == pytest.approx([170 + 95 * 0.92, 130])


def test_sphere_sees_behind_and_agrees_with_the_pinhole_in_front() -> None:
    assert cameras.spherical(FORWARD, [-2.0, 2.0, 0.5]) == pytest.approx([0, 0, -1])
    assert cameras.spherical(FORWARD, [1.0, 5.0, 4.5]) == pytest.approx([-0.6, -0.8, 0])
    Ts, ms = poses_and_points()
    on_sphere = cameras.spherical(Ts, ms)
    assert np.linalg.norm(on_sphere, axis=-1) == pytest.approx(1)
    assert IDEAL.project(on_sphere[:, :2] / on_sphere[:, 2:]) == pytest.approx(cameras.pinhole(Ts, IDEAL, ms))
    assert np.isnan(cameras.spherical(FORWARD, FORWARD[:3, 3])).all()


def test_radial_polynomial_and_its_inverse() -> None:
    d = np.array([[0.3, -0.4], [0.0, 0.0], [0.6, 0.1]])
    assert cameras.undistort_radial(d, 0.2, 0.04)[0] == pytest.approx(np.array([0.3, -0.4]) * (1 + 0.05 + 0.0025))
    for a1, a2 in ((0.2, 0.04), (-0.3, 0.05), (0.0, 0.0)):
        assert cameras.distort_radial(cameras.undistort_radial(d, a1, a2), a1, a2) == pytest.approx(d, abs=1e-10)
        J = cameras.undistort_radial_jacobian(d, a1, a2)
        for k in range(3):
            numeric = differences(lambda e, p=d[k], a=(a1, a2): cameras.undistort_radial(p + e, *a), 2)
            assert J[k] == pytest.approx(numeric, abs=1e-9)
    with pytest.raises(ValueError, match="reach"):
        cameras.distort_radial([2.0, 0.0], -0.5, 0.0)


def test_stereo_depth_from_disparity() -> None:
    z = cameras.stereo(FORWARD, IDEAL, 0.1, [3.0, 2.0, 0.5])
    assert z == pytest.approx([319.5, 239.5, 500 * 0.1 / 2])
    right = FORWARD @ se3.pose(None, [0.1, 0, 0])
    Ts, ms = poses_and_points(20)
    rights = Ts @ se3.pose(None, [0.1, 0, 0])
    left_z, right_px = cameras.stereo(Ts, IDEAL, 0.1, ms), cameras.pinhole(rights, IDEAL, ms)
    assert left_z[:, 0] - left_z[:, 2] == pytest.approx(right_px[:, 0])
    assert left_z[:, 1] == pytest.approx(right_px[:, 1])
    assert cameras.stereo_inverse(Ts, IDEAL, 0.1, left_z) == pytest.approx(ms)
    # The right camera stands to the right, which is -y for one that looks along x.
    assert right[:3, 3] == pytest.approx([1, 1.9, 0.5])
    with pytest.raises(ValueError, match="rectified"):
        cameras.stereo(FORWARD, WIDE, 0.1, [3.0, 2.0, 0.5])


def test_encoder_counts_what_was_rolled() -> None:
    tick = np.pi * 0.254 / 360
    assert wheels.metres_per_tick(0.254, 360) == pytest.approx(tick)
    v = np.full(200, 0.7)
    counts = wheels.encoder_counts(v, 0.025, 0.254, 360)
    assert counts.sum() == int(200 * 0.7 * 0.025 / tick)
    assert np.abs(counts - 0.7 * 0.025 / tick).max() < 1
    assert wheels.encoder_velocity(counts, 0.025, 0.254, 360).mean() == pytest.approx(0.7, rel=1e-3)
    assert wheels.encoder_counts(-v, 0.025, 0.254, 360).sum() == -counts.sum() - 1
    assert wheels.encoder_velocity(360, 2.0, 0.254, 360) == pytest.approx(np.pi * 0.254 / 2)


def test_imu_in_hover_feels_one_g_upward_in_any_attitude() -> None:
    zero = np.zeros(3)
    gyro, accel = imu.imu(np.eye(3), zero, zero, zero)
    assert gyro == pytest.approx(zero)
    assert accel == pytest.approx([0, 0, 9.81])
    # Lying on its left side (y down), up is along -y.
    assert imu.imu(se3.exp_so3([-np.pi / 2, 0, 0]), zero, zero, zero)[1] == pytest.approx([0, -9.81, 0])
    assert imu.imu(np.eye(3), zero, zero, imu.GRAVITY_DOWN_Z)[1] == pytest.approx(zero)


def test_imu_on_a_lever_feels_the_turn() -> None:
    zero, arm = np.zeros(3), se3.pose(None, [0.2, 0, 0])
    _, accel = imu.imu(np.eye(3), [0, 0, 3.0], [0, 0, 5.0], zero, T_body_imu=arm)
    # Centripetal w² r inwards, tangential alpha r forward.
    assert accel == pytest.approx([-9 * 0.2, 5 * 0.2, 9.81])
    turned = se3.pose(se3.exp_so3([0, 0, np.pi / 2]), [0.2, 0, 0])
    gyro, accel = imu.imu(np.eye(3), [1.0, 0, 3.0], [0, 0, 5.0], zero, T_body_imu=turned, gyro_bias=[0.1, 0, 0])
    assert gyro == pytest.approx([0.1, -1, 3])
    assert accel[:2] == pytest.approx([5 * 0.2, 9 * 0.2])


def test_imu_jacobians_are_central_differences() -> None:
    R, w, alpha, a = se3.exp_so3(RNG.standard_normal(3)), *RNG.standard_normal((3, 3))
    T = exp_se3(RNG.standard_normal(6))
    J = imu.imu_jacobians(R, w, a, T_body_imu=T)
    cases = {
        "gyro_omega": lambda d: imu.imu(R, w + d, alpha, a, T_body_imu=T)[0],
        "accel_rotation": lambda d: imu.imu(R @ se3.exp_so3(d), w, alpha, a, T_body_imu=T)[1],
        "accel_omega": lambda d: imu.imu(R, w + d, alpha, a, T_body_imu=T)[1],
        "accel_alpha": lambda d: imu.imu(R, w, alpha + d, a, T_body_imu=T)[1],
        "accel_accel": lambda d: imu.imu(R, w, alpha, a + d, T_body_imu=T)[1],
    }
    assert set(cases) == set(J)
    for name, function in cases.items():
        assert J[name] == pytest.approx(differences(function, 3), abs=1e-7), name


def test_bias_walks_with_the_root_of_time() -> None:
    rng = np.random.default_rng(5)
    walks = np.stack([imu.random_walk(401, [1.0, 0, 0], 0.02, 0.25, rng) for _ in range(400)])
    assert np.all(walks[:, 0] == [1.0, 0, 0])
    spread = (walks - [1.0, 0, 0]).std(axis=(0, 2))
    # 25 s and 100 s.
    assert spread[100] == pytest.approx(0.1, rel=0.08)
    assert spread[400] == pytest.approx(0.2, rel=0.08)


def test_intensity_noise_grows_with_the_root_of_the_light() -> None:
    rng = np.random.default_rng(2)
    grey = {level: light.intensity_image(np.full((200, 300), level), rng, full_well=400) for level in (0.1, 0.4)}
    assert grey[0.1].std() == pytest.approx(255 * np.sqrt(0.1 / 400 + 0.003**2), rel=0.05)
    assert grey[0.4].std() == pytest.approx(255 * np.sqrt(0.4 / 400 + 0.003**2), rel=0.05)
    exact = light.intensity_image(np.array([[0.0, 0.5, 2.0]]), rng, full_well=np.inf, read_sigma=0, exposure=0.5)
    assert exact.tolist() == [[0, 64, 255]]


def test_depth_noise_grows_with_the_square_of_the_depth() -> None:
    rng = np.random.default_rng(4)
    for z in (1.0, 3.0):
        units = light.depth_image(np.full((180, 240), z), rng, hole_share=0.1)
        assert (units == 0).mean() == pytest.approx(0.1, abs=0.01)
        measured = units[units > 0] / 5000
        assert measured.mean() == pytest.approx(z, abs=1e-3)
        assert measured.std() == pytest.approx(0.0015 * z * z, rel=0.03)


def test_depth_holes_and_quantization() -> None:
    rng = np.random.default_rng(4)
    depth = np.full((4, 6), 2.00003)
    depth[:, 3:] = 3.0
    depth[0, 0], depth[3, 0], depth[0, 5] = np.nan, 0.2, 9.0
    units = light.depth_image(depth, rng, sigma_at_1m=0, hole_share=0)
    assert units.dtype == np.uint16
    # Out of range, no surface; and on both sides of a step.
    assert units[:, 1].tolist() == [10000, 10000, 10000, 0]
    assert units[0, 0] == units[3, 0] == units[0, 5] == 0
    assert not units[:, 2:4].any()
    assert units[2, 5] == 15000
    beyond = light.depth_image(np.full((2, 3), 7.9), rng, scale=10_000, hole_share=0)
    assert not beyond.any()


def test_events_of_a_ramp_are_contrast_by_threshold() -> None:
    t, p = light.pixel_events([0.0, 2.0], [0.0, 1.0], threshold_on=0.25)
    assert t == pytest.approx(np.arange(1, 9) / 8)
    assert np.all(p == 1)
    t, p = light.pixel_events([1.0, 0.0, 1.0], [0.0, 1.0, 2.0], threshold_on=0.4, threshold_off=0.3)
    # Down at 0.3, 0.6, 0.9; then up from 0.1: at 0.5 and 0.9 of the way.
    assert t == pytest.approx([0.3, 0.6, 0.9, 1.5, 1.9])
    assert p.tolist() == [-1, -1, -1, 1, 1]
    # Blind for 0.1 s after an event, then what it sees is memorised: one event each 0.1 + 0.125 s.
    t, _ = light.pixel_events([0.0, 2.0], [0.0, 1.0], refractory_s=0.1)
    assert t == pytest.approx(0.125 + 0.225 * np.arange(4))


def test_pixel_and_sensor_agree() -> None:
    t = np.linspace(0, 1, 400)
    levels = 0.9 * np.sin(9 * t) + 0.3 * np.sin(41 * t) - 1.5
    sensor = EventCameraModel(
        threshold_sigma=0, leak_hz=0, shot_hz=0, hot_share=0, refractory_s=2e-3, threshold_off=0.2
    )
    pixel = EventCamera(sensor, np.exp(levels[:1, None]).astype(np.float32), 0.0, np.random.default_rng(0))
    image = np.empty((1, 1), np.float32)
    for k in range(1, 400):
        image[:] = np.exp(levels[k])
        pixel.step(image, float(t[k]))
    events = pixel.flush(image, 1.0)
    # The sensor starts at an unknown level between its thresholds: both agree from the first event on.
    start = int(events.t_us[0]) * 1e-6 + 2e-3
    after = t > start
    level = np.interp(start, t, levels)
    times, signs = light.pixel_events(
        np.append(level, levels[after]), np.append(start, t[after]), threshold_off=0.2, refractory_s=2e-3
    )
    assert len(times) > 20
    assert np.array_equal(signs > 0, events.is_positive[1:])
    assert np.abs(times * 1e6 - events.t_us[1:]).max() < 20


def test_brightness_increment_is_what_passes_by() -> None:
    # An edge of slope 0.1 a pixel that moves right at 50 px/s darkens a pixel by 0.5 in 0.1 s.
    assert light.brightness_increment([0.1, 0.0], [50.0, 20.0], 0.1) == pytest.approx(-0.5)
    g, v, tau = RNG.standard_normal((4, 2)), RNG.standard_normal((4, 2)), np.full(4, 0.3)
    by_gradient, by_flow = light.brightness_increment_jacobians(g, v, tau)
    for k in range(4):
        one = (g[k], v[k])
        numeric = differences(lambda d, o=one: light.brightness_increment(o[0] + d, o[1], 0.3), 2)[0]
        assert by_gradient[k] == pytest.approx(numeric)
        numeric = differences(lambda d, o=one: light.brightness_increment(o[0], o[1] + d, 0.3), 2)[0]
        assert by_flow[k] == pytest.approx(numeric)
