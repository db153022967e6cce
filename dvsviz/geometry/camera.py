"""The pinhole camera with radial-tangential distortion.

Pixels: (0, 0) is the centre of the top-left pixel, x grows right (column), y grows down (row).
A *bearing* is (x, y, 1) in optical axes (x right, y down, z forward): the undistorted, calibrated pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Iterations of the undistortion: OpenCV's default (5) is off by pixels in the corners of wide lenses.
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """A calibrated pinhole camera.

    Attributes:
        width: sensor columns.
        height: sensor rows.
        fx: focal length in x, px.
        fy: focal length in y, px.
        cx: principal point column, px.
        cy: principal point row, px.
        distortion: k1, k2, p1, p2, k3 of the radial-tangential model (OpenCV's order).
        is_guess: True where no calibration was given and the values are the documented guess.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    is_guess: bool = False

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width, height: expected at least 1, got {self.width}x{self.height}")
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if len(self.distortion) != 5 or not np.all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"camera: expected finite fx, fy > 0 and five distortion values, got {values}")

    @classmethod
    def guess(cls, width: int, height: int) -> Camera:
        """Return the camera assumed where no calibration is known: f = 0.8 x width, centred, no distortion.

        0.8 widths (64 degrees across) lies in the middle of the lenses of public event datasets.
        """
        f = 0.8 * width
        return cls(width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2, cy=(height - 1) / 2, is_guess=True)

    @property
    def focal_px(self) -> float:
        """Mean focal length, px: what a step in bearings or rad is in the image."""
        return 0.5 * (self.fx + self.fy)

    def reduced(self, focal_px: float) -> Camera:
        """Return the same view on fewer pixels, where the focal length is longer than `focal_px`, else this camera."""
        scale = focal_px / self.focal_px
        if scale >= 1.0:
            return self
        return Camera(
            width=max(1, round(self.width * scale)),
            height=max(1, round(self.height * scale)),
            fx=self.fx * scale,
            fy=self.fy * scale,
            cx=(self.cx + 0.5) * scale - 0.5,
            cy=(self.cy + 0.5) * scale - 0.5,
            distortion=self.distortion,
            is_guess=self.is_guess,
        )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The calibration matrix K (3, 3), px."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def has_distortion(self) -> bool:
        """True where any distortion coefficient is not zero."""
        return any(self.distortion)

    def bearings(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Return undistorted bearings (N, 2), the x and y of (x, y, 1), of sensor pixels (N, 2)."""
        px = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if len(px) == 0:
            return np.zeros((0, 2))
        if not self.has_distortion:
            return (px[:, 0] - (self.cx, self.cy)) / (self.fx, self.fy)
        undistorted = cv2.undistortPoints(px, self.matrix, np.array(self.distortion), criteria=_UNDISTORT_CRITERIA)
        return np.asarray(undistorted[:, 0], dtype=np.float64)

    def project(self, bearings: ArrayLike) -> NDArray[np.float64]:
        """Return sensor pixels (N, 2), distorted, of bearings (N, 2)."""
        b = np.asarray(bearings, dtype=np.float64).reshape(-1, 2)
        x, y = b[:, 0], b[:, 1]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=-1)

    def bearing_table(self) -> NDArray[np.float32]:
        """Return the bearings (height, width, 2) of all pixel centres, read-only, computed once a camera."""
        return _bearing_table(self)


@lru_cache(maxsize=8)
def _bearing_table(camera: Camera) -> NDArray[np.float32]:
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    table = camera.bearings(np.stack([x.ravel(), y.ravel()], axis=-1)).astype(np.float32)
    table = table.reshape(camera.height, camera.width, 2)
    table.setflags(write=False)
    return table
