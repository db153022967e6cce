from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.events.recording import Imu
from dvsviz.formats.hdf5 import RecordingWriter, read_recording
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory

CAMERA = Camera(width=31, height=17, fx=30.0, fy=29.0, cx=15.5, cy=8.25, distortion=(-0.3, 0.1, 1e-3, -2e-3, 0.01))


def make_events(t_us: list[int] | np.ndarray, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    n = len(t_us)
    events = Events(
        t_us=np.asarray(t_us, np.int64),
        x_px=rng.integers(0, 31, n).astype(np.uint16),
        y_px=rng.integers(0, 17, n).astype(np.uint16),
        is_positive=rng.integers(0, 2, n).astype(bool),
    )
    for column in (events.t_us, events.x_px, events.y_px, events.is_positive):
        column.setflags(write=False)
    return events


def write(path: Path, events: Events, parts: int = 1, camera: Camera = CAMERA) -> Path:
    with RecordingWriter(path, camera=camera) as writer:
        for part in np.array_split(np.arange(len(events)), parts):
            writer.append(events[int(part[0]) : int(part[-1]) + 1] if len(part) else Events.empty())
    return path


def assert_same(a: Events, b: Events) -> None:
    np.testing.assert_array_equal(a.t_us, b.t_us)
    np.testing.assert_array_equal(a.x_px, b.x_px)
    np.testing.assert_array_equal(a.y_px, b.y_px)
    np.testing.assert_array_equal(a.is_positive, b.is_positive)


@settings(max_examples=40, deadline=None)
@given(
    gaps=st.lists(st.integers(0, 5000), min_size=1, max_size=300),
    start=st.integers(-(10**6), 2 * 10**15),
    parts=st.integers(1, 7),
)
def test_round_trip(tmp_path_factory, gaps: list[int], start: int, parts: int) -> None:
    t = start + np.cumsum(gaps)
    events = make_events(t)
    path = write(tmp_path_factory.mktemp("h5") / "r.h5", events, parts)
    recording = read_recording(path)
    assert_same(recording.events.read(0, recording.events.count), events)
    assert recording.camera == CAMERA
    assert (recording.first_us, recording.last_us) == (t[0], t[-1])
    for at in (t[0] - 1, t[0], (t[0] + t[-1]) // 2, t[-1], t[-1] + 1):
        assert recording.events.index_at(int(at)) == np.searchsorted(t, at)
    with h5py.File(path) as file:
        index = file["events/ms_to_idx"][:]
    marks = t[0] + 1000 * np.arange((t[-1] - t[0]) // 1000 + 1)
    np.testing.assert_array_equal(index, np.searchsorted(t, marks))


def test_blocks_agree_with_the_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    events = make_events(np.cumsum(rng.integers(0, 9, 700_001)))
    source = read_recording(write(tmp_path / "r.h5", events, 3)).events
    for first, end in ((0, 10), (262_140, 262_150), (100, 600_000), (700_000, 800_000), (5, 5), (-3, 4)):
        assert_same(source.read(first, end), events[max(0, first) : end])
    for at in rng.integers(-5, int(events.t_us[-1]) + 5, 50):
        assert source.index_at(int(at)) == np.searchsorted(events.t_us, at)


def test_what_is_read_ahead_is_told_where_it_is_asked_for(tmp_path: Path) -> None:
    # More events than are checked on opening, in blocks of 2^18; one time in the third block is not in order.
    block, count = 1 << 18, 5_000_000
    path = write(tmp_path / "long.h5", make_events(np.arange(count)))
    with h5py.File(path, "r+") as file:
        _set(file, "events/t", np.r_[np.arange(2 * block + 10), 0, np.arange(2 * block + 11, count)])
    recording = read_recording(path)
    for first in (0, block // 2, block, block + block // 2):
        assert recording.events.read(first, first + block // 2).t_us[0] == first
    with pytest.raises(FormatError, match="event 524298: time runs backwards"):
        recording.events.read(2 * block, 2 * block + 100)
    assert recording.events.read(block, block + 10).t_us[-1] == block + 9
    recording.close()


def test_no_index_where_it_would_be_huge(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5", make_events([0, 5_000_000, 7 * 3_600_000_000, 10**15]), 2)
    with h5py.File(path) as file:
        assert "ms_to_idx" not in file["events"]
    assert read_recording(path).events.index_at(6_000_000) == 2


def test_everything_beside_the_events(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    Ts = se3.pose(se3.exp_so3(rng.normal(size=(5, 3))), rng.normal(size=(5, 3)))
    truth = Trajectory(t_us=np.arange(5, dtype=np.int64) * 1000, Ts_world_camera=Ts)
    imu = Imu(t_us=np.arange(4, dtype=np.int64), gyro=rng.normal(size=(4, 3)), accel=np.full((4, 3), np.nan))
    frames = rng.integers(0, 255, (3, 17, 31)).astype(np.uint8)
    with RecordingWriter(tmp_path / "r.h5", camera=CAMERA) as writer:
        writer.append(make_events([0, 1, 1, 4000]))
        writer.set_ground_truth(truth)
        writer.set_imu(imu)
        for i, frame in enumerate(frames):
            writer.append_frame(i * 40_000, frame)
        writer.set_plane(mean_plane_distance=1.5, normal_world=(0, 0, -1), distance_world=2.5)
    recording = read_recording(tmp_path / "r.h5")
    assert recording.ground_truth is not None and recording.imu is not None and recording.frames is not None
    np.testing.assert_allclose(recording.ground_truth.Ts_world_camera, Ts, atol=1e-12)
    np.testing.assert_array_equal(recording.imu.gyro, imu.gyro)
    assert np.isnan(recording.imu.accel).all()
    np.testing.assert_array_equal(recording.frames.t_us, [0, 40_000, 80_000])
    np.testing.assert_array_equal(recording.frames.read(2), frames[2])
    assert recording.mean_plane_distance == 1.5 and recording.plane_distance_world == 2.5
    np.testing.assert_array_equal(recording.plane_normal_world, [0, 0, -1])
    assert recording.warnings == ()


def test_guessed_calibration_stays_a_guess(tmp_path: Path) -> None:
    recording = read_recording(write(tmp_path / "r.h5", make_events([1, 2]), camera=Camera.guess(31, 17)))
    assert recording.camera == Camera.guess(31, 17)
    assert "no calibration" in recording.warnings[0]


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="event 2: time runs backwards"):
        write(tmp_path / "r.h5", make_events([1, 5, 3]))
    with pytest.raises(FormatError, match="outside the sensor of 20x17"):
        write(tmp_path / "r.h5", make_events(range(500)), camera=Camera.guess(20, 17))
    assert list(tmp_path.iterdir()) == []


def test_order_is_checked_across_appends(tmp_path: Path) -> None:
    with (
        pytest.raises(FormatError, match="event 2: time runs backwards"),
        RecordingWriter(tmp_path / "r.h5", camera=CAMERA) as writer,
    ):
        writer.append(make_events([10, 20]))
        writer.append(make_events([19]))


def _set(file: h5py.File, name: str, values: object) -> None:
    del file[name]
    file[name] = values


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: f.attrs.update(format="other"), "attribute format: expected 'dvsviz-recording', got 'other'"),
        (
            lambda f: f.attrs.update(version=2),
            "attribute version: version 2 is not known, expected 1; update dvsviz",
        ),
        (lambda f: f.attrs.update(width=10**9), r"a sensor of 1000000000x\d+; expected 1 to 4096"),
        (lambda f: f.attrs.update(width="wide"), "attribute width: expected a number"),
        (lambda f: f["camera"].attrs.update(fx=np.nan), "camera: camera: expected finite"),
        (lambda f: f["camera"].attrs.update(distortion=[1.0, 2.0]), "five distortion values"),
        (lambda f: f.__delitem__("events/p"), "events/p: this dataset is missing"),
        (lambda f: _set(f, "events/x", np.zeros(3, np.uint16)), "events: t, x, y, p differ in size"),
        (lambda f: _set(f, "events/t", np.array([1, 2, 9, 4, 5])), "event 3: time runs backwards, 4 us after 9 us"),
        (lambda f: _set(f, "events/t", np.array([1.0, 2, 3, 4, 5])), "events: expected integers"),
        (
            lambda f: _set(f, "events/y", np.array([1, 2, 17, 4, 5], np.uint16)),
            "event 2: pixel .* outside the sensor",
        ),
        (lambda f: _set(f, "events/y", np.array([1, -2, 7, 4, 5], np.int16)), "outside the sensor"),
        (lambda f: _set(f, "groundtruth/position", np.full((2, 3), np.nan)), "pose 0: the pose is not finite"),
        (lambda f: _set(f, "groundtruth/t", np.array([5, 5])), "groundtruth: .*strictly increasing"),
        (lambda f: _set(f, "imu/gyro", np.zeros((2, 2))), r"imu: expected .*gyro \(2, 2\)"),
        (lambda f: _set(f, "imu/gyro", np.full((2, 3), b"x")), "imu/gyro: expected numbers"),
        (lambda f: _set(f, "imu/t", np.array([0.1, 0.2])), "imu/t: expected whole numbers"),
        (lambda f: _set(f, "imu/t", np.array([1, 2**63], np.uint64)), "imu/t: .* 63 bits"),
        (lambda f: _set(f, "events/t", np.full(5, 2**63 + 1, np.uint64)), "events 0 and after: .* 63 bits"),
        (lambda f: f.attrs.update(plane_normal_world=[1.0, 2.0]), "plane_normal_world: expected three"),
        (lambda f: _set(f, "frames/image", np.zeros((3, 4), np.uint8)), "frames/image: expected"),
    ],
)
def test_refused_by_name(tmp_path: Path, break_it, message: str) -> None:
    path = tmp_path / "r.h5"
    with RecordingWriter(path, camera=CAMERA) as writer:
        writer.append(make_events([1, 2, 3, 4, 5]))
        writer.set_ground_truth(
            Trajectory(t_us=np.arange(2, dtype=np.int64), Ts_world_camera=np.stack([np.eye(4)] * 2))
        )
        writer.set_imu(Imu(t_us=np.arange(2, dtype=np.int64), gyro=np.zeros((2, 3)), accel=np.zeros((2, 3))))
        writer.append_frame(0, np.zeros((17, 31), np.uint8))
    with h5py.File(path, "a") as file:
        break_it(file)
    with pytest.raises(FormatError, match=message) as caught:
        read_recording(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_gyroscope_alone_is_enough(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with RecordingWriter(path, camera=CAMERA) as writer:
        writer.append(make_events([1, 2, 3]))
        writer.set_imu(Imu(t_us=np.arange(2, dtype=np.int64), gyro=np.ones((2, 3)), accel=np.zeros((2, 3))))
    with h5py.File(path, "a") as file:
        del file["imu/accel"]
    imu = read_recording(path).imu
    assert imu is not None and imu.gyro.shape == (2, 3) and np.isnan(imu.accel).all()


def test_no_file_no_hdf5_no_events(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_recording(tmp_path / "absent.h5")
    (tmp_path / "junk.h5").write_bytes(b"junk" * 100)
    with pytest.raises(FormatError, match="not an HDF5 file"):
        read_recording(tmp_path / "junk.h5")
    with RecordingWriter(tmp_path / "empty.h5", camera=CAMERA):
        pass
    with pytest.raises(FormatError, match="there are no events"):
        read_recording(tmp_path / "empty.h5")


def test_the_example_of_the_document_is_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[1] / "docs/recording-format.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(text.split("```python")[1].split("```")[0], {})
    recording = read_recording(tmp_path / "recording.h5")
    np.testing.assert_array_equal(recording.events.read(0, 9).x_px, [5, 6, 7])
    assert recording.events.index_at(12) == 1


@pytest.mark.parametrize("attributes", [{}, {"format": "dvsviz-recording", "version": 1, "width": 9, "height": 9}])
def test_a_header_that_claims_what_no_file_holds(tmp_path: Path, attributes: dict) -> None:
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.attrs.update(attributes)
        for name in "txyp":
            file.create_dataset(f"events/{name}", (10**13,), np.uint16, chunks=(1000,))
    for repair in (False, True):
        with pytest.raises(FormatError, match="events/t: claims 20,000,000,000,000 bytes"):
            open_recording(tmp_path / "r.h5", repair=repair)
