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

# Depth (third coordinate) below which a point counts as behind the target.
_NEAREST = 1e-6
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


@numba.njit(inline="always", **_JIT)
def project(H, x, y):
    """Return where a homography (3, 3) puts the bearing (x, y, 1); NaN where that is behind the target."""
    z = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    if z <= _NEAREST:
        return np.nan, np.nan
    return (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / z, (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / z


@numba.njit(inline="always", **_JIT)
def warp_one(nodes, scale, t, x, y):
    """Return where the homographies (M, 3, 3) put the bearing (x, y, 1) at time t since the first; NaN behind."""
    k, f = _node(t, scale, nodes.shape[0])
    a, b = nodes[k], nodes[k + 1]
    g = 1.0 - f
    z = (g * a[2, 0] + f * b[2, 0]) * x + (g * a[2, 1] + f * b[2, 1]) * y + g * a[2, 2] + f * b[2, 2]
    if z <= _NEAREST:
        return np.nan, np.nan
    u = (g * a[0, 0] + f * b[0, 0]) * x + (g * a[0, 1] + f * b[0, 1]) * y + g * a[0, 2] + f * b[0, 2]
    v = (g * a[1, 0] + f * b[1, 0]) * x + (g * a[1, 1] + f * b[1, 1]) * y + g * a[1, 2] + f * b[1, 2]
    return u / z, v / z


@numba.njit(inline="always", **_JIT)
def is_inside(u, v, rows, cols):
    """Return whether a point has four pixels around it; NaN has none."""
    return u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1


@numba.njit(inline="always", **_JIT)
def bilinear(image, u, v):
    """Return the value of an image (rows, columns) at a point inside."""
    c, r = int(u), int(v)
    fx, fy = u - c, v - r
    return (1 - fy) * ((1 - fx) * image[r, c] + fx * image[r, c + 1]) + fy * (
        (1 - fx) * image[r + 1, c] + fx * image[r + 1, c + 1]
    )


@numba.njit(inline="always", **_JIT)
def splat(image, u, v, weight):
    """Add a weight to the four pixels of an image (rows, columns) around a point inside, bilinearly."""
    c, r = int(u), int(v)
    fx, fy = u - c, v - r
    image[r, c] += weight * (1 - fx) * (1 - fy)
    image[r, c + 1] += weight * fx * (1 - fy)
    image[r + 1, c] += weight * (1 - fx) * fy
    image[r + 1, c + 1] += weight * fx * fy


@numba.njit(**_JIT)
def warp_events(bearings, t_s, nodes, scale, out):
    """Write the warped positions (N, 2) of bearings (N, 2); NaN where the point is behind the target."""
    for i in range(bearings.shape[0]):
        out[i, 0], out[i, 1] = warp_one(nodes, scale, t_s[i], bearings[i, 0], bearings[i, 1])


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
        if is_inside(x, y, rows, cols):
            splat(image, x, y, weights[0] if one else weights[i])


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
def sample(points, image, outside):
    """Return the bilinear samples (N,) of an image at pixel positions (N, 2); `outside` where there is none."""
    rows, cols = image.shape
    out = np.empty(points.shape[0], dtype=np.float32)
    for i in range(points.shape[0]):
        u, v = points[i, 0], points[i, 1]
        out[i] = bilinear(image, u, v) if is_inside(u, v, rows, cols) else outside
    return out


@numba.njit(**_JIT)
def contrasts(bearings, t_s, weights, nodes, scale, image, smooth, sloped, out):
    """Write the contrast of the same events under several warps.

    Each image is smoothed by the binomial kernel (1, 2, 1) / 4 in x and y (sigma 0.7 px): single votes would make the
    contrast rough from warp to warp.

    Args:
        bearings: (N, 2).
        t_s: seconds since the first node (N,).
        weights: (N,) or (1,).
        nodes: homographies to pixels (C, M, 3, 3), one set a warp.
        scale: nodes per second.
        image: scratch (rows, columns).
        smooth: scratch (rows, columns).
        sloped: False for the variance, True for the mean squared gradient.
        out: (C,), written.
    """
    rows, cols = image.shape
    one = weights.shape[0] == 1
    line = np.empty(cols, dtype=np.float32)
    for w in range(nodes.shape[0]):
        image[:] = 0.0
        for i in range(bearings.shape[0]):
            u, v = warp_one(nodes[w], scale, t_s[i], bearings[i, 0], bearings[i, 1])
            if is_inside(u, v, rows, cols):
                splat(image, u, v, weights[0] if one else weights[i])
        for r in range(rows):
            up, down = max(r - 1, 0), min(r + 1, rows - 1)
            for c in range(cols):
                line[c] = 0.25 * (image[up, c] + 2 * image[r, c] + image[down, c])
            smooth[r, 0], smooth[r, cols - 1] = line[0], line[cols - 1]
            for c in range(1, cols - 1):
                smooth[r, c] = 0.25 * (line[c - 1] + 2 * line[c] + line[c + 1])
        total, squares = 0.0, 0.0
        if sloped:
            for r in range(1, rows - 1):
                for c in range(1, cols - 1):
                    dx = smooth[r, c + 1] - smooth[r, c - 1]
                    dy = smooth[r + 1, c] - smooth[r - 1, c]
                    squares += dx * dx + dy * dy
            squares *= 0.25
        else:
            for r in range(rows):
                for c in range(cols):
                    total += smooth[r, c]
                    squares += smooth[r, c] * smooth[r, c]
        size = rows * cols
        out[w] = squares / size - (total / size) ** 2


@numba.njit(**_JIT)
def means_on(bearings, t_s, nodes, scale, image, out, inside):
    """Write the mean of an image at the same events under several warps, and the share of events inside it.

    Args:
        bearings: (N, 2).
        t_s: seconds since the first node (N,).
        nodes: homographies to pixels of `image` (C, M, 3, 3), one set a warp.
        scale: nodes per second.
        image: (rows, columns), sampled bilinearly.
        out: means (C,), written; 0 where no event is inside.
        inside: shares (C,), written.
    """
    rows, cols = image.shape
    n = bearings.shape[0]
    for w in range(nodes.shape[0]):
        total, count = 0.0, 0
        for i in range(n):
            u, v = warp_one(nodes[w], scale, t_s[i], bearings[i, 0], bearings[i, 1])
            if is_inside(u, v, rows, cols):
                total += bilinear(image, u, v)
                count += 1
        out[w] = total / count if count > 0 else 0.0
        inside[w] = count / n if n > 0 else 0.0


@numba.njit(**_JIT)
def occupied(x_px, y_px, starts, stamps, out):
    """Write how many pixels have at least one event, for each of several windows.

    Args:
        x_px: columns of all events (N,).
        y_px: their rows (N,).
        starts: index of each window's first event, and the end of the last (W + 1,).
        stamps: scratch (rows, columns) int64 of -1.
        out: (W,), written.
    """
    for w in range(out.shape[0]):
        count = 0
        for i in range(starts[w], starts[w + 1]):
            r, c = y_px[i], x_px[i]
            if stamps[r, c] != w:
                stamps[r, c] = w
                count += 1
        out[w] = count


def node_count(rotation_rad: float) -> int:
    """Return how many nodes keep the linear interpolation of a rotation exact to 1e-5 rad.

    The chord of an arc of h rad is off by h²/8: h = 0.009 rad gives 1e-5 rad, 0.002 px at f = 200 px.
    """
    return int(min(257, max(3, math.ceil(rotation_rad / 0.009) + 1)))


def node_times(duration_s: float, count: int) -> tuple[NDArray[np.float64], float]:
    """Return node times (count,) over `[0, duration_s]` and nodes per second."""
    duration = max(duration_s, 1e-6)
    return np.linspace(0.0, duration, count), (count - 1) / duration
