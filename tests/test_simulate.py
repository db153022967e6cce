"""The simulator: its truth is the truth, its events are those of the definition, the same seed gives the same bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvsviz.events.recording import Recording
from dvsviz.formats.hdf5 import read_recording
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.geometry.se3 import exp_so3, pose
from dvsviz.simulate.inertial import ImuModel, simulate_imu
from dvsviz.simulate.motion import MotionName, slider
from dvsviz.simulate.render import PixelGrid, PlaneView
from dvsviz.simulate.scenes import PAINTERS, SceneName, blank, fill_polygon
from dvsviz.simulate.simulate import simulate
from dvsviz.simulate.texture import make_texture

SMALL = Camera(width=90, height=60, fx=80.0, fy=80.0, cx=44.5, cy=29.5)


def make(path: Path, **options) -> Recording:
    simulate(path, camera=SMALL, **{"seconds": 0.6, **options})
    return read_recording(path)


def test_truth_spans_the_events_at_200_hz_and_above(tmp_path: Path) -> None:
    recording = make(tmp_path / "a.h5")
    truth = recording.ground_truth
    assert truth is not None
    assert truth.t_us[0] == recording.first_us
    assert truth.t_us[-1] == recording.last_us
    assert np.diff(truth.t_us).max() <= 5000
    assert recording.imu is not None
    assert np.all(np.diff(recording.imu.t_us) == 1000)


def test_same_seed_same_bits_other_seed_other_events(tmp_path: Path) -> None:
    a, b, c = (make(tmp_path / f"{name}.h5", seed=seed) for name, seed in (("a", 3), ("b", 3), ("c", 4)))
    ea, eb = a.events.read(0, a.events.count), b.events.read(0, b.events.count)
    for name in ("t_us", "x_px", "y_px", "is_positive"):
        assert np.array_equal(getattr(ea, name), getattr(eb, name))
    assert a.events.count != c.events.count


def homography_to_start(recording: Recording, t_us: int, *, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Take pixels at a time to those of the first event by truth, made wrong by a turn (rad) and a shift (m)."""
    truth, K = recording.ground_truth, SMALL.matrix
    assert truth is not None and recording.plane_normal_world is not None
    assert recording.plane_distance_world is not None
    plane = Plane(normal=recording.plane_normal_world, distance=recording.plane_distance_world)
    T = truth.at(np.array([truth.t_us[0], t_us])).Ts_world_camera
    T_start, T_now = T[0], T[1] @ pose(exp_so3(turn), shift)
    H = np.linalg.inv(homography_map_camera(T_start, plane)) @ homography_map_camera(T_now, plane)
    return K @ H @ np.linalg.inv(K)


def sharpness(recording: Recording, *, turn: np.ndarray, shift: np.ndarray) -> float:
    """Variance of the image of the first 80 ms of events, each 2 ms warped as a whole by a linearly growing error."""
    end_us = recording.first_us + 80_000
    events = recording.events.read(0, recording.events.index_at(end_us))
    image = np.zeros((SMALL.height, SMALL.width))
    for t in range(recording.first_us, end_us, 2000):
        part = events[np.searchsorted(events.t_us, t) : np.searchsorted(events.t_us, t + 2000)]
        share = (t - recording.first_us) / 80_000
        H = homography_to_start(recording, t + 1000, turn=share * turn, shift=share * shift)
        p = H @ np.stack([part.x_px.astype(float), part.y_px.astype(float), np.ones(len(part))])
        x, y = np.rint(p[:2] / p[2]).astype(int)
        inside = (x >= 0) & (x < SMALL.width) & (y >= 0) & (y < SMALL.height)
        np.add.at(image, (y[inside], x[inside]), np.where(part.is_positive[inside], 1.0, -1.0))
    return float(image.var())


def test_events_are_sharpest_when_warped_by_the_truth(tmp_path: Path) -> None:
    recording = make(tmp_path / "a.h5", seed=5, seconds=0.2)
    zero = np.zeros(3)
    true = sharpness(recording, turn=zero, shift=zero)
    # 0.05 rad and 0.05 m are 4 px of this camera.
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        assert sharpness(recording, turn=0.05 * axis * (1, 1, 3), shift=zero) < 0.98 * true
        assert sharpness(recording, turn=zero, shift=0.05 * axis * (1, 1, 3)) < 0.98 * true


def test_distorted_lens_keeps_the_truth(tmp_path: Path) -> None:
    """What a distorted pixel sees is what an ideal camera sees along its bearing."""
    lens = Camera(
        width=90, height=60, fx=60.0, fy=62.0, cx=44.0, cy=31.0, distortion=(-0.3, 0.08, 1e-3, -1e-3, 0.0)
    )
    texture = PAINTERS["checkerboard"](np.random.default_rng(0), (-2.0, -2.0, 2.0, 2.0), 0.008)
    image, active = np.zeros((60, 90), np.float32), np.ones(15 * 23, bool)
    H = np.array([[1.0, 0.1, 0.05], [-0.1, 1.0, -0.02], [0.05, 0.02, 1.0]])
    PlaneView(PixelGrid.of(lens), texture).render(H, image, active)

    def agreement(bearings: np.ndarray) -> float:
        p = np.column_stack([bearings.reshape(-1, 2), np.ones(5400)]) @ H.T
        i, j = np.rint((p[:, :2] / p[:, 2:] + 2.0) / 0.008 - 0.5).astype(int).T
        return float((np.abs(image - texture.image[j, i].reshape(60, 90)) < 0.25).mean())

    ideal = Camera(width=90, height=60, fx=60.0, fy=62.0, cx=44.0, cy=31.0)
    assert agreement(lens.bearing_table()) > 0.9
    assert agreement(ideal.bearing_table()) < 0.8


