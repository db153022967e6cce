"""What a window looks like: raw, warped, and on the map, on a dark background.

All images lie on the camera's *undistorted* pixel grid (same K, no distortion), so that raw, warped and map can be
compared pixel by pixel. `scale` makes the grid finer for warped events and map, whose positions are sub-pixel; raw
events are repeated instead, because one event is one pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import image_of_warped_events, vote
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.session.records import MapRevision, WindowResult
from dvsviz.view.picture import Picture

Bytes = NDArray[np.uint8]
Votes = NDArray[np.float32]

# RGB. On / off events in warm and cool, explained / unexplained edges in the Okabe-Ito green and vermilion,
# lightened for a dark ground: the pairs stay apart for the three common kinds of colour blindness.
BACKGROUND = (12, 15, 19)
POSITIVE = (255, 183, 77)
NEGATIVE = (86, 180, 233)
NEUTRAL = (236, 240, 243)
EXPLAINED = (46, 214, 163)
UNEXPLAINED = (255, 109, 58)
MAP = (128, 138, 150)

# A map pixel is an edge from this occurrence (of 255) on; an edge within this many map pixels explains an event.
EDGE_LEVEL = 48
EDGE_REACH_PX = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageOptions:
    """How a window is drawn.

    Attributes:
        polarity: on and off events in two colours.
        scale: pixels of the image per sensor pixel, 1 to 4.
    """

    polarity: bool = True
    scale: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.scale <= 4:
            raise ValueError(f"scale: expected 1 to 4, got {self.scale}")


def scaled_camera(camera: Camera, scale: int) -> Camera:
    """Return the undistorted camera with `scale` times as many pixels in x and y; pixel centres stay centred."""
    return replace(
        camera,
        width=camera.width * scale,
        height=camera.height * scale,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx + 0.5) * scale - 0.5,
        cy=(camera.cy + 0.5) * scale - 0.5,
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
    )


def raw_picture(window: EventWindow, camera: Camera, options: ImageOptions) -> Picture:
    """Return the events as recorded, each at its nearest undistorted pixel."""
    points = _nearest_pixels(camera)[window.events.y_px, window.events.x_px]
    positive = window.events.is_positive
    on, off = (_counted(points[m], camera) for m in (positive, ~positive))
    picture = _two_colours(on, off, options)
    if options.scale == 1:
        return picture
    return Picture(pixels=picture.pixels.repeat(options.scale, 0).repeat(options.scale, 1), palette=picture.palette)


def warped_picture(window: EventWindow, result: WindowResult, camera: Camera, options: ImageOptions) -> Picture:
    """Return the window's events warped to its start at the estimated velocity."""
    if not options.polarity:
        votes = _warped(window, result, camera, options, None)
        return Picture(pixels=_tone(votes, _peak(votes)), palette=_ramp(NEUTRAL))
    positive = window.events.is_positive
    on = _warped(window, result, camera, options, positive)
    off = _warped(window, result, camera, options, ~positive)
    peak = _peak(on + off)
    return _two_colours(_tone(on, peak), _tone(off, peak), options)


