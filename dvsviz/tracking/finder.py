"""The finder: where a window was seen from, by prediction and alignment, by contrast, by a gyroscope or by search.

It reads the map and moves the velocities in `Motion`; whether a pose is believed is the judge's business.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.contrast.solve import ContrastSolution
from dvsviz.events.windows import EventWindow
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import Status
from dvsviz.tracking import constants as c
from dvsviz.tracking import diagnose
from dvsviz.tracking.align import Alignment, align, align_each
from dvsviz.tracking.bootstrap import motion_by_contrast
from dvsviz.tracking.by_contrast import follow_by_contrast
from dvsviz.tracking.failures import FailureWatch
from dvsviz.tracking.gyro import Gyro, prior_by_gyro
from dvsviz.tracking.mapping import Mapper
from dvsviz.tracking.measure import WindowImages, measure
from dvsviz.tracking.prediction import difference
from dvsviz.tracking.relocalize import relocalize
from dvsviz.tracking.sampling import thinned, view_rays
from dvsviz.tracking.state import Motion
from dvsviz.tracking.traces import HELD, Trace
from dvsviz.tracking.translation import ReliefOdometry

Array = NDArray[np.float64]


@dataclass(slots=True, kw_only=True, eq=False)
class PoseFinder:
    """Finds the poses of one tracker's windows.

    Attributes:
        camera: of the tracker's images.
        config: settings.
        free: mask (6,) of rotation and position that the motion model solves for.
        mapper: its map is what windows are aligned with.
        motion: last pose, velocities and status, moved on.
        failures: is told when the way back was found.
        gyro: the gyroscope, where it is used.
        is_placed: True where the pose was set from outside: the next window's velocities come from its own contrast.
    """

    camera: Camera
    config: TrackerConfig
    free: NDArray[np.bool_]
    mapper: Mapper
    motion: Motion
    failures: FailureWatch
    gyro: Gyro | None
    is_placed: bool = False
    _view: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        # A camera that only turns cannot draw near.
        self._view = view_rays(self.camera) if self.free[3:].any() else None

    def trace(
        self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int, T: Array
    ) -> Trace:
        """Return the window at a pose (4, 4), with the velocities as they are known."""
        return Trace(
            window=window.index,
            first_event=window.first_event,
            start_us=window.start_us,
            mid_us=mid_us,
            duration_s=window.duration_s,
            T_world_camera=T,
            omega=self.motion.omega,
            velocity=self.motion.velocity,
            bearings=sampled[0],
            t_s=sampled[1],
            events=len(window),
        )

    def contrast(self, window: EventWindow) -> ContrastSolution:
        """Return the motion of a window by its own contrast."""
        plane = self.mapper.plane.seen_from(self.motion.T_world_camera)
        # In mode contrast the first window finds the plane too: 8 parameters.
        first = self.config.mode == "contrast" and self.mapper.map is None and bool(self.free[3:].all())
        name, seed = self.config.objective, self.config.seed
        return motion_by_contrast(self.camera, window, plane, self.free, seed, name=name, with_normal=first)

    def start(self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int) -> Trace:
        """Return the first window's trace: its pose is the identity, its motion found by contrast alone."""
        self.motion.searches = 0
        solution = self.contrast(window)
        mid_s = (mid_us - window.start_us) * 1e-6
        T = se3.propagate(np.eye(4), solution.omega, solution.velocity, mid_s)
        R_mid_start = se3.exp_so3(solution.omega * mid_s).T
        self.motion.omega, self.motion.velocity = solution.omega, R_mid_start @ solution.velocity
        self.mapper.begin(Plane(normal=solution.normal))
        return self.trace(window, sampled, mid_us, T)

    def wait(self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int) -> Trace:
        """Return a window that shows noise alone where the camera was last: it stands still."""
        self.motion.omega, self.motion.velocity = np.zeros(3), np.zeros(3)
        self.motion.filter.forget()
        if self.mapper.map is None:
            self.mapper.begin(self.mapper.plane)
        return replace(self.trace(window, sampled, mid_us, self.motion.T_world_camera), keyframe=HELD)

    def waits(self, alike: float) -> bool:
        """Return whether a window tells nothing of a camera that stands still.

        Before the first pose also one that, after noise, tells too little to hold all others.

        Args:
            alike: correlation of the window's neighbouring pixels.
        """
        if self.motion.status in (Status.LOST, Status.RELOCALIZING):
            return False
        if not self.mapper.traces:
            if alike < c.NOISE_ALIKE:
                self.motion.searches = max(1, self.motion.searches)
                return True
            if self.motion.searches == 0 or alike >= c.NOISE_START_ALIKE:
                return False
            self.motion.searches += 1
            return self.motion.searches <= c.NOISE_START_WINDOWS
        speed = float(np.linalg.norm(self.motion.omega) + np.linalg.norm(self.motion.velocity))
        moved_px = speed * 1e-3 * self.config.max_window_ms * self.camera.focal_px
        return alike < c.NOISE_ALIKE and moved_px < c.NOISE_STILL * self.camera.width

    def follow(
        self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int
    ) -> tuple[Trace, Alignment]:
        """Return the window aligned with the map from where the filter predicts it."""
        if self.config.mode == "contrast":
            found = follow_by_contrast(
                self.camera, self.config, self.free, self.motion, self.mapper.live_map, window, sampled, mid_us
            )
            return self.trace(window, sampled, mid_us, found.T_world_camera), found
        dt = max(1e-6, (mid_us - self.motion.t_us) * 1e-6)
        # Through a gap without events the camera stood still: the velocity is not carried across it.
        dt_predict = min(dt, 2e-3 * self.config.max_window_ms)
        predicted = se3.propagate(self.motion.T_world_camera, self.motion.omega, self.motion.velocity, dt_predict)
        velocity = se3.exp_so3(self.motion.omega * dt_predict).T @ self.motion.velocity
        omega = self.motion.omega
        if self.is_placed:
            self.is_placed = False
            solution = self.contrast(window)
            predicted = self.motion.T_world_camera.copy()
            omega = solution.omega
            velocity = se3.exp_so3(omega * (mid_us - window.start_us) * 1e-6).T @ solution.velocity
        prior = None
        if self.gyro is not None and self.gyro.knows(self.motion.t_us, mid_us):
            turn = self.gyro.turn(self.motion.t_us, mid_us)
            predicted[:3, :3] = self.motion.T_world_camera[:3, :3] @ turn
            omega, velocity = self.gyro.rate(mid_us), turn.T @ self.motion.velocity
            prior = prior_by_gyro(self.gyro, dt, (mid_us - self.gyro.seen_us) * 1e-6)
        closed = self.mapper.look(predicted)
        if closed is not None:
            self.motion.T_world_camera, predicted = closed @ self.motion.T_world_camera, closed @ predicted
        mid_s = (mid_us - window.start_us) * 1e-6
        # Where tracking is well the coarsest level has nothing to find; it is asked where the fit is poor.
        first = 1 if self.motion.status is Status.TRACKING else 0
        if dt > dt_predict:
            self.motion.filter.forget()
        known = self.motion.filter.predict(dt_predict) * c.FILTER_CORRELATED
        by_gyro = prior is not None
        prior = known if prior is None else prior
        alignment = self._align(sampled, mid_s, predicted, omega, velocity, prior, first_level=first)
        if first > 0 and self._agreed(alignment) < c.WEAK_RATIO * self.motion.good_score:
            wider = self._align(sampled, mid_s, predicted, omega, velocity, prior if by_gyro else None)
            alignment = max(alignment, wider, key=self._agreed)
        elsewhere = self._probe(sampled, mid_s, alignment, omega, velocity)
        if elsewhere is not None:
            # It went astray over many windows, along a direction that they hardly told.
            self.motion.filter.forget()
            return self.trace(window, sampled, mid_us, elsewhere.T_world_camera), elsewhere
        T = alignment.T_world_camera
        change = self.motion.filter.correct(difference(predicted, T), alignment.information, dt_predict)
        if by_gyro:
            # A gyroscope's rate is better than what two poses say.
            change[:3] = 0.0
        self.motion.omega, self.motion.velocity = omega + change[:3], velocity + change[3:]
        return self.trace(window, sampled, mid_us, T), alignment

    def _probe(
        self,
        sampled: tuple[NDArray[np.float32], Array],
        mid_s: float,
        alignment: Alignment,
        omega: Array,
        velocity: Array,
    ) -> Alignment | None:
        """Return a better alignment from farther off along the directions that a window tells least of, if any."""
        good = self.motion.good_score
        here = self._agreed(alignment)
        if self.motion.status is Status.INITIALIZING or here >= c.PROBE_RATIO * good or not self.free.all():
            return None
        T = alignment.T_world_camera
        if diagnose.stripes(self.mapper.live_map, T, self.camera)[0] < c.STRIPES_SHARE:
            # Along stripes one place is as good as the next.
            return None
        vectors = np.linalg.eigh(alignment.information)[1][:, : c.PROBE_DIRECTIONS]
        steps = np.array([sign * size for size in c.PROBE_STEPS for sign in (-1.0, 1.0)])
        offsets = (vectors.T[:, None] * steps[:, None]).reshape(-1, 6)
        R = T[:3, :3]
        Ts = se3.pose(R @ se3.exp_so3(offsets[:, :3]), T[:3, 3] + offsets[:, 3:] @ R.T)
        for most in (c.PROBE_EVENTS, c.ALIGN_EVENTS):
            pick, count = thinned(len(sampled[0]), most), len(Ts)
            found = align_each(
                self.mapper.live_map,
                [sampled[0][pick]] * count,
                [sampled[1][pick] - mid_s] * count,
                Ts,
                np.tile(omega, (count, 1)),
                np.tile(velocity, (count, 1)),
                focal_px=self.camera.focal_px,
                free=self.free,
            )
            best = max(found, key=self._agreed)
            # Few events tell which place fits best, all of them how well.
            Ts = best.T_world_camera[None]
        return best if self._agreed(best) > here + c.PROBE_LEAD * good else None

    def bridge(
        self, trace: Trace, alignment: Alignment | None, images: WindowImages
    ) -> tuple[Trace, diagnose.Judgement] | None:
        """Return a window that says nothing, turned on by the gyroscope where the camera was last seen; else None."""
        motion, gyro = self.motion, self.gyro
        if gyro is None or alignment is None or not gyro.knows(motion.t_us, trace.mid_us):
            return None
        agreed = diagnose.agreement(self.mapper.live_map, alignment, self.camera)
        says_nothing = trace.events < c.FAILURE_EVENTS or images.edge_pixels < c.TEXTURE_EDGE_PIXELS
        # Where a camera that only turns comes out of the dark before something new, only the gyroscope knows where.
        is_new = not self.free[3:].any() and motion.status is Status.WEAK and agreed.inside < c.LOST_INSIDE
        if agreed.score > c.LOST_RATIO * motion.good_score or not (says_nothing or is_new):
            return None
        T = motion.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ gyro.turn(motion.t_us, trace.mid_us)
        motion.status, motion.bad_windows = Status.WEAK, 0
        gyro.forget_anchor()
        trace = replace(trace, T_world_camera=T, omega=gyro.rate(trace.mid_us), velocity=np.zeros(3), keyframe=HELD)
        unknown = diagnose.Judgement.unknown()
        return trace, replace(unknown, score=agreed.score, is_trusted=is_new and not says_nothing)

    def learn_bias(self, trace: Trace, was: Status) -> str:
        """Let the gyroscope's bias follow well-tracked rotations, and check it by them.

        Args:
            trace: the window.
            was: the status before it.

        Returns:
            What is to be said of the gyroscope, mostly nothing.
        """
        if self.gyro is None:
            return ""
        said = ""
        if self.motion.status is Status.LOST and was not in (Status.LOST, Status.RELOCALIZING):
            said = self.gyro.doubt("led to a loss") if self.gyro.trust > 0 else ""
        elif self.motion.status in (Status.TRACKING, Status.INITIALIZING):
            said = self.gyro.check(trace.mid_us, trace.T_world_camera[:3, :3])
        if self.motion.status in (Status.TRACKING, Status.WEAK, Status.INITIALIZING):
            self.gyro.seen_us = trace.mid_us
        if self.motion.status is Status.TRACKING and self.mapper.refinements > 0:
            self.gyro.learn(trace.mid_us, trace.T_world_camera[:3, :3])
        elif self.motion.status is not Status.INITIALIZING:
            self.gyro.forget_anchor()
        return said

    def _agreed(self, alignment: Alignment) -> float:
        """Return the chance-normalised score of an alignment."""
        return diagnose.agreement(self.mapper.live_map, alignment, self.camera).score

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
            pick = thinned(len(bearings))
            bearings, t_s = bearings[pick], t_s[pick]
        alignment = align(
            self.mapper.live_map,
            bearings,
            t_s - mid_s,
            T,
            omega,
            velocity,
            focal_px=self.camera.focal_px,
            free=self.free,
            prior=prior,
            anchored=c.ANCHOR**-2 if self.motion.status is Status.INITIALIZING else 0.0,
            view=self._view,
            first_level=first_level,
            to_lines=True,
        )
        return replace(alignment, agreed=diagnose.agreement(self.mapper.live_map, alignment, self.camera))

    def drift(
        self,
        relief: ReliefOdometry,
        window: EventWindow,
        sampled: tuple[NDArray[np.float32], Array],
        mid_us: int,
    ) -> Trace:
        """Return the window where the relief map places it."""
        self.motion.omega, self.motion.velocity = np.zeros(3), relief.velocity
        return self.trace(window, sampled, mid_us, relief.T_world_camera)

    def lose(self) -> None:
        """Take the camera as lost, where it was last seen."""
        self.motion.status = Status.LOST
        self.motion.filter.forget()
        # Where nothing was seen the pose was only carried on: what is believed is where it was last trusted.
        trusted = next((t for t in reversed(self.mapper.traces) if t.is_trusted), None)
        if trusted is not None:
            self.motion.T_world_camera = trusted.T_world_camera

    def search(
        self,
        window: EventWindow,
        sampled: tuple[NDArray[np.float32], Array],
        mid_us: int,
        *,
        is_noise: bool = False,
    ) -> tuple[Trace, Alignment | None, str]:
        """Return the window placed by relocalization, or where it was last seen; noise alone is not searched for."""
        self.lose()
        if mid_us - self.motion.t_us < c.RELOCALIZE_EVERY_US * self.motion.searches:
            return self.trace(window, sampled, mid_us, self.motion.T_world_camera), None, ""
        self.motion.searches += 1
        self.motion.omega, self.motion.velocity = np.zeros(3), np.zeros(3)
        trace = self.trace(window, sampled, mid_us, self.motion.T_world_camera)
        edges = measure(self.camera, self.mapper.plane, window, trace).edge_pixels
        if is_noise or edges < c.STRIPES_EDGE_PIXELS:
            # A covered lens shows noise: whatever it lay on would be chance.
            return trace, None, ""
        solution = self.contrast(window)
        mid_s = (mid_us - window.start_us) * 1e-6
        self.motion.omega = solution.omega
        self.motion.velocity = se3.exp_so3(solution.omega * mid_s).T @ solution.velocity
        trace = self.trace(window, sampled, mid_us, self.motion.T_world_camera)
        planar_map, keyframes = self.mapper.to_search(self.motion.searches - 1)
        found = relocalize(
            planar_map,
            self.camera,
            trace.deskewed(self.mapper.plane),
            keyframes,
            free=self.free,
        )
        if found is None:
            return trace, None, ""
        self.motion.status = Status.RELOCALIZING
        believed = found.score > c.RELOCALIZE_SCORE * self.motion.good_score
        believed &= found.score - found.runner_up > c.RELOCALIZE_LEAD
        if not believed:
            # A rival pose that nearly fits keeps the search open; nothing that fits is plainly lost.
            near = found.score > 0.5 * c.RELOCALIZE_SCORE * self.motion.good_score
            self.motion.status = Status.RELOCALIZING if near else Status.LOST
            return trace, None, ""
        self.mapper.look(found.T_world_camera, may_close=False)
        alignment = self._align(sampled, mid_s, found.T_world_camera, self.motion.omega, self.motion.velocity, None)
        if diagnose.is_on_a_line(planar_map, alignment, self.camera, self.free):
            # There anything fits: on a cover's edge that sweeps over the image.
            return trace, None, ""
        since_s = (mid_us - self.motion.t_us) * 1e-6
        self.failures.found_again(self.motion.T_world_camera, alignment.T_world_camera, since_s)
        self.motion.status = Status.TRACKING
        self.motion.bad_windows = 0
        self.motion.t_us = mid_us
        self.motion.searches = 0
        return (
            replace(trace, T_world_camera=alignment.T_world_camera),
            alignment,
            f"relocalized: score {found.score:.2f}, next best {found.runner_up:.2f}",
        )

    def take_up(
        self, window: EventWindow, sampled: tuple[NDArray[np.float32], Array], mid_us: int, T_world_camera: Array
    ) -> tuple[Trace, Alignment]:
        """Return a window aligned with the map near a pose (4, 4) that is believed: tracking goes on from there."""
        motion = self.motion
        mid_s = (mid_us - window.start_us) * 1e-6
        alignment = self._align(sampled, mid_s, T_world_camera, motion.omega, motion.velocity, None)
        motion.status = Status.TRACKING
        motion.bad_windows, motion.searches = 0, 0
        motion.t_us = mid_us
        return self.trace(window, sampled, mid_us, alignment.T_world_camera), alignment
