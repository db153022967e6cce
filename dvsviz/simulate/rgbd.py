"""Simulated RGB-D sequences in the TUM layout: grey images, depth of 16 bits, true poses, calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import seconds_text, write_tum
from dvsviz.simulate.models.light import depth_image, intensity_image
from dvsviz.simulate.paths import AnyMotion, AnyScene, make_path, make_scene
from dvsviz.simulate.relief import Relief, ReliefView, image_of
from dvsviz.simulate.render import PixelGrid
from dvsviz.simulate.simulate import LONGEST_S, check_wall, wall_relief

# Units a metre of the layout's depth images.
DEPTH_SCALE = 5000.0
_TRUTH_HZ = 100.0
# Images that make one with an open shutter: at 1,000 px/s and 10 ms they are 0.6 px apart.
_SHUTTER_PARTS = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class RgbdModel:
    """What an RGB-D camera does to light and depth; see `models.light`.

    Attributes:
        full_well: photons that fill a pixel; infinite for no photon noise.
        read_sigma: noise of reading, as a share of white.
        sigma_at_1m: depth noise at 1 m, m; it grows with the square of the depth.
        hole_share: of pixels that fail at random.
        edge_step: depth steps above this share of the depth make holes; infinite for none.
        near: smallest depth that is measured, m.
        far: largest one, m.
    """

    full_well: float = 10_000.0
    read_sigma: float = 0.003
    sigma_at_1m: float = 0.0015
    hole_share: float = 0.01
    edge_step: float = 0.05
    near: float = 0.4
    far: float = 8.0


PERFECT = RgbdModel(
    full_well=np.inf, read_sigma=0, sigma_at_1m=0, hole_share=0, edge_step=np.inf, near=0.01, far=13.0
)


def rgbd_camera() -> Camera:
    """Return the calibration of a common RGB-D camera: 640 x 480, a focal length of 525 px, no distortion."""
    return Camera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)


def simulate_rgbd(
    out: Path,
    *,
    scene: AnyScene = "boxes",
    motion: AnyMotion = "circle",
    seconds: float | None = None,
    seed: int = 1,
    camera: Camera | None = None,
    model: RgbdModel | None = None,
    distance: float = 1.0,
    tilt_deg: float = 5.0,
    rate_hz: float = 30.0,
    exposure_s: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Write a folder: `rgb/`, `depth/`, `rgb.txt`, `depth.txt`, `groundtruth.txt` and `calib.txt`.

    With the same scene, motion, duration and seed, `simulate` writes the events of the same flight; of a wall, which is
    painted as far and as finely as the camera sees it, with the same camera too.

    Args:
        out: the folder; made where it is missing.
        scene: a scene with depth, or what is on a wall.
        motion: of the camera: a name, a TUM file, or a function of time that gives poses.
        seconds: duration; None for the whole of a file or flight, 10 s of the others.
        seed: of everything random.
        camera: calibration; 640 x 480 with a focal length of 525 px where None.
        model: noise; `PERFECT` for none.
        distance: metres to the wall along the world's z axis.
        tilt_deg: angle between the wall and the world's image plane, in degrees, below 80.
        rate_hz: frames a second.
        exposure_s: how long the shutter of the intensity images is open, their time in the middle: what moves is
            blurred. Depth is measured in that instant.
        progress: called with the share done, 0 to 1.

    Raises:
        ValueError: an argument is out of range, or scene and motion do not go together.
        DvsvizError: the folder cannot be written.
    """
    if not 0 < rate_hz <= 1000 or not (seconds is None or 0 < seconds <= 36_000):
        raise ValueError(f"rate_hz, seconds: expected 0 to 1000 and 0 to 36000, got {rate_hz}, {seconds}")
    if not 0 <= exposure_s <= 1 / rate_hz:
        raise ValueError(f"exposure_s: expected 0 to a frame's {1 / rate_hz:.4f} s, got {exposure_s}")
    check_wall(distance, tilt_deg)
    camera = rgbd_camera() if camera is None else camera
    model = RgbdModel() if model is None else model
    rngs = [np.random.default_rng([seed, i]) for i in range(5)]
    found = make_scene(scene, rngs[1])
    relief = found if isinstance(found, Relief) else None
    path, seconds = make_path(motion, rngs[0], seconds, distance=distance, relief=relief)
    if seconds > LONGEST_S:
        raise ValueError(f"motion: expected at most {LONGEST_S} s, it lasts {seconds:.0f} s: give --seconds")
    if not isinstance(found, Relief):
        found = wall_relief(found, camera, path, seconds, rngs[1], distance=distance, tilt_deg=tilt_deg)
    t_us = np.round(np.arange(int(seconds * rate_hz + 1e-6) + 1) * 1e6 / rate_hz).astype(np.int64)
    names = [f"{seconds_text(int(t))}.png" for t in t_us]
    view = ReliefView(PixelGrid.of(camera), found)
    # Middles of equal parts of the exposure, within the motion's time.
    open_s = exposure_s * ((np.arange(_SHUTTER_PARTS) + 0.5) / _SHUTTER_PARTS - 0.5) if exposure_s else np.zeros(1)
    try:
        for folder in ("rgb", "depth"):
            (out / folder).mkdir(parents=True, exist_ok=True)
        for k, t in enumerate((t_us * 1e-6).astype(np.float64)):
            Ts = path(np.clip(t + open_s, 0, seconds))
            grey, depth = _look(view, Ts, path(np.array([t]))[0], camera, model, rngs[4])
            _write_png(out / "rgb" / names[k], grey)
            _write_png(out / "depth" / names[k], depth)
            if progress is not None:
                progress((k + 1) / len(t_us))
        for folder, what in (("rgb", "color images"), ("depth", "depth maps")):
            lines = [f"{name.removesuffix('.png')} {folder}/{name}" for name in names]
            text = "\n".join([f"# {what}", "# timestamp filename", *lines, ""])
            (out / f"{folder}.txt").write_text(text, encoding="utf-8")
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
        (out / "calib.txt").write_text(" ".join(repr(float(v)) for v in numbers) + "\n", encoding="utf-8")
    except OSError as error:
        hint = "check the folder and the free space"
        raise DvsvizError(f"cannot be written: {error.strerror}", path=out, hint=hint) from error
    every = np.arange(0, int(t_us[-1]), round(1e6 / _TRUTH_HZ), dtype=np.int64)
    truth_us = np.union1d(every, t_us)
    Ts = path((truth_us * 1e-6).astype(np.float64))
    write_tum(out / "groundtruth.txt", Trajectory(t_us=truth_us, Ts_world_camera=Ts))


def _look(
    view: ReliefView,
    Ts_open: NDArray[np.float64],
    T_world_camera: NDArray[np.float64],
    camera: Camera,
    model: RgbdModel,
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Return the intensity image of the poses (N, 4, 4) while the shutter is open, and the depth image of a pose."""
    light = np.asarray(np.mean([image_of(view, T, camera) for T in Ts_open], axis=0), dtype=np.float32)
    depth = depth_image(
        view.depth(T_world_camera),
        rng,
        sigma_at_1m=model.sigma_at_1m,
        hole_share=model.hole_share,
        edge_step=model.edge_step,
        near=model.near,
        far=model.far,
        scale=DEPTH_SCALE,
    )
    return intensity_image(light, rng, full_well=model.full_well, read_sigma=model.read_sigma), depth


def _write_png(path: Path, image: NDArray) -> None:
    # Level 1 writes a noisy depth image six times faster than the default and hardly larger.
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise DvsvizError("the image cannot be encoded", path=path)
    path.write_bytes(data.tobytes())
