"""Odometry: a sequence of frames becomes a trajectory, frame to frame or frame to keyframe, with loop closure."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.registration.dense import Surface, surface_of
from dvsviz.registration.features import FeatureKind, Features, depth_at, detect, match
from dvsviz.registration.frames import FrameSequence
from dvsviz.registration.methods import DENSE, register
from dvsviz.registration.pose_graph import Edge, optimise
from dvsviz.registration.records import (
    GUESS_SIGMA_PX,
    IMAGE_SIGMA_PX,
    MatchedPoints,
    Registration,
    RegistrationConfig,
)

Array = NDArray[np.float64]

# A keyframe serves while at least this share of its features, and so many, are still inliers of the newest frame.
_KEYFRAME_SHARE = 0.25
_KEYFRAME_INLIERS = 40
# Loops are looked for between frames at least so many registered frames apart.
_LOOP_GAP = 4
_LOOP_INLIERS = 40
_LOOPS_A_FRAME = 3
# What a registration of one inlier would be known to; n inliers are sqrt(n) times better.
_ROTATION_SIGMA = 0.01
_TRANSLATION_SIGMA = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Seconds spent on one step.

    Attributes:
        features_s: detection in the new frame and matching.
        points_s: looking up depths.
        method_s: the registration itself.
    """

    features_s: float = 0.0
    points_s: float = 0.0
    method_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One registered frame.

    Attributes:
        frame: number of the frame in its sequence.
        against: number of the frame it was registered against.
        pairs: feature numbers (M, 2) in `against` and `frame` that were matched.
        registration: the result.
        timing: seconds spent.
    """

    frame: int
    against: int
    pairs: NDArray[np.int64]
    registration: Registration
    timing: Timing


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Odometry:
    """A registered sequence.

    Attributes:
        method: name of the method.
        frames: numbers (N,) of the frames.
        trajectory: their poses; the first is the identity.
        steps: N - 1 steps, one a frame after the first.
        loops: number of loop closures that were used.
    """

    method: str
    frames: NDArray[np.int64]
    trajectory: Trajectory
    steps: tuple[Step, ...]
    loops: int = 0


class FeatureTable:
    """Features and depths of a sequence's frames, and their matches, found once each, with the seconds it took.

    Args:
        sequence: the frames.
        kind: what is detected.
        clock: what is asked for the time, s: `time.process_time` on a machine that does other things meanwhile.
    """

    def __init__(
        self,
        sequence: FrameSequence,
        kind: FeatureKind = "sift",
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.sequence = sequence
        self.kind: FeatureKind = kind
        self.clock = clock
        self._kept: dict[int, tuple[Features, Array, float, float]] = {}
        self._surfaces: dict[int, tuple[Surface | None, float]] = {}
        self._matches: dict[tuple[int, int], tuple[NDArray[np.int64], float]] = {}
        camera = sequence.camera
        self.focal_px = (camera.fx + camera.fy) / 2

    def of(self, frame: int) -> tuple[Features, Array, float, float]:
        """Return features, their depths (N,), seconds of detection, and seconds of depth look-up, of one frame."""
        if frame not in self._kept:
            image = self.sequence.read(frame)
            start = self.clock()
            features = detect(image, self.sequence.camera, kind=self.kind)
            middle = self.clock()
            depth = depth_at(image, features.pixels)
            self._kept[frame] = features, depth, middle - start, self.clock() - middle
        return self._kept[frame]

    def matched(self, a: int, b: int) -> tuple[MatchedPoints, NDArray[np.int64], float]:
        """Return the matched points of two frames, the feature numbers (M, 2), and the seconds of matching."""
        (features_a, depth_a, *_), (features_b, depth_b, *_) = self.of(a), self.of(b)
        if (a, b) not in self._matches:
            start = self.clock()
            found = match(features_a, features_b)
            self._matches[a, b] = found, self.clock() - start
        pairs, seconds = self._matches[a, b]
        points = MatchedPoints(
            bearings_a=features_a.bearings[pairs[:, 0]],
            bearings_b=features_b.bearings[pairs[:, 1]],
            depth_a=depth_a[pairs[:, 0]],
            depth_b=depth_b[pairs[:, 1]],
            focal_px=self.focal_px,
            image_sigma_px=float(np.hypot(IMAGE_SIGMA_PX, GUESS_SIGMA_PX * self.sequence.camera.is_guess)),
        )
        return points, pairs, seconds

    def surface(self, frame: int) -> tuple[Surface | None, float]:
        """Return the surfaces in view of a frame, None without depth, and the seconds it took."""
        if frame not in self._surfaces:
            image = self.sequence.read(frame)
            start = self.clock()
            found = surface_of(image, self.sequence.camera)
            self._surfaces[frame] = found, self.clock() - start
        return self._surfaces[frame]

    def step(
        self, a: int, b: int, method: str, config: RegistrationConfig, step_length: float | None = None
    ) -> Step:
        """Return frame b registered against frame a."""
        _, _, features_s, points_s = self.of(b)
        points, pairs, matching_s = self.matched(a, b)
        if method in DENSE:
            surface_b, surface_s = self.surface(b)
            points = replace(points, surface_a=self.surface(a)[0], surface_b=surface_b)
            points_s += surface_s
        start = self.clock()
        registration = register(points, method, config, step_length=step_length)
        timing = Timing(features_s=features_s + matching_s, points_s=points_s, method_s=self.clock() - start)
        return Step(frame=b, against=a, pairs=pairs, registration=registration, timing=timing)


def run_odometry(
    table: FeatureTable,
    method: str,
    *,
    skip: int = 1,
    first: int = 0,
    end: int | None = None,
    keyframes: bool = False,
    loop_closure: bool = False,
    speed: float | None = None,
    config: RegistrationConfig | None = None,
) -> Odometry:
    """Return the trajectory of every `skip`-th frame.

    A step that fails is taken as no motion, and says why (`steps[k].registration.reason`).

    Args:
        table: features of the sequence.
        method: key of `methods.METHODS`.
        skip: frames from one registered frame to the next, at least 1.
        first: first frame.
        end: frame after the last; the sequence's end where not given.
        keyframes: register against the last keyframe while it overlaps, instead of the frame before.
        loop_closure: register frames far apart in the sequence too, and solve the pose graph of all.
        speed: metres a second, the motion model of methods whose scale nothing else gives.
        config: thresholds.

    Raises:
        ValueError: `skip` is below 1, or there are fewer than two frames.
    """
    if skip < 1:
        raise ValueError(f"skip: expected at least 1, got {skip}")
    settings = config or RegistrationConfig()
    t_us = table.sequence.t_us
    frames = np.arange(first, len(t_us) if end is None else end, skip)
    if len(frames) < 2:
        raise ValueError(f"frames: expected at least two, got {len(frames)} with skip {skip}")

    def go(a: int, b: int) -> Step:
        length = None if speed is None else speed * float(t_us[b] - t_us[a]) * 1e-6
        return table.step(a, b, method, settings, length)

    poses = {int(frames[0]): np.eye(4)}
    steps: list[Step] = []
    keyframe = int(frames[0])
    for before, frame in zip(frames[:-1].tolist(), frames[1:].tolist(), strict=True):
        step = go(keyframe if keyframes else before, frame)
        if keyframes and keyframe != before and not _overlaps(step, table):
            keyframe = before
            again = go(keyframe, frame)
            step = replace(again, timing=_sum(step.timing, again.timing))
        # A failed step against a keyframe stays at the frame before it, not at the keyframe.
        base = step.against if step.registration.is_found else before
        poses[frame] = poses[base] @ step.registration.T_a_b
        steps.append(step)
    Ts = np.array([poses[int(frame)] for frame in frames])
    loops = 0
    if loop_closure:
        Ts, loops = _close_loops(Ts, frames, steps, table, method, settings)
    trajectory = Trajectory(t_us=t_us[frames], Ts_world_camera=Ts)
    return Odometry(method=method, frames=frames, trajectory=trajectory, steps=tuple(steps), loops=loops)


def _overlaps(step: Step, table: FeatureTable) -> bool:
    found = step.registration
    features = len(table.of(step.against)[0])
    return found.is_found and found.inlier_count >= max(_KEYFRAME_INLIERS, _KEYFRAME_SHARE * features)


def _sum(a: Timing, b: Timing) -> Timing:
    # The new frame's features were detected once: only the second matching is new, and it is small.
    return Timing(features_s=a.features_s, points_s=a.points_s, method_s=a.method_s + b.method_s)


def _edge(i: int, j: int, registration: Registration) -> Edge:
    n = np.sqrt(max(1, registration.inlier_count))
    return Edge(
        i=i,
        j=j,
        T_i_j=registration.T_a_b,
        rotation_sigma=_ROTATION_SIGMA / n,
        translation_sigma=_TRANSLATION_SIGMA / n,
    )


def _close_loops(
    Ts: Array,
    frames: NDArray[np.int64],
    steps: list[Step],
    table: FeatureTable,
    method: str,
    config: RegistrationConfig,
) -> tuple[Array, int]:
    """Return the poses of the graph of all steps and the loops found, and how many loops there are.

    Candidates are the frames that look in the most similar direction from the nearest place, as estimated.
    """
    number = {int(frame): k for k, frame in enumerate(frames)}
    edges = [_edge(number[s.against], number[s.frame], s.registration) for s in steps if s.registration.is_found]
    for k, step in enumerate(steps):
        if not step.registration.is_found:
            # A loose spring: the graph stays connected, and loops may move it.
            hold = Edge(i=k, j=k + 1, T_i_j=np.eye(4), rotation_sigma=0.5, translation_sigma=0.5)
            edges.append(hold)
    loops = 0
    for k in range(_LOOP_GAP, len(frames)):
        earlier = np.arange(k - _LOOP_GAP + 1)
        turn = se3.rotation_angle(np.swapaxes(Ts[earlier, :3, :3], 1, 2) @ Ts[k, :3, :3])
        distance = np.linalg.norm(Ts[earlier, :3, 3] - Ts[k, :3, 3], axis=1)
        near = earlier[np.argsort(turn + distance)][:_LOOPS_A_FRAME]
        for other in near[turn[near] < np.pi / 3]:
            step = table.step(int(frames[other]), int(frames[k]), method, config)
            found = step.registration
            # A loop of unit length would pull the graph to a scale that means nothing.
            if found.is_found and found.scale == "depth" and found.inlier_count >= _LOOP_INLIERS:
                edges.append(_edge(int(other), k, found))
                loops += 1
    return (optimise(Ts, edges), loops) if loops else (Ts, 0)
