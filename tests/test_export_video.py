"""Videos, read back: how many frames, how large, and that a frame shows its window."""

from __future__ import annotations

from pathlib import Path

import cv2
import gateway_samples as samples
import numpy as np
import pytest

from dvsviz.cli import main
from dvsviz.errors import DvsvizError, RunCancelled
from dvsviz.export.stage import Stage
from dvsviz.export.video import FRAMES_A_SECOND, export_video
from dvsviz.export.video_frames import GAP, HEAD, PANEL_WIDTH, Frames
from dvsviz.formats.open import open_recording
from dvsviz.session.store import open_session
from dvsviz.view.shown import ShownSession

WINDOWS = 60  # 0.6 s


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("video")
    recording = samples.make_recording(folder / "r.h5", WINDOWS)
    return samples.make_session(folder / "walk.h5", recording, WINDOWS)


def shown(path: Path) -> ShownSession:
    session = open_session(path)
    return ShownSession(session, open_recording(Path(session.header.recording_path)))


def frames_of(path: Path) -> list[np.ndarray]:
    film, frames = cv2.VideoCapture(str(path)), []
    while True:
        there, frame = film.read()
        if not there:
            return frames
        frames.append(frame[..., ::-1].astype(int))


def colour(name: str) -> np.ndarray:
    return {"lost": np.array((213, 94, 0)), "tracking": np.array((0, 158, 115))}[name]


@pytest.mark.parametrize("ending", ["webm", "mp4"])
def test_a_stretch_has_its_frames_each_with_its_state(session: Path, tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"x.{ending}"
    assert main(["export", str(session), "--video", str(out), "--start", "0.08", "--end", "0.48"]) == 0
    frames = frames_of(out)
    assert len(frames) == 10
    width, height = 3 * PANEL_WIDTH + 4 * GAP, 320 + HEAD + 26 + GAP + 84
    assert frames[0].shape == (height, width, 3)
    # Frame k shows 0.08 s + k / 25: windows 8, 12, …; each tenth window is lost. The badge's corner tells.
    for k, frame in enumerate(frames):
        window = 8 + k * 100 // FRAMES_A_SECOND
        name = "lost" if window % 10 == 9 else "tracking"
        assert np.abs(frame[14:18, -GAP - 8 : -GAP - 4].mean(axis=(0, 1)) - colour(name)).max() < 25


def test_half_the_speed_gives_twice_the_frames_and_lost_windows_their_colour(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.mp4"
    assert export_video(shown(session), out, start_s=0.08, end_s=0.12, speed=0.25) == 4
    badge = [frame[14:18, -GAP - 8 : -GAP - 4].mean(axis=(0, 1)) for frame in frames_of(out)]
    for seen, name in zip(badge, ("tracking", "lost", "tracking", "tracking"), strict=True):
        assert np.abs(seen - colour(name)).max() < 25


def test_a_frame_shows_the_event_of_its_window_where_it_was(session: Path) -> None:
    drawing = Frames(shown(session), (0, WINDOWS - 1))
    for window in (3, 30):
        frame = drawing.frame(window, 0.01 * window)
        scale = PANEL_WIDTH / samples.CAMERA.width
        x, y = samples.pixel_of(window)
        panel = frame[HEAD + 26 : HEAD + 26 + 320, GAP : GAP + PANEL_WIDTH].astype(int).sum(axis=2)
        row, column = np.unravel_index(int(panel.argmax()), panel.shape)
        assert abs(column - (x + 0.5) * scale) < scale
        assert abs(row - (y + 0.5) * scale) < scale


def test_the_stage_moves_its_camera_and_draws_the_path_behind_it(session: Path) -> None:
    stage = Stage(shown(session), (0, WINDOWS - 1), 480, 320)
    tracked = [
        (np.abs(stage.picture(w).astype(int) - colour("tracking")).sum(axis=2) < 40).sum() for w in (0, 20, 59)
    ]
    assert tracked[0] == 0
    assert 0 < tracked[1] < tracked[2]


def test_what_stops_it_leaves_nothing(session: Path, tmp_path: Path) -> None:
    def stop(share: float) -> None:
        if share > 0:
            raise RunCancelled("stopped")

    with pytest.raises(RunCancelled):
        export_video(shown(session), tmp_path / "x.webm", progress=stop)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_shown_is_said(session: Path, tmp_path: Path) -> None:
    with pytest.raises(DvsvizError, match=r"no windows from 3 to 0\.6 s; it has windows"):
        export_video(shown(session), tmp_path / "x.webm", start_s=3.0)
    with pytest.raises(DvsvizError, match="speed 0 shows nothing"):
        export_video(shown(session), tmp_path / "x.webm", speed=0.0)
    with open_session(session) as opened, pytest.raises(DvsvizError, match="needs the recording's events"):
        export_video(ShownSession(opened, None), tmp_path / "x.webm")
    assert not list(tmp_path.iterdir())
