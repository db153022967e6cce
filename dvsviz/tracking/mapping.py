"""The mapper: what the tracker has seen, kept so that it can be corrected.

It holds the traces of past windows, the map built of them, the keyframes among them, and the refinements that move
all three together.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import Keyframe
from dvsviz.tracking import constants as c
from dvsviz.tracking.news import News
from dvsviz.tracking.panorama import Panorama, loop_error, nearest, spread
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.refining import Job, Refiner, Revised
from dvsviz.tracking.traces import Trace, add_to_map, correct, window_poses

Array = NDArray[np.float64]
Sampled = tuple[NDArray[np.float32], Array]


class Mapper(News):
    """Map, traces and keyframes of one tracker.

    Args:
        camera: of the windows.
        free: mask (6,) of rotation and position.
        image_size: (width, height) of the keyframes' images.
        solve_normal: refine the plane's normal too.
        is_panorama: the camera only turns: the map has as many planes as its view needs.
    """

    # May a refinement that the last one goes beyond be left undone; is a stream tracked, which does not wait?
    _may_drop, is_live = True, False

    def __init__(
        self,
        camera: Camera,
        free: NDArray[np.bool_],
        image_size: tuple[int, int],
        *,
        solve_normal: bool,
        is_panorama: bool = False,
    ) -> None:
        super().__init__()
        self.camera = camera
        self.plane = Plane(normal=np.array([0.0, 0.0, -1.0]))
        self.map: PlanarMap | None = None
        self.traces: list[Trace] = []
        self.keyframes: list[Keyframe] = []
        self.refinements = 0
        self.revision = -1
        self.tried_at = 0
        self.job: Job | None = None
        self.must_relocalize = False
        self.panorama = Panorama(self.plane) if is_panorama else None
        self.closed_loops = 0
        self._free = free
        self._refiner = Refiner(camera=camera, free=free, solve_normal=solve_normal, is_panorama=is_panorama)
        self._image_size = image_size
        self._sensor = (camera.height, camera.width)
        self.revision_at_keyframes = 0
        # Where the keyframes are among the traces, how many traces that was read from; poses of the last keyframes.
        self._keyframe_at: list[int] = []
        self._looked_at = 0
        self._anchors: tuple[list[Trace], int, Array] = ([], 0, np.zeros((0, 4, 4)))

    @property
    def live_map(self) -> PlanarMap:
        """The map; there is one after `begin`."""
        if self.map is None:
            raise ValueError("map: expected one after the first window")
        return self.map

    def begin(self, plane: Plane) -> None:
        """Start an empty map on a plane."""
        self.plane = plane if self.panorama is None else self.panorama.plane
        self.map = self._empty(freeze_px=float("inf"))

    def _empty(self, *, freeze_px: float) -> PlanarMap:
        size = np.array([self.camera.width, self.camera.height])
        return PlanarMap(
            self.plane,
            self.camera.focal_px / self.plane.distance,
            -0.5 * size * self.plane.distance / self.camera.focal_px,
            self._sensor,
            freeze_px=freeze_px,
            reach=float("inf") if self.panorama is None else c.FACE_REACH,
        )

    # --- turning -------------------------------------------------------------------------------------------

    def look(self, T_world_camera: Array, *, may_close: bool = True) -> Array | None:
        """Take the face of a panorama that a view shows best.

        Args:
            T_world_camera: pose (4, 4).
            may_close: compare with what was known of the face before the camera turned away from it.

        Returns:
            The turn (4, 4), world, by which the last window was corrected where that closed a loop; else None.
        """
        if self.panorama is None or not self.panorama.turn_to(T_world_camera, len(self.traces)):
            return None
        moved = self._close_loop(self.panorama) if may_close else None
        self._show_face(self.panorama.plane)
        self._publish(self.traces[-1].window)
        return moved

    def _show_face(self, face: Plane) -> None:
        """Make the map of a face from what is remembered."""
        limit = c.FREEZE_DISPLACEMENT_PX if self.refinements else float("inf")
        self.plane, self.map = face, self._refiner.build(self.traces, face, freeze_px=limit)
        self.map.freeze_px = limit

    def _close_loop(self, panorama: Panorama) -> Array | None:
        """Spread the difference between the face as it was left and as it was come back to over the turn between."""
        first = panorama.earlier(self.traces)
        if not first:
            return None
        before = self.traces[-1].T_world_camera
        old = self._refiner.build(self.traces[:first], panorama.plane)
        error = loop_error(old, self.live_map, self.traces, self.camera, self._free)
        if error is None:
            return None
        off_px = float(np.linalg.norm(se3.log_so3(error))) * self.camera.focal_px
        if off_px < c.LOOP_PX:
            return None
        if self.job is not None:
            # It moves what the loop's error is to be spread over: landed first, and asked again.
            self._merge(self.job)
            error = loop_error(
                self._refiner.build(self.traces[:first], panorama.plane),
                self._refiner.build(self.traces[first:], panorama.plane),
                self.traces,
                self.camera,
                self._free,
            )
        if error is not None:
            self.traces = correct(self.traces, spread(self.traces, first, error))
            self.tell_refined(window_poses(self.traces))
            self.closed_loops += 1
            self.tried_at = 0
            self.log(
                self.traces[-1].window,
                "info",
                f"loop closed: {off_px:.1f} px off after {len(self.traces) - first} windows",
            )
        after = self.traces[-1].T_world_camera
        return se3.pose(after[:3, :3] @ before[:3, :3].T, np.zeros(3))

    def to_search(self, attempt: int) -> tuple[PlanarMap, list[Array]]:
        """Return where a lost camera is looked for: a map and the keyframe poses (4, 4) it was seen from.

        Of a panorama one face after the other, those near the last view first.
        """
        poses = [t.T_world_camera for t in self.traces if t.keyframe >= 0 and t.is_trusted]
        if self.panorama is None or len(self.panorama.faces) == 1:
            return self.live_map, poses[:: max(1, -(-len(poses) // c.RELOCALIZE_KEYFRAMES))]
        faces = self.panorama.faces
        order = np.argsort([p.normal @ self.traces[-1].T_world_camera[:3, 2] for p in faces])
        k = int(order[attempt % len(faces)])
        poses = [T for T in poses if nearest(faces, T) == k]
        planar_map = self.live_map
        if k != self.panorama.current:
            planar_map = self._refiner.build(self.traces, faces[k], freeze_px=c.FREEZE_DISPLACEMENT_PX)
        return planar_map, poses[:: max(1, -(-len(poses) // c.RELOCALIZE_KEYFRAMES))]

    # --- growing -------------------------------------------------------------------------------------------

    def remember(self, trace: Trace) -> None:
        """Keep a window that must not write the map."""
        self.traces.append(replace(trace, is_trusted=False))

    def add(self, trace: Trace, image: NDArray[np.float32], overlap: float, densely: Callable[[], Sampled]) -> int:
        """Write a window to the map; return its keyframe number, or -1.

        Args:
            trace: the window.
            image: of its warped events, for a keyframe's picture.
            overlap: with the map.
            densely: gives the events that a keyframe keeps.
        """
        add_to_map(self.live_map, trace, self._sensor, self.camera.matrix)
        number = -1
        if self._is_keyframe(trace, overlap):
            number = len(self.keyframes)
            bearings, t_s = densely()
            trace = replace(trace, keyframe=number, bearings=bearings, t_s=t_s)
            top = float(np.percentile(image[image > 0], 98)) if (image > 0).any() else 1.0
            shown = (np.clip(image / max(top, 1e-6), 0, 1) * 255).astype(np.uint8)
            keyframe = Keyframe(
                keyframe=number,
                window=trace.window,
                t_us=trace.start_us,
                T_world_camera=trace.T_world_start,
                image=np.asarray(cv2.resize(shown, self._image_size), dtype=np.uint8),
            )
            self.keyframes.append(keyframe)
            self.tell_keyframes([keyframe])
        self.traces.append(trace)
        if self.revision < 0 or len(self.keyframes) >= self.revision_at_keyframes + c.REVISION_KEYFRAMES:
            self._publish(trace.window)
        return number

    def take_in(self, traces: Sequence[Trace], keyframes: Sequence[Keyframe]) -> None:
        """Take in windows of another map that are written on this one; the next refinement is of all together."""
        self.traces = sorted([*self.traces, *traces], key=lambda t: t.window)
        self._keyframe_at, self._looked_at, self.tried_at = [], 0, 0
        self.keyframes = [*self.keyframes, *keyframes]
        self.tell_keyframes(keyframes)

    def _is_keyframe(self, trace: Trace, overlap: float) -> bool:
        count = len(self.keyframes)
        anchors = self._anchor_poses()
        if len(anchors) == 0:
            return True
        since_s = (trace.mid_us - self.traces[self._keyframe_at[-1]].mid_us) * 1e-6
        # The first keyframes lie close together: the first refinements repair the start.
        grown = min(1.0, count / c.KEYFRAME_SETTLED)
        if since_s >= c.KEYFRAME_SECONDS * max(grown, 0.2):
            return True
        limit = c.KEYFRAME_DISPLACEMENT * self.camera.width * max(grown, 0.2)
        moved = float(self._view_changes_px(trace.T_world_camera, anchors).min())
        return moved > limit or (overlap < c.OVERLAP_KEYFRAME and moved > 0.3 * limit)

    def _anchor_poses(self, most: int = c.KEYFRAME_COMPARE) -> Array:
        """Return the poses (N, 4, 4) of the last keyframes, in order."""
        for i in range(self._looked_at, len(self.traces)):
            if self.traces[i].keyframe >= 0:
                self._keyframe_at.append(i)
        self._looked_at = len(self.traces)
        known_in, count, poses = self._anchors
        # A refinement puts another list in the place of the traces.
        if known_in is not self.traces or count != len(self._keyframe_at):
            last = [self.traces[i].T_world_camera for i in self._keyframe_at[-most:]]
            poses = np.array(last).reshape(-1, 4, 4)
            self._anchors = (self.traces, len(self._keyframe_at), poses)
        return poses

    def _view_changes_px(self, T: Array, Ts: Array) -> Array:
        """Return about how far (px) the image moved between a view (4, 4) and each of others (N, 4, 4)."""
        # The trace of R^T R' is 1 + 2 cos(angle).
        cosine = 0.5 * (Ts[:, :3, :3].reshape(-1, 9) @ T[:3, :3].ravel() - 1.0)
        turn = np.arccos(np.clip(cosine, -1.0, 1.0))
        shift = np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1)
        return self.camera.focal_px * (turn + shift / self.plane.distance)

    def _publish(self, window: int, planar_map: PlanarMap | None = None) -> None:
        self.revision += 1
        self.revision_at_keyframes = len(self.keyframes)
        self.tell_revision((planar_map or self.live_map).revision(self.revision, window))

    # --- refining ------------------------------------------------------------------------------------------

    def advance(self, trace: Trace) -> Trace:
        """Begin a refinement that is due, merge one whose window has come; return the trace as it is known then.

        It is merged at a window that was fixed when it began: how fast the machine is does not change the result. A
        live stream does not wait: there it is merged when it is ready.
        """
        if self.job is None and self._due():
            count = len(self.keyframes)
            self.begin_refinement(
                len(self.traces), trace.window + c.REFINE_WINDOWS * max(0, count - c.REFINE_AT_ONCE)
            )
            self.tried_at = count
        if self.job is None or trace.window < self.job.land_at or (self.is_live and not self.job.future.done()):
            return trace
        self._merge(self.job)
        for kept in reversed(self.traces):
            if kept.window == trace.window:
                return kept
        return trace

    def begin_refinement(self, count: int, land_at: int) -> None:
        """Start a refinement of the first `count` traces that is merged at window `land_at`."""
        dropped, awaited = threading.Event(), threading.Event()
        pool = ThreadPoolExecutor(1, thread_name_prefix="refinement")
        future = pool.submit(
            self._refiner.revise,
            tuple(self.traces[:count]),
            self.plane,
            first=self.refinements == 0,
            faces=() if self.panorama is None else self.panorama.known_at(count),
            most=c.REFINE_LIVE_VIEWS if self.is_live else c.REFINE_MAX_VIEWS,
            dropped=dropped,
            awaited=awaited,
        )
        pool.shutdown(wait=False)
        self.job = Job(count=count, land_at=land_at, future=future, dropped=dropped, awaited=awaited)

    def _due(self) -> bool:
        """Return whether enough keyframes were added for the next refinement."""
        count = len(self.keyframes)
        return any(self.tried_at < at <= count for at in c.REFINE_AT) and self._is_spread

    @property
    def _is_spread(self) -> bool:
        """True where the image moved enough between the first keyframe and the one farthest from it."""
        anchors = [t.T_world_camera for t in self.traces if t.keyframe >= 0]
        if not anchors:
            return False
        moved = float(self._view_changes_px(anchors[0], np.stack(anchors)).max())
        return moved >= c.REFINE_SPREAD * self.camera.width

    def _merge(self, job: Job) -> None:
        self.job = None
        job.awaited.set()
        revised = job.future.result()
        window = self.traces[-1].window
        self.log(window, "info", revised.text)
        if revised.planar_map is None:
            return
        later = self._refiner.append(
            revised.planar_map, self.traces[job.count - 1], revised.traces[-1], self.traces[job.count :]
        )
        self._take_over(revised, [*revised.traces, *later])
        if self.panorama is not None and self.plane is not self.panorama.plane:
            self._show_face(self.panorama.plane)
        self._publish(window)

    def _take_over(self, revised: Revised, traces: list[Trace]) -> None:
        self.traces, self.plane, self.map = traces, revised.plane, revised.planar_map
        self.refinements += 1
        self.tell_refined(window_poses(self.traces))

    def finish(self, *, refine: bool) -> None:
        """Refine once more with everything that was seen (if asked), and publish the last map."""
        if self.map is None or not self.traces:
            return
        everything = refine and len(self.keyframes) >= c.REFINE_AT[0] and self._is_spread
        if self.job is not None and everything and self._may_drop:
            # The last refinement does what this one does, with more.
            self.job.dropped.set()
            self.job.future.result()
            self.job = None
        elif self.job is not None:
            self._merge(self.job)
        if refine:
            if everything:
                faces = () if self.panorama is None else tuple(self.panorama.faces)
                revised = self._refiner.revise(
                    self.traces,
                    self.plane,
                    first=self.refinements == 0,
                    last=True,
                    faces=faces,
                    most=c.REFINE_LAST_VIEWS,
                )
            else:
                revised = self._refiner.settle(self.traces, self.plane)
            self.log(self.traces[-1].window, "info", revised.text)
            if revised.planar_map is not None:
                self._take_over(revised, list(revised.traces))
        if self.panorama is not None:
            for face in (p for p in self.panorama.faces if p is not self.plane):
                self._publish(self.traces[-1].window, self._refiner.build(self.traces, face))
        self._publish(self.traces[-1].window)
