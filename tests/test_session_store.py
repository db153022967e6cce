import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
import session_samples as samples

from dvsviz.errors import SessionError
from dvsviz.session.records import STATUSES, LogEntry
from dvsviz.session.store import Session, SessionWriter, open_session

WINDOWS = 120


def write(path: Path, windows: int = WINDOWS, *, close: bool = True) -> SessionWriter:
    writer = SessionWriter.create(path, samples.header())
    writer.set_ground_truth(samples.truth(windows))
    for k in range(windows):
        writer.append(samples.result(k))
        writer.add(samples.updates(k))
        if k % 25 == 24:
            writer.checkpoint(k, {"window": np.array(k), "pose": samples.pose(k), "name": np.array("größe")})
    if close:
        writer.close({"windows": windows, "evaluation": None})
    return writer


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("session") / "wall one.h5"
    write(path)
    return path


def assert_same_result(found: object, wanted: object) -> None:
    for name in type(wanted).__slots__:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)


def check(session: Session, windows: int) -> None:
    """Everything of the first `windows` windows is there, digit for digit."""
    assert session.window_count == windows
    for k in range(0, windows, 7):
        assert_same_result(session.result(k), samples.result(k))
    columns = session.columns()
    assert columns["status"].tolist() == [STATUSES.index(samples.status(k)) for k in range(windows)]
    np.testing.assert_array_equal(columns["start_us"], samples.FIRST_US + samples.WINDOW_US * np.arange(windows))
    if windows:
        np.testing.assert_array_equal(session.Ts_world_camera(False), [samples.pose(k) for k in range(windows)])
        np.testing.assert_array_equal(
            session.Ts_world_camera(), [samples.refined_pose(k, windows) for k in range(windows)]
        )


def test_a_finished_session_gives_back_every_number(finished: Path) -> None:
    session = open_session(finished)
    check(session, WINDOWS)
    assert session.complete and not session.is_live
    assert session.name == "wall one"
    assert session.summary == {"windows": WINDOWS, "evaluation": None}
    wanted = samples.header()
    for name in type(wanted).__slots__:
        np.testing.assert_array_equal(getattr(session.header, name), getattr(wanted, name), err_msg=name)


def test_a_finished_session_opens_plainly_with_h5py(finished: Path) -> None:
    with h5py.File(finished, "r") as file:
        assert file.attrs["format"] == "dvsviz-session"
        assert file["windows/start_us"].shape == (WINDOWS,)


def test_what_was_added_besides_windows_comes_back(finished: Path) -> None:
    session = open_session(finished)
    assert [k.window for k in session.keyframes] == list(range(0, WINDOWS, 10))
    third = session.keyframe(3)
    assert third.image.shape == (samples.CAMERA.height, samples.CAMERA.width) and np.all(third.image == 3)
    np.testing.assert_array_equal(third.T_world_camera, samples.pose(30))
    assert [f.worst for f in session.failures] == [41, 91]
    assert session.failures[0] == samples.updates(43).failures[0]
    assert session.log[:2] == (LogEntry(window=0, level="info", text="keyframe 0"), samples.updates(10).log[0])
    found = session.checkpoint_at(60)
    assert found is not None and found[0] == 49
    np.testing.assert_array_equal(found[1]["pose"], samples.pose(49))
    assert int(found[1]["window"]) == 49 and str(found[1]["name"]) == "größe"
    assert session.checkpoint_at(10) is None
    assert session.ground_truth is not None
    np.testing.assert_array_equal(session.ground_truth.Ts_world_camera, samples.truth(WINDOWS).Ts_world_camera)


def test_map_revisions_are_light_until_their_texture_is_asked_for(finished: Path) -> None:
    session = open_session(finished)
    light = session.map_revisions[4]
    assert (light.revision, light.window, light.rows, light.columns) == (4, 40, 31, 40)
    np.testing.assert_array_equal(light.texture, samples.texture(4))
    full = session.map_at(47)
    assert full is not None and full.revision == 4
    for name in type(full).__slots__:
        np.testing.assert_array_equal(getattr(full, name), getattr(samples.map_revision(4, 40), name), err_msg=name)
    assert session.map_at(-1) is None


def test_a_texture_that_did_not_change_is_stored_once(tmp_path: Path) -> None:
    with SessionWriter.create(tmp_path / "s.h5", samples.header()) as writer:
        writer.append(samples.result(0))
        for revision in (0, 0, 1):
            writer.add(samples.TrackerUpdates(map_revisions=(samples.map_revision(revision, 0),)))
    places = [r.place for r in open_session(tmp_path / "s.h5").map_revisions]
    assert places[0] == places[1] != places[2]


