"""Sequences of intensity or RGB-D frames, from folders, TUM lists and event recordings.

Three layouts are recognised: a folder of `frame-000000.color.png`, `.depth.png`, `.pose.txt` (7-Scenes), a TUM RGB-D
folder (`rgb.txt`, `depth.txt`, `groundtruth.txt`), and the frames of an event recording, which have no depth.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.events.recording import Recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import microseconds, read_tum
from dvsviz.registration.association import colour_offsets
from dvsviz.registration.rig import Rig, edge_agreement, kinect

# TUM's own tool for joining colour and depth allows 20 ms.
MAX_ASSOCIATION_US = 20_000
TUM_DEPTH_SCALE = 5000.0
FOLDER_DEPTH_SCALE = 1000.0
# The folder layout has no times: frames of a Kinect come at 30 Hz.
FOLDER_RATE_HZ = 30.0
# `aligned`: depth and colour are one grid. `kinect`: raw images of the first Kinect. `auto`: what the images show.
RigKind = Literal["auto", "aligned", "kinect"]
# Depth steps lie on outlines 1.3 to 3 times as strongly as elsewhere when aligned, 1.0 to 1.3 times when not.
_MIN_AGREEMENT_GAIN = 1.2
_AGREEMENT_FRAMES = 5
_FRAME_NAME = re.compile(r"frame-(\d+)\.color\.png$")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One image with the depth that was measured beside it.

    Attributes:
        index: number of the frame in its sequence.
        t_us: time, int64 microseconds.
        grey: intensity (height, width) uint8.
        depth: depth along the optical axis (height, width) float32, metres, NaN where none; or None.
    """

    index: int
    t_us: int
    grey: NDArray[np.uint8]
    depth: NDArray[np.float32] | None


class FrameSequence(Protocol):
    """Frames that are read one at a time."""

    @property
    def camera(self) -> Camera:
        """Calibration of the frames."""
        ...

    @property
    def t_us(self) -> NDArray[np.int64]:
        """Strictly increasing times (N,)."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses, which may cover a part of the frames."""
        ...

    def read(self, index: int) -> Frame:
        """Return frame `index`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FileFrames:
    """A `FrameSequence` over image files.

    Attributes:
        camera: calibration.
        t_us: times (N,).
        grey_paths: N colour or grey images.
        depth_paths: N depth images of 16 bits, None where a frame has none.
        depth_scale: depth units a metre.
        ground_truth: true poses of the camera, or None.
        rig: where the depth camera stands; None where depth and colour are one grid.
        warnings: sentences about what was assumed.
    """

    camera: Camera
    t_us: NDArray[np.int64]
    grey_paths: tuple[Path, ...]
    depth_paths: tuple[Path | None, ...]
    depth_scale: float
    ground_truth: Trajectory | None = None
    rig: Rig | None = None
    warnings: tuple[str, ...] = field(default=())

    def read(self, index: int) -> Frame:
        """Return frame `index`.

        Raises:
            FormatError: an image is missing, of another size, or a depth image has not 16 bits.
        """
        return Frame(
            index=index, t_us=int(self.t_us[index]), grey=self.read_grey(index), depth=self.read_depth(index)
        )

    def read_grey(self, index: int) -> NDArray[np.uint8]:
        """Return the intensity (height, width) of frame `index`."""
        return _image(self.grey_paths[index], cv2.IMREAD_GRAYSCALE, self.camera)

    def read_depth(self, index: int) -> NDArray[np.float32] | None:
        """Return the depth (height, width) of frame `index`, None where it has none."""
        path = self.depth_paths[index]
        depth = None
        if path is not None:
            raw = _image(path, cv2.IMREAD_UNCHANGED, self.camera)
            if raw.dtype != np.uint16 or raw.ndim != 2:
                raise FormatError(
                    f"expected a depth image with one channel of 16 bits, got {raw.shape} {raw.dtype}", path=path
                )
            # 0 is "none" in both layouts, 65535 in 7-Scenes.
            is_measured = (raw > 0) & (raw < 65535)
            depth = np.where(is_measured, raw.astype(np.float32) / np.float32(self.depth_scale), np.float32(np.nan))
            depth = depth if self.rig is None else self.rig.depth_in_colour(depth)
        return depth


class RecordingFrames:
    """A `FrameSequence` over the intensity frames of an event recording."""

    def __init__(self, recording: Recording) -> None:
        if recording.frames is None or len(recording.frames.t_us) == 0:
            raise FormatError("expected a recording with intensity frames, found none", path=recording.path)
        self._recording, self._frames = recording, recording.frames

    @property
    def camera(self) -> Camera:
        """Calibration of the frames: that of the events."""
        return self._recording.camera

    @property
    def t_us(self) -> NDArray[np.int64]:
        """Times (N,) of the frames."""
        return self._frames.t_us

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses of the recording."""
        return self._recording.ground_truth

    def read(self, index: int) -> Frame:
        """Return frame `index`, without depth."""
        return Frame(index=index, t_us=int(self.t_us[index]), grey=self._frames.read(index), depth=None)


