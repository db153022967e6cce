"""Conversion: what is written is read back as it was, and parts are the parts that were asked for."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from dvsviz.cli import main
from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.events.filters import EventFilter, FilterConfig
from dvsviz.events.recording import Imu, MemoryEvents, Recording
from dvsviz.formats.convert import Selection, convert, target_of
from dvsviz.formats.ground_truth import read_ground_truth
from dvsviz.formats.open import open_recording
from dvsviz.formats.uzh_writer import write_uzh
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory

W, H, START = 96, 64, 7_000_000_123


class Frames:
    t_us = np.array([START + 5, START + 500_000, START + 900_000], np.int64)

    def read(self, index: int) -> np.ndarray:
        return ((np.arange(H)[:, None] * 3 + np.arange(W) + 11 * index) % 256).astype(np.uint8)


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(3)
    n = 20_000
    t = START + np.sort(rng.integers(0, 1_000_000, n))
    t[0], t[-1] = START, START + 999_999
    x, y = rng.integers(0, W, n), rng.integers(0, H, n)
    x[::40], y[::40] = 17, 9
    events = Events(
        t_us=t.astype(np.int64),
        x_px=x.astype(np.uint16),
        y_px=y.astype(np.uint16),
        is_positive=rng.integers(0, 2, n).astype(bool),
    )
    pose_t = START + np.arange(0, 1_100_000, 50_000, dtype=np.int64)
    T = np.tile(np.eye(4), (len(pose_t), 1, 1))
    T[:, 0, 3] = np.arange(len(pose_t)) * 0.1
    imu_t = START + np.arange(0, 1_000_000, 10_000, dtype=np.int64)
    gyro, accel = rng.normal(size=(2, len(imu_t), 3))
    return Recording(
        path=Path("r"),
        name="r",
        format="memory",
        camera=Camera(width=W, height=H, fx=80, fy=81, cx=47, cy=31, distortion=(-0.1, 0.02, 0.001, 0, 0)),
        events=MemoryEvents(events),
        ground_truth=Trajectory(t_us=pose_t, Ts_world_camera=T),
        imu=Imu(t_us=imu_t, gyro=gyro, accel=accel),
        frames=Frames(),
    )


def whole(recording: Recording) -> Events:
    return recording.events.read(0, recording.events.count)


def assert_same(a: Events, b: Events) -> None:
    for name in ("t_us", "x_px", "y_px", "is_positive"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("name", ["a.h5", "folder", "a.zip", "a.aedat4", "dsec.h5"])
def test_round_trip(tmp_path: Path, recording: Recording, name: str) -> None:
    out = tmp_path / name
    found = convert(recording, out, target="dsec" if name.startswith("dsec") else None)
    assert found["events"] == found["events_kept"] == 20_000
    again = open_recording(out, size=(W, H))
    assert_same(whole(again), whole(recording))
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    if name in ("a.h5", "folder", "a.zip"):
        assert again.ground_truth is not None and again.camera == recording.camera
        np.testing.assert_allclose(again.ground_truth.positions, recording.ground_truth.positions, atol=1e-12)
        np.testing.assert_array_equal(again.ground_truth.t_us, recording.ground_truth.t_us)
    if not name.startswith("dsec"):
        assert again.imu is not None and again.frames is not None
        np.testing.assert_allclose(again.imu.gyro, recording.imu.gyro, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(again.imu.accel, recording.imu.accel, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(again.frames.t_us, recording.frames.t_us)
        np.testing.assert_array_equal(again.frames.read(2), recording.frames.read(2))


def test_dsec_index(tmp_path: Path, recording: Recording) -> None:
    convert(recording, tmp_path / "d.h5", target="dsec")
    with h5py.File(tmp_path / "d.h5") as file:
        t, index = file["events/t"][:].astype(np.int64), file["ms_to_idx"][:]
        assert file["t_offset"][()] == START and len(index) == 1000
        np.testing.assert_array_equal(index, np.searchsorted(t, 1000 * np.arange(1000)))
    long = replace(
        recording,
        events=MemoryEvents(
            Events(
                t_us=np.array([0, 1 << 32], np.int64),
                x_px=np.zeros(2, np.uint16),
                y_px=np.zeros(2, np.uint16),
                is_positive=np.ones(2, bool),
            )
        ),
    )
    with pytest.raises(FormatError, match="longer than 71 minutes"):
        convert(long, tmp_path / "l.h5", target="dsec")


def test_parts(tmp_path: Path, recording: Recording) -> None:
    part = Selection(start_s=0.25, end_s=0.75, roi=(10, 4, 50, 40), stride=3)
    convert(recording, tmp_path / "p.h5", selection=part)
    again, events = open_recording(tmp_path / "p.h5"), whole(recording)
    t, x, y = events.t_us - START, events.x_px.astype(int), events.y_px.astype(int)
    wanted = (t >= 250_000) & (t < 750_000) & (x >= 10) & (x < 60) & (y >= 4) & (y < 44)
    k = np.flatnonzero(wanted)[::3]
    found = whole(again)
    np.testing.assert_array_equal(found.t_us, events.t_us[k])
    np.testing.assert_array_equal(found.x_px, x[k] - 10)
    np.testing.assert_array_equal(found.y_px, y[k] - 4)
    assert (again.camera.width, again.camera.height, again.camera.cx, again.camera.cy) == (50, 40, 37, 27)
    # The bearing of a pixel is that of the same pixel of the whole sensor.
    np.testing.assert_allclose(
        again.camera.bearing_table(), recording.camera.bearing_table()[4:44, 10:60], atol=1e-6
    )
    assert again.frames is not None and again.frames.t_us.tolist() == [START + 500_000]
    np.testing.assert_array_equal(again.frames.read(0), recording.frames.read(1)[4:44, 10:60])
    assert again.ground_truth is not None
    assert again.ground_truth.t_us[0] == START + 250_000 and again.ground_truth.t_us[-1] == START + 750_000
    assert again.imu is not None and again.imu.t_us[0] == START + 250_000 and len(again.imu.t_us) == 50


def test_filters_while_converting_and_while_opening(tmp_path: Path, recording: Recording) -> None:
    config = FilterConfig(hot_pixels=True, background_us=20_000, refractory_us=300)
    found = convert(recording, tmp_path / "f.h5", selection=Selection(filters=config))
    hot = np.zeros((H, W), bool)
    hot[9, 17] = True
    expected = EventFilter(W, H, config, hot)(whole(recording))
    assert 0 < found["events_kept"] == len(expected) < 19_500
    assert_same(whole(open_recording(tmp_path / "f.h5")), expected)
    convert(recording, tmp_path / "w.h5")
    opened = open_recording(tmp_path / "w.h5", filters=config)
    assert_same(whole(opened), expected)
    assert opened.events_before_filters == 20_000 and opened.filters == config and opened.imu is not None
    # The unfiltered recording is there beside the filtered copy.
    assert open_recording(tmp_path / "w.h5").events.count == 20_000


def test_truth_alone(tmp_path: Path, recording: Recording) -> None:
    convert(recording, tmp_path / "t.tum", selection=Selection(start_s=0.5))
    truth = read_ground_truth(tmp_path / "t.tum")
    np.testing.assert_array_equal(truth.t_us, recording.ground_truth.t_us[10:21])
    with pytest.raises(FormatError, match="no ground truth"):
        convert(replace(recording, ground_truth=None), tmp_path / "n.tum")


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        (Selection(start_s=2), "from 2 to"),
        (Selection(start_s=0.5, end_s=0.2), "from 0.5 to 0.2"),
        (Selection(stride=0), "--stride"),
        (Selection(roi=(90, 0, 20, 20)), "--roi: 90,0,20,20 lies outside"),
        (Selection(start_s=0.1, end_s=0.1), "no event is left"),
    ],
)
def test_parts_that_are_none(tmp_path: Path, recording: Recording, selection: Selection, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        convert(recording, tmp_path / "x.h5", selection=selection)
    assert not list(tmp_path.iterdir())


def test_endings() -> None:
    assert target_of(Path("a.H5")) == "hdf5" and target_of(Path("a.h5"), "dsec") == "dsec"
    with pytest.raises(FormatError, match="cannot tell a format"):
        target_of(Path("a.bag"))


def test_command(tmp_path: Path, recording: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    convert(recording, tmp_path / "w.h5")
    (tmp_path / "t.csv").write_text(
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
        f"{START * 1000},1,2,3,1,0,0,0,9,9\n{(START + 50_000) * 1000},2,2,3,0,1,0,0,9,9\n"
    )
    wanted = ["convert", str(tmp_path / "w.h5"), str(tmp_path / "o.h5"), "--start", "0.5", "--json"]
    assert main([*wanted, "--ground-truth", str(tmp_path / "t.csv"), "--gt-offset", "0.5"]) == 0
    assert json.loads(capsys.readouterr().out)["target"] == "hdf5"
    truth = open_recording(tmp_path / "o.h5").ground_truth
    assert truth is not None and truth.t_us.tolist() == [START + 500_000, START + 550_000]
    np.testing.assert_allclose(truth.positions, [[1, 2, 3], [2, 2, 3]])
    np.testing.assert_allclose(truth.rotations[1], np.diag([1, -1, -1]), atol=1e-12)
    assert main(wanted) == 2 and "--force" in capsys.readouterr().err
    filters = ["--hot-pixels", "--refractory", "500"]
    assert main(["info", str(tmp_path / "w.h5"), *filters, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["events_before_filters"] == 20_000 > found["events"] and found["filters"]["refractory_us"] == 500
    assert main(["info", str(tmp_path / "w.h5"), *filters]) == 0
    assert "events kept" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "w.h5")]) == 0
    assert "(17, 9) 5" in (text := capsys.readouterr().out) and "▇" in text
    assert main(["info", str(tmp_path / "w.h5"), "--ground-truth", "/pose"]) == 2
    assert "the recording is no bag" in capsys.readouterr().err


def test_a_guessed_calibration_is_not_written_as_a_real_one(recording: Recording, tmp_path: Path) -> None:
    guessed = replace(recording, camera=Camera.guess(W, H), frames=None)
    write_uzh(guessed, tmp_path / "out")
    assert not (tmp_path / "out" / "calib.txt").exists()
    again = open_recording(tmp_path / "out")
    assert again.camera.is_guess and (again.camera.width, again.camera.height) == (W, H)
    assert again.events.count == recording.events.count
