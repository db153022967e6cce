"""Planted failures: each recording goes wrong for one reason, and the diagnosis must name it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.events.windows import windows
from dvsviz.formats.open import open_recording
from dvsviz.session.records import Cause, Failure
from dvsviz.simulate.cover import Cover
from dvsviz.simulate.planted import blank, jerked, shapes_until, stripes, to_the_right
from dvsviz.simulate.scenes import shapes
from dvsviz.simulate.simulate import simulate
from dvsviz.tracking.tracker import Tracker


def failures_of(path: Path, motion: str = "planar") -> list[Failure]:
    """Track a recording and return its failures."""
    recording = open_recording(path)
    tracker = Tracker(recording.camera, TrackerConfig(motion=motion))  # pyright: ignore[reportArgumentType]
    found: list[Failure] = []
    for window in windows(recording, lambda: tracker.window_size):
        tracker.step(window)
        found.extend(tracker.take_updates().failures)
    found.extend(tracker.finish().failures)
    return found


@pytest.mark.parametrize(
    ("wall", "path", "expected"),
    [
        (shapes_until(blank), to_the_right, {Cause.TOO_LITTLE_TEXTURE, Cause.TOO_FEW_EVENTS}),
        (shapes_until(stripes), to_the_right, {Cause.WEAK_DIRECTION}),
        (shapes, jerked, {Cause.TOO_FAST}),
    ],
    ids=["blank", "stripes", "jerk"],
)
def test_the_cause_of_a_planted_failure_is_named(
    tmp_path: Path, wall: Callable, path: Callable, expected: set[Cause]
) -> None:
    out = tmp_path / "planted.h5"
    seconds = 3.0
    simulate(out, scene=wall, motion=path(np.random.default_rng(3), seconds), seconds=seconds, seed=3)
    found = failures_of(out)
    assert found, "nothing was noticed"
    assert {f.cause for f in found} & expected, [(f.cause, f.message) for f in found]


def test_a_covered_lens_has_too_few_events(tmp_path: Path) -> None:
    out = tmp_path / "covered.h5"
    simulate(out, scene="shapes", motion="handheld", seconds=2.6, seed=4, cover=Cover(intervals=((1.4, 1.9),)))
    found = failures_of(out)
    assert any(f.cause in (Cause.TOO_FEW_EVENTS, Cause.TOO_LITTLE_TEXTURE) for f in found), [
        (f.cause, f.message) for f in found
    ]


def test_a_scene_with_depth_is_not_a_plane(data_dir: Path) -> None:
    found = failures_of(data_dir / "ecd" / "slider_depth.zip")
    assert any(f.cause is Cause.NOT_PLANAR for f in found), [(f.cause, f.message) for f in found]