def open_frames(
    path: Path, *, calibration: Path | None = None, depth_scale: float | None = None, rig: RigKind = "auto"
) -> FileFrames:
    """Return the frame sequence of a folder.

    Args:
        path: a TUM folder, a folder of `frame-*.color.png`, or a folder that holds one of these.
        calibration: text file with the matrix K (3 x 3) or `fx fy cx cy [k1 k2 p1 p2 k3]`; looked for beside the
            frames (`camera-intrinsics.txt`, `calibration.txt`, `calib.txt`) where not given.
        depth_scale: depth units a metre; TUM's 5000 or, for the other layout, 1000 where not given.
        rig: how depth and colour stand to each other. With `auto`, TUM folders are aligned, as that layout promises;
            of the other layout, which has both kinds, the images decide.

    Raises:
        FormatError: no known layout, no calibration, or a broken file.
    """
    if not path.is_dir():
        raise FormatError(
            "expected a folder of frames", path=path, hint="give a TUM RGB-D or frame-*.color.png folder"
        )
    if depth_scale is not None and not 0 < depth_scale < 1e9:
        raise FormatError(f"depth scale: expected units a metre above 0, got {depth_scale}", path=path)
    candidates = _candidates(path)
    for folder in candidates:
        if any(_FRAME_NAME.search(p.name) for p in folder.glob("frame-*.color.png")):
            numbered = _open_numbered(folder, calibration, depth_scale or FOLDER_DEPTH_SCALE)
            return _joined(_with_rig(numbered, rig))
    for folder in candidates:
        if (folder / "rgb.txt").is_file():
            frames = _open_tum(folder, calibration, depth_scale or TUM_DEPTH_SCALE)
            return _with_rig(frames, "aligned" if rig == "auto" else rig)
    raise FormatError(
        "found neither rgb.txt nor frame-*.color.png", path=path, hint="give the folder that holds them"
    )


def is_frame_folder(path: Path) -> bool:
    """Return whether `open_frames` knows a folder's layout; the text layout of event recordings is another one."""
    return any((p / "rgb.txt").is_file() or any(p.glob("frame-*.color.png")) for p in _candidates(path))


def _candidates(path: Path) -> list[Path]:
    return [path, *sorted(p for p in path.iterdir() if p.is_dir())]


def _with_rig(frames: FileFrames, kind: RigKind) -> FileFrames:
    """Return the frames with their rig; the calibration and the true poses of a raw file are the depth camera's."""
    if kind == "aligned" or all(path is None for path in frames.depth_paths):
        return frames
    rig = kinect(frames.camera)
    warnings = frames.warnings
    if kind == "auto":
        picks = np.unique(np.linspace(0, len(frames.t_us) - 1, _AGREEMENT_FRAMES).astype(int))
        looks = [(f.grey, f.depth) for f in map(frames.read, picks.tolist()) if f.depth is not None]
        aligned = np.array([edge_agreement(grey, depth) for grey, depth in looks])
        moved = np.array([edge_agreement(grey, rig.depth_in_colour(depth)) for grey, depth in looks])
        both = np.isfinite(aligned) & np.isfinite(moved)
        if not both.any() or np.median(moved[both] / aligned[both]) < _MIN_AGREEMENT_GAIN:
            return frames
        warnings = (
            *warnings,
            "depth steps lie on the colour image's outlines only after moving them by the factory geometry of a "
            "Kinect (colour 525 px, depth camera 25 mm to the left): taken as raw Kinect images",
        )
    truth = frames.ground_truth
    if truth is not None:
        T_depth_colour = se3.inverse(rig.T_colour_depth)
        truth = Trajectory(t_us=truth.t_us, Ts_world_camera=truth.Ts_world_camera @ T_depth_colour)
    return replace(frames, camera=rig.colour, ground_truth=truth, rig=rig, warnings=warnings)


