"""Kernels of the joint refinement: landmark offsets eliminated, the rest solved."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def reduce_normal_equations(view, landmark, weight, residual, J, A, g):
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


@numba.njit(cache=True, nogil=True)
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
