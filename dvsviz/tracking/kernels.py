"""Numba kernels of the tracker: warps, a window's images, its footprint on the map, its overlap with it."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def exp_rotation(v):
    """Return exp(v^) (3, 3) of one rotation vector (3,): `se3.exp_so3` inside kernels."""
    a2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if a2 < 1e-10:
        s, k = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        a = np.sqrt(a2)
        s, k = np.sin(a) / a, (1.0 - np.cos(a)) / a2
    x, y, z = v[0], v[1], v[2]
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1 - k * (y * y + z * z), k * x * y - s * z, k * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = k * x * y + s * z, 1 - k * (x * x + z * z), k * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = k * x * z - s * y, k * y * z + s * x, 1 - k * (x * x + y * y)
    return out


@numba.njit(cache=True, nogil=True)
def map_nodes(R0, p0, omega, velocity, normal, distance, target, start, duration, nodes):
    """Write the homographies (M, 3, 3) of `contrast.warp.map_warp`, without allocating.

    `target` is the projection to cells times the rotation to the map, its last row divided by the distance.
    """
    m = nodes.shape[0]
    v_world = R0 @ velocity
    step = np.empty((3, 3))
    for k in range(m):
        t = start + duration * k / (m - 1)
        R = R0 @ exp_rotation(omega * t)
        position = p0 + v_world * t
        n_c = normal @ R
        d_c = distance + position @ normal
        for a in range(3):
            for b in range(3):
                step[a, b] = d_c * R[a, b] - position[a] * n_c[b]
        nodes[k] = target @ step


@numba.njit(cache=True, nogil=True)
def vote_window(bearings, t_s, sign, nodes, scale, K, warped, signed, raw):
    """Vote a window bilinearly into three images (rows, columns), added to in place.

    Args:
        bearings: (N, 2) float32.
        t_s: seconds since the first node (N,).
        sign: polarities ±1 (N,) float32.
        nodes: homographies to pixels (M, 3, 3), linear in time in between.
        scale: nodes per second.
        K: calibration (3, 3), for `raw`.
        warped: the IWE with weights 1.
        signed: the IWE with polarities as weights.
        raw: the polarities where the events were, without motion.
    """
    rows, cols = warped.shape
    m = nodes.shape[0]
    for i in range(bearings.shape[0]):
        x, y, w = bearings[i, 0], bearings[i, 1], sign[i]
        u, v = K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]
        if u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1:
            c, r = int(u), int(v)
            fx, fy = u - c, v - r
            raw[r, c] += w * (1 - fx) * (1 - fy)
            raw[r, c + 1] += w * fx * (1 - fy)
            raw[r + 1, c] += w * (1 - fx) * fy
            raw[r + 1, c + 1] += w * fx * fy
        s = t_s[i] * scale
        k = min(max(int(s), 0), m - 2)
        f = s - k
        g = 1.0 - f
        a, b = nodes[k], nodes[k + 1]
        pz = (g * a[2, 0] + f * b[2, 0]) * x + (g * a[2, 1] + f * b[2, 1]) * y + g * a[2, 2] + f * b[2, 2]
        if pz <= 1e-6:
            continue
        u = ((g * a[0, 0] + f * b[0, 0]) * x + (g * a[0, 1] + f * b[0, 1]) * y + g * a[0, 2] + f * b[0, 2]) / pz
        v = ((g * a[1, 0] + f * b[1, 0]) * x + (g * a[1, 1] + f * b[1, 1]) * y + g * a[1, 2] + f * b[1, 2]) / pz
        if not (u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1):
            continue
        c, r = int(u), int(v)
        fx, fy = u - c, v - r
        w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
        warped[r, c] += w00
        warped[r, c + 1] += w01
        warped[r + 1, c] += w10
        warped[r + 1, c + 1] += w11
        signed[r, c] += w * w00
        signed[r, c + 1] += w * w01
        signed[r + 1, c] += w * w10
        signed[r + 1, c + 1] += w * w11


@numba.njit(cache=True, nogil=True)
def footprint_mean(edge, exposure, block, H, K, width, height, columns):
    """Return (mean edge value over what is in view and was seen, share of the view that was seen).

    Args:
        edge: edge image (rows, columns) in [0, 1].
        exposure: displacement that swept each block (rows / block, columns / block); 0 is not seen.
        block: cells a block.
        H: homography (3, 3) from bearings to cells.
        K: calibration (3, 3).
        width: of the sensor.
        height: of the sensor.
        columns: pixels sampled along the width.
    """
    rows, cols = edge.shape
    lines = max(2, int(columns * height / width + 0.5))
    total, seen = 0.0, 0
    for i in range(lines):
        y = ((height - 1) * i / (lines - 1) - K[1, 2]) / K[1, 1]
        for j in range(columns):
            x = ((width - 1) * j / (columns - 1) - K[0, 2]) / K[0, 0]
            pz = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            if pz <= 1e-9:
                continue
            u = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / pz
            v = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / pz
            if not (u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1):
                continue
            c, r = int(u), int(v)
            if exposure[r // block, c // block] <= 0.0:
                continue
            fx, fy = u - c, v - r
            total += (1 - fy) * ((1 - fx) * edge[r, c] + fx * edge[r, c + 1]) + fy * (
                (1 - fx) * edge[r + 1, c] + fx * edge[r + 1, c + 1]
            )
            seen += 1
    return (total / seen if seen > 0 else 0.0), seen / (lines * columns)


@numba.njit(cache=True, nogil=True)
def explained_share(image, level, edge, H, K, threshold):
    """Return (share of the pixels of `image` above `level` whose place on the map is an edge, their number).

    Args:
        image: IWE (height, width).
        level: votes above which a pixel holds an edge.
        edge: edge image of the map (rows, columns).
        H: homography (3, 3) from bearings to cells.
        K: calibration (3, 3).
        threshold: edge value above which a cell is an edge.
    """
    rows, cols = edge.shape
    count, explained = 0, 0
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            if not image[r, c] > level:
                continue
            count += 1
            x, y = (c - K[0, 2]) / K[0, 0], (r - K[1, 2]) / K[1, 1]
            pz = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            if pz <= 1e-9:
                continue
            u = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / pz
            v = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / pz
            if not (u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1):
                continue
            q, p = int(u), int(v)
            fx, fy = u - q, v - p
            value = (1 - fy) * ((1 - fx) * edge[p, q] + fx * edge[p, q + 1]) + fy * (
                (1 - fx) * edge[p + 1, q] + fx * edge[p + 1, q + 1]
            )
            if value > threshold:
                explained += 1
    return (explained / count if count > 0 else 0.0), count


@numba.njit(cache=True, nogil=True)
def mean_displacement(first, last, K, width, height):
    """Return the mean distance (px) over a grid of the sensor between where two homographies put a bearing."""
    total = 0.0
    for i in range(4):
        y = ((height - 1) * i / 3.0 - K[1, 2]) / K[1, 1]
        for j in range(5):
            x = ((width - 1) * j / 4.0 - K[0, 2]) / K[0, 0]
            az = first[2, 0] * x + first[2, 1] * y + first[2, 2]
            bz = last[2, 0] * x + last[2, 1] * y + last[2, 2]
            dx = (first[0, 0] * x + first[0, 1] * y + first[0, 2]) / az
            dx -= (last[0, 0] * x + last[0, 1] * y + last[0, 2]) / bz
            dy = (first[1, 0] * x + first[1, 1] * y + first[1, 2]) / az
            dy -= (last[1, 0] * x + last[1, 1] * y + last[1, 2]) / bz
            total += np.sqrt(dx * dx + dy * dy)
    return total / 20.0


@numba.njit(cache=True, nogil=True)
def slope_tensor(edge, H, K, width, height, columns):
    """Return the sums (xx, xy, yy) of the squared slopes of an edge image over what a camera sees of it.

    Args:
        edge: blurred edge image (rows, columns).
        H: homography (3, 3) from bearings to cells.
        K: calibration (3, 3).
        width: of the sensor.
        height: of the sensor.
        columns: pixels sampled along the width.
    """
    rows, cols = edge.shape
    lines = max(2, int(columns * height / width + 0.5))
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in range(lines):
        y = ((height - 1) * i / (lines - 1) - K[1, 2]) / K[1, 1]
        for j in range(columns):
            x = ((width - 1) * j / (columns - 1) - K[0, 2]) / K[0, 0]
            pz = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            if pz <= 1e-9:
                continue
            c = int((H[0, 0] * x + H[0, 1] * y + H[0, 2]) / pz + 0.5)
            r = int((H[1, 0] * x + H[1, 1] * y + H[1, 2]) / pz + 0.5)
            if c < 1 or r < 1 or c >= cols - 1 or r >= rows - 1:
                continue
            gx = 0.5 * (edge[r, c + 1] - edge[r, c - 1])
            gy = 0.5 * (edge[r + 1, c] - edge[r - 1, c])
            xx += gx * gx
            xy += gx * gy
            yy += gy * gy
    return xx, xy, yy
