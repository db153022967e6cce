"""A camera that only turns: the faces of its panorama, loops, and the picture of all directions."""

from __future__ import annotations

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.events.events import Events
from dvsviz.events.recording import MemoryEvents
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import MapRevision, Status, WindowResult
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import free_parameters
from dvsviz.tracking.panorama import Panorama, loop_error, nearest, spread, turned_away
from dvsviz.tracking.refining import Refiner
from dvsviz.tracking.traces import Trace
from dvsviz.tracking.tracker import Tracker
from dvsviz.view.panorama import equirectangular

CAMERA = Camera(width=160, height=120, fx=110.0, fy=110.0, cx=79.5, cy=59.5)
AHEAD = Plane(normal=np.array([0.0, 0.0, -1.0]))
_RATE, _STEP_S, _TURN_RAD_S = 80_000, 0.005, 3.0


def sky(rng: np.random.Generator) -> np.ndarray:
    """Return directions (M, 3) of points along short edges all over the sphere, poles and all."""
    a = rng.standard_normal((420, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    side = np.cross(a, rng.standard_normal((420, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    p = a[:, None] + np.linspace(0, 0.2, 60)[None, :, None] * side[:, None]
    return (p / np.linalg.norm(p, axis=2, keepdims=True)).reshape(-1, 3)


def turn(t_s: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3), world from camera: more than a turn about y, nodding and rolling a little."""
    t = np.asarray(t_s, dtype=np.float64)
    zero = np.zeros_like(t)
    about_y = se3.exp_so3(np.stack([zero, _TURN_RAD_S * t, zero], axis=-1))
    rest = np.stack([0.25 * np.sin(1.7 * t), zero, 0.2 * np.sin(2.3 * t)], axis=-1)
    return about_y @ se3.exp_so3(rest)


def tumble(t_s: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) that look straight up and backwards upside down on their way round about x."""
    t = np.asarray(t_s, dtype=np.float64)
    zero = np.zeros_like(t)
    about_x = se3.exp_so3(np.stack([_TURN_RAD_S * t, zero, zero], axis=-1))
    return about_x @ se3.exp_so3(np.stack([zero, 0.1 * np.sin(2.0 * t), 0.2 * np.sin(1.3 * t)], axis=-1))


def seen(motion, seconds: float, seed: int = 0) -> Events:
    """Return events of the edges of a `sky` that a turning camera sees, with noise, each edge with its polarity."""
    rng = np.random.default_rng(seed)
    points = sky(rng)
    parts = []
    for k in range(round(seconds / _STEP_S)):
        n = int(_RATE * _STEP_S)
        b = points @ motion(np.array([(k + 0.5) * _STEP_S]))[0]
        ahead = np.flatnonzero((b[:, 2] > 0.4) & (np.abs(b[:, :2]) < 0.8 * b[:, 2:]).all(axis=1))
        t = k * _STEP_S + np.sort(rng.uniform(0, _STEP_S, 2 * n))
        which = ahead[rng.integers(0, len(ahead), 2 * n)]
        p = np.einsum("ni,nij->nj", points[which], motion(t))
        x, y = (110.0 * p[:, i] / p[:, 2] + o + 0.3 * rng.standard_normal(2 * n) for i, o in ((0, 79.5), (1, 59.5)))
        noise = rng.random(2 * n) < 0.03
        x[noise], y[noise] = rng.uniform(0, 159, noise.sum()), rng.uniform(0, 119, noise.sum())
        inside = np.flatnonzero((x > 0) & (x < 159) & (y > 0) & (y < 119))[:n]
        parts.append((t[inside], x[inside], y[inside], which[inside] // 60 % 2))
    t, x, y, sign = (np.concatenate([p[i] for p in parts]) for i in range(4))
    order = np.argsort(t, kind="stable")
    return Events(
        t_us=(t[order] * 1e6).astype(np.int64),
        x_px=np.round(x[order]).astype(np.uint16),
        y_px=np.round(y[order]).astype(np.uint16),
        is_positive=sign[order] == 1,
    )


def windows(events: Events, size: int = 1500) -> list[EventWindow]:
    return [
        make_window(CAMERA, events[i : i + size], index=k, first_event=i, end_us=int(events.t_us[i + size - 1]) + 1)
        for k, i in enumerate(range(0, len(events) - size, size))
    ]


def follow(tracker: Tracker, given: list[EventWindow]) -> tuple[list[WindowResult], np.ndarray, list[MapRevision]]:
    """Track windows to the end; return results, refined poses (N, 4, 4) and map revisions."""
    results, updates = [], []
    for window in given:
        results.append(tracker.step(window))
        updates.append(tracker.take_updates())
    updates.append(tracker.finish())
    poses = {r.window: r.T_world_camera for r in results}
    for update in updates:
        for refined in update.refined:
            poses |= dict(zip(refined.windows.tolist(), refined.Ts_world_camera, strict=True))
    revisions = [m for update in updates for m in update.map_revisions]
    return results, np.stack([poses[r.window] for r in results]), revisions


def errors_deg(results: list[WindowResult], poses: np.ndarray, motion) -> np.ndarray:
    true = motion(np.array([r.start_us for r in results]) * 1e-6)
    true = true[0].T @ true
    return np.degrees(se3.rotation_angle(np.swapaxes(poses[:, :3, :3], 1, 2) @ true))


CONFIG = TrackerConfig(motion="rotation", window=1500)


@pytest.fixture(scope="module")
def turned() -> tuple[list[EventWindow], list[WindowResult], np.ndarray, list[MapRevision]]:
    """A turn of 390 degrees about y."""
    given = windows(seen(turn, np.radians(390) / _TURN_RAD_S))
    return given, *follow(Tracker(CAMERA, CONFIG), given)


def test_a_whole_turn_is_tracked(turned: tuple) -> None:
    """Never lost, and after 390 degrees back where it was: one plane is left at a sixth of this."""
    _, results, poses, revisions = turned
    assert not {r.status for r in results} & {Status.LOST, Status.RELOCALIZING}
    found = errors_deg(results, poses, turn)
    assert np.sqrt((found**2).mean()) < 0.5
    assert found[-1] < 0.6
    assert np.allclose(poses[:, :3, 3], 0.0)
    faces = {tuple(m.normal_world.round(6)) for m in revisions}
    assert 8 <= len(faces) <= 20


def test_the_plane_is_always_before_the_camera(turned: tuple) -> None:
    """What a window is drawn on is what it looks at: also behind the first camera."""
    _, results, _, _ = turned
    away = [float(np.degrees(np.arccos(-r.normal_world @ r.T_world_camera[:3, 2]))) for r in results]
    assert max(away) < np.degrees(c.FACE_APART_RAD) + 12


def test_over_the_pole_and_upside_down() -> None:
    given = windows(seen(tumble, np.radians(140) / _TURN_RAD_S, seed=2))
    results, poses, _ = follow(Tracker(CAMERA, CONFIG), given)
    assert not {r.status for r in results} & {Status.LOST, Status.RELOCALIZING}
    assert np.sqrt((errors_deg(results, poses, tumble) ** 2).mean()) < 0.5


def test_checkpoint_beyond_the_first_face(turned: tuple) -> None:
    """A tracker restored on another face gives the same results to the bit."""
    given = turned[0]
    events = seen(turn, np.radians(390) / _TURN_RAD_S)
    cut = len(given) // 3
    tracker = Tracker(CAMERA, CONFIG)
    for window in given[:cut]:
        tracker.step(window)
        tracker.take_updates()
    again = Tracker.restore(CAMERA, CONFIG, tracker.checkpoint(), MemoryEvents(events))
    for window in given[cut : cut + 20]:
        a, b = tracker.step(window), again.step(window)
        assert np.array_equal(a.T_world_camera, b.T_world_camera)
        assert np.array_equal(a.normal_world, b.normal_world)


def _trace(index: int, R: np.ndarray, bearings: np.ndarray) -> Trace:
    n = len(bearings)
    return Trace(
        window=index, first_event=0, start_us=20_000 * index, mid_us=20_000 * index + 10_000, duration_s=0.02,
        T_world_camera=se3.pose(R, np.zeros(3)), omega=np.zeros(3), velocity=np.zeros(3),
        bearings=bearings.astype(np.float32), t_s=np.linspace(0, 0.02, n), events=n, keyframe=index,
    )  # fmt: skip


def _view(points: np.ndarray, R: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the bearings (2000, 2) of points on the sphere, in a camera that stands still."""
    p = points @ R
    b = p[p[:, 2] > 0.5, :2] / p[p[:, 2] > 0.5, 2:]
    b = b[(np.abs(b) < (0.7, 0.5)).all(axis=1)]
    return b[rng.integers(0, len(b), 2000)]


def test_the_error_of_a_loop_is_found_and_spread() -> None:
    """Windows that came back 3 degrees off the old map say so; what lies between moves by its share."""
    rng = np.random.default_rng(4)
    points = sky(rng)
    error = se3.exp_so3(np.radians([0.5, 3.0, -0.7]))
    first = [_trace(k, se3.exp_so3([0.0, 0.01 * k, 0.0]), np.zeros((0, 2))) for k in range(6)]
    still = [t.T_world_camera[:3, :3] for t in first]
    first = [_trace(k, R, _view(points, R, rng)) for k, R in enumerate(still)]
    round_it = [
        _trace(6 + k, error @ R, _view(points, R, rng))
        for k, R in enumerate(se3.exp_so3([0.0, a, 0.0]) for a in np.linspace(0.3, 2 * np.pi, 20))
    ]
    back = [_trace(26 + k, error @ R, _view(points, R, rng)) for k, R in enumerate(still)]
    traces = [*first, *round_it, *back]
    panorama = Panorama(AHEAD)
    assert panorama.earlier(traces[:6]) == 0
    # Two of the way out still show something of the first face.
    came = panorama.earlier(traces)
    assert 6 <= came <= 9
    refiner = Refiner(camera=CAMERA, free=free_parameters("rotation"), solve_normal=False, is_panorama=True)
    old, now = refiner.build(traces[:6], AHEAD), refiner.build(traces[26:], AHEAD)
    found = loop_error(old, now, traces, CAMERA, free_parameters("rotation"))
    assert found is not None
    assert np.degrees(se3.rotation_angle(found @ error)) < 0.4
    moved = spread(traces, 6, found)
    assert np.array_equal(moved[3], traces[3].T_world_camera)
    assert np.degrees(se3.rotation_angle(moved[31][:3, :3].T @ still[-1])) < 0.4
    shares = [se3.rotation_angle(moved[k][:3, :3] @ traces[k].T_world_camera[:3, :3].T) for k in range(5, 32)]
    assert np.all(np.diff(shares) > -1e-9)
    # A map of other texture is no place to close at.
    other = refiner.build([_trace(k, R, _view(sky(rng), R, rng)) for k, R in enumerate(still)], AHEAD)
    assert loop_error(other, now, traces, CAMERA, free_parameters("rotation")) is None


def test_faces_lie_where_the_camera_looks() -> None:
    panorama = Panorama(AHEAD)
    assert not panorama.turn_to(se3.pose(se3.exp_so3([0.0, 0.4, 0.0]), np.zeros(3)), 10)
    for k, angle in enumerate(np.linspace(0.0, 2 * np.pi, 100)):
        T = se3.pose(se3.exp_so3([0.0, angle, 0.0]), np.zeros(3))
        panorama.turn_to(T, k)
        trace = _trace(k, T[:3, :3], np.zeros((1, 2)))
        assert turned_away(panorama.plane, [trace])[0] < c.FACE_APART_RAD + c.FACE_LEAD_RAD
    assert panorama.current == 0
    assert 10 <= len(panorama.faces) <= 13
    assert len(panorama.known_at(1)) == 1
    assert nearest(panorama.faces, np.eye(4)) == 0
    # Straight backwards, where the map's rotation is not defined for the very opposite of ahead.
    backwards = Panorama(AHEAD)
    assert backwards.turn_to(np.diag([-1.0, 1.0, -1.0, 1.0]), 1)
    assert 0 < np.arccos(backwards.plane.normal[2]) < 0.02


def test_picture_of_all_directions() -> None:
    """A point of each face lies where its direction says: right of ahead, behind, above."""

    def face(look: np.ndarray, column: int, row: int) -> MapRevision:
        texture = np.zeros((200, 220), dtype=np.uint8)
        texture[row - 1 : row + 2, column - 1 : column + 2] = 255
        texture[0, 0] = texture[-1, -1] = 1
        return MapRevision(
            revision=0, window=0, texture=texture, origin=np.array([-1.1, -1.0]), px_per_unit=100.0,
            normal_world=-look / np.linalg.norm(look), distance=1.0,
        )  # fmt: skip

    ahead, right = face(np.array([0.0, 0, 1]), 150, 100), face(np.array([1.0, 0, 0.0]), 110, 60)
    picture = equirectangular([ahead, right, face(np.array([-1e-2, 0, -1.0]), 110, 100)])
    assert picture.shape[1] == 628
    rows, cols = np.nonzero(picture > 100)
    azimuth = np.degrees((cols + 0.5) / 628 * 2 * np.pi - np.pi)
    assert np.abs(azimuth - np.degrees(np.arctan(0.4))).min() < 1.0
    assert np.abs(azimuth - 90).min() < 1.0
    assert np.abs(np.abs(azimuth) - 180).min() < 1.5
    above = rows[np.abs(azimuth - 90) < 2].mean() - rows[np.abs(azimuth - 22) < 2].mean()
    assert above == pytest.approx(-100 * np.arctan(0.4), abs=1.5)
