"""Numba kernels of the tracker: warps, a window's images, its footprint on the map, its overlap with it."""

from __future__ import annotations

import numba
import numpy as np

from dvsviz.contrast.kernels import bilinear, is_inside, project, splat, warp_one
from dvsviz.geometry.rotation_kernels import exp_rotation


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
def vote_window(bearings, t_us, is_positive, step, start_us, nodes, scale, K, warped, signed, raw):
    """Vote a window bilinearly into three images (rows, columns), added to in place.

    Args:
        bearings: (N, 2) float32.
        t_us: times (N,), int64.
        is_positive: polarities (N,), bool.
        step: every so manieth event is taken.
        start_us: time of the first node.
        nodes: homographies to pixels (M, 3, 3), linear in time in between.
        scale: nodes per second.
        K: calibration (3, 3), for `raw`.
        warped: the IWE with weights 1.
        signed: the IWE with polarities as weights.
        raw: the polarities where the events were, without motion.
    """
    rows, cols = warped.shape
    for i in range(0, bearings.shape[0], step):
        x, y = bearings[i, 0], bearings[i, 1]
        sign = np.float32(1.0) if is_positive[i] else np.float32(-1.0)
        u, v = K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]
        if is_inside(u, v, rows, cols):
            splat(raw, u, v, sign)
        u, v = warp_one(nodes, scale, (t_us[i] - start_us) * 1e-6, x, y)
        if is_inside(u, v, rows, cols):
            splat(warped, u, v, 1.0)
            splat(signed, u, v, sign)


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def variance(image):
    """Return the variance of an image (rows, columns)."""
    total, squares = 0.0, 0.0
    for row in range(image.shape[0]):
        # A line is short: its sums keep their digits in single precision.
        sum_row, squares_row = np.float32(0.0), np.float32(0.0)
        for value in image[row]:
            sum_row += value
            squares_row += value * value
        total += sum_row
        squares += squares_row
    return squares / image.size - (total / image.size) ** 2


@numba.njit(cache=True, nogil=True)
def edges_of(image, least):
    """Return the level above which a pixel of an IWE (rows, columns) holds an edge, and how many do.

    The level is half of what nine tenths of the occupied pixels stay below (of 1024 steps), and at least `least`.
    """
    flat = image.ravel()
    top = np.float32(0.0)
    for value in flat:
        top = max(top, value)
    if not top > 0.0:
        return least, 0
    occupied, n = np.empty(flat.shape[0], dtype=np.int32), 0
    for i in range(flat.shape[0]):
        occupied[n] = i
        n += flat[i] > 0.0
    bins, scale = np.zeros(1024, dtype=np.int32), np.float32(1024.0) / top
    for i in occupied[:n]:
        bins[min(1023, int(flat[i] * scale))] += 1
    level, seen = least, 0
    for i in range(1024):
        seen += bins[i]
        if seen >= 0.9 * n:
            level = max(least, 0.5 * top * (i + 0.5) / 1024.0)
            break
    count = 0
    for i in occupied[:n]:
        count += flat[i] > level
    return level, count


