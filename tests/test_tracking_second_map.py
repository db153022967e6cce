"""A second map after a loss: begun before something new, joined where it meets the first, else given up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.evaluate.evaluate import evaluate
from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, windows
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.records import LogEntry, Status, TrackerUpdates, WindowResult
from dvsviz.simulate.cover import Cover
from dvsviz.simulate.simulate import simulate
from dvsviz.simulate.suite_scenes import away_and_back
from dvsviz.tracking import second_constants as own
from dvsviz.tracking.joining import Join, agreeing, fit, moved, rival
from dvsviz.tracking.local_map import LocalMap
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.traces import add_to_map
from dvsviz.tracking.tracker import Tracker

SEED, SECONDS = 7, 8.2
DARK_S, BACK_S = (2.0, 2.8), (6.0, 7.4)
LOST = (Status.LOST, Status.RELOCALIZING)
CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)


@dataclass(kw_only=True, eq=False)
class Run:
    """What a tracker made of the recording, and what it knew on the way."""

    tracker: Tracker
    results: list[WindowResult] = field(default_factory=list)
    log: list[LogEntry] = field(default_factory=list)
    refined: dict[int, np.ndarray] = field(default_factory=dict)
    keyframes: list[int] = field(default_factory=list)
    states: dict[str, tuple[int, Mapping[str, np.ndarray]]] = field(default_factory=dict)

    def take(self, updates: TrackerUpdates) -> None:
        self.log.extend(updates.log)
        self.keyframes.extend(k.keyframe for k in updates.keyframes)
        for landing in updates.refined:
            self.refined |= dict(zip(landing.windows.tolist(), landing.Ts_world_camera, strict=True))

    def said(self, text: str) -> list[LogEntry]:
        return [entry for entry in self.log if text in entry.text]

    @property
    def lost(self) -> list[WindowResult]:
        return [r for r in self.results if r.status in LOST]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("second_map") / "away.h5"
    motion = away_and_back(np.random.default_rng(SEED), DARK_S, BACK_S)
    simulate(path, scene="shapes", motion=motion, seconds=SECONDS, seed=SEED, cover=Cover(intervals=(DARK_S,)))
    return open_recording(path)


@pytest.fixture(scope="module")
def tracked(recording: Recording) -> Run:
    """Return the whole run; states: as it is lost, on the second map, and just before the camera comes back."""
    tracker = Tracker(recording.camera)
    run = Run(tracker=tracker)
    for window in windows(recording, lambda: tracker.window_size):
        run.results.append(tracker.step(window))
        run.take(tracker.take_updates())
        second, s = tracker._second, (window.end_us - recording.first_us) * 1e-6
        assert second is not None
        if run.results[-1].status is Status.LOST and "lost" not in run.states:
            run.states["lost"] = (window.index, tracker.checkpoint())
        if second.local is not None and second.local.is_settled and "second" not in run.states:
            run.states["second"] = (window.index, tracker.checkpoint())
        if s > BACK_S[0] and "back" not in run.states:
            run.states["back"] = (window.index, tracker.checkpoint())
    run.take(tracker.finish())
    return run


def restored(recording: Recording, run: Run, name: str) -> Tracker:
    return Tracker.restore(recording.camera, TrackerConfig(), run.states[name][1], recording.events)


def test_windows_of_a_second_map_get_poses_when_the_maps_meet(recording: Recording, tracked: Run) -> None:
    """What was lost for seconds has poses within 1 % of the distance and half a degree in the end."""
    (begun,), (joined,) = tracked.said("second map begun"), tracked.said("maps joined")
    first = int(begun.text.split()[-1])
    assert all(r.status in LOST for r in tracked.results[first : joined.window]), "not known in the first world yet"
    assert tracked.results[-1].status is Status.TRACKING
    kept = [r for r in tracked.results if r.status not in LOST or r.window in tracked.refined]
    poses = np.stack([tracked.refined.get(r.window, r.T_world_camera) for r in kept])
    assert recording.ground_truth is not None and recording.mean_plane_distance is not None
    found = evaluate(
        Trajectory(t_us=np.array([r.start_us for r in kept]), Ts_world_camera=poses), recording.ground_truth
    )
    assert found.position_rmse_m is not None
    assert 100 * found.position_rmse_m / recording.mean_plane_distance < 1.0
    assert found.rotation_rmse_deg < 0.5
    between = [r.window for r in tracked.lost if first <= r.window < joined.window]
    assert len(between) > 50 and sum(k in tracked.refined for k in between) > 0.95 * len(between)
    s = np.array([(r.start_us - recording.first_us) * 1e-6 for r in tracked.results])
    assert s[first] < DARK_S[1] + 1.5, "begun soon"
    assert s[joined.window] < BACK_S[1], "joined on the way back"


def test_the_map_holds_both_parts_of_the_wall(tracked: Run) -> None:
    tracker, mapper = tracked.tracker, tracked.tracker._mapper
    assert tracker._second is not None and tracker._second.local is None
    assert tracked.keyframes == list(range(len(tracked.keyframes))), "numbered on"
    assert [t.window for t in mapper.traces] == sorted({t.window for t in mapper.traces})
    columns = np.flatnonzero(mapper.live_map.edge_image().any(axis=0))
    assert np.ptp(columns) / mapper.live_map.px_per_unit > 2.5
    # Rebuilt of all windows it says the same: nothing else was written.
    again = mapper._refiner.build(mapper.traces, mapper.plane)
    assert again.votes.sum() == pytest.approx(mapper.live_map.votes.sum(), rel=0.02)


@pytest.mark.parametrize("name", ["lost", "second"])
def test_a_checkpoint_goes_on_with_the_same_bits(recording: Recording, tracked: Run, name: str) -> None:
    tracker, start = restored(recording, tracked, name), tracked.states[name][0]
    joined = tracked.said("maps joined")[0].window
    first_event = tracked.results[start].end_event
    size = lambda: tracker.window_size  # noqa: E731
    for window in windows(recording, size, first_event=first_event, index=start + 1):
        again, wanted = tracker.step(window), tracked.results[window.index]
        assert (again.end_event, again.status, again.keyframe) == (wanted.end_event, wanted.status, wanted.keyframe)
        assert np.array_equal(again.T_world_camera, wanted.T_world_camera)
        if window.index == joined + 2 or (name == "lost" and window.index == tracked.states["second"][0]):
            break
    if name == "second":
        mine = [k for k in tracker.take_updates().keyframes if k.window < joined]
        assert mine and all(k.image.any() for k in mine)


def test_maps_that_do_not_meet_are_not_joined(recording: Recording, tracked: Run) -> None:
    """The recording ends on the other part of the wall: its windows stay lost and the first map as it was."""
    tracker = restored(recording, tracked, "back")
    mapper = tracker._mapper
    before = restored(recording, tracked, "lost")._mapper
    assert np.array_equal(mapper.live_map.votes, before.live_map.votes)
    assert len(mapper.traces) == len(before.traces)
    run = Run(tracker=tracker)
    run.take(tracker.finish())
    (given_up,) = run.said("never met")
    assert "stay lost" in given_up.text
    assert max(run.refined, default=0) < tracked.lost[0].window


def noise(window: EventWindow, rng: np.random.Generator) -> EventWindow:
    bearings = rng.uniform((-0.55, -0.4), (0.55, 0.4), window.bearings.shape).astype(np.float32)
    return replace(window, bearings=bearings)


def test_no_second_map_of_what_shows_nothing(recording: Recording, tracked: Run) -> None:
    """Two seconds before a covered lens: noise as a sensor makes it, and as much of it as of events before a wall."""
    assert all(entry.window > 0 for entry in tracked.said("second map begun"))
    tracker, start = restored(recording, tracked, "lost"), tracked.states["lost"][0]
    rng = np.random.default_rng(0)
    first_us = tracked.results[start].end_us
    for window in windows(recording, 6000, first_event=tracked.results[start].end_event, index=start + 1):
        assert tracker.step(noise(window, rng)).status in LOST
        assert tracker._second is not None and tracker._second.local is None
        if window.end_us - first_us > 2_000_000:
            break


def test_none_where_it_would_not_make_sense() -> None:
    for changes in ({"motion": "rotation"}, {"motion": "translation"}, {"mode": "contrast"}):
        assert Tracker(CAMERA, TrackerConfig(**changes))._second is None


def test_a_second_map_waits_while_the_camera_is_on_the_first(tracked: Run) -> None:
    """It came back without its being seen how the maps meet, and later goes there: then they are joined.

    The windows of the way back are dealt out, every other one to the second map, which gets another world.
    """
    known = tracked.tracker._mapper
    begun = int(tracked.said("second map begun")[0].text.split()[-1])
    joined = tracked.said("maps joined")[0].window
    shared = [t for t in known.traces if joined - 80 <= t.window]
    away = [t for t in known.traces if begun <= t.window < joined - 80] + shared[::2]
    turn, shift = se3.exp_so3(np.array([0.0, 0.1, 0.8])), np.array([0.3, -0.5, 0.2])
    scale = 1.0 / (known.plane.distance + float(known.plane.normal @ shift))
    back = Join(scale=scale, R_first_second=turn.T, t_first_second=-scale * turn.T @ shift)
    tracker = Tracker(CAMERA)
    mapper, second = tracker._mapper, tracker._second
    assert second is not None
    mapper.plane, mapper.traces = known.plane, [t for t in known.traces if t.window < begun]
    mapper.keyframes = known.keyframes[: sum(t.keyframe >= 0 for t in mapper.traces)]
    mapper.map = mapper._refiner.build(mapper.traces, known.plane)
    tracker._motion.status, tracker._motion.good_score = Status.TRACKING, 0.8
    local = LocalMap.start(second.finder, Plane(normal=turn.T @ known.plane.normal), begun, 0)
    local.mapper.traces, local.mapper.keyframes = moved(away, known.keyframes, back, 0)
    local.mapper.map = local.mapper._refiner.build(local.mapper.traces, local.mapper.plane)
    local.mapper.refinements, local.motion.good_score, local.is_told = 1, 0.8, True
    second.local = local
    wanted = {t.window: t.T_world_camera for t in away}
    for trace in shared[1::2]:
        mapper.traces.append(trace)
        add_to_map(mapper.live_map, trace, (CAMERA.height, CAMERA.width), CAMERA.matrix)
        second.stay(trace, trace.mid_us)
        assert local.is_left
        if second.local is None:
            break
    run = Run(tracker=tracker)
    run.take(tracker.take_updates())
    (said,) = run.said("maps joined")
    wanted = {k: T for k, T in wanted.items() if k < said.window}
    assert len(wanted) > 50
    found = {t.window: t.T_world_camera for t in mapper.traces}
    for k, T in wanted.items():
        assert np.linalg.norm(found[k][:3, 3] - T[:3, 3]) < 0.01
        assert np.degrees(se3.rotation_angle(found[k][:3, :3].T @ T[:3, :3])) < 0.3
    numbers = [k.keyframe for k in mapper.keyframes]
    assert len(set(numbers)) == len(numbers) and set(wanted) <= set(run.refined)


# --- how two maps lie to each other ----------------------------------------------------------------------------


def planted() -> tuple[Join, Plane, Plane]:
    """Return a join of two worlds with one common plane, and the plane in both."""
    normal = np.array([0.2, -0.1, -1.0])
    first = Plane(normal=normal / np.linalg.norm(normal))
    T_first_second = se3.pose(se3.exp_so3(np.array([0.1, -0.2, 0.7])), np.array([0.8, -0.3, 0.2]))
    seen = first.seen_from(T_first_second)
    join = Join(scale=seen.distance, R_first_second=T_first_second[:3, :3], t_first_second=T_first_second[:3, 3])
    return join, first, Plane(normal=seen.normal)


def views(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    along = np.array([0.1, 0.0, 0.0])
    return [se3.pose(se3.exp_so3(rng.normal(0, 0.1, 3)), rng.normal(0, 0.1, 3) + k * along) for k in range(count)]


def test_a_join_is_found_of_windows_that_are_on_both_maps() -> None:
    wanted, first, second = planted()
    pairs = [(wanted.pose(T), T) for T in views(3)]
    found, off_px = fit(pairs, first, second, CAMERA)
    assert off_px.max() < 1e-9
    assert found.scale == pytest.approx(wanted.scale)
    assert np.allclose(found.R_first_second, wanted.R_first_second, atol=1e-9)
    assert np.allclose(found.t_first_second, wanted.t_first_second, atol=1e-9)
    agreed = agreeing(pairs, first, second, CAMERA)
    assert agreed is not None and agreed.scale == pytest.approx(wanted.scale)


def test_windows_that_disagree_or_repeat_each_other_join_nothing() -> None:
    join, first, second = planted()
    Ts = views(3)
    pairs = [(join.pose(T), T) for T in Ts]
    assert agreeing(pairs[:2], first, second, CAMERA) is None, "too few"
    astray = se3.pose(se3.exp_so3(np.array([0, 0, 0.1])), np.array([0.3, 0.0, 0.0])) @ pairs[2][0]
    assert agreeing([*pairs[:2], (astray, Ts[2])], first, second, CAMERA) is None, "one is elsewhere"
    assert agreeing([pairs[0]] * 3, first, second, CAMERA) is None, "one view, three times"
    off = [(astray, Ts[2]), *pairs]
    assert agreeing(off, first, second, CAMERA) is not None, "an odd one out does not matter"


def test_a_pattern_that_repeats_is_not_joined(tracked: Run) -> None:
    """On a wallpaper windows lie as well one period further on; on shapes they do not."""
    mapper = tracked.tracker._mapper
    assert rival(mapper.live_map, mapper.traces[20:28], CAMERA) < 0.5 * own.JOIN_RIVAL
    plane, s = Plane(normal=np.array([0.0, 0.0, -1.0])), np.linspace(-1.5, 1.5, 1500)
    lines = np.arange(-1.5, 1.5, 0.15)
    across = np.column_stack([np.repeat(lines, len(s)), np.tile(s, len(lines))])
    points = np.concatenate([across, across[:, ::-1]]).astype(np.float32)
    planar_map = PlanarMap(plane, 200.0, np.array([-1.5, -1.5]), (600, 600), freeze_px=np.inf)
    view = homography_map_camera(np.eye(4), plane)
    planar_map.add(points, view, view, (180, 240), CAMERA.matrix)
    planar_map.exposure[:] = 1.0
    seen = np.ascontiguousarray(points[np.all(np.abs(points) < (0.58, 0.43), axis=1)])
    window = replace(mapper.traces[0], T_world_camera=np.eye(4), omega=np.zeros(3), velocity=np.zeros(3))
    window = replace(window, bearings=seen, t_s=np.linspace(0, window.duration_s, len(seen)))
    assert rival(planar_map, [window], CAMERA) > 1.2 * own.JOIN_RIVAL


def test_what_is_joined_moves_as_it_did(tracked: Run) -> None:
    """Pose and velocity of a window are those of the same camera, in another unit."""
    join, _, _ = planted()
    mapper = tracked.tracker._mapper
    traces = mapper.traces[:40]
    out, keyframes = moved(traces, mapper.keyframes, join, 100)
    assert [k.keyframe for k in keyframes] == [100 + i for i in range(len(keyframes))] and len(keyframes) > 2
    for before, after in zip(traces, out, strict=True):
        assert np.allclose(after.T_world_start, join.pose(before.T_world_start), atol=1e-12)
        assert np.array_equal(after.omega, before.omega)
