"""Gauss-Newton's normal equations of a pose from the events of a window and the edge image of a map.

Where an event lies on the map is linear in its ray and in its time: `x ~ (A + t B) e`, with A and B made once a step.
Events are taken in blocks: projected, sampled, and their rows and products made, each in a loop of its own over arrays
in single precision, so that the processor works on 8 or 16 of them at once. Only the sampling goes one by one.
"""

from __future__ import annotations

import numba
import numpy as np

from dvsviz.geometry.rotation_kernels import exp_rotation

# A window's rotation is interpolated linearly between nodes: at least so many intervals, and none turns by more than so
# much (rad), which keeps it exact to 1e-4 rad.
_INTERVALS = 4
_TURN = 0.025
# Events whose rows are kept until their products are summed: what fits the first cache.
_BLOCK = 256
# A ridge's least height in the blurred edge image (0 to 1), and how far it may be from an event and its pixel, px.
_RIDGE_LEVEL = np.float32(0.1)
_RIDGE_REACH_PX = np.float32(2.0)
_JIT = {"cache": True, "nogil": True, "fastmath": {"contract", "arcp", "nsz", "reassoc"}}


@numba.njit(cache=True, nogil=True)
def turned(bearings, t_s, omega, rays):
    """Write the bearings (N, 2) as rays (3, N) in the camera frame of the pose: E(t) (x, y, 1).

    Args:
        bearings: (N, 2).
        t_s: their times (N,) relative to the pose, increasing.
        omega: angular velocity (3,), held.
        rays: (3, N) float32.
    """
    n = bearings.shape[0]
    start, duration = t_s[0], max(t_s[n - 1] - t_s[0], 1e-6)
    turn = np.sqrt(omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2) * duration
    intervals = _INTERVALS
    if turn > _INTERVALS * _TURN:
        intervals = int(min(turn / _TURN, 1000.0))
    nodes = np.empty((intervals + 1, 3, 3))
    for k in range(intervals + 1):
        nodes[k] = exp_rotation(omega * (start + duration * k / intervals))
    scale = intervals / duration
    for i in range(n):
        s = (t_s[i] - start) * scale
        k = min(max(int(s), 0), intervals - 1)
        f = s - k
        g = 1.0 - f
        a, b = nodes[k], nodes[k + 1]
        x, y = bearings[i, 0], bearings[i, 1]
        for q in range(3):
            rays[q, i] = (
                (g * a[q, 0] + f * b[q, 0]) * x + (g * a[q, 1] + f * b[q, 1]) * y + g * a[q, 2] + f * b[q, 2]
            )


@numba.njit(**_JIT)
def to_ridge(image, u, v):
    """Return the unit normal of the ridge of a smooth image near (u, v) and the distance to it, px; zeros without one.

    A ridge is a line, not a blob or noise: high enough, curved across much more than along, and within reach.
    The second derivative across it is most negative, the first one vanishes on it (Steger).
    """
    zero, half = np.float32(0.0), np.float32(0.5)
    rows, cols = image.shape
    c, r = int(u + half), int(v + half)
    if c < 1 or r < 1 or c > cols - 2 or r > rows - 2 or not image[r, c] > _RIDGE_LEVEL:
        return zero, zero, zero
    here = image[r, c]
    left, right, above, below = image[r, c - 1], image[r, c + 1], image[r - 1, c], image[r + 1, c]
    gx, gy = half * (right - left), half * (below - above)
    xx, yy = right - (here + here) + left, below - (here + here) + above
    xy = np.float32(0.25) * (image[r + 1, c + 1] - image[r + 1, c - 1] - image[r - 1, c + 1] + image[r - 1, c - 1])
    mean, diff = half * (xx + yy), half * (xx - yy)
    root = np.sqrt(diff * diff + xy * xy)
    curvature = mean - root
    if curvature > np.float32(-1e-4) or abs(mean + root) >= half * abs(curvature):
        return zero, zero, zero
    # The normal is the eigenvector of the smaller eigenvalue: (xy, curvature - xx) or, better away from its zero, the
    # other row.
    if diff > zero:
        nx, ny = xy, curvature - xx
    else:
        nx, ny = curvature - yy, xy
    size = np.sqrt(nx * nx + ny * ny)
    if not size > np.float32(1e-12):
        return zero, zero, zero
    nx, ny = nx / size, ny / size
    ahead = -(gx * nx + gy * ny) / curvature
    off = nx * (u - np.float32(c)) + ny * (v - np.float32(r)) - ahead
    if abs(ahead) > _RIDGE_REACH_PX or abs(off) > _RIDGE_REACH_PX:
        return zero, zero, zero
    return nx, ny, off


