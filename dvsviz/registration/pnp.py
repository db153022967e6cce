"""Relative pose from the 3-D points of one frame and their images in the other."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.registration.records import (
    MatchedPoints,
    Registration,
    RegistrationConfig,
    depth_sigma,
    failed,
    homogeneous,
)

Array = NDArray[np.float64]

_MIN_POINTS = 6
_REFINE_STEPS = 12


def pnp(
    matched: MatchedPoints, config: RegistrationConfig, *, solver: int = cv2.SOLVEPNP_ITERATIVE
) -> Registration:
    """Return the motion by PnP with RANSAC.

    Args:
        matched: points whose depth is known in a, at least six.
        config: thresholds.
        solver: OpenCV's `SOLVEPNP_ITERATIVE`, `SOLVEPNP_EPNP` or `SOLVEPNP_SQPNP`.
    """
    usable = matched.has_depth_a
    if usable.sum() < _MIN_POINTS:
        return failed(len(matched), f"PnP needs {_MIN_POINTS} matches with depth, got {usable.sum()}")
    points, images, K = _inputs(matched[usable])
    is_found, rotation, position, kept = cv2.solvePnPRansac(
        points,
        images,
        K,
        None,
        iterationsCount=config.max_rounds,
        reprojectionError=config.threshold_px,
        confidence=config.confidence,
        flags=solver,
    )
    return _result(matched, usable, is_found, rotation, position, kept, config)


def pnp_magsac(matched: MatchedPoints, config: RegistrationConfig) -> Registration:
    """Return the motion by PnP with OpenCV's USAC: MAGSAC scores, local optimisation."""
    usable = matched.has_depth_a
    if usable.sum() < _MIN_POINTS:
        return failed(len(matched), f"PnP needs {_MIN_POINTS} matches with depth, got {usable.sum()}")
    points, images, K = _inputs(matched[usable])
    settings = cv2.UsacParams()
    settings.confidence, settings.threshold = config.confidence, config.threshold_px
    settings.maxIterations, settings.randomGeneratorState = config.max_rounds, config.seed
    settings.score, settings.loMethod = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA
    settings.sampler = cv2.SAMPLING_UNIFORM
    is_found, _, rotation, position, kept = cv2.solvePnPRansac(points, images, K, None, params=settings)
    return _result(matched, usable, is_found, rotation, position, kept, config)


def pnp_refined(matched: MatchedPoints, config: RegistrationConfig) -> Registration:
    """Return the motion that minimises the reprojection error in *both* frames, from the inliers of PnP."""
    start = pnp(matched, config, solver=cv2.SOLVEPNP_EPNP)
    if not start.is_found:
        return start
    T_b_a, inliers = se3.inverse(start.T_a_b), start.inliers
    for _ in range(2):
        T_b_a = refine(T_b_a, matched[inliers], config.threshold_px)
        inliers = reprojection_px(T_b_a, matched) < config.threshold_px
        if inliers.sum() < config.min_inliers:
            return failed(len(matched), f"only {inliers.sum()} matches agree after refinement")
    return Registration(T_a_b=se3.inverse(T_b_a), inliers=inliers, scale="depth")


def reprojection_px(T_b_a: Array, matched: MatchedPoints) -> Array:
    """Return the distances (M,) in px between a's points seen in b and their matches; infinite where not known."""
    p = matched.points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    is_seen = np.isfinite(p[:, 2]) & (p[:, 2] > 1e-6)
    out = np.full(len(matched), np.inf)
    seen = p[is_seen]
    error = seen[:, :2] / seen[:, 2:] - matched.bearings_b[is_seen]
    out[is_seen] = np.linalg.norm(error, axis=1) * matched.focal_px
    return out


def refine(T_b_a: Array, matched: MatchedPoints, threshold_px: float) -> Array:
    """Return `T_b_a` (4, 4) after Levenberg-Marquardt on Huber-weighted reprojection errors in both frames.

    Args:
        T_b_a: where to start.
        matched: inliers.
        threshold_px: twice the error at which weights begin to fall.
    """
    cost, rows, gradient = normal_equations(T_b_a, matched, threshold_px / 2)
    damping = 1e-4
    for _ in range(_REFINE_STEPS):
        step = np.linalg.solve(rows + damping * np.diag(np.diag(rows) + 1e-12), -gradient)
        moved = se3.pose(se3.exp_so3(step[:3]) @ T_b_a[:3, :3], T_b_a[:3, 3] + step[3:])
        new = normal_equations(moved, matched, threshold_px / 2)
        if new[0] < cost:
            T_b_a, damping = moved, damping / 10
            is_settled = cost - new[0] < 1e-10 * cost
            cost, rows, gradient = new
            if is_settled:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return T_b_a


