from pathlib import Path

import numpy as np
import pytest

from dvsviz.events.events import Events
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.formats.info import describe, sparkline
from dvsviz.geometry.camera import Camera


def test_known_answers(tmp_path: Path) -> None:
    t = np.concatenate([np.arange(100) * 1000, 400_000 + np.arange(50) * 1000])
    x, y, p = np.arange(150) % 31, np.arange(150) % 17, np.arange(150) % 2
    t[7], x[7], y[7], p[7] = t[6], x[6], y[6], p[6]
    t[9], x[9], y[9], p[9] = t[8], x[8], y[8], 1 - p[8]
    events = Events(
        t_us=t.astype(np.int64), x_px=x.astype(np.uint16), y_px=y.astype(np.uint16), is_positive=p.astype(bool)
    )
    with RecordingWriter(
        tmp_path / "r.h5", camera=Camera(width=31, height=17, fx=30, fy=30, cx=15, cy=8)
    ) as writer:
        writer.append(events)
        writer.append_frame(5, np.zeros((17, 31), np.uint8))
    found = describe(tmp_path / "r.h5")
    assert found["format"] == "dvsviz-recording 1" and found["name"] == "r"
    assert (found["events"], found["width"], found["height"]) == (150, 31, 17)
    assert (found["first_us"], found["last_us"], found["duration_s"]) == (0, 449_000, pytest.approx(0.449))
    assert found["rate_hz"] == pytest.approx(150 / 0.449)
    assert found["streams"] == {"events": 150, "ground_truth": 0, "imu": 0, "frames": 1, "triggers": 0}
    assert found["calibrated"] is True and found["camera"]["fx"] == 30 and found["warnings"] == []
    assert (found["duplicates"], found["gaps"]) == (1, 1) and found["longest_gap_s"] == pytest.approx(0.301)
    assert found["positive_share"] == pytest.approx(p.sum() / 150)
    rates = np.array(found["rate_over_time_hz"])
    assert len(rates) == 60 and rates.sum() * 0.449 / 60 == pytest.approx(150)
    assert found["peak_rate_hz"] == rates.max() and found["hot_pixels"] == 0


def test_a_hot_pixel_is_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 30_000
    x, y = rng.integers(0, 31, n), rng.integers(0, 17, n)
    x[::5], y[::5] = 12, 3
    events = Events(
        t_us=np.arange(n, dtype=np.int64),
        x_px=x.astype(np.uint16),
        y_px=y.astype(np.uint16),
        is_positive=np.ones(n, bool),
    )
    with RecordingWriter(tmp_path / "r.h5", camera=Camera.guess(31, 17)) as writer:
        writer.append(events)
    found = describe(tmp_path / "r.h5")
    assert found["hot_pixels"] == 1 and found["hot_share"] == pytest.approx(0.2, abs=0.01)
    assert found["calibrated"] is False and "no calibration" in found["warnings"][0]


def test_sparkline() -> None:
    assert sparkline(np.array([0.0, 4.0, 8.0])) == "▁▅█"
    assert sparkline(np.zeros(2)) == "▁▁"
