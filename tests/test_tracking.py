"""The tracker on recordings with known truth, and its parts against obvious references."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.contrast.warp import map_warp
from dvsviz.evaluate.evaluate import evaluate
from dvsviz.events.events import Events
from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, make_window, windows
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import (
    Plane,
    homography_map_camera,
    map_to_world,
    rotation_to_map,
    turn_normal,
    turn_normal_derivative,
)
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.records import Failure, Status, WindowResult
from dvsviz.simulate.simulate import simulate
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import align, free_parameters
from dvsviz.tracking.diagnose import in_words, weakest
from dvsviz.tracking.kernels import map_nodes
from dvsviz.tracking.measure import measure
from dvsviz.tracking.normal_equations import banded_cholesky, landmark_jacobians, solve_views
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.refine import View, refine
from dvsviz.tracking.refining import Revised
from dvsviz.tracking.relocalize import relocalize
from dvsviz.tracking.sampling import view_rays
from dvsviz.tracking.smooth_motion import SmoothMotion
from dvsviz.tracking.traces import Trace
from dvsviz.tracking.tracker import Tracker
from dvsviz.tracking.translation import deviation_from_plane

TILTED = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)
ALL = free_parameters("planar")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Three seconds of shapes, hand-held."""
    path = tmp_path_factory.mktemp("tracking") / "shapes.h5"
    simulate(path, scene="shapes", motion="handheld", seconds=3.0, seed=5)
    return open_recording(path)


def run(
    recording: Recording, config: TrackerConfig | None = None
) -> tuple[Tracker, list[WindowResult], np.ndarray]:
    """Track everything; return the tracker, the results and the refined poses (N, 4, 4)."""
    tracker = Tracker(recording.camera, config)
    results, refined = [], []
    for window in windows(recording, lambda: tracker.window_size):
        results.append(tracker.step(window))
        refined.extend(tracker.take_updates().refined)
    refined.extend(tracker.finish().refined)
    poses = np.stack([r.T_world_camera for r in results])
    for landing in refined:
        poses[landing.windows] = landing.Ts_world_camera
    return tracker, results, poses


@pytest.fixture(scope="module")
def tracked(recording: Recording) -> tuple[Tracker, list[WindowResult], np.ndarray]:
    return run(recording)


def test_follows_a_hand_held_camera(recording: Recording, tracked: tuple) -> None:
    """No window lost, the refined poses within 1 % of the plane distance and 0.6 degrees of a truth never seen."""
    _, results, poses = tracked
    assert len(results) > 20
    assert not {r.status for r in results} & {Status.LOST, Status.RELOCALIZING}
    assert results[-1].status is Status.TRACKING
    estimate = Trajectory(t_us=np.array([r.start_us for r in results]), Ts_world_camera=poses)
    truth = recording.ground_truth
    assert truth is not None
    assert recording.mean_plane_distance is not None
    found = evaluate(estimate, truth)
    assert found.position_rmse_m is not None
    assert 100 * found.position_rmse_m / recording.mean_plane_distance < 1.0
    assert found.rotation_rmse_deg < 0.6
    # The plane's normal, seen from the first camera.
    T = truth.at(np.array([results[0].start_us])).Ts_world_camera[0]
    assert recording.plane_normal_world is not None
    wanted = T[:3, :3].T @ recording.plane_normal_world
    assert np.degrees(np.arccos(wanted @ results[-1].normal_world)) < 3.0


def test_first_pose_is_the_identity_and_results_are_whole(tracked: tuple) -> None:
    _, results, _ = tracked
    assert np.allclose(results[0].T_world_camera, np.eye(4), atol=1e-9)
    for k, r in enumerate(results):
        assert r.window == k
        assert np.isfinite(r.T_world_camera).all()
        assert np.linalg.norm(r.normal_world) == pytest.approx(1.0)
        assert r.end_event > r.first_event
        if k:
            assert r.first_event == results[k - 1].end_event
            assert 0 <= r.confidence <= 1


