"""Finding the way back from nothing: the window's image against the map seen from every keyframe.

At quarter resolution, for 24 turns about the optical axis, the de-skewed window is correlated (by FFT) with the map
as each keyframe saw it; the best candidates are aligned with the map (tracking notes, finding 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.kernels import sample
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import align
from dvsviz.tracking.diagnose import agreement, footprint
from dvsviz.tracking.planar_map import PlanarMap

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Relocalization:
    """The best pose found.

    Attributes:
        T_world_camera: pose (4, 4).
        score: its chance-normalised agreement with the map.
        runner_up: the best score among clearly different poses.
    """

    T_world_camera: Array
    score: float
    runner_up: float


def relocalize(
    planar_map: PlanarMap,
    camera: Camera,
    bearings: NDArray[np.float32],
    keyframes: Sequence[Array],
    *,
    free: NDArray[np.bool_],
) -> Relocalization | None:
    """Return the best pose for de-skewed events, or None where nothing was to be compared or found.

    Args:
        planar_map: the map.
        camera: of the window.
        bearings: de-skewed events (N, 2) float32, all at the time of the pose that is sought.
        keyframes: poses (4, 4) from which the map was seen.
        free: mask (6,) of rotation and position.
    """
    if not keyframes or len(bearings) < c.RELOCALIZE_MIN_EVENTS:
        return None
    candidates = _candidates(planar_map, camera, bearings, keyframes, turn=bool(free[2]), shift=bool(free[3]))
    t = np.linspace(0.0, 1e-6, len(bearings))
    wide = np.diag([0.15**-2] * 3 + [0.15**-2] * 3)
    distances = [planar_map.plane.seen_from(T).distance for T in keyframes]
    nearest, farthest = min(distances), max(distances)
    found: list[tuple[float, Array]] = []
    for T in candidates:
        aligned = align(
            planar_map,
            bearings,
            t,
            T,
            np.zeros(3),
            np.zeros(3),
            focal_px=0.5 * (camera.fx + camera.fy),
            free=free,
            prior=wide,
            iterations=c.RELOCALIZE_ITERATIONS,
        )
        distance = planar_map.plane.seen_from(aligned.T_world_camera).distance
        if not nearest / c.RELOCALIZE_NEARER < distance < farthest * c.RELOCALIZE_NEARER:
            continue
        measured = agreement(planar_map, aligned, camera)
        found.append((measured.score * min(1.0, aligned.inside), aligned.T_world_camera))
    if not found:
        return None
    found.sort(key=lambda pair: -pair[0])
    best = found[0][1]
    others = [score for score, T in found[1:] if _apart(best, T)]
    return Relocalization(T_world_camera=best, score=found[0][0], runner_up=others[0] if others else 0.0)


def _apart(a: Array, b: Array) -> bool:
    delta = se3.inverse(a) @ b
    return bool(np.linalg.norm(delta[:3, 3]) > 0.05 or se3.rotation_angle(delta[:3, :3]) > 0.05)


def _candidates(
    planar_map: PlanarMap,
    camera: Camera,
    bearings: NDArray[np.float32],
    keyframes: Sequence[Array],
    *,
    turn: bool,
    shift: bool,
) -> list[Array]:
    """Return the poses of the highest correlations over keyframes and turns."""
    k = c.RELOCALIZE_REDUCTION
    cols, rows = -(-camera.width // k), -(-camera.height // k)
    size = (cv2.getOptimalDFTSize(2 * rows), cv2.getOptimalDFTSize(2 * cols))
    px = bearings * np.array([camera.fx, camera.fy]) + np.array([camera.cx, camera.cy])
    image = np.zeros((rows, cols), dtype=np.float32)
    cell = (px / k).astype(np.int64)
    ok = (cell[:, 0] >= 0) & (cell[:, 1] >= 0) & (cell[:, 0] < cols) & (cell[:, 1] < rows)
    if not ok.any():
        return []
    np.add.at(image, (cell[ok, 1], cell[ok, 0]), 1.0)
    image = np.minimum(image / max(1e-6, float(np.percentile(image[image > 0], 70))), 1.0).astype(np.float32)
    centre = (camera.cx / k, camera.cy / k)
    angles = np.arange(c.RELOCALIZE_TURNS) * (2 * np.pi / c.RELOCALIZE_TURNS) if turn else np.zeros(1)
    queries = []
    for angle in angles:
        rotation = cv2.getRotationMatrix2D(centre, float(-np.degrees(angle)), 1.0)
        turned = cv2.warpAffine(image, rotation, (cols, rows))
        queries.append(np.conj(np.fft.rfft2(turned - turned.mean(), s=size)))
    scores: list[tuple[float, Array]] = []
    level = planar_map.level(0)
    for T in keyframes:
        view = sample(footprint(planar_map, T, camera, columns=cols), level, 0.0)
        view = view.reshape(-1, cols)[:rows]
        view = np.pad(view, ((0, rows - view.shape[0]), (0, 0)))
        spectrum = np.fft.rfft2(view - view.mean(), s=size)
        norm = float(np.linalg.norm(view - view.mean())) + 1e-9
        for angle, query in zip(angles, queries, strict=True):
            correlation = np.fft.irfft2(spectrum * query, s=size)
            if not shift:
                flat = _rotation_only_peak(correlation, rows, cols)
            else:
                flat = int(np.argmax(correlation))
            dy, dx = (int(v) for v in np.unravel_index(flat, correlation.shape))
            dy, dx = dy - size[0] * (dy > size[0] // 2), dx - size[1] * (dx > size[1] // 2)
            scores.append(
                (
                    float(correlation.flat[flat]) / norm,
                    _moved(T, angle, dx * k, dy * k, camera, planar_map.plane, shift),
                )
            )
    scores.sort(key=lambda pair: -pair[0])
    return [T for _, T in scores[: c.RELOCALIZE_CANDIDATES]]


def _rotation_only_peak(correlation: Array, rows: int, cols: int) -> int:
    limited = correlation.copy()
    limited[rows // 2 : -rows // 2] = -np.inf
    limited[:, cols // 2 : -cols // 2] = -np.inf
    return int(np.argmax(limited))


def _moved(T: Array, angle: float, dx_px: float, dy_px: float, camera: Camera, plane: Plane, shift: bool) -> Array:
    """Return the keyframe's pose turned about its optical axis and moved so that the image shifts by (dx, dy).

    A pixel of the window that was turned by `angle` and shifted by (dx, dy) falls on the keyframe's view.
    """
    turn = se3.exp_so3(np.array([0.0, 0.0, angle]))
    bearing = np.array([dx_px / camera.fx, dy_px / camera.fy, 0.0])
    if shift:
        depth = plane.seen_from(T).distance / max(0.2, abs(float(T[:3, 2] @ plane.normal)))
        return T @ se3.pose(turn, bearing * depth)
    tilt = se3.exp_so3(np.array([-bearing[1], bearing[0], 0.0]))
    return T @ se3.pose(tilt @ turn)
