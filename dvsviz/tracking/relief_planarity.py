"""Is what a relief map holds a plane? How far its landmarks' motion is from that of one.

The image of a plane moves by `x' = rho(x) B(x) v + C(x) omega` with an inverse depth that is linear in the image; so do
the landmarks of one, across their lines, whether the map knows that the camera turns or takes it for depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.tracking import relief_constants as rc
from dvsviz.tracking.relief_align import Sample
from dvsviz.tracking.relief_map import ReliefMap
from dvsviz.tracking.relief_sweep import image_flow
from dvsviz.tracking.traces import Trace

Array = NDArray[np.float64]
_ROUNDS = 10
# The pixels (N, 2) to which a plane's map moves the events of a window, by its number; None of one it does not know.
OnPlane = Callable[[int, Sample], NDArray[np.float32] | None]


def deviation_of_landmarks(relief_map: ReliefMap, *, may_turn: bool) -> float:
    """Return the median deviation of the landmarks' motion from that of the best plane, by its mean; NaN of too few.

    Args:
        relief_map: several windows old.
        may_turn: the camera may also turn, which a map that knows only translation takes for depth.
    """
    landmarks, seen = relief_map.in_view()
    known = landmarks.information[:, 1, 1] * landmarks.states[:, 1] ** 2
    good = (landmarks.counts[:, 0] > rc.RELIEF_SEEN) & (known > 0)
    velocity = relief_map.mean_velocity()
    speed = float(np.linalg.norm(velocity))
    if good.sum() < rc.RELIEF_LEAST or speed == 0.0:
        return float("nan")
    xy, normal, rho, known = seen[good, :2], seen[good, 2:4], seen[good, 4], known[good]
    one, still = np.ones(len(rho)), np.zeros(3)
    by_depth = (image_flow(xy, one, still, velocity) * normal).sum(axis=1)
    A = by_depth[:, None] * np.column_stack([one, xy])
    if may_turn:
        turns = [(image_flow(xy, 0 * one, axis, still) * normal).sum(axis=1) for axis in np.eye(3)]
        A = np.column_stack([A, *turns])
    mean = speed * float(np.average(rho, weights=known / (known + rc.RELIEF_KNOWN**-2)))
    motion = rho * by_depth
    weight = 1.0 / (rc.RELIEF_KNOWN**2 + motion**2 / known / mean**2)
    robust, off = weight, motion
    for _ in range(_ROUNDS):
        root = np.sqrt(robust)
        off = (motion - A @ np.linalg.lstsq(A * root[:, None], motion * root, rcond=None)[0]) / mean
        robust = weight / (1.0 + (off / rc.RELIEF_OFF_ROBUST) ** 2)
    # Lines along the motion show no depth.
    weight = weight * np.minimum(1.0, (by_depth / speed) ** 2)
    order = np.argsort(np.abs(off))
    total = np.cumsum(weight[order])
    return float(np.abs(off)[order][np.searchsorted(total, 0.5 * total[-1])])


def moved_by_plane(traces: Sequence[Trace], plane: Plane, camera: Camera) -> OnPlane:
    """Return what tells to which pixels a plane's map moves a window's events.

    Args:
        traces: the windows that were tracked on it.
        plane: in the world.
        camera: of the pixels.
    """
    by_window, K = {t.window: t for t in traces}, camera.matrix

    def moved(window: int, sample: Sample) -> NDArray[np.float32] | None:
        trace = by_window.get(window)
        if trace is None:
            return None
        b = replace(trace, bearings=sample.bearings, t_s=sample.t_s + trace.mid_s).deskewed(plane)
        return (b @ K[:2, :2] + K[:2, 2]).astype(np.float32) if len(b) == len(sample.t_s) else None

    return moved
