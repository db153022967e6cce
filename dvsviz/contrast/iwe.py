"""The image of warped events (IWE), eq. 2.1."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.contrast import kernels
from dvsviz.contrast.warp import Warp, window_warp
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane

_ONE = np.ones(1, dtype=np.float32)


def sample_window(window: EventWindow, most: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return at most `most` events of a window, in time order: bearings (N, 2) and seconds since its start (N,).

    The choice depends on the seed and the window's number alone, so that it can be made again.
    """
    if len(window) <= most:
        return window.bearings, window.t_s
    pick = sample_indices(window, most, seed)
    t_s = np.asarray((window.events.t_us.take(pick) - window.start_us) * 1e-6, dtype=np.float64)
    if not window.bearings.flags.c_contiguous:
        return window.bearings[pick], t_s
    # x and y of a bearing are taken as one number of 8 bytes: a third of the time.
    return window.bearings.reshape(-1).view(np.int64).take(pick).view(np.float32).reshape(-1, 2), t_s


def sample_indices(window: EventWindow, most: int, seed: int) -> NDArray[np.int64]:
    """Return which events (N,) of a window `sample_window` takes, increasing."""
    if len(window) <= most:
        return np.arange(len(window))
    rng = np.random.default_rng((seed, window.index))
    # One event of each of `most` equal runs: in order without a sort, and spread over the whole window.
    edges = np.linspace(0, len(window), most + 1)
    return (edges[:-1] + rng.random(most) * np.diff(edges)).astype(np.int64)


def warp_points(bearings: NDArray[np.float32], t_s: NDArray[np.float64], warp: Warp) -> NDArray[np.float32]:
    """Return target pixels (N, 2) float32 of bearings (N, 2) at times (N,); NaN behind the target."""
    out = np.empty((len(bearings), 2), dtype=np.float32)
    kernels.warp_events(bearings, t_s, warp.nodes, warp.scale, out)
    return out


def vote(
    points: NDArray[np.float32], weights: NDArray[np.float32] | None, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Return the image (rows, columns) of points (N, 2) voted bilinearly with weights (N,), or 1 each."""
    image = np.zeros(shape, dtype=np.float32)
    kernels.vote(points, _ONE if weights is None else np.asarray(weights, dtype=np.float32), image)
    return image


def image_of_warped_events(
    bearings: NDArray[np.float32],
    t_s: NDArray[np.float64],
    weights: NDArray[np.float32] | None,
    camera: Camera,
    *,
    omega: ArrayLike = (0.0, 0.0, 0.0),
    velocity: ArrayLike = (0.0, 0.0, 0.0),
    normal: ArrayLike = (0.0, 0.0, -1.0),
    distance: float = 1.0,
) -> NDArray[np.float32]:
    """Return the IWE (height, width) float32 on the camera's undistorted pixel grid (eq. 2.1).

    Args:
        bearings: (N, 2) float32.
        t_s: seconds since the window's first event (N,), to which all events are warped.
        weights: s_k (N,), polarity ±1 or None for 1 each.
        camera: its K and size make the grid; its distortion is not used.
        omega: angular velocity (3,), rad/s.
        velocity: linear velocity (3,), units of `distance` per second.
        normal: plane normal (3,) in the camera frame.
        distance: plane distance from the camera.
    """
    if len(bearings) == 0:
        return np.zeros((camera.height, camera.width), dtype=np.float32)
    warp = window_warp(
        np.asarray(omega, dtype=np.float64),
        np.asarray(velocity, dtype=np.float64),
        Plane(normal=np.asarray(normal, dtype=np.float64), distance=distance),
        float(t_s[-1]),
        camera.matrix,
        derivatives=False,
    )
    return vote(warp_points(bearings, t_s, warp), weights, (camera.height, camera.width))