def test_derived_columns(finished: Path) -> None:
    columns = open_session(finished).columns()
    for k in (0, 50, WINDOWS - 1):
        assert columns["contrast_gain"][k] == samples.result(k).contrast_gain
        assert columns["event_rate_hz"][k] == samples.result(k).event_rate_hz
        assert columns["window"][k] == k
    assert not columns["overlap"].flags.writeable


def test_the_trajectory_leaves_lost_windows_out(finished: Path, tmp_path: Path) -> None:
    """As known at the time; refined, those are in it too that a refinement gave a pose: in the sample, all of them."""
    session = open_session(finished)
    kept = [k for k in range(WINDOWS) if samples.status(k) not in ("lost", "relocalizing")]
    for poses, windows, rule in (
        ("online", kept, samples.pose),
        ("refined", range(WINDOWS), lambda k: samples.refined_pose(k, WINDOWS)),
    ):
        trajectory = session.trajectory(poses)
        np.testing.assert_array_equal(trajectory.t_us, [samples.result(k).start_us for k in windows])
        np.testing.assert_array_equal(trajectory.Ts_world_camera, [rule(k) for k in windows])
    with SessionWriter.create(tmp_path / "s.h5", samples.header()) as writer:
        for k in range(WINDOWS):
            writer.append(samples.result(k))
    session = open_session(tmp_path / "s.h5")
    np.testing.assert_array_equal(session.trajectory().t_us, [samples.result(k).start_us for k in kept])
    assert len(session.trajectory(drop_lost=False)) == WINDOWS


def test_a_growing_session_is_read_by_another_thread_of_the_same_process(tmp_path: Path) -> None:
    path = tmp_path / "live.h5"
    seen: list[int] = []
    done = threading.Event()

    def read() -> None:
        session = open_session(path)
        while not done.is_set():
            n = session.refresh()
            check(session, n)
            seen.append(n)

    writer = SessionWriter.create(path, samples.header())
    pool = ThreadPoolExecutor(1)
    reader = pool.submit(read)
    for k in range(WINDOWS):
        writer.append(samples.result(k), samples.updates(k))
        if k % 5 == 4:
            writer.flush()
    assert open_session(path).is_live
    writer.close({})
    done.set()
    reader.result()
    pool.shutdown()
    assert seen == sorted(seen)
    final = open_session(path)
    check(final, WINDOWS)
    assert final.complete
    with h5py.File(path, "r"):
        pass


def test_a_flush_comes_by_itself(tmp_path: Path) -> None:
    writer = SessionWriter.create(tmp_path / "s.h5", samples.header())
    writer.append(samples.result(0))
    session, wait = open_session(tmp_path / "s.h5"), threading.Event()
    for _ in range(100):
        if session.refresh():
            break
        wait.wait(0.05)
    assert session.window_count == 1
    writer.close()


def test_leaving_by_an_exception_leaves_an_incomplete_session(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), SessionWriter.create(tmp_path / "s.h5", samples.header()) as writer:
        writer.append(samples.result(0))
        raise RuntimeError
    session = open_session(tmp_path / "s.h5")
    assert session.window_count == 1
    assert not session.complete and not session.is_live and session.summary is None


def test_an_empty_session_opens(tmp_path: Path) -> None:
    SessionWriter.create(tmp_path / "s.h5", samples.header()).close()
    session = open_session(tmp_path / "s.h5")
    check(session, 0)
    assert session.map_at(5) is None and session.keyframes == () and session.ground_truth is None
    assert len(session.trajectory()) == 0


def test_an_existing_session_is_kept_unless_forced(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    path.write_bytes(finished.read_bytes())
    with pytest.raises(SessionError, match=r"s\.h5.*--force.*--resume"):
        SessionWriter.create(path, samples.header())
    check(open_session(path), WINDOWS)
    SessionWriter.create(path, samples.header(), force=True).close()
    assert open_session(path).window_count == 0
    assert [p.name for p in tmp_path.iterdir()] == ["s.h5"]


def test_a_session_that_is_being_written_is_not_replaced_even_by_force(tmp_path: Path) -> None:
    writer = SessionWriter.create(tmp_path / "s.h5", samples.header())
    for attempt in (lambda p: SessionWriter.create(p, samples.header(), force=True), SessionWriter.resume):
        with pytest.raises(SessionError, match="being written"):
            attempt(tmp_path / "s.h5")
    writer.close()


def test_windows_must_follow_each_other(tmp_path: Path) -> None:
    with SessionWriter.create(tmp_path / "s.h5", samples.header()) as writer:
        with pytest.raises(ValueError, match="expected 0, got 1"):
            writer.append(samples.result(1))
        with pytest.raises(ValueError, match="windows"):
            writer.add(samples.updates(0))
    with pytest.raises(SessionError, match="closed"):
        writer.append(samples.result(0))


def test_a_session_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SessionError, match="cannot be written"):
        SessionWriter.create(tmp_path / "file" / "s.h5", samples.header())
