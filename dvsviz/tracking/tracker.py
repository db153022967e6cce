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
from dvsviz.contrast.solve import ContrastSolution
from dvsviz.events.recording import EventSource, Imu
from dvsviz.events.windows import EventWindow
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import Status, TrackerUpdates, WindowResult
from dvsviz.tracking import constants as c
from dvsviz.tracking import diagnose
from dvsviz.tracking.align import Alignment, align, free_parameters
from dvsviz.tracking.bootstrap import motion_by_contrast
from dvsviz.tracking.by_contrast import follow_by_contrast
from dvsviz.tracking.failures import FailureWatch, cause_of
from dvsviz.tracking.gyro import Gyro, prior_by_gyro
from dvsviz.tracking.judging import judge
from dvsviz.tracking.keyframe_map import mapper_of
from dvsviz.tracking.measure import WindowImages, measure
from dvsviz.tracking.prediction import difference
from dvsviz.tracking.relocalize import relocalize
from dvsviz.tracking.state import Motion, pack, unpack
from dvsviz.tracking.traces import HELD, Trace
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
        self._most_events = round(c.WINDOW_EVENTS_MAX * max(1.0, camera.width * camera.height / c.WINDOW_PIXELS))
        self.config = config or TrackerConfig()
        self._free = free_parameters(self.config.motion)
        self._mapper = mapper_of(self.config, self.camera, self._free, (camera.width, camera.height))
        self._motion = Motion.start(self._free)
        self.stretch = 1.0
        self._failures = FailureWatch()
        self._gyro = Gyro(imu) if imu is not None and self.config.imu == "auto" and len(imu.t_us) > 1 else None
        # A camera that only turns sees no depth.
        uneven = c.RELIEF_UNEVEN_TOLD if self.config.motion == "planar" else c.RELIEF_UNEVEN
        self._relief = ReliefOdometry(self.camera, uneven) if self.config.motion != "rotation" else None

    @property
    def window_size(self) -> int:
        """Events that the next window should have: the configured number, or by the image's motion."""
        if self.config.window is not None:
            return self.config.window
        return int(np.clip(self._motion.size * self.stretch, c.WINDOW_EVENTS_MIN, self._most_events))

    @property
    def status(self) -> Status:
        """What is known about the last pose."""
        return self._motion.status

    def step(self, window: EventWindow) -> WindowResult:
        """Return the result of one window; windows are given in order, each once."""
        clock = time.perf_counter()
        sampled = sample_window(window, c.TRACE_EVENTS, self.config.seed)
        mid_us = window.start_us + (window.end_us - window.start_us) // 2
        note = ""
        if self._relief is not None and (self._relief.is_asked or self._drifts):
            note = self._relief.look(window)
            if self._relief.not_a_plane and not self._is_uneven:
                note = ""
            if note and self._drifts:
                self._mapper.tell_refined(self._relief.poses)
        relief = self._relief if self._drifts else None
        if relief is not None:
            trace, alignment = self._drift(relief, window, sampled, mid_us), None
        elif self._mapper.map is None:
            trace, alignment = self._start(window, sampled, mid_us), None
        elif self._motion.status in (Status.LOST, Status.RELOCALIZING):
            trace, alignment, note = self._search(window, sampled, mid_us)
        else:
            trace, alignment = self._follow(window, sampled, mid_us)
        images = measure(self.camera, self._mapper.plane, window, trace)
        bridged = self._bridge(trace, alignment, images)
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
                None if relief is None else relief.gain,
            )
            self._learn_bias(trace)
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
            self._failures.look_closer(trace, self._contrast(window), self.camera.focal_px)
        keyframe = -1
        if judged.is_trusted or (alignment is None and self._motion.status is Status.INITIALIZING):
            keyframe = self._mapper.add(
                trace,
                images.warped,
                overlap,
                lambda: sample_window(window, c.KEYFRAME_EVENTS, self.config.seed),
            )
        elif self._motion.status is Status.WEAK:
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
        if self._motion.status not in (Status.LOST, Status.RELOCALIZING):
            wanted_px = c.WINDOW_DISPLACEMENT * self.camera.width
            if relief is not None or (self.config.motion != "planar" and self._is_undecided):
                wanted_px = c.RELIEF_DISPLACEMENT_PX
            self._motion.resize(images.displacement_px, wanted_px, self._most_events)
        if note:
            self._mapper.log(window.index, "warning" if self._motion.status is Status.LOST else "info", note)
        return WindowResult(
            window=window.index,
            start_us=window.start_us,
            end_us=window.end_us,
            first_event=window.first_event,
            end_event=window.end_event,
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
        self._mapper.finish(refine=not self._drifts)
        return self._mapper.take_updates()

    @property
    def _drifts(self) -> bool:
        """True where the scene was found to be no plane: poses are odometry, without a map to come back to."""
        return self._is_uneven and self.config.motion in ("translation", "auto")

    @property
    def _is_undecided(self) -> bool:
        return self._relief is not None and self._relief.is_asked

    @property
    def _is_uneven(self) -> bool:
        if self._relief is None or not self._relief.not_a_plane:
            return False
        # Where it is only told, small windows show little of a depth: the map must not fit well either.
        return self.config.motion != "planar" or self._motion.good_score < c.RELIEF_TOLD_SCORE

    def place(self, T_world_camera: Array) -> None:
        """Start the next window from a given pose, as after a loss: weak, standing still, until the map agrees.

        Args:
            T_world_camera: pose (4, 4), world (first camera's frame, in plane distances) from camera.
        """
        motion = self._motion
        motion.T_world_camera = np.array(T_world_camera, dtype=np.float64)
        motion.omega, motion.velocity = np.zeros(3), np.zeros(3)
        motion.filter.forget()
        motion.bad_windows, motion.searches = 0, 0
        if self._mapper.map is not None:
            motion.status = Status.WEAK

    # --- finding the pose ----------------------------------------------------------------------------------

    def _trace(
        self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int, T: Array
    ) -> Trace:
        return Trace(
            window=window.index,
            first_event=window.first_event,
            start_us=window.start_us,
            mid_us=mid_us,
            duration_s=window.duration_s,
            T_world_camera=T,
            omega=self._motion.omega,
            velocity=self._motion.velocity,
            bearings=sampled[0],
            t_s=sampled[1],
            events=len(window),
        )

    def _contrast(self, window: EventWindow) -> ContrastSolution:
        plane = self._mapper.plane.seen_from(self._motion.T_world_camera)
        # In mode contrast the first window finds the plane too: 8 parameters.
        first = self.config.mode == "contrast" and self._mapper.map is None and bool(self._free[3:].all())
        name, seed = self.config.objective, self.config.seed
        return motion_by_contrast(self.camera, window, plane, self._free, seed, name=name, with_normal=first)

    def _start(self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int) -> Trace:
        """Return the first window's trace: its pose is the identity, its motion found by contrast alone."""
        solution = self._contrast(window)
        mid_s = (mid_us - window.start_us) * 1e-6
        T = se3.propagate(np.eye(4), solution.omega, solution.velocity, mid_s)
        R_mid_start = se3.exp_so3(solution.omega * mid_s).T
        self._motion.omega, self._motion.velocity = solution.omega, R_mid_start @ solution.velocity
        self._mapper.begin(Plane(normal=solution.normal))
        return self._trace(window, sampled, mid_us, T)

    def _follow(
        self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int
    ) -> tuple[Trace, Alignment]:
        """Return the window aligned with the map from where the filter predicts it."""
        if self.config.mode == "contrast":
            found = follow_by_contrast(
                self.camera, self.config, self._free, self._motion, self._mapper.live_map, window, sampled, mid_us
            )
            return self._trace(window, sampled, mid_us, found.T_world_camera), found
        dt = max(1e-6, (mid_us - self._motion.t_us) * 1e-6)
        # Through a gap without events the camera stood still: the velocity is not carried across it.
        dt_predict = min(dt, 2e-3 * self.config.max_window_ms)
        predicted = se3.propagate(
            self._motion.T_world_camera, self._motion.omega, self._motion.velocity, dt_predict
        )
        velocity = se3.exp_so3(self._motion.omega * dt_predict).T @ self._motion.velocity
        omega = self._motion.omega
        prior = None
        if self._gyro is not None and self._gyro.covers(self._motion.t_us, mid_us):
            turn = self._gyro.turn(self._motion.t_us, mid_us)
            predicted[:3, :3] = self._motion.T_world_camera[:3, :3] @ turn
            omega, velocity = self._gyro.rate(mid_us), turn.T @ self._motion.velocity
            prior = prior_by_gyro(self._gyro, dt, (mid_us - self._gyro.seen_us) * 1e-6)
        closed = self._mapper.look(predicted)
        if closed is not None:
            self._motion.T_world_camera, predicted = closed @ self._motion.T_world_camera, closed @ predicted
        mid_s = (mid_us - window.start_us) * 1e-6
        # Where tracking is well the coarsest level has nothing to find; it is asked where the fit is poor.
        first = 1 if self._motion.status is Status.TRACKING else 0
        if dt > dt_predict:
            self._motion.filter.forget()
        known = self._motion.filter.predict(dt_predict) * c.FILTER_CORRELATED
        by_gyro = prior is not None
        prior = known if prior is None else prior
        alignment = self._align(sampled, mid_s, predicted, omega, velocity, prior, first_level=first)
        if first > 0 and self._agreed(alignment) < c.WEAK_RATIO * self._motion.good_score:
            wider = self._align(sampled, mid_s, predicted, omega, velocity, prior if by_gyro else None)
            alignment = max(alignment, wider, key=self._agreed)
        T = alignment.T_world_camera
        change = self._motion.filter.correct(difference(predicted, T), alignment.information, dt_predict)
        if by_gyro:
            # A gyroscope's rate is better than what two poses say.
            change[:3] = 0.0
        self._motion.omega, self._motion.velocity = omega + change[:3], velocity + change[3:]
        return self._trace(window, sampled, mid_us, T), alignment

    def _bridge(
        self, trace: Trace, alignment: Alignment | None, images: WindowImages
    ) -> tuple[Trace, diagnose.Judgement] | None:
        """Return a window that says nothing, turned on by the gyroscope where the camera was last seen; else None."""
        motion, gyro = self._motion, self._gyro
        if gyro is None or alignment is None or not gyro.covers(motion.t_us, trace.mid_us):
            return None
        agreed = diagnose.agreement(self._mapper.live_map, alignment.value, trace.T_world_camera, self.camera)
        says_nothing = trace.events < c.FAILURE_EVENTS or images.edge_pixels < c.TEXTURE_EDGE_PIXELS
        # Where a camera that only turns comes out of the dark before something new, only the gyroscope knows where.
        is_new = not self._free[3:].any() and motion.status is Status.WEAK and agreed.inside < c.LOST_INSIDE
        if agreed.score > c.LOST_RATIO * motion.good_score or not (says_nothing or is_new):
            return None
        T = motion.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ gyro.turn(motion.t_us, trace.mid_us)
        motion.status, motion.bad_windows = Status.WEAK, 0
        gyro.forget_anchor()
        trace = replace(trace, T_world_camera=T, omega=gyro.rate(trace.mid_us), velocity=np.zeros(3), keyframe=HELD)
        unknown = diagnose.Judgement.unknown()
        return trace, replace(unknown, score=agreed.score, is_trusted=is_new and not says_nothing)

    def _learn_bias(self, trace: Trace) -> None:
        """Let the gyroscope's bias follow well-tracked rotations."""
        if self._gyro is None:
            return
        if self._motion.status in (Status.TRACKING, Status.WEAK, Status.INITIALIZING):
            self._gyro.seen_us = trace.mid_us
        if self._motion.status is Status.TRACKING and self._mapper.refinements > 0:
            self._gyro.learn(trace.mid_us, trace.T_world_camera[:3, :3])
        else:
            self._gyro.forget_anchor()

    def _agreed(self, alignment: Alignment) -> float:
        """Return the chance-normalised score of an alignment."""
        return diagnose.agreement(
            self._mapper.live_map, alignment.value, alignment.T_world_camera, self.camera
        ).score

    def _align(
        self,
        sampled: tuple[NDArray[np.float32], Array],
        mid_s: float,
        T: Array,
        omega: Array,
        velocity: Array,
        prior: Array | None,
        *,
        first_level: int = 0,
    ) -> Alignment:
        bearings, t_s = sampled
        if len(bearings) > c.ALIGN_EVENTS:
            step = len(bearings) / c.ALIGN_EVENTS
            pick = (np.arange(c.ALIGN_EVENTS) * step).astype(np.int64)
            bearings, t_s = bearings[pick], t_s[pick]
        return align(
            self._mapper.live_map,
            bearings,
            t_s - mid_s,
            T,
            omega,
            velocity,
            focal_px=self.camera.focal_px,
            free=self._free,
            prior=prior,
            anchored=c.ANCHOR**-2 if self._motion.status is Status.INITIALIZING else 0.0,
            first_level=first_level,
        )

    def _drift(
        self,
        relief: ReliefOdometry,
        window: EventWindow,
        sampled: tuple[NDArray[np.float32], Array],
        mid_us: int,
    ) -> Trace:
        """Return the window moved on by the relief's velocity: odometry, no reference to come back to."""
        self._motion.omega, self._motion.velocity = np.zeros(3), relief.velocity
        return self._trace(window, sampled, mid_us, relief.T_world_camera)

    def _search(
        self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int
    ) -> tuple[Trace, Alignment | None, str]:
        """Return the window placed by relocalization, or where it was last seen."""
        self._motion.status = Status.LOST
        self._motion.filter.forget()
        if mid_us - self._motion.t_us < c.RELOCALIZE_EVERY_US * self._motion.searches:
            return self._trace(window, sampled, mid_us, self._motion.T_world_camera), None, ""
        self._motion.searches += 1
        solution = self._contrast(window)
        mid_s = (mid_us - window.start_us) * 1e-6
        self._motion.omega = solution.omega
        self._motion.velocity = se3.exp_so3(solution.omega * mid_s).T @ solution.velocity
        trace = self._trace(window, sampled, mid_us, self._motion.T_world_camera)
        planar_map, keyframes = self._mapper.to_search(self._motion.searches - 1)
        found = relocalize(
            planar_map,
            self.camera,
            trace.deskewed(self._mapper.plane).astype(np.float32),
            keyframes,
            free=self._free,
        )
        if found is None:
            return trace, None, ""
        self._motion.status = Status.RELOCALIZING
        believed = found.score > c.RELOCALIZE_SCORE * self._motion.good_score
        believed &= found.score - found.runner_up > c.RELOCALIZE_LEAD
        if not believed:
            # A rival pose that nearly fits keeps the search open; nothing that fits is plainly lost.
            near = found.score > 0.5 * c.RELOCALIZE_SCORE * self._motion.good_score
            self._motion.status = Status.RELOCALIZING if near else Status.LOST
            return trace, None, ""
        self._mapper.look(found.T_world_camera, may_close=False)
        alignment = self._align(
            sampled, mid_s, found.T_world_camera, self._motion.omega, self._motion.velocity, None
        )
        since_s = (mid_us - self._motion.t_us) * 1e-6
        self._failures.found_again(self._motion.T_world_camera, alignment.T_world_camera, since_s)
        self._motion.status = Status.TRACKING
        self._motion.bad_windows = 0
        self._motion.t_us = mid_us
        self._motion.searches = 0
        return (
            replace(trace, T_world_camera=alignment.T_world_camera),
            alignment,
            f"relocalized: score {found.score:.2f}, next best {found.runner_up:.2f}",
        )

    # --- checkpoints ---------------------------------------------------------------------------------------

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return the whole state as named arrays, from which `restore` goes on with the same results."""
        state = pack(self._motion, self._mapper)
        if self._gyro is not None:
            state |= self._gyro.pack()
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
        # A branch may go on as another motion than the one that was stored.
        if tracker._relief is not None and "relief" in state:
            tracker._relief.unpack(state)
        return tracker
