"""Rerun recordings are read back with rerun's own reader and compared with the session, number by number."""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
import session_samples as samples
from rerun.chunk import RrdReader

from dvsviz.errors import DvsvizError, SessionError
from dvsviz.events.events import Events
from dvsviz.events.recording import MemoryEvents, Recording
from dvsviz.events.windows import read_window
from dvsviz.export.rerun import RerunLogger, export_rerun
from dvsviz.geometry import se3
from dvsviz.session.store import Session, SessionWriter, open_session

WINDOWS = 500
STEP_US = 10


@pytest.fixture(autouse=True)
def _strict() -> Iterator[None]:
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(before)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    path = tmp_path_factory.mktemp("session") / "wall.h5"
    with SessionWriter.create(path, samples.header()) as writer:
        writer.set_ground_truth(samples.truth(WINDOWS))
        for k in range(WINDOWS):
            writer.append(samples.result(k), samples.updates(k))
    return open_session(path)


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Events whose windows are those of the session's first 30 results."""
    rng = np.random.default_rng(4)
    t_us = np.concatenate(
        [samples.FIRST_US + samples.WINDOW_US * k + np.arange(1000, dtype=np.int64) * STEP_US for k in range(31)]
    )
    n = len(t_us)
    events = Events(
        t_us=t_us,
        x_px=rng.integers(0, samples.CAMERA.width, n).astype(np.uint16),
        y_px=rng.integers(0, samples.CAMERA.height, n).astype(np.uint16),
        is_positive=rng.random(n) < 0.5,
    )
    return Recording(
        path=Path("r.h5"), name="r", format="memory", camera=samples.CAMERA, events=MemoryEvents(events)
    )


