"""Noise: lonely events are left out, and windows that show nothing else move neither the camera nor the map."""

from pathlib import Path

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.events.events import Events
from dvsviz.events.windows import EventWindow, make_window, windows
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.session.records import Status
from dvsviz.simulate.event_camera import EventCameraModel
from dvsviz.simulate.simulate import simulate
from dvsviz.tracking import constants as c
from dvsviz.tracking.noise import without_noise
from dvsviz.tracking.tracker import Tracker

# Not square.
CAMERA = Camera(width=120, height=80, fx=100.0, fy=100.0, cx=59.5, cy=39.5)


def window_of(x: np.ndarray, y: np.ndarray) -> EventWindow:
    events = Events(
        t_us=np.arange(len(x), dtype=np.int64) * 5,
        x_px=x.astype(np.uint16),
        y_px=y.astype(np.uint16),
        is_positive=np.ones(len(x), dtype=bool),
    )
    return make_window(CAMERA, events)


def edge(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Events of an upright edge, two pixels wide and 50 high."""
    return rng.integers(60, 62, count), rng.integers(15, 65, count)


def noise(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    return rng.integers(0, CAMERA.width, count), rng.integers(0, CAMERA.height, count)


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> EventWindow:
    x, y = (np.concatenate(part) for part in zip(*parts, strict=True))
    return window_of(x, y)


def test_what_fires_alone_is_left_out_and_edges_stay() -> None:
    rng = np.random.default_rng(0)
    hot = np.full(60, 20), np.full(60, 30)
    window = joined(edge(rng, 900), noise(rng, 60), hot)
    heard, alike = without_noise(window, CAMERA.width, CAMERA.height)
    on_edge = (heard.events.x_px >= 60) & (heard.events.x_px < 62)
    assert np.count_nonzero(on_edge) >= 900
    assert np.count_nonzero(~on_edge) < 15
    assert not np.any((heard.events.x_px == 20) & (heard.events.y_px == 30))
    assert alike > c.NOISE_START_ALIKE
    assert (heard.start_us, heard.end_us) == (window.start_us, window.end_us)
    assert len(heard.bearings) == len(heard.events)


def test_corners_of_the_sensor_count() -> None:
    x, y = (np.repeat(some, 200) for some in ([0, 1, 119, 118, 60], [0, 0, 79, 79, 0]))
    heard, _ = without_noise(window_of(x, y), CAMERA.width, CAMERA.height)
    assert np.unique(heard.events.x_px).tolist() == [0, 1, 118, 119]


@pytest.mark.parametrize("count", [300, 2000, 20_000])
def test_noise_of_any_strength_is_not_alike(count: int) -> None:
    rng = np.random.default_rng(count)
    hot = np.repeat(rng.integers(0, CAMERA.width, 20), 40), np.repeat(rng.integers(0, CAMERA.height, 20), 40)
    _, alike = without_noise(joined(noise(rng, count), hot), CAMERA.width, CAMERA.height)
    assert abs(alike) < 0.5 * c.NOISE_ALIKE


def test_a_window_of_noise_alone_keeps_its_events() -> None:
    """Somebody has to say that there were any."""
    window = window_of(np.array([5, 50, 100]), np.array([5, 40, 70]))
    assert len(without_noise(window, CAMERA.width, CAMERA.height)[0]) == 3


def resting(t_s: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4): still for 0.6 s, a sideways way of 1.6 s, still for 0.8 s, and on."""
    s = np.clip((t_s - 0.6) / 1.6, 0, 1) + np.clip((t_s - 3.0) / 1.6, 0, 1)
    whole, part = np.floor(s), s - np.floor(s)
    s = whole + part * part * (3 - 2 * part)
    position = np.stack([0.5 * s, 0.15 * np.sin(3 * s), 0.05 * s], axis=-1)
    turn = np.stack([0.02 * s, 0.03 * np.sin(2 * s), 0.1 * s], axis=-1)
    return se3.pose(se3.exp_so3(turn), position)


def test_a_camera_that_stands_still_in_noise_stays_where_it_is(tmp_path: Path) -> None:
    out = tmp_path / "resting.h5"
    noisy = EventCameraModel(shot_hz=1.0, hot_share=3e-4, hot_hz=200.0)
    simulate(out, motion=resting, seconds=3.8, seed=6, sensor=noisy)
    recording = open_recording(out)
    tracker = Tracker(recording.camera, TrackerConfig())
    first_us = int(recording.events.read(0, 1).t_us[0])
    results, s = [], []
    for window in windows(recording, lambda: tracker.window_size):
        results.append(tracker.step(window))
        s.append((window.start_us - first_us) * 1e-6)
    at = np.array(s)
    before, between = at < 0.5, (at > 2.35) & (at < 2.9)
    assert np.count_nonzero(before) > 3
    assert np.count_nonzero(between) > 3
    assert all(r.status is Status.INITIALIZING for r, is_before in zip(results, before, strict=True) if is_before)
    for r, is_before in zip(results, before, strict=True):
        if is_before:
            assert np.array_equal(r.T_world_camera, np.eye(4))
    held = [r for r, is_between in zip(results, between, strict=True) if is_between]
    assert all(r.status is Status.WEAK for r in held)
    # A refinement may land meanwhile.
    assert np.ptp([r.T_world_camera[:3, 3] for r in held], axis=0).max() < 0.015
    assert not any(r.status in (Status.LOST, Status.RELOCALIZING) for r in results)
    assert results[-1].status is Status.TRACKING