def test_same_input_same_bits(recording: Recording, tracked: tuple) -> None:
    _, first, first_poses = tracked
    _, second, second_poses = run(recording)
    assert [r.end_event for r in first] == [r.end_event for r in second]
    assert np.array_equal(first_poses, second_poses)


def test_checkpoint_goes_on_with_the_same_results(recording: Recording) -> None:
    config = TrackerConfig(window=6000)
    whole = Tracker(recording.camera, config)
    cut: dict[str, np.ndarray] = {}
    wanted: list[WindowResult] = []
    for window in windows(recording, 6000):
        wanted.append(whole.step(window))
        if window.index == 14:
            cut = whole.checkpoint()
    resumed = Tracker.restore(recording.camera, config, cut, recording.events)
    start = wanted[15].first_event
    for window in windows(recording, 6000, first_event=start, index=15):
        again = resumed.step(window)
        assert np.array_equal(again.T_world_camera, wanted[window.index].T_world_camera)
        assert again.status is wanted[window.index].status


def test_a_checkpoint_of_another_version_is_refused(recording: Recording) -> None:
    tracker = Tracker(recording.camera)
    state = tracker.checkpoint()
    with pytest.raises(ValueError, match="version"):
        Tracker.restore(recording.camera, TrackerConfig(), state | {"version": np.array([99])}, recording.events)
    del state["omega"]
    with pytest.raises(ValueError, match="omega"):
        Tracker.restore(recording.camera, TrackerConfig(), state, recording.events)


def test_finds_the_way_back(recording: Recording, tracked: tuple) -> None:
    """A window taken from the middle, from a blank prior: within 5 % and 3 degrees of where it was."""
    tracker, _, _ = tracked
    mapper = tracker._mapper
    hits = 0
    tried = mapper.traces[10::12]
    for trace in tried:
        keyframes = [t.T_world_camera for t in mapper.traces if t.keyframe >= 0 and t.window != trace.window]
        found = relocalize(mapper.live_map, recording.camera, trace.deskewed(mapper.plane), keyframes, free=ALL)
        assert found is not None
        delta = se3.inverse(found.T_world_camera) @ trace.T_world_camera
        near = np.linalg.norm(delta[:3, 3]) < 0.05 and np.degrees(se3.rotation_angle(delta[:3, :3])) < 3
        hits += int(near)
    assert hits >= len(tried) - 1


def test_covered_lens_is_lost_and_found_without_polluting_the_map(tmp_path: Path) -> None:
    path = tmp_path / "shapes.h5"
    simulate(path, scene="shapes", motion="handheld", seconds=2.2, seed=8)
    recording = open_recording(path)
    tracker = Tracker(recording.camera)
    rng = np.random.default_rng(0)
    states: list[Status] = []
    failures: list[Failure] = []
    votes_lost: list[float] = []
    for window in windows(recording, lambda: tracker.window_size):
        covered = 1.3 < (window.start_us - recording.first_us) * 1e-6 < 1.6
        if covered:
            # The texture is gone: the same number of events, anywhere.
            b = rng.uniform((-0.55, -0.4), (0.55, 0.4), window.bearings.shape).astype(np.float32)
            window = EventWindow(
                index=window.index,
                first_event=window.first_event,
                start_us=window.start_us,
                end_us=window.end_us,
                events=window.events,
                bearings=b,
            )
        states.append(tracker.step(window).status)
        failures.extend(tracker.take_updates().failures)
        if states[-1] is Status.LOST:
            votes_lost.append(float(tracker._mapper.live_map.votes.sum()))
    tracker.finish()
    failures.extend(tracker.take_updates().failures)
    assert Status.LOST in states
    lost = [f for f in failures if states[f.start : f.end].count(Status.LOST)]
    assert len(lost) == 1
    assert states[lost[0].end] in (Status.TRACKING, Status.WEAK)
    assert lost[0].start <= lost[0].worst < lost[0].end
    assert lost[0].message
    assert states[-1] in (Status.TRACKING, Status.WEAK)
    assert len(set(votes_lost)) == 1, "the map was written while lost"


