"""What a run found, in numbers."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import EvaluationError
from dvsviz.evaluate.evaluate import evaluate
from dvsviz.events.recording import Recording
from dvsviz.session.records import STATUSES, Status
from dvsviz.session.store import Session


def summarize(status: NDArray[np.uint8]) -> dict[str, Any]:
    """Return `windows`, `tracked_share` and `losses` of windows' statuses (N,), indices into `records.STATUSES`.

    The share is of all windows after initialization, tracking or weak; a loss is a window that is lost or
    relocalizing after one that was neither.
    """

    def among(*names: Status) -> NDArray[np.bool_]:
        return np.isin(status, [STATUSES.index(name) for name in names])

    after = ~among(Status.INITIALIZING)
    lost = among(Status.LOST, Status.RELOCALIZING)
    began = lost & ~np.concatenate([[False], lost[:-1]]) if len(lost) else lost
    share = float(among(Status.TRACKING, Status.WEAK)[after].mean()) if after.any() else 0.0
    return {"windows": len(status), "tracked_share": share, "losses": int(began.sum())}


def events_kept(recording: Recording) -> dict[str, Any]:
    """Return `filters` and `events_kept_share` of a recording whose events were filtered, else nothing."""
    if recording.filters is None or recording.events_before_filters is None:
        return {}
    share = recording.events.count / max(1, recording.events_before_filters)
    return {"filters": asdict(recording.filters), "events_kept_share": share}


def evaluation_of(session: Session) -> dict[str, Any] | None:
    """Return the session's evaluation, or None without ground truth or where too little of it was tracked."""
    if session.ground_truth is None:
        return None
    try:
        return evaluate(session).to_dict()
    except EvaluationError:  # every window lost, or a truth of another time: there is no figure to give
        return None
