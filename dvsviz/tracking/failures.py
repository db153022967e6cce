"""Failures: stretches of weak or lost windows, each with its cause, read off what was measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.solve import ContrastSolution
from dvsviz.geometry import se3
from dvsviz.session.records import Cause, Failure, Status
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import Alignment
from dvsviz.tracking.diagnose import Judgement, in_words
from dvsviz.tracking.measure import WindowImages
from dvsviz.tracking.traces import Trace

Array = NDArray[np.float64]


def cause_of(
    judged: Judgement,
    images: WindowImages,
    alignment: Alignment | None,
    events: int,
    good_score: float,
    is_uneven: bool = False,
) -> tuple[Cause, str]:
    """Return the most likely cause of a bad window, and a sentence.

    Args:
        judged: its score and condition.
        images: its edge pixels and displacement.
        alignment: where its events fell on the map, if it was aligned.
        events: how many it had.
        good_score: running score of good windows.
        is_uneven: the first windows showed that the scene is not a plane.
    """
    if events < c.FAILURE_EVENTS:
        return Cause.TOO_FEW_EVENTS, f"only {events} events in the window"
    is_weak = np.isfinite(judged.condition) and judged.condition > c.WEAK_CONDITION
    if is_weak and images.edge_pixels >= c.STRIPES_EDGE_PIXELS:
        return Cause.WEAK_DIRECTION, f"{in_words(judged.weak_direction)} cannot be seen in this texture"
    if is_uneven:
        # One plane's motion blurs such a scene: few edges and wild velocities follow from it.
        return Cause.NOT_PLANAR, "the scene is not a plane: track it with --motion auto or translation"
    moved = f"faster than the search: {images.displacement_px:.0f} px in one window"
    if images.contrast_before > max(c.FAILURE_SHARP, c.FAILURE_SHARPER * images.contrast_after):
        # A motion that the camera did not make smears the edges that are there: it stopped, or turned, at once.
        return Cause.TOO_FAST, f"{moved}, with which its edges are less sharp than without"
    if images.edge_pixels < c.TEXTURE_EDGE_PIXELS:
        return Cause.TOO_LITTLE_TEXTURE, f"too little texture: {images.edge_pixels} edge pixels in view"
    if alignment is not None and alignment.inside < c.LOST_INSIDE:
        return Cause.LEFT_MAP, f"left the map: {100 * alignment.inside:.0f} % of the events fall on it"
    if images.displacement_px > c.FAILURE_FAST_PX:
        return Cause.TOO_FAST, moved
    if np.isfinite(judged.score):
        return (
            Cause.UNKNOWN,
            f"the events no longer fit the map: score {judged.score:.2f}, {good_score:.2f} when good",
        )
    return Cause.UNKNOWN, "no pose on the map fits the events"


class FailureWatch:
    """Follows the windows' statuses and tells each failure when it has ended."""

    def __init__(self) -> None:
        self._start: int | None = None
        self._was_lost = False
        self._worst = (float("inf"), -1)
        self._blind: list[tuple[Cause, str]] = []
        self._cause: tuple[Cause, str] = (Cause.UNKNOWN, "")
        self._last = -1

    def observe(self, window: int, status: Status, score: float, cause: tuple[Cause, str]) -> Failure | None:
        """Take one window; return the failure that it ends, if any.

        Args:
            window: its number.
            status: what became of it.
            score: its agreement with the map; NaN where there is none.
            cause: `cause_of` it.
        """
        self._last = window
        bad = status in (Status.WEAK, Status.LOST, Status.RELOCALIZING)
        if not bad:
            return self._end(window)
        lost = status is not Status.WEAK
        if self._start is None:
            self._start, self._cause = window, cause
        if cause[0] in (Cause.TOO_FEW_EVENTS, Cause.TOO_LITTLE_TEXTURE):
            self._blind.append(cause)
        # The cause is that of the moment it was lost, or of the worst weak window before; what follows is consequence.
        value = score if np.isfinite(score) else 1.0
        if not self._was_lost and (lost or value < self._worst[0]):
            self._worst, self._cause = (value, window), cause
        self._was_lost |= lost
        return None

    @property
    def is_unexplained(self) -> bool:
        """True within a failure whose cause is not known yet."""
        return self._start is not None and self._cause[0] is Cause.UNKNOWN

    def look_closer(self, trace: Trace, own: ContrastSolution, focal_px: float) -> None:
        """Compare the motion a lost window was given with its own: one far from it was too fast to follow.

        Args:
            trace: the window as it was tracked.
            own: its motion by contrast alone.
            focal_px: focal length, to express the difference in px.
        """
        delta = np.linalg.norm(own.omega - trace.omega) + np.linalg.norm(own.velocity - trace.velocity)
        jump_px = float(delta) * focal_px * trace.duration_s
        if jump_px > c.FAILURE_JUMP_PX:
            text = (
                f"faster than the search: the image moved {jump_px:.0f} px away from the prediction in one window"
            )
            self._cause = (Cause.TOO_FAST, text)

    def found_again(self, T_lost: Array, T_found: Array, after_s: float) -> None:
        """Look back at a loss whose cause was not understood: a way back that was near was there all along.

        Args:
            T_lost: last pose (4, 4) before the loss.
            T_found: pose (4, 4) that was found.
            after_s: time between the two.
        """
        delta = se3.inverse(T_lost) @ T_found
        apart = float(np.linalg.norm(delta[:3, 3]) + se3.rotation_angle(delta[:3, :3]))
        if self.is_unexplained and after_s < c.FAILURE_NEAR_S and apart < c.FAILURE_NEAR:
            self._cause = (
                Cause.LOCAL_OPTIMUM,
                f"a local optimum: a better pose lay {100 * apart:.0f} % of the distance away",
            )

    def finish(self) -> Failure | None:
        """Return the failure that the recording's end cut off, if any."""
        return self._end(self._last + 1)

    def _end(self, window: int) -> Failure | None:
        start, lost, worst, cause = self._start, self._was_lost, self._worst, self._cause
        if start is not None and len(self._blind) >= c.FAILURE_BLIND_WINDOWS:
            cause = self._blind[len(self._blind) // 2]
        self._blind = []
        self._start, self._was_lost, self._worst = None, False, (float("inf"), -1)
        if start is None or (not lost and window - start < c.FAILURE_WEAK_WINDOWS):
            return None
        return Failure(cause=cause[0], start=start, end=window, worst=max(start, worst[1]), message=cause[1])