def test_a_stream_waits_for_no_refinement(recording: Recording) -> None:
    tracker = Tracker(recording.camera)
    tracker.hurry()
    mapper = tracker._mapper
    pending: Future[Revised] = Future()
    stream = windows(recording, lambda: tracker.window_size, max_duration_us=100_000)
    for window in stream:
        tracker.step(window)
        if mapper.job is not None and mapper.job.future is not pending:
            # From now on it takes for ever.
            due, mapper.job = mapper.job, replace(mapper.job, future=pending)
            land_at, began = mapper.job.land_at, window.index
        if mapper.job is not None and window.index >= max(land_at, began) + 5:
            break
    assert mapper.job is not None and mapper.refinements == 0
    pending.set_result(due.future.result())
    tracker.step(next(iter(stream)))
    assert mapper.job is None and mapper.refinements == 1


def test_larger_windows_stay_larger_while_a_stream_is_behind(recording: Recording) -> None:
    sizes = {}
    for stretch in (1.0, 2.0):
        tracker = Tracker(recording.camera)
        tracker.stretch = stretch
        counts = [
            len(window)
            for window in windows(recording, lambda tracker=tracker: tracker.window_size, max_duration_us=200_000)
            if tracker.step(window).status is Status.TRACKING
        ]
        sizes[stretch] = np.median(counts)
    assert 1.5 * sizes[1.0] < sizes[2.0] < 2.5 * sizes[1.0]


def test_roll_of_a_real_disk(data_dir: Path, tmp_path: Path) -> None:
    """gyro/rotdisk in rotation mode: total roll within 1.5 degrees of the gyro's 92.7, never lost."""
    calibration = tmp_path / "calib.txt"
    calibration.write_text("243 243 119.5 89.5 0 0 0 0 0\n")
    recording = open_recording(data_dir / "gyro" / "rotdisk_events.npz", size=(240, 180), calibration=calibration)
    _, results, poses = run(recording, TrackerConfig(motion="rotation"))
    assert not {r.status for r in results} & {Status.LOST, Status.RELOCALIZING}
    roll = se3.log_so3(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])[:, 2].sum()
    # The camera's rate about its optical axis is minus the recorded one.
    assert abs(np.degrees(roll)) == pytest.approx(92.7, abs=1.5)


def test_windows_of_two_sizes_agree_on_a_real_wall(data_dir: Path) -> None:
    recording = open_recording(data_dir / "ecd" / "shapes_start")
    ends = []
    for size in (1000, 2000):
        _, results, poses = run(recording, TrackerConfig(window=size))
        assert not {r.status for r in results} & {Status.LOST, Status.RELOCALIZING}
        ends.append(Trajectory(t_us=np.array([r.start_us for r in results]), Ts_world_camera=poses))
    last = np.array([min(int(e.t_us[-1]) for e in ends)])
    a, b = (e.at(last).Ts_world_camera[0] for e in ends)
    assert np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.005
    assert np.degrees(se3.rotation_angle(a[:3, :3].T @ b[:3, :3])) < 0.5


# --- parts -----------------------------------------------------------------------------------------------------


def test_map_nodes_equal_the_reference_warp() -> None:
    T = se3.pose(se3.exp_so3([0.1, 0.2, -0.3]), [0.1, -0.2, 0.3])
    omega, velocity = np.array([0.4, -0.6, 1.0]), np.array([0.5, -0.3, 0.4])
    target = np.array([[200.0, 0, 50], [0, 200, 60], [0, 0, 1]])
    plane = Plane(normal=TILTED, distance=1.1)
    wanted = map_warp(T, omega, velocity, plane, -0.02, 0.05, target)
    m = len(wanted.nodes)
    nodes = np.empty((m, 3, 3))
    projection = target @ (rotation_to_map(TILTED) / np.array([[1.0], [1.0], [1.1]]))
    map_nodes(T[:3, :3].copy(), T[:3, 3].copy(), omega, velocity, TILTED, 1.1, projection, -0.02, 0.05, nodes)
    assert np.abs(nodes - wanted.nodes).max() < 1e-11


