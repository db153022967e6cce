"""Dense alignment: all depths of both frames, point to plane, together with the matches of the images.

A handful of matches hardly tells a turn from a sideways motion, and where colour and depth camera are not calibrated to
each other they tell it wrong. Surfaces tell it well and leave open what slides along them: the matches tell that.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.registration.frames import Frame
from dvsviz.registration.pnp import normal_equations, pnp_refined, reprojection_px
from dvsviz.registration.records import MatchedPoints, Registration, RegistrationConfig, depth_sigma

Array = NDArray[np.float64]

# Blocks of so many pixels become one point: 640 x 480 gives 19,200.
_STRIDE = 4
# Depths of a block, and of neighbouring blocks, that differ by more than this share lie on two surfaces.
_STEP_SHARE = 0.04
# Points farther from each other's plane than so many sigmas are not one place; the first rounds are wider.
_GATES = (6.0, 4.0, 3.0, 3.0, 3.0)
_FACING = 0.8
# Matches may stand so much farther off than PnP's: where the colour camera is not calibrated, by 2 to 5 px.
_WIDER = 3.0
_MIN_POINTS = 200
_HUBER_SIGMAS = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """What a depth image says of the surfaces in view, on a grid of blocks.

    Attributes:
        camera: calibration of the blocks: one pixel each.
        points: points (rows, columns, 3) in the camera's frame, m, NaN where none.
        normals: unit normals (rows, columns, 3) that face the camera, NaN where none.
    """

    camera: Camera
    points: Array
    normals: Array


def surface_of(frame: Frame, camera: Camera) -> Surface | None:
    """Return the surfaces of a frame; None without depth."""
    if frame.depth is None:
        return None
    rows, columns = camera.height // _STRIDE, camera.width // _STRIDE
    blocks = frame.depth[: rows * _STRIDE, : columns * _STRIDE].reshape(rows, _STRIDE, columns, _STRIDE)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    depth = np.where(known, blocks, 0).sum(axis=(1, 3), dtype=np.float64) / np.maximum(count, 1)
    far = np.where(known, blocks, -np.inf).max(axis=(1, 3))
    near = np.where(known, blocks, np.inf).min(axis=(1, 3))
    depth[(count < _STRIDE * _STRIDE // 2) | ~(far - near < _STEP_SHARE * depth)] = np.nan
    small = Camera(
        width=columns,
        height=rows,
        fx=camera.fx / _STRIDE,
        fy=camera.fy / _STRIDE,
        # The middle of a block of four is pixel 1.5 of it.
        cx=(camera.cx - (_STRIDE - 1) / 2) / _STRIDE,
        cy=(camera.cy - (_STRIDE - 1) / 2) / _STRIDE,
        distortion=camera.distortion,
    )
    bearings = small.bearing_table().astype(np.float64)
    points = np.concatenate([bearings, np.ones((rows, columns, 1))], axis=-1) * depth[..., None]
    return Surface(camera=small, points=points, normals=_normals(points))


def _normals(points: Array) -> Array:
    """Return the normals (rows, columns, 3) of a grid of points, from differences of smoothed neighbours."""
    known = np.isfinite(points[..., 2])
    weight = cv2.boxFilter(known.astype(np.float64), -1, (5, 5), normalize=False)
    total = cv2.boxFilter(np.where(known[..., None], points, 0.0), -1, (5, 5), normalize=False)
    smooth = total / np.maximum(weight, 1)[..., None]
    normals = np.full(points.shape, np.nan)
    across = smooth[1:-1, 2:] - smooth[1:-1, :-2]
    down = smooth[2:, 1:-1] - smooth[:-2, 1:-1]
    n = np.cross(down, across)
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)
    z = points[1:-1, 1:-1, 2]
    # Differences over a depth step are not on a surface, nor is a mean that left its point.
    is_flat = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2])) < _STEP_SHARE * z
    is_flat &= (np.abs(smooth[1:-1, 1:-1, 2] - z) < _STEP_SHARE * z) & (weight[1:-1, 1:-1] > 15)
    normals[1:-1, 1:-1] = np.where(is_flat[..., None], n, np.nan)
    return normals


def pnp_dense(matched: MatchedPoints, config: RegistrationConfig) -> Registration:
    """Return the motion of `pnp_refined`, refined again on its matches and on the surfaces of both frames.

    Where the surfaces do not say enough, or say something that half of the matches deny, it stays as it was.

    Args:
        matched: matches, with the surfaces of both frames.
        config: thresholds.
    """
    start = pnp_refined(matched, config)
    a, b = matched.surface_a, matched.surface_b
    if not start.is_found or a is None or b is None:
        return start
    T_b_a, inliers = se3.inverse(start.T_a_b), start.inliers
    for gate in _GATES:
        _, rows, gradient = normal_equations(T_b_a, matched[inliers], config.threshold_px / 2)
        dense = _dense_equations(T_b_a, a, b, gate, matched.image_sigma_px)
        if dense is None:
            return start
        step = np.linalg.solve(rows + dense[0], -(gradient + dense[1]))
        T_b_a = se3.pose(se3.exp_so3(step[:3]) @ T_b_a[:3, :3], T_b_a[:3, 3] + step[3:])
        if gate > _GATES[-1]:
            continue
        # The surfaces draw it away from where PnP's matches were: others agree now.
        inliers = reprojection_px(T_b_a, matched) < _WIDER * config.threshold_px
        if inliers.sum() < max(config.min_inliers, start.inlier_count // 2):
            return start
    return Registration(T_a_b=se3.inverse(T_b_a), inliers=inliers, scale="depth")


def _dense_equations(
    T_b_a: Array, a: Surface, b: Surface, gate: float, unit_px: float
) -> tuple[Array, Array] | None:
    """Return J^T W J (6, 6) and J^T W r (6,) over (turn of b, position) of a's points on b's planes."""
    usable = np.isfinite(a.normals[..., 0])
    R, t = T_b_a[:3, :3], T_b_a[:3, 3]
    turned = a.points[usable] @ R.T
    p = turned + t
    normals = a.normals[usable] @ R.T
    with np.errstate(invalid="ignore", divide="ignore"):
        pixels = np.rint(b.camera.project(p[:, :2] / p[:, 2:]))
    height, width = b.points.shape[:2]
    seen = (p[:, 2] > 0.05) & (pixels[:, 0] >= 0) & (pixels[:, 0] < width)
    seen &= (pixels[:, 1] >= 0) & (pixels[:, 1] < height)
    p, turned, normals = p[seen], turned[seen], normals[seen]
    columns, rows = pixels[seen].astype(np.int64).T
    target, n = b.points[rows, columns], b.normals[rows, columns]
    r = ((p - target) * n).sum(axis=1)
    # Depth noise moves a point along its ray, and off the plane by the cosine of the angle between the two.
    ray = -(n * target).sum(axis=1) / np.linalg.norm(target, axis=1)
    sigma = np.sqrt(2) * depth_sigma(target[:, 2], _STRIDE * b.camera.fx) * np.abs(ray)
    with np.errstate(invalid="ignore"):
        close = (np.abs(r) < gate * sigma) & ((normals * n).sum(axis=1) > _FACING)
    if close.sum() < _MIN_POINTS:
        return None
    # In the units of the image's residuals, px.
    scale = unit_px / sigma[close]
    J = np.concatenate([np.cross(turned[close], n[close]), n[close]], axis=1) * scale[:, None]
    r = r[close] * scale
    weight = np.minimum(1.0, _HUBER_SIGMAS * unit_px / np.maximum(np.abs(r), 1e-12))
    return (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ r
