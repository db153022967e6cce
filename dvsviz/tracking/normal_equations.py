"""Kernels of the joint refinement: landmark offsets eliminated, the rest solved by conjugate gradients.

The matrix of all poses is never made: it is full, as every landmark ties all views that saw it to each other, but its
product with a vector costs one pass over the observations. What ties neighbours in time, and each pose to itself, is a
band around the diagonal; its Cholesky factor is the preconditioner.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def landmark_jacobians(bearings, view, Rs, ts, n, d, R_map_world, scale, normals, d_normal, out):
    """Write d(normal . cell) / d(rotation, position, plane normal) (M, 8) of bearings (M, 2), each seen from a view.

    Rotation and position are moved in the world: R' = exp(phi) R, t' = t + delta.

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
    m, y, x = np.empty(3), np.empty(3), np.empty(3)
    for i in range(bearings.shape[0]):
        R, t = Rs[view[i]], ts[view[i]]
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
        # By the rotation: dy = phi x y; s = d_c m - (m . t) n.
        s0, s1, s2 = d_c * m[0] - mt * n[0], d_c * m[1] - mt * n[1], d_c * m[2] - mt * n[2]
        out[i, 0] = y[1] * s2 - y[2] * s1
        out[i, 1] = y[2] * s0 - y[0] * s2
        out[i, 2] = y[0] * s1 - y[1] * s0
        for k in range(3):
            out[i, 3 + k] = n[k] * my - m[k] * ny
        out[i, 6] = t_0 * my - mt * (by_0[0] * y[0] + by_0[1] * y[1] + by_0[2] * y[2])
        out[i, 7] = t_1 * my - mt * (by_1[0] * y[0] + by_1[1] * y[1] + by_1[2] * y[2])


@numba.njit(cache=True, nogil=True)
def solve_views(
    first, view, weight, residual, J, prior, gradient, middle, tie, stiffness, is_free, most, tolerance
):
    """Return the Gauss-Newton step (6 K + 2,) of K poses and the plane's normal, the landmarks' offsets eliminated.

    Args:
        first: of each landmark its first observation (L + 1,).
        view: of each observation (M,).
        weight: (M,).
        residual: (M,); its mean over each landmark is taken off, in place.
        J: by the view's pose and the plane's normal (M, 8); the last two without their mean too, in place.
        prior: information (6 K + 2,) that each number has by itself.
        gradient: (6 K + 2,) of all but the observations.
        middle: poses (T,) that are tied to the one before and the one after.
        tie: coefficients (T, 3) of before, middle and after.
        stiffness: information (T, 6) of the six combinations being zero.
        is_free: mask (6 K + 2,); the others stay.
        most: iterations.
        tolerance: of the preconditioned residual's length, by that at the start.
    """
    size = prior.shape[0]
    poses = size - 2
    total = _centred(first, weight, residual, J)
    band = np.zeros((poses, 19))
    g = gradient.copy()
    pivot = prior[poses:].copy()
    _observed(first, view, weight, residual, J, g, band, pivot)
    for q in range(poses):
        band[q, 0] += prior[q]
    for k in range(middle.shape[0]):
        at = 6 * (middle[k] - 1)
        for a in range(3):
            for b in range(a + 1):
                for q in range(6):
                    band[at + 6 * a + q, 6 * (a - b)] += stiffness[k, q] * tie[k, a] * tie[k, b]
    for q in range(poses):
        for d in range(1, min(q, 18) + 1):
            if not (is_free[q] and is_free[q - d]):
                band[q, d] = 0.0
    banded_cholesky(band)
    x, r = np.zeros(size), -g
    for q in range(size):
        if not is_free[q]:
            r[q] = 0.0
    z = r.copy()
    _precondition(band, pivot, z)
    p, p_out = z.copy(), np.empty(size)
    at_first = now = r @ z
    for _ in range(most):
        if not now > tolerance * tolerance * at_first:
            break
        for q in range(size):
            p_out[q] = prior[q] * p[q]
        _times_observed(first, view, weight, J, total, p, p_out)
        for k in range(middle.shape[0]):
            at = 6 * (middle[k] - 1)
            for q in range(6):
                s = tie[k, 0] * p[at + q] + tie[k, 1] * p[at + 6 + q] + tie[k, 2] * p[at + 12 + q]
                s *= stiffness[k, q]
                for a in range(3):
                    p_out[at + 6 * a + q] += tie[k, a] * s
        for q in range(size):
            if not is_free[q]:
                p_out[q] = 0.0
        step = now / (p @ p_out)
        x += step * p
        r -= step * p_out
        z[:] = r
        _precondition(band, pivot, z)
        before, now = now, r @ z
        p *= now / before
        p += z
    return x


