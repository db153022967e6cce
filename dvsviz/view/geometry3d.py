"""Shapes of the 3-D scene: paths, pyramids and the map's place, as arrays."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, map_to_world, rotation_to_map
from dvsviz.session.records import STATUS_BADNESS, STATUSES, MapRevision, Status

Array = NDArray[np.float64]

MAX_TEXTURE_PX = 2048
# Drawn by the processor, a segment takes 35 us of every frame: with 800 and 500 instead of 4,000 each the scene follows
# a click in half the time.
MAX_SEGMENTS, MAX_TRUTH_SEGMENTS = 800, 500
# More pyramids than these cover each other, and each is drawn in every frame.
MAX_KEYFRAMES = 500
_THUMBNAIL_PX = 240

# Okabe-Ito, as everywhere a status is drawn.
STATUS_RGB: dict[Status, tuple[int, int, int]] = {
    Status.INITIALIZING: (153, 153, 153),
    Status.TRACKING: (0, 158, 115),
    Status.WEAK: (230, 159, 0),
    Status.LOST: (213, 94, 0),
    Status.RELOCALIZING: (86, 180, 233),
}


def line_rgb(rgb: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the colour that viser's lines need to look like `rgb`: they take linear light, not sRGB."""
    r, g, b = (round(255 * (value / 255) ** 2.2) for value in rgb)
    return r, g, b


_PALETTE = np.array([line_rgb(STATUS_RGB[status]) for status in STATUSES], dtype=np.uint8)


_BADNESS = np.array(STATUS_BADNESS)
_BY_BADNESS = np.argsort(_BADNESS)


def path(positions: Array, most: int = MAX_SEGMENTS) -> NDArray[np.float32]:
    """Return at most so many segments (S, 2, 3) of a polyline through positions (N, 3)."""
    kept = positions[np.all(np.isfinite(positions), axis=-1)]
    kept = kept[_along(kept, most)]
    return np.stack([kept[:-1], kept[1:]], axis=1).astype(np.float32)


def status_path(Ts_world_camera: Array, status: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return segments (S, 2, 3) and colours (S, 2, 3) of a trajectory; a segment has its windows' worst status.

    Args:
        Ts_world_camera: poses (N, 4, 4).
        status: numbers of `STATUSES` (N,).
    """
    count = min(len(Ts_world_camera), len(status))
    positions, numbers = Ts_world_camera[:count, :3, 3], np.asarray(status)[:count]
    finite = np.all(np.isfinite(positions), axis=-1)
    positions, numbers = positions[finite], numbers[finite]
    chosen = _along(positions, MAX_SEGMENTS)
    kept = positions[chosen]
    points = np.stack([kept[:-1], kept[1:]], axis=1).astype(np.float32)
    if len(points) == 0:
        return points, np.zeros((0, 2, 3), dtype=np.uint8)
    worst = np.maximum.reduceat(_BADNESS[numbers[1:]], chosen[:-1])
    return points, np.repeat(_PALETTE[_BY_BADNESS[worst]][:, None], 2, axis=1)


def _along(positions: Array, most: int) -> NDArray[np.int64]:
    """Return which positions (N, 3) a line of at most so many segments goes through, the first and the last among them.

    Three quarters lie evenly along the way, so that a camera at rest takes none; the others evenly in time.
    """
    if len(positions) <= most + 1:
        return np.arange(len(positions))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    evenly = np.searchsorted(way, np.linspace(0.0, way[-1], most - most // 4 + 1))
    # A way that is no number leads nowhere.
    evenly = np.minimum(evenly, len(positions) - 1)
    return np.unique(np.concatenate([evenly, thinned(len(positions), most // 4)]))


def quaternions(Ts_world_camera: Array) -> Array:
    """Return quaternions (N, 4) wxyz of poses (N, 4, 4)."""
    return se3.quaternion_from_rotation(Ts_world_camera[:, :3, :3])


def field_of_view(camera: Camera) -> tuple[float, float]:
    """Return the vertical field of view, rad, and width by height of the image plane."""
    tall, wide = camera.height / camera.fy, camera.width / camera.fx
    return 2 * float(np.arctan(tall / 2)), wide / tall


def pyramid(camera: Camera, size: float) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (5, 3) and faces (6, 3) of a camera's pyramid with its tip at the origin, `size` deep."""
    x, y = camera.width / camera.fx / 2, camera.height / camera.fy / 2
    vertices = size * np.array([[0, 0, 0], [-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 3, 2], [1, 4, 3]])
    return vertices, faces


def map_image_pose(revision: MapRevision) -> tuple[float, float, Array, Array]:
    """Return width, height, position (3,) and quaternion wxyz (4,) at which a map's texture lies in the world.

    viser draws an image with x right and y down, to be seen along +z: as the map frame has it.
    """
    rows, columns = revision.texture.shape
    plane = Plane(normal=revision.normal_world, distance=revision.distance)
    centre = revision.origin + np.array([columns - 1, rows - 1]) / (2 * revision.px_per_unit)
    position = map_to_world(centre[None], plane)[0]
    wxyz = se3.quaternion_from_rotation(rotation_to_map(revision.normal_world).T)
    width, height = columns / revision.px_per_unit, rows / revision.px_per_unit
    return width, height, position, wxyz


def viewpoint(Ts_world_camera: Array) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return where to look from and at, so that the cameras and the wall one unit ahead are both seen."""
    positions = Ts_world_camera[:, :3, 3]
    positions = positions[np.all(np.isfinite(positions), axis=-1)]
    centre, extent = np.zeros(3), 1.0
    if len(positions):
        # A lost stretch may fly far away: the middle 90 % say where the camera was.
        low, high = np.percentile(positions, [5, 95], axis=0)
        centre = np.clip((low + high) / 2, -5, 5)
        extent = float(np.clip(np.linalg.norm(high - low), 0.8, 8.0))
    eye = centre + extent * np.array([0.8, -0.55, -0.95])
    target = centre + np.array([0.15, 0.0, 0.6])
    return (eye[0], eye[1], eye[2]), (target[0], target[1], target[2])


def thumbnail(png: bytes) -> NDArray[np.uint8]:
    """Return an encoded image as RGB (rows, columns, 3), made small enough for the frustum."""
    image = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise ValueError("png: expected an encoded image")
    shrink = _THUMBNAIL_PX / image.shape[1]
    if shrink < 1:
        image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return np.asarray(image, dtype=np.uint8)


def thinned(count: int, most: int) -> NDArray[np.int64]:
    """Return at most so many increasing numbers below `count`, the first and the last among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).astype(np.int64))
