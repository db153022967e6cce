"""Simulated recordings of a wall or of a scene with depth, with their truth.

The wall is a plane with a picture; the camera moves in front of it; its event sensor is advanced in steps of at most
half a pixel of image motion. Everything follows from the seed: the same call writes the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.events import Events, joined
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, rotation_to_map
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.simulate.cover import Cover
from dvsviz.simulate.event_camera import EventCamera, EventCameraModel
from dvsviz.simulate.inertial import GRAVITY_WORLD, ImuModel, simulate_imu
from dvsviz.simulate.motion import Motion
from dvsviz.simulate.panorama import PanoramaView
from dvsviz.simulate.paths import AnyMotion, AnyScene, make_path, make_scene
from dvsviz.simulate.relief import Patch, Relief, ReliefView
from dvsviz.simulate.render import BLOCK, PixelGrid, PlaneView
from dvsviz.simulate.scenes import Bounds, Painter
from dvsviz.simulate.steps import LONGEST_STEP_S, PART, border_bearings, image_speed, step_times
from dvsviz.simulate.texture import Texture

Array = NDArray[np.float64]

# Parts of the image that move slower than the fastest one wait until they have moved by this much, px.
STILL_PX = 0.3
# A texture's levels, and what is painted into them, take some 30 B a texel.
_MOST_TEXELS = 300_000_000
LONGEST_S = 36_000
# Events are sorted in pieces of this length.
_FLUSH_S = 0.02
# They are written in pieces of at least so many: every piece packs the last chunk of each column anew, 1 ms in all.
_WRITE_EVENTS = 1 << 17
_TRUTH_HZ = 500.0
# The wall ends this far from the camera's first axis: tilted walls reach the horizon.
_WALL_LIMIT_M = 6.0


def default_camera() -> Camera:
    """Return the simulated sensor's camera: 240 x 180, 62 degrees across, no distortion."""
    return Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)


def check_wall(distance: float, tilt_deg: float) -> None:
    """Refuse a wall that nothing could be painted on.

    Raises:
        ValueError: distance or tilt is out of range.
    """
    if not 0.01 <= distance < 1e4 or not 0 <= tilt_deg < 80:
        raise ValueError(
            f"distance, tilt_deg: expected 0.01 to 10000 m and 0 to 80 degrees, got {distance}, {tilt_deg}"
        )


def wall(distance: float, tilt_deg: float) -> Plane:
    """Return the wall: `distance` metres from the world's origin, turned by `tilt_deg` about an oblique axis."""
    axis = np.array([0.5, np.sqrt(0.75), 0.0])
    normal = se3.exp_so3(np.radians(tilt_deg) * axis) @ np.array([0.0, 0.0, -1.0])
    return Plane(normal=normal, distance=distance * float(-normal[2]))


def homographies(Ts_world_camera: Array, plane_world: Plane) -> Array:
    """Return `H_map_camera` (N, 3, 3) of poses (N, 4, 4): as `plane.homography_map_camera`, for many."""
    R, t = Ts_world_camera[:, :3, :3], Ts_world_camera[:, :3, 3]
    n_camera = np.einsum("nji,j->ni", R, plane_world.normal)
    d_camera = plane_world.distance + t @ plane_world.normal
    H = rotation_to_map(plane_world.normal) @ (d_camera[:, None, None] * R - t[:, :, None] * n_camera[:, None, :])
    return H / np.array([[1.0], [1.0], [plane_world.distance]])