def normal_equations(T_b_a: Array, matched: MatchedPoints, huber_px: float) -> tuple[float, Array, Array]:
    """Return cost, J^T W J (6, 6) and J^T W r (6,) over (turn of b, position) of both frames' points."""
    total, rows, gradient = 0.0, np.zeros((6, 6)), np.zeros(6)
    R, t = T_b_a[:3, :3], T_b_a[:3, 3]
    f = matched.focal_px
    for forward in (True, False):
        known = np.isfinite(matched.depth_a if forward else matched.depth_b)
        points = (matched.points_a if forward else matched.points_b)[known]
        target = (matched.bearings_b if forward else matched.bearings_a)[known]
        if forward:
            turned = points @ R.T
            p = turned + t
            # p = exp(turn) R x + t + step
            d_turn, d_step = -se3.hat(turned), np.broadcast_to(np.eye(3), (len(p), 3, 3))
        else:
            back = points - t
            p = back @ R
            # p = R^T exp(-turn) (x - t - step)
            d_turn, d_step = R.T @ se3.hat(back), np.broadcast_to(-R.T, (len(p), 3, 3))
        z = np.maximum(p[:, 2], 1e-6)
        x = p[:, :2] / z[:, None]
        r = (x - target) * f
        d_image = np.zeros((len(p), 2, 3))
        d_image[:, 0, 0] = d_image[:, 1, 1] = f / z
        d_image[:, :, 2] = -x * (f / z)[:, None]
        d_point = np.concatenate([d_turn, d_step], axis=2)
        J = d_image @ d_point
        total, rows, gradient = _add(total, rows, gradient, r, J, huber_px)
        # Where the other frame measured the depth too, it is a third coordinate, in units of its own noise.
        seen = (matched.depth_b if forward else matched.depth_a)[known]
        both = np.isfinite(seen)
        sigma = depth_sigma(seen[both], f) / matched.image_sigma_px
        r_depth = ((p[both, 2] - seen[both]) / sigma)[:, None]
        J_depth = d_point[both, 2:3] / sigma[:, None, None]
        total, rows, gradient = _add(total, rows, gradient, r_depth, J_depth, huber_px)
    return total, rows, gradient


def _add(
    total: float, rows: Array, gradient: Array, r: Array, J: Array, huber: float
) -> tuple[float, Array, Array]:
    """Return the three sums with Huber-weighted residuals (N, k) and their Jacobian (N, k, 6) added."""
    size = np.linalg.norm(r, axis=1)
    weight = np.minimum(1.0, huber / np.maximum(size, 1e-12))
    cost = np.where(size < huber, 0.5 * size**2, huber * (size - 0.5 * huber)).sum()
    weighted = J * weight[:, None, None]
    return (
        total + float(cost),
        rows + np.einsum("nki,nkj->ij", weighted, J),
        gradient + np.einsum("nki,nk->i", weighted, r),
    )


def _inputs(matched: MatchedPoints) -> tuple[Array, Array, Array]:
    f = matched.focal_px
    images = (homogeneous(matched.bearings_b) * f)[:, :2]
    return np.ascontiguousarray(matched.points_a), np.ascontiguousarray(images), np.diag([f, f, 1.0])


def _result(
    matched: MatchedPoints,
    usable: NDArray[np.bool_],
    is_found: bool,
    rotation: NDArray,
    position: NDArray,
    kept: NDArray | None,
    config: RegistrationConfig,
) -> Registration:
    if not is_found or kept is None:
        return failed(len(matched), "PnP found no motion that the matches agree on")
    inliers = np.zeros(len(matched), dtype=bool)
    inliers[np.flatnonzero(usable)[np.asarray(kept).ravel()]] = True
    if inliers.sum() < config.min_inliers:
        return failed(len(matched), f"only {inliers.sum()} matches agree with one motion")
    T_b_a = se3.pose(se3.exp_so3(rotation.ravel()), position.ravel())
    return Registration(T_a_b=se3.inverse(T_b_a), inliers=inliers, scale="depth")