@numba.njit(cache=True, nogil=True)
def reach(points, step):
    """Return the corners (2,), (2,) of the box of some points (N, 2), but for the outermost; NaN is left out.

    Args:
        points: (N, 2).
        step: every so manieth is looked at.
    """
    low, high = np.full(2, np.nan), np.full(2, np.nan)
    some = points[::step]
    for axis in range(2):
        values = np.sort(some[:, axis][np.isfinite(some[:, axis])])
        n = len(values)
        if n > 0:
            outer = int(0.005 * n)
            low[axis], high[axis] = values[outer], values[n - 1 - outer]
    return low, high


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
            u, v = project(H, x, y)
            if not is_inside(u, v, rows, cols) or exposure[int(v) // block, int(u) // block] <= 0.0:
                continue
            total += bilinear(edge, u, v)
            seen += 1
    return (total / seen if seen > 0 else 0.0), seen / (lines * columns)


@numba.njit(cache=True, nogil=True)
def still_written(rays, H, exposure, block, limit):
    """Return those of rays (3, N) that meet the map where it is not yet frozen.

    Args:
        rays: (3, N) float32, camera frame.
        H: homography (3, 3) from bearings to cells.
        exposure: displacement that swept each block.
        block: cells a block.
        limit: a block swept by more, px, is frozen.
    """
    rows, cols = exposure.shape[0] * block, exposure.shape[1] * block
    kept, count = np.empty_like(rays), 0
    for i in range(rays.shape[1]):
        u, v = project(H, rays[0, i] / rays[2, i], rays[1, i] / rays[2, i])
        if is_inside(u, v, rows, cols) and exposure[int(v) // block, int(u) // block] <= limit:
            kept[:, count] = rays[:, i]
            count += 1
    return kept[:, :count].copy()


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
            u, v = project(H, (c - K[0, 2]) / K[0, 0], (r - K[1, 2]) / K[1, 1])
            if is_inside(u, v, rows, cols) and bilinear(edge, u, v) > threshold:
                explained += 1
    return (explained / count if count > 0 else 0.0), count


@numba.njit(cache=True, nogil=True)
def mean_displacement(first, last, K, width, height):
    """Return the mean distance (px) over a grid of the sensor between where two homographies put a bearing.

    What is behind the target in one of them is left out.
    """
    total, count = 0.0, 0
    for i in range(4):
        y = ((height - 1) * i / 3.0 - K[1, 2]) / K[1, 1]
        for j in range(5):
            x = ((width - 1) * j / 4.0 - K[0, 2]) / K[0, 0]
            ax, ay = project(first, x, y)
            bx, by = project(last, x, y)
            moved = np.sqrt((ax - bx) ** 2 + (ay - by) ** 2)
            if np.isfinite(moved):
                total += moved
                count += 1
    return total / count if count > 0 else 0.0


@numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def slope_tensor(edge, H, K, width, height, columns):
    """Return the sums (xx, xy, yy) of the squared slopes of an edge image over what a camera sees of it.

    The pixels of a line are evenly spaced: numerators and denominator of the homography are linear in their number.

    Args:
        edge: blurred edge image (rows, columns).
        H: homography (3, 3) from bearings to cells.
        K: calibration (3, 3).
        width: of the sensor.
        height: of the sensor.
        columns: pixels sampled along the width.
    """
    rows, cols = edge.shape
    flat, at = edge.ravel(), np.empty(columns, dtype=np.int32)
    lines = max(2, int(columns * height / width + 0.5))
    zero, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    right, bottom = np.float32(cols - 1.5), np.float32(rows - 1.5)
    x_first, x_step = -K[0, 2] / K[0, 0], (width - 1) / (columns - 1) / K[0, 0]
    du, dv, dw = np.float32(H[0, 0] * x_step), np.float32(H[1, 0] * x_step), np.float32(H[2, 0] * x_step)
    xx, xy, yy = zero, zero, zero
    for i in range(lines):
        y = ((height - 1) * i / (lines - 1) - K[1, 2]) / K[1, 1]
        u_first = np.float32(H[0, 0] * x_first + H[0, 1] * y + H[0, 2])
        v_first = np.float32(H[1, 0] * x_first + H[1, 1] * y + H[1, 2])
        w_first = np.float32(H[2, 0] * x_first + H[2, 1] * y + H[2, 2])
        for j in range(columns):
            k = np.float32(j)
            w = w_first + k * dw
            u, v = (u_first + k * du) * (one / w), (v_first + k * dv) * (one / w)
            seen = (w > zero) & (u >= half) & (v >= half) & (u < right) & (v < bottom)
            c = np.int32(u + half) if seen else np.int32(0)
            r = np.int32(v + half) if seen else np.int32(0)
            at[j] = r * np.int32(cols) + c
        for j in range(columns):
            k = at[j]
            # The first cell has no neighbours: it stands for what is not seen.
            if k > 0:
                gx, gy = half * (flat[k + 1] - flat[k - 1]), half * (flat[k + cols] - flat[k - cols])
                xx += gx * gx
                xy += gx * gy
                yy += gy * gy
    return xx, xy, yy


@numba.njit(cache=True, nogil=True)
def adjugate(H):
    """Return the inverse of a homography (3, 3), up to scale; also of one that has none."""
    out = np.empty((3, 3))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            p, q = (j + 1) % 3, (j + 2) % 3
            out[j, i] = H[a, p] * H[b, q] - H[a, q] * H[b, p]
    return out
