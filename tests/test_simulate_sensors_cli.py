"""`dvsviz simulate` and `simulate-suite`: every option reaches the simulator, wrong ones are one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvsviz.cli import main
from dvsviz.formats.hdf5 import read_recording
from dvsviz.formats.open import open_recording
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import write_tum
from dvsviz.registration.frames import open_frames
from dvsviz.simulate import simulate, suite
from dvsviz.simulate.motion import slider

SMALL = Camera(width=90, height=60, fx=80.0, fy=80.0, cx=44.5, cy=29.5)


def run(*argv: object) -> int:
    return main(["simulate", *map(str, argv)])


def refused(capsys: pytest.CaptureFixture[str], *argv: object) -> str:
    capsys.readouterr()
    assert run(*argv) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def test_wall_camera_and_frames(tmp_path: Path) -> None:
    out = tmp_path / "r.h5"
    assert run("--size", "96x64", "--distance", 0.7, "--tilt-deg", 20, "--frames-hz", 50, "--seconds", 0.1,
               "--out", out) == 0  # fmt: skip
    recording = read_recording(out)
    assert (recording.camera.width, recording.camera.height, recording.camera.fx) == (96, 64, 80.0)
    assert recording.frames is not None and len(recording.frames.t_us) == 6
    assert recording.plane_normal_world is not None and recording.plane_distance_world is not None
    assert -recording.plane_normal_world[2] == pytest.approx(np.cos(np.radians(20)))
    assert recording.plane_distance_world == pytest.approx(0.7 * np.cos(np.radians(20)))


def test_calibration_and_uzh_text(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("81.5 82.5 47.25 31.5 -0.1 0.02 0.001 -0.002 0.003\n")
    out = tmp_path / "text"
    argv = ["--size", "96x64", "--calibration", tmp_path / "calib.txt", "--seconds", 0.1, "--out", out]
    assert run(*argv, "--layout", "uzh") == 0
    camera = open_recording(out).camera
    assert camera == Camera(
        width=96, height=64, fx=81.5, fy=82.5, cx=47.25, cy=31.5, distortion=(-0.1, 0.02, 0.001, -0.002, 0.003)
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["calib.txt", "text"]


def test_tum_file_over_a_scene_with_depth_as_rgbd(tmp_path: Path) -> None:
    t = np.arange(11) * 0.02
    file, out = tmp_path / "real.txt", tmp_path / "flight"
    write_tum(file, Trajectory(t_us=np.round(t * 1e6).astype(np.int64), Ts_world_camera=slider(speed=0.5)(t)))
    argv = ["--scene", "planes", "--motion", file, "--layout", "rgbd", "--size", "80x60", "--out", out]
    assert run(*argv, "--frames-hz", 10, "--exposure-ms", 2) == 0
    frames = open_frames(out)
    assert frames.t_us.tolist() == [0, 100_000, 200_000]
    assert frames.ground_truth is not None
    assert frames.ground_truth.positions[-1] == pytest.approx([0.1, 0, 0], abs=1e-6)


def test_a_picture_of_ones_own_on_the_wall(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Left half black, right half white, 2 m wide: what the camera sees left and right of its middle."""
    image = np.zeros((40, 100), np.uint8)
    image[:, 50:] = 255
    assert cv2.imwrite(str(tmp_path / "half.png"), image)
    wish = ["--scene", tmp_path / "half.png", "--motion", "slider", "--seconds", 0.2, "--tilt-deg", 0]
    assert run(*wish, "--size", "80x60", "--frames-hz", 10, "--out", tmp_path / "r.h5") == 0
    frames = read_recording(tmp_path / "r.h5").frames
    assert frames is not None
    # The slider begins 16 mm left of the middle, a metre away: a pixel right of it, at 67 px of focal length.
    seen = frames.read(0)
    assert (seen[:, :38] < 10).all() and (seen[:, 44:] > 250).all()
    (tmp_path / "no.png").write_bytes(b"x")
    assert "picture" in refused(capsys, "--scene", tmp_path / "no.png", "--out", tmp_path / "b.h5")
    assert "picture" in refused(capsys, "--scene", "nothing", "--out", tmp_path / "b.h5")


