import shutil
import zipfile
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvsviz.errors import DvsvizError, FormatError
from dvsviz.formats.cache import cache_folder
from dvsviz.formats.open import open_recording

CALIB = "199.1 198.8 132.2 110.7 -0.37 0.15 -0.0003 -0.0008 0.0\n"
EVENTS = "0.003811000 96 133 0\n0.003820001 127 171 1\n0.003820501 4 160 0\n"
TRUTH = "0.0 1 2 3 0 0 0 1\n0.01 1 2 4 0 0.7071067811865476 0 0.7071067811865476\n"


def folder(root: Path, **files: str | bytes) -> Path:
    made = root / "recording"
    made.mkdir()
    for name, content in {"events": EVENTS, "calib": CALIB, **files}.items():
        data = content.encode() if isinstance(content, str) else content
        (made / f"{name}.txt").write_bytes(data)
    return made


def test_a_folder_with_everything(tmp_path: Path) -> None:
    path = folder(
        tmp_path,
        groundtruth=TRUTH,
        images="0.000000000 images/a.png\n0.038766001 images/b.png\n",
        imu="0.001 1 2 3 4 5 6\n0.002 1 2 3 4 5 6\n",
    )
    (path / "images").mkdir()
    frames = np.random.default_rng(0).integers(0, 255, (2, 180, 200)).astype(np.uint8)
    for name, frame in zip("ab", frames, strict=True):
        assert cv2.imwrite(str(path / f"images/{name}.png"), frame)
    recording = open_recording(path)
    events = recording.events.read(0, 10)
    np.testing.assert_array_equal(events.t_us, [3811, 3820, 3821])
    np.testing.assert_array_equal(events.x_px, [96, 127, 4])
    np.testing.assert_array_equal(events.y_px, [133, 171, 160])
    np.testing.assert_array_equal(events.is_positive, [False, True, False])
    camera = recording.camera
    assert (camera.width, camera.height) == (200, 180), "the size is that of the frames"
    assert (camera.fx, camera.cy, camera.distortion[1]) == (199.1, 110.7, 0.15) and not camera.is_guess
    assert recording.ground_truth is not None and recording.imu is not None and recording.frames is not None
    np.testing.assert_array_equal(recording.ground_truth.t_us, [0, 10_000])
    # Quaternion (x, y, z, w) = (0, s, 0, s): a quarter turn about y takes z to x.
    np.testing.assert_allclose(recording.ground_truth.Ts_world_camera[1, :3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(recording.imu.accel[0], [1, 2, 3])
    np.testing.assert_array_equal(recording.imu.gyro[0], [4, 5, 6])
    np.testing.assert_array_equal(recording.frames.t_us, [0, 38_766])
    np.testing.assert_array_equal(recording.frames.read(1), frames[1])
    assert recording.warnings == () and recording.name == "recording"


def test_without_size_and_calibration(tmp_path: Path) -> None:
    path = folder(tmp_path)
    (path / "calib.txt").unlink()
    recording = open_recording(path)
    assert (recording.camera.width, recording.camera.height, recording.camera.is_guess) == (240, 180, True)
    assert "240x180 assumed" in recording.warnings[0] and "no calibration" in recording.warnings[1]
    (tmp_path / "c.txt").write_text(CALIB)
    given = open_recording(path, size=(346, 260), calibration=tmp_path / "c.txt")
    assert (given.camera.width, given.camera.fx, given.camera.is_guess) == (346, 199.1, False)
    assert given.warnings == ()


def _exact(seconds: str) -> int:
    return int((Decimal(seconds) * 1_000_000).to_integral_value(rounding=ROUND_HALF_UP))


@settings(max_examples=60, deadline=None)
@given(
    digits=st.lists(st.integers(0, 10**18 - 1), min_size=1, max_size=50),
    decimals=st.integers(1, 12),
    separator=st.sampled_from([" ", "\t", ", ", "  "]),
    newline=st.sampled_from(["\n", "\r\n"]),
)
def test_times_are_exact(tmp_path_factory, digits, decimals, separator, newline) -> None:
    times = [Decimal(d).scaleb(-decimals) for d in sorted(digits)]
    texts = [f"{t:.{decimals}f}" for t in times]
    lines = newline.join(separator.join((text, "3", "4", "-1")) for text in texts)
    path = tmp_path_factory.mktemp("times") / "any-name"
    path.write_bytes(lines.encode())
    expected = [_exact(text) for text in texts]
    if expected[-1] > 9 * 10**17:
        return
    events = open_recording(path).events.read(0, len(times))
    np.testing.assert_array_equal(events.t_us, expected)
    assert not events.is_positive.any()


def test_numbers_as_other_programs_write_them(tmp_path: Path) -> None:
    path = folder(
        tmp_path,
        events="# t x y p\n240 180\n\n1.8579911e+01 9.6e+01 1.33e2 1.0\n18.5799119999 +5 06 1 \n18.6 1 1 0",
    )
    events = open_recording(path).events.read(0, 9)
    np.testing.assert_array_equal(events.t_us, [18_579_911, 18_579_912, 18_600_000])
    np.testing.assert_array_equal(events.x_px, [96, 5, 1])
    np.testing.assert_array_equal(events.y_px, [133, 6, 1])
    (path / "events.txt").write_text("18579911 1 2 0\n18579912 1 2 1\n")
    recording = open_recording(path)
    assert recording.first_us == 18_579_911 and "taken as microseconds" in " ".join(recording.warnings)


BAD = {
    "events empty": ({"events": ""}, "events.txt", "no events"),
    "events blank": ({"events": "\n# nothing\n"}, "events.txt", "no events"),
    "letters in a number": (
        {"events": EVENTS + "0.00z9 1 2 0\n"},
        "events.txt, line 4",
        "not a number in `0.00z9 1 2 0`",
    ),
    "letters in a pixel": ({"events": EVENTS + "0.009 1a 2 0\n"}, "events.txt, line 4", "not a number"),
    "not a number": ({"events": EVENTS + "nan 1 2 0\n"}, "events.txt, line 4", "not a number"),
    "three columns": ({"events": EVENTS + "0.009 1 2\n"}, "events.txt, line 4", "got fewer"),
    "five columns": ({"events": EVENTS + "0.009 1 2 0 7\n"}, "events.txt, line 4", "got more"),
    "half a pixel": ({"events": EVENTS + "0.009 1.5 2 0\n"}, "events.txt, line 4", "not a whole number"),
    "polarity": ({"events": EVENTS + "0.009 1 2 2\n"}, "events.txt, line 4", "polarity"),
    "unsorted": ({"events": EVENTS + "0.001 1 2 0\n"}, "events.txt, line 4", "time runs backwards"),
    "outside": ({"events": EVENTS + "0.009 240 2 0\n"}, "events.txt, line 4", "outside the sensor.*240x180"),
    "negative": ({"events": EVENTS + "0.009 -1 2 0\n"}, "events.txt, line 4", "outside the sensor"),
    "huge": ({"events": EVENTS + "9" * 30 + ".0 1 2 0\n"}, "events.txt, line 4", "out of range"),
    "binary": ({"events": EVENTS.encode() + b"\x00" * 50}, "events.txt", "not a text file"),
    "calibration of 4": ({"calib": "1 2 3 4\n"}, "calib.txt, line 1", "expected 9 numbers, got 4"),
    "calibration empty": ({"calib": "\n"}, "calib.txt", "no calibration"),
    "calibration letters": ({"calib": CALIB.replace("0.15", "O.15")}, "calib.txt, line 1", "not a number"),
    "calibration focal": ({"calib": CALIB.replace("199.1", "-1")}, "calib.txt, line 1", "focal lengths above 0"),
    "pose NaN": (
        {"groundtruth": TRUTH + "0.02 nan 2 3 0 0 0 1\n"},
        "groundtruth.txt, line 3",
        "not a finite number",
    ),
    "pose of 7": ({"groundtruth": TRUTH + "0.02 2 3 0 0 0 1\n"}, "groundtruth.txt, line 3", "expected 8 numbers"),
    "pose twice": ({"groundtruth": TRUTH + "0.01 1 2 3 0 0 0 1\n"}, "groundtruth.txt, line 3", "not after the one"),
    "pose quaternion": ({"groundtruth": TRUTH + "0.02 1 2 3 0 0 0 0\n"}, "groundtruth.txt, pose 2", "length 0"),
    "imu": ({"imu": "0.1 1 2 3 4 5\n"}, "imu.txt, line 1", "expected 7 numbers"),
    "frame list": ({"images": "zero a.png\n"}, "images.txt, line 1", "expected a number"),
    "frame": ({"images": "0.0 calib.txt\n"}, "calib.txt", "not an image"),
    "frame elsewhere": ({"images": "0.0 ../secret.png\n"}, "recording", "leads out of the folder"),
}


@pytest.mark.parametrize("what", BAD)
@pytest.mark.parametrize("packed", [False, True])
def test_bad_input_is_one_clear_line(tmp_path: Path, what: str, packed: bool) -> None:
    files, place, message = BAD[what]
    path = folder(tmp_path, **files)
    if packed:
        if what == "frame elsewhere":
            return  # A name that leads out of an archive is a name that is not inside: a frame that is missing.
        path = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", path))
    with pytest.raises(DvsvizError, match=message) as caught:
        open_recording(path)
    text = str(caught.value)
    assert place.replace("recording", path.name) in text and str(path) in text, text
    assert caught.value.hint and "\n" not in text and len(text) < 400
    assert not list(cache_folder().glob(f"*{path.stem}*.part"))


REPAIRABLE = {
    "letters in a number": "1 line that is not an event dropped",
    "half a pixel": "1 line that is not an event",
    "unsorted": "1 event whose time ran backwards",
    "outside": "1 event outside the sensor",
    "negative": "1 event outside the sensor",
    "huge": "1 line that is not an event",
    "pose NaN": "1 pose of groundtruth.txt",
    "pose quaternion": "1 pose of groundtruth.txt",
    "imu": "1 line of imu.txt",
    "frame": "1 frame dropped",
}


@pytest.mark.parametrize("what", REPAIRABLE)
def test_repair_drops_and_counts(tmp_path: Path, what: str) -> None:
    recording = open_recording(folder(tmp_path, **BAD[what][0]), repair=True)
    np.testing.assert_array_equal(recording.events.read(0, 9).t_us, [3811, 3820, 3821])
    assert REPAIRABLE[what] in " ".join(recording.warnings)
    if "pose" in what:
        assert recording.ground_truth is not None and len(recording.ground_truth) == 2


def test_polarity_in_words(tmp_path: Path) -> None:
    lines = "0.1 5 6 True\n0.2 5 6 False\n0.3 5 6 true\n"
    recording = open_recording(folder(tmp_path, events=lines))
    np.testing.assert_array_equal(recording.events.read(0, 9).is_positive, [True, False, True])
    (tmp_path / "other.txt").write_text(lines + "0.4 5 6 Tree\n")
    with pytest.raises(FormatError, match=r"line 4: not a number in `0\.4 5 6 Tree`"):
        open_recording(tmp_path / "other.txt", size=(240, 180))


def test_repair_survives_a_time_far_ahead(tmp_path: Path) -> None:
    lines = [f"{1 + i * 1e-4:.6f} 5 6 1" for i in range(100)]
    lines[40] = "900000.000000 5 6 1"
    lines[0] = "800000.000000 5 6 1"
    recording = open_recording(folder(tmp_path, events="\n".join(lines)), repair=True)
    assert recording.events.count == 98 and recording.last_us == 1_009_900
    assert "2 events whose time ran backwards" in " ".join(recording.warnings)


def test_archives_that_are_none(tmp_path: Path) -> None:
    packed = Path(shutil.make_archive(str(tmp_path / "whole"), "zip", folder(tmp_path, events=EVENTS * 1)))
    assert open_recording(packed).events.count == 3
    data = packed.read_bytes()
    (tmp_path / "cut.zip").write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError, match=r"cut\.zip: not a whole zip archive; it was cut short"):
        open_recording(tmp_path / "cut.zip")
    # A flipped byte inside the packed events shows as damage of that file.
    flipped = bytearray(data)
    at = data.index(b"events.txt") + 14
    flipped[at] ^= 0xFF
    (tmp_path / "flipped.zip").write_bytes(bytes(flipped))
    with pytest.raises(FormatError, match=r"events\.txt"):
        open_recording(tmp_path / "flipped.zip")
    with (
        zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as bomb,
        bomb.open("events.txt", "w", force_zip64=True) as out,
    ):
        for _ in range(200):
            out.write(b"0" * (1 << 20))
    with pytest.raises(FormatError, match="unpack to more than 200 times its size"):
        open_recording(tmp_path / "bomb.zip")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as other:
        other.writestr("readme.md", "nothing")
    with pytest.raises(FormatError, match=r"no events\.txt in this archive"):
        open_recording(tmp_path / "other.zip")


def test_what_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file or folder"):
        open_recording(tmp_path / "absent.zip")
    with pytest.raises(FormatError, match="no recording in this folder"):
        open_recording(tmp_path)
    (tmp_path / "empty").touch()
    with pytest.raises(FormatError, match="the file is empty"):
        open_recording(tmp_path / "empty")
    (tmp_path / "text.txt").write_text("Dear reader, this is no recording.\n")
    with pytest.raises(FormatError, match="no recording of a known format"):
        open_recording(tmp_path / "text.txt")


def test_the_cache_is_used_renewed_and_rebuilt(tmp_path: Path) -> None:
    path = folder(tmp_path)
    calls: list[float] = []
    open_recording(path, progress=calls.append)
    assert calls[-1] == 1.0
    kept = list(cache_folder().glob("recording-*.h5"))
    calls.clear()
    open_recording(path, progress=calls.append)
    assert calls == [], "the second opening converts nothing"
    newest = max(kept, key=lambda file: file.stat().st_mtime_ns)
    newest.write_bytes(newest.read_bytes()[:3000])
    assert open_recording(path).events.count == 3, "a damaged cache is made again"
    (path / "events.txt").write_text(EVENTS + "0.9 1 1 1\n")
    assert open_recording(path).events.count == 4, "a changed source is converted again"
    assert not newest.exists(), "and what was made of its older state is removed"


@pytest.mark.data
def test_slider_depth(data_dir: Path, tmp_path: Path) -> None:
    packed = open_recording(data_dir / "ecd/slider_depth.zip")
    assert packed.name == "slider_depth" and packed.warnings == ()
    assert packed.events.count == 1_078_541
    assert (packed.first_us, packed.last_us) == (3811, 3_404_080)
    assert packed.ground_truth is not None and packed.frames is not None
    assert len(packed.ground_truth) == 339 and len(packed.frames.t_us) == 87
    x = packed.ground_truth.positions[:, 0]
    assert (round(x[0], 3), round(x[-1], 3)) == (0.112, 1.092)
    assert (packed.camera.width, packed.camera.height, packed.camera.fx) == (240, 180, 335.419462958)
    with zipfile.ZipFile(data_dir / "ecd/slider_depth.zip") as archive:
        archive.extractall(tmp_path / "slider_depth")
    unpacked = open_recording(tmp_path / "slider_depth")
    for first in range(0, packed.events.count, 1 << 19):
        a, b = (r.events.read(first, first + (1 << 19)) for r in (packed, unpacked))
        np.testing.assert_array_equal(a.t_us, b.t_us)
        np.testing.assert_array_equal(a.x_px, b.x_px)
    # The archive also holds the same events as arrays, made by another program.
    arrays = open_recording(tmp_path / "slider_depth/events.npz")
    np.testing.assert_array_equal(
        arrays.events.read(0, 1 << 21).x_px[-1000:], packed.events.read(1_077_541, 1 << 21).x_px
    )
    assert abs(arrays.events.read(0, 1 << 21).t_us - packed.events.read(0, 1 << 21).t_us).max() <= 1


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("shapes_start", 34_634),
        ("shapes_rotation", 30_000),
        ("poster_translation", 30_000),
        ("boxes_translation", 30_000),
        ("dynamic_translation", 30_000),
        ("poster_6dof_undistorted", 38_139),
        ("shapes_rotation_start", 120_000),
    ],
)
def test_other_sequences(data_dir: Path, name: str, count: int) -> None:
    recording = open_recording(data_dir / "ecd" / name)
    assert recording.events.count == count
    assert (recording.camera.width, recording.camera.height) == (240, 180) and not recording.camera.is_guess
    assert recording.camera.has_distortion is (name != "poster_6dof_undistorted")