def test_landmark_jacobians_against_central_differences() -> None:
    rng = np.random.default_rng(5)
    T = se3.pose(se3.exp_so3([0.1, 0.2, -0.3]), [0.1, -0.2, 0.3])
    plane, scale = Plane(normal=TILTED, distance=1.1), 200.0
    bearings, angle = rng.uniform(-0.4, 0.4, (7, 2)), rng.uniform(0, np.pi, 7)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    R_map_world = rotation_to_map(TILTED)

    def along(x: np.ndarray) -> np.ndarray:
        moved = se3.pose(se3.exp_so3(x[:3]) @ T[:3, :3], T[:3, 3] + x[3:6])
        n = turn_normal(TILTED, x[6:])
        y = np.column_stack([bearings, np.ones(7)]) @ moved[:3, :3].T
        p = ((1.1 + moved[:3, 3] @ n) * y - np.outer(y @ n, moved[:3, 3])) @ R_map_world.T
        return scale * 1.1 * (normals * p[:, :2]).sum(axis=1) / p[:, 2]

    J = np.empty((7, 8))
    landmark_jacobians(
        bearings, np.ones(7, dtype=np.int64), np.stack([np.eye(3), T[:3, :3]]), np.stack([np.zeros(3), T[:3, 3]]),
        TILTED, plane.distance, R_map_world, scale, normals,
        turn_normal_derivative(TILTED, np.zeros(2)), J,
    )  # fmt: skip
    numeric = np.stack([(along(h) - along(-h)) / 2e-6 for h in 1e-6 * np.eye(8)], axis=-1)
    assert np.abs(J - numeric).max() < 1e-5 * np.abs(numeric).max()


def grid_points() -> np.ndarray:
    """Points (N, 2) on the plane, dense along the lines of an irregular figure."""
    rng = np.random.default_rng(3)
    corners = rng.uniform((-0.6, -0.45), (0.6, 0.45), (24, 2, 2))
    s = np.linspace(0, 1, 900)[:, None]
    return np.concatenate([a + s * (b - a) for a, b in corners])


def seen(points_map: np.ndarray, T: np.ndarray, plane: Plane) -> np.ndarray:
    """Bearings (M, 2) of the plane points that lie in view."""
    p = (map_to_world(points_map, plane) - T[:3, 3]) @ T[:3, :3]
    b = p[:, :2] / p[:, 2:]
    return b[(p[:, 2] > 0) & (np.abs(b) < (0.58, 0.43)).all(axis=1)]


def edge_pixels(camera: Camera, window: EventWindow) -> int:
    """How many pixels of a window's image hold an edge, without motion: what a lost tracker looks for by."""
    trace = Trace(
        window=window.index, first_event=0, start_us=window.start_us, mid_us=window.start_us,
        duration_s=window.duration_s, T_world_camera=np.eye(4), omega=np.zeros(3), velocity=np.zeros(3),
        bearings=window.bearings, t_s=window.t_s, events=len(window),
    )  # fmt: skip
    return measure(camera, Plane(normal=np.array([0.0, 0.0, -1.0])), window, trace).edge_pixels


def test_noise_is_no_place_to_come_back_to(recording: Recording) -> None:
    tracker = Tracker(recording.camera)
    last = None
    for window in windows(recording, lambda: tracker.window_size):
        last = tracker.step(window)
        if last.window == 40:
            break
    assert last is not None
    assert last.status in (Status.TRACKING, Status.WEAK)
    rng = np.random.default_rng(0)
    for index in range(41, 60):
        start_us = last.end_us + (index - 41) * 100_000
        noise = Events(
            t_us=start_us + np.sort(rng.integers(0, 100_000, 480)),
            x_px=rng.integers(0, 240, 480).astype(np.uint16),
            y_px=rng.integers(0, 180, 480).astype(np.uint16),
            is_positive=rng.random(480) < 0.5,
        )
        covered = make_window(recording.camera, noise, index=index, end_us=start_us + 100_000)
        assert (
            edge_pixels(recording.camera, covered) < c.STRIPES_EDGE_PIXELS < edge_pixels(recording.camera, window)
        )
        result = tracker.step(covered)
        assert "relocalized" not in result.note
    assert result.status is Status.LOST


