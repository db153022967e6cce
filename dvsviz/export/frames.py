"""A window's warped events as the PNG image that the camera carries."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import image_of_warped_events
from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import WindowResult

# RGB; warm and cool stay apart for the common kinds of colour blindness.
_BACKGROUND, _POSITIVE, _NEGATIVE = np.array([12, 15, 19]), np.array([255, 183, 77]), np.array([86, 180, 233])
# Votes at this percentile of the pixels that have any are drawn at full brightness.
_PEAK_PERCENTILE = 99
MAP_CANVAS_PX = 1024
# Grey levels of ground and sure edge: the ground is told from the background. Grey encodes three times faster.
_MAP_LEVELS = np.linspace(34, 240, 256).round().astype(np.uint8)
# Nearer than this to the plane, or behind it (a lost pose), the homography is not defined.
_MIN_DISTANCE = 1e-3


def event_window(recording: Recording, result: WindowResult, camera: Camera) -> EventWindow | None:
    """Return the events of a stored window again, or None where the recording does not have them (any more)."""
    events = recording.events.read(result.first_event, result.end_event)
    if len(events) == 0 or int(events.t_us[0]) != result.start_us:
        return None
    if int(events.x_px.max()) >= camera.width or int(events.y_px.max()) >= camera.height:
        return None
    return make_window(camera, events, index=result.window, first_event=result.first_event, end_us=result.end_us)


def warped_png(window: EventWindow, result: WindowResult, camera: Camera) -> bytes:
    """Return a window's events, warped to its start at the estimated velocity, as a colour PNG.

    The image lies on the camera's undistorted pixel grid, on and off events in two colours.
    """
    plane = Plane(normal=result.normal_world).seen_from(result.T_world_camera)
    if not plane.distance > _MIN_DISTANCE:
        plane = Plane(normal=np.array([0.0, 0.0, -1.0]))
    grid = replace(camera, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
    votes = [
        image_of_warped_events(
            window.bearings[mask],
            window.t_s[mask],
            None,
            grid,
            omega=result.omega,
            velocity=result.velocity,
            normal=plane.normal,
            distance=plane.distance,
        )
        for mask in (window.events.is_positive, ~window.events.is_positive)
    ]
    occupied = (votes[0] + votes[1])[(votes[0] + votes[1]) > 0]
    peak = max(1.0, float(np.percentile(occupied, _PEAK_PERCENTILE))) if len(occupied) else 1.0
    # The square root shows weak edges beside strong ones.
    on, off = (np.sqrt(np.minimum(v / peak, 1))[..., None] for v in votes)
    image = np.maximum(_BACKGROUND + on * (_POSITIVE - _BACKGROUND), _BACKGROUND + off * (_NEGATIVE - _BACKGROUND))
    return _png(np.clip(image, 0, 255).astype(np.uint8)[..., ::-1])


def map_png(texture: NDArray[np.uint8]) -> tuple[bytes, float]:
    """Return a map's texture (rows, columns) on a square canvas as a PNG, and canvas pixels per texture pixel.

    The canvas is as large for every texture, because the viewer refuses images of one entity whose size changes. The
    texture fills its width or height and lies in its middle, light edges on a dark ground.
    """
    rows, columns = texture.shape
    scale = MAP_CANVAS_PX / max(rows, columns)
    top, left = (MAP_CANVAS_PX - scale * rows) / 2, (MAP_CANVAS_PX - scale * columns) / 2
    # Pixel centres: texture (column + 0.5) * scale + left = canvas (column + 0.5).
    into_canvas = np.array([[scale, 0, left + 0.5 * scale - 0.5], [0, scale, top + 0.5 * scale - 0.5]])
    interpolation = cv2.INTER_LINEAR if scale >= 1 else cv2.INTER_AREA
    canvas = cv2.warpAffine(texture, into_canvas, (MAP_CANVAS_PX, MAP_CANVAS_PX), flags=interpolation)
    return _png(np.asarray(cv2.LUT(canvas, _MAP_LEVELS), dtype=np.uint8)), scale


def grey_png(image: NDArray[np.uint8]) -> bytes:
    """Return a grey image (rows, columns) as PNG."""
    return _png(image)


def _png(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()
