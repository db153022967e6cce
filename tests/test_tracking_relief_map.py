"""The relief map: its derivatives, its bundle adjustment, and translation before simulated scenes with depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvsviz.config import Motion, TrackerConfig
from dvsviz.evaluate.align import align_positions
from dvsviz.events.windows import windows
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.session.records import WindowResult
from dvsviz.simulate.motion import slider
from dvsviz.simulate.scenes import SceneName
from dvsviz.simulate.simulate import simulate
from dvsviz.tracking.relief_adjust import Sightings, adjust
from dvsviz.tracking.relief_kernels import associate, derivatives
from dvsviz.tracking.relief_landmarks import Landmarks
from dvsviz.tracking.relief_sweep import image_flow, sweep
from dvsviz.tracking.tracker import Tracker

CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)
FREE = np.ones(6, dtype=np.bool_)
TRANSLATION = np.array([False, False, False, True, True, True])


def random_landmarks(rng: np.random.Generator, count: int) -> Landmarks:
    """Return landmarks on the rays of a camera at the origin, at inverse depths of 0.4 to 1.6."""
    xy = np.column_stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.4, 0.4, count)])
    angle = rng.uniform(0, np.pi, count)
    n = np.column_stack([np.cos(angle), np.sin(angle)])
    one, nothing = np.ones((count, 1)), np.zeros((count, 1))
    rays = np.column_stack([np.zeros((count, 3)), xy, one, n, nothing, -n[:, 1:], n[:, :1], nothing])
    states = np.column_stack([np.zeros(count), rng.uniform(0.4, 1.6, count)])
    return Landmarks(
        rays=rays,
        states=states,
        prior_states=states,
        prior_information=np.zeros((count, 2, 2)),
        information=np.zeros((count, 2, 2)),
        sides=np.zeros(count),
        counts=np.zeros((count, 2), dtype=np.int64),
    )


def test_derivatives_of_a_landmark_are_central_differences() -> None:
    rng = np.random.default_rng(1)
    for ray, (_, rho) in zip((m := random_landmarks(rng, 20)).rays, m.states, strict=True):
        R, p = se3.exp_so3(rng.normal(0, 0.2, 3)), rng.normal(0, 0.2, 3)
        u, normal = float(rng.normal(0, 0.01)), np.array([0.6, -0.8])
        by_pose, by_state, unused = np.empty(6), np.empty(2), (np.empty(6), np.empty(2))

        def place(step: np.ndarray, ray=ray, R=R, p=p, u=u, rho=rho, normal=normal, unused=unused) -> float:
            turned = R @ se3.exp_so3(step[:3])
            return derivatives(ray, u + step[6], rho + step[7], turned, p + step[3:6], normal, 200.0, *unused)

        derivatives(ray, u, rho, R, p, normal, 200.0, by_pose, by_state)
        h = 1e-5
        numeric = [(place(h * e) - place(-h * e)) / (2 * h) for e in np.eye(8)]
        np.testing.assert_allclose(np.r_[by_pose, by_state], numeric, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("free", [TRANSLATION, FREE], ids=["translation", "6-dof"])
def test_adjustment_finds_poses_and_inverse_depths_of_noise_free_sightings(free: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    truth = random_landmarks(rng, 300)
    turns = np.where(free[0], rng.normal(0, 0.03, (5, 3)), 0.0)
    Ts = se3.pose(se3.exp_so3(turns), rng.normal(0, 0.1, (5, 3)))
    Ts[0] = np.eye(4)
    seen = [truth.seen_from(T) for T in Ts]
    sightings = Sightings(
        landmark=np.tile(np.arange(300), 5),
        view=np.repeat(np.arange(5), 300),
        normal=np.concatenate([s[:, 2:4] for s in seen]),
        place_px=np.concatenate([200.0 * (s[:, :2] * s[:, 2:4]).sum(axis=1) for s in seen]),
        weight=np.ones(1500),
    )
    start = truth.states * [1.0, 1.0] + np.column_stack([np.zeros(300), rng.normal(0, 0.05, 300)])
    first = Ts.copy()
    first[1:, :3, 3] += rng.normal(0, 0.01, (4, 3))
    if free[0]:
        first[1:, :3, :3] = first[1:, :3, :3] @ se3.exp_so3(rng.normal(0, 0.01, (4, 3)))
    # The scale is what the prior says of one landmark.
    known = np.tile(np.diag([1e-6, 1e-9]), (300, 1, 1))
    known[0] = np.diag([1e6, 1e9])
    held = np.array([True, False, False, False, False])
    found, states, information = adjust(
        truth.rays, start, truth.states, known, first, held, free, sightings, 200.0, rounds=15, scale_px=10.0
    )  # fmt: skip
    np.testing.assert_allclose(found, Ts, atol=2e-4)
    well = information[:, 1, 1] > np.median(information[:, 1, 1])
    np.testing.assert_allclose(states[well, 1], truth.states[well, 1], atol=2e-3)


def test_events_belong_to_the_nearest_line_of_their_polarity() -> None:
    # Two upright lines, 2 px apart, that move to the left: the left one is positive, the right one negative.
    bounds = np.array([0.0, 0.01])
    xs = np.array([[0.0, 0.01], [-0.02, -0.01]])
    seen = np.stack([xs, np.zeros((2, 2)), np.ones((2, 2)), np.zeros((2, 2)), np.ones((2, 2))], axis=-1)
    bearings = np.array([[-0.006, 0.0], [-0.006, 0.0], [0.3, 0.0]], dtype=np.float32)
    owner, residual = np.full(3, -1, np.int32), np.zeros(3)
    associate(
        bearings, np.full(3, 0.005), np.array([True, False, True]), bounds, seen, np.array([-1.0, 1.0]),
        CAMERA.matrix, np.array([240, 180]), 6.0, 2.5, 1.5, owner, residual,
    )  # fmt: skip
    assert owner.tolist() == [0, 1, -1]
    np.testing.assert_allclose(residual[:2], [0.8, -1.2], atol=1e-5)


def test_sweep_finds_the_inverse_depths_of_two_halves() -> None:
    rng = np.random.default_rng(3)
    velocity, omega = np.array([0.4, 0.1, 0.05]), np.array([0.0, 0.0, 0.2])
    points = np.column_stack([rng.uniform(-0.6, 0.6, 600), rng.uniform(-0.45, 0.45, 600)])
    rho = np.where(points[:, 0] < 0, 0.5, 1.5)
    which = rng.integers(0, 600, 12_000)
    t_s = np.sort(rng.uniform(-0.03, 0.03, 12_000))
    flow = image_flow(points, rho, omega, velocity)
    bearings = (points[which] + flow[which] * t_s[:, None]).astype(np.float32)
    sign = rng.random(600) < 0.5
    swept, clear = sweep(bearings, t_s, sign[which], CAMERA, omega, velocity, np.geomspace(0.25, 4.0, 24))
    for side, expected in ((slice(3, 15), 0.5), (slice(-15, -3), 1.5)):
        told = clear[5:-5, side] > 0.2
        assert told.mean() > 0.7
        assert np.median(swept[5:-5, side][told]) == pytest.approx(expected, rel=0.05)


def tracked(path: Path, motion: Motion) -> tuple[list[WindowResult], Tracker]:
    """Track a recording and return the results, with the poses as they are known at the end."""
    recording = open_recording(path)
    tracker = Tracker(recording.camera, TrackerConfig(motion=motion))
    return [tracker.step(w) for w in windows(recording, lambda: tracker.window_size)], tracker


@pytest.fixture(scope="module")
def slide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a slide before four walls at 0.8 to 2.5 m."""
    out = tmp_path_factory.mktemp("relief") / "slide.h5"
    simulate(out, scene="planes", motion=slider(speed=0.3, start=-0.3), seconds=2.0, seed=7)
    return out


