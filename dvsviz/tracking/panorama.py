"""A panorama: the map of a camera that only turns, on planes that touch the unit sphere.

One plane holds what is seen within some 60 degrees of its centre. So the map of a turning camera has several, its
faces: each a `PlanarMap` for itself, made of the remembered windows when the camera turns to it, and made anew when it
comes back. Only the face in use is kept: what the others hold follows from the windows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import align
from dvsviz.tracking.diagnose import agreement, footprint
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.traces import Trace

Array = NDArray[np.float64]


class Panorama:
    """Which faces there are.

    Args:
        first: the plane straight ahead of the first camera.

    Attributes:
        faces: planes at distance 1 in the world, in the order they were made.
        made_at: how many windows were remembered when each was made.
        current: number of the one in use.
    """

    def __init__(self, first: Plane) -> None:
        self.faces = [first]
        self.made_at = [0]
        self.current = 0

    @property
    def plane(self) -> Plane:
        """The face in use."""
        return self.faces[self.current]

    def known_at(self, count: int) -> tuple[Plane, ...]:
        """Return the faces that were made before `count` windows were remembered, whatever was made since."""
        return tuple(p for p, at in zip(self.faces, self.made_at, strict=True) if at < count)

    def turn_to(self, T_world_camera: Array, count: int) -> bool:
        """Take the face for a view, a new one where all are far; return whether it is another than before.

        Args:
            T_world_camera: pose (4, 4).
            count: how many windows are remembered.
        """
        look = T_world_camera[:3, 2]
        away = np.arccos(np.clip([-p.normal @ look for p in self.faces], -1.0, 1.0))
        best, before = int(np.argmin(away)), self.current
        if away[best] > c.FACE_APART_RAD:
            self.faces.append(Plane(normal=_mappable(-look)))
            self.made_at.append(count)
            self.current = len(self.faces) - 1
        elif away[best] < away[before] - c.FACE_LEAD_RAD:
            self.current = best
        return self.current != before

    def earlier(self, traces: Sequence[Trace]) -> int:
        """Return how many windows were remembered when the camera last turned its back on the face in use; 0 if never.

        What came after came round another way: only the earlier windows say where the face was the first time.
        """
        seen = turned_away(self.plane, traces) < c.FACE_SEEN_RAD
        away = np.flatnonzero(~seen)
        before = np.flatnonzero(seen[: away[-1]]) if len(away) else away
        return int(before[-1]) + 1 if len(before) else 0


def nearest(planes: Sequence[Plane], T_world_camera: Array) -> int:
    """Return the number of the plane that a camera at the world's origin looks at most squarely."""
    if len(planes) == 1:
        return 0
    return int(np.argmin([p.normal @ T_world_camera[:3, 2] for p in planes]))


def turned_away(face: Plane, traces: Sequence[Trace]) -> Array:
    """Return how far (N,), rad, the views of windows are turned away from a face's centre."""
    if not traces:
        return np.zeros(0)
    looks = np.stack([t.T_world_camera[:3, 2] for t in traces])
    return np.arccos(np.clip(-looks @ face.normal, -1.0, 1.0))


def is_full(planar_map: PlanarMap, trace: Trace, camera: Camera) -> bool:
    """Return whether a window would write nothing: what it shows of the map is frozen."""
    cells = footprint(planar_map, trace.T_world_camera, camera, columns=5)
    rows, cols = planar_map.exposure.shape
    at = np.floor(cells[np.isfinite(cells[:, 0])] / c.EXPOSURE_CELL_PX)
    limit = c.FACE_REACH * planar_map.px_per_unit / c.EXPOSURE_CELL_PX
    # Beyond the reach nothing is ever written.
    within = np.abs(at + planar_map.origin * planar_map.px_per_unit / c.EXPOSURE_CELL_PX).max(axis=1) < limit - 1
    at = at[within].astype(np.int64)
    if (at < 0).any() or (at >= (cols, rows)).any():
        return False
    return bool((planar_map.exposure[at[:, 1], at[:, 0]] > c.FREEZE_DISPLACEMENT_PX).all())


def loop_error(
    old: PlanarMap, now: PlanarMap, traces: Sequence[Trace], camera: Camera, free: NDArray[np.bool_]
) -> Array | None:
    """Return the rotation (3, 3), world, that puts the last windows on a map that was made before a turn.

    Args:
        old: the map of the face as it was seen the first time.
        now: the map that the windows were tracked on.
        traces: the windows; the last `LOOP_WINDOWS` are asked.
        camera: of the windows.
        free: mask (6,) of rotation and position.

    Returns:
        None where too few of them fit the old map, or they do not agree.
    """
    found: list[Array] = []
    last = traces[-c.LOOP_WINDOWS :]
    wide = np.diag([0.15**-2] * 6)
    for trace in last:
        fits = []
        for planar_map, prior, iterations in (
            (old, wide, c.RELOCALIZE_ITERATIONS),
            (now, None, c.ALIGN_ITERATIONS),
        ):
            aligned = align(
                planar_map,
                trace.bearings,
                trace.t_s - trace.mid_s,
                trace.T_world_camera,
                trace.omega,
                trace.velocity,
                focal_px=camera.focal_px,
                free=free,
                prior=prior,
                iterations=iterations,
            )
            fits.append((agreement(planar_map, aligned, camera).score, aligned))
        if fits[0][0] > c.WEAK_RATIO * fits[1][0] and fits[0][1].inside > c.LOST_INSIDE:
            found.append(se3.log_so3(fits[0][1].T_world_camera[:3, :3] @ trace.T_world_camera[:3, :3].T))
    if 2 * len(found) <= len(last):
        return None
    middle = np.median(np.stack(found), axis=0)
    apart = np.linalg.norm(np.stack(found) - middle, axis=1)
    if np.median(apart) * camera.focal_px > c.LOOP_SPREAD_PX:
        return None
    return se3.exp_so3(middle)


def spread(traces: Sequence[Trace], first: int, error: Array) -> dict[int, Array]:
    """Return poses (4, 4) of all keyframes, by window, after a loop's error was spread over the turn.

    Args:
        traces: all windows.
        first: the first one after the face was left; what came before stays.
        error: rotation (3, 3), world, by which the last one is to be turned; the share of the others grows with the
            angle that the camera had turned by then.
    """
    R = np.stack([t.T_world_camera[:3, :3] for t in traces[first - 1 :]])
    turned = np.concatenate([[0.0], np.cumsum(se3.rotation_angle(np.swapaxes(R[:-1], 1, 2) @ R[1:]))])
    share = np.concatenate([np.zeros(first - 1), turned / max(turned[-1], 1e-9)])
    whole = se3.log_so3(error)
    moved = {
        t.window: se3.pose(se3.exp_so3(s * whole), np.zeros(3)) @ t.T_world_camera
        for t, s in zip(traces, share, strict=True)
        if t.keyframe >= 0
    }
    return moved


def _mappable(normal: Array) -> Array:
    """Return a unit normal, moved off (0, 0, 1), where the rotation to the map is not defined."""
    n = normal / np.linalg.norm(normal)
    if n[2] > 1.0 - 1e-6:
        n = n + np.array([1e-2, 0.0, 0.0])
    return n / np.linalg.norm(n)
