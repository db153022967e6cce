"""A map in a world of its own, and the camera on it: the tracker's steps without failures, gyroscope and relief."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dvsviz.contrast.iwe import sample_window
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import Status
from dvsviz.tracking import constants as c
from dvsviz.tracking import diagnose
from dvsviz.tracking.failures import FailureWatch
from dvsviz.tracking.finder import PoseFinder
from dvsviz.tracking.judging import judge
from dvsviz.tracking.mapping import Mapper, Sampled
from dvsviz.tracking.measure import measure
from dvsviz.tracking.state import Motion

_LOST = (Status.LOST, Status.RELOCALIZING)


@dataclass(slots=True, kw_only=True, eq=False)
class LocalMap:
    """A map in its own world, and the camera on it.

    Attributes:
        finder: finds poses on it; knows its mapper and motion.
        begun: the window it begins with.
        begun_us: its time.
        is_told: True where the log says that it was begun.
        is_left: True where the camera is followed on the first map again.
    """

    finder: PoseFinder
    begun: int
    begun_us: int
    is_told: bool = False
    is_left: bool = False

    @classmethod
    def start(cls, finder: PoseFinder, plane: Plane, begun: int, begun_us: int) -> LocalMap:
        """Return an empty map for the camera of another finder.

        Args:
            finder: of the first map.
            plane: how the wall is expected in the camera frame, at distance 1.
            begun: the window it begins with.
            begun_us: its time.
        """
        camera, config, free = finder.camera, replace(finder.config, motion="planar"), finder.free
        mapper = Mapper(camera, free, (camera.width, camera.height), solve_normal=True)
        mapper.plane = plane
        local = PoseFinder(
            camera=camera, config=config, free=free, mapper=mapper, motion=Motion.start(free),
            failures=FailureWatch(), gyro=None,
        )  # fmt: skip
        return cls(finder=local, begun=begun, begun_us=begun_us)

    @property
    def mapper(self) -> Mapper:
        """Its traces, keyframes and map."""
        return self.finder.mapper

    @property
    def motion(self) -> Motion:
        """The camera on it."""
        return self.finder.motion

    @property
    def is_settled(self) -> bool:
        """True once its first windows were refined together: before, their poses are an assumption."""
        return self.mapper.refinements > 0

    @property
    def is_followed(self) -> bool:
        """True where the camera is tracked on it."""
        return self.motion.status not in _LOST

    @property
    def last(self) -> int:
        """The last window that it holds."""
        return self.mapper.traces[-1].window if self.mapper.traces else self.begun

    def step(self, window: EventWindow, sampled: Sampled, mid_us: int, recorded: int) -> None:
        """Track one window, of so many recorded events, on it: align, judge, map, refine."""
        finder, mapper, motion = self.finder, self.mapper, self.motion
        if mapper.map is None:
            trace, alignment = finder.start(window, sampled, mid_us), None
        elif self.is_followed:
            trace, alignment = finder.follow(window, sampled, mid_us)
        else:
            trace, alignment, _ = finder.search(window, sampled, mid_us)
        trace = replace(trace, events=recorded, heard=len(window) / recorded)
        images = measure(finder.camera, mapper.plane, window, trace)
        judged = judge(motion, mapper, finder.free, trace, alignment, images, None)
        if judged.is_trusted or (alignment is None and motion.status is Status.INITIALIZING):
            overlap = diagnose.overlap(mapper.live_map, images, trace.T_world_camera, finder.camera)
            mapper.add(
                trace,
                images.warped,
                overlap,
                lambda: sample_window(window, c.KEYFRAME_EVENTS, finder.config.seed),
            )
        elif motion.status is Status.WEAK:
            mapper.remember(trace)
        trace = mapper.advance(trace)
        if self.is_followed:
            motion.T_world_camera, motion.omega, motion.velocity = trace.T_world_camera, trace.omega, trace.velocity
            motion.t_us = mid_us
            most = max(c.WINDOW_EVENTS_MAX, len(window))
            motion.resize(images.displacement_px, c.WINDOW_DISPLACEMENT * finder.camera.width, most)
        else:
            motion.size = max(motion.size, float(c.WINDOW_EVENTS_START))
        # Its keyframes and poses are in a world that nobody else knows.
        mapper.take_updates()

    def leave(self) -> None:
        """Wait while the camera is followed on the first map."""
        self.stop()
        self.is_left, self.motion.status = True, Status.LOST

    def come_back(self, mid_us: int) -> None:
        """Look for the camera, which is lost on the first map again, from a time on."""
        self.is_left = False
        self.motion.searches = (mid_us - self.motion.t_us) // c.RELOCALIZE_EVERY_US

    def stop(self) -> None:
        """End what it does beside the tracker."""
        if self.mapper.job is not None:
            self.mapper.job.dropped.set()
            self.mapper.job = None
