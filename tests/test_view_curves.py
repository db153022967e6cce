"""Poses by axis beside the truth, and occupied pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gateway_samples import make_recording, make_session

from dvsviz.formats.open import open_recording
from dvsviz.gateway.app import static_folder
from dvsviz.geometry import se3
from dvsviz.session.records import Cause
from dvsviz.session.store import open_session
from dvsviz.view.curves import OccupiedPixels, axis_angles, pose_curves
from dvsviz.view.shown import ShownSession


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> ShownSession:
    folder: Path = tmp_path_factory.mktemp("curves")
    recording = make_recording(folder / "r.h5", 40)
    return ShownSession(open_session(make_session(folder / "s.h5", recording, 40)), open_recording(recording))


def test_one_turn_about_one_axis_is_one_angle() -> None:
    for axis in range(3):
        turned = axis_angles(se3.exp_so3(np.eye(3)[axis] * np.radians(25.0))[None])[0]
        np.testing.assert_allclose(turned, 25.0 * np.eye(3)[axis], atol=1e-9)
    composed = se3.exp_so3([0, 0.3, 0]) @ se3.exp_so3([0.2, 0, 0]) @ se3.exp_so3([0, 0, -0.4])
    np.testing.assert_allclose(np.radians(axis_angles(composed[None])[0]), [0.2, 0.3, -0.4], atol=1e-9)


def test_the_truth_lies_on_the_estimate_that_it_is(shown: ShownSession) -> None:
    # The sample's truth is its estimate: the aligned curves are one.
    curves = pose_curves(shown, 5)
    np.testing.assert_allclose(curves["x"], shown.poses()[5:, 0, 3], atol=1e-6)
    for name in ("x", "y", "z", "pitch", "yaw", "roll"):
        assert len(curves[name]) == 35
        np.testing.assert_allclose(curves[f"true_{name}"], curves[name], atol=1e-4)


def test_occupied_pixels_come_a_part_at_a_time(shown: ShownSession) -> None:
    counter = OccupiedPixels()
    first = counter.curve(shown, 0, seconds=0.0)["occupied_px"]
    assert len(first) >= 1
    every = counter.curve(shown, 0)["occupied_px"]
    assert len(every) == 40
    for window in (0, 17, 39):
        (events,) = shown.events_from(window, 1, 0)
        pixels = {*zip(events.events.x_px.tolist(), events.events.y_px.tolist(), strict=True)}
        assert every[window] == len(pixels)
    np.testing.assert_array_equal(counter.curve(shown, 30)["occupied_px"], every[30:])


def test_without_the_recording_they_are_not_known(shown: ShownSession) -> None:
    alone = ShownSession(shown.session, None, "gone")
    assert np.isnan(OccupiedPixels().curve(alone, 0)["occupied_px"]).all()


def test_events_of_several_windows_and_of_milliseconds(shown: ShownSession) -> None:
    three = shown.events_from(4, 3, 0)
    assert [part.index for part in three] == [4, 5, 6]
    assert sum(map(len, three)) == sum(len(shown.events_from(k, 1, 0)[0]) for k in (4, 5, 6))
    start_us, end_us = shown.result(4).start_us, shown.result(4).end_us
    length_ms = 1.5 * (end_us - start_us) * 1e-3
    parts = shown.events_from(4, 1, length_ms)
    assert [part.index for part in parts] == [4, 5]
    last = max(int(part.events.t_us[-1]) for part in parts)
    assert last < start_us + 1000 * length_ms
    assert len(shown.events_from(38, 9, 0)) == 2  # the session ends


@pytest.mark.parametrize("cause", list(Cause))
def test_each_cause_is_explained_in_the_page_and_in_the_manual(cause: Cause) -> None:
    page = (static_folder() / "causes.js").read_text(encoding="utf-8")
    manual = (Path(__file__).parents[1] / "docs" / "failures.md").read_text(encoding="utf-8")
    assert f"\n  {cause}: {{" in page
    assert f"\n| `{cause}` |" in manual
