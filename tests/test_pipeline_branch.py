"""Trying again from a window: what is copied, what is tracked anew, and that nothing else differs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError, SessionError
from dvsviz.events.part import EventsUntil
from dvsviz.events.recording import Recording
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.pipeline import Branch, branch, track
from dvsviz.pipeline.branch import config_at
from dvsviz.session.records import STATUSES, Status
from dvsviz.session.store import add_bookmark, open_session
from dvsviz.simulate.simulate import simulate

CONFIG = TrackerConfig(window=3000)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("recordings") / "wall.h5"
    simulate(path, seconds=1.5, seed=1, camera=Camera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5))
    return open_recording(path)


@pytest.fixture(scope="module")
def parent(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sessions") / "wall.h5"
    track(recording, CONFIG, out)
    add_bookmark(out, 3, "here")
    return out


def test_a_branch_without_changes_is_its_parent(recording: Recording, parent: Path, tmp_path: Path) -> None:
    """The replay from the checkpoint leaves the tracker as it was: every number of every window comes again."""
    with open_session(parent) as before:
        keyframes = [k.window for k in before.keyframes]
        window = next(k for k in range(keyframes[-1] - 1, 0, -1) if k not in keyframes and k - 1 not in keyframes)
    summary = branch(recording, parent, tmp_path / "b.h5", Branch(window=window, config=CONFIG))
    with open_session(parent) as a, open_session(tmp_path / "b.h5") as b:
        assert b.complete
        assert b.window_count == a.window_count == summary["windows"]
        was, now = a.columns(), b.columns()
        for name in was:
            if name != "time_spent_s":
                np.testing.assert_allclose(now[name], was[name], rtol=1e-6, atol=1e-9, err_msg=name)
        assert [k.window for k in b.keyframes] == keyframes
        assert b.bookmarks == ()
        origin = b.header.origin
        assert origin is not None and (origin.session, origin.window, origin.changes) == ("wall", window, {})
        assert a.ground_truth is not None and b.ground_truth is not None
        assert b.summary is not None and b.summary["evaluation"] is not None
        assert any("Tried again from window" in line.text for line in b.log)


def test_changes_hold_from_the_window_on(recording: Recording, parent: Path, tmp_path: Path) -> None:
    with open_session(parent) as a:
        window, count = a.window_count // 2, a.window_count
    config = TrackerConfig(window=1500, motion="rotation")
    branch(recording, parent, tmp_path / "b.h5", Branch(window=window, config=config))
    with open_session(parent) as a, open_session(tmp_path / "b.h5") as b:
        assert b.window_count > count
        for name in ("T_world_camera", "start_us", "contrast_after", "status"):
            np.testing.assert_array_equal(b.column(name)[:window], a.column(name)[:window])
        sizes = b.column("end_event") - b.column("first_event")
        assert (sizes[:window] == 3000).all() and (sizes[window:-1] == 1500).all()
        assert np.array_equal(b.column("first_event")[1:], b.column("end_event")[:-1])
        origin = b.header.origin
        assert origin is not None
        assert origin.changes == {"motion": ("planar", "rotation"), "window": (3000, 1500)}
        assert config_at(b.header, window - 1) == CONFIG
        assert config_at(b.header, window) == config
    # A branch of the branch, before and after its own beginning.
    again = TrackerConfig(window=2500)
    for at in (window - 2, window + 3):
        out = tmp_path / f"c{at}.h5"
        branch(recording, tmp_path / "b.h5", out, Branch(window=at, config=again))
        with open_session(out) as c:
            sizes = c.column("end_event") - c.column("first_event")
            assert (sizes[: min(at, window)] == 3000).all() and (sizes[at:-1] == 2500).all()
            assert config_at(c.header, 0) == CONFIG
            assert c.header.origin is not None and c.header.origin.session == "b"


def test_translation_can_be_tried_from_any_window(recording: Recording, parent: Path, tmp_path: Path) -> None:
    config = TrackerConfig(window=3000, motion="translation")
    summary = branch(recording, parent, tmp_path / "b.h5", Branch(window=12, config=config))
    with open_session(tmp_path / "b.h5") as b:
        assert b.complete
        assert summary["motion"] == "translation"


def test_a_given_pose_is_where_the_window_begins(recording: Recording, parent: Path, tmp_path: Path) -> None:
    with open_session(parent) as a:
        window = a.window_count // 2
        truth = a.Ts_world_camera()[window]
    near = truth @ se3.pose(se3.exp_so3([0.0, 0.005, 0.0]), [0.004, 0.0, 0.0])
    far = truth @ se3.pose(np.eye(3), [0.9, 0.6, 0.0])
    ends = {}
    for name, T in {"near": near, "far": far}.items():
        branch(recording, parent, tmp_path / f"{name}.h5", Branch(window=window, config=CONFIG, T_world_camera=T))
        with open_session(tmp_path / f"{name}.h5") as b:
            origin = b.header.origin
            assert origin is not None and origin.T_world_camera is not None
            np.testing.assert_allclose(origin.T_world_camera, T)
            ends[name] = b.column("T_world_camera")[window, :3, 3], b.column("status")[window:]
    assert np.linalg.norm(ends["near"][0] - truth[:3, 3]) < 0.02
    assert np.linalg.norm(ends["far"][0] - truth[:3, 3]) > 0.3
    good = STATUSES.index(Status.TRACKING)
    assert (ends["near"][1] == good).mean() > 0.8
    assert ends["far"][1][0] != good


def test_what_cannot_be_tried_is_refused(recording: Recording, parent: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="window: expected 0 to"):
        branch(recording, parent, tmp_path / "b.h5", Branch(window=100_000, config=CONFIG))
    with pytest.raises(ConfigError, match="no map yet"):
        branch(recording, parent, tmp_path / "b.h5", Branch(window=0, config=CONFIG, T_world_camera=np.eye(4)))
    with pytest.raises(SessionError, match="already exists"):
        branch(recording, parent, parent, Branch(window=3, config=CONFIG))
    with open_session(parent) as a:
        last, T = a.window_count - 1, a.Ts_world_camera()[-1]
    mirrored, nan, far, behind = (T.copy() for _ in range(4))
    mirrored[:3, 0] *= -1
    nan[1, 3], far[0, 3], behind[2, 3] = np.nan, 1e9, 1.5
    for bad, said in (
        (mirrored, "mirrors"),
        (2 * T, "scales"),
        (nan, "finite"),
        (far, "within"),
        (behind, "behind"),
        (T[:3], r"\(3, 4\)"),
    ):
        with pytest.raises(ConfigError, match=said):
            branch(recording, parent, tmp_path / "b.h5", Branch(window=last, config=CONFIG, T_world_camera=bad))
    assert not (tmp_path / "b.h5").exists()


def test_a_part_of_a_recording_is_tracked(recording: Recording, tmp_path: Path) -> None:
    track(recording, CONFIG, tmp_path / "p.h5", start_s=0.5, end_s=1.0)
    with open_session(tmp_path / "p.h5") as session:
        start, end = session.column("start_us")[0], session.column("end_us")[-1]
        assert abs(start - recording.first_us - 500_000) < 2000
        assert abs(end - recording.first_us - 1_000_000) < 2000
        assert session.header.events == recording.events.count
        assert session.header.part_s == pytest.approx((0.5, 1.0), abs=1e-5)
        assert session.column("T_world_camera")[0] == pytest.approx(np.eye(4), abs=0.02)
    with pytest.raises(ConfigError, match="no events from"):
        track(recording, CONFIG, tmp_path / "q.h5", start_s=50.0)
    with pytest.raises(ConfigError, match="no events from"):
        track(recording, CONFIG, tmp_path / "q.h5", start_s=0.8, end_s=0.2)


def test_events_until_end_where_they_are_said_to(recording: Recording) -> None:
    part = EventsUntil(recording.events, 100)
    assert part.count == 100
    assert len(part.read(90, 500)) == 10 and len(part.read(200, 300)) == 0
    assert part.index_at(recording.last_us) == 100
