"""Every real recording beside the checkout: counts of its README, and checks by independent files and libraries."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from dvsviz.events.events import Events
from dvsviz.events.recording import Recording
from dvsviz.formats.open import open_recording

pytestmark = pytest.mark.data

COUNTS = {
    "formats/davis346.aedat4": (78_830, (346, 260), 2.36),
    "formats/evt3.raw": (1_218_618, (1280, 720), 10.77),
    "formats/gen4.dat": (1_218_618, (1280, 720), 10.77),
    "formats/evt2.raw": (521_252, (640, 480), 0.096),
    "formats/dvs.es": (473_225, (320, 240), 0.999),
    "formats/atis.es": (473_225, (320, 240), 0.999),
    "formats/test_events_1.bag": (343_474, (640, 480), 2.08),
    "formats/test_events_1": (343_474, (640, 480), 2.08),
    "formats/test_events_1/test_events_1.db3": (343_474, (640, 480), 2.08),
    "formats/test_events_2": (571_266, (346, 260), 1.0),
    "gyro/rotdisk.aedat": (374_296, (240, 180), 3.167),
    "gyro/rotdisk_events.npz": (374_296, (240, 180), 3.167),
    "dvs128/garfield.mat": (202_235, (128, 128), None),
    "dvs128/building.mat": (115_839, (128, 128), None),
}


def whole(recording: Recording) -> Events:
    return recording.events.read(0, recording.events.count)


def assert_same(a: Events, b: Events, later_us: int = 0) -> None:
    np.testing.assert_array_equal(a.t_us, b.t_us + later_us)
    np.testing.assert_array_equal(a.x_px, b.x_px)
    np.testing.assert_array_equal(a.y_px, b.y_px)
    np.testing.assert_array_equal(a.is_positive, b.is_positive)


@pytest.mark.parametrize("name", COUNTS)
def test_counts(data_dir: Path, name: str) -> None:
    count, size, duration_s = COUNTS[name]
    recording = open_recording(data_dir / name)
    assert recording.events.count == count
    assert (recording.camera.width, recording.camera.height) == size
    if duration_s is not None:
        assert recording.duration_s == pytest.approx(duration_s, abs=0.01)


def test_evt3_and_dat_are_the_same_events(data_dir: Path) -> None:
    raw, dat = open_recording(data_dir / "formats/evt3.raw"), open_recording(data_dir / "formats/gen4.dat")
    assert_same(whole(raw), whole(dat), later_us=11_194_368)


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", ["evt2.raw", "evt3.raw"])
def test_raw_against_evlib(data_dir: Path, name: str) -> None:
    import evlib

    ours = whole(open_recording(data_dir / "formats" / name))
    theirs = evlib.load_events(str(data_dir / "formats" / name), sort=False).collect()
    np.testing.assert_array_equal(ours.x_px, theirs["x"].to_numpy())
    np.testing.assert_array_equal(ours.y_px, theirs["y"].to_numpy())
    np.testing.assert_array_equal(ours.is_positive, theirs["polarity"].to_numpy() > 0)
    t = theirs["t"].dt.total_microseconds().to_numpy()
    np.testing.assert_array_equal(np.diff(ours.t_us), np.diff(t))


def test_a_bag_by_another_name(data_dir: Path, tmp_path: Path) -> None:
    shutil.copy(data_dir / "formats/test_events_1/test_events_1.db3", tmp_path / "bag.bin")
    assert open_recording(tmp_path / "bag.bin").events.count == 343_474


def test_bags_of_both_versions_are_the_same_events(data_dir: Path) -> None:
    one, two = (open_recording(data_dir / "formats" / name) for name in ("test_events_1.bag", "test_events_1"))
    assert_same(whole(one), whole(two))
    on = int(whole(one).is_positive.sum())
    assert (on, one.events.count - on) == (125_183, 218_291)


def test_dvs_and_atis_streams(data_dir: Path) -> None:
    dvs, atis = (open_recording(data_dir / "formats" / name) for name in ("dvs.es", "atis.es"))
    a, b = whole(dvs), whole(atis)
    np.testing.assert_array_equal(a.x_px, b.x_px)
    assert "exposure measurements left out" in atis.warnings[0]


def test_rotdisk_against_the_arrays_and_the_table(data_dir: Path) -> None:
    aedat, arrays = (open_recording(data_dir / "gyro" / n) for n in ("rotdisk.aedat", "rotdisk_events.npz"))
    assert_same(whole(aedat), whole(arrays))
    table = np.loadtxt(data_dir / "gyro/rotdisk_imu.csv", delimiter=",", skiprows=1)
    assert aedat.imu is not None
    np.testing.assert_array_equal(aedat.imu.t_us, table[:, 0])
    np.testing.assert_allclose(aedat.imu.gyro, table[:, 8:11], atol=1e-6)
    np.testing.assert_allclose(aedat.imu.accel, table[:, 4:7] * [-9.80665, 9.80665, -9.80665], atol=1e-4)


def test_davis346_streams(data_dir: Path) -> None:
    recording = open_recording(data_dir / "formats/davis346.aedat4")
    assert recording.frames is not None and recording.imu is not None
    assert recording.frames.read(0).shape == (260, 346) and len(recording.frames.t_us) == 59
    kinds = ("exposure end", "exposure start", "frame end", "frame start")
    assert recording.triggers == {f"aps {kind}": 59 for kind in kinds}
    # At rest the length of the specific force is that of gravity.
    assert np.median(np.linalg.norm(recording.imu.accel, axis=1)) == pytest.approx(9.81, abs=0.5)
