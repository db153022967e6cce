"""Edge bundle adjustment: all keyframe poses and the plane's normal from the edges they share.

Landmarks are ridge pixels of the map with one parameter each, the offset along the edge's normal. The residual of an
event is its distance to the landmark's line; the offsets are eliminated by the Schur complement, all poses and the
normal are solved together. Gauge: the first keyframe's pose and the plane's distance are held (section 2.2.3 has
12k - 4 parameters; the velocities are taken from neighbouring poses instead).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.plane import Plane, rotation_to_map, tangent_basis, turn_normal, turn_normal_derivative
from dvsviz.tracking import constants as c
from dvsviz.tracking.planar_map import occupied_percentile

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A keyframe as the refinement sees it: de-skewed bearings at one pose.

    Attributes:
        bearings: (N, 2), all events moved to the time of the pose.
        T_world_camera: pose (4, 4).
    """

    bearings: Array
    T_world_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """Refined poses and plane.

    Attributes:
        Ts_world_camera: poses (K, 4, 4) of the views.
        plane: the refined plane in the world.
        before_px: disagreement of the views on held-out events at the start, px RMS.
        after_px: the same after refinement.
        residual_px: RMS distance of events to their edges in the last round, map px.
        landmarks: ridge pixels used in the last round.
        rounds: rounds done.
    """

    Ts_world_camera: Array
    plane: Plane
    before_px: float
    after_px: float
    residual_px: float
    landmarks: int
    rounds: int

    @property
    def accepted(self) -> bool:
        """True where the held-out disagreement fell."""
        return self.after_px < self.before_px


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Ridges:
    xy: Array  # (L, 2) cells
    normal: Array  # (L, 2)
    label: NDArray[np.int32]  # (rows, columns): nearest landmark, -1 where none is near


def refine(
    views: list[View],
    plane: Plane,
    px_per_unit: float,
    *,
    free: NDArray[np.bool_],
    solve_normal: bool = True,
    held: int = 1,
    rounds: int = c.REFINE_ROUNDS,
) -> Refinement:
    """Return the poses of the views and the plane that bring the views' edges together.

    Args:
        views: keyframes; half of each one's events are held out to judge the result.
        plane: start, in the world.
        px_per_unit: resolution of the map, cells per unit.
        free: mask (6,) of rotation and position to refine.
        solve_normal: also refine the normal.
        held: how many of the first views keep their pose (at least 1, the gauge).
        rounds: association and solving, repeated.
    """
    Ts = np.stack([v.T_world_camera for v in views])
    train = [np.ascontiguousarray(v.bearings[0::2]) for v in views]
    test = [np.ascontiguousarray(v.bearings[1::2]) for v in views]
    start = (Ts, plane)
    before = disagreement(test, Ts, plane, px_per_unit)
    # The gate closes over the first rounds; the rest converge with it closed.
    gates = np.geomspace(c.REFINE_GATE_START_PX, c.REFINE_GATE_END_PX, 4)
    residual, landmarks, done = float("nan"), 0, 0
    for i in range(rounds):
        gate = float(gates[min(i, 3)])
        step = _round(train, Ts, plane, start, px_per_unit, gate, free, solve_normal, held)
        if step is None:
            break
        Ts, plane, residual, landmarks, size = step
        done += 1
        if i >= 4 and size < c.REFINE_STEP:
            break
    return Refinement(
        Ts_world_camera=Ts,
        plane=plane,
        before_px=before,
        after_px=disagreement(test, Ts, plane, px_per_unit),
        residual_px=residual,
        landmarks=landmarks,
        rounds=done,
    )


def _to_cells(bearings: Array, T: Array, plane: Plane, R_map_world: Array, scale: float) -> Array:
    """Return plane coordinates (N, 2) in cells from the map frame's origin."""
    H = _homography(T, plane, R_map_world)
    q = bearings @ H[:, :2].T + H[:, 2]
    return scale * q[:, :2] / q[:, 2:]


