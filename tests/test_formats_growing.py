"""A recording that is being written: what is there is read, what comes is waited for, and it gets its name whole."""

import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from dvsviz.events.events import Events
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.formats.hdf5_growing import GrowingEvents, open_growing
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
