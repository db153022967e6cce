"""Numba kernels: fused warp and vote, adjoint gather, map sampling.

One idea carries all of them. A homography that changes over a window is given at `nodes` (M, 3, 3), equally
spaced in time, and is interpolated linearly between them, entry by entry. A warp that is linear in its nodes has a
derivative that is linear in the nodes' derivatives: for an image cost with adjoint image G = d cost / d image, every
event adds the outer product of a 3-vector and its bearing to the two nodes around it, and the gradient with respect
to any parameter p is `sum(adjoint * d nodes / d p)`. The cost of an event does not depend on the number of
parameters, and the gradient is exact for the warp that was evaluated.

All kernels release the GIL and write only to arrays they are given for output.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

_JIT = {"cache": True, "nogil": True, "fastmath": {"contract", "arcp", "nsz", "reassoc"}}


@numba.njit(inline="always", **_JIT)
def _node(t, scale, count):
    """Return index and fraction of the node before relative time t; `scale` is nodes per second."""
    s = t * scale
    k = int(s)
    if k < 0:
        k = 0
    elif k > count - 2:
        k = count - 2
    return k, s - k


@numba.njit(**_JIT)
def warp_events(bearings, t_s, nodes, scale, out):
    """Write the warped positions (N, 2) of bearings (N, 2); NaN where the point is behind the target."""
    m = nodes.shape[0]
    for i in range(bearings.shape[0]):
        x, y = bearings[i, 0], bearings[i, 1]
        k, f = _node(t_s[i], scale, m)
        a, b = nodes[k], nodes[k + 1]
        g = 1.0 - f
        px = (g * a[0, 0] + f * b[0, 0]) * x + (g * a[0, 1] + f * b[0, 1]) * y + g * a[0, 2] + f * b[0, 2]
        py = (g * a[1, 0] + f * b[1, 0]) * x + (g * a[1, 1] + f * b[1, 1]) * y + g * a[1, 2] + f * b[1, 2]
        pz = (g * a[2, 0] + f * b[2, 0]) * x + (g * a[2, 1] + f * b[2, 1]) * y + g * a[2, 2] + f * b[2, 2]
        if pz > 1e-6:
            out[i, 0] = px / pz
            out[i, 1] = py / pz
        else:
            out[i, 0] = np.nan
            out[i, 1] = np.nan


@numba.njit(**_JIT)
def vote(points, weights, image):
    """Add each point's weight to the four pixels around it, bilinearly; points outside are left out.

    Args:
        points: pixel positions (N, 2), x then y; NaN is outside.
        weights: (N,) or (1,) for one weight of all.
        image: (rows, columns), added to in place.
    """
    rows, cols = image.shape
    one = weights.shape[0] == 1
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if not (x >= 0.0 and y >= 0.0 and x < cols - 1 and y < rows - 1):
            continue
        w = weights[0] if one else weights[i]
        c, r = int(x), int(y)
        fx, fy = x - c, y - r
        image[r, c] += w * (1 - fx) * (1 - fy)
        image[r, c + 1] += w * fx * (1 - fy)
        image[r + 1, c] += w * (1 - fx) * fy
        image[r + 1, c + 1] += w * fx * fy


@numba.njit(**_JIT)
def gather(bearings, t_s, weights, points, adjoint, nodes, scale, out):
    """Add the adjoint of the node matrices (M, 3, 3) of `vote(warp_events(...))` for an adjoint image.

    Args:
        bearings: (N, 2).
        t_s: seconds since the first node (N,).
        weights: (N,) or (1,).
        points: warped positions (N, 2) that were voted.
        adjoint: d cost / d image (rows, columns).
        nodes: (M, 3, 3).
        scale: nodes per second.
        out: (M, 3, 3), added to in place.
    """
    rows, cols = adjoint.shape
    m = nodes.shape[0]
    one = weights.shape[0] == 1
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        if not (px >= 0.0 and py >= 0.0 and px < cols - 1 and py < rows - 1):
            continue
        w = weights[0] if one else weights[i]
        c, r = int(px), int(py)
        fx, fy = px - c, py - r
        v00, v01 = adjoint[r, c], adjoint[r, c + 1]
        v10, v11 = adjoint[r + 1, c], adjoint[r + 1, c + 1]
        gx = w * ((1 - fy) * (v01 - v00) + fy * (v11 - v10))
        gy = w * ((1 - fx) * (v10 - v00) + fx * (v11 - v01))
        x, y = bearings[i, 0], bearings[i, 1]
        k, f = _node(t_s[i], scale, m)
        g = 1.0 - f
        a, b = nodes[k], nodes[k + 1]
        pz = (g * a[2, 0] + f * b[2, 0]) * x + (g * a[2, 1] + f * b[2, 1]) * y + g * a[2, 2] + f * b[2, 2]
        a0, a1 = gx / pz, gy / pz
        a2 = -(gx * px + gy * py) / pz
        lo, hi = out[k], out[k + 1]
        for q in range(3):
            e = a0 if q == 0 else (a1 if q == 1 else a2)
            lo[q, 0] += g * e * x
            lo[q, 1] += g * e * y
            lo[q, 2] += g * e
            hi[q, 0] += f * e * x
            hi[q, 1] += f * e * y
            hi[q, 2] += f * e


@numba.njit(**_JIT)
def normal_equations(bearings, t_s, nodes, d_nodes, scale, image, robust, hessian, gradient):
    """Accumulate Gauss-Newton's normal equations of residuals `1 - image(x(theta))` over events.

    The image is sampled bilinearly, its slope is the exact derivative of the sample. An event outside the image is
    left out. Residuals are weighted by `robust² / (robust² + r²)` squared (Geman-McClure) where robust > 0.

    Args:
        bearings: (N, 2).
        t_s: seconds since the first node (N,).
        nodes: homographies to pixels of `image` (M, 3, 3).
        d_nodes: their derivatives (P, M, 3, 3).
        scale: nodes per second.
        image: values in [0, 1] (rows, columns).
        robust: scale of the robust weight, 0 for none.
        hessian: (P, P), added to in place.
        gradient: (P,), J^T w r, added to in place.

    Returns:
        Sum of image values at the events inside, and their number.
    """
    rows, cols = image.shape
    m, p_count = nodes.shape[0], d_nodes.shape[0]
    j = np.empty(p_count)
    total, inside = 0.0, 0
    for i in range(bearings.shape[0]):
        x, y = bearings[i, 0], bearings[i, 1]
        k, f = _node(t_s[i], scale, m)
        g = 1.0 - f
        a, b = nodes[k], nodes[k + 1]
        px = (g * a[0, 0] + f * b[0, 0]) * x + (g * a[0, 1] + f * b[0, 1]) * y + g * a[0, 2] + f * b[0, 2]
        py = (g * a[1, 0] + f * b[1, 0]) * x + (g * a[1, 1] + f * b[1, 1]) * y + g * a[1, 2] + f * b[1, 2]
        pz = (g * a[2, 0] + f * b[2, 0]) * x + (g * a[2, 1] + f * b[2, 1]) * y + g * a[2, 2] + f * b[2, 2]
        if pz <= 1e-6:
            continue
        u, v = px / pz, py / pz
        if not (u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1):
            continue
        c, r = int(u), int(v)
        fx, fy = u - c, v - r
        v00, v01 = image[r, c], image[r, c + 1]
        v10, v11 = image[r + 1, c], image[r + 1, c + 1]
        value = (1 - fy) * ((1 - fx) * v00 + fx * v01) + fy * ((1 - fx) * v10 + fx * v11)
        gx = (1 - fy) * (v01 - v00) + fy * (v11 - v10)
        gy = (1 - fx) * (v10 - v00) + fx * (v11 - v01)
        total += value
        inside += 1
        res = 1.0 - value
        w = 1.0
        if robust > 0.0:
            w = robust * robust / (robust * robust + res * res)
            w *= w
        a0, a1 = gx / pz, gy / pz
        a2 = -(gx * u + gy * v) / pz
        for q in range(p_count):
            lo, hi = d_nodes[q, k], d_nodes[q, k + 1]
            s0 = (g * lo[0, 0] + f * hi[0, 0]) * x + (g * lo[0, 1] + f * hi[0, 1]) * y + g * lo[0, 2] + f * hi[0, 2]
            s1 = (g * lo[1, 0] + f * hi[1, 0]) * x + (g * lo[1, 1] + f * hi[1, 1]) * y + g * lo[1, 2] + f * hi[1, 2]
            s2 = (g * lo[2, 0] + f * hi[2, 0]) * x + (g * lo[2, 1] + f * hi[2, 1]) * y + g * lo[2, 2] + f * hi[2, 2]
            j[q] = -(a0 * s0 + a1 * s1 + a2 * s2)
        for q in range(p_count):
            wj = w * j[q]
            gradient[q] += wj * res
            for s in range(q + 1):
                hessian[q, s] += wj * j[s]
    for q in range(p_count):
        for s in range(q):
            hessian[s, q] = hessian[q, s]
    return total, inside


@numba.njit(**_JIT)
def sample(points, image, outside):
    """Return the bilinear samples (N,) of an image at pixel positions (N, 2); `outside` where there is none."""
    rows, cols = image.shape
    out = np.empty(points.shape[0], dtype=np.float32)
    for i in range(points.shape[0]):
        u, v = points[i, 0], points[i, 1]
        if not (u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1):
            out[i] = outside
            continue
        c, r = int(u), int(v)
        fx, fy = u - c, v - r
        out[i] = (1 - fy) * ((1 - fx) * image[r, c] + fx * image[r, c + 1]) + fy * (
            (1 - fx) * image[r + 1, c] + fx * image[r + 1, c + 1]
        )
    return out


def node_count(rotation_rad: float) -> int:
    """Return how many nodes keep the linear interpolation of a rotation exact to 1e-5 rad.

    The chord of an arc of h rad is off by h²/8: h = 0.009 rad gives 1e-5 rad, 0.002 px at f = 200 px.
    """
    return int(min(257, max(3, math.ceil(rotation_rad / 0.009) + 1)))


def node_times(duration_s: float, count: int) -> tuple[NDArray[np.float64], float]:
    """Return node times (count,) over `[0, duration_s]` and nodes per second."""
    duration = max(duration_s, 1e-6)
    return np.linspace(0.0, duration, count), (count - 1) / duration
