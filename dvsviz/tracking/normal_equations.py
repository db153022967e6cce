"""Kernels of the joint refinement: landmark offsets eliminated, the rest solved."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def landmark_jacobians(bearings, view, Rs, ts, n, d, R_map_world, scale, normals, d_normal, out):
    """Write d(normal . cell) / d(rotation, position, plane normal) (M, 8) of bearings (M, 2), each seen from a view.

    The cell of bearing b is `scale q / q_2` with q = R_map_world (d_c R b - t (n . R b)) and its last entry by d. The
    map frame is held while the plane's normal moves: both are rendered anew in the next round.

    Args:
        bearings: (M, 2).
        view: which view each was seen from (M,).
        Rs: rotations (K, 3, 3) of the views, world from camera.
        ts: positions (K, 3).
        n: the plane's normal (3,), world.
        d: its distance.
        R_map_world: rotation (3, 3).
        scale: cells per unit.
        normals: of the landmarks' edges in the map (M, 2).
        d_normal: derivative (3, 2) of the plane's normal by its two parameters.
        out: (M, 8).
    """
    by_0, by_1 = d_normal[:, 0].copy(), d_normal[:, 1].copy()
    m, y, x, n_c = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(bearings.shape[0]):
        R, t = Rs[view[i]], ts[view[i]]
        for k in range(3):
            n_c[k] = n[0] * R[0, k] + n[1] * R[1, k] + n[2] * R[2, k]
        d_c = d + t[0] * n[0] + t[1] * n[1] + t[2] * n[2]
        t_0 = t[0] * by_0[0] + t[1] * by_0[1] + t[2] * by_0[2]
        t_1 = t[0] * by_1[0] + t[1] * by_1[1] + t[2] * by_1[2]
        x[0], x[1], x[2] = bearings[i, 0], bearings[i, 1], 1.0
        for k in range(3):
            y[k] = R[k, 0] * x[0] + R[k, 1] * x[1] + R[k, 2]
        ny = n[0] * y[0] + n[1] * y[1] + n[2] * y[2]
        p0, p1, p2 = d_c * y[0] - t[0] * ny, d_c * y[1] - t[1] * ny, d_c * y[2] - t[2] * ny
        q0 = R_map_world[0, 0] * p0 + R_map_world[0, 1] * p1 + R_map_world[0, 2] * p2
        q1 = R_map_world[1, 0] * p0 + R_map_world[1, 1] * p1 + R_map_world[1, 2] * p2
        q2 = (R_map_world[2, 0] * p0 + R_map_world[2, 1] * p1 + R_map_world[2, 2] * p2) / d
        w = scale / q2
        a0, a1 = normals[i, 0] * w, normals[i, 1] * w
        a2 = -(normals[i, 0] * q0 + normals[i, 1] * q1) * w / q2 / d
        for k in range(3):
            m[k] = R_map_world[0, k] * a0 + R_map_world[1, k] * a1 + R_map_world[2, k] * a2
        my = m[0] * y[0] + m[1] * y[1] + m[2] * y[2]
        mt = m[0] * t[0] + m[1] * t[1] + m[2] * t[2]
        # By the rotation: dy = R (phi x b); s = R^T (d_c m - (m . t) n).
        s0 = d_c * (R[0, 0] * m[0] + R[1, 0] * m[1] + R[2, 0] * m[2]) - mt * n_c[0]
        s1 = d_c * (R[0, 1] * m[0] + R[1, 1] * m[1] + R[2, 1] * m[2]) - mt * n_c[1]
        s2 = d_c * (R[0, 2] * m[0] + R[1, 2] * m[1] + R[2, 2] * m[2]) - mt * n_c[2]
        out[i, 0] = x[1] * s2 - x[2] * s1
        out[i, 1] = x[2] * s0 - x[0] * s2
        out[i, 2] = x[0] * s1 - x[1] * s0
        for k in range(3):
            mr = m[0] * R[0, k] + m[1] * R[1, k] + m[2] * R[2, k]
            out[i, 3 + k] = n_c[k] * my - mr * ny
        out[i, 6] = t_0 * my - mt * (by_0[0] * y[0] + by_0[1] * y[1] + by_0[2] * y[2])
        out[i, 7] = t_1 * my - mt * (by_1[0] * y[0] + by_1[1] * y[1] + by_1[2] * y[2])


def reduce_normal_equations(
    view: NDArray[np.int64],
    landmark: NDArray[np.int64],
    weight: Array,
    residual: Array,
    J: Array,
    landmarks: int,
    A: Array,
    g: Array,
) -> None:
    """Add the reduced normal equations of landmarks whose offsets are eliminated.

    Args:
        view: of each observation (M,).
        landmark: of each observation (M,), increasing.
        weight: (M,).
        residual: (M,).
        J: by the view's pose and the plane's normal (M, 8).
        landmarks: how many there are.
        A: (6 K + 2, 6 K + 2) of K views, added to in place.
        g: (6 K + 2,), added to in place.
    """
    eliminated = np.zeros((landmarks, len(g) - 2))
    _add_observations(view, landmark, weight, residual, J, A, g, eliminated)
    A[:-2, :-2] -= eliminated.T @ eliminated


@numba.njit(cache=True, nogil=True)
def _add_observations(view, landmark, weight, residual, J, A, g, eliminated):
    """Add all but the product of each landmark's row (6 K,) with itself, which is written to `eliminated`."""
    n = view.shape[0]
    normal_at = A.shape[0] - 2
    i = 0
    while i < n:
        j = i
        total, mean_r, mean_n0, mean_n1 = 0.0, 0.0, 0.0, 0.0
        while j < n and landmark[j] == landmark[i]:
            total += weight[j]
            mean_r += weight[j] * residual[j]
            mean_n0 += weight[j] * J[j, 6]
            mean_n1 += weight[j] * J[j, 7]
            j += 1
        mean_r, mean_n0, mean_n1 = mean_r / total, mean_n0 / total, mean_n1 / total
        # Seen once, a landmark says nothing.
        for a in range(i, j if j - i >= 2 else i):
            wa, ka = weight[a], 6 * view[a]
            ra = wa * (residual[a] - mean_r)
            n0, n1 = J[a, 6] - mean_n0, J[a, 7] - mean_n1
            for p in range(6):
                g[ka + p] += J[a, p] * ra
                A[ka + p, normal_at] += wa * J[a, p] * n0
                A[ka + p, normal_at + 1] += wa * J[a, p] * n1
                for q in range(6):
                    A[ka + p, ka + q] += wa * J[a, p] * J[a, q]
                eliminated[landmark[a], ka + p] = wa * J[a, p] / np.sqrt(total)
            g[normal_at] += n0 * ra
            g[normal_at + 1] += n1 * ra
            A[normal_at, normal_at] += wa * n0 * n0
            A[normal_at, normal_at + 1] += wa * n0 * n1
            A[normal_at + 1, normal_at + 1] += wa * n1 * n1
        i = j
    for p in range(normal_at):
        A[normal_at, p] = A[p, normal_at]
        A[normal_at + 1, p] = A[p, normal_at + 1]
    A[normal_at + 1, normal_at] = A[normal_at, normal_at + 1]


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def solve_positive(A, b):
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
