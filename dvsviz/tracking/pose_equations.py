"""Gauss-Newton's normal equations of a pose from the events of a window and the edge image of a map."""

from __future__ import annotations

import numba
import numpy as np

from dvsviz.tracking.kernels import exp_rotation

# A window's rotation is interpolated linearly between nodes: at least so many intervals, and none turns by more than so
# much (rad), which keeps it exact to 1e-4 rad.
_INTERVALS = 4
_TURN = 0.025
# Events whose rows are kept until their products are summed: what fits the first cache.
_BLOCK = 256
# A ridge's least height in the blurred edge image (0 to 1), and how far it may be from an event and its pixel, px.
_RIDGE_LEVEL = 0.1
_RIDGE_REACH_PX = 2.0


@numba.njit(cache=True, nogil=True)
def turned(bearings, t_s, omega, rays):
    """Write the bearings (N, 2) as rays (N, 3) in the camera frame of the pose: E(t) (x, y, 1).

    Args:
        bearings: (N, 2).
        t_s: their times (N,) relative to the pose, increasing.
        omega: angular velocity (3,), held.
        rays: (N, 3).
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
            rays[i, q] = (
                (g * a[q, 0] + f * b[q, 0]) * x + (g * a[q, 1] + f * b[q, 1]) * y + g * a[q, 2] + f * b[q, 2]
            )


@numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def to_ridge(image, u, v):
    """Return the unit normal of the ridge of a smooth image near (u, v) and the distance to it, px; zeros without one.

    A ridge is a line, not a blob or noise: high enough, curved across much more than along, and within reach.
    The second derivative across it is most negative, the first one vanishes on it (Steger).
    """
    rows, cols = image.shape
    c, r = int(u + 0.5), int(v + 0.5)
    if c < 1 or r < 1 or c > cols - 2 or r > rows - 2 or not image[r, c] > _RIDGE_LEVEL:
        return 0.0, 0.0, 0.0
    here = image[r, c]
    left, right, above, below = image[r, c - 1], image[r, c + 1], image[r - 1, c], image[r + 1, c]
    gx, gy = 0.5 * (right - left), 0.5 * (below - above)
    xx, yy = right - 2.0 * here + left, below - 2.0 * here + above
    xy = 0.25 * (image[r + 1, c + 1] - image[r + 1, c - 1] - image[r - 1, c + 1] + image[r - 1, c - 1])
    half, diff = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.sqrt(diff * diff + xy * xy)
    curvature = half - root
    if curvature > -1e-4 or abs(half + root) >= 0.5 * abs(curvature):
        return 0.0, 0.0, 0.0
    # The normal is the eigenvector of the smaller eigenvalue: (xy, curvature - xx) or, better away from its zero, the
    # other row.
    if diff > 0.0:
        nx, ny = xy, curvature - xx
    else:
        nx, ny = curvature - yy, xy
    size = np.sqrt(nx * nx + ny * ny)
    if not size > 1e-12:
        return 0.0, 0.0, 0.0
    nx, ny = nx / size, ny / size
    ahead = -(gx * nx + gy * ny) / curvature
    off = nx * (u - c) + ny * (v - r) - ahead
    if abs(ahead) > _RIDGE_REACH_PX or abs(off) > _RIDGE_REACH_PX:
        return 0.0, 0.0, 0.0
    return nx, ny, off


@numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def pose_equations(
    rays, t_s, R0, p0, velocity, normal, distance, target, image, robust, to_lines, hessian, gradient
):
    """Accumulate Gauss-Newton's normal equations over events, of residuals `1 - image(x(pose))` or distances to lines.

    Parameters: rotation (3) by `R0 exp(phi^)` and position (3) by `p0 + R0 rho`, as in `contrast.warp.map_warp`. The
    point of an event at t is `target R0 (d_t e - q_t (n . e))` with its ray e = E(t) b, q_t = R0^T p0 + v t, the normal
    in the camera frame of the pose and d_t = distance + n . q_t (eq. 2.11); the derivatives are exact but for E(t),
    which is interpolated linearly. The image is sampled bilinearly, its slope is the exact derivative of the sample. An
    event outside the image is left out. Residuals are weighted by `robust² / (robust² + r²)` squared (Geman-McClure)
    where robust > 0.

    With `to_lines` the residual is the distance, px, to the ridge that the image's second derivatives at the nearest
    pixel show (Steger), where they show one, weighted by `robust / |r|` beyond `robust` (Huber). Bright cells draw
    events together; a line does not, and tells what brightness hides: a quarter of the error before few edges.

    Args:
        rays: (N, 3) of `turned`.
        t_s: times (N,) relative to the pose, s.
        R0: rotation (3, 3) of the pose, world from camera.
        p0: its position (3,).
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
    rows, cols = image.shape
    n0 = R0[0, 0] * normal[0] + R0[1, 0] * normal[1] + R0[2, 0] * normal[2]
    n1 = R0[0, 1] * normal[0] + R0[1, 1] * normal[1] + R0[2, 1] * normal[2]
    n2 = R0[0, 2] * normal[0] + R0[1, 2] * normal[1] + R0[2, 2] * normal[2]
    o0 = R0[0, 0] * p0[0] + R0[1, 0] * p0[1] + R0[2, 0] * p0[2]
    o1 = R0[0, 1] * p0[0] + R0[1, 1] * p0[1] + R0[2, 1] * p0[2]
    o2 = R0[0, 2] * p0[0] + R0[1, 2] * p0[1] + R0[2, 2] * p0[2]
    v0, v1, v2 = velocity[0], velocity[1], velocity[2]
    M = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            M[a, b] = target[a, 0] * R0[0, b] + target[a, 1] * R0[1, b] + target[a, 2] * R0[2, b]
    m00, m01, m02 = M[0, 0], M[0, 1], M[0, 2]
    m10, m11, m12 = M[1, 0], M[1, 1], M[1, 2]
    m20, m21, m22 = M[2, 0], M[2, 1], M[2, 2]
    square = robust * robust
    total, inside, kept = 0.0, 0, 0
    # Rows of the Jacobian and the residual, each times the root of its weight.
    block = np.zeros((7, _BLOCK))
    count = rays.shape[0]
    for i in range(count):
        e0, e1, e2, t = rays[i, 0], rays[i, 1], rays[i, 2], t_s[i]
        q0, q1, q2 = o0 + v0 * t, o1 + v1 * t, o2 + v2 * t
        d = distance + n0 * q0 + n1 * q1 + n2 * q2
        ne = n0 * e0 + n1 * e1 + n2 * e2
        x0, x1, x2 = d * e0 - q0 * ne, d * e1 - q1 * ne, d * e2 - q2 * ne
        z = m20 * x0 + m21 * x1 + m22 * x2
        if z > 1e-6:
            by_z = 1.0 / z
            u = (m00 * x0 + m01 * x1 + m02 * x2) * by_z
            v = (m10 * x0 + m11 * x1 + m12 * x2) * by_z
            if u >= 0.0 and v >= 0.0 and u < cols - 1 and v < rows - 1:
                inside += 1
                gx, gy, res, w = 0.0, 0.0, 0.0, 1.0
                if to_lines:
                    nx, ny, res = to_ridge(image, u, v)
                    if nx != 0.0 or ny != 0.0:
                        total += 1.0
                        gx, gy = -nx * by_z, -ny * by_z
                        w = np.sqrt(robust / max(abs(res), robust))
                else:
                    c, r = int(u), int(v)
                    fx, fy = u - c, v - r
                    i00, i01 = image[r, c], image[r, c + 1]
                    i10, i11 = image[r + 1, c], image[r + 1, c + 1]
                    value = (1 - fy) * ((1 - fx) * i00 + fx * i01) + fy * ((1 - fx) * i10 + fx * i11)
                    gx = ((1 - fy) * (i01 - i00) + fy * (i11 - i10)) * by_z
                    gy = ((1 - fx) * (i10 - i00) + fx * (i11 - i01)) * by_z
                    total += value
                    res = 1.0 - value
                    w = square / (square + res * res) if square > 0.0 else 1.0
                if gx != 0.0 or gy != 0.0:
                    # Slope of the image by the point x, in the camera frame of the pose, times the root of the weight.
                    gx, gy = w * gx, w * gy
                    gz = -(gx * u + gy * v)
                    s0, s1, s2 = (
                        gx * m00 + gy * m10 + gz * m20,
                        gx * m01 + gy * m11 + gz * m21,
                        gx * m02 + gy * m12 + gz * m22,
                    )
                    se, sq = s0 * e0 + s1 * e1 + s2 * e2, s0 * q0 + s1 * q1 + s2 * q2
                    # By the position: (n . dq) (s . e) - (s . dq) (n . e).
                    a0, a1, a2 = n0 * se - s0 * ne, n1 * se - s1 * ne, n2 * se - s2 * ne
                    # By the rotation: de = phi x e, and the position turns by phi x v t.
                    r0, r1, r2 = d * s0 - sq * n0, d * s1 - sq * n1, d * s2 - sq * n2
                    block[0, kept] = -(e1 * r2 - e2 * r1 + t * (v1 * a2 - v2 * a1))
                    block[1, kept] = -(e2 * r0 - e0 * r2 + t * (v2 * a0 - v0 * a2))
                    block[2, kept] = -(e0 * r1 - e1 * r0 + t * (v0 * a1 - v1 * a0))
                    block[3, kept], block[4, kept], block[5, kept] = -a0, -a1, -a2
                    block[6, kept] = w * res
                    kept += 1
        if kept == _BLOCK or (i == count - 1 and kept > 0):
            for a in range(6):
                for b in range(a + 1):
                    product = 0.0
                    for k in range(kept):
                        product += block[a, k] * block[b, k]
                    hessian[a, b] += product
                product = 0.0
                for k in range(kept):
                    product += block[a, k] * block[6, k]
                gradient[a] += product
            kept = 0
    for a in range(6):
        for b in range(a):
            hessian[b, a] = hessian[a, b]
    return total, inside