def test_wrong_wishes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "r.h5"
    assert "handheld" in refused(capsys, "--motion", "swim", "--out", out)
    assert "no-such.tum" in refused(capsys, "--motion", "no-such.tum", "--out", out)
    assert "floor" in refused(capsys, "--motion", "circle", "--out", out)
    assert "floor" in refused(capsys, "--motion", "circle", "--layout", "rgbd", "--out", tmp_path / "d")
    assert "shutter" in refused(capsys, "--exposure-ms", "5", "--out", out)
    assert "pixels" in refused(capsys, "--size", "9000x10", "--out", out)
    assert "tilt_deg" in refused(capsys, "--tilt-deg", "85", "--out", out)
    assert "frames_hz" in refused(capsys, "--frames-hz", "-1", "--out", out)
    assert "no-calib" in refused(capsys, "--calibration", "no-calib.txt", "--out", out)
    out.write_bytes(b"")
    assert "folder" in refused(capsys, "--layout", "uzh", "--force", "--out", out)
    assert "already exists" in refused(capsys, "--out", out)


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("dot", np.zeros((1, 1), np.uint8)),
        ("thin", np.arange(200, dtype=np.uint8)[None]),
        ("plain", np.full((40, 60), 90, np.uint8)),
    ],
)
def test_pictures_that_show_nothing_are_one_line(
    name: str, image: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"{name}.png"
    assert cv2.imwrite(str(path), image)
    assert f"{name}.png: image: expected" in refused(capsys, "--scene", path, "--out", tmp_path / "r.h5")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_what_would_fill_the_memory_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images by the hundred million, a wall of billions of texels, a motion that lasts for years."""
    out, T = tmp_path / "r.h5", np.stack([np.eye(4)] * 4)
    write_tum(tmp_path / "long.tum", Trajectory(t_us=np.arange(4) * 10**14, Ts_world_camera=T))
    assert "images would be needed" in refused(capsys, "--size", "1x4096", "--seconds", 0.1, "--out", out)
    with monkeypatch.context() as patch:
        patch.setattr(simulate, "_MOST_TEXELS", 1000)
        assert "points large" in refused(capsys, "--seconds", 0.01, "--out", out)
    assert "give --seconds" in refused(capsys, "--motion", tmp_path / "long.tum", "--out", out)
    assert "distance" in refused(capsys, "--distance", "1e-9", "--out", out)
    assert "whole number" in refused(capsys, "--seed", "-1", "--out", out)
    assert "rotation or turn" in refused(capsys, "--scene", "room", "--out", out)
    assert not out.exists()


def test_force_replaces_only_what_a_simulation_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, folder = tmp_path / "thesis.h5", tmp_path / "mine"
    text.write_text("years of work")
    folder.mkdir()
    (folder / "letter.txt").write_text("dear")
    assert "not replaced" in refused(capsys, "--seconds", 0.1, "--force", "--out", text)
    assert "is a folder" in refused(capsys, "--seconds", 0.1, "--force", "--out", folder)
    for layout in ("uzh", "rgbd"):
        assert "not replaced" in refused(capsys, "--layout", layout, "--force", "--out", folder)
    assert "no name" in refused(capsys, "--layout", "uzh", "--force", "--out", "/")
    assert text.read_text() == "years of work" and len(list(folder.iterdir())) == 1
    argv = ["--size", "48x32", "--seconds", 0.1, "--force", "--out"]
    for again in range(2):
        assert run(*argv, tmp_path / "r.h5") == 0, again
        assert run(*argv, tmp_path / "text", "--layout", "uzh") == 0, again


def test_suite_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    short = tuple(replace(entry, seconds=0.1, camera=SMALL) for entry in suite.SUITE if entry.name != "kidnap")
    monkeypatch.setattr(suite, "SUITE", short)
    assert main(["simulate-suite", "--out", str(tmp_path), "--names", "shake", "tilt_30"]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "shake.h5"), str(tmp_path / "tilt_30.h5")]
    assert read_recording(tmp_path / "tilt_30.h5").events.count > 0
    assert main(["simulate-suite", "--out", str(tmp_path), "--names", "shaken"]) == 2
    assert "tilt_45" in capsys.readouterr().err
