"""The map of mode `contrast`: keyframes alone write it, and each new one is refined together with all others.

Section 2.2.3 of seed 000: a window of which the map explains too little becomes a candidate; poses and velocities of
all keyframes and the normal are found together by the contrast of their common image; where the others then explain
too little of the candidate, its pose was off: the map goes on without it, and the tracker relocalizes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.contrast.iwe import vote
from dvsviz.contrast.joint import KeyframeEvents, canvas_of, common_image, maximize_joint_contrast
from dvsviz.contrast.objectives import ObjectiveName, objective
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.tracking import constants as c
from dvsviz.tracking.kernels import explained_share
from dvsviz.tracking.mapping import Mapper, Sampled
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.refining import Job, Refiner, Revised, evenly
from dvsviz.tracking.traces import Trace, add_to_map, correct

Array = NDArray[np.float64]


def mapper_of(
    config: TrackerConfig, camera: Camera, free: NDArray[np.bool_], image_size: tuple[int, int]
) -> Mapper:
    """Return the mapper of a configuration's mode."""
    solve_normal = config.motion in ("planar", "auto")
    if config.mode == "map":
        return Mapper(camera, free, image_size, solve_normal=solve_normal, is_panorama=config.motion == "rotation")
    return KeyframeMapper(
        camera, free, image_size, solve_normal=solve_normal, name=config.objective, seed=config.seed
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointlyRevised(Revised):
    """What a joint refinement made of the keyframes.

    Attributes:
        is_refused: True where the others explain too little of the last keyframe.
    """

    is_refused: bool


class KeyframeMapper(Mapper):
    """Map, traces and keyframes of one tracker by contrast.

    Args:
        camera: of the windows.
        free: mask (6,) of rotation and position.
        image_size: (width, height) of the keyframes' images.
        solve_normal: refine the plane's normal too.
        name: the objective.
        seed: of the dither.
    """

    # It also judges the last candidate.
    _may_drop = False

    def __init__(
        self,
        camera: Camera,
        free: NDArray[np.bool_],
        image_size: tuple[int, int],
        *,
        solve_normal: bool,
        name: ObjectiveName,
        seed: int,
    ) -> None:
        super().__init__(camera, free, image_size, solve_normal=solve_normal)
        self._refiner = JointRefiner(camera=camera, free=free, solve_normal=solve_normal, name=name, seed=seed)

    def add(self, trace: Trace, image: NDArray[np.float32], overlap: float, densely: Callable[[], Sampled]) -> int:
        """Write a window to the map if it becomes a keyframe; return its number, or -1."""
        if self._is_keyframe(trace, overlap):
            return super().add(trace, image, overlap, densely)
        self.traces.append(trace)
        return -1

    def _is_keyframe(self, trace: Trace, overlap: float) -> bool:
        anchors = [t.T_world_camera for t in self.traces if t.keyframe >= 0]
        if not anchors:
            return True
        moved = self._view_changes_px(trace.T_world_camera, np.stack(anchors[-c.KEYFRAME_COMPARE :])).min()
        limit = c.KEYFRAME_DISPLACEMENT * self.camera.width * min(1.0, max(0.2, len(anchors) / c.KEYFRAME_SETTLED))
        # What the map explains is a keyframe only for the baseline that it gives.
        return moved > c.REFINE_SPREAD * self.camera.width or (overlap < c.OVERLAP_KEYFRAME and moved > 0.3 * limit)

    def _due(self) -> bool:
        return len(self.keyframes) > 1 and self.tried_at < len(self.keyframes)

    def _merge(self, job: Job) -> None:
        super()._merge(job)
        revised = job.future.result()
        self.must_relocalize = isinstance(revised, JointlyRevised) and revised.is_refused


def _is_anchor(trace: Trace) -> bool:
    return trace.keyframe >= 0 and trace.is_trusted


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointRefiner(Refiner):
    """Refinement of all keyframes by the contrast of their common image.

    Attributes:
        name: the objective.
        seed: of the dither.
    """

    name: ObjectiveName
    seed: int

    def revise(
        self,
        traces: Sequence[Trace],
        plane: Plane,
        *,
        first: bool,
        last: bool = False,
        faces: Sequence[Plane] = (),
        most: int = c.JOINT_MAX_VIEWS,
        dropped: threading.Event | None = None,
        awaited: threading.Event | None = None,
    ) -> Revised:
        """Return what takes the place of the traces and the map: 12 k - 4 parameters found together.

        Args:
            traces: all windows so far, keyframes among them; the last keyframe is the candidate.
            plane: as known.
            first: not used: the map is made anew in any case.
            last: at the recording's end, where there is no candidate.
            faces: not used: this mode keeps to one plane.
            most: keyframes that are found together, at most `JOINT_MAX_VIEWS`.
            dropped: not used: what is found of the candidate is always wanted.
            awaited: not used.
        """
        anchors = evenly([t for t in traces if _is_anchor(t)], min(most, c.JOINT_MAX_VIEWS))
        if len(anchors) < 2:
            return self.settle(traces, plane)
        train, test = ([self._events(t, half) for t in anchors] for half in (0, 1))
        scale = self.camera.focal_px / plane.distance
        solved = maximize_joint_contrast(
            train,
            plane,
            scale,
            free=self.free,
            solve_normal=self.solve_normal,
            blurs_px=c.JOINT_BLURS_PX,
            max_evaluations=c.JOINT_EVALUATIONS,
            ridge=c.JOINT_RIDGE,
            name=self.name,
        )
        moved = [
            replace(k, T_world_camera=s.T_world_camera, omega=s.omega, velocity=s.velocity)
            for k, s in zip(test, solved.keyframes, strict=True)
        ]
        canvas = canvas_of(test, plane, scale)
        cost = objective(self.name, c.JOINT_BLURS_PX[-1])
        before = cost(common_image(test, plane, canvas))[0]
        after = cost(common_image(moved, solved.plane, canvas))[0]
        kept, before_plane = list(traces), plane
        # A contrast that multiplies is views drawn together, as before a scene that is no plane.
        accepted = before < after < c.JOINT_RISE * before
        if accepted:
            kept, plane = self._moved(kept, anchors, solved.keyframes), solved.plane
        views = [t for t in kept if _is_anchor(t)]
        overlap, usual = (self._explained(views, which, plane) for which in (-1, -2))
        # Dense texture explains less than a few shapes do: what the others explain of the keyframe before is usual.
        refused = not last and overlap < c.JOINT_OVERLAP * usual
        if refused:
            candidate = max(t.keyframe for t in anchors)
            kept = [replace(t, is_trusted=False) if t.keyframe == candidate else t for t in traces]
            plane, accepted = before_plane, False
        said = "refused" if refused else "accepted" if accepted else "left as it was"
        return JointlyRevised(
            traces=tuple(kept),
            plane=plane,
            planar_map=self.build(kept, plane),
            text=f"joint contrast of {len(anchors)} keyframes on held-out events: {before:.4g} to {after:.4g}, {said}"
            f"; the others explain {100 * overlap:.0f} % of the last, {100 * usual:.0f} % of the one before",
            accepted=accepted,
            is_refused=refused,
        )

    def _events(self, trace: Trace, half: int) -> KeyframeEvents:
        """Return half of a keyframe's events, dithered by up to half a pixel, with its state at the first event."""
        rng = np.random.default_rng((self.seed, trace.window, half))
        bearings = trace.bearings[half::2]
        dither = rng.uniform(-0.5, 0.5, bearings.shape) / (self.camera.fx, self.camera.fy)
        return KeyframeEvents(
            bearings=(bearings + dither).astype(np.float32),
            t_s=np.ascontiguousarray(trace.t_s[half::2]),
            duration_s=max(trace.duration_s, 1e-6),
            T_world_camera=trace.T_world_start,
            omega=trace.omega,
            velocity=se3.exp_so3(trace.omega * trace.mid_s) @ trace.velocity,
        )

    @staticmethod
    def _moved(traces: Sequence[Trace], anchors: Sequence[Trace], solved: Sequence[KeyframeEvents]) -> list[Trace]:
        """Return the traces re-expressed after their keyframes moved, keyframes with their own velocities."""
        found = {}
        for t, k in zip(anchors, solved, strict=True):
            T = se3.propagate(k.T_world_camera, k.omega, k.velocity, t.mid_s)
            found[t.window] = (T, k.omega, se3.exp_so3(k.omega * t.mid_s).T @ k.velocity)
        return [
            replace(t, T_world_camera=found[t.window][0], omega=found[t.window][1], velocity=found[t.window][2])
            if t.window in found
            else t
            for t in correct(traces, {number: T for number, (T, _, _) in found.items()})
        ]

    def _explained(self, anchors: Sequence[Trace], which: int, plane: Plane) -> float:
        """Return the share of a keyframe's edge pixels that the others' map explains; NaN where it has none."""
        last, K = anchors[which], self.camera.matrix
        others = self.build([t for t in anchors if t is not last], plane)
        px = (last.deskewed(plane) @ K[:2, :2].T + K[:2, 2]).astype(np.float32)
        image = vote(px, None, (self.camera.height, self.camera.width))
        occupied = image[image > 0]
        level = max(1.5, 0.5 * float(np.percentile(occupied, 90))) if len(occupied) else 1.5
        H = others.projection @ homography_map_camera(last.T_world_camera, plane)
        share, count = explained_share(image, level, others.level(-1), H, K, c.OVERLAP_EDGE)
        return share if count > 0 else float("nan")

    def settle(self, traces: Sequence[Trace], plane: Plane) -> Revised:
        """Return the traces as they are, with the map of their keyframes."""
        return Revised(
            traces=tuple(traces),
            plane=plane,
            planar_map=self.build(traces, plane),
            text="too few keyframes for a joint refinement",
            accepted=False,
        )

    def build(self, traces: Sequence[Trace], plane: Plane) -> PlanarMap:
        """Return the map of the keyframes alone."""
        # A class with slots is made anew: `super()` without arguments would look for the old one.
        return Refiner.build(self, [t for t in traces if _is_anchor(t)], plane)

    def append(self, planar_map: PlanarMap, before: Trace, after: Trace, later: Sequence[Trace]) -> list[Trace]:
        """Return windows that were tracked meanwhile, moved along; keyframes among them join the revised map."""
        R = after.T_world_camera[:3, :3] @ before.T_world_camera[:3, :3].T
        shift = after.T_world_camera[:3, 3] - before.T_world_camera[:3, 3]
        out: list[Trace] = []
        for trace in later:
            T = trace.T_world_camera
            out.append(replace(trace, T_world_camera=se3.pose(R @ T[:3, :3], T[:3, 3] + shift)))
            if _is_anchor(trace):
                add_to_map(planar_map, out[-1], (self.camera.height, self.camera.width), self.camera.matrix)
        return out