def _joined(frames: FileFrames) -> FileFrames:
    """Return numbered frames, each with the colour image that was taken with its depth and its pose."""
    regular = np.ptp(np.diff(frames.t_us)) <= 1 if len(frames.t_us) > 2 else False
    if not regular or all(path is None for path in frames.depth_paths):
        return frames
    offsets = colour_offsets(len(frames.t_us), frames.read_grey, frames.read_depth)
    if not offsets.any():
        return frames
    colour = np.arange(len(offsets)) + offsets
    # A colour image that was lost leaves its depth without one; the image before it has its own.
    kept = (colour >= 0) & (colour < len(colour)) & np.r_[True, np.diff(colour) > 0]
    changes = np.flatnonzero(np.diff(offsets, prepend=0))
    told = ", ".join(f"{frames.grey_paths[k].name} (by {offsets[k]:+d})" for k in changes[:5])
    warning = (
        "one stream lost images: depth steps lie on the outlines of colour images with other numbers, from "
        f"{told}{' …' if len(changes) > 5 else ''} on; joined so, {int((~kept).sum())} without a colour image left out"
    )
    return replace(
        frames,
        t_us=frames.t_us[kept],
        grey_paths=tuple(frames.grey_paths[k] for k in colour[kept]),
        depth_paths=tuple(frames.depth_paths[k] for k in np.flatnonzero(kept)),
        warnings=(*frames.warnings, warning),
    )


def _open_numbered(folder: Path, calibration: Path | None, depth_scale: float) -> FileFrames:
    numbered = sorted(
        (int(found.group(1)), p) for p in folder.glob("frame-*") if (found := _FRAME_NAME.search(p.name))
    )
    numbers = np.array([number for number, _ in numbered])
    if np.any(np.diff(numbers) == 0):
        raise FormatError("two frames have the same number", path=folder)
    t_us = np.round(numbers * (1e6 / FOLDER_RATE_HZ)).astype(np.int64)
    stems = [p.name.removesuffix(".color.png") for _, p in numbered]
    depth = [folder / f"{stem}.depth.png" for stem in stems]
    poses = [(k, pose) for k, stem in enumerate(stems) if (pose := folder / f"{stem}.pose.txt").is_file()]
    known = [(k, T) for k, p in poses if (T := _pose(p)) is not None]
    truth = None
    if known:
        truth = Trajectory(t_us=t_us[[k for k, _ in known]], Ts_world_camera=np.array([T for _, T in known]))
    return FileFrames(
        camera=_find_camera(folder, calibration, numbered[0][1]),
        t_us=t_us,
        grey_paths=tuple(p for _, p in numbered),
        depth_paths=tuple(p if p.is_file() else None for p in depth),
        depth_scale=depth_scale,
        ground_truth=truth,
    )


def _open_tum(folder: Path, calibration: Path | None, depth_scale: float) -> FileFrames:
    t_us, grey = _read_list(folder / "rgb.txt")
    depth: list[Path | None] = [None] * len(grey)
    if (folder / "depth.txt").is_file():
        depth_us, depth_paths = _read_list(folder / "depth.txt")
        for k, j in enumerate(nearest(t_us, depth_us)):
            if abs(int(depth_us[j]) - int(t_us[k])) <= MAX_ASSOCIATION_US:
                depth[k] = depth_paths[j]
    truth = folder / "groundtruth.txt"
    return FileFrames(
        camera=_find_camera(folder, calibration, grey[0]),
        t_us=t_us,
        grey_paths=tuple(grey),
        depth_paths=tuple(depth),
        depth_scale=depth_scale,
        ground_truth=read_tum(truth) if truth.is_file() else None,
    )


