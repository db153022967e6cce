"""Numba kernels of the relief map: landmarks in a view, which events belong to them, and the equations of a pose.

A landmark is a short piece of edge in space, on the ray of the view that first saw it. With the ray's origin `o`, its
direction `d` (of unit depth), the edge's normal `m` and tangent `q` in that view's image, all in world axes, and the
two unknowns offset `u` and inverse depth `rho`, a camera at (R, p) sees it at `x = Y_xy / Y_z` of

    Y = R^T (d + u m + rho (o - p))

which is exact, has no singularity at infinity, and is linear in both unknowns.
"""

from __future__ import annotations

import numba
import numpy as np

# Columns of `rays`: origin, direction, normal, tangent.
RAY_COLUMNS = 12
# Columns of `seen`: bearing (2), normal (2), inverse depth in the view (0 where it is behind the camera).
SEEN_COLUMNS = 5
_NEAREST = 1e-3


@numba.njit(cache=True, nogil=True)
def homogeneous(ray, u, rho, R, p, Y):
    """Write Y (3,), the direction in which a camera (R, p) sees a landmark."""
    a0 = ray[3] + u * ray[6] + rho * (ray[0] - p[0])
    a1 = ray[4] + u * ray[7] + rho * (ray[1] - p[1])
    a2 = ray[5] + u * ray[8] + rho * (ray[2] - p[2])
    for k in range(3):
        Y[k] = R[0, k] * a0 + R[1, k] * a1 + R[2, k] * a2


@numba.njit(cache=True, nogil=True)
def see(rays, states, R, p, seen):
    """Write how a camera (R, p) sees the landmarks.

    Args:
        rays: (L, 12), world.
        states: offset and inverse depth (L, 2).
        R: rotation (3, 3) of the camera in the world.
        p: position (3,).
        seen: (L, 5), written.
    """
    Y = np.empty(3)
    for i in range(rays.shape[0]):
        homogeneous(rays[i], states[i, 0], states[i, 1], R, p, Y)
        seen[i, 4] = 0.0
        if Y[2] < _NEAREST or states[i, 1] <= 0.0:
            continue
        x, y = Y[0] / Y[2], Y[1] / Y[2]
        t0 = R[0, 0] * rays[i, 9] + R[1, 0] * rays[i, 10] + R[2, 0] * rays[i, 11]
        t1 = R[0, 1] * rays[i, 9] + R[1, 1] * rays[i, 10] + R[2, 1] * rays[i, 11]
        t2 = R[0, 2] * rays[i, 9] + R[1, 2] * rays[i, 10] + R[2, 2] * rays[i, 11]
        along_x, along_y = t0 - x * t2, t1 - y * t2
        size = np.sqrt(along_x * along_x + along_y * along_y)
        if size < 1e-9:
            continue
        seen[i, 0], seen[i, 1] = x, y
        seen[i, 2], seen[i, 3] = along_y / size, -along_x / size
        seen[i, 4] = states[i, 1] / Y[2]


@numba.njit(cache=True, nogil=True)
def associate(
    bearings, t_s, is_positive, bounds_s, seen, sides, K, size, gate_px, reach_px, told_px, owner, residual
):
    """Write which landmark (N,) each event belongs to, -1 for none, and its distance from the line, px.

    The window is cut into slices, each with its own view of the landmarks, in which they move evenly.

    Args:
        bearings: (N, 2) of events in time order.
        t_s: their times (N,).
        is_positive: their polarities (N,).
        bounds_s: times (S + 1,) between which the slices lie.
        seen: how the landmarks are seen at those times (S + 1, L, 5).
        sides: polarity (L,), ±1, of a landmark's events when it moves along its normal.
        K: calibration (3, 3).
        size: (width, height) of the image.
        gate_px: largest distance across the line.
        reach_px: largest distance along it.
        told_px: a landmark's motion across its line within the window, px, above which its polarity is told.
        owner: written.
        residual: written; bearings less landmark, across the line.
    """
    count, landmarks = bearings.shape[0], seen.shape[1]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    focal = 0.5 * (fx + fy)
    cell = max(gate_px, reach_px)
    cols, rows = int(size[0] / cell) + 3, int(size[1] / cell) + 3
    head = np.empty((rows, cols), np.int32)
    following = np.empty(landmarks, np.int32)
    x, y = np.empty(landmarks), np.empty(landmarks)
    dx, dy, sign = np.empty(landmarks), np.empty(landmarks), np.empty(landmarks)
    k, whole = 0, bounds_s[-1] - bounds_s[0]
    for s in range(seen.shape[0] - 1):
        head[:] = -1
        a, b = seen[s], seen[s + 1]
        length = max(bounds_s[s + 1] - bounds_s[s], 1e-9)
        middle = 0.5 * (bounds_s[s] + bounds_s[s + 1])
        for i in range(landmarks):
            if a[i, 4] <= 0.0 or b[i, 4] <= 0.0:
                continue
            x[i], y[i] = 0.5 * (a[i, 0] + b[i, 0]), 0.5 * (a[i, 1] + b[i, 1])
            col, row = int((fx * x[i] + cx) / cell + 1.0), int((fy * y[i] + cy) / cell + 1.0)
            if col < 0 or row < 0 or col >= cols or row >= rows:
                continue
            dx[i], dy[i] = (b[i, 0] - a[i, 0]) / length, (b[i, 1] - a[i, 1]) / length
            across = dx[i] * a[i, 2] + dy[i] * a[i, 3]
            told = abs(across) * focal * whole > told_px
            sign[i] = (sides[i] if across > 0 else -sides[i]) if told else 0.0
            following[i] = head[row, col]
            head[row, col] = i
        last = s == seen.shape[0] - 2
        while k < count and (last or t_s[k] < bounds_s[s + 1]):
            owner[k], best = -1, 1e30
            polarity = 1.0 if is_positive[k] else -1.0
            dt = t_s[k] - middle
            col = int((fx * bearings[k, 0] + cx) / cell + 1.0)
            row = int((fy * bearings[k, 1] + cy) / cell + 1.0)
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(col - 1, 0), min(col + 2, cols)):
                    i = head[r, c]
                    while i >= 0:
                        if sign[i] * polarity >= 0.0:
                            ex = focal * (bearings[k, 0] - x[i] - dx[i] * dt)
                            ey = focal * (bearings[k, 1] - y[i] - dy[i] * dt)
                            across = a[i, 2] * ex + a[i, 3] * ey
                            along = a[i, 2] * ey - a[i, 3] * ex
                            if abs(across) < gate_px and abs(along) < reach_px:
                                cost = across * across + 0.25 * along * along
                                if cost < best:
                                    best, owner[k], residual[k] = cost, i, across
                        i = following[i]
            k += 1