def visible_bounds(camera: Camera, Hs_map_camera: Array, margin: float = 0.1) -> Bounds:
    """Return the wall's rectangle (left, top, right, bottom), m, that is ever in view of the camera."""
    if len(Hs_map_camera) > PART:
        found = [
            visible_bounds(camera, Hs_map_camera[k : k + PART], margin) for k in range(0, len(Hs_map_camera), PART)
        ]
        left, top, right, bottom = zip(*found, strict=True)
        return min(left), min(top), max(right), max(bottom)
    p = np.einsum("nij,mj->nmi", Hs_map_camera, border_bearings(camera))
    uv = p[..., :2] / np.maximum(p[..., 2:], 1e-3)
    low, high = uv.min(axis=(0, 1)) - margin, uv.max(axis=(0, 1)) + margin
    low, high = np.maximum(low, -_WALL_LIMIT_M), np.minimum(high, _WALL_LIMIT_M)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def simulate(
    out: Path,
    *,
    scene: AnyScene = "shapes",
    motion: AnyMotion = "handheld",
    seconds: float | None = 10.0,
    seed: int = 1,
    camera: Camera | None = None,
    sensor: EventCameraModel | None = None,
    imu: ImuModel | None = None,
    distance: float = 1.0,
    tilt_deg: float = 5.0,
    panorama: bool = False,
    cover: Cover | None = None,
    frames_hz: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Write a simulated recording with its ground truth.

    Args:
        out: the file, in our own layout.
        scene: what is on the wall, or a function that paints it; or a scene with depth.
        motion: of the camera: a name, a TUM file, or a function of time that gives poses.
        seconds: duration; None for the whole of a file or flight, 10 s of the others.
        seed: of everything random.
        camera: the lens and the pixels; 240 x 180 with a focal length of 200 px where none is given.
        sensor: the event sensor; the default one has thresholds of 0.25.
        imu: the inertial sensor; the default one has 1 kHz.
        distance: metres to the wall along the world's z axis.
        tilt_deg: angle between the wall and the world's image plane, in degrees, below 80.
        panorama: True for a scene far around the camera, seen by a pure rotation, in place of a wall.
        cover: when something is held before the lens.
        frames_hz: intensity frames a second, 0 for none.
        progress: called with the share done, 0 to 1.

    Raises:
        ValueError: an argument is out of range, or the camera would pass through the wall.
        FormatError: the file is no trajectory.
    """
    if seconds is not None and not 0 < seconds <= LONGEST_S:
        raise ValueError(f"seconds: expected 0 to {LONGEST_S}, got {seconds}")
    if not 0 <= frames_hz <= 10_000:
        raise ValueError(f"frames_hz: expected 0 to 10000, got {frames_hz}")
    check_wall(distance, tilt_deg)
    camera = default_camera() if camera is None else camera
    rngs = [np.random.default_rng([seed, i]) for i in range(5)]
    found = make_scene(scene, rngs[1])
    relief = found if isinstance(found, Relief) else None
    path, seconds = make_path(motion, rngs[0], seconds, distance=distance, relief=relief)
    if seconds > LONGEST_S:
        raise ValueError(f"motion: expected at most {LONGEST_S} s, it lasts {seconds:.0f} s: give --seconds")
    plane = None if panorama or relief is not None else wall(distance, tilt_deg)
    seen = None if relief is None else ReliefView(PixelGrid.of(camera), relief)

    coarse_s = np.linspace(0, seconds, int(np.ceil(seconds * 1000)) + 1)
    distances = _distances(path, coarse_s, plane)
    if distances.min() < 0.02 * distance:
        raise ValueError(f"motion: the camera comes within {distances.min():.3f} m of the wall")
    sensor = EventCameraModel() if sensor is None else sensor
    times = step_times(
        image_speed(path, camera, plane, coarse_s, seen), coarse_s, min(LONGEST_STEP_S, sensor.settling_s)
    )
    if cover is not None:
        extra = cover.step_times()
        times = np.union1d(times, extra[(extra > 0) & (extra < seconds)])
    view: PlaneView | PanoramaView | ReliefView
    if isinstance(found, Relief):
        view, maps = seen or ReliefView(PixelGrid.of(camera), found), path(times)
    else:
        view, maps = _view(camera, plane, found, path(times), distances, rngs[1])
    light = _Light(view, maps, times, camera, cover)
    light.advance(0, whole=True)
    pixels = EventCamera(sensor, light.seen, 0.0, rngs[2])
    first_us: int | None = None
    last_us = 0
    next_flush_s, next_frame_s = _FLUSH_S, 0.0
    unwritten: list[Events] = []
    with RecordingWriter(out, camera=camera) as writer:
        for k, t in enumerate(times):
            flush, frame = t >= next_flush_s or k == len(times) - 1, frames_hz > 0 and t >= next_frame_s
            if k and light.advance(k, whole=flush or frame):
                pixels.step(light.seen, t, light.active)
            if frame:
                writer.append_frame(round(t * 1e6), np.round(np.clip(light.seen, 0, 1) * 255).astype(np.uint8))
                next_frame_s += 1 / frames_hz
            if flush:
                events = pixels.flush(light.seen, t)
                if len(events):
                    first_us = int(events.t_us[0]) if first_us is None else first_us
                    last_us = int(events.t_us[-1])
                    unwritten.append(events)
                if unwritten and (k == len(times) - 1 or sum(map(len, unwritten)) >= _WRITE_EVENTS):
                    writer.append(joined(unwritten))
                    unwritten = []
                next_flush_s = t + _FLUSH_S
                if progress is not None:
                    progress(float(t / seconds))
        if first_us is None:
            raise ValueError("seconds: the recording would hold no event; make it longer or the scene richer")
        writer.set_ground_truth(_truth(path, first_us, last_us))
        gravity = GRAVITY_WORLD if relief is None else relief.gravity_world
        writer.set_imu(simulate_imu(ImuModel() if imu is None else imu, path, seconds, rngs[3], gravity))
        if plane is not None:
            mean = float(distances.mean())
            writer.set_plane(mean_plane_distance=mean, normal_world=plane.normal, distance_world=plane.distance)


class _Light:
    """What falls on the sensor: the view, and what is held before it.

    Attributes:
        seen: intensity image (height, width).
        active: blocks (N,) that may have changed in the last step; None for all.
    """

    def __init__(
        self,
        view: PlaneView | PanoramaView | ReliefView,
        maps: Array,
        times: Array,
        camera: Camera,
        cover: Cover | None,
    ) -> None:
        self._view, self._maps, self._times, self._cover = view, maps, times, cover
        self._image = np.empty((camera.height, camera.width), np.float32)
        self._flags = np.ones(-(-camera.height // BLOCK) * -(-camera.width // BLOCK), np.bool_)
        self._covered = False
        self.seen: NDArray[np.float32] = self._image
        self.active: NDArray[np.bool_] | None = self._flags

    def advance(self, k: int, *, whole: bool) -> bool:
        """Go to step `k`, and return False where the image is known to be that of the step before.

        Blocks that hardly moved are left for later, unless the `whole` image is wanted.
        """
        t = float(self._times[k])
        over = self._cover is not None and self._cover.is_over(t)
        if over and self._covered and self._cover is not None and self._cover.is_dark(t):
            self._view.forget()
            self.seen, self.active = self._cover.over(self._image, t), None
            return whole
        still_px = 0.0 if whole or over or self._covered else STILL_PX
        self._view.render(self._maps[k], self._image, self._flags, still_px=still_px)
        # The step that uncovers the last of the image changes blocks that did not move.
        self.active = None if over or self._covered else self._flags
        self.seen = self._cover.over(self._image, t) if over and self._cover is not None else self._image
        self._covered = over
        return True


def _distances(path: Motion, t_s: Array, plane: Plane | None) -> Array:
    """Return the camera's distances (N,) to the wall, m, at times; infinite to a panorama."""
    if plane is None:
        return np.full(len(t_s), np.inf)
    parts = [path(t_s[k : k + PART])[:, :3, 3] @ plane.normal for k in range(0, len(t_s), PART)]
    return plane.distance + np.concatenate(parts)


def _view(
    camera: Camera, plane: Plane | None, painter: Painter, Ts: Array, distances: Array, rng: np.random.Generator
) -> tuple[PlaneView | PanoramaView, Array]:
    """Return what is rendered, and at each step how it is seen: homographies or rotations (N, 3, 3)."""
    grid = PixelGrid.of(camera)
    texel = 0.6 / max(camera.fx, camera.fy)
    if plane is None:
        if np.abs(np.diff(Ts[:, :3, 3], axis=0)).max() > 1e-9:
            raise ValueError("motion: expected a pure rotation in a panorama")
        half = float(np.abs(np.arctan2(*_directions(camera, Ts)[:, ::2].T)).max()) + 0.1
        high = float(np.abs(_heights(_directions(camera, Ts))).max()) + 0.1
        texture = _paint(painter, rng, (-half, -high, half, high), texel)
        return PanoramaView(grid, texture), Ts[:, :3, :3]
    return PlaneView(grid, _painted(camera, plane, painter, Ts, distances, rng)), homographies(Ts, plane)


def _painted(
    camera: Camera, plane: Plane, painter: Painter, Ts: Array, distances: Array, rng: np.random.Generator
) -> Texture:
    """Return the texture of what is ever in view of a wall."""
    # Nearly two texels a pixel where the camera is near: an edge's place is then good to a few hundredths of a pixel.
    texel = 0.6 / max(camera.fx, camera.fy) * float(np.percentile(distances, 5))
    return _paint(painter, rng, visible_bounds(camera, homographies(Ts, plane)), texel)


def _paint(painter: Painter, rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
    """Return the texture of a rectangle.

    Raises:
        ValueError: it would not fit into memory.
    """
    across, down = (bounds[2] - bounds[0]) / texel, (bounds[3] - bounds[1]) / texel
    if not across * down <= _MOST_TEXELS:
        raise ValueError(
            f"size, distance, tilt_deg: the scene would be painted {across:,.0f} by {down:,.0f} points large: take a "
            "smaller sensor, a smaller tilt or a larger distance"
        )
    return painter(rng, bounds, texel)


def wall_relief(
    painter: Painter,
    camera: Camera,
    path: Motion,
    seconds: float,
    rng: np.random.Generator,
    *,
    distance: float,
    tilt_deg: float,
) -> Relief:
    """Return the wall that `simulate` paints for the same arguments as a scene with depth: one rectangle."""
    plane = wall(distance, tilt_deg)
    coarse_s = np.linspace(0, seconds, int(np.ceil(seconds * 1000)) + 1)
    distances = _distances(path, coarse_s, plane)
    if distances.min() < 0.02 * distance:
        raise ValueError(f"motion: the camera comes within {distances.min():.3f} m of the wall")
    times = step_times(image_speed(path, camera, plane, coarse_s), coarse_s)
    texture = _painted(camera, plane, painter, path(times), distances, rng)
    R = rotation_to_map(plane.normal).T
    corner = R @ np.array([texture.left, texture.top, plane.distance])
    rows, columns = texture.image.shape
    patch = Patch(
        T_world_patch=se3.pose(R, corner),
        width=columns * texture.texel,
        height=rows * texture.texel,
        texture=replace(texture, left=0.0, top=0.0),
    )
    return Relief(patches=(patch,), T_world_hand=np.eye(4), gravity_world=GRAVITY_WORLD, has_floor=False)


def _directions(camera: Camera, Ts: Array) -> Array:
    """Return directions (M, 3) in the world along the border of some images."""
    some = Ts[:: max(len(Ts) // 2000, 1), :3, :3]
    return np.einsum("nij,mj->nmi", some, border_bearings(camera)).reshape(-1, 3)


def _heights(directions: Array) -> Array:
    return directions[:, 1] / np.hypot(directions[:, 0], directions[:, 2])


def _truth(motion: Motion, first_us: int, last_us: int) -> Trajectory:
    """Return the true poses from the first to the last event, both included."""
    step = round(1e6 / _TRUTH_HZ)
    t_us = np.unique(np.append(np.arange(first_us, last_us, step), last_us)).astype(np.int64)
    return Trajectory(t_us=t_us, Ts_world_camera=motion((t_us * 1e-6).astype(np.float64)))