@pytest.mark.parametrize("motion", ["translation", "auto", "planar"])
def test_a_slide_before_several_planes_keeps_its_scale(slide: Path, motion: Motion) -> None:
    results, tracker = tracked(slide, motion)
    assert any("the scene is not a plane" in r.note for r in results)
    refined = tracker.finish().refined[-1]
    truth = open_recording(slide).ground_truth
    assert truth is not None
    t_us = np.array([results[k].start_us for k in refined.windows])
    inside = (t_us >= truth.t_us[0]) & (t_us <= truth.t_us[-1])
    p, q = refined.Ts_world_camera[inside, :3, 3], truth.at(t_us[inside]).positions
    fit = align_positions(p, q, "sim3")
    off = fit.scale * p @ fit.R_truth_world.T + fit.t_truth_world - q
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.015 * 0.6
    # The scale does not drift: first and second half of the way are as long as they were.
    half = len(p) // 2
    ways = [np.linalg.norm(x[b] - x[a]) for x in (p, q) for a, b in ((2, half), (half, -1))]
    assert ways[0] / ways[1] == pytest.approx(ways[2] / ways[3], rel=0.08)


@pytest.mark.parametrize("at", [8, 30])
def test_a_checkpoint_goes_on_with_the_same_bits(slide: Path, at: int) -> None:
    recording = open_recording(slide)
    config = TrackerConfig(motion="translation")
    first = Tracker(recording.camera, config)
    poses, second = [], None
    for k, window in enumerate(windows(recording, lambda: first.window_size)):
        if k == at:
            state = {name: value.copy() for name, value in first.checkpoint().items()}
            second = Tracker.restore(recording.camera, config, state, recording.events)
        result = first.step(window)
        if second is not None:
            again = second.step(window)
            np.testing.assert_array_equal(again.T_world_camera, result.T_world_camera)
            assert second.window_size == first.window_size and again.note == result.note
        poses.append(result)
        if k == at + 14:
            break
    assert second is not None
    assert any("not a plane" in r.note for r in poses)


@pytest.mark.parametrize(("scene", "seed"), [("shapes", 5), ("poster", 6)])
def test_a_plane_stays_one(tmp_path: Path, scene: SceneName, seed: int) -> None:
    simulate(
        tmp_path / "wall.h5",
        scene=scene,
        motion=slider(speed=0.3, start=-0.2),
        seconds=1.3,
        seed=seed,
        tilt_deg=30.0,
    )
    motions: tuple[Motion, ...] = ("translation", "auto", "planar")
    for motion in motions:
        results, _ = tracked(tmp_path / "wall.h5", motion)
        assert not any("not a plane" in r.note for r in results)


def test_slider_depth_is_tracked_in_each_motion(data_dir: Path) -> None:
    path = data_dir / "ecd" / "slider_depth.zip"
    truth = open_recording(path).ground_truth
    assert truth is not None
    motions: tuple[Motion, ...] = ("auto", "planar")
    for motion in motions:
        results, tracker = tracked(path, motion)
        refined = tracker.finish().refined[-1]
        t_us = np.array([results[k].start_us for k in refined.windows])
        inside = (t_us >= truth.t_us[0]) & (t_us <= truth.t_us[-1])
        p, q = refined.Ts_world_camera[inside, :3, 3], truth.at(t_us[inside]).positions
        axis = (p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0])
        assert np.degrees(np.arccos(axis[0])) < 5.0
        along, true = (p - p[0]) @ axis, q[:, 0] - q[0, 0]
        scale = true[-1] / along[-1]
        np.testing.assert_allclose(scale * along, true, atol=0.03)
