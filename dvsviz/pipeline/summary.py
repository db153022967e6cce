"""What a run found, in numbers."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from dvsviz.errors import EvaluationError
from dvsviz.evaluate.metric_scale import metric_scale
from dvsviz.evaluate.summary import evaluation_of, summarize
from dvsviz.events.recording import Recording
from dvsviz.session.store import Session

__all__ = ["evaluation_of", "events_kept", "metric_scale_of", "summarize"]


def events_kept(recording: Recording) -> dict[str, Any]:
    """Return `filters` and `events_kept_share` of a recording whose events were filtered, else nothing."""
    if recording.filters is None or recording.events_before_filters is None:
        return {}
    share = recording.events.count / max(1, recording.events_before_filters)
    return {"filters": asdict(recording.filters), "events_kept_share": share}


def metric_scale_of(session: Session, recording: Recording) -> dict[str, Any]:
    """Return `metric_scale` of a recording with an accelerometer, else nothing.

    It holds `metres_per_unit`, `deviation` and `explained`, or `unknown` with the reason.
    """
    if recording.imu is None or not np.isfinite(recording.imu.accel).any():
        return {}
    try:
        found = metric_scale(session.trajectory(), recording.imu)
    except EvaluationError as error:
        return {"metric_scale": {"unknown": str(error)}}
    figures = ("metres_per_unit", "deviation", "explained")
    return {"metric_scale": {name: getattr(found, name) for name in figures}}