@numba.njit(**_JIT)
def pose_equations(
    rays, t_s, R0, p0, velocity, normal, distance, target, image, robust, to_lines, hessian, gradient
):
    """Add the normal equations of one step; return (sum of the image at the events, events inside).

    Args:
        rays: events (3, N) float32, camera frame at the pose: `turned`.
        t_s: their times (N,) float32, relative to the pose.
        R0: rotation (3, 3), world from camera.
        p0: position (3,), world.
        velocity: (3,), camera frame at the pose, held.
        normal: of the plane (3,), world.
        distance: of the plane.
        target: (3, 3) from the world's plane points to pixels of `image`.
        image: values in [0, 1] (rows, columns).
        robust: scale of the robust weight, 0 for none.
        to_lines: the residual is the distance to a ridge of the image.
        hessian: (6, 6), added to in place.
        gradient: (6,), J^T w r, added to in place.

    Returns:
        Sum of image values at the events inside, or how many lie by a ridge; and how many are inside.
    """
    n, o, M = R0.T @ normal, R0.T @ p0, target @ R0
    d, d_t = distance + n @ o, n @ velocity
    A = (d * M - np.outer(M @ o, n)).astype(np.float32)
    B = (d_t * M - np.outer(M @ velocity, n)).astype(np.float32)
    # For the rows: plane, position, velocity and target in the camera frame of the pose, in single precision.
    frame = np.empty((6, 3), dtype=np.float32)
    frame[0], frame[1], frame[2], frame[3:] = n, o, velocity, M
    cells, kept_events, rows = (
        np.empty((3, _BLOCK), dtype=np.float32),
        np.empty((8, _BLOCK), dtype=np.float32),
        np.empty((7, _BLOCK), dtype=np.float32),
    )
    total, inside = 0.0, 0
    for first in range(0, rays.shape[1], _BLOCK):
        end = min(first + _BLOCK, rays.shape[1])
        x, y, z, at = rays[0, first:end], rays[1, first:end], rays[2, first:end], t_s[first:end]
        _project(x, y, z, at, A, B, cells)
        value, seen, kept = _sample(x, y, z, at, cells, image, np.float32(robust), to_lines, kept_events, rows[6])
        total, inside = total + value, inside + seen
        _rows(kept_events, kept, frame, np.float32(d), np.float32(d_t), rows)
        for a in range(6):
            for b in range(a + 1):
                product = np.float32(0.0)
                for k in range(kept):
                    product += rows[a, k] * rows[b, k]
                hessian[a, b] += product
            product = np.float32(0.0)
            for k in range(kept):
                product += rows[a, k] * rows[6, k]
            gradient[a] += product
    for a in range(6):
        for b in range(a):
            hessian[b, a] = hessian[a, b]
    return total, inside


@numba.njit(**_JIT)
def _project(x, y, z, t_s, A, B, cells):
    """Write pixels u, v and the inverse of their depth (3, block) of rays (x, y, z) (n,) at times (n,): (A + t B) e."""
    u, v, by_depth = cells
    a00, a01, a02, a10, a11, a12, a20, a21, a22 = A.ravel()
    b00, b01, b02, b10, b11, b12, b20, b21, b22 = B.ravel()
    for k in range(t_s.shape[0]):
        t = t_s[k]
        w = np.float32(1.0) / ((a20 + t * b20) * x[k] + (a21 + t * b21) * y[k] + (a22 + t * b22) * z[k])
        u[k] = ((a00 + t * b00) * x[k] + (a01 + t * b01) * y[k] + (a02 + t * b02) * z[k]) * w
        v[k] = ((a10 + t * b10) * x[k] + (a11 + t * b11) * y[k] + (a12 + t * b12) * z[k]) * w
        by_depth[k] = w


