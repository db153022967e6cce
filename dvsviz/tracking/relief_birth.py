"""New landmarks of the relief map: edges that none explains yet, with the inverse depth of their surroundings."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import vote
from dvsviz.geometry.camera import Camera
from dvsviz.tracking import constants as c
from dvsviz.tracking import relief_constants as rc
from dvsviz.tracking.edges import ridge_pixels
from dvsviz.tracking.relief_align import Moving, Sample
from dvsviz.tracking.relief_landmarks import Landmarks
from dvsviz.tracking.relief_sweep import image_flow, sweep

Array = NDArray[np.float64]


def inverse_depths(landmarks: Landmarks, sample: Sample, moving: Moving, camera: Camera) -> Array:
    """Return the inverse depth (height, width) of a view, of the landmarks in it and of a sweep of its events."""
    seen = landmarks.seen_from(moving.T_world_camera)
    step = rc.RELIEF_CELL_PX
    shape = (camera.height // step + 1, camera.width // step + 1)
    x, y = _pixels(seen[:, :2], camera).T / step
    good = (seen[:, 4] > 0) & (landmarks.counts[:, 0] >= 2)
    good &= (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
    cell = y[good].astype(np.int64) * shape[1] + x[good].astype(np.int64)
    rho = seen[good, 4]
    told = landmarks.information[good, 1, 1] * landmarks.states[good, 1] ** 2
    weight = told / (told + 1.0 / rc.RELIEF_DEPTH_SHARE**2)
    total = np.bincount(cell, weight * rho, shape[0] * shape[1]).reshape(shape)
    known = np.bincount(cell, weight, shape[0] * shape[1]).reshape(shape)
    middle = float(np.median(rho)) if len(rho) else 1.0
    tried = np.geomspace(middle / rc.RELIEF_SWEEP_RANGE, middle * rc.RELIEF_SWEEP_RANGE, rc.RELIEF_SWEEP_STEPS)
    swept, clear = sweep(
        sample.bearings, sample.t_s, sample.is_positive, camera, moving.omega, moving.velocity, tried
    )
    total, known = total + clear * swept, known + clear
    out = np.full(shape, float(total.sum() / known.sum()) if known.sum() > 0 else middle)
    # From coarse to fine: where a finer neighbourhood knows little, the coarser one is taken.
    for sigma in (8.0, 4.0, 2.0, 1.0):
        a, b = cv2.GaussianBlur(total, (0, 0), sigma), cv2.GaussianBlur(known, (0, 0), sigma)
        least = 1.0 / (2 * np.pi * sigma * sigma)
        out = (a + least * out) / (b + least)
    image = cv2.resize(out, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(image, dtype=np.float64)


def deskewed(sample: Sample, rho: Array, moving: Moving, camera: Camera) -> NDArray[np.float32]:
    """Return the pixels (N, 2) of events moved to the time of the pose, by inverse depths of an image."""
    b = np.asarray(sample.bearings, dtype=np.float64)
    xy = np.rint(_pixels(b, camera)).astype(np.int64)
    x, y = np.clip(xy[:, 0], 0, camera.width - 1), np.clip(xy[:, 1], 0, camera.height - 1)
    points = b - image_flow(b, rho[y, x], moving.omega, moving.velocity) * sample.t_s[:, None]
    return _pixels(points, camera).astype(np.float32)


def new_landmarks(
    landmarks: Landmarks, sample: Sample, px: NDArray[np.float32], rho: Array, moving: Moving, camera: Camera
) -> tuple[Landmarks, Array, Array]:
    """Return landmarks of the edges that none explains yet, their normals (M, 2) and places across them (M,), px.

    Args:
        landmarks: that are known and may be in view.
        sample: the window.
        px: its events (N, 2) at the time of the pose.
        rho: inverse depth (height, width).
        moving: pose and velocities at its middle.
        camera: of the window.
    """
    shape, focal = (camera.height, camera.width), camera.focal_px
    seen = landmarks.seen_from(moving.T_world_camera)
    ahead = landmarks.seen_from(moving.at(sample.duration_s))
    flow_px = focal * np.einsum("ij,ij->i", ahead[:, :2] - seen[:, :2], seen[:, 2:4])
    signs = np.where(np.abs(flow_px) > rc.RELIEF_SIGNED_PX, landmarks.sides * np.sign(flow_px), 0.0)
    uv = np.rint(_pixels(seen[:, :2], camera)).astype(np.int64)
    inside = (seen[:, 4] > 0) & (uv >= 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
    made = []
    for polarity in (1.0, -1.0):
        votes = vote(px[sample.is_positive == (polarity > 0)], None, shape)
        occupied = votes[votes > 0]
        if len(occupied) == 0:
            continue
        level = max(1.0, float(np.percentile(occupied, 90)))
        edge = (1 - np.exp(-c.MAP_SATURATION * votes / level)).astype(np.float32)
        found = ridge_pixels(cv2.GaussianBlur(edge, (0, 0), c.REFINE_RIDGE_BLUR_PX), c.REFINE_RIDGE_LEVEL)
        taken = np.zeros(shape, dtype=np.uint8)
        near = inside & (signs * polarity >= 0)
        taken[uv[near, 1], uv[near, 0]] = 1
        taken = cv2.dilate(taken, np.ones((rc.RELIEF_CLEAR_PX, rc.RELIEF_CLEAR_PX), np.uint8))
        found = found[taken[found[:, 1].astype(np.int64), found[:, 0].astype(np.int64)] == 0]
        found = found[_spaced(found, shape)]
        made.append(np.column_stack([found, np.full(len(found), polarity)]))
    if not made:
        return Landmarks.none(), np.zeros((0, 2)), np.zeros(0)
    new = np.concatenate(made)
    xy = (new[:, :2] + new[:, 2:3] * new[:, 3:5] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    normal, polarity = np.ascontiguousarray(new[:, 3:5]), new[:, 5]
    depth = rho[new[:, 1].astype(np.int64), new[:, 0].astype(np.int64)]
    across = np.einsum("ij,ij->i", image_flow(xy, depth, moving.omega, moving.velocity), normal)
    told = focal * np.abs(across) * sample.duration_s > rc.RELIEF_SIGNED_PX
    sides = np.where(told, np.sign(across) * polarity, 0.0)
    fresh = _on_rays(moving.T_world_camera, xy, normal, depth, sides, focal)
    return fresh, normal, focal * (normal * xy).sum(axis=1)


def _on_rays(T: Array, xy: Array, normal: Array, depth: Array, sides: Array, focal: float) -> Landmarks:
    """Return landmarks at bearings (M, 2) of a view (4, 4), with normals (M, 2) and inverse depths (M,)."""
    count, R = len(xy), T[:3, :3]
    nothing, one = np.zeros((count, 1)), np.ones((count, 1))
    rays = np.column_stack(
        [
            np.tile(T[:3, 3], (count, 1)),
            np.column_stack([xy, one]) @ R.T,
            np.column_stack([normal, nothing]) @ R.T,
            np.column_stack([-normal[:, 1:], normal[:, :1], nothing]) @ R.T,
        ]
    )
    states = np.column_stack([nothing, depth])
    known = np.zeros((count, 2, 2))
    known[:, 0, 0] = (focal / rc.RELIEF_OFFSET_PX) ** 2
    known[:, 1, 1] = 1.0 / (rc.RELIEF_DEPTH_SHARE * depth) ** 2
    return Landmarks(
        rays=rays,
        states=states,
        prior_states=states.copy(),
        prior_information=known,
        information=known.copy(),
        sides=sides,
        counts=np.tile(np.array([1, 0], dtype=np.int64), (count, 1)),
    )


def _pixels(bearings: Array, camera: Camera) -> Array:
    """Return undistorted pixels (N, 2) of bearings (N, 2)."""
    return bearings * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _spaced(found: Array, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return which ridge pixels to take: one of each block of pixels."""
    block = rc.RELIEF_SPACING_PX
    row, column = (found[:, 1] // block).astype(np.int64), (found[:, 0] // block).astype(np.int64)
    return np.sort(np.unique(row * (shape[1] // block + 1) + column, return_index=True)[1])
