"""Mode `contrast`: derivatives of the keyframes' joint contrast, its parts on known answers, and a whole run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dvsviz.config import Objective, TrackerConfig
from dvsviz.contrast.joint import (
    KeyframeEvents,
    canvas_of,
    common_image,
    joint_contrast,
    maximize_joint_contrast,
)
from dvsviz.contrast.objectives import ObjectiveName, objective
from dvsviz.contrast.solve import ContrastProblem, maximize_contrast
from dvsviz.contrast.warp import keyframe_warp
from dvsviz.events.events import Events
from dvsviz.events.recording import MemoryEvents, Recording
from dvsviz.events.windows import windows
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import (
    Plane,
    homography_map_camera,
    map_to_world,
    rotation_to_map,
    rotation_to_map_derivative,
    turn_normal,
    turn_normal_derivative,
)
from dvsviz.session.records import Status
from dvsviz.tracking import constants as c
from dvsviz.tracking.tracker import Tracker

# The project's choice: see `contrast.joint`.
AREA_POWER = 0.5
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


# --- every gradient against central differences of a slow float64 version -----------------------------------------

SMALL = Camera(width=48, height=32, fx=40.0, fy=42.0, cx=23.0, cy=16.5)


def slow_vote(image: NDArray[np.float64], q: NDArray[np.float64], weight: float = 1.0) -> None:
    """Vote homogeneous points (N, 3) bilinearly, in float64."""
    x, y = q[:, 0] / q[:, 2], q[:, 1] / q[:, 2]
    c, r = x.astype(int), y.astype(int)
    fx, fy = x - c, y - r
    for dr, dc, share in (
        (0, 0, (1 - fy) * (1 - fx)),
        (0, 1, (1 - fy) * fx),
        (1, 0, fy * (1 - fx)),
        (1, 1, fy * fx),
    ):
        np.add.at(image, (r + dr, c + dc), weight * share)


def slow_objective(name: ObjectiveName, image: NDArray[np.float64], blur: float) -> float:
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_CONSTANT), dtype=np.float64)
    if name == "variance":
        return float(((image - image.mean()) ** 2).mean())
    if name == "gradient":
        x, y = 0.5 * (image[:, 2:] - image[:, :-2]), 0.5 * (image[2:] - image[:-2])
        return float(((x**2).sum() + (y**2).sum()) / image.size)
    if name == "highpass":
        wide = np.pad(image, 1)
        around = sum(wide[a : a + image.shape[0], b : b + image.shape[1]] for a in range(3) for b in range(3))
        return float(((9 * image - around) ** 2).mean())
    return float((image.max() - image.min()) / (image.max() + image.min()))


def central(f: Callable[[NDArray[np.float64]], float], size: int) -> NDArray[np.float64]:
    return np.array([(f(s) - f(-s)) / 2e-6 for s in 1e-6 * np.eye(size)])


def a_window(seed: int, count: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    # Far from the border: an event that leaves the image is a jump that no derivative has.
    bearings = rng.uniform((-0.3, -0.18), (0.3, 0.18), (count, 2)).astype(np.float32)
    t_s = np.sort(rng.uniform(0, 0.2, count))
    t_s[0] = 0.0
    for array in (bearings, t_s):
        array.setflags(write=False)
    return bearings, t_s


@pytest.mark.parametrize("name", get_args(ObjectiveName))
def test_gradient_of_map_and_window(name: ObjectiveName) -> None:
    """The joint contrast of a map's texture and a window by omega, v and normal (eq. 2.11), for every objective."""
    bearings, t_s = a_window(1, 120)
    texture = np.random.default_rng(2).uniform(0.5, 2.0, (64, 91)).astype(np.float32)
    texture.setflags(write=False)
    T = se3.pose(se3.exp_so3([0.02, 0.03, -0.05]), [0.02, -0.03, 0.05])
    world = Plane(normal=TILTED)
    target = np.array([[44.0, 0, 45], [0, 44, 32], [0, 0, 1]]) @ homography_map_camera(T, world)
    seen = world.seen_from(T)
    problem = ContrastProblem(
        bearings=bearings, t_s=t_s, weights=np.ones(1, dtype=np.float32), camera=SMALL, duration_s=0.2,
        target=target, texture=texture,
    )  # fmt: skip

    def slow(x: NDArray[np.float64]) -> float:
        n = turn_normal(seen.normal, x[6:])
        image = texture.astype(np.float64)
        A = np.linalg.inv(np.eye(3) + t_s[:, None, None] * np.outer(0.4 * VELOCITY + x[3:6], n) / seen.distance)
        H = target @ A @ se3.exp_so3(np.multiply.outer(t_s, 0.4 * OMEGA + x[:3]))
        slow_vote(image, np.einsum("nij,nj->ni", H, np.column_stack([bearings, np.ones(len(t_s))])))
        return slow_objective(name, image, 1.2)

    value, exact = problem.evaluate(
        0.4 * OMEGA,
        0.4 * VELOCITY,
        seen,
        objective(name, 1.2),
        d_normal=turn_normal_derivative(seen.normal, np.zeros(2)),
    )
    numeric = central(slow, 8)
    assert value == pytest.approx(slow(np.zeros(8)), rel=1e-3)
    assert np.abs(numeric).max() > 0
    assert np.abs(exact - numeric).max() < 0.02 * np.abs(numeric).max()


