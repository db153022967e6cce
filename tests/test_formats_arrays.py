from pathlib import Path

import numpy as np
import pytest

from dvsviz.errors import FormatError
from dvsviz.formats.open import open_recording

T = np.array([10, 20, 20, 35], np.int64)
X, Y, P = np.array([3, 239, 0, 7]), np.array([0, 179, 100, 5]), np.array([1, 0, 1, 0], np.uint8)


def check(recording) -> None:
    events = recording.events.read(0, 9)
    np.testing.assert_array_equal(events.t_us, T)
    np.testing.assert_array_equal(events.x_px, X)
    np.testing.assert_array_equal(events.y_px, Y)
    np.testing.assert_array_equal(events.is_positive, P > 0)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint16, np.int64, np.float32])
@pytest.mark.parametrize("polarity", ["0/1", "-1/1", "bool"])
def test_npz_columns(tmp_path: Path, save, kind, polarity: str) -> None:
    p = {"0/1": P, "-1/1": 2 * P.astype(np.int8) - 1, "bool": P > 0}[polarity]
    save(tmp_path / "e.npz", t_us=T, x=X.astype(kind), y=Y.astype(kind), p=p)
    check(open_recording(tmp_path / "e.npz", size=(240, 180)))


def test_size_is_assumed_only_where_the_pixels_fill_a_known_sensor(tmp_path: Path) -> None:
    np.savez(tmp_path / "full.npz", t_us=T, x=X, y=Y, p=P)
    recording = open_recording(tmp_path / "full.npz")
    assert (recording.camera.width, recording.camera.height) == (240, 180)
    assert "assumed from the largest pixel" in recording.warnings[0]
    np.savez(tmp_path / "part.npz", t_us=T, x=X // 2, y=Y // 2, p=P)
    with pytest.raises(
        FormatError, match=r"size is not recorded; give it with --size WxH \(the largest pixel is 119, 89\)"
    ):
        open_recording(tmp_path / "part.npz")


def test_npy_structured_and_plain(tmp_path: Path) -> None:
    rows = np.zeros(4, [("x", "<u2"), ("y", "<u2"), ("timestamp", "<i8"), ("polarity", "?")])
    rows["x"], rows["y"], rows["timestamp"], rows["polarity"] = X, Y, T, P
    np.save(tmp_path / "s.npy", rows)
    check(open_recording(tmp_path / "s.npy", size=(240, 180)))
    for name, columns in {"txyp": (T, X, Y, P), "xytp": (X, Y, T, P), "xypt": (X, Y, P, T)}.items():
        np.save(tmp_path / f"{name}.npy", np.stack(columns, axis=1))
        check(open_recording(tmp_path / f"{name}.npy", size=(240, 180)))
        np.savez(tmp_path / f"{name}.npz", events=np.stack(columns, axis=1))
        check(open_recording(tmp_path / f"{name}.npz", size=(240, 180)))


def test_seconds_as_floats(tmp_path: Path) -> None:
    np.savez(tmp_path / "e.npz", t=T * 1e-6, x=X, y=Y, p=P)
    recording = open_recording(tmp_path / "e.npz", size=(240, 180))
    check(recording)
    assert "taken as seconds" in " ".join(recording.warnings)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"t": T, "x": X, "y": Y}, "no columns t, x, y, p among t, x, y"),
        ({"t": T, "x": X, "y": Y, "p": P[:2]}, "differ in size"),
        ({"t": T[::-1].copy(), "x": X, "y": Y, "p": P}, "event 1: time runs backwards"),
        ({"t": T, "x": X + 1, "y": Y, "p": P}, r"event 1: pixel \(240, 179\) lies outside"),
        ({"t": T, "x": X - 1, "y": Y, "p": P}, "event 2: pixel .* lies outside"),
        ({"t": T, "x": X + 0.5, "y": Y, "p": P}, "not a whole number"),
        ({"t": T[:0], "x": X[:0], "y": Y[:0], "p": P[:0]}, "no events"),
        ({"t": np.array([1.5, np.nan, 2, 3]), "x": X, "y": Y, "p": P}, "not finite"),
        ({"t": np.array([None] * 4), "x": X, "y": Y, "p": P}, "Python objects"),
    ],
)
def test_bad_arrays(tmp_path: Path, arrays, message: str) -> None:
    np.savez(tmp_path / "e.npz", **arrays)
    with pytest.raises(FormatError, match=message) as caught:
        open_recording(tmp_path / "e.npz", size=(240, 180))
    assert "e.npz" in str(caught.value) and caught.value.hint and "\n" not in str(caught.value)


def test_repair_counts(tmp_path: Path) -> None:
    np.savez(tmp_path / "e.npz", t=T[[0, 3, 1, 2, 3, 3]], x=[1, 2, 3, 4, 5, 999], y=[1] * 6, p=[1] * 6)
    recording = open_recording(tmp_path / "e.npz", size=(240, 180), repair=True)
    np.testing.assert_array_equal(recording.events.read(0, 9).t_us, [10, 35, 35])
    assert "2 events whose time ran backwards" in " ".join(recording.warnings)
    assert "1 event outside the sensor" in " ".join(recording.warnings)


def test_cut_short(tmp_path: Path) -> None:
    np.save(tmp_path / "e.npy", np.stack([T, X, Y, P], axis=1))
    data = (tmp_path / "e.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(data[:-20])
    with pytest.raises(FormatError, match="cut short"):
        open_recording(tmp_path / "cut.npy", size=(240, 180))
    # A header that claims a trillion rows is refused without memory being asked for.
    (tmp_path / "huge.npy").write_bytes(
        data.replace(b"(4, 4), ", b"(10**12,4), ".replace(b"10**12", b"999999999999"))
    )
    with pytest.raises(FormatError):
        open_recording(tmp_path / "huge.npy", size=(240, 180))


@pytest.mark.data
def test_rotdisk(data_dir: Path) -> None:
    recording = open_recording(data_dir / "gyro/rotdisk_events.npz", size=(240, 180))
    assert recording.events.count == 374_296 and round(recording.duration_s, 3) == 3.167


@pytest.mark.parametrize("bits", [31, 32])
def test_repair_carries_on_a_clock_that_wraps(tmp_path: Path, bits: int) -> None:
    t = np.arange(2000) * 1000 + (1 << bits) - 1_000_000
    x, p = np.arange(2000) % 240, np.arange(2000) % 2
    np.savez(tmp_path / "e.npz", t=t % (1 << bits), x=x, y=x % 180, p=p)
    with pytest.raises(FormatError, match="event 1000: time runs backwards"):
        open_recording(tmp_path / "e.npz", size=(240, 180))
    recording = open_recording(tmp_path / "e.npz", size=(240, 180), repair=True)
    np.testing.assert_array_equal(recording.events.read(0, 2000).t_us, t)
    assert "a clock that began anew at its largest number once was carried on" in recording.warnings[0]
