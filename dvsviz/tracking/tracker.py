r"""The tracker: predict, align, judge, map, keyframe, refine, and find the way back.

    window -> predict -> align with the map -> judge -> status
                                                |  \\
              map <- add <- velocity <--- good  \   lost -> relocalize
               ^                            |
               +---- refine <- keyframe <---+

`Tracker.step` reads as this diagram. A tracker knows nothing of files or viewers: it takes windows and returns results,
and `take_updates` hands over keyframes, map revisions and refined poses.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.contrast.iwe import sample_window
from dvsviz.events.inertial import usable_imu
from dvsviz.events.recording import EventSource, Imu
from dvsviz.events.windows import EventWindow
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.session.records import Cause, Failure, Status, TrackerUpdates, WindowResult
from dvsviz.tracking import constants as c
from dvsviz.tracking import diagnose
from dvsviz.tracking import relief_constants as rc
from dvsviz.tracking.align import free_parameters
from dvsviz.tracking.failures import FailureWatch, cause_of
from dvsviz.tracking.finder import PoseFinder
from dvsviz.tracking.gyro import Gyro
from dvsviz.tracking.judging import judge
from dvsviz.tracking.keyframe_map import mapper_of
from dvsviz.tracking.measure import measure
from dvsviz.tracking.noise import without_noise
from dvsviz.tracking.relief_planarity import moved_by_plane
from dvsviz.tracking.second_map import SecondMap
from dvsviz.tracking.state import Motion, pack, unpack
from dvsviz.tracking.traces import HELD
from dvsviz.tracking.translation import ReliefOdometry

Array = NDArray[np.float64]


class Tracker:
    """Tracks a camera before a plane, window by window.

    Args:
        camera: the calibrated camera.
        config: settings; the defaults need none.
        imu: the recording's, used where `config.imu` is `auto`.

    Attributes:
        stretch: how much more than the wanted image motion a window may cover, for a stream that is behind.
    """

    def __init__(self, camera: Camera, config: TrackerConfig | None = None, imu: Imu | None = None) -> None:
        # Sharp lenses have pixels to spare: the tracker's images have as many as its accuracy can use.
        self.camera = camera.reduced(c.FOCAL_PX)
        self._sensor = (camera.width, camera.height)
        self._most_events = round(c.WINDOW_EVENTS_MAX * max(1.0, camera.width * camera.height / c.WINDOW_PIXELS))
        self.config = config or TrackerConfig()
        self._free = free_parameters(self.config.motion)
        self._mapper = mapper_of(self.config, self.camera, self._free, (camera.width, camera.height))
        self._motion = Motion.start(self._free)
        self.stretch = 1.0
        self._failures = FailureWatch()
        usable = usable_imu(imu)[0] if imu is not None and self.config.imu == "auto" else None
        self._gyro = None if usable is None else Gyro(usable)
        self._finder = PoseFinder(
            camera=self.camera,
            config=self.config,
            free=self._free,
            mapper=self._mapper,
            motion=self._motion,
            failures=self._failures,
            gyro=self._gyro,
        )
        # A panorama grows with the camera, and mode contrast has its own way back.
        has_second = self.config.mode == "map" and self.config.motion in ("planar", "auto")
        self._second = SecondMap(finder=self._finder) if has_second else None
        # A camera that only turns sees no depth.
        uneven = rc.RELIEF_UNEVEN_TOLD if self.config.motion == "planar" else rc.RELIEF_UNEVEN
        self._relief = ReliefOdometry(self.camera, uneven) if self.config.motion != "rotation" else None

    @property
    def window_size(self) -> int:
        """Events that the next window should have: the configured number, or by the image's motion."""
        if self.config.window is not None:
            return self.config.window
        size = (self._second.window_size if self._second is not None else None) or self._motion.size
        return int(np.clip(size * self.stretch, c.WINDOW_EVENTS_MIN, self._most_events))

    @property
    def status(self) -> Status:
        """What is known about the last pose."""
        return self._motion.status

    def hurry(self) -> None:
        """Never wait for a refinement, as before a live stream: results then depend on the machine's speed."""
        self._mapper.is_live = True

    def step(self, window: EventWindow) -> WindowResult:
        """Return the result of one window; windows are given in order, each once."""
        clock = time.perf_counter()
        recorded = window
        window, alike = without_noise(recorded, *self._sensor)
        is_noise = alike < c.NOISE_ALIKE
        sampled = sample_window(window, c.TRACE_EVENTS, self.config.seed)
        mid_us = window.start_us + (window.end_us - window.start_us) // 2
        was = self._motion.status
        # What is far moves little and fires alone: depth is asked of all events.
        note = "" if is_noise else self._look_for_depth(recorded)
        relief = self._relief if self._drifts else None
        if relief is not None:
            trace, alignment = self._finder.drift(relief, window, sampled, mid_us), None
        elif self._finder.waits(alike):
            trace, alignment = self._finder.wait(window, sampled, mid_us), None
        elif self._mapper.map is None or self._mapper.map.adds == 0:
            trace, alignment = self._finder.start(window, sampled, mid_us), None
        elif self._motion.status in (Status.LOST, Status.RELOCALIZING):
            if self._second is not None:
                trace, alignment, note = self._second.search(
                    window, sampled, mid_us, len(recorded), is_noise=is_noise
                )
            else:
                trace, alignment, note = self._finder.search(window, sampled, mid_us, is_noise=is_noise)
        else:
            trace, alignment = self._finder.follow(window, sampled, mid_us)
        trace = replace(trace, events=len(recorded), heard=len(window) / len(recorded))
        images = measure(self.camera, self._mapper.plane, window, trace)
        bridged = self._finder.bridge(trace, alignment, images)
        if bridged is not None:
            trace, judged = bridged
        else:
            judged = judge(
                self._motion,
                self._mapper,
                self._free,
                trace,
                alignment,
                images,
                None if relief is None else relief.is_sharp,
            )
            doubted = self._finder.learn_bias(trace, was)
            if doubted:
                self._mapper.log(window.index, "warning", doubted)
        if judged.note:
            note = judged.note
        overlap = diagnose.overlap(self._mapper.live_map, images, trace.T_world_camera, self.camera)
        used = self._mapper.revision
        failed = self._failures.observe(
            window.index,
            self._motion.status,
            judged.score,
            cause_of(judged, images, alignment, trace.events, self._motion.good_score, self._is_uneven),
        )
        if failed is not None:
            self._mapper.tell(failed)
        if note and self._motion.status is Status.LOST and self._failures.is_unexplained:
            self._failures.look_closer(trace, self._finder.contrast(window), self.camera.focal_px)
        keyframe = -1
        waits = trace.keyframe == HELD
        if judged.is_trusted or (alignment is None and self._motion.status is Status.INITIALIZING and not waits):
            keyframe = self._mapper.add(
                trace,
                images.warped,
                overlap,
                lambda: sample_window(window, c.KEYFRAME_EVENTS, self.config.seed),
            )
        elif self._motion.status is Status.WEAK or (waits and self._mapper.traces):
            self._mapper.remember(trace)
        if relief is None:
            before = trace
            trace = self._mapper.advance(trace)
            if self._gyro is not None and trace is not before:
                self._gyro.forget_anchor()
        if self._mapper.must_relocalize:
            self._mapper.must_relocalize, self._motion.status = False, Status.LOST
        if self._motion.status not in (Status.LOST, Status.RELOCALIZING):
            self._motion.T_world_camera, self._motion.omega, self._motion.velocity = (
                trace.T_world_camera,
                trace.omega,
                trace.velocity,
            )
            self._motion.t_us = mid_us
        is_lost = self._motion.status in (Status.LOST, Status.RELOCALIZING)
        if not is_lost and not is_noise:
            wanted_px = c.WINDOW_DISPLACEMENT * self.camera.width
            # A window with less motion would not show depth.
            clear = self._motion.status in (Status.TRACKING, Status.INITIALIZING) and not self._is_undecided
            if clear and images.edge_pixels >= c.WINDOW_EDGE_PIXELS:
                speed = images.displacement_px / max(window.duration_s, 1e-6)
                least_px, most_px = (share * self.camera.width for share in c.WINDOW_DISPLACEMENTS)
                wanted_px = min(wanted_px, max(least_px, speed * c.WINDOW_SECONDS))
                wanted_px = max(wanted_px, min(most_px, speed * c.WINDOW_SECONDS_FAST))
            if relief is not None or (self.config.motion != "planar" and self._is_undecided):
                wanted_px = rc.RELIEF_DISPLACEMENT_PX
            moved_px = images.displacement_px if relief is None else relief.live_map.displacement_px
            self._motion.resize(moved_px, wanted_px * self.stretch, self._most_events)
        elif is_lost:
            # What was believed of the motion before the loss made the windows too small to be found by.
            self._motion.size = max(self._motion.size, float(c.WINDOW_EVENTS_START))
        if self._second is not None and self._motion.status not in (Status.LOST, Status.RELOCALIZING):
            self._second.stay(trace, mid_us)
        if note:
            self._mapper.log(window.index, "warning" if self._motion.status is Status.LOST else "info", note)
        return WindowResult(
            window=window.index,
            start_us=window.start_us,
            end_us=window.end_us,
            first_event=window.first_event,
            end_event=recorded.end_event,
            status=self._motion.status,
            T_world_camera=trace.T_world_start,
            omega=trace.omega,
            velocity=trace.velocity,
            normal_world=self._mapper.plane.normal,
            contrast_before=images.contrast_before,
            contrast_after=images.contrast_after,
            overlap=overlap,
            score=judged.score,
            confidence=judged.confidence,
            condition=judged.condition,
            weak_direction=judged.weak_direction,
            iterations=alignment.iterations if alignment else 0,
            events_used=len(sampled[0]),
            map_revision=used,
            keyframe=keyframe,
            time_spent_s=time.perf_counter() - clock,
            note=note,
        )

    def take_updates(self) -> TrackerUpdates:
        """Return what was made since the last call: keyframes, map revisions, refined poses, log."""
        return self._mapper.take_updates()

    def finish(self) -> TrackerUpdates:
        """Return the last updates, after a final refinement of everything."""
        failed = self._failures.finish()
        if failed is not None:
            self._mapper.tell(failed)
        if self._relief is not None and self._drifts:
            self._mapper.tell_refined(self._relief.poses())
        if self._second is not None:
            self._second.finish()
        self._mapper.finish(refine=not self._drifts)
        return self._mapper.take_updates()

    def _look_for_depth(self, window: EventWindow) -> str:
        """Ask a window whether the scene is a plane, or track it by the relief map; return what was decided, or ""."""
        relief = self._relief
        if relief is None:
            return ""
        if relief.map is not None:
            relief.follow(window)
            return ""
        if self._asks_relief:
            note = relief.look(window)
        elif relief.not_a_plane and relief.asked:
            # Before a plane's map is found not to fit.
            relief.keep(window, 0.0)
            note = f"the scene is not a plane: {relief.percent}"
        else:
            return ""
        if relief.not_a_plane is None:
            return ""
        straight = self.config.motion == "translation"
        told_only = self.config.motion == "planar" and self.config.mode != "map"
        if not told_only and (straight or self._motion.good_score < rc.RELIEF_TOLD_SCORE):
            return self._begin_relief(relief, window, straight=straight)
        if not relief.not_a_plane or len(relief.asked) > rc.RELIEF_PATIENCE:
            relief.asked = []
        return note if self._is_uneven or not relief.not_a_plane else ""

    def _begin_relief(self, relief: ReliefOdometry, window: EventWindow, *, straight: bool) -> str:
        """Go on by a relief map where its landmarks, too, lie on no plane; return what is to be said."""
        planar = self.config.motion == "planar"
        least = rc.RELIEF_OFF_PLANE_STRAIGHT if straight else rc.RELIEF_OFF_PLANE
        first = relief.asked[0].window
        T = next((t.T_world_camera for t in self._mapper.traces if t.window == first and first > 0), np.eye(4))
        on_plane = None if straight else moved_by_plane(self._mapper.traces, self._mapper.plane, self.camera)
        if not relief.begin(T, may_turn=not straight, least=least, on_plane=on_plane):
            relief.not_a_plane, relief.asked = False, []
            return f"the scene is a plane: {relief.percent}"
        self._mapper.tell_refined(relief.poses())
        note = f"the scene is not a plane: {relief.percent}"
        if not planar:
            return note
        text = f"{note}; tracked on a relief from here on, as a camera that does not turn"
        self._mapper.tell(
            Failure(cause=Cause.NOT_PLANAR, start=first, end=window.index + 1, worst=window.index, message=text)
        )
        return text

    @property
    def _asks_relief(self) -> bool:
        """True where a window is asked if the scene is a plane; a stream that is only told so is not held up by it."""
        is_behind = self.stretch > 1.0 or self._mapper.job is not None
        if self.config.motion == "planar" and self._motion.status not in (Status.TRACKING, Status.INITIALIZING):
            # A blow looks like depth: within the window the camera does not move evenly.
            return False
        return self._is_undecided and not (self._mapper.is_live and self.config.motion == "planar" and is_behind)

    @property
    def _drifts(self) -> bool:
        """True where the scene was found to be no plane: poses are odometry, without a map to come back to."""
        return self._relief is not None and self._relief.map is not None

    @property
    def _is_undecided(self) -> bool:
        return self._relief is not None and self._relief.is_asked

    @property
    def _is_uneven(self) -> bool:
        if self._relief is None or not self._relief.not_a_plane:
            return False
        # Where it is only told, small windows show little of a depth: the map must not fit well either.
        return self.config.motion != "planar" or self._motion.good_score < rc.RELIEF_TOLD_SCORE

    def place(self, T_world_camera: Array) -> None:
        """Start the next window from a given pose, as after a loss: weak until the map agrees.

        Its velocities are those that the window shows by itself.

        Args:
            T_world_camera: pose (4, 4), world (first camera's frame, in plane distances) from camera.

        Raises:
            ValueError: it is no pose, or one that sees nothing of the plane because it lies behind it or far off.
        """
        T = se3.checked_pose(T_world_camera, "T_world_camera")
        if not float(np.abs(T[:3, 3]).max()) <= c.PLACE_MOST:
            raise ValueError(f"T_world_camera: expected a position within {c.PLACE_MOST:g} plane distances")
        plane = self._mapper.plane
        if self._free[3:].any() and float(plane.normal @ T[:3, 3]) + plane.distance <= 0:
            raise ValueError("T_world_camera: expected a camera before the plane, it lies behind it")
        motion = self._motion
        motion.T_world_camera = T
        motion.omega, motion.velocity = np.zeros(3), np.zeros(3)
        motion.filter.forget()
        self._finder.is_placed = True
        motion.bad_windows, motion.searches = 0, 0
        if self._mapper.map is not None:
            motion.status = Status.WEAK

    # --- checkpoints ---------------------------------------------------------------------------------------

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return the whole state as named arrays, from which `restore` goes on with the same results."""
        state = pack(self._motion, self._mapper)
        if self._gyro is not None:
            state |= self._gyro.pack()
        if self._second is not None:
            state |= self._second.pack()
        return state if self._relief is None else state | self._relief.pack()

    @classmethod
    def restore(
        cls,
        camera: Camera,
        config: TrackerConfig,
        state: Mapping[str, np.ndarray],
        source: EventSource,
        imu: Imu | None = None,
    ) -> Tracker:
        """Return a tracker that goes on where `checkpoint` was taken.

        Args:
            camera: the same as then.
            config: the same as then.
            state: what `checkpoint` returned.
            source: the recording's events.
            imu: the same as then.

        Raises:
            ValueError: the state was made by another version or is incomplete.
        """
        tracker = cls(camera, config, imu)
        if tracker._gyro is not None and "gyro_bias" in state:
            tracker._gyro.unpack(state)
        tracker._motion = unpack(state, camera, config.seed, tracker._mapper, source)
        tracker._finder.motion = tracker._motion
        if tracker._second is not None:
            tracker._second.unpack(state, camera, source)
        # A branch may go on as another motion than the one that was stored.
        if tracker._relief is not None and "relief" in state:
            tracker._relief.unpack(state, camera, source)
        return tracker
