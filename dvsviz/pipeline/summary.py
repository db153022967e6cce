"""What a run found, in numbers."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from dvsviz.evaluate.summary import evaluation_of, summarize
from dvsviz.events.recording import Recording

__all__ = ["evaluation_of", "events_kept", "summarize"]


def events_kept(recording: Recording) -> dict[str, Any]:
    """Return `filters` and `events_kept_share` of a recording whose events were filtered, else nothing."""
    if recording.filters is None or recording.events_before_filters is None:
        return {}
    share = recording.events.count / max(1, recording.events_before_filters)
    return {"filters": asdict(recording.filters), "events_kept_share": share}