def read(path: Path) -> dict[str, list[pa.RecordBatch]]:
    """Return the batches of each entity, static ones under `name (static)`."""
    found: dict[str, list[pa.RecordBatch]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        name = chunk.entity_path.lstrip("/") + (" (static)" if chunk.is_static else "")
        found.setdefault(name, []).append(chunk.to_record_batch())
    return found


def column(batches: list[pa.RecordBatch], ending: str) -> list:
    """Return one column of all batches, in the order of the timeline `window` where there is one."""
    rows: list[tuple[int, object]] = []
    for batch in batches:
        names = [name for name in batch.schema.names if name.endswith(ending)]
        assert len(names) == 1, (ending, batch.schema.names)
        order = batch.column("window").to_pylist() if "window" in batch.schema.names else [0] * batch.num_rows
        rows += list(zip(order, batch.column(names[0]).to_pylist(), strict=True))
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def array(batches: list[pa.RecordBatch], ending: str) -> np.ndarray:
    return np.array(column(batches, ending), dtype=np.float64).squeeze()


@pytest.fixture(scope="module")
def exported(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rrd") / "wall.rrd"
    shares: list[float] = []
    export_rerun(session, out, progress=shares.append)
    assert shares[-1] == 1.0 and [p.name for p in out.parent.iterdir()] == ["wall.rrd"]
    return out


def test_poses_and_plots_equal_the_sessions(session: Session, exported: Path) -> None:
    found = read(exported)
    Ts, columns = session.Ts_world_camera(), session.columns()
    camera = found["world/camera"]
    assert column(camera, "window") == list(range(WINDOWS))
    times = [t.total_seconds() if hasattr(t, "total_seconds") else t for t in column(camera, "time")]
    np.testing.assert_allclose(times, 0.01 * np.arange(WINDOWS), atol=1e-9)
    np.testing.assert_allclose(array(camera, "translation"), Ts[:, :3, 3], atol=1e-6)
    q_wxyz = se3.wxyz_from_xyzw(array(camera, "quaternion"))
    np.testing.assert_allclose(se3.rotation_from_quaternion(q_wxyz), Ts[:, :3, :3], atol=1e-6)
    strips = np.array(column(found["world/trajectory"], "strips"), dtype=np.float64).reshape(WINDOWS, 2, 3)
    np.testing.assert_allclose(strips[:, 1], Ts[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(strips[1:, 0], Ts[:-1, :3, 3], atol=1e-6)
    for name, key in (("contrast_gain", "contrast_gain"), ("event_rate", "event_rate_hz"), ("overlap", "overlap")):
        wanted = columns[key][np.isfinite(columns[key])]
        np.testing.assert_array_equal(array(found[f"plots/{name}"], "scalars"), wanted)


def test_states_keyframes_maps_and_log_equal_the_sessions(session: Session, exported: Path) -> None:
    found = read(exported)
    names = [str(samples.status(k)) for k in range(WINDOWS)]
    changes = [k for k in range(WINDOWS) if k == 0 or names[k] != names[k - 1]]
    assert column(found["state"], "window") == changes
    assert [value[0] for value in column(found["state"], ":state")] == [names[k] for k in changes]
    keyframes = [k.window for k in session.keyframes]
    assert column(found["world/keyframes"], "window") == keyframes
    np.testing.assert_allclose(
        array(found["world/keyframes"], "positions"), session.Ts_world_camera()[keyframes, :3, 3], atol=1e-6
    )
    assert column(found["world/map"], "window") == [r.window for r in session.map_revisions]
    assert [value[0] for value in column(found["log"], "text")] == [entry.text for entry in session.log]
    assert {"world/ground_truth (static)", "world (static)", "state (static)"} <= set(found)


def test_the_map_lies_on_its_plane(exported: Path) -> None:
    batches = read(exported)["world/map"]
    K = np.array(column(batches, "image_from_camera")[0], dtype=np.float64).reshape(3, 3).T
    position = np.array(column(batches, "translation")[0], dtype=np.float64).ravel()
    depth = float(np.ravel(column(batches, "image_plane_distance")[0])[0])
    image = cv2.imdecode(np.array(column(batches, "blob")[0], dtype=np.uint8).ravel(), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    revision = samples.map_revision(0, 0)
    rows, columns = revision.texture.shape
    for row, col in ((0, 0), (rows - 1, columns - 1), (12, 30)):
        u, v = revision.origin + np.array([col, row]) / revision.px_per_unit
        # The plane point in the map's camera, then its pixel (corner convention) on the canvas.
        x, y, _ = K @ ((np.array([u, v, revision.distance]) - position) / depth)
        bright = image[int(y), int(x)] > 100
        assert bright == (revision.texture[row, col] > 100), (row, col)


def test_windows_carry_their_warped_events(session: Session, recording: Recording, tmp_path: Path) -> None:
    export_rerun(session, tmp_path / "x.rrd", recording)
    frames = read(tmp_path / "x.rrd")["world/camera/image"]
    # The recording ends with window 30; what is not there has no image.
    assert column(frames, "window") == list(range(31))
    image = cv2.imdecode(np.array(column(frames, "blob")[3], dtype=np.uint8).ravel(), cv2.IMREAD_COLOR)
    assert image is not None and image.shape == (samples.CAMERA.height, samples.CAMERA.width, 3)
    assert image.max() > 200


def test_without_a_recording_the_keyframes_images_are_shown(session: Session, exported: Path) -> None:
    frames = read(exported)["world/camera/image"]
    assert column(frames, "window") == [k.window for k in session.keyframes]


def test_reruns_own_tool_verifies_the_file(exported: Path) -> None:
    done = subprocess.run(
        [str(Path(sys.executable).parent / "rerun"), "rrd", "verify", str(exported)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0
    assert "1 file verified without error" in done.stdout + done.stderr


def test_a_recording_has_a_blueprint(exported: Path) -> None:
    assert len(RrdReader(exported).blueprints()) == 1
    assert [entry.application_id for entry in RrdReader(exported).recordings()] == ["dvsviz"]


def test_500_windows_take_seconds_at_most(session: Session, tmp_path: Path) -> None:
    start = time.perf_counter()
    export_rerun(session, tmp_path / "x.rrd")
    # 1 s on two busy cores; the bound is loose because the machine is shared.
    assert time.perf_counter() - start < 20


def test_a_logger_writes_the_same_entities_while_tracking(recording: Recording, tmp_path: Path) -> None:
    out = tmp_path / "live.rrd"
    with RerunLogger(out, samples.header()) as logger:
        for k in range(20):
            window = read_window(recording, index=k, first_event=1000 * k, count=1000)
            logger.log(samples.result(k), samples.updates(k), window)
            assert not out.exists()
    found = read(out)
    assert column(found["world/camera"], "window") == list(range(20))
    np.testing.assert_allclose(
        array(found["world/camera"], "translation"), [samples.pose(k)[:3, 3] for k in range(20)], atol=1e-6
    )
    assert column(found["world/camera/image"], "window") == list(range(20))
    assert column(found["world/keyframes"], "window") == [0, 10] == column(found["world/map"], "window")
    assert column(found["state"], "window") == [0, 3]


def test_a_logger_that_is_left_by_an_exception_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), RerunLogger(tmp_path / "x.rrd", samples.header()) as logger:
        logger.log(samples.result(0), samples.updates(0))
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_said(session: Session, tmp_path: Path) -> None:
    with pytest.raises(DvsvizError, match="cannot be written"):
        export_rerun(session, tmp_path / "none" / "x.rrd")
    SessionWriter.create(tmp_path / "empty.h5", samples.header()).close()
    with pytest.raises(SessionError, match="no windows"):
        export_rerun(open_session(tmp_path / "empty.h5"), tmp_path / "x.rrd")
    assert not (tmp_path / "x.rrd").exists()