def overlay_picture(
    window: EventWindow,
    result: WindowResult,
    map_revision: MapRevision | None,
    T_world_camera: NDArray[np.float64],
    camera: Camera,
    options: ImageOptions,
) -> Picture:
    """Return the warped window on the map as seen from its pose.

    Edges that the map has are drawn in `EXPLAINED`, others in `UNEXPLAINED`, the map itself in grey.
    Without a map every edge is unexplained.

    Args:
        window: its events.
        result: its velocity.
        map_revision: a map, or None.
        T_world_camera: the window's pose (4, 4) as it is known when that map holds.
        camera: of the session.
        options: how it is drawn.
    """
    if map_revision is not None:
        result = replace(result, T_world_camera=T_world_camera, normal_world=map_revision.normal_world)
    votes = _warped(window, result, camera, options, None)
    level = _tone(votes, _peak(votes)) // 3  # three ramps of 85 colours share the palette
    palette = _three_ramps(UNEXPLAINED, EXPLAINED, MAP)
    if map_revision is None:
        return Picture(pixels=level, palette=palette)
    seen = map_seen_from(map_revision, T_world_camera, scaled_camera(camera, options.scale))
    reach = 2 * EDGE_REACH_PX * options.scale + 1
    explained = cv2.dilate(seen, np.ones((reach, reach), np.uint8)) >= EDGE_LEVEL
    pixels = np.where(level > 13, level + 86 * explained, 172 + seen // 4)
    return Picture(pixels=np.asarray(pixels, dtype=np.uint8), palette=palette)


def map_seen_from(map_revision: MapRevision, T_world_camera: NDArray[np.float64], grid: Camera) -> Bytes:
    """Return the map's texture (height, width) uint8 as a camera without distortion sees it from a pose.

    Pixels whose ray does not meet the plane are 0.
    """
    plane = Plane(normal=map_revision.normal_world, distance=map_revision.distance)
    H_map_camera = homography_map_camera(T_world_camera, plane)
    k, (u0, v0) = map_revision.px_per_unit, map_revision.origin
    texture_from_map = np.array([[k, 0.0, -k * u0], [0.0, k, -k * v0], [0.0, 0.0, 1.0]])
    H_texture_px = texture_from_map @ H_map_camera @ np.linalg.inv(grid.matrix)
    size = (grid.width, grid.height)
    seen = cv2.warpPerspective(
        map_revision.texture, H_texture_px, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    # The ray's depth has the sign of the third homogeneous coordinate; behind the camera the map would be mirrored.
    a, b, c = H_texture_px[2]
    depth = c + a * np.arange(grid.width) + b * np.arange(grid.height)[:, None]
    return np.asarray(np.where(depth > 0, seen, 0), dtype=np.uint8)


def texture_picture(map_revision: MapRevision) -> Picture:
    """Return the map's texture, light edges on the dark ground."""
    return Picture(pixels=map_revision.texture, palette=_ramp(NEUTRAL))


def map_levels(map_revision: MapRevision) -> Picture:
    """Return the map's texture as it is stored, black to white."""
    return Picture(
        pixels=map_revision.texture, palette=np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    )


def keyframe_picture(image: Bytes) -> Picture:
    """Return a stored keyframe's image (height, width)."""
    return Picture(pixels=image, palette=_ramp(NEUTRAL))


def _warped(
    window: EventWindow, result: WindowResult, camera: Camera, options: ImageOptions, mask: NDArray[np.bool_] | None
) -> Votes:
    """Return the IWE of the events of a mask (None: all), in the finer grid of the options."""
    plane = Plane(normal=result.normal_world).seen_from(result.T_world_camera)
    # On or behind the plane (a lost pose) the homography is not defined: draw with the plane ahead.
    if not plane.distance > 1e-3:
        plane = Plane(normal=np.array([0.0, 0.0, -1.0]))
    bearings, t_s = window.bearings, window.t_s
    grid = scaled_camera(camera, options.scale)
    votes = image_of_warped_events(
        bearings if mask is None else bearings[mask],
        t_s if mask is None else t_s[mask],
        None,
        replace(grid, width=grid.width + 1, height=grid.height + 1),
        omega=result.omega,
        velocity=result.velocity,
        normal=plane.normal,
        distance=plane.distance,
    )
    return votes[: grid.height, : grid.width]


def _counted(points: NDArray[np.float32], camera: Camera) -> Bytes:
    """Return the brightness of pixels by how many of the whole-pixel points (N, 2) fall on them."""
    # A bilinear vote needs a neighbour to the right and below: the last row and column get one here.
    votes = vote(points, None, (camera.height + 1, camera.width + 1))[: camera.height, : camera.width]
    return _RAW_LEVELS[np.minimum(votes, 3).astype(np.uint8)]


def _peak(votes: Votes) -> float:
    """Return the votes that are drawn at full brightness: the 99th percentile of pixels that have any."""
    occupied = votes[votes > 0.25]
    if len(occupied) == 0:
        return 1.0
    rank = int(0.99 * (len(occupied) - 1))
    return max(1.0, float(np.partition(occupied, rank)[rank]))


def _tone(votes: Votes, peak: float) -> Bytes:
    """Return brightness 0 to 255 of votes: square root, so that weak edges beside strong ones are seen."""
    root = np.asarray(cv2.sqrt(votes))
    return np.asarray(cv2.convertScaleAbs(root, alpha=255 / np.sqrt(peak)), dtype=np.uint8)


def _two_colours(on: Bytes, off: Bytes, options: ImageOptions) -> Picture:
    if not options.polarity:
        return Picture(pixels=np.maximum(on, off), palette=_ramp(NEUTRAL))
    return Picture(pixels=np.asarray((on & 0xF0) | (off >> 4), dtype=np.uint8), palette=_polarity_palette())


_RAW_LEVELS = np.array([0, 150, 205, 255], dtype=np.uint8)  # one event is seen at once, three or more are full


def _colours(share: NDArray[np.float64], rgb: tuple[int, int, int]) -> NDArray[np.float64]:
    return (1 - share[:, None]) * np.array(BACKGROUND) + share[:, None] * np.array(rgb)


@lru_cache(maxsize=8)
def _ramp(rgb: tuple[int, int, int]) -> Bytes:
    """Return 256 colours from background to `rgb`."""
    return np.rint(_colours(np.arange(256) / 255, rgb)).astype(np.uint8)


@lru_cache(maxsize=1)
def _polarity_palette() -> Bytes:
    """Return the colours of 16 levels of positive (high half byte) by 16 levels of negative."""
    share = np.arange(16) / 15
    on, off = _colours(share, POSITIVE), _colours(share, NEGATIVE)
    return np.rint(np.maximum(on[:, None], off[None])).reshape(256, 3).astype(np.uint8)


@lru_cache(maxsize=2)
def _three_ramps(first: tuple[int, int, int], second: tuple[int, int, int], third: tuple[int, int, int]) -> Bytes:
    """Return three ramps of 86, 86 and 84 colours."""
    # The third ends at 64 levels of a texture: its ramp is stretched so that a sure edge is full.
    parts = (_colours(np.arange(86) / 85, first), _colours(np.arange(86) / 85, second))
    return np.rint(np.vstack([*parts, _colours(np.minimum(np.arange(84) / 63, 1), third)])).astype(np.uint8)


@lru_cache(maxsize=8)
def _nearest_pixels(camera: Camera) -> NDArray[np.float32]:
    """Return the nearest undistorted pixel (height, width, 2) of each sensor pixel."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    return np.rint(camera.bearing_table() * focal + centre).astype(np.float32)
