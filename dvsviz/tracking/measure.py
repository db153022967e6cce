"""The images of a tracked window and the numbers read off them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.tracking import constants as c
from dvsviz.tracking.kernels import edges_of, mean_displacement, variance, vote_window
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
    warped, signed, raw = np.zeros((3, camera.height, camera.width), dtype=np.float32)
    K = camera.matrix
    warp = trace.warp(plane, K @ np.linalg.inv(homography_map_camera(trace.T_world_camera, plane)))
    vote_window(
        window.bearings,
        _frozen(window.events.t_us),
        _frozen(window.events.is_positive),
        -(-len(window) // c.MEASURE_EVENTS),
        window.start_us,
        warp.nodes,
        warp.scale,
        K,
        warped,
        signed,
        raw,
    )
    level, edges = edges_of(warped, c.EDGE_VOTES)
    return WindowImages(
        warped=warped,
        contrast_before=variance(raw),
        contrast_after=variance(signed),
        edge_level=level,
        edge_pixels=edges,
        displacement_px=float(mean_displacement(warp.nodes[0], warp.nodes[-1], K, camera.width, camera.height)),
    )


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view: a kernel is compiled for one kind of array, whoever made it."""
    view = array.view()
    view.flags.writeable = False
    return view
