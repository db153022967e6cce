"""A recording that is being written: what is there is read, what comes is waited for, and it gets its name whole."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.formats.hdf5_growing import GrowingEvents, open_growing
from dvsviz.formats.hdf5_rescue import rescue
from dvsviz.formats.hdf5_writer import growing_path
from dvsviz.formats.open import open_recording
from dvsviz.geometry.camera import Camera

CAMERA = Camera(width=96, height=64, fx=80, fy=81, cx=47, cy=31)


def events(first: int, n: int) -> Events:
    at = np.arange(first, first + n)
    return Events(
        t_us=5_000_000 + 10 * at,
        x_px=(at % 96).astype(np.uint16),
        y_px=(at % 64).astype(np.uint16),
        is_positive=at % 3 == 0,
    )


def assert_same(a: Events, b: Events) -> None:
    for name in ("t_us", "x_px", "y_px", "is_positive"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_it_is_read_while_it_grows(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    assert open_growing(path, CAMERA) is None
    with RecordingWriter(path, camera=CAMERA, growing=True) as writer:
        writer.append(events(0, 1000))
        recording = open_growing(path, CAMERA)
        assert recording is not None and isinstance(recording.events, GrowingEvents)
        assert recording.path == path and not path.exists()
        source = recording.events
        assert source.count == 1000 and recording.first_us == 5_000_000
        assert_same(source.read(990, 1100), events(990, 10))
        assert not source.wait(1001)
        adding = threading.Thread(target=lambda: (time.sleep(0.1), writer.append(events(1000, 100_000))))
        adding.start()
        assert source.wait(101_000)
        adding.join()
        assert_same(source.read(65_000, 66_000), events(65_000, 1000))
        assert source.index_at(5_000_000 + 10 * 70_000 - 3) == 70_000
    # The reader's file is still there where the whole one has got its name.
    assert not growing_path(path).exists()
    assert_same(source.read(100_999, 200_000), events(100_999, 1))
    recording.close()
    assert_same(open_recording(path).events.read(0, 200_000), events(0, 101_000))
    assert open_recording(path).camera == CAMERA


def test_what_holds_no_events_is_no_recording(tmp_path: Path) -> None:
    with h5py.File(growing_path(tmp_path / "r.h5"), "w", libver="latest") as file:
        file.create_group("events")
    with pytest.raises(KeyError):
        GrowingEvents(growing_path(tmp_path / "r.h5"))
    assert open_growing(tmp_path / "r.h5", CAMERA) is None


# Records until it is killed; says after each addition that it is on the disk.
RECORDER = """
import sys, time
from pathlib import Path
import test_formats_growing as samples
from dvsviz.formats.hdf5 import RecordingWriter
with RecordingWriter(Path(sys.argv[1]), camera=samples.CAMERA, growing=True) as writer:
    for first in range(0, 400_000, 100_000):
        writer.append(samples.events(first, 100_000))
        print(first + 100_000, flush=True)
    time.sleep(60)
"""


def test_what_a_killed_run_recorded_is_saved(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [sys.executable, "-c", RECORDER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as recorder:
        assert recorder.stdout is not None
        while recorder.stdout.readline() != b"400000\n":
            assert recorder.poll() is None
        # A run that is under way is left alone, by those who would save and by those who would record there.
        assert rescue(path) is None
        with pytest.raises(FormatError, match="is being recorded by another run"):
            RecordingWriter(path, camera=CAMERA, growing=True)
        recorder.send_signal(signal.SIGKILL)
    assert growing_path(path).is_file() and not path.exists()
    recording = open_recording(path)
    assert not growing_path(path).exists()
    assert recording.camera == CAMERA
    assert_same(recording.events.read(0, 500_000), events(0, 400_000))
    # What is there already is not touched, whatever lies beside it.
    growing_path(path).write_bytes(b"")
    assert rescue(path) is None


def test_events_that_had_not_reached_the_disk_end_what_is_saved(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with h5py.File(growing_path(path), "w", libver="latest") as file:
        file.attrs.update(format="dvsviz-recording", version=1, width=96, height=64)
        whole = events(0, 1000)
        t = whole.t_us.copy()
        t[700:] = 0
        for name, values in (
            ("t", t),
            ("x", whole.x_px),
            ("y", whole.y_px),
            ("p", whole.is_positive.view(np.uint8)),
        ):
            file.create_dataset(f"events/{name}", data=values, maxshape=(None,), chunks=(1 << 10,))
    assert rescue(path) == 700
    assert_same(open_recording(path).events.read(0, 1000), events(0, 700))


def test_a_leftover_without_events_is_no_recording(tmp_path: Path) -> None:
    growing_path(tmp_path / "r.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(FormatError, match="no such file"):
        open_recording(tmp_path / "r.h5")
