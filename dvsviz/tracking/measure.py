"""The images of a tracked window and the numbers read off them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import vote, warp_points
from dvsviz.contrast.warp import Warp, map_warp
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.tracking import constants as c
from dvsviz.tracking.traces import Trace

Array = NDArray[np.float64]
Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowImages:
    """A window before and after its motion was undone.

    Attributes:
        warped: IWE (height, width) at the middle of the window, weights 1.
        contrast_before: variance of the signed image without motion (eq. 2.3).
        contrast_after: variance of the signed IWE at the estimated motion.
        edge_pixels: pixels of `warped` that hold an edge.
        displacement_px: mean image displacement from start to end.
    """

    warped: Image
    contrast_before: float
    contrast_after: float
    edge_pixels: int
    displacement_px: float


def measure(camera: Camera, plane: Plane, window: EventWindow, trace: Trace) -> WindowImages:
    """Return the window's images and numbers at its tracked motion.

    Args:
        camera: gives the grid.
        plane: in the world.
        window: its events (a sample of `MEASURE_EVENTS` is used where there are more).
        trace: its pose and velocities.
    """
    step = -(-len(window) // c.MEASURE_EVENTS)
    bearings, t_s = window.bearings[::step], window.t_s[::step]
    sign = np.where(window.events.is_positive[::step], np.float32(1), np.float32(-1))
    shape = (camera.height, camera.width)
    raw = (bearings * np.array([camera.fx, camera.fy]) + np.array([camera.cx, camera.cy])).astype(np.float32)
    to_image = camera.matrix @ np.linalg.inv(homography_map_camera(trace.T_world_camera, plane))
    warp = map_warp(
        trace.T_world_camera,
        trace.omega,
        trace.velocity,
        plane,
        -trace.mid_s,
        trace.duration_s,
        to_image,
        derivatives=False,
    )
    points = warp_points(bearings, t_s, warp)
    warped = vote(points, None, shape)
    positive = vote(points, sign, shape)
    occupied = warped[warped > 0]
    level = max(1.5, 0.5 * float(np.percentile(occupied, 90))) if len(occupied) else 1.5
    return WindowImages(
        warped=warped,
        contrast_before=float(vote(raw, sign, shape).var()),
        contrast_after=float(positive.var()),
        edge_pixels=int((warped > level).sum()),
        displacement_px=displacement_px(warp, camera),
    )


def displacement_px(warp: Warp, camera: Camera) -> float:
    """Return the mean distance (px) over the image between where a warp's first and last node put a bearing."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 5), np.linspace(0, camera.height - 1, 4))
    b = np.column_stack([(x.ravel() - camera.cx) / camera.fx, (y.ravel() - camera.cy) / camera.fy, np.ones(x.size)])
    first, last = b @ warp.nodes[0].T, b @ warp.nodes[-1].T
    delta = first[:, :2] / first[:, 2:] - last[:, :2] / last[:, 2:]
    return float(np.linalg.norm(delta, axis=1).mean())
