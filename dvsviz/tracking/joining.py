"""How two maps of one plane lie to each other, and whether they really do.

Both maps know the plane, so what is between them is a similarity of its points: a turn about the normal, a scale and a
shift. A window that was found on both maps shows each point of its image on both: a few windows give the four numbers
by least squares, and how far they disagree, in pixels. What is so found is believed only where other windows, put on
the first map by it, lie on that map's edges beyond chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import warp_points
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera, rotation_to_map
from dvsviz.session.records import Keyframe
from dvsviz.tracking import constants as c
from dvsviz.tracking import second_constants as own
from dvsviz.tracking.align import align_each
from dvsviz.tracking.diagnose import agreement, seen_by_chance
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.refining import evenly
from dvsviz.tracking.sampling import thinned
from dvsviz.tracking.traces import HELD, Trace, add_to_map

Array = NDArray[np.float64]
Pair = tuple[Array, Array]
"""Poses (4, 4) of one window in the first and in the second world."""
# Pixels along the width at which it is asked what a map has seen of a view.
_COLUMNS = 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Join:
    """The second world in the first: `p_first = scale * R_first_second @ p_second + t_first_second`.

    Attributes:
        scale: lengths in the first world by those in the second.
        R_first_second: rotation (3, 3).
        t_first_second: shift (3,).
    """

    scale: float
    R_first_second: Array
    t_first_second: Array

    def pose(self, T_second_camera: Array) -> Array:
        """Return a pose (4, 4) of the second world in the first."""
        R, t = T_second_camera[:3, :3], T_second_camera[:3, 3]
        return se3.pose(self.R_first_second @ R, self.scale * (self.R_first_second @ t) + self.t_first_second)

    def trace(self, trace: Trace, keyframe: int) -> Trace:
        """Return a window of the second map in the first world.

        Args:
            trace: the window.
            keyframe: its keyframe number there.
        """
        T = self.pose(trace.T_world_camera)
        return replace(trace, T_world_camera=T, velocity=self.scale * trace.velocity, keyframe=keyframe)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """What the windows say of a join.

    Attributes:
        join: as the windows that lie on both maps have it.
        windows: how many do.
        score: their mean agreement with the first map, by its usual score.
        off_px: RMS distance of their image points between the two maps.
        elsewhere: how well they lie on another place of the first map, by how well they lie here (`rival`).
        is_sure: True where the maps may be joined.
    """

    join: Join
    windows: int
    score: float
    off_px: float
    elsewhere: float
    is_sure: bool


def moved(
    traces: Sequence[Trace], keyframes: Sequence[Keyframe], join: Join, first_number: int
) -> tuple[list[Trace], list[Keyframe]]:
    """Return windows of the second map and the keyframes among them in the first world, numbered anew.

    Args:
        traces: in time order.
        keyframes: of the second map.
        join: where it lies.
        first_number: of the keyframes.
    """
    images = {k.window: k.image for k in keyframes}
    out: list[Trace] = []
    made: list[Keyframe] = []
    for trace in traces:
        number = first_number + len(made) if trace.keyframe >= 0 else trace.keyframe
        out.append(join.trace(trace, number))
        if number >= 0:
            made.append(
                Keyframe(
                    keyframe=number,
                    window=trace.window,
                    t_us=trace.start_us,
                    T_world_camera=out[-1].T_world_start,
                    image=images[trace.window],
                )
            )
    return out, made


def write(traces: Sequence[Trace], planar_map: PlanarMap, camera: Camera) -> None:
    """Write windows that are in the map's world to it, where it is not frozen."""
    for trace in (t for t in traces if t.is_trusted):
        add_to_map(planar_map, trace, (camera.height, camera.width), camera.matrix)
    planar_map.settle()


def share_seen(planar_map: PlanarMap, T_world_camera: Array, camera: Camera) -> float:
    """Return the share of a view from a pose (4, 4) that the map has seen."""
    return seen_by_chance(planar_map, T_world_camera, camera, _COLUMNS)[1]


