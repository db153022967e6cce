"""The motion of one window by contrast alone: how tracking starts, and how a lost window is de-skewed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.objectives import ObjectiveName
from dvsviz.contrast.solve import ContrastProblem, ContrastSolution, maximize_contrast
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.tracking import constants as c

# The plane assumed before anything is known: straight ahead.
AHEAD = np.array([0.0, 0.0, -1.0])


def contrast_problem(
    camera: Camera, window: EventWindow, pick: slice | NDArray[np.int64], seed: int
) -> ContrastProblem:
    """Return the contrast of some of a window's events, signed.

    On integer pixels zero motion is an artificial maximum of the bilinear votes: half a pixel of dither removes it.

    Args:
        camera: of the window.
        window: its events.
        pick: which of them.
        seed: of the dither.
    """
    bearings = window.bearings[pick]
    rng = np.random.default_rng((seed, window.index))
    dither = rng.uniform(-0.5, 0.5, bearings.shape) / (camera.fx, camera.fy)
    return ContrastProblem(
        bearings=(bearings + dither).astype(np.float32),
        t_s=np.ascontiguousarray(window.t_s[pick]),
        weights=np.where(window.events.is_positive[pick], np.float32(1), np.float32(-1)),
        camera=camera,
        duration_s=window.duration_s,
    )


def motion_by_contrast(
    camera: Camera,
    window: EventWindow,
    plane: Plane,
    free: NDArray[np.bool_],
    seed: int,
    *,
    name: ObjectiveName = "variance",
    with_normal: bool = False,
) -> ContrastSolution:
    """Return the motion of a window from a zero start, of a sample of its events.

    Args:
        camera: of the window.
        window: its events.
        plane: in the camera frame; the plane ahead is taken where the camera is too close to it.
        free: mask (6,) over rotation and translation.
        seed: of the dither.
        name: the objective.
        with_normal: also find the plane's normal (8 parameters).
    """
    step = max(1, len(window) // c.CONTRAST_EVENTS)
    return maximize_contrast(
        contrast_problem(camera, window, slice(None, None, step), seed),
        plane if plane.distance > c.PLANE_TOO_NEAR else Plane(normal=AHEAD),
        free=free,
        with_normal=with_normal,
        name=name,
        ridge=c.CONTRAST_RIDGE,
        blurs_px=c.CONTRAST_BLURS_PX,
        max_evaluations=c.CONTRAST_EVALUATIONS,
    )
