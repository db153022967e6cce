"""Planted failures: each recording goes wrong for one reason, and the diagnosis must name it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.events.windows import windows
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.session.records import Cause, Failure
from dvsviz.simulate.cover import Cover
from dvsviz.simulate.motion import Motion, free_motion, handheld
from dvsviz.simulate.scenes import shapes
from dvsviz.simulate.simulate import simulate
from dvsviz.simulate.suite_scenes import smooth_step
from dvsviz.simulate.texture import Texture, make_texture
from dvsviz.tracking.tracker import Tracker

Bounds = tuple[float, float, float, float]
Array = NDArray[np.float64]


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


def half(of: Callable[[np.random.Generator, Bounds, float], Texture], beyond: Callable[[Array], Array]):
    """Return a painter whose wall is `of` to the left of 0.35 m and `beyond(x)` (columns,) to its right."""

    def paint(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
        left, top, _, _ = bounds
        image = of(rng, bounds, texel).image.copy()
        first = int((0.35 - left) / texel)
        image[:, first:] = beyond(left + texel * np.arange(first, image.shape[1]))[None, :]
        return make_texture(image, texel=texel, left=left, top=top)

    return paint


def blank(x: Array) -> Array:
    return np.full_like(x, 0.7)


def stripes(x: Array) -> Array:
    return np.where((x / 0.07) % 1.0 < 0.45, 0.2, 0.7)


def to_the_right(rng: np.random.Generator, seconds: float) -> Motion:
    """A hand that tracks for a second, goes 1.3 m to the right and looks at what is there."""
    hand = handheld(rng, seconds, scale=0.6)

    def position(t_s: Array) -> Array:
        return hand(t_s)[:, :3, 3] + smooth_step(t_s, 1.2, 2.4)[:, None] * np.array([1.3, 0.0, 0.0])

    return free_motion(position)


def jerked(rng: np.random.Generator, seconds: float) -> Motion:
    """A hand that is struck after 1.2 s: 25 degrees in 40 ms."""
    hand = handheld(rng, seconds, scale=0.5)

    def motion(t_s: Array) -> Array:
        T = hand(t_s)
        phi = np.zeros((len(T), 3))
        phi[:, 1] = np.radians(25.0) * smooth_step(t_s, 1.2, 1.24)
        T = T.copy()
        T[:, :3, :3] = T[:, :3, :3] @ se3.exp_so3(phi)
        return T

    return motion


@pytest.mark.parametrize(
    ("wall", "path", "expected"),
    [
        (half(shapes, blank), to_the_right, {Cause.TOO_LITTLE_TEXTURE, Cause.TOO_FEW_EVENTS}),
        (half(shapes, stripes), to_the_right, {Cause.WEAK_DIRECTION}),
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
