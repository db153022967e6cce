"""The simulator: its truth is the truth, its events are those of the definition, the same seed gives the same bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvsviz.events.recording import Recording
from dvsviz.formats.hdf5 import read_recording
from dvsviz.geometry.camera import Camera
from dvsviz.simulate.simulate import simulate

SMALL = Camera(width=90, height=60, fx=80.0, fy=80.0, cx=44.5, cy=29.5)


def make(path: Path, **options) -> Recording:
    simulate(path, camera=SMALL, **{"seconds": 0.6, **options})
    return read_recording(path)


def test_truth_spans_the_events_at_200_hz_and_above(tmp_path: Path) -> None:
    recording = make(tmp_path / "a.h5")
    truth = recording.ground_truth
    assert truth is not None
    assert truth.t_us[0] == recording.first_us
    assert truth.t_us[-1] == recording.last_us
    assert np.diff(truth.t_us).max() <= 5000
    assert recording.imu is not None
    assert np.all(np.diff(recording.imu.t_us) == 1000)


def test_same_seed_same_bits_other_seed_other_events(tmp_path: Path) -> None:
    a, b, c = (make(tmp_path / f"{name}.h5", seed=seed) for name, seed in (("a", 3), ("b", 3), ("c", 4)))
    ea, eb = a.events.read(0, a.events.count), b.events.read(0, b.events.count)
    for name in ("t_us", "x_px", "y_px", "is_positive"):
        assert np.array_equal(getattr(ea, name), getattr(eb, name))
    assert a.events.count != c.events.count
