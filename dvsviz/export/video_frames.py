"""The frames of a video: warped window, window on the map, and the scene side by side, with time and state."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.export.stage import Stage
from dvsviz.session.records import STATUSES
from dvsviz.view.drawing import draw
from dvsviz.view.geometry3d import STATUS_RGB
from dvsviz.view.images import BACKGROUND, ImageKind, ImageOptions
from dvsviz.view.shown import ShownSession

Image = NDArray[np.uint8]

PANEL_WIDTH = 480
GAP, HEAD, FOOT = 16, 52, 84
STRIP = 12
"""Height in px of the strip of states at the bottom."""

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_GROUND, _TEXT, _DIM, _LINE = (18, 21, 26), (233, 236, 239), (152, 162, 174), (60, 68, 79)
_SCORE = (217, 195, 106)
_CAPTION = 26


class Frames:
    """Draws frames of some windows of a session, in increasing order.

    Args:
        shown: the session.
        windows: first and last window of the video.
    """

    def __init__(self, shown: ShownSession, windows: tuple[int, int]) -> None:
        self._shown = shown
        self._first, self._last = windows
        camera = shown.session.header.camera
        self._panel = (PANEL_WIDTH, round(PANEL_WIDTH * camera.height / camera.width))
        # Even sides: the chroma of a video has half the resolution.
        self.width = (3 * PANEL_WIDTH + 4 * GAP) // 2 * 2
        self.height = (HEAD + _CAPTION + self._panel[1] + GAP + FOOT) // 2 * 2
        self._t_s = shown.plotted(0)["t_s"]
        self._status = shown.statuses()
        self._scale = max(1, min(4, round(PANEL_WIDTH / camera.width)))
        self._stage = Stage(shown, windows, *self._panel)
        self._drawn = -1
        self._below = self._background()
        self._image = self._below

    def frame(self, window: int, t_s: float) -> Image:
        """Return the frame (height, width, 3) RGB of a window at a time; a window is drawn once."""
        if window != self._drawn:
            self._drawn = window
            image = self._below.copy()
            for place, kind in enumerate((ImageKind.WARPED, ImageKind.MAP)):
                self._put(image, place, self._picture(window, kind))
            self._put(image, 2, self._stage.picture(window))
            self._state(image, window)
            self._image = image
        image = self._image.copy()
        text = f"{int(t_s // 60):02d}:{t_s % 60:06.3f}   window {window}"
        cv2.putText(image, text, (GAP + PANEL_WIDTH + GAP, 34), _FONT, 0.62, _TEXT, 1, cv2.LINE_AA)
        x = round(float(self._x(t_s)))
        cv2.line(image, (x, self.height - FOOT + 4), (x, self.height - 8), _TEXT, 1)
        return image

    def _picture(self, window: int, kind: ImageKind) -> Image:
        picture = draw(self._shown, window, kind, ImageOptions(scale=self._scale))
        if picture is None:
            return np.full((self._panel[1], self._panel[0], 3), BACKGROUND, dtype=np.uint8)
        rgb = picture.rgb()
        if (rgb.shape[1], rgb.shape[0]) == self._panel:
            return rgb
        way = cv2.INTER_AREA if rgb.shape[1] > self._panel[0] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(rgb, self._panel, interpolation=way), dtype=np.uint8)

    def _put(self, image: Image, place: int, picture: Image) -> None:
        left, top = GAP + place * (PANEL_WIDTH + GAP), HEAD + _CAPTION
        image[top : top + self._panel[1], left : left + PANEL_WIDTH] = picture

    def _state(self, image: Image, window: int) -> None:
        status = STATUSES[int(self._status[window])]
        (wide, _), _ = cv2.getTextSize(str(status), _FONT, 0.62, 1)
        right = self.width - GAP
        cv2.rectangle(image, (right - wide - 24, 12), (right, 44), STATUS_RGB[status], -1)
        cv2.putText(image, str(status), (right - wide - 12, 34), _FONT, 0.62, (0, 0, 0), 1, cv2.LINE_AA)

    def _x(self, t_s: NDArray[np.float64] | float) -> NDArray[np.float64]:
        begin, end = self._t_s[self._first], self._t_s[self._last]
        share = (np.asarray(t_s) - begin) / max(1e-9, end - begin)
        return GAP + np.clip(share, 0, 1) * (self.width - 2 * GAP - 1)

    def _background(self) -> Image:
        """Return what every frame has: captions, the strip of states, the curve of the score."""
        image = np.full((self.height, self.width, 3), _GROUND, dtype=np.uint8)
        name = (
            self._shown.name if self._shown.name.isascii() else self._shown.name.encode("ascii", "replace").decode()
        )
        cv2.putText(image, name[:40], (GAP, 34), _FONT, 0.7, _TEXT, 1, cv2.LINE_AA)
        for place, caption in enumerate(("warped by the estimated motion", "on the map", "path, map and camera")):
            at = (GAP + place * (PANEL_WIDTH + GAP), HEAD + 16)
            cv2.putText(image, caption, at, _FONT, 0.46, _DIM, 1, cv2.LINE_AA)
        chosen = slice(self._first, self._last + 1)
        x, status = self._x(self._t_s[chosen]), self._status[chosen]
        top, bottom = self.height - FOOT + 4, self.height - 8
        for k in range(len(x)):
            right = x[k + 1] if k + 1 < len(x) else self.width - GAP
            colour = STATUS_RGB[STATUSES[int(status[k])]]
            cv2.rectangle(image, (round(x[k]), bottom - STRIP), (round(right), bottom), colour, -1)
        low = bottom - STRIP - 6
        cv2.line(image, (GAP, low), (self.width - GAP, low), _LINE, 1)
        score = np.asarray(self._shown.plotted(0)["score"][chosen], dtype=np.float64)
        y = low - np.clip(score, 0, 1) * (low - top)
        for part in np.split(np.arange(len(x)), np.flatnonzero(np.diff(np.isfinite(y).astype(int))) + 1):
            if len(part) > 1 and np.isfinite(y[part[0]]):
                points = np.stack([x[part], y[part]], axis=1).round().astype(np.int32)
                cv2.polylines(image, [points], False, _SCORE, 1, cv2.LINE_AA)
        cv2.putText(image, "map score", (GAP, low - 5), _FONT, 0.4, _DIM, 1, cv2.LINE_AA)
        return image