def test_edge_is_rendered_where_it_projects() -> None:
    """A slanted edge is where geometry says: to two hundredths of a pixel on average, a tenth in each row."""
    bounds, texel = (-1.0, -0.8, 1.0, 0.8), 0.6 / 80
    paper = blank(bounds, texel, 0.8)
    fill_polygon(paper, [(-2, -3), (0.0, -3), (0.3, 3), (-2, 3)], 0.2, left=-1.0, top=-0.8, texel=texel)
    texture = make_texture(paper, texel=texel, left=-1.0, top=-0.8)
    view = PlaneView(PixelGrid.of(SMALL), texture)
    image, active = np.zeros((60, 90), np.float32), np.ones(15 * 23, bool)
    for scale in (0.7, 1.0, 1.7):
        # No step of a motion: a view promises its image only where the plane moved by less than half a pixel.
        view.forget()
        view.render(np.diag([scale, scale, 1.0]), image, active)
        errors = []
        for row in range(60):
            v = (row - SMALL.cy) / SMALL.fy * scale
            column = (0.15 + v * 0.05) / scale * SMALL.fx + SMALL.cx
            # The dark area of the row ends at the edge, whatever the blur.
            dark = (0.8 - image[row].astype(float)).sum() / 0.6
            errors.append(dark - 0.5 - column)
        assert abs(np.mean(errors)) < 0.02
        assert np.abs(errors).max() < 0.1


def test_blocks_left_alone_would_not_have_changed(tmp_path: Path) -> None:
    """Rendering what may have changed gives the image that rendering all gives."""
    texture = PAINTERS["shapes"](np.random.default_rng(2), (-1.5, -1.2, 1.5, 1.2), 0.6 / 80)
    grid = PixelGrid.of(SMALL)
    view, image, active = PlaneView(grid, texture), np.zeros((60, 90), np.float32), np.ones(15 * 23, bool)
    share = []
    for k in range(200):
        H = np.array([[1.0, 0.0, 0.005 * k - 0.5], [0.0, 1.0, 0.002 * k - 0.2], [0.0, 0.0, 1.0]])
        view.render(H, image, active)
        share.append(active.mean())
        whole = np.zeros_like(image)
        PlaneView(grid, texture).render(H, whole, np.ones_like(active))
        assert np.array_equal(image, whole)
    assert np.mean(share[1:]) < 0.9


@pytest.mark.parametrize("scene", ["poster", "stripes", "checkerboard"])
@pytest.mark.parametrize("motion", ["slider", "rotation", "shake"])
def test_every_scene_and_motion_makes_a_recording(tmp_path: Path, scene: SceneName, motion: MotionName) -> None:
    recording = make(tmp_path / "a.h5", scene=scene, motion=motion, seconds=0.1, frames_hz=30.0)
    assert recording.events.count > 500
    assert recording.frames is not None
    assert recording.frames.read(0).std() > 10


def test_inertial_sensor_measures_turns_and_specific_force() -> None:
    quiet = ImuModel(gyro_sigma=0, accel_sigma=0, gyro_bias_sigma=0, accel_bias_sigma=0)
    rng = np.random.default_rng(0)
    still = simulate_imu(quiet, slider(speed=0.0), 0.1, rng)
    assert np.allclose(still.gyro, 0, atol=1e-9)
    # At rest the sensor feels the table push up, which is against y.
    assert np.allclose(still.accel, [0, -9.81, 0], atol=1e-5)

    def circle(t_s: np.ndarray) -> np.ndarray:
        phi = np.zeros((len(t_s), 3))
        phi[:, 2] = 2.0 * t_s
        p = 0.5 * np.stack([np.cos(2 * t_s), np.sin(2 * t_s), 0 * t_s], axis=1)
        return pose(exp_so3(phi), p)

    imu = simulate_imu(quiet, circle, 1.0, rng)
    assert np.allclose(imu.gyro, [0, 0, 2.0], atol=1e-7)
    t = imu.t_us * 1e-6
    gravity = 9.81 * np.stack([-np.sin(2 * t), -np.cos(2 * t), 0 * t], axis=1)
    assert np.allclose(imu.accel - gravity, [-2.0, 0, 0], atol=1e-4)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"seconds": 0.0}, "seconds"),
        ({"scene": "sea"}, "scene"),
        ({"motion": "swim"}, "motion"),
        ({"tilt_deg": 90.0}, "tilt"),
    ],
)
def test_wrong_calls_say_what_was_expected(tmp_path: Path, options: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        make(tmp_path / "a.h5", **options)
    assert list(tmp_path.iterdir()) == []