def _homography(T: Array, plane: Plane, R_map_world: Array) -> Array:
    R, t = T[:3, :3], T[:3, 3]
    H = R_map_world @ ((plane.distance + t @ plane.normal) * R - np.outer(t, plane.normal @ R))
    return H / np.array([[1.0], [1.0], [plane.distance]])


def disagreement(bearings: list[Array], Ts: Array, plane: Plane, scale: float) -> float:
    """Return how far (px, RMS) the views disagree on where their shared edges lie.

    Each view's mean distance to a landmark is compared with the landmark's mean over all views; landmarks and views are
    those of a fixed gate, so that what is judged does not depend on how it was found.
    """
    R_map_world = rotation_to_map(plane.normal)
    cells = [_to_cells(b, T, plane, R_map_world, scale) for b, T in zip(bearings, Ts, strict=True)]
    low, shape = _bounds(cells)
    gate = c.REFINE_JUDGE_GATE_PX
    ridges = _ridges(cells, low, shape, gate)
    if ridges is None:
        return float("inf")
    count = np.zeros((len(cells), len(ridges.xy)))
    mean = np.zeros_like(count)
    for k, points in enumerate(cells):
        sums = np.zeros((len(ridges.xy), 4))
        _associate(points - low, bearings[k], ridges.label, ridges.xy, ridges.normal, gate, sums)
        seen = sums[:, 0] >= c.REFINE_MIN_EVENTS
        count[k] = np.where(seen, np.minimum(sums[:, 0], c.REFINE_MAX_EVENTS), 0.0)
        mean[k] = np.where(seen, sums[:, 1] / np.maximum(sums[:, 0], 1.0), 0.0)
    shared = (count > 0).sum(axis=0) >= 2
    weight = count[:, shared]
    if not shared.any():
        return float("inf")
    value = mean[:, shared]
    centre = (weight * value).sum(axis=0) / weight.sum(axis=0)
    return float(np.sqrt((weight * (value - centre) ** 2).sum() / weight.sum()))


