"""The judge: what the numbers of a window say, and what becomes of the tracker's status."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.session.records import Status
from dvsviz.tracking import constants as c
from dvsviz.tracking import diagnose
from dvsviz.tracking.align import Alignment
from dvsviz.tracking.failures import cause_of
from dvsviz.tracking.mapping import Mapper
from dvsviz.tracking.measure import WindowImages
from dvsviz.tracking.state import Motion
from dvsviz.tracking.traces import HELD, Trace


def judge(
    motion: Motion,
    mapper: Mapper,
    free: NDArray[np.bool_],
    trace: Trace,
    alignment: Alignment | None,
    images: WindowImages,
    gain: float | None,
) -> diagnose.Judgement:
    """Return what the numbers say of a window, and move the status in `motion`.

    Args:
        motion: status, running score and bad windows are moved on.
        mapper: its map is what the window is compared with.
        free: mask (6,) of rotation and position.
        trace: the window.
        alignment: how it was aligned with the map, if it was.
        images: the window's images.
        gain: contrast by contrast without motion, where the pose is odometry without a map; else None.
    """
    if gain is not None:
        sharp = gain > c.RELIEF_GAIN
        motion.status = Status.TRACKING if sharp else Status.WEAK
        return replace(diagnose.Judgement.unknown(), is_trusted=True, confidence=0.5 if sharp else 0.1)
    if alignment is None:
        if trace.keyframe == HELD and motion.status is Status.TRACKING:
            motion.status = Status.WEAK
        return diagnose.Judgement.unknown()
    agreed = diagnose.agreement(mapper.live_map, alignment.value, trace.T_world_camera, mapper.camera)
    condition, weak = diagnose.weakest(alignment.information, free)
    share, unseen = diagnose.stripes(mapper.live_map, trace.T_world_camera, mapper.camera)
    if share < c.STRIPES_SHARE and free[3:5].any():
        condition, weak = max(condition, c.WEAK_CONDITION * c.STRIPES_SHARE / max(share, 1e-3)), unseen
    good = motion.good_score if motion.good_score > 0 else agreed.score
    ratio = agreed.score / max(good, 1e-3)
    judged = diagnose.Judgement(
        score=agreed.score,
        confidence=diagnose.confidence(ratio, condition, alignment.inside),
        condition=condition,
        weak_direction=weak,
        note="",
    )
    bad = ratio < c.LOST_RATIO or alignment.inside < c.LOST_INSIDE
    weak_now = ratio < c.WEAK_RATIO or condition > c.WEAK_CONDITION
    motion.bad_windows = motion.bad_windows + 1 if bad else 0
    if motion.status is Status.INITIALIZING:
        if mapper.refinements > 0:
            motion.status = Status.TRACKING
        motion.good_score = agreed.score if motion.good_score == 0 else motion.good_score
    if motion.status is not Status.INITIALIZING:
        if motion.bad_windows >= c.LOST_WINDOWS:
            motion.status = Status.LOST
            judged = replace(
                judged, note="lost: " + cause_of(judged, images, alignment, trace.events, motion.good_score)[1]
            )
        elif bad or weak_now:
            motion.status = Status.WEAK
        else:
            motion.status = Status.TRACKING
    # What lies on the map may write to it, though a direction is not seen: stripes go on where the map ends.
    is_good = not bad and ratio >= c.WEAK_RATIO and motion.status is not Status.LOST
    if is_good or motion.status is Status.INITIALIZING:
        judged = replace(judged, is_trusted=True)
    if motion.status in (Status.TRACKING, Status.INITIALIZING):
        motion.good_score += c.SCORE_GAIN * (agreed.score - motion.good_score)
    return judged
