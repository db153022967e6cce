r"""A second map: a camera that is lost before something new is followed there, until that map and the first one meet.

    lost, texture in view, not found ---> second map begun ---> followed on it, looked for on the first map
                                               |                             |
      long lost on both, or the end: given up <+          views agree: maps joined, tracking goes on

Where the camera is on the second map is known in that map's own world only: its windows are told as lost, and get
refined poses when the maps are joined. Until then the first map is not touched.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.recording import EventSource
from dvsviz.events.windows import EventWindow
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import Status
from dvsviz.tracking import constants as c
from dvsviz.tracking import second_constants as own
from dvsviz.tracking.align import Alignment
from dvsviz.tracking.bootstrap import AHEAD
from dvsviz.tracking.finder import PoseFinder
from dvsviz.tracking.joining import Pair, Verdict, agreeing, moved, rival, verify, write
from dvsviz.tracking.local_map import LocalMap
from dvsviz.tracking.mapping import Sampled
from dvsviz.tracking.measure import measure
from dvsviz.tracking.relocalize import relocalize
from dvsviz.tracking.state import pack, unpack
from dvsviz.tracking.traces import Trace, window_poses

Array = NDArray[np.float64]
Found = tuple[Trace, Alignment | None, str]
"""A window on the first map, how it was aligned with it if it was found, and what is to be said."""

_PREFIX = "second."


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """A window of one map that was found on the other from nothing.

    Attributes:
        window: its number.
        mid_us: its time.
        T_world_camera: the pose (4, 4) that was found, in the other map's world.
    """

    window: int
    mid_us: int
    T_world_camera: Array


@dataclass(slots=True, kw_only=True, eq=False)
class SecondMap:
    """What a tracker does about a loss that lasts: begins a second map, follows the camera there, joins the maps.

    Attributes:
        finder: of the first map, with its mapper and the tracker's motion.
        local: the second map, where there is one.
        textured_us: since when there has been texture and the camera was found nowhere; -1 where it is not so.
        next_us: from when on a window of one map is looked for on the other again.
        sightings: those found, in time order; all on the first map, or, once the camera is back there, on the second.
        in_a_row: how many of the last searches found one.
    """

    finder: PoseFinder
    local: LocalMap | None = None
    textured_us: int = -1
    next_us: int = 0
    sightings: list[Sighting] = field(default_factory=list)
    in_a_row: int = 0

    @property
    def window_size(self) -> float | None:
        """Events that the next window should have, where the camera is followed on the second map."""
        local = self.local
        return local.motion.size if local is not None and not local.is_left and local.is_followed else None

    def search(
        self, window: EventWindow, sampled: Sampled, mid_us: int, recorded: int, *, is_noise: bool = False
    ) -> Found:
        """Return a lost window as the first map knows it, as `PoseFinder.search` does, and follow it on the second.

        Args:
            window: without noise.
            sampled: its sampled events.
            mid_us: its time.
            recorded: its events with noise.
            is_noise: nothing else is in it: it is neither searched nor followed.
        """
        local = self.local
        if is_noise:
            self.textured_us = -1
            return self.finder.search(window, sampled, mid_us, is_noise=True)
        if local is None:
            found = self.finder.search(window, sampled, mid_us)
            if found[1] is None and self._is_unknown(window, found[0], mid_us, own.SECOND_AFTER_US):
                self._begin(window.index, mid_us).step(window, sampled, mid_us, recorded)
            return found
        if local.is_left:
            local.come_back(mid_us)
            self._forget_sightings()
        local.mapper.is_live = self.finder.mapper.is_live
        local.step(window, sampled, mid_us, recorded)
        if self._is_tiny(local, mid_us):
            if not local.is_settled and local.motion.bad_windows >= c.LOST_WINDOWS:
                # Nothing holds a map that has not been refined yet: begun anew where there is texture.
                self._give_up("")
            return self.finder.search(window, sampled, mid_us)
        if not local.is_told:
            local.is_told = True
            self._log(window.index, f"second map begun at window {local.begun}")
        if local.is_followed:
            self.textured_us = -1
            return self._follow(local, window, sampled, mid_us)
        if mid_us < self.next_us:
            return self._unseen(window, sampled, mid_us), None, ""
        self.next_us = mid_us + own.SECOND_NEAR_EVERY_US
        found = self.finder.search(window, sampled, mid_us)
        if found[1] is None and self._is_unknown(window, found[0], mid_us, own.SECOND_PATIENCE_US):
            self._give_up("lost on both")
        return found

    def stay(self, trace: Trace, mid_us: int) -> None:
        """Take note of a window that is tracked on the first map; where a second one waits, see whether they meet here.

        Args:
            trace: the window.
            mid_us: its time.
        """
        self.textured_us = -1
        local, mapper = self.local, self.finder.mapper
        if local is None:
            return
        if self._is_tiny(local, mid_us):
            self._give_up("")
            return
        if not local.is_left:
            local.leave()
            self._forget_sightings()
        known = mapper.traces[-1]
        if self.finder.motion.status is Status.TRACKING and known.window == trace.window and known.is_trusted:
            verdict = self._look(local, known, mid_us)
            if verdict is not None:
                self._join(local, verdict, trace.window)

    def finish(self) -> None:
        """Forget a second map that never met the first, at the recording's end."""
        self._give_up("it never met the first")

    @staticmethod
    def _is_tiny(local: LocalMap, mid_us: int) -> bool:
        """Return whether the second map is not worth more than the first one's own way back."""
        return not local.is_settled or (mid_us - local.begun_us < own.SECOND_TINY_US and not local.is_told)

    # --- where the first map is lost -----------------------------------------------------------------------

    def _unseen(self, window: EventWindow, sampled: Sampled, mid_us: int) -> Trace:
        """Return a window that is not looked for on the first map: where it was last seen there."""
        motion = self.finder.motion
        self.finder.lose()
        motion.status = Status.RELOCALIZING if self.sightings else Status.LOST
        # What was not searched is not made up for later.
        motion.searches = (mid_us - motion.t_us) // c.RELOCALIZE_EVERY_US
        return self.finder.trace(window, sampled, mid_us, motion.T_world_camera)

    def _is_unknown(self, window: EventWindow, trace: Trace, mid_us: int, wait_us: int) -> bool:
        """Return whether there has been texture for so long: whether it moves as one shows on the map that is begun.

        Args:
            window: lost.
            trace: with the motion of its own contrast.
            mid_us: its time.
            wait_us: how long.
        """
        images = measure(self.finder.camera, self.finder.mapper.plane, window, trace)
        if len(window) < c.FAILURE_EVENTS or images.edge_pixels < c.TEXTURE_EDGE_PIXELS:
            self.textured_us = -1
            return False
        if self.textured_us < 0:
            self.textured_us = mid_us
        return mid_us - self.textured_us >= wait_us

    def _begin(self, window: int, mid_us: int) -> LocalMap:
        """Return a new second map; the wall is expected as it was last seen."""
        finder = self.finder
        normal = finder.mapper.plane.seen_from(finder.motion.T_world_camera).normal
        facing = float(normal @ AHEAD) > own.SECOND_FACING
        local = LocalMap.start(finder, Plane(normal=normal if facing else AHEAD), window, mid_us)
        local.mapper.is_live = finder.mapper.is_live
        self.local, self.textured_us, self.next_us = local, -1, 0
        self._forget_sightings()
        return local

    def _follow(self, local: LocalMap, window: EventWindow, sampled: Sampled, mid_us: int) -> Found:
        """Return a window that is tracked on the second map: lost, unless the maps can be joined by it."""
        finder, motion = self.finder, self.finder.motion
        here, verdict = local.mapper.traces[-1], None
        if here.window == window.index and here.is_trusted:
            verdict = self._look(local, here, mid_us)
        if verdict is not None:
            self._join(local, verdict, window.index)
            start = verdict.join.trace(here, -1)
            motion.omega, motion.velocity = start.omega, start.velocity
            T = start.T_world_camera
        else:
            # The image moves by the velocity over the distance, which needs no scale.
            distance = local.mapper.plane.seen_from(local.motion.T_world_camera).distance
            ratio = finder.mapper.plane.seen_from(motion.T_world_camera).distance / max(distance, c.PLANE_TOO_NEAR)
            motion.omega, motion.velocity = local.motion.omega, ratio * local.motion.velocity
            if self.in_a_row < own.SECOND_IN_A_ROW or self.sightings[-1].window != window.index:
                return self._unseen(window, sampled, mid_us), None, ""
            # The camera is on the first map, and the second one does not fit it.
            T = self.sightings[-1].T_world_camera
            there = finder.trace(window, sampled, mid_us, T)
            if rival(finder.mapper.live_map, [there], finder.camera) > own.JOIN_RIVAL:
                return self._unseen(window, sampled, mid_us), None, ""
        motion.size = local.motion.size
        motion.filter.forget()
        return *finder.take_up(window, sampled, mid_us, T), ""

    # --- meeting -------------------------------------------------------------------------------------------

    def _look(self, local: LocalMap, trace: Trace, mid_us: int) -> Verdict | None:
        """Look for a window of one map on the other; return the verdict where enough of them agree and it is sure.

        Args:
            local: the second map.
            trace: the window on the map that it is tracked on.
            mid_us: its time.
        """
        first = self.finder.mapper
        mine, other, good = local.mapper, first, self.finder.motion.good_score
        if local.is_left:
            mine, other, good = first, local.mapper, local.motion.good_score
        if mid_us < self.next_us:
            return None
        planar_map, keyframes = other.to_search(0)
        bearings = trace.deskewed(mine.plane).astype(np.float32)
        found = relocalize(planar_map, self.finder.camera, bearings, keyframes, free=self.finder.free)
        fits = 0.0 if found is None else found.score / max(c.RELOCALIZE_SCORE * good, 1e-3)
        self.sightings = [s for s in self.sightings if mid_us - s.mid_us < own.SECOND_SIGHTED_US]
        if found is not None and fits > 1.0 and found.score - found.runner_up > c.RELOCALIZE_LEAD:
            new = Sighting(window=trace.window, mid_us=mid_us, T_world_camera=found.T_world_camera)
            self.sightings = [*self.sightings, new][-own.SECOND_SIGHTINGS :]
            self.in_a_row += 1
        else:
            self.in_a_row = 0
        far_us = own.SECOND_LEFT_EVERY_US if local.is_left else own.SECOND_EVERY_US
        self.next_us = mid_us + (own.SECOND_NEAR_EVERY_US if fits > own.SECOND_NEAR else far_us)
        # A refinement that moves the first map's traces must have landed.
        return self._agreed(local) if self.in_a_row > 0 and first.job is None else None

    def _agreed(self, local: LocalMap) -> Verdict | None:
        """Return the verdict on the join that the sightings agree on, if they do and it is sure."""
        first = self.finder.mapper
        known = {t.window: t.T_world_camera for t in (first if local.is_left else local.mapper).traces}
        pairs: list[Pair] = []
        for s in (s for s in self.sightings if s.window in known):
            T = known[s.window]
            pairs.append((T, s.T_world_camera) if local.is_left else (s.T_world_camera, T))
        join = agreeing(pairs, first.plane, local.mapper.plane, self.finder.camera)
        if join is None:
            return None
        verdict = verify(
            join,
            local.mapper.traces,
            local.mapper.plane,
            first.live_map,
            self.finder.camera,
            self.finder.free,
            self.finder.motion.good_score,
        )
        return verdict if verdict.is_sure else None

    def _join(self, local: LocalMap, verdict: Verdict, window: int) -> None:
        """Bring the second map's windows before a window into the first map."""
        first = self.finder.mapper
        traces = [t for t in local.mapper.traces if t.window < window]
        there, keyframes = moved(traces, local.mapper.keyframes, verdict.join, len(first.keyframes))
        write(there, first.live_map, self.finder.camera)
        first.take_in(there, keyframes)
        first.tell_refined(window_poses(there))
        self._log(
            window,
            f"maps joined: windows {local.begun} to {traces[-1].window}; {verdict.windows} of them lie on both, "
            f"{verdict.off_px:.1f} px apart, score {verdict.score:.2f} of the usual, scale {verdict.join.scale:.3f}",
        )
        local.stop()
        self.local = None
        self._forget_sightings()

    def _forget_sightings(self) -> None:
        self.sightings, self.in_a_row = [], 0

    def _give_up(self, why: str) -> None:
        """Forget the second map."""
        local = self.local
        if local is not None:
            local.stop()
            if local.is_told:
                text = f"second map of windows {local.begun} to {local.last} given up, they stay lost: {why}"
                self._log(local.last, text)
        self.local, self.textured_us = None, -1
        self._forget_sightings()

    def _log(self, window: int, text: str) -> None:
        self.finder.mapper.log(window, "info", text)

    # --- checkpoints ---------------------------------------------------------------------------------------

    def pack(self) -> dict[str, np.ndarray]:
        """Return what a checkpoint keeps of it."""
        state = {"second_times": np.array([self.textured_us, self.next_us, self.in_a_row], dtype=np.int64)}
        local = self.local
        if local is None:
            return state
        state |= {
            "second_local": np.array([local.begun, local.begun_us, local.is_told, local.is_left], np.int64),
            "second_windows": np.array([(s.window, s.mid_us) for s in self.sightings], np.int64).reshape(-1, 2),
            "second_poses": np.array([s.T_world_camera for s in self.sightings]).reshape(-1, 4, 4),
            # Those of the first map are in the session already.
            "second_images": np.array([k.image for k in local.mapper.keyframes], dtype=np.uint8),
        }
        return state | {_PREFIX + name: array for name, array in pack(local.motion, local.mapper).items()}

    def unpack(self, state: Mapping[str, np.ndarray], camera: Camera, source: EventSource) -> None:
        """Take over what `pack` returned; a state without a second map leaves none.

        Args:
            state: of a checkpoint.
            camera: of the recording.
            source: its events.

        Raises:
            ValueError: the state is incomplete.
        """
        if "second_times" not in state:
            return
        self.textured_us, self.next_us, self.in_a_row = (int(v) for v in state["second_times"])
        if "second_local" not in state:
            return
        begun, begun_us, is_told, is_left = (int(v) for v in state["second_local"])
        local = LocalMap.start(self.finder, Plane(normal=AHEAD), begun, begun_us)
        local.is_told, local.is_left = bool(is_told), bool(is_left)
        packed = {name.removeprefix(_PREFIX): array for name, array in state.items() if name.startswith(_PREFIX)}
        local.finder.motion = unpack(packed, camera, self.finder.config.seed, local.mapper, source)
        try:
            local.mapper.keyframes = [
                replace(k, image=np.array(image, dtype=np.uint8))
                for k, image in zip(local.mapper.keyframes, state["second_images"], strict=True)
            ]
            self.sightings = [
                Sighting(window=int(k), mid_us=int(t), T_world_camera=np.array(T))
                for (k, t), T in zip(state["second_windows"], state["second_poses"], strict=True)
            ]
        except KeyError as error:
            raise ValueError(f"state: expected an array {error}, got none") from error
        self.local = local