@pytest.mark.parametrize("name", ["variance", "gradient", "highpass"])
def test_gradient_of_the_joint_contrast(name: ObjectiveName) -> None:
    """All 12 k - 4 parameters and the held first pose; Michelson is constant where a pixel is empty."""
    plane = Plane(normal=TILTED)
    keyframes = []
    for i, x in enumerate(([0.0] * 6, [0.05, -0.1, 0.2, 0.1, -0.05, -0.15], [-0.1, 0.05, -0.1, -0.1, 0.1, 0.2])):
        bearings, t_s = a_window(3 + i, 60)
        keyframes.append(
            KeyframeEvents(
                bearings=bearings, t_s=t_s, duration_s=0.2, T_world_camera=moved(np.eye(4), np.array(x)),
                omega=0.4 * OMEGA, velocity=0.4 * VELOCITY,
            )
        )  # fmt: skip
    canvas = canvas_of(keyframes, plane, 40.0)

    def slow(x: NDArray[np.float64]) -> float:
        n = turn_normal(TILTED, x[36:])
        image = np.zeros(canvas.shape)
        for i, k in enumerate(keyframes):
            y = x[12 * i : 12 * i + 12]
            T = moved(k.T_world_camera, y)
            H = canvas.target @ homography_map_camera(T, Plane(normal=n))
            weight = (np.linalg.det(H) / H[2, 2] ** 3 / 40.0**2) ** (0.5 * AREA_POWER)
            # Where each event's ray meets the plane, in the map's frame.
            R = T[:3, :3] @ se3.exp_so3(np.multiply.outer(k.t_s, k.omega + y[6:9]))
            p = T[:3, 3] + np.multiply.outer(k.t_s, T[:3, :3] @ (k.velocity + y[9:]))
            ray = np.einsum("nij,nj->ni", R, np.column_stack([k.bearings, np.ones(len(p))]))
            depth = -(1.0 + p @ n) / (ray @ n)
            on_map = (p + depth[:, None] * ray) @ rotation_to_map(n).T
            slow_vote(image, np.column_stack([on_map[:, :2], np.ones(len(p))]) @ canvas.target.T, weight)
        return slow_objective(name, image, 1.2)

    value, slopes, by_normal = joint_contrast(
        keyframes, plane, canvas, objective(name, 1.2), turn_normal_derivative(TILTED, np.zeros(2))
    )
    assert value == pytest.approx(slow(np.zeros(38)), rel=1e-3)
    exact, numeric = np.concatenate([slopes.ravel(), by_normal]), central(slow, 38)
    for part in (slice(0, 36), slice(36, 38)):
        assert np.abs(exact[part] - numeric[part]).max() < 0.02 * np.abs(numeric[part]).max()


# --- known answers --------------------------------------------------------------------------------------------------