def test_alignment_recovers_a_displaced_pose() -> None:
    plane = Plane(normal=TILTED)
    points = grid_points()
    planar_map = PlanarMap(plane, 200.0, np.array([-0.9, -0.7]), (300, 380), freeze_px=np.inf)
    view = homography_map_camera(np.eye(4), plane)
    planar_map.add(points.astype(np.float32), view, view, (180, 240), CAMERA.matrix)
    # Swept evenly: every line is as bright as the next.
    planar_map.exposure[:] = 1.0
    truth = se3.pose(se3.exp_so3([0.03, -0.02, 0.05]), [0.05, -0.03, 0.04])
    bearings = seen(points, truth, plane).astype(np.float32)
    bearings.setflags(write=False)
    t_s = np.linspace(-1e-3, 1e-3, len(bearings))
    wide = np.diag([0.2**-2] * 6)
    found = align(
        planar_map,
        bearings,
        t_s,
        se3.pose(se3.exp_so3([0.03, -0.02, 0.03]), [0.05, -0.04, 0.04]),
        np.zeros(3),
        np.zeros(3),
        focal_px=200.0,
        free=ALL,
        prior=wide,
        iterations=(10, 10, 15),
    )
    # Judged by where the image falls: turning about y and moving along x hardly move it against each other.
    p = (map_to_world(points, plane) - found.T_world_camera[:3, 3]) @ found.T_world_camera[:3, :3]
    q = (map_to_world(points, plane) - truth[:3, 3]) @ truth[:3, :3]
    off_px = 200.0 * np.linalg.norm(p[:, :2] / p[:, 2:] - q[:, :2] / q[:, 2:], axis=1)
    in_view = (np.abs(q[:, :2] / q[:, 2:]) < (0.58, 0.43)).all(axis=1)
    assert np.sqrt((off_px[in_view] ** 2).mean()) < 0.5
    assert found.value > 0.7
    still = align(
        planar_map,
        bearings,
        t_s,
        truth,
        np.zeros(3),
        np.zeros(3),
        focal_px=200.0,
        free=free_parameters("translation"),
    )
    assert np.array_equal(still.T_world_camera[:3, :3], truth[:3, :3])