@numba.njit(cache=True, nogil=True)
def _centred(first, weight, residual, J):
    """Take the landmarks' weighted means off the residuals and off what the normal changes; return their weights (L,).

    Seen once, a landmark says nothing: its residual becomes zero.
    """
    total = np.zeros(first.shape[0] - 1)
    for j in range(total.shape[0]):
        r, n0, n1 = 0.0, 0.0, 0.0
        for i in range(first[j], first[j + 1]):
            total[j] += weight[i]
            r += weight[i] * residual[i]
            n0 += weight[i] * J[i, 6]
            n1 += weight[i] * J[i, 7]
        by = 1.0 / max(total[j], 1e-30)
        for i in range(first[j], first[j + 1]):
            residual[i] -= r * by
            J[i, 6] -= n0 * by
            J[i, 7] -= n1 * by
    return total


@numba.njit(cache=True, nogil=True)
def _observed(first, view, weight, residual, J, g, band, pivot):
    """Add the observations' gradient (6 K + 2,), their blocks on the diagonal (6 K, 19), and the normal's (2,)."""
    poses = band.shape[0]
    for j in range(first.shape[0] - 1):
        if first[j + 1] - first[j] < 2:
            continue
        for i in range(first[j], first[j + 1]):
            at, w = 6 * view[i], weight[i]
            for p in range(6):
                g[at + p] += w * J[i, p] * residual[i]
                for q in range(p + 1):
                    band[at + p, p - q] += w * J[i, p] * J[i, q]
            for p in range(2):
                g[poses + p] += w * J[i, 6 + p] * residual[i]
                pivot[p] += w * J[i, 6 + p] * J[i, 6 + p]


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _times_observed(first, view, weight, J, total, x, out):
    """Add the product of the observations' reduced matrix with x (6 K + 2,), in the precision of J."""
    poses = x.shape[0] - 2
    # By view, eight numbers each: one line of the cache.
    x_view, out_view = np.empty((poses // 6, 8), dtype=J.dtype), np.zeros((poses // 6, 8))
    for k in range(poses // 6):
        for q in range(6):
            x_view[k, q] = x[6 * k + q]
        x_view[k, 6], x_view[k, 7] = x[poses], x[poses + 1]
    most = 1
    for j in range(first.shape[0] - 1):
        most = max(most, first[j + 1] - first[j])
    along, sums = np.empty(most, dtype=J.dtype), np.zeros(2, dtype=J.dtype)
    for j in range(first.shape[0] - 1):
        a, b = first[j], first[j + 1]
        if b - a < 2:
            continue
        sums[:] = 0.0
        for i in range(a, b):
            row, other = J[i], x_view[view[i]]
            s = row[0] * other[0] + row[1] * other[1] + row[2] * other[2]
            s += row[3] * other[3] + row[4] * other[4] + row[5] * other[5]
            sums[0] += weight[i] * s
            along[i - a] = s + row[6] * other[6] + row[7] * other[7]
        sums[1] = sums[0] / total[j]
        for i in range(a, b):
            s = weight[i] * (along[i - a] - sums[1])
            row, into = J[i], out_view[view[i]]
            for q in range(8):
                into[q] += row[q] * s
    for k in range(poses // 6):
        for q in range(6):
            out[6 * k + q] += out_view[k, q]
        out[poses] += out_view[k, 6]
        out[poses + 1] += out_view[k, 7]


@numba.njit(cache=True, nogil=True)
def _precondition(band, pivot, x):
    """Replace x (6 K + 2,) by the solution of the band and of the normal's two pivots."""
    n = band.shape[0]
    x[n] /= pivot[0]
    x[n + 1] /= pivot[1]
    for i in range(n):
        s = x[i]
        for d in range(1, min(i, band.shape[1] - 1) + 1):
            s -= band[i, d] * x[i - d]
        x[i] = s / band[i, 0]
    for i in range(n - 1, -1, -1):
        x[i] /= band[i, 0]
        for d in range(1, min(i, band.shape[1] - 1) + 1):
            x[i - d] -= band[i, d] * x[i]


@numba.njit(cache=True, nogil=True)
def banded_cholesky(band):
    """Replace a positive definite matrix, A[i, i - d] = band[i, d] (n, width + 1), by its lower factor, in place."""
    width = band.shape[1] - 1
    for i in range(band.shape[0]):
        for d in range(min(i, width), -1, -1):
            j = i - d
            s = band[i, d]
            for k in range(max(0, i - width), j):
                s -= band[i, i - k] * band[j, j - k]
            band[i, d] = s / band[j, 0] if d > 0 else np.sqrt(max(s, 1e-30))
