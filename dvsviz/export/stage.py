"""The 3-D corner of a video: map, path and camera seen from a fixed place, drawn with lines and one warp."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.session.records import STATUSES
from dvsviz.view.geometry3d import STATUS_RGB, pyramid, viewpoint
from dvsviz.view.images import BACKGROUND, map_seen_from
from dvsviz.view.shown import ShownSession

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_TRUTH_RGB = (204, 121, 167)
_AHEAD_RGB = (70, 78, 88)
_CAMERA_RGB = (236, 240, 243)
_FOV_RAD = 0.9
_NEAREST = 0.02
_SHIFT = 4  # OpenCV's sub-pixel lines: coordinates in sixteenths


class Stage:
    """The scene of some windows of a session; the path behind the camera is coloured by state.

    Args:
        shown: the session.
        windows: first and last window that is shown.
        width: of the picture, px.
        height: of the picture, px.
    """

    def __init__(self, shown: ShownSession, windows: tuple[int, int], width: int, height: int) -> None:
        first, last = windows
        self._Ts = shown.poses()
        self._status = shown.statuses()
        self._first, self._drawn = first, first
        f = height / 2 / np.tan(_FOV_RAD / 2)
        self._grid = Camera(width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2, cy=(height - 1) / 2)
        T_world_view = _pose_of_eye(*viewpoint(self._Ts[first : last + 1]))
        self._T_view_world = se3.inverse(T_world_view)
        vertices, _ = pyramid(shown.session.header.camera, 0.16)
        self._pyramid = vertices
        ground = np.full((height, width, 3), BACKGROUND, dtype=np.float64)
        revision = shown.newest_map()
        if revision is not None:
            seen = map_seen_from(revision, T_world_view, self._grid)[..., None] / 255
            ground += seen * (np.array((150, 158, 168)) - ground)
        self._image = np.asarray(ground, dtype=np.uint8)
        truth = shown.errors().truth_world if shown.has_truth else None
        if truth is not None:
            t_us = shown.session.column("start_us")
            inside = (truth.t_us >= t_us[first]) & (truth.t_us <= t_us[last])
            self._lines(self._image, truth.positions[inside], _TRUTH_RGB)
        self._lines(self._image, self._Ts[first : last + 1, :3, 3], _AHEAD_RGB)

    def picture(self, window: int) -> Image:
        """Return the picture (height, width, 3) RGB with the camera at a window; windows only go forward."""
        for k in range(self._drawn, window):
            colour = STATUS_RGB[STATUSES[int(self._status[k + 1])]]
            self._lines(self._image, self._Ts[k : k + 2, :3, 3], colour, thickness=2)
        self._drawn = max(self._drawn, window)
        image = self._image.copy()
        T = self._Ts[window]
        if np.isfinite(T).all():
            corners = self._pyramid @ T[:3, :3].T + T[:3, 3]
            for way in ((1, 2, 3, 4, 1), (0, 1), (0, 2), (0, 3), (0, 4)):
                self._lines(image, corners[list(way)], _CAMERA_RGB, thickness=2)
        return image

    def _lines(self, image: Image, points: Array, rgb: tuple[int, int, int], *, thickness: int = 1) -> None:
        """Draw a line through world points (N, 3); parts behind the eye are left out."""
        if len(points) < 2:
            return
        p = points @ self._T_view_world[:3, :3].T + self._T_view_world[:3, 3]
        ahead = np.isfinite(p).all(axis=1) & (p[:, 2] > _NEAREST)
        depth = np.where(ahead, p[:, 2], 1.0)
        pixels = p[:, :2] / depth[:, None] * self._grid.fx + (self._grid.cx, self._grid.cy)
        ahead &= np.abs(np.where(ahead[:, None], pixels, 0.0)).max(axis=1) < 20_000
        fixed = np.where(ahead[:, None], pixels * 2**_SHIFT, 0).round().astype(np.int32)
        for part in np.split(np.arange(len(p)), np.flatnonzero(np.diff(ahead.astype(int))) + 1):
            if len(part) > 1 and ahead[part[0]]:
                cv2.polylines(image, [fixed[part]], False, rgb, thickness, cv2.LINE_AA, _SHIFT)


def _pose_of_eye(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Array:
    """Return `T_world_view` (4, 4) of an eye that looks at a point, the world's y pointing down in its picture."""
    z = np.subtract(target, eye)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return se3.pose(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(eye))
