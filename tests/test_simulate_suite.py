"""The suite: made once, versioned; covered lenses and panoramas."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvsviz.formats.hdf5 import read_recording
from dvsviz.geometry.camera import Camera
from dvsviz.simulate import suite as module
from dvsviz.simulate.cover import Cover
from dvsviz.simulate.panorama import PanoramaView, boxes
from dvsviz.simulate.render import PixelGrid
from dvsviz.simulate.simulate import simulate
from dvsviz.simulate.suite import SUITE, simulate_suite, suite_entries

SMALL = Camera(width=90, height=60, fx=80.0, fy=80.0, cx=44.5, cy=29.5)


def test_a_recording_is_made_once_and_again_when_the_version_rises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = tuple(replace(entry, seconds=0.1, camera=SMALL) for entry in SUITE if entry.name == "shake")
    monkeypatch.setattr(module, "SUITE", short)
    (entry,) = simulate_suite(tmp_path)
    written = entry.path(tmp_path).stat().st_mtime_ns
    simulate_suite(tmp_path, ["shake"])
    assert entry.path(tmp_path).stat().st_mtime_ns == written
    monkeypatch.setattr(module, "SUITE_VERSION", module.SUITE_VERSION + 1)
    simulate_suite(tmp_path)
    assert entry.path(tmp_path).stat().st_mtime_ns > written


def test_names_are_those_of_the_table_and_unknown_ones_are_refused() -> None:
    names = {entry.name for entry in suite_entries()}
    assert {"shapes_6dof", "kidnap", "boxes_rotation", "tilt_45", "explore", "hd_shapes"} <= names
    assert [entry.name for entry in suite_entries(["shake", "kidnap"])] == ["shake", "kidnap"]
    with pytest.raises(ValueError, match="nosuch"):
        suite_entries(["nosuch"])


@pytest.mark.parametrize("entry", SUITE, ids=lambda entry: entry.name)
def test_every_recipe_makes_events_along_its_whole_motion(entry: module.SuiteEntry, tmp_path: Path) -> None:
    # The motion of the real duration, of which the first 50 ms are rendered on a small sensor.
    made = entry.motion
    motion = made(np.random.default_rng([entry.seed, 100]), entry.seconds) if callable(made) else made
    options = {**entry.options, "cover": None}
    simulate(tmp_path / "a.h5", scene=entry.scene, motion=motion, seconds=0.05, camera=SMALL, **options)
    assert read_recording(tmp_path / "a.h5").events.count > 10


def test_covered_lens_sees_nothing_and_the_same_wall_afterwards(tmp_path: Path) -> None:
    cover = Cover(intervals=((0.2, 0.6),))
    for name, option in (("covered", cover), ("free", None)):
        simulate(tmp_path / f"{name}.h5", seconds=0.8, camera=SMALL, cover=option)
    covered, free = (read_recording(tmp_path / f"{name}.h5") for name in ("covered", "free"))

    def count(recording, start_s: float, end_s: float) -> int:
        return recording.events.index_at(int(end_s * 1e6)) - recording.events.index_at(int(start_s * 1e6))

    # Nothing but noise (0.1 Hz a pixel and hot pixels) in the dark; bursts when the hand comes and goes.
    assert count(covered, 0.29, 0.51) < 0.3 * 5400 * 0.22
    assert count(covered, 0.2, 0.28) > 5 * count(free, 0.2, 0.28)
    assert count(covered, 0.52, 0.6) > 5 * count(free, 0.52, 0.6)
    assert count(covered, 0.62, 0.8) == pytest.approx(count(free, 0.62, 0.8), rel=0.1)


def test_panorama_is_seen_along_directions() -> None:
    texture = boxes(np.random.default_rng(0), (-1.2, -0.9, 1.2, 0.9), 0.6 / 80)
    image, active = np.zeros((60, 90), np.float32), np.ones(15 * 23, bool)
    c, s = np.cos(0.3), np.sin(0.3)
    turned = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    straight = np.zeros_like(image)
    view = PanoramaView(PixelGrid.of(SMALL), texture)
    view.render(turned, image, active)
    view.forget()
    view.render(np.eye(3), straight, active)
    # A yaw moves the middle row by f tan(yaw): what was right of the centre is now in it.
    column = SMALL.cx + SMALL.fx * np.tan(0.3)
    i = int(column)
    wanted = straight[29, i] * (1 - (column - i)) + straight[29, i + 1] * (column - i)
    assert np.hypot(*(image[29, 44:46].mean() - wanted, 0)) < 0.1
    assert image.std() > 0.05


def test_panorama_refuses_a_moving_camera(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rotation"):
        simulate(tmp_path / "a.h5", scene=boxes, panorama=True, motion="slider", seconds=0.1, camera=SMALL)