@numba.njit(cache=True, nogil=True)
def by_landmark(owner, residual, count, total):
    """Add up events (N,) by their landmarks (L,): their number, and their residuals."""
    for k in range(owner.shape[0]):
        i = owner[k]
        if i >= 0:
            count[i] += 1
            total[i] += residual[k]


@numba.njit(cache=True, nogil=True)
def derivatives(ray, u, rho, R, p, normal, focal, by_pose, by_state):
    """Write the derivatives of a landmark's place across its line, px; return that place.

    Args:
        ray: (12,).
        u: offset.
        rho: inverse depth.
        R: rotation (3, 3).
        p: position (3,).
        normal: of the line (2,) in the image, held.
        focal: px.
        by_pose: (6,), written: by a turn in the camera's frame (`R exp(phi)`), and by the position in the world.
        by_state: (2,), written: by offset and inverse depth.
    """
    Y = np.empty(3)
    homogeneous(ray, u, rho, R, p, Y)
    z = max(Y[2], _NEAREST)
    x, y = Y[0] / z, Y[1] / z
    # g · dY is the derivative of normal · x.
    g0, g1 = focal * normal[0] / z, focal * normal[1] / z
    g2 = -(g0 * x + g1 * y)
    # Y of a camera turned by phi is exp(-phi) Y: dY = Y × phi.
    by_pose[0] = g1 * Y[2] - g2 * Y[1]
    by_pose[1] = g2 * Y[0] - g0 * Y[2]
    by_pose[2] = g0 * Y[1] - g1 * Y[0]
    w0 = R[0, 0] * g0 + R[0, 1] * g1 + R[0, 2] * g2
    w1 = R[1, 0] * g0 + R[1, 1] * g1 + R[1, 2] * g2
    w2 = R[2, 0] * g0 + R[2, 1] * g1 + R[2, 2] * g2
    by_pose[3], by_pose[4], by_pose[5] = -rho * w0, -rho * w1, -rho * w2
    by_state[0] = w0 * ray[6] + w1 * ray[7] + w2 * ray[8]
    by_state[1] = w0 * (ray[0] - p[0]) + w1 * (ray[1] - p[1]) + w2 * (ray[2] - p[2])
    return focal * (normal[0] * x + normal[1] * y)


@numba.njit(cache=True, nogil=True)
def pose_equations(rays, states, variances, seen, R, p, focal, index, offset, weight, scale_px, H, g):
    """Add the normal equations of one pose (6, 6), (6,) by landmarks' mean distances from their lines.

    Args:
        rays: (L, 12).
        states: (L, 2).
        variances: of the landmarks' places across their lines in this view (L,), px².
        seen: (L, 5) at the pose.
        R: rotation (3, 3).
        p: position (3,).
        focal: px.
        index: landmarks with events (M,).
        offset: their events' mean distance from the line (M,), px.
        weight: how many observations each counts for (M,).
        scale_px: of the robust (Cauchy) weight.
        H: added to.
        g: added to.

    Returns:
        The robust cost.
    """
    J, by_state = np.empty(6), np.empty(2)
    cost = 0.0
    for m in range(index.shape[0]):
        i = index[m]
        derivatives(rays[i], states[i, 0], states[i, 1], R, p, seen[i, 2:4], focal, J, by_state)
        e = offset[m]
        s2 = scale_px * scale_px
        w = 1.0 / ((1.0 + e * e / s2) * (1.0 / weight[m] + variances[i]))
        cost += w * e * e
        for a in range(6):
            g[a] += w * e * J[a]
            for b in range(6):
                H[a, b] += w * J[a] * J[b]
    return cost


@numba.njit(cache=True, nogil=True)
def place_variances(rays, states, information, seen, R, p, focal, out):
    """Write the variances (L,), px², of the landmarks' places across their lines, by their information (L, 2, 2)."""
    J, s = np.empty(6), np.empty(2)
    for i in range(rays.shape[0]):
        out[i] = np.inf
        if seen[i, 4] <= 0.0:
            continue
        derivatives(rays[i], states[i, 0], states[i, 1], R, p, seen[i, 2:4], focal, J, s)
        a, b, d = information[i, 0, 0], information[i, 0, 1], information[i, 1, 1]
        determinant = a * d - b * b
        if determinant > 0.0:
            out[i] = (d * s[0] * s[0] - 2.0 * b * s[0] * s[1] + a * s[1] * s[1]) / determinant
