"""What a window looks like: raw, warped, and on the map, on a dark background.

All images lie on the camera's *undistorted* pixel grid (same K, no distortion), so that raw, warped and map can be
compared pixel by pixel. `scale` makes the grid finer for warped events and map, whose positions are sub-pixel; raw
events are repeated instead, because one event is one pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import vote
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.session.records import MapRevision
from dvsviz.view.moving import MovingWindow, Polarities, votes_of
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
# In the picture of what is left over, explained edges are this bright.
_DIMMED = 0.6


MOST_WINDOWS = 64
LONGEST_MS = 1000.0


class ImageKind(StrEnum):
    """What can be drawn of a window."""

    RAW = "raw"
    WARPED = "warped"
    MAP = "map"
    TEXTURE = "texture"
    RESIDUAL = "residual"
    TRUTH = "truth"
    ALIGNED = "aligned"


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageOptions:
    """How a window is drawn.

    Attributes:
        polarity: on and off events in two colours.
        scale: pixels of the image per sensor pixel, 1 to 4.
        windows: how many windows, from the shown one on, are laid on each other.
        ms: milliseconds from the window's start instead; 0 for whole windows.
        events: which polarities are drawn.
    """

    polarity: bool = True
    scale: int = 1
    windows: int = 1
    ms: float = 0.0
    events: Polarities = Polarities.BOTH

    def __post_init__(self) -> None:
        if not 1 <= self.scale <= 4:
            raise ValueError(f"scale: expected 1 to 4, got {self.scale}")
        if not 1 <= self.windows <= MOST_WINDOWS:
            raise ValueError(f"windows: expected 1 to {MOST_WINDOWS}, got {self.windows}")
        if not 0 <= self.ms <= LONGEST_MS:
            raise ValueError(f"ms: expected 0 to {LONGEST_MS:g}, got {self.ms}")

    @property
    def wanted(self) -> tuple[bool, bool]:
        """Whether on and off events are drawn."""
        return self.events is not Polarities.OFF, self.events is not Polarities.ON


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


def raw_picture(windows: Sequence[EventWindow], camera: Camera, options: ImageOptions) -> Picture:
    """Return the events as recorded, each at its nearest undistorted pixel."""
    pixels = _nearest_pixels(camera)
    drawn: list[Bytes] = []
    for sign, wanted in zip((True, False), options.wanted, strict=True):
        chosen = [w.events.is_positive == sign for w in windows] if wanted else []
        points = [
            pixels[w.events.y_px[m], w.events.x_px[m]]
            for w, m in zip(windows if wanted else (), chosen, strict=True)
        ]
        drawn.append(_counted(np.concatenate(points) if points else np.zeros((0, 2), np.float32), camera))
    picture = _two_colours(drawn[0], drawn[1], options)
    if options.scale == 1:
        return picture
    return Picture(pixels=picture.pixels.repeat(options.scale, 0).repeat(options.scale, 1), palette=picture.palette)


def warped_picture(
    moving: Sequence[MovingWindow],
    T_world_camera: NDArray[np.float64],
    plane_world: Plane,
    camera: Camera,
    options: ImageOptions,
) -> Picture:
    """Return the windows' events moved back by their motions into the camera at a pose.

    Args:
        moving: windows with their motions.
        T_world_camera: pose (4, 4) that is looked from.
        plane_world: where the events come from.
        camera: of the session.
        options: how it is drawn.
    """
    if not options.polarity:
        votes = _votes(moving, T_world_camera, plane_world, camera, options)
        return Picture(pixels=_tone(votes, _peak(votes)), palette=_ramp(NEUTRAL))
    grid = scaled_camera(camera, options.scale)
    on, off = (
        votes_of(moving if wanted else (), T_world_camera, plane_world, grid, positive=sign)
        for sign, wanted in zip((True, False), options.wanted, strict=True)
    )
    peak = _peak(on + off)
    return _two_colours(_tone(on, peak), _tone(off, peak), options)


def overlay_picture(
    moving: Sequence[MovingWindow],
    T_world_camera: NDArray[np.float64],
    map_revision: MapRevision | None,
    camera: Camera,
    options: ImageOptions,
    *,
    with_map: bool = True,
) -> Picture:
    """Return the warped windows on the map as seen from a pose.

    Edges that the map has are drawn in `EXPLAINED`, others in `UNEXPLAINED`, the map itself in grey.
    Without a map every edge is unexplained.

    Args:
        moving: windows with their motions.
        T_world_camera: pose (4, 4) that is looked from, in the world in which that map holds.
        map_revision: a map, or None.
        camera: of the session.
        options: how it is drawn.
        with_map: False leaves the map away and dims what it explains: what is left over stands out.
    """
    if map_revision is None:
        plane = Plane(normal=np.array([0.0, 0.0, -1.0]))
    else:
        plane = Plane(normal=map_revision.normal_world, distance=map_revision.distance)
    votes = _votes(moving, T_world_camera, plane, camera, options)
    level = _tone(votes, _peak(votes)) // 3  # three ramps of 85 colours share the palette
    palette = _three_ramps(UNEXPLAINED, EXPLAINED, MAP)
    if map_revision is None:
        return Picture(pixels=level, palette=palette)
    seen = map_seen_from(map_revision, T_world_camera, scaled_camera(camera, options.scale))
    reach = 2 * EDGE_REACH_PX * options.scale + 1
    explained = cv2.dilate(seen, np.ones((reach, reach), np.uint8)) >= EDGE_LEVEL
    if not with_map:
        pixels = np.where(explained, 86 + np.asarray(_DIMMED * level, dtype=np.uint8), level)
        return Picture(pixels=np.asarray(pixels, dtype=np.uint8), palette=palette)
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


def _votes(
    moving: Sequence[MovingWindow],
    T_world_camera: NDArray[np.float64],
    plane_world: Plane,
    camera: Camera,
    options: ImageOptions,
) -> Votes:
    """Return the image of the wanted events, in the finer grid of the options."""
    sign = None if options.events is Polarities.BOTH else options.events is Polarities.ON
    return votes_of(moving, T_world_camera, plane_world, scaled_camera(camera, options.scale), positive=sign)


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
