"""Colour and depth images of numbered files are joined by what is in them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dvsviz.registration.association import colour_offsets
from dvsviz.registration.frames import open_frames

SHAPE = (60, 90)


def scene(place: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the image and the depth of a dark board before a wall, at a place that moves by three pixels a frame."""
    grey = np.random.default_rng(place).integers(180, 190, SHAPE).astype(np.uint8)
    depth = np.full(SHAPE, 2.0, np.float32)
    board = (slice(15, 45), slice(10 + 3 * place, 30 + 3 * place))
    grey[board] = 60
    depth[board] = 1.2
    return grey, depth


def offsets(colour: list[int], depth: list[int]) -> list[int]:
    return colour_offsets(len(colour), lambda k: scene(colour[k])[0], lambda k: scene(depth[k])[1]).tolist()


def test_lost_depth_image_is_found_where_it_was_lost() -> None:
    every, lost = list(range(12)), [*range(5), *range(6, 13)]
    assert offsets(every, lost) == [0] * 5 + [1] * 7
    assert offsets(lost, every) == [0] * 5 + [0] + [-1] * 6 or offsets(lost, every) == [0] * 5 + [-1] * 7
    assert offsets(every, every) == [0] * 12


def test_change_is_found_between_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dvsviz.registration.association._SAMPLES", 6)
    assert offsets(list(range(16)), [*range(7), *range(8, 17)]) == [0] * 7 + [1] * 9


def test_still_camera_keeps_the_numbers() -> None:
    assert offsets([3] * 10, [3] * 10) == [0] * 10
    assert colour_offsets(4, lambda k: scene(k)[0], lambda k: None).tolist() == [0] * 4


def write(folder: Path, colour: list[int], depth: list[int]) -> None:
    folder.mkdir()
    for k, (c, d) in enumerate(zip(colour, depth, strict=True)):
        cv2.imwrite(f"{folder}/frame-{k:06d}.color.png", scene(c)[0])
        cv2.imwrite(f"{folder}/frame-{k:06d}.depth.png", (scene(d)[1] * 1000).astype(np.uint16))
        pose = np.eye(4)
        pose[0, 3] = d
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", pose)
    np.savetxt(folder / "camera-intrinsics.txt", [[80, 0, 45], [0, 80, 30], [0, 0, 1]])


def test_folder_joins_what_was_taken_together(tmp_path: Path) -> None:
    write(tmp_path / "lost", list(range(12)), [*range(5), *range(6, 13)])
    frames = open_frames(tmp_path / "lost", rig="aligned")
    assert len(frames.t_us) == 11
    assert "frame-000005.color.png (by +1)" in frames.warnings[-1]
    for k in range(11):
        frame = frames.read(k)
        assert frame.depth is not None
        np.testing.assert_array_equal(frame.grey < 100, frame.depth < 1.5)
        # Poses and times stay with the depth images.
        assert frames.ground_truth is not None
        place = frames.ground_truth.at(frames.t_us[k : k + 1]).Ts_world_camera[0, 0, 3]
        assert place == pytest.approx([*range(5), *range(6, 13)][k])
    write(tmp_path / "whole", list(range(12)), list(range(12)))
    whole = open_frames(tmp_path / "whole", rig="aligned")
    assert (len(whole.t_us), whole.warnings) == (12, ())


@pytest.mark.data
def test_real_frames_lost_one_depth_image(data_dir: Path) -> None:
    frames = open_frames(data_dir / "rgbd")
    names = [
        (grey.name[6:12], depth.name[6:12])
        for grey, depth in zip(frames.grey_paths, frames.depth_paths, strict=True)
        if depth
    ]
    assert names[28] == ("000178", "000178")
    assert names[29] == ("000180", "000179")
    assert names[-1] == ("000199", "000198")