def on_the_wall(
    T: NDArray[np.float64], omega: NDArray[np.float64], velocity: NDArray[np.float64], plane: Plane, duration_s: float,
    count: int, seed: int,
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]:  # fmt: skip
    """Bearings (N, 2), times (N,) and signs (N,) of 80 segments on a plane, before a camera that starts at a pose."""
    rng = np.random.default_rng(7)
    centre, angle = rng.uniform((-0.8, -0.6), (0.8, 0.6), (80, 2)), rng.uniform(0, np.pi, 80)
    length = rng.uniform(0.1, 0.4, 80)
    rng = np.random.default_rng(seed)
    which, along = rng.integers(0, 80, 4 * count), rng.uniform(-0.5, 0.5, 4 * count)
    uv = centre[which] + (along * length[which])[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[which]
    t = np.sort(rng.uniform(0, duration_s, 4 * count))
    poses_R = T[:3, :3] @ se3.exp_so3(np.multiply.outer(t, omega))
    positions = T[:3, 3] + (t[:, None] * velocity) @ T[:3, :3].T
    seen = np.einsum("nji,nj->ni", poses_R, map_to_world(uv, plane) - positions)
    b = seen[:, :2] / seen[:, 2:]
    keep = np.flatnonzero((seen[:, 2] > 0) & (np.abs(b) < (0.58, 0.43)).all(axis=1))
    keep = keep[np.linspace(0, len(keep) - 1, count).astype(int)]
    return b[keep].astype(np.float32), t[keep] - t[keep[0]], which[keep] % 2 == 0


def off_px(T_found: NDArray[np.float64], found: Plane, T_true: NDArray[np.float64], true: Plane) -> float:
    """How far apart (RMS) two poses put a view's corners in the image of the first camera."""
    corners = np.array([[x, y, 1.0] for x in (-0.4, 0.4) for y in (-0.3, 0.3)])
    at = []
    for T, world in ((T_found, found), (T_true, true)):
        H = np.linalg.inv(homography_map_camera(np.eye(4), world)) @ homography_map_camera(T, world)
        q = corners @ H.T
        at.append(200.0 * q[:, :2] / q[:, 2:])
    return float(np.sqrt(((at[0] - at[1]) ** 2).sum(axis=1).mean()))


def test_first_window_finds_a_tilted_plane() -> None:
    """8 parameters from a zero start: a plane 20 degrees off is found to 6 degrees, and the motion with it."""
    normal = np.array([np.sin(np.radians(20.0)), 0.0, -np.cos(np.radians(20.0))])
    omega, velocity = np.array([0.1, -0.1, 0.2]), np.array([0.8, 0.5, 0.6])
    plane = Plane(normal=normal)
    bearings, t_s, _ = on_the_wall(np.eye(4), omega, velocity, plane, 0.1, 8_000, seed=1)
    problem = ContrastProblem(
        bearings=bearings, t_s=t_s, weights=np.ones(1, dtype=np.float32), camera=CAMERA, duration_s=0.1
    )
    found = maximize_contrast(problem, Plane(normal=np.array([0.0, 0.0, -1.0])), with_normal=True)
    assert np.degrees(np.arccos(found.normal @ normal)) < 6.0
    assert found.contrast_after > 1.5 * found.contrast_before


def test_joint_contrast_recovers_poses_velocities_and_tilt() -> None:
    """Four keyframes a few per cent off before a plane 6 degrees off: nearer, and not drawn together."""
    normal = np.array([0.1, 0.03, -1.0])
    plane = Plane(normal=normal / np.linalg.norm(normal))
    rng = np.random.default_rng(0)
    truths, starts = [], []
    for i in range(4):
        x = np.concatenate([rng.normal(0, 0.08, 3), rng.normal(0, 0.15, 3)]) if i else np.zeros(6)
        T, omega, velocity = moved(np.eye(4), x), rng.normal(0, 0.4, 3), rng.normal(0, 0.4, 3)
        bearings, t_s, _ = on_the_wall(T, omega, velocity, plane, 0.03, 2_000, seed=20 + i)
        # As wide as a pixel.
        bearings = (bearings + rng.uniform(-0.5, 0.5, bearings.shape) / 200).astype(np.float32)
        k = KeyframeEvents(
            bearings=bearings, t_s=t_s, duration_s=0.03, T_world_camera=T, omega=omega, velocity=velocity
        )
        truths.append(k)
        step = rng.normal(0, 0.01, 6) * (i > 0)
        starts.append(replace(k, T_world_camera=moved(T, step), omega=omega + rng.normal(0, 0.1, 3)))
    ahead = Plane(normal=np.array([0.0, 0.0, -1.0]))
    solved = maximize_joint_contrast(
        starts, ahead, 200.0, free=ALL, solve_normal=True, blurs_px=(2.0, 0.8), max_evaluations=40, ridge=1e-4
    )

    def off(keyframes: Sequence[KeyframeEvents], world: Plane) -> float:
        return float(np.mean([off_px(a.T_world_camera, world, b.T_world_camera, plane)
                              for a, b in zip(keyframes, truths, strict=True)]))  # fmt: skip

    assert solved.contrast_after > 1.2 * solved.contrast_before
    assert off(solved.keyframes, solved.plane) < 0.5 * off(starts, ahead)
    assert np.degrees(np.arccos(solved.plane.normal @ plane.normal)) < 3.0
    assert np.array_equal(solved.keyframes[0].T_world_camera, np.eye(4))
    # The truth is about as sharp: nothing was gained by drawing views together.
    canvas, cost = canvas_of(truths, plane, 200.0), objective("variance", 0.8)
    assert (
        cost(common_image(solved.keyframes, solved.plane, canvas))[0]
        < 1.01 * cost(common_image(truths, plane, canvas))[0]
    )


# --- a whole run ------------------------------------------------------------------------------------------------------

CONFIG = TrackerConfig(mode="contrast", window=3000)
NORMAL = np.array([0.1, 0.03, -1.0]) / np.linalg.norm([0.1, 0.03, -1.0])


@pytest.fixture(scope="module")
def recording() -> Recording:
    """18,000 events in 0.08 s of a wall 6 degrees off, at a constant velocity."""
    bearings, t_s, positive = on_the_wall(np.eye(4), OMEGA, VELOCITY, Plane(normal=NORMAL), 0.08, 18_000, seed=3)
    px = bearings * 200.0 + (119.5, 89.5)
    events = Events(
        t_us=np.round(t_s * 1e6).astype(np.int64) + 5_000_000,
        x_px=np.round(px[:, 0]).astype(np.uint16),
        y_px=np.round(px[:, 1]).astype(np.uint16),
        is_positive=positive,
    )
    return Recording(path=Path("wall.h5"), name="wall", format="memory", camera=CAMERA, events=MemoryEvents(events))


def test_tracks_before_a_wall(recording: Recording) -> None:
    """Never lost, every pose where the truth puts the image; keyframes alone write the map; checkpoints go on."""
    tracker = Tracker(recording.camera, CONFIG)
    results, cut = [], {}
    for window in windows(recording, 3000):
        results.append(tracker.step(window))
        if window.index == 3:
            cut = tracker.checkpoint()
    assert len(results) == 6
    assert not {r.status for r in results} & {Status.LOST, Status.RELOCALIZING}
    updates = tracker.take_updates()
    assert len(updates.keyframes) >= 2
    assert any("joint contrast" in line.text for line in updates.log)
    mapper = tracker._mapper
    written = sum(t.events for t in mapper.traces if t.keyframe >= 0)
    assert 0.8 * written < mapper.live_map.votes.sum() <= written * 1.001
    for r in results:
        true = se3.propagate(np.eye(4), OMEGA, VELOCITY, (r.start_us - results[0].start_us) * 1e-6)
        assert off_px(r.T_world_camera, Plane(normal=r.normal_world), true, Plane(normal=NORMAL)) < 1.0
    resumed = Tracker.restore(recording.camera, CONFIG, cut, recording.events)
    for window in windows(recording, 3000, first_event=12_000, index=4):
        again = resumed.step(window)
        assert np.array_equal(again.T_world_camera, results[window.index].T_world_camera)
        assert again.status is results[window.index].status


def test_a_refused_keyframe_is_lost_and_not_on_the_map(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the other keyframes explain too little of the candidate, the former map is kept and a way back searched."""
    monkeypatch.setattr(c, "JOINT_OVERLAP", 100.0)
    tracker = Tracker(recording.camera, CONFIG)
    votes = []
    for window in windows(recording, 3000):
        result = tracker.step(window)
        votes.append(float(tracker._mapper.live_map.votes.sum()))
        if result.status is Status.LOST:
            break
    assert result.status is Status.LOST
    assert result.keyframe == 1
    assert votes[-1] == pytest.approx(votes[0], rel=0.05)
    log = tracker.take_updates().log
    assert any("refused" in line.text for line in log)


@pytest.mark.parametrize("name", ["gradient", "highpass"])
def test_other_objectives_move_the_window(recording: Recording, name: Objective) -> None:
    """The objective that is asked for is the one that is maximised: another answer than the variance's, as near."""
    first = next(iter(windows(recording, 3000)))
    true = se3.propagate(np.eye(4), OMEGA, VELOCITY, first.duration_s)
    found = []
    for config in (replace(CONFIG, objective=name), CONFIG):
        r = Tracker(recording.camera, config).step(first)
        found.append(se3.propagate(np.eye(4), r.omega, r.velocity, first.duration_s))
        moved_px = off_px(np.eye(4), Plane(normal=NORMAL), true, Plane(normal=NORMAL))
        assert off_px(found[-1], Plane(normal=r.normal_world), true, Plane(normal=NORMAL)) < 0.5 * moved_px
    assert not np.array_equal(found[0], found[1])
