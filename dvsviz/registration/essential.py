"""Relative pose from bearings alone: the essential matrix and the homography of a plane, with their scale."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.registration.epipolar import refine_essential
from dvsviz.registration.records import MatchedPoints, Registration, RegistrationConfig, Scale, failed, homogeneous

Array = NDArray[np.float64]

# Between frames that hardly moved no direction of travel is known: then the answer is a rotation.
_MIN_SCALE_POINTS = 5


def essential(
    matched: MatchedPoints,
    config: RegistrationConfig,
    *,
    sampler: int = cv2.RANSAC,
    step_length: float | None = None,
    refined: bool = False,
) -> Registration:
    """Return the motion of the essential matrix (five points + RANSAC), its length from depth where there is any.

    Args:
        matched: at least five matches.
        config: thresholds.
        sampler: OpenCV's `RANSAC`, `USAC_MAGSAC` or `USAC_ACCURATE`.
        step_length: metres travelled, known from a motion model; used where no depth is known.
        refined: fit it to all inliers, not to the best five points alone.
    """
    if len(matched) < 5:
        return failed(len(matched), f"the essential matrix needs 5 matches, got {len(matched)}")
    # Pixels of an ideal camera with the same mean focal length: OpenCV's thresholds are then pixels.
    f = matched.focal_px
    found, mask = cv2.findEssentialMat(
        matched.bearings_a * f,
        matched.bearings_b * f,
        np.diag([f, f, 1.0]),
        sampler,
        config.confidence,
        config.threshold_px,
        config.max_rounds,
    )
    if found is None or found.shape[0] < 3:
        return failed(len(matched), "no essential matrix fits the matches")
    inliers = np.asarray(mask).ravel() > 0
    if inliers.sum() < config.min_inliers:
        return failed(len(matched), f"only {inliers.sum()} matches agree with one essential matrix")
    T_b_a, in_front = _decompose(found[:3], matched[inliers])
    inliers[np.flatnonzero(inliers)[~in_front]] = False
    if refined and inliers.sum() >= config.min_inliers:
        T_b_a = refine_essential(T_b_a, matched[inliers], config.threshold_px / 2)
    return _scaled(T_b_a, inliers, matched, step_length)


def _decompose(E: NDArray, matched: MatchedPoints) -> tuple[Array, NDArray[np.bool_]]:
    """Return `T_b_a` with a unit translation, and the points (M,) in front of both cameras, of the best of four."""
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    best: tuple[Array, NDArray[np.bool_]] = np.eye(4), np.zeros(len(matched), dtype=bool)
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            # Depths of the closest points of the two rays, up to a positive factor. Far points count too: between
            # frames of a video most are hundreds of steps away.
            za, zb = _depth_signs(R, t, matched)
            in_front = (za > 0) & (zb > 0)
            if in_front.sum() > best[1].sum():
                best = se3.pose(R, t), in_front
    return best


def _depth_signs(R_b_a: Array, t_b_a: Array, matched: MatchedPoints) -> tuple[Array, Array]:
    """Return the depths (M,) in a and in b of matches under a motion, each up to one positive factor a point."""
    ray_a = homogeneous(matched.bearings_a) @ R_b_a.T
    ray_b = homogeneous(matched.bearings_b)
    # z_b ray_b = z_a ray_a + t: least squares in (z_a, z_b), Cramer's rule without the (positive) determinant.
    aa, bb, ab = (ray_a * ray_a).sum(1), (ray_b * ray_b).sum(1), (ray_a * ray_b).sum(1)
    ta, tb = ray_a @ t_b_a, ray_b @ t_b_a
    return ab * tb - bb * ta, aa * tb - ab * ta


def _scaled(
    T_b_a: Array, inliers: NDArray[np.bool_], matched: MatchedPoints, step_length: float | None
) -> Registration:
    """Return the registration of a motion with unit translation, its length measured where possible."""
    length: float | None = None
    scale: Scale = "unit"
    if (matched.has_depth_a & inliers).sum() >= _MIN_SCALE_POINTS:
        length, scale = translation_length(T_b_a, matched[inliers & matched.has_depth_a]), "depth"
    elif step_length is not None:
        length, scale = step_length, "motion"
    T = T_b_a.copy()
    T[:3, 3] *= 1.0 if length is None else length
    return Registration(T_a_b=se3.inverse(T), inliers=inliers, scale=scale)


def translation_length(T_b_a: Array, matched: MatchedPoints) -> float:
    """Return the metres of a unit translation: the weighted median of what each point of known depth says.

    With `q = R p_a` the point seen in b is `q + s t`, so that `(q_x + s t_x) = x_b (q_z + s t_z)` and likewise for y:
    each point gives the least-squares s of two equations, weighted by how much parallax it has. The median holds
    against wrong matches along the epipolar line, which no epipolar test can see.
    """
    q = matched.points_a @ T_b_a[:3, :3].T
    t = T_b_a[:3, 3]
    left = t[:2] - matched.bearings_b * t[2]
    right = matched.bearings_b * q[:, 2:] - q[:, :2]
    parallax = (left * left).sum(axis=1)
    s = (left * right).sum(axis=1) / np.maximum(parallax, 1e-12)
    order = np.argsort(s)
    weight = np.cumsum((np.sqrt(parallax) / matched.depth_a)[order])
    return max(0.0, float(s[order][np.searchsorted(weight, weight[-1] / 2)]))


def homography(
    matched: MatchedPoints,
    config: RegistrationConfig,
    *,
    sampler: int = cv2.RANSAC,
    step_length: float | None = None,
) -> Registration:
    """Return the motion in front of a plane: homography, decomposed, the solution that the depths agree with.

    Args:
        matched: at least four matches.
        config: thresholds.
        sampler: OpenCV's `RANSAC` or `USAC_MAGSAC`.
        step_length: metres travelled, known from a motion model; used where no depth is known.
    """
    if len(matched) < 4:
        return failed(len(matched), f"a homography needs 4 matches, got {len(matched)}")
    # In pixels: the samplers of OpenCV's USAC hold constants of that size and find nothing among bearings.
    f = matched.focal_px
    H_b_a, mask = cv2.findHomography(
        matched.bearings_a * f,
        matched.bearings_b * f,
        sampler,
        config.threshold_px,
        maxIters=config.max_rounds,
        confidence=config.confidence,
    )
    if H_b_a is None:
        return failed(len(matched), "no homography fits the matches")
    inliers = np.asarray(mask).ravel() > 0
    if inliers.sum() < config.min_inliers:
        return failed(len(matched), f"only {inliers.sum()} matches lie on one plane")
    _, Rs, ts, normals = cv2.decomposeHomographyMat(H_b_a, np.diag([f, f, 1.0]))
    if len(Rs) == 0:
        return failed(len(matched), "the homography is not one of a rigid motion")
    on_plane = matched[inliers]
    rays = homogeneous(on_plane.bearings_a)
    known = on_plane.has_depth_a
    best_cost, best = np.inf, None
    for R, t, normal in zip(Rs, ts, normals, strict=True):
        # OpenCV: X_b = R X_a + t n·X_a / d. Visible points are in front: n·ray has one sign.
        facing = rays @ normal[:, 0]
        if np.mean(facing > 0) < 0.5:
            continue
        cost, distance = -float(np.median(facing)), None
        if known.sum() >= _MIN_SCALE_POINTS:
            heights = on_plane.points_a[known] @ normal[:, 0]
            distance = float(np.median(heights))
            cost = float(np.median(np.abs(heights - distance))) / max(distance, 1e-9)
        if cost < best_cost:
            best_cost, best = cost, (R, t[:, 0], distance)
    if best is None:
        return failed(len(matched), "no decomposition of the homography has the points in front of the camera")
    R, t, distance = best
    if distance is not None:
        T_b_a = se3.pose(R, t * distance)
        return Registration(T_a_b=se3.inverse(T_b_a), inliers=inliers, scale="depth")
    norm = np.linalg.norm(t)
    unit = se3.pose(R, t / norm if norm > 1e-12 else t)
    return replace(_scaled(unit, inliers, matched, step_length), inliers=inliers)