def rival(planar_map: PlanarMap, traces: Sequence[Trace], camera: Camera) -> float:
    """Return how well windows lie on the map elsewhere, at best, by how well they lie where they are: 1 is a wallpaper.

    Their events are correlated with the map over all shifts. A pattern that repeats fits as well a period further on,
    and nobody knows which of the places is the right one.

    Args:
        planar_map: the map.
        traces: windows in its world.
        camera: of the windows.
    """
    k = c.RELOCALIZE_REDUCTION
    level = planar_map.level(0)[::k, ::k]
    seen = np.kron(planar_map.exposure > 0, np.ones((c.EXPOSURE_CELL_PX // k, c.EXPOSURE_CELL_PX // k), bool))
    image = np.zeros_like(level)
    for trace in traces:
        cells = warp_points(trace.bearings, trace.t_s, trace.warp(planar_map.plane, planar_map.projection))
        x, y = np.round(cells.T / k).astype(np.int64)
        ok = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
        np.add.at(image, (y[ok], x[ok]), 1.0)
    image = np.minimum(image / max(1e-6, float(np.percentile(image[image > 0], 70))), 1.0)
    where = image > 0
    # Edges against what lies between them, in the part that the windows show.
    shown = cv2.dilate(where.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    flat = np.where(shown, image - image[shown].mean(), 0.0)
    texture = np.where(seen, level - level[seen].mean(), 0.0)
    size = tuple(cv2.getOptimalDFTSize(2 * n) for n in level.shape)
    found = np.fft.irfft2(np.fft.rfft2(texture, s=size) * np.conj(np.fft.rfft2(flat, s=size)), s=size)
    near = round(own.JOIN_RIVAL_PX / k)
    rows, cols = (np.minimum(np.arange(n), n - np.arange(n)) for n in size)
    here = (rows[:, None] <= near) & (cols <= near)
    return float(found[~here].max() / max(float(found[here].max()), 1e-9))


def plane_points(T_world_camera: Array, plane: Plane, camera: Camera) -> NDArray[np.complex128]:
    """Return where nine rays of a view meet the plane: u + iv (9,) in the map frame, in the world's units."""
    x = (np.array([0.1, 0.5, 0.9]) * camera.width - camera.cx) / camera.fx
    y = (np.array([0.1, 0.5, 0.9]) * camera.height - camera.cy) / camera.fy
    rays = np.column_stack([np.tile(x, 3), np.repeat(y, 3), np.ones(9)])
    p = rays @ homography_map_camera(T_world_camera, plane).T
    return (p[:, 0] + 1j * p[:, 1]) / p[:, 2]


def fit(pairs: Sequence[Pair], first: Plane, second: Plane, camera: Camera) -> tuple[Join, Array]:
    """Return the similarity that takes the second plane's points to the first one's, and how far off each window is.

    With `w` and `z` the points as complex numbers, `w = a z + b`: `a` turns and scales, `b` shifts. The height above
    the plane follows from its being one and the same.

    Args:
        pairs: of each window.
        first: the plane in the first world.
        second: in the second.
        camera: of the windows.

    Returns:
        The join, and the RMS distance (N,) of each window's points, px.
    """
    w = np.stack([plane_points(T, first, camera) for T, _ in pairs])
    z = np.stack([plane_points(T, second, camera) for _, T in pairs])
    to_w, to_z = w - w.mean(), z - z.mean()
    a = complex((np.conj(to_z) * to_w).sum() / (np.abs(to_z) ** 2).sum())
    b = complex(w.mean() - a * z.mean())
    depth = np.array([first.seen_from(T).distance for T, _ in pairs])
    off = np.abs(w - a * z - b) * camera.focal_px / np.maximum(depth, 1e-3)[:, None]
    turn = se3.exp_so3(np.array([0.0, 0.0, np.angle(a)]))
    scale, R_map_first = abs(a), rotation_to_map(first.normal)
    join = Join(
        scale=scale,
        R_first_second=R_map_first.T @ turn @ rotation_to_map(second.normal),
        t_first_second=R_map_first.T @ np.array([b.real, b.imag, first.distance - scale * second.distance]),
    )
    return join, np.sqrt((off**2).mean(axis=1))


def agreeing(pairs: Sequence[Pair], first: Plane, second: Plane, camera: Camera) -> Join | None:
    """Return the join that the last window and enough others agree on; None where there is none.

    Args:
        pairs: of windows that were found on both maps, in time order.
        first: the plane in the first world.
        second: in the second.
        camera: of the windows.
    """
    limit = own.JOIN_OFF * camera.width
    last = len(pairs) - 1
    if last + 1 < own.JOIN_SIGHTINGS:
        return None
    same = [k for k in range(last) if fit([pairs[k], pairs[last]], first, second, camera)[1].max() < limit]
    chosen = [*same, last]
    if len(chosen) < own.JOIN_SIGHTINGS:
        return None
    join, off = fit([pairs[k] for k in chosen], first, second, camera)
    middles = np.array([plane_points(pairs[k][0], first, camera)[4] for k in chosen])
    depth = first.seen_from(pairs[last][0]).distance
    # Views of one place repeat each other's mistake.
    spread_px = float(np.abs(middles - middles[-1]).max()) * camera.focal_px / max(depth, 1e-3)
    return join if off.max() < limit and spread_px > own.JOIN_SPREAD * camera.width else None


def verify(
    join: Join,
    traces: Sequence[Trace],
    second: Plane,
    planar_map: PlanarMap,
    camera: Camera,
    free: NDArray[np.bool_],
    good_score: float,
) -> Verdict:
    """Return what the windows of the second map say of a join: those that should lie on the first map are put there.

    All of them are asked, not only those by which the join was found: where two walls look alike in one place they do
    not in the next.

    Args:
        join: to be judged.
        traces: windows of the second map.
        second: its plane.
        planar_map: the first map.
        camera: of the windows.
        free: mask (6,) of rotation and position.
        good_score: running score of good windows on the first map.
    """
    some = evenly([t for t in traces if t.is_trusted and t.keyframe != HELD], own.JOIN_LOOKED_AT)
    on_both = [t for t in some if share_seen(planar_map, join.pose(t.T_world_camera), camera) > own.JOIN_INSIDE]
    on_both = evenly(on_both, own.JOIN_WINDOWS)
    if len(on_both) < own.JOIN_SIGHTINGS:
        return Verdict(join=join, windows=len(on_both), score=0.0, off_px=np.inf, elsewhere=1.0, is_sure=False)
    picks = [thinned(len(t.bearings)) for t in on_both]
    found = align_each(
        planar_map,
        [t.bearings[pick] for t, pick in zip(on_both, picks, strict=True)],
        [t.t_s[pick] - t.mid_s for t, pick in zip(on_both, picks, strict=True)],
        np.stack([join.pose(t.T_world_camera) for t in on_both]),
        np.stack([t.omega for t in on_both]),
        np.stack([join.scale * t.velocity for t in on_both]),
        focal_px=camera.focal_px,
        free=free,
        prior=np.diag([own.JOIN_PRIOR**-2] * 6),
    )
    scores = np.array([agreement(planar_map, one, camera).score for one in found])
    ratio = scores / max(good_score, 1e-3)
    pairs = [(one.T_world_camera, t.T_world_camera) for one, t in zip(found, on_both, strict=True)]
    better, off = fit(pairs, planar_map.plane, second, camera)
    off_px = float(np.sqrt((off**2).mean()))
    there = [replace(join.trace(t, -1), T_world_camera=T) for t, (T, _) in zip(on_both, pairs, strict=True)]
    elsewhere = rival(planar_map, there, camera)
    is_sure = (
        float(ratio.mean()) > c.RELOCALIZE_SCORE
        and float((ratio > c.WEAK_RATIO).mean()) >= own.JOIN_SHARE
        and off_px < own.JOIN_FIT * camera.width
        and elsewhere < own.JOIN_RIVAL
    )
    return Verdict(
        join=better,
        windows=len(on_both),
        score=float(ratio.mean()),
        off_px=off_px,
        elsewhere=elsewhere,
        is_sure=is_sure,
    )