def nearest(t_us: NDArray[np.int64], among_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each time (N,), the index (N,) of the nearest among sorted times (M,), M >= 1."""
    after = np.clip(np.searchsorted(among_us, t_us), 1, max(1, len(among_us) - 1))
    before = after - 1
    after = np.minimum(after, len(among_us) - 1)
    is_before = np.abs(t_us - among_us[before]) <= np.abs(among_us[after] - t_us)
    return np.where(is_before, before, after)


def _read_list(path: Path) -> tuple[NDArray[np.int64], list[Path]]:
    times, paths = [], []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 2:
            raise FormatError(
                f"expected a time and a file name, got {line[:60]!r}", path=path, place=f"line {number}"
            )
        try:
            times.append(microseconds(words[0]))
        except ValueError as error:
            raise FormatError(
                f"expected a time in seconds, got {words[0]!r}", path=path, place=f"line {number}"
            ) from error
        paths.append(path.parent / words[1])
    t_us = np.array(times, dtype=np.int64)
    if len(t_us) == 0:
        raise FormatError("lists no images", path=path)
    if np.any(np.diff(t_us) <= 0):
        raise FormatError(
            "times do not increase", path=path, place=f"entry {int(np.argmax(np.diff(t_us) <= 0)) + 2}"
        )
    return t_us, paths


def _pose(path: Path) -> NDArray[np.float64] | None:
    T = _numbers(path)
    if T.shape != (4, 4):
        raise FormatError(f"expected a pose of 4 x 4 numbers, got {T.shape}", path=path)
    # 7-Scenes writes infinities where its tracker was lost.
    return T if np.all(np.isfinite(T)) else None


def _numbers(path: Path) -> NDArray[np.float64]:
    try:
        return np.atleast_2d(np.loadtxt(path))
    except (ValueError, OSError) as error:
        raise FormatError("cannot be read as rows of numbers", path=path) from error


def _find_camera(folder: Path, calibration: Path | None, image: Path) -> Camera:
    if calibration is None:
        names = ("camera-intrinsics.txt", "calibration.txt", "calib.txt")
        found = [p for place in (folder, folder.parent) for name in names if (p := place / name).is_file()]
        if not found:
            raise FormatError("found no calibration", path=folder, hint="give one: a file with fx fy cx cy")
        calibration = found[0]
    shape = _image(image, cv2.IMREAD_GRAYSCALE, None).shape
    values = _numbers(calibration)
    if values.shape == (3, 3):
        line = [values[0, 0], values[1, 1], values[0, 2], values[1, 2]]
    elif values.shape in ((1, 4), (1, 9)):
        line = list(values[0])
    else:
        raise FormatError(
            f"expected K (3 x 3) or fx fy cx cy [k1 k2 p1 p2 k3], got {values.shape}", path=calibration
        )
    distortion = tuple(float(v) for v in line[4:]) if len(line) == 9 else (0.0,) * 5
    try:
        return Camera(
            width=shape[1],
            height=shape[0],
            fx=float(line[0]),
            fy=float(line[1]),
            cx=float(line[2]),
            cy=float(line[3]),
            distortion=distortion,  # pyright: ignore[reportArgumentType]
        )
    except ValueError as error:
        raise FormatError(str(error), path=calibration) from error


def _image(path: Path, flag: int, camera: Camera | None) -> NDArray:
    if not path.is_file():
        raise FormatError("image is missing", path=path)
    image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), flag)
    if image is None:
        raise FormatError("cannot be read as an image", path=path)
    if camera is not None and image.shape[:2] != (camera.height, camera.width):
        raise FormatError(
            f"expected {camera.width}x{camera.height} pixels, got {image.shape[1]}x{image.shape[0]}", path=path
        )
    return image
