"""A refinement as one job: windows adjusted together, those between carried along, the map made anew.

The job reads a frozen copy of what the tracker knew and gives back what should take its place, so that it can run
beside the tracker. What it costs is the tracker's time only where it has to be waited for.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import align_each
from dvsviz.tracking.halves import ONE_CORE, Halves
from dvsviz.tracking.panorama import is_full, nearest, turned_away
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.refine import View, refine
from dvsviz.tracking.sampling import thinned
from dvsviz.tracking.traces import HELD, Trace, add_to_map, correct

Array = NDArray[np.float64]
Item = TypeVar("Item")

# Level of the map from which on they are aligned: they lie near.
_FIRST_LEVEL = 1


def _always() -> bool:
    return True


def evenly(items: list[Item], most: int) -> list[Item]:
    """Return at most so many of the items, in order, the first and the last among them."""
    if len(items) <= most:
        return items
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Revised:
    """What a refinement made of the traces it was given.

    Attributes:
        traces: the same windows, re-expressed.
        plane: the refined plane; of a panorama the face of the last window.
        planar_map: the map made of them on that plane; None where nothing was gained and everything stays as it is.
        text: what happened, for the log.
        accepted: True where the held-out disagreement fell; where it did not, poses are only put back on the map.
    """

    traces: tuple[Trace, ...]
    plane: Plane
    planar_map: PlanarMap | None
    text: str
    accepted: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """A refinement that runs.

    Attributes:
        count: how many traces it was given.
        land_at: window at which it is merged.
        future: its result.
        dropped: set where nobody wants it any more.
        awaited: set where the tracker waits for it.
    """

    count: int
    land_at: int
    future: Future[Revised]
    dropped: threading.Event
    awaited: threading.Event


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refiner:
    """What does not change from one refinement to the next.

    Attributes:
        camera: of the windows.
        free: mask (6,) of rotation and position.
        solve_normal: refine the plane's normal too.
        is_panorama: the map is a panorama's: a plane holds a part of what is seen.
    """

    camera: Camera
    free: NDArray[np.bool_]
    solve_normal: bool
    is_panorama: bool = False

    def revise(
        self,
        traces: Sequence[Trace],
        plane: Plane,
        *,
        first: bool,
        last: bool = False,
        faces: Sequence[Plane] = (),
        most: int = c.REFINE_MAX_VIEWS,
        dropped: threading.Event | None = None,
        awaited: threading.Event | None = None,
    ) -> Revised:
        """Return what takes the place of the traces and the map.

        Args:
            traces: all windows so far, keyframes among them.
            plane: as known.
            first: also make the map anew where the refinement is refused: the first one was written while drifting.
            last: at the recording's end: with more rounds.
            faces: the planes of a panorama, in place of the one plane.
            most: windows that are refined; the others are carried along.
            dropped: set where the result is not wanted any more: then nothing is revised.
            awaited: set where the tracker waits for the result, and both cores are free; always where None.
        """
        halves = Halves(is_awaited=_always if awaited is None else awaited.is_set)
        planes = tuple(faces) or (plane,)
        chosen = self._chosen(traces, most)
        limit = (c.REFINE_LAST_EVENTS if last else c.REFINE_EVENTS) // len(chosen)
        rounds, closing = c.REFINE_ROUNDS if last else c.REFINE_ROUNDS_LATER, c.REFINE_CLOSING
        if len(chosen) < c.REFINE_EARLY_VIEWS:
            rounds *= c.REFINE_EARLY_ROUNDS
            closing = rounds // 2
        result = refine(
            [self._view(t, planes, traces[0].mid_us, limit) for t in chosen],
            planes[0],
            self.camera.focal_px,
            free=self.free,
            solve_normal=self.solve_normal,
            rounds=rounds,
            closing=closing,
            faces=faces if len(faces) > 1 else (),
            rounds_with_all=c.REFINE_ROUNDS_WITH_ALL if last else 0,
            stop=dropped.is_set if dropped is not None else None,
            halves=halves,
        )
        if dropped is not None and dropped.is_set():
            return Revised(traces=tuple(traces), plane=plane, planar_map=None, text="dropped", accepted=False)
        text = (
            f"refinement of {len(chosen)} windows: disagreement {result.before_px:.3f} to {result.after_px:.3f} px, "
            f"{'accepted' if result.accepted else 'refused'}"
        )
        kept = list(traces)
        if result.accepted:
            kept = correct(kept, {t.window: T for t, T in zip(chosen, result.Ts_world_camera, strict=True)})
            planes = (result.plane,) if len(planes) == 1 else planes
        elif not first:
            return Revised(traces=tuple(traces), plane=plane, planar_map=None, text=text, accepted=False)
        planar_map = self.build(kept, planes[nearest(planes, kept[-1].T_world_camera)], halves=halves)
        return Revised(
            traces=tuple(kept), plane=planar_map.plane, planar_map=planar_map, text=text, accepted=result.accepted
        )

    @staticmethod
    def _chosen(traces: Sequence[Trace], most: int) -> list[Trace]:
        """Return the windows that are refined, in order: keyframes, and others evenly between them."""
        keyframes = [i for i, t in enumerate(traces) if t.keyframe >= 0]
        others = [i for i, t in enumerate(traces) if t.keyframe < 0]
        keyframes = evenly(keyframes, most // 2)
        others = evenly(others, most - len(keyframes))
        return [traces[i] for i in sorted(keyframes + others)]

    @staticmethod
    def _view(trace: Trace, planes: Sequence[Plane], start_us: int, limit: int) -> View:
        """Return a window as it is refined, with at most `limit` events.

        One that was weak is only carried along by those around it.
        """
        bearings = np.zeros((0, 2), dtype=np.float32)
        if trace.is_trusted and trace.keyframe != HELD:
            bearings = trace.deskewed(
                planes[nearest(planes, trace.T_world_camera)], -(-len(trace.bearings) // max(1, limit))
            )
        t_s = (trace.mid_us - start_us) * 1e-6
        return View(bearings=bearings, T_world_camera=trace.T_world_camera, t_s=t_s)

    def settle(self, traces: Sequence[Trace], plane: Plane) -> Revised:
        """Return the windows refined together with all their events, pulled to the first pose; the normal is held.

        Where the image hardly moved, turning and moving sideways look alike, and what a refinement would leave only for
        good reason is itself in doubt: held to the first pose, one answer does not depend on how windows are cut.
        """
        chosen = self._chosen(traces, c.REFINE_MAX_VIEWS)
        result = refine(
            [self._view(t, (plane,), traces[0].mid_us, len(t.bearings)) for t in chosen],
            plane,
            self.camera.focal_px,
            free=self.free,
            solve_normal=False,
            rounds=c.SETTLE_ROUNDS,
            is_anchored=True,
            halves=Halves(is_awaited=_always),
        )
        kept = correct(traces, {t.window: T for t, T in zip(chosen, result.Ts_world_camera, strict=True)})
        return Revised(
            traces=tuple(kept),
            plane=plane,
            planar_map=self.build(kept, plane),
            text=f"{len(chosen)} windows of little motion refined together, held to the first pose",
            accepted=False,
        )

    def build(
        self,
        traces: Sequence[Trace],
        plane: Plane,
        *,
        freeze_px: float = float("inf"),
        halves: Halves = ONE_CORE,
    ) -> PlanarMap:
        """Return the map of all traces, frozen where it was seen well.

        Args:
            traces: in time order; of a panorama those that show something of the face are taken.
            plane: on which.
            freeze_px: a block swept by more is no longer written while the map is made.
            halves: on how many cores.
        """
        if self.is_panorama:
            away = turned_away(plane, traces)
            traces = [t for t, angle in zip(traces, away, strict=True) if angle < c.FACE_SEEN_RAD]
        traces = [t for t in traces if t.is_trusted]
        if np.isfinite(freeze_px):
            # What is written depends on what was written before.
            planar_map = self._written(traces, plane, freeze_px)
        else:
            planar_map, other = halves.both(
                lambda start, end: self._written(traces[start:end], plane, freeze_px), len(traces) // 2, len(traces)
            )
            planar_map.take_in(other)
        planar_map.freeze_px = c.FREEZE_DISPLACEMENT_PX
        planar_map.settle()
        planar_map.prepare(_FIRST_LEVEL)
        return planar_map

    def _written(self, traces: Sequence[Trace], plane: Plane, freeze_px: float) -> PlanarMap:
        """Return a map with some traces on it."""
        size = np.array([self.camera.width, self.camera.height])
        planar_map = PlanarMap(
            plane,
            self.camera.focal_px / plane.distance,
            -0.5 * size * plane.distance / self.camera.focal_px,
            (self.camera.height, self.camera.width),
            freeze_px=freeze_px,
            reach=c.FACE_REACH if self.is_panorama else float("inf"),
        )
        for trace in traces:
            if np.isfinite(freeze_px) and is_full(planar_map, trace, self.camera):
                continue
            add_to_map(planar_map, trace, (self.camera.height, self.camera.width), self.camera.matrix)
        return planar_map

    def append(self, planar_map: PlanarMap, before: Trace, after: Trace, later: Sequence[Trace]) -> list[Trace]:
        """Return windows that were tracked meanwhile, moved along and added to the revised map.

        Args:
            planar_map: of the refinement; it grows.
            before: the last window the refinement was given, as it was then.
            after: the same as refined.
            later: the windows after it, in order.
        """
        R = after.T_world_camera[:3, :3] @ before.T_world_camera[:3, :3].T
        shift = after.T_world_camera[:3, 3] - before.T_world_camera[:3, 3]
        sensor, appended = (self.camera.height, self.camera.width), []
        for trace in later:
            T = trace.T_world_camera
            # It keeps its own velocity, in the camera's frame: the difference of two poses that were aligned anew is
            # noise where the texture says little, and the tracker would fly on with it.
            moved = replace(trace, T_world_camera=se3.pose(R @ T[:3, :3], T[:3, 3] + shift))
            # Round the corner of a panorama there is nothing of this face to align with.
            near = not self.is_panorama or turned_away(planar_map.plane, [moved])[0] < c.FACE_APART_RAD
            if near:
                moved = replace(moved, T_world_camera=self._aligned(planar_map, [moved])[0])
            appended.append(moved)
            if moved.is_trusted and near:
                add_to_map(planar_map, moved, sensor, self.camera.matrix)
        return appended

    def _aligned(self, planar_map: PlanarMap, traces: Sequence[Trace]) -> Array:
        picks = [np.zeros(0, dtype=np.int64) if t.keyframe == HELD else thinned(len(t.bearings)) for t in traces]
        found = align_each(
            planar_map,
            [t.bearings[pick] for t, pick in zip(traces, picks, strict=True)],
            [t.t_s[pick] - t.mid_s for t, pick in zip(traces, picks, strict=True)],
            np.stack([t.T_world_camera for t in traces]),
            np.stack([t.omega for t in traces]),
            np.stack([t.velocity for t in traces]),
            focal_px=self.camera.focal_px,
            free=self.free,
            first_level=_FIRST_LEVEL,
            to_lines=True,
        )
        return np.array([one.T_world_camera for one in found])
