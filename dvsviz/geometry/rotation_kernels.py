"""Kernels of one rotation at a time, for other kernels and for the calls of which there are many a window."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def exp_rotation(v):
    """Return exp(v^) (3, 3) of one rotation vector (3,): `se3.exp_so3` inside kernels."""
    a2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if a2 < 1e-8:
        s, k = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        a = np.sqrt(a2)
        half = np.sin(0.5 * a)
        s, k = np.sin(a) / a, 2.0 * half * half / a2
    x, y, z = v[0], v[1], v[2]
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1 - k * (y * y + z * z), k * x * y - s * z, k * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = k * x * y + s * z, 1 - k * (x * x + z * z), k * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = k * x * z - s * y, k * y * z + s * x, 1 - k * (x * x + y * y)
    return out


@numba.njit(cache=True, nogil=True)
def log_near(R, out):
    """Write the rotation vector (3,) of a rotation (3, 3) by less than 2.5 rad; return whether it is one."""
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine, cosine = np.sqrt(x * x + y * y + z * z), 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    if not cosine > -0.8:
        return False
    by = np.arctan2(sine, cosine) / sine if sine > 1e-8 else 1.0
    out[0], out[1], out[2] = by * x, by * y, by * z
    return True
