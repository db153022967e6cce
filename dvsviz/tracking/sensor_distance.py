"""From a line's distance on the map to the distance on the sensor, and how the one by the other changes with a pose.

The refinement brings down distances on the sensor: that is where they were measured. Those on the map become smaller
for every view that draws near to the plane, and all views together would.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.plane import Plane, rotation_to_map, turn_normal_derivative
from dvsviz.tracking.edges import ViewEvents
from dvsviz.tracking.halves import Halves

Array = NDArray[np.float64]
# Events of a view that tell how large its pixels are on the plane, and the least cosine and distance that count.
_SCALE_EVENTS = 100
_SLANT = 1e-3
_JIT = {"cache": True, "nogil": True, "fastmath": {"contract", "arcp", "nsz", "reassoc"}}


def cells_per_unit(events: ViewEvents, Ts: Array, plane: Plane, focal_px: float) -> float:
    """Return the resolution of a map on which a pixel of the sensor covers one cell (geometric mean over the events).

    A plane that is steep to the views takes up more of the map than one that they face; with a fixed resolution it
    would be judged by larger pixels.

    Args:
        events: of the views.
        Ts: poses (K, 4, 4) of the views.
        plane: in the world.
        focal_px: pixels of the sensor per unit of a bearing.
    """
    total, count = 0.0, 0
    for k, T in enumerate(Ts):
        b = events.of_view(k)
        b = b[:: max(1, len(b) // _SCALE_EVENTS)]
        seen = plane.seen_from(T)
        # The plane's area by the bearings': d_c² / (-n_c . b)³.
        slant = -(b @ seen.normal[:2] + seen.normal[2])
        slant = slant[slant > _SLANT]
        total += 2.0 * len(slant) * np.log(max(seen.distance, _SLANT)) - 3.0 * float(np.log(slant).sum())
        count += len(slant)
    return focal_px * float(np.exp(-0.5 * total / max(1, count)))


def on_the_sensor(
    mean: Array,
    view: NDArray[np.int64],
    Ts: Array,
    plane: Plane,
    scale: float,
    normals: Array,
    focal_px: float,
    halves: Halves,
) -> tuple[Array, NDArray[np.float32]]:
    """Return how many pixels of the sensor a cell is across its line where a view sees it (M,), and `d_log` (M, 8).

    Args:
        mean: (M, 4), as `associate` returns it.
        view: which view (M,).
        Ts: poses (K, 4, 4) of the views.
        plane: in the world.
        scale: cells per unit.
        normals: of the lines (M, 2).
        focal_px: pixels of the sensor per unit of a bearing.
        halves: on how many cores.
    """
    cells, d_log = np.empty(len(view)), np.empty((len(view), 8), dtype=np.float32)
    bearings, Rs, ts = (np.ascontiguousarray(part) for part in (mean[:, 2:], Ts[:, :3, :3], Ts[:, :3, 3]))
    to_map, d_normal = rotation_to_map(plane.normal), turn_normal_derivative(plane.normal, np.zeros(2))

    def work(start: int, end: int) -> None:
        some = slice(start, end)
        cells_per_bearing(
            bearings[some],
            view[some],
            Rs,
            ts,
            plane.normal,
            plane.distance,
            to_map,
            scale,
            normals[some],
            d_normal,
            cells[some],
            d_log[some],
        )

    halves.both(work, len(view) // 2, len(view))
    return focal_px / cells, d_log


@numba.njit(cache=True, nogil=True)
def weigh(first, px_per_cell, d_log, huber_px, weight, residual, J):
    """Make the rows of distances on the map those of distances on the sensor, in place.

    Args:
        first: of each landmark its first row (L + 1,).
        px_per_cell: of each row (M,).
        d_log: derivative (M, 8) of the logarithm of its inverse.
        huber_px: distance beyond which a row counts less.
        weight: (M,), moved from cells to pixels.
        residual: distance (M,), cells.
        J: its derivative (M, 8); that of the scale, times what is left without the landmark's offset, is taken off.
    """
    for j in range(first.shape[0] - 1):
        total = moment = 0.0
        for i in range(first[j], first[j + 1]):
            off_px = abs(residual[i]) * px_per_cell[i]
            weight[i] *= min(1.0, huber_px / max(off_px, 1e-9)) * px_per_cell[i] ** 2
            total += weight[i]
            moment += weight[i] * residual[i]
        centre = moment / max(total, 1e-9)
        for i in range(first[j], first[j + 1]):
            off = residual[i] - centre
            for q in range(8):
                J[i, q] -= off * d_log[i, q]


@numba.njit(inline="always", **_JIT)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(**_JIT)
def cells_per_bearing(bearings, view, Rs, ts, n, d, R_map_world, scale, normals, d_normal, out, d_log):
    """Write by how many cells the distance to a line grows a unit of bearing across it (M,), and its log's derivative.

    The cell of a bearing is `scale q / q_2` with q = P y, y = R b, `P y = R_map_world (d_c y - t (n . y))` and its last
    entry by d. Across the line, y moves by z = R e, with e the unit vector in the image that crosses it, and the
    distance by

        L = scale (l . P z  q_2 - l . q  (P z)_2) / q_2²

    of which e is the steepest: to first order L does not depend on it.

    Args:
        bearings: (M, 2).
        view: which view each was seen from (M,).
        Rs: rotations (K, 3, 3) of the views, world from camera.
        ts: positions (K, 3).
        n: the plane's normal (3,), world.
        d: its distance.
        R_map_world: rotation (3, 3), held while the normal moves.
        scale: cells per unit.
        normals: l, of the lines on the map (M, 2).
        d_normal: derivative (3, 2) of the plane's normal by its two parameters.
        out: L (M,).
        d_log: derivative (M, 8) of log L by rotation and position, moved in the world, and the plane's normal.
    """
    v = R_map_world[2] / d
    y, z, p, p_z = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    u, s, by_p, by_z = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(bearings.shape[0]):
        R, t = Rs[view[i]], ts[view[i]]
        d_c = d + _dot(t, n)
        for k in range(3):
            y[k] = R[k, 0] * bearings[i, 0] + R[k, 1] * bearings[i, 1] + R[k, 2]
            u[k] = R_map_world[0, k] * normals[i, 0] + R_map_world[1, k] * normals[i, 1]
        ny = _dot(n, y)
        for k in range(3):
            p[k] = d_c * y[k] - t[k] * ny
        lq, q2 = _dot(u, p), _dot(v, p)
        # Its slope by the bearing, in the world: the gradient of l . q / q_2 through P.
        for k in range(3):
            s[k] = u[k] * q2 - v[k] * lq
        st = _dot(s, t)
        for k in range(3):
            s[k] = d_c * s[k] - st * n[k]
        e0, e1 = 0.0, 0.0
        for k in range(3):
            e0 += R[k, 0] * s[k]
            e1 += R[k, 1] * s[k]
        length = np.sqrt(e0 * e0 + e1 * e1)
        for k in range(3):
            z[k] = (R[k, 0] * e0 + R[k, 1] * e1) / length
        nz = _dot(n, z)
        for k in range(3):
            p_z[k] = d_c * z[k] - t[k] * nz
        lq_z, q2_z = _dot(u, p_z), _dot(v, p_z)
        A = lq_z * q2 - lq * q2_z
        out[i] = scale * A / (q2 * q2)
        for k in range(3):
            by_p[k] = (lq_z * v[k] - q2_z * u[k]) / A - 2.0 / q2 * v[k]
            by_z[k] = (q2 * u[k] - lq * v[k]) / A
        pt, zt, py, zz = _dot(by_p, t), _dot(by_z, t), _dot(by_p, y), _dot(by_z, z)
        for k in range(3):
            i1, i2 = (k + 1) % 3, (k + 2) % 3
            # d(P y) = P (phi x y), and the same of z.
            d_log[i, k] = (
                y[i1] * (d_c * by_p[i2] - pt * n[i2])
                - y[i2] * (d_c * by_p[i1] - pt * n[i1])
                + z[i1] * (d_c * by_z[i2] - zt * n[i2])
                - z[i2] * (d_c * by_z[i1] - zt * n[i1])
            )
            d_log[i, 3 + k] = n[k] * (py + zz) - by_p[k] * ny - by_z[k] * nz
        for k in range(2):
            m = d_normal[:, k]
            tm, ym, zm = _dot(t, m), _dot(y, m), _dot(z, m)
            d_log[i, 6 + k] = tm * (py + zz) - pt * ym - zt * zm