@numba.njit(**_JIT)
def _sample(x, y, z, t_s, cells, image, robust, to_lines, events, residuals):
    """Gather what has a slope: ray, time, pixel, weighted slope by the depth (8, block), weighted residual (block,).

    Returns:
        Sum of image values, or how many lie by a ridge; how many are inside; how many have a slope.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    right, bottom = np.float32(image.shape[1] - 1), np.float32(image.shape[0] - 1)
    square = robust * robust
    total, inside, kept = zero, 0, 0
    for k in range(t_s.shape[0]):
        u, v, by_depth = cells[0, k], cells[1, k], cells[2, k]
        # Behind the camera, or as good as in its plane, is outside.
        if not (
            by_depth > zero and by_depth < np.float32(1e6) and u >= zero and v >= zero and u < right and v < bottom
        ):
            continue
        inside += 1
        if to_lines:
            nx, ny, residual = to_ridge(image, u, v)
            if nx == zero and ny == zero:
                continue
            total += one
            gx, gy = -nx, -ny
            w = np.sqrt(robust / max(abs(residual), robust))
        else:
            c, r = int(u), int(v)
            fx, fy = u - np.float32(c), v - np.float32(r)
            dx, dx_below = image[r, c + 1] - image[r, c], image[r + 1, c + 1] - image[r + 1, c]
            dy, dy_right = image[r + 1, c] - image[r, c], image[r + 1, c + 1] - image[r, c + 1]
            gx, gy = dx + fy * (dx_below - dx), dy + fx * (dy_right - dy)
            value = image[r, c] + fx * dx + fy * gy
            total += value
            if gx == zero and gy == zero:
                continue
            residual = one - value
            w = square / (square + residual * residual) if square > zero else one
        events[0, kept], events[1, kept], events[2, kept] = x[k], y[k], z[k]
        events[3, kept], events[4, kept], events[5, kept] = t_s[k], u, v
        events[6, kept], events[7, kept] = w * gx * by_depth, w * gy * by_depth
        residuals[kept] = w * residual
        kept += 1
    return total, inside, kept


@numba.njit(**_JIT)
def _rows(events, count, frame, d, d_t, rows):
    """Write the first six rows of the Jacobian, by rotation and position, of what `_sample` gathered.

    Args:
        events: (8, block).
        count: of them.
        frame: normal, position, velocity and target (6, 3), in the camera frame of the pose.
        d: distance of the camera from the plane at the pose.
        d_t: its change a second.
        rows: (7, block).
    """
    n0, n1, n2 = frame[0]
    o0, o1, o2 = frame[1]
    v0, v1, v2 = frame[2]
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = frame[3:].ravel()
    for k in range(count):
        e0, e1, e2, t = events[0, k], events[1, k], events[2, k], events[3, k]
        # Slope of the image by the point on the plane times its depth, in the camera frame of the pose.
        gx, gy = events[6, k], events[7, k]
        gz = -(gx * events[4, k] + gy * events[5, k])
        s0, s1, s2 = (
            gx * m00 + gy * m10 + gz * m20,
            gx * m01 + gy * m11 + gz * m21,
            gx * m02 + gy * m12 + gz * m22,
        )
        q0, q1, q2 = o0 + v0 * t, o1 + v1 * t, o2 + v2 * t
        depth, ne = d + d_t * t, n0 * e0 + n1 * e1 + n2 * e2
        se, sq = s0 * e0 + s1 * e1 + s2 * e2, s0 * q0 + s1 * q1 + s2 * q2
        # By the position: (n . dq) (s . e) - (s . dq) (n . e).
        a0, a1, a2 = n0 * se - s0 * ne, n1 * se - s1 * ne, n2 * se - s2 * ne
        # By the rotation: de = phi x e, and the position turns by phi x v t.
        r0, r1, r2 = depth * s0 - sq * n0, depth * s1 - sq * n1, depth * s2 - sq * n2
        rows[0, k] = -(e1 * r2 - e2 * r1 + t * (v1 * a2 - v2 * a1))
        rows[1, k] = -(e2 * r0 - e0 * r2 + t * (v2 * a0 - v0 * a2))
        rows[2, k] = -(e0 * r1 - e1 * r0 + t * (v0 * a1 - v1 * a0))
        rows[3, k], rows[4, k], rows[5, k] = -a0, -a1, -a2
