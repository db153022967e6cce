"""What stands over the pictures of a registered frame."""

from __future__ import annotations

from typing import Any

from dvsviz.session.registration import RegistrationRecord


def captions(record: RegistrationRecord, window: int) -> dict[str, Any]:
    """Return name and note of each picture of a frame, and a sentence about its registration.

    The pictures take the places of a window's: `warped` the matches, `raw` the pair, `map` depth, `texture` errors.

    Args:
        record: the registration.
        window: number of the frame among the registered ones.
    """
    run = record.shown_run
    step = record.steps[window - 1] if window else None
    counts, sentence = "first frame", f"{run.name}, skip {run.skip}: the first frame, its camera is the world"
    if step is not None:
        inliers = int(step.is_inlier.sum())
        counts = f"{inliers} of {len(step.is_inlier)} agree"
        sentence = f"{run.name}, skip {run.skip}: frame {window} against {step.against}, {counts}"
    if step is not None and step.reason:
        sentence = f"{sentence}: {step.reason}"
    texts = {
        "warped": ("matches", counts),
        "raw": ("pair of frames", "green: inliers, orange: outliers"),
        "map": ("depth", "0.4 m red to 5 m blue"),
        "texture": ("errors of all methods", "absolute"),
    }
    return {"captions": {k: {"name": a, "note": b} for k, (a, b) in texts.items()}, "note": sentence}