def test_noise_before_a_young_map_does_not_draw_the_camera_nearer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rings that are denser in the middle: by chance alone, events lie on more of the map the nearer the camera is."""
    plane = Plane(normal=np.array([0.0, 0.0, -1.0]))
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, (12, 3000)), np.linspace(0.05, 0.6, 12)[:, None]
    points = np.column_stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()])
    planar_map = PlanarMap(plane, 200.0, np.array([-0.9, -0.7]), (300, 380), freeze_px=np.inf)
    view = homography_map_camera(np.eye(4), plane)
    planar_map.add(points.astype(np.float32), view, view, (180, 240), CAMERA.matrix)
    planar_map.exposure[:] = 1.0
    noise = rng.uniform((-0.6, -0.45), (0.6, 0.45), (2000, 2)).astype(np.float32)

    def nearer(rays: np.ndarray | None) -> float:
        found = align(
            planar_map,
            noise,
            np.linspace(-1e-3, 1e-3, len(noise)),
            np.eye(4),
            np.zeros(3),
            np.zeros(3),
            focal_px=200.0,
            free=ALL,
            prior=np.diag([0.05**-2] * 6),
            view=rays,
        )
        return float(found.T_world_camera[2, 3])

    free_flight = nearer(None)
    assert free_flight > 0.2
    assert nearer(view_rays(CAMERA)) < free_flight - 0.01
    monkeypatch.setattr(c, "CHANCE_SHARE", 1.0)
    assert abs(nearer(view_rays(CAMERA))) < 0.5 * free_flight
    # A map that is written no more is not flown into: nothing is taken off.
    planar_map.freeze_px = 0.5
    assert nearer(view_rays(CAMERA)) == free_flight


def test_refinement_recovers_poses_and_tilt() -> None:
    """Ten views with pose errors of a few per cent and a plane 10 degrees off: brought to 0.3 %, tilt to 1 degree."""
    rng = np.random.default_rng(0)
    normal = np.array([0.17, 0.05, -1.0])
    plane = Plane(normal=normal / np.linalg.norm(normal))
    points = grid_points()
    truths = [
        se3.pose(se3.exp_so3(rng.normal(0, 0.06, 3)), rng.normal(0, 0.12, 3)) if k else np.eye(4) for k in range(10)
    ]
    views = []
    for k, T in enumerate(truths):
        b = seen(points, T, plane)
        noisy = b + rng.normal(0, 0.4 / 200, b.shape)
        start = T @ se3.pose(se3.exp_so3(rng.normal(0, 0.006, 3)), rng.normal(0, 0.006, 3)) if k else T
        views.append(View(bearings=np.repeat(noisy, 2, axis=0), T_world_camera=start))
    result = refine(views, Plane(normal=np.array([0.0, 0.0, -1.0])), 200.0, free=ALL)
    assert result.accepted
    assert np.degrees(np.arccos(min(1.0, result.plane.normal @ plane.normal))) < 1.0
    t = np.arange(10, dtype=np.int64)
    found = evaluate(
        Trajectory(t_us=t, Ts_world_camera=result.Ts_world_camera),
        Trajectory(t_us=t, Ts_world_camera=np.stack(truths)),
    )
    assert found.position_rmse_m is not None
    assert found.position_rmse_m < 0.003
    assert found.rotation_rmse_deg < 0.3


def test_map_grows_and_stays_bounded() -> None:
    planar_map = PlanarMap(
        Plane(normal=np.array([0.0, 0.0, -1.0])), 200.0, np.zeros(2), (180, 240), freeze_px=np.inf
    )
    planar_map.votes[10, 20] = 3.0
    before = planar_map.origin + np.array([20, 10]) / 200.0
    assert planar_map.cover(np.array([-1.0, -0.5]), np.array([2.0, 1.0]))
    row, col = np.unravel_index(int(planar_map.votes.argmax()), planar_map.votes.shape)
    assert np.allclose(planar_map.origin + np.array([col, row]) / 200.0, before)
    assert not planar_map.cover(np.array([-1e6, 0.0]), np.array([1e6, 1.0]))
    assert not planar_map.cover(np.array([np.nan, 0.0]), np.array([1.0, 1.0]))
    assert planar_map.votes.size <= c.MAP_MAX_CELLS


def test_frozen_cells_are_not_written() -> None:
    planar_map = PlanarMap(Plane(normal=np.array([0.0, 0.0, -1.0])), 200.0, np.zeros(2), (160, 240), freeze_px=50.0)
    planar_map.exposure[:] = 60.0
    planar_map.exposure[0, 0] = 1.0
    points = np.array([[4.0, 4.0], [100.0, 100.0]]) / 200.0
    view = homography_map_camera(np.eye(4), planar_map.plane)
    planar_map.add(points, view, view, (180, 240), CAMERA.matrix)
    assert planar_map.votes[4, 4] == 1.0
    assert planar_map.votes.sum() == 1.0


def test_banded_cholesky() -> None:
    rng = np.random.default_rng(0)
    L = np.tril(np.triu(rng.normal(size=(30, 30)), -4)) + 6 * np.eye(30)
    band = np.stack([np.concatenate([np.zeros(d), np.diagonal(L @ L.T, -d)]) for d in range(5)], axis=-1)
    banded_cholesky(band)
    for d in range(5):
        assert np.allclose(band[d:, d], np.diagonal(L, -d))


def test_views_are_solved_as_by_the_whole_matrix() -> None:
    """Poses, normal and landmark offsets solved together, densely: the same step of poses and normal."""
    rng = np.random.default_rng(1)
    views, landmarks = 7, 60
    sees = rng.random((landmarks, views)) < 0.5
    landmark, view = np.nonzero(sees)
    first = np.searchsorted(landmark, np.arange(landmarks + 1))
    m, size = len(view), 6 * views + 2
    weight, residual, J = rng.uniform(1, 8, m), rng.normal(size=m), rng.normal(size=(m, 8))
    Ts = np.stack([se3.pose(se3.exp_so3(x[:3]), x[3:]) for x in rng.normal(0, 0.1, (views, 6))])
    motion = SmoothMotion.between(np.array([0.0, 0.1, 0.15, 0.3, 0.9, 1.0, 1.1]), Ts)
    # None across the gap.
    assert motion.middle.tolist() == [1, 2, 5]
    prior = rng.uniform(0.5, 2, size)
    is_free = np.arange(size) >= 6
    whole = np.zeros((size + landmarks, size + landmarks))
    g = np.zeros(size + landmarks)
    for k in range(m):
        row = np.zeros(size + landmarks)
        row[6 * view[k] : 6 * view[k] + 6], row[size - 2 : size], row[size + landmark[k]] = J[k, :6], J[k, 6:], -1.0
        whole += weight[k] * np.outer(row, row)
        g += weight[k] * residual[k] * row
    for k, middle in enumerate(motion.middle):
        for q in range(6):
            row = np.zeros(size + landmarks)
            row[6 * (middle - 1) + q : 6 * (middle + 2) + q : 6] = motion.tie[k]
            whole += motion.information[k, q] * np.outer(row, row)
    whole[np.diag_indices(size)] += prior
    gradient = np.concatenate([motion.gradient(Ts), [0.3, -0.2]])
    g[:size] += gradient
    live = np.concatenate([is_free, sees.any(axis=1)])
    wanted = -np.linalg.solve(whole[np.ix_(live, live)], g[live])[: size - 6]
    found = solve_views(
        first, view, weight, residual, J, prior, gradient, motion.middle, motion.tie, motion.information, is_free,
        500, 1e-12,
    )  # fmt: skip
    assert np.all(found[:6] == 0)
    assert np.abs(found[6:] - wanted).max() < 1e-8 * np.abs(wanted).max()


def test_smooth_motion_against_central_differences() -> None:
    rng = np.random.default_rng(2)
    t_s = np.cumsum(rng.uniform(0.02, 0.05, 12))
    # Steps of a hand: the changes are linear in the poses up to second order in the turn between two of them.
    Ts = np.stack([se3.pose(se3.exp_so3(x[:3]), x[3:]) for x in np.cumsum(rng.normal(0, 1e-3, (12, 6)), axis=0)])
    motion = SmoothMotion.between(t_s, Ts)
    assert len(motion.middle) == 10

    def cost(x: np.ndarray) -> float:
        moved = x.reshape(-1, 6)
        turned = se3.pose(se3.exp_so3(moved[:, :3]) @ Ts[:, :3, :3], Ts[:, :3, 3] + moved[:, 3:])
        return 0.5 * float((motion.information * motion.changes(turned) ** 2).sum())

    numeric = np.array([(cost(h) - cost(-h)) / 2e-6 for h in 1e-6 * np.eye(72)])
    assert np.abs(motion.gradient(Ts) - numeric).max() < 5e-3 * np.abs(numeric).max()


def test_weak_direction_in_words() -> None:
    information = np.diag([1e4, 1e4, 1e4, 1e4, 1e4, 1e4])
    # Motion along x and rotation about y cancel.
    v = np.array([0, 1, 0, 1, 0, 0]) / np.sqrt(2)
    information -= 0.9999 * 1e4 * np.outer(v, v)
    condition, direction = weakest(information, ALL)
    assert condition == pytest.approx(1e4, rel=1e-3)
    words = in_words(direction)
    assert "motion along x" in words
    assert "rotation about y" in words
    assert "motion along y" not in words


def test_deviation_from_plane() -> None:
    y, x = np.indices((5, 7))
    assert deviation_from_plane(np.log(1 + 0.05 * x - 0.02 * y)) < 1e-12
    assert deviation_from_plane(np.log(np.where(x > 3, 1.4, 0.7))) > 0.1