def _bounds(cells: list[Array]) -> tuple[Array, tuple[int, int]]:
    """Return the low corner (2,) and (rows, columns) of a grid that holds nearly all points."""
    points = np.concatenate([p[:: max(1, len(p) // 200)] for p in cells])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = np.percentile(points, 0.2, axis=0) - 40, np.percentile(points, 99.8, axis=0) + 40
    size = np.minimum(high - low, 6000)
    return np.floor(low), (int(size[1]) + 1, int(size[0]) + 1)


def _ridges(cells: list[Array], low: Array, shape: tuple[int, int], gate: float) -> _Ridges | None:
    """Return the ridge pixels of the joint edge image, sub-pixel, with their normals."""
    votes = np.zeros(shape, dtype=np.float32)
    for points in cells:
        _vote(points - low, votes)
    ones = np.ones((1, 1), dtype=np.float32)
    p90 = occupied_percentile(votes, ones, max(shape), 0.9)
    if p90 <= 0:
        return None
    # `occupied_percentile` divides by exposure + 1 = 2.
    edge = 1.0 - np.exp(-c.MAP_SATURATION * votes / (2.0 * p90))
    smooth = cv2.GaussianBlur(edge.astype(np.float32), (0, 0), c.REFINE_RIDGE_BLUR_PX)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy = cv2.Sobel(gx, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(gy, cv2.CV_32F, 0, 1, scale=1 / 8)
    xy = cv2.Sobel(gx, cv2.CV_32F, 0, 1, scale=1 / 8)
    # Steger's ridge: the second derivative across the line is most negative, the first one vanishes within the pixel.
    half, diff = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.sqrt(diff * diff + xy * xy)
    curvature = half - root
    angle = 0.5 * np.arctan2(-2 * xy, -(xx - yy))
    nx, ny = np.cos(angle), np.sin(angle)
    along = -(gx * nx + gy * ny) / np.where(curvature < -1e-6, curvature, -1e-6)
    is_ridge = (np.abs(along * nx) <= 0.6) & (np.abs(along * ny) <= 0.6) & (curvature < 0)
    # A line, not a blob or noise: curved across much more than along, and high enough.
    is_ridge &= (smooth > c.REFINE_RIDGE_LEVEL) & (np.abs(half + root) < 0.5 * np.abs(curvature))
    is_ridge[:4], is_ridge[-4:], is_ridge[:, :4], is_ridge[:, -4:] = False, False, False, False
    rows, cols = np.nonzero(is_ridge)
    if len(rows) < 50:
        return None
    keep = slice(None, None, max(1, len(rows) // c.REFINE_LANDMARKS))
    rows, cols = rows[keep], cols[keep]
    index = np.full(shape, -1, dtype=np.int32)
    index[rows, cols] = np.arange(len(rows), dtype=np.int32)
    mask = np.full(shape, 255, dtype=np.uint8)
    mask[rows, cols] = 0
    distance, label = cv2.distanceTransformWithLabels(mask, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    # OpenCV numbers the zero pixels itself: translate its numbers to ours.
    table = np.full(int(label.max()) + 1, -1, dtype=np.int32)
    label = np.asarray(label, dtype=np.int32)
    table[label[rows, cols]] = index[rows, cols]
    nearest = table[label]
    nearest[distance > gate + 1.5] = -1
    offset = along[rows, cols]
    normal = np.stack([nx[rows, cols], ny[rows, cols]], axis=-1).astype(np.float64)
    xy_px = np.stack([cols, rows], axis=-1) + offset[:, None] * normal
    return _Ridges(xy=xy_px, normal=normal, label=nearest)


def _round(
    bearings: list[Array],
    Ts: Array,
    plane: Plane,
    start: tuple[Array, Plane],
    scale: float,
    gate: float,
    free: NDArray[np.bool_],
    solve_normal: bool,
    held: int,
) -> tuple[Array, Plane, float, int, float] | None:
    R_map_world = rotation_to_map(plane.normal)
    cells = [_to_cells(b, T, plane, R_map_world, scale) for b, T in zip(bearings, Ts, strict=True)]
    low, shape = _bounds(cells)
    ridges = _ridges(cells, low, shape, gate)
    if ridges is None:
        return None
    L, K = len(ridges.xy), len(Ts)
    d_normal = turn_normal_derivative(plane.normal, np.zeros(2))
    columns: list[tuple[NDArray[Any], ...]] = []
    for k in range(K):
        sums = np.zeros((L, 4))
        _associate(cells[k] - low, bearings[k], ridges.label, ridges.xy, ridges.normal, gate, sums)
        seen = np.flatnonzero(sums[:, 0] >= c.REFINE_MIN_EVENTS)
        if len(seen) == 0:
            continue
        count = sums[seen, 0]
        mean = sums[seen, 1:] / count[:, None]
        J = _jacobian(mean[:, 1:], Ts[k], plane, R_map_world, scale, ridges.normal[seen], d_normal)
        J[:, :6][:, ~free] = 0.0
        weight = np.minimum(count, c.REFINE_MAX_EVENTS)
        # Huber on the mean residual of a landmark in a view.
        huber = 0.5 * gate
        weight = weight * np.where(np.abs(mean[:, 0]) > huber, huber / np.maximum(np.abs(mean[:, 0]), 1e-9), 1.0)
        columns.append((np.full(len(seen), k), seen, weight, mean[:, 0], J))
    if len(columns) < 2:
        return None
    view, landmark, weight, residual = (np.concatenate([col[i] for col in columns]) for i in range(4))
    J = np.concatenate([col[4] for col in columns])
    order = np.argsort(landmark, kind="stable")
    size = 6 * K + 2
    A, g = np.zeros((size, size)), np.zeros(size)
    _schur(
        view[order].astype(np.int64),
        landmark[order].astype(np.int64),
        weight[order],
        residual[order],
        np.ascontiguousarray(J[order]),
        A,
        g,
    )
    fixed = np.zeros(size, dtype=bool)
    fixed[: 6 * held] = True
    fixed[:-2] |= np.tile(~free, K)
    fixed[-2:] = not solve_normal
    strength = c.REFINE_CORRELATED * c.REFINE_VARIANCE_PX2
    prior = np.full(size, strength / c.REFINE_PRIOR_POSE**2)
    prior[-2:] = strength / c.REFINE_PRIOR_NORMAL_RAD**2
    A[np.diag_indices(size)] += prior
    g += prior * _offset(start, Ts, plane)
    live = ~fixed
    x = np.zeros(size)
    x[live] = _solve_positive(A[np.ix_(live, live)], -g[live])
    limit = np.abs(x).max()
    if limit > 0.2:
        x *= 0.2 / limit
    Ts = Ts.copy()
    for k in range(K):
        dx = x[6 * k : 6 * k + 6]
        R = Ts[k, :3, :3]
        Ts[k, :3, 3] += R @ dx[3:]
        Ts[k, :3, :3] = R @ se3.exp_so3(dx[:3])
    plane = Plane(normal=turn_normal(plane.normal, x[-2:]), distance=plane.distance)
    rms = float(np.sqrt(np.average(residual**2, weights=weight)))
    return Ts, plane, rms, L, float(limit)


def _offset(start: tuple[Array, Plane], Ts: Array, plane: Plane) -> Array:
    """Return how far (6 K + 2,) poses and normal have moved from the start, in the current tangent spaces."""
    R = Ts[:, :3, :3]
    R_start_now = np.swapaxes(start[0][:, :3, :3], 1, 2) @ R
    shift = np.einsum("kji,kj->ki", R, Ts[:, :3, 3] - start[0][:, :3, 3])
    tilt = tangent_basis(plane.normal).T @ (plane.normal - start[1].normal)
    return np.concatenate([np.concatenate([se3.log_so3(R_start_now), shift], axis=1).ravel(), tilt])


def _jacobian(
    mean_bearings: Array, T: Array, plane: Plane, R_map_world: Array, scale: float, normal: Array, d_normal: Array
) -> Array:
    """Return d(normal · cells) / d(rotation, position, plane normal) (M, 8) at bearings (M, 2)."""
    R, t, n, d = T[:3, :3], T[:3, 3], plane.normal, plane.distance
    third = np.array([[1.0], [1.0], [d]])
    H = _homography(T, plane, R_map_world)
    x = np.column_stack([mean_bearings, np.ones(len(mean_bearings))])
    q = x @ H.T
    w = scale / q[:, 2]
    # d(cells · normal) = a · d(H x)
    a = np.column_stack(
        [
            normal[:, 0] * w,
            normal[:, 1] * w,
            -(normal[:, 0] * q[:, 0] + normal[:, 1] * q[:, 1]) * w / q[:, 2],
        ]
    )
    J = np.empty((len(x), 8))
    n_c = n @ R
    for i in range(3):
        J[:, i] = np.einsum("ma,ab,mb->m", a, H @ se3.hat(np.eye(3)[i]), x)
        dt = R[:, i]
        J[:, 3 + i] = np.einsum("ma,ab,mb->m", a, R_map_world @ ((dt @ n) * R - np.outer(dt, n_c)) / third, x)
    for i in range(2):
        # The map frame is held while the normal moves: both are re-rendered in the next round.
        dn = d_normal[:, i]
        J[:, 6 + i] = np.einsum("ma,ab,mb->m", a, R_map_world @ ((t @ dn) * R - np.outer(t, dn @ R)) / third, x)
    return J


@numba.njit(cache=True, nogil=True)
def _solve_positive(A, b):
    """Return x with A x = b for a positive definite A, which is overwritten (Cholesky).

    LAPACK is faster on an idle machine, but its threads wait for each other on a busy one: 50 ms against 2 ms for 140
    unknowns beside one other process on two cores.
    """
    n = A.shape[0]
    x = b.copy()
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i == j:
                A[i, i] = np.sqrt(max(total, 1e-30))
            else:
                A[i, j] = total / A[j, j]
    for i in range(n):
        for k in range(i):
            x[i] -= A[i, k] * x[k]
        x[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= A[k, i] * x[k]
        x[i] /= A[i, i]
    return x


@numba.njit(cache=True, nogil=True)
def _vote(points, image):
    rows, cols = image.shape
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if not (x >= 0.0 and y >= 0.0 and x < cols - 1 and y < rows - 1):
            continue
        q, r = int(x), int(y)
        fx, fy = x - q, y - r
        image[r, q] += (1 - fx) * (1 - fy)
        image[r, q + 1] += fx * (1 - fy)
        image[r + 1, q] += (1 - fx) * fy
        image[r + 1, q + 1] += fx * fy


@numba.njit(cache=True, nogil=True)
def _associate(points, bearings, label, xy, normal, gate, sums):
    """Sum, for each landmark, count, residual and bearing of the events within the gate of its line."""
    rows, cols = label.shape
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if not (x >= 0.0 and y >= 0.0 and x < cols - 1 and y < rows - 1):
            continue
        j = label[int(y + 0.5), int(x + 0.5)]
        if j < 0:
            continue
        r = normal[j, 0] * (x - xy[j, 0]) + normal[j, 1] * (y - xy[j, 1])
        if abs(r) > gate:
            continue
        sums[j, 0] += 1.0
        sums[j, 1] += r
        sums[j, 2] += bearings[i, 0]
        sums[j, 3] += bearings[i, 1]


@numba.njit(cache=True, nogil=True)
def _schur(view, landmark, weight, residual, J, A, g):
    """Add the reduced normal equations: observations sorted by landmark, its offset eliminated."""
    n = view.shape[0]
    normal_at = A.shape[0] - 2
    i = 0
    while i < n:
        j = i
        total, mean_r = 0.0, 0.0
        while j < n and landmark[j] == landmark[i]:
            total += weight[j]
            mean_r += weight[j] * residual[j]
            j += 1
        if j - i >= 2:
            mean_r /= total
            mean_n0, mean_n1 = 0.0, 0.0
            for a in range(i, j):
                mean_n0 += weight[a] * J[a, 6] / total
                mean_n1 += weight[a] * J[a, 7] / total
            for a in range(i, j):
                wa, ka = weight[a], 6 * view[a]
                ra = wa * (residual[a] - mean_r)
                n0, n1 = J[a, 6] - mean_n0, J[a, 7] - mean_n1
                for p in range(6):
                    g[ka + p] += J[a, p] * ra
                    A[ka + p, normal_at] += wa * J[a, p] * n0
                    A[ka + p, normal_at + 1] += wa * J[a, p] * n1
                    for q in range(6):
                        A[ka + p, ka + q] += wa * J[a, p] * J[a, q]
                g[normal_at] += n0 * ra
                g[normal_at + 1] += n1 * ra
                A[normal_at, normal_at] += wa * n0 * n0
                A[normal_at, normal_at + 1] += wa * n0 * n1
                A[normal_at + 1, normal_at + 1] += wa * n1 * n1
                for b in range(i, j):
                    kb = 6 * view[b]
                    f = wa * weight[b] / total
                    for p in range(6):
                        s = f * J[a, p]
                        for q in range(6):
                            A[ka + p, kb + q] -= s * J[b, q]
        i = j
    for p in range(normal_at):
        A[normal_at, p] = A[p, normal_at]
        A[normal_at + 1, p] = A[p, normal_at + 1]
    A[normal_at + 1, normal_at] = A[normal_at, normal_at + 1]
