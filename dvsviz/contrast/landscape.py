"""Slices of an objective around a motion or a pose, over any two of its six parameters.

The landscape shows what an optimiser climbs: a ridge where two parameters trade off, a second summit where it may end.
Contrast is a function of a window's velocities, agreement with a map one of its pose. Both have six parameters:
rotation about x, y, z, then motion along x, y, z, in the camera frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast import kernels
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, points_to_map

Array = NDArray[np.float64]
Measure = Literal["variance", "gradient"]

# Wider images are made smaller: a cell of the landscape costs what its pixels and events cost.
_WIDEST_PX = 320
# The edge image that a window is aligned with at last: blurred by this, thin lines brought back to their height.
_EDGE_BLUR_PX = 0.8
_EDGE_GAIN = 2.2
# With fewer of its events on the map a window has no agreement to speak of.
_LEAST_INSIDE = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """The cells of a slice.

    Attributes:
        axes: the two parameters (0 to 5) that change, along columns and along rows.
        columns: offsets of the first one from the centre (C,).
        rows: offsets of the second one (R,).
    """

    axes: tuple[int, int]
    columns: Array
    rows: Array

    def __post_init__(self) -> None:
        a, b = self.axes
        if a == b or not (0 <= a < 6 and 0 <= b < 6):
            raise ValueError(f"axes: expected two different ones of 0 to 5, got {self.axes}")

    @classmethod
    def around(cls, axes: tuple[int, int], spans: tuple[float, float], size: int) -> Grid:
        """Return `size` by `size` cells that reach `spans` to both sides of the centre."""
        return cls(
            axes=axes,
            columns=np.linspace(-spans[0], spans[0], size),
            rows=np.linspace(-spans[1], spans[1], size),
        )

    def row(self, number: int) -> Array:
        """Return the offsets (C, 6) of one row's cells."""
        offsets = np.zeros((len(self.columns), 6))
        offsets[:, self.axes[0]] = self.columns
        offsets[:, self.axes[1]] = self.rows[number]
        return offsets


def contrast_landscape(
    bearings: NDArray[np.float32],
    t_s: Array,
    weights: NDArray[np.float32],
    camera: Camera,
    motion: Array,
    plane: Plane,
    grid: Grid,
    *,
    measure: Measure = "variance",
    cancelled: Callable[[], bool] = lambda: False,
) -> NDArray[np.float64] | None:
    """Return the contrast (rows, columns) of a window around a motion (eq. 2.3); None where it was cancelled.

    Args:
        bearings: (N, 2) float32.
        t_s: seconds since the window's first event (N,), increasing.
        weights: s_k (N,) float32, ±1, or (1,).
        camera: gives the image grid.
        motion: omega and velocity (6,) at the centre, rad/s and plane distances per second.
        plane: in the camera frame at the first event.
        grid: the cells.
        measure: variance, or the mean squared gradient.
        cancelled: asked before each row.
    """
    small = min(1.0, _WIDEST_PX / camera.width)
    K = np.diag([small, small, 1.0]) @ camera.matrix
    shape = (max(2, round(camera.height * small)), max(2, round(camera.width * small)))
    image, smooth = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    values = np.empty((len(grid.rows), len(grid.columns)))
    duration_s = float(t_s[-1])
    for r in range(len(grid.rows)):
        if cancelled():
            return None
        nodes, scale = window_nodes(motion + grid.row(r), plane, duration_s, K)
        kernels.contrasts(bearings, t_s, weights, nodes, scale, image, smooth, measure == "gradient", values[r])
    return values


def edge_image(texture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the edges (rows, columns) in [0, 1] that windows are aligned with, of a stored map's texture."""
    edge = texture.astype(np.float32) / 255
    blurred = cv2.GaussianBlur(edge, (0, 0), _EDGE_BLUR_PX, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(np.minimum(blurred * np.float32(_EDGE_GAIN), 1.0), dtype=np.float32)


def map_landscape(
    bearings: NDArray[np.float32],
    t_s: Array,
    T_world_camera: Array,
    motion: Array,
    plane_world: Plane,
    edges: NDArray[np.float32],
    target: Array,
    chance: float,
    grid: Grid,
    *,
    cancelled: Callable[[], bool] = lambda: False,
) -> NDArray[np.float64] | None:
    """Return the agreement with a map (rows, columns) around a pose; None where it was cancelled.

    The agreement is (mean at the events - chance) / (1 - chance): 1 perfect, 0 chance; NaN off the map. Rotations are
    `R_world_camera exp(phi^)`, positions `t + R_world_camera rho`; the velocities are held.

    Args:
        bearings: (N, 2) float32.
        t_s: seconds since the pose's time (N,), increasing.
        T_world_camera: pose (4, 4) at the centre.
        motion: omega and velocity (6,), held.
        plane_world: the map's plane.
        edges: `edge_image` of the map.
        target: from plane coordinates (u, v, 1) to pixels of `edges` (3, 3).
        chance: mean of `edges` where the window looks.
        grid: the cells, rad and plane distances.
        cancelled: asked before each row.
    """
    values = np.empty((len(grid.rows), len(grid.columns)))
    inside = np.empty(len(grid.columns))
    start, duration_s = float(t_s[0]), float(t_s[-1] - t_s[0])
    for r in range(len(grid.rows)):
        if cancelled():
            return None
        offsets = grid.row(r)
        Ts = T_world_camera @ se3.pose(se3.exp_so3(offsets[:, :3]), offsets[:, 3:])
        nodes, scale = map_nodes(Ts, motion, plane_world, start, duration_s, target)
        kernels.means_on(bearings, t_s - start, nodes, scale, edges, values[r], inside)
        values[r] = np.where(inside >= _LEAST_INSIDE, (values[r] - chance) / max(1e-3, 1.0 - chance), np.nan)
    return values


def window_nodes(motions: Array, plane: Plane, duration_s: float, target: Array) -> tuple[Array, float]:
    """Return the nodes (C, M, 3, 3) of `contrast.warp.window_warp` for several motions (C, 6), and nodes per second.

    All have as many nodes as the quickest turn needs.
    """
    fastest = float(np.linalg.norm(motions[:, :3], axis=1).max())
    t, scale = kernels.node_times(duration_s, kernels.node_count(fastest * duration_s))
    v = motions[:, 3:] / plane.distance
    denominator = np.maximum(1.0 + np.multiply.outer(v @ plane.normal, t), 1e-3)
    R = se3.exp_so3(motions[:, None, :3] * t[:, None])
    nR = plane.normal @ R
    return target @ (R - (t / denominator)[..., None, None] * v[:, None, :, None] * nR[:, :, None, :]), scale


def map_nodes(
    Ts_world_camera: Array, motion: Array, plane_world: Plane, start_s: float, duration_s: float, target: Array
) -> tuple[Array, float]:
    """Return the nodes (C, M, 3, 3) of `contrast.warp.map_warp` for several poses (C, 4, 4), and nodes per second."""
    t, scale = kernels.node_times(duration_s, kernels.node_count(float(np.linalg.norm(motion[:3])) * duration_s))
    t = t + start_s
    R0, p0 = Ts_world_camera[:, :3, :3], Ts_world_camera[:, :3, 3]
    n, d = plane_world.normal, plane_world.distance
    R = R0[:, None] @ se3.exp_so3(np.multiply.outer(t, motion[:3]))
    position = p0[:, None] + t[:, None] * (R0 @ motion[3:])[:, None]
    n_c, d_c = n @ R, d + position @ n
    PM = target @ points_to_map(plane_world)
    return PM @ (d_c[..., None, None] * R - position[..., :, None] * n_c[..., None, :]), scale
