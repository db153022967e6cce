"""Depth cameras that stand beside the colour camera: their depth images, seen from the colour camera.

Most RGB-D files hold depth already aligned with colour. Raw files of the first structured-light sensors do not: their
depth image has another focal length and stands 25 mm to the left. Taken as aligned it is wrong by twenty pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera

Array = NDArray[np.float64]

# Factory values of the first Kinect, for images 640 pixels wide: colour 525 px, infrared 585 px, 25 mm apart.
_KINECT_COLOUR_FOCAL = 525.0
_KINECT_OFFSET_M = 0.025
# A pixel is at a depth step where neighbours differ by more than this share of the depth.
_STEP_SHARE = 0.05
# Fewer pixels at depth steps say nothing.
_MIN_STEPS = 50


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """A colour and a depth camera.

    Attributes:
        colour: the colour camera, whose pose is the frame's pose.
        depth: the depth camera.
        T_colour_depth: pose (4, 4) of the depth camera in the colour camera, metres.
    """

    colour: Camera
    depth: Camera
    T_colour_depth: Array

    def depth_in_colour(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a depth image (height, width) of the depth camera as the colour camera would measure it.

        Each pixel is moved on its own; where two land on one pixel the nearer is seen, single-pixel holes are closed.
        """
        height, width = depth.shape
        known = np.isfinite(depth)
        z = depth[known].astype(np.float64)
        rays = self.depth.bearing_table()[known]
        p = np.column_stack([rays * z[:, None], z]) @ self.T_colour_depth[:3, :3].T + self.T_colour_depth[:3, 3]
        pixels = np.rint(self.colour.project(p[:, :2] / p[:, 2:])).astype(np.int64)
        inside = (pixels[:, 0] >= 0) & (pixels[:, 0] < width) & (pixels[:, 1] >= 0) & (pixels[:, 1] < height)
        inside &= p[:, 2] > 0
        seen = np.full(height * width, np.inf, dtype=np.float32)
        np.minimum.at(seen, pixels[inside, 1] * width + pixels[inside, 0], p[inside, 2].astype(np.float32))
        seen = seen.reshape(height, width)
        # A hole with measured neighbours on both sides is a rounding of the grid, not a shadow.
        filled = cv2.erode(seen, np.ones((3, 3), np.uint8))
        neighbours = cv2.boxFilter(np.isfinite(seen).astype(np.float32), -1, (3, 3), normalize=False)
        holes = ~np.isfinite(seen) & (neighbours >= 6)
        return np.where(holes, filled, np.where(np.isfinite(seen), seen, np.float32(np.nan)))


def kinect(depth: Camera) -> Rig:
    """Return the factory rig of the first Kinect around its depth camera."""
    scale = depth.width / 640
    colour = replace(
        depth,
        fx=_KINECT_COLOUR_FOCAL * scale,
        fy=_KINECT_COLOUR_FOCAL * scale,
        cx=(depth.width - 1) / 2,
        cy=(depth.height - 1) / 2,
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
        is_guess=True,
    )
    return Rig(colour=colour, depth=depth, T_colour_depth=se3.pose(position=[-_KINECT_OFFSET_M, 0.0, 0.0]))


def edge_agreement(grey: NDArray[np.uint8], depth: NDArray[np.float32]) -> float:
    """Return how much stronger the image's edges are where the depth steps than elsewhere; 1 is chance.

    It needs no poses: aligned depth steps lie on the outlines of objects. NaN where the depth has no steps.
    """
    steps, is_measured = depth_steps(depth)
    if steps is None:
        return float("nan")
    outline = outlines(grey)
    return float(outline[steps].mean() / outline[is_measured].mean())


def outlines(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how strong the edges of an image (height, width) are, a little blurred."""
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    return np.asarray(cv2.GaussianBlur(gradient, (0, 0), 1.5), dtype=np.float32)


def depth_steps(depth: NDArray[np.float32]) -> tuple[NDArray[np.bool_] | None, NDArray[np.bool_]]:
    """Return where a depth image (height, width) steps, None for too few places, and where it was measured."""
    z = np.where(np.isfinite(depth), depth, np.float32(0))
    nearest = cv2.erode(np.where(z > 0, z, np.float32(1e3)), np.ones((3, 3), np.uint8))
    farthest = cv2.dilate(z, np.ones((3, 3), np.uint8))
    is_measured = cv2.erode((z > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    steps = is_measured & (farthest - nearest > _STEP_SHARE * nearest)
    return (steps if steps.sum() >= _MIN_STEPS else None), is_measured
