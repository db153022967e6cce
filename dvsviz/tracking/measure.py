"""The images of a tracked window and the numbers read off them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.tracking import constants as c
from dvsviz.tracking.kernels import mean_displacement, vote_window
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
        edge_level: votes above which a pixel of `warped` holds an edge.
        edge_pixels: pixels of `warped` that hold an edge.
        displacement_px: mean image displacement from start to end.
    """

    warped: Image
    contrast_before: float
    contrast_after: float
    edge_level: float
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
    bearings = np.ascontiguousarray(window.bearings[::step])
    t_s = np.ascontiguousarray(window.t_s[::step])
    sign = np.where(window.events.is_positive[::step], np.float32(1), np.float32(-1))
    warped, signed, raw = (np.zeros((camera.height, camera.width), dtype=np.float32) for _ in range(3))
    K = camera.matrix
    warp = trace.warp(plane, K @ np.linalg.inv(homography_map_camera(trace.T_world_camera, plane)))
    vote_window(bearings, t_s, sign, warp.nodes, warp.scale, K, warped, signed, raw)
    occupied = warped[warped > 0]
    level = max(1.5, 0.5 * float(np.percentile(occupied, 90))) if len(occupied) else 1.5
    return WindowImages(
        warped=warped,
        contrast_before=float(raw.var()),
        contrast_after=float(signed.var()),
        edge_level=level,
        edge_pixels=int(np.count_nonzero(warped > level)),
        displacement_px=float(mean_displacement(warp.nodes[0], warp.nodes[-1], K, camera.width, camera.height)),
    )
