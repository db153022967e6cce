"""What a session amounts to: how much of it was tracked, how often it was lost, how far from the truth it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import EvaluationError
from dvsviz.evaluate.evaluate import SessionLike, evaluate
from dvsviz.session.records import STATUSES, Status


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


def evaluation_of(session: SessionLike) -> dict[str, Any] | None:
    """Return the session's evaluation, or None without ground truth or where too little of it was tracked."""
    if session.ground_truth is None:
        return None
    try:
        return evaluate(session).to_dict()
    except EvaluationError:  # every window lost, or a truth of another time: there is no figure to give
        return None
