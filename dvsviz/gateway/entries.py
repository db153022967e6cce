"""The entries of the list of sessions: one a session, one a run that has no session yet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.gateway.orders import RunOrder, RunState, Stage
from dvsviz.gateway.runs import Run
from dvsviz.pipeline import summarize
from dvsviz.session.records import STATUS_BADNESS
from dvsviz.session.store import SessionHeader, open_session

_SPARKS = 64
# A stretch of the sparkline shows its worst state.
_BADNESS = np.array(STATUS_BADNESS)


def read_entry(name: str, path: Path, *, kept: bool) -> dict[str, Any]:
    """Return a session's entry, read from its file.

    Raises:
        SessionError: it is no session, or damaged.
    """
    session = open_session(path)
    state = session.state()
    header, status = session.header, session.column("status")
    figures = summarize(status)
    events, last_us = session.extent
    duration_s = (last_us - header.first_us) * 1e-6 if header.is_stream else header.part_s[1] - header.part_s[0]
    tracked_us = int(session.column("end_us")[-1] - session.column("start_us")[0]) if len(status) else 0
    summary = session.summary or {}
    return {
        "name": name,
        "recording": header.recording_name,
        "format": header.recording_format,
        "width": header.camera.width,
        "height": header.camera.height,
        "duration_s": duration_s,
        "events": events,
        "windows": session.window_count,
        "tracked_share": figures["tracked_share"],
        "losses": figures["losses"],
        "state": state,
        "sparkline": sparkline(status),
        "has_ground_truth": session.ground_truth is not None,
        "created": header.created,
        "tags": list(session.tags),
        "bytes": path.stat().st_size,
        "tracked_s": tracked_us * 1e-6,
        "events_per_second": summary.get("events_per_second"),
        "recording_path": header.recording_path,
        "origin": origin_of(header),
        "kept": kept,
    }


def origin_of(header: SessionHeader) -> dict[str, Any] | None:
    """Return where a branch comes from, as the page needs it, or None."""
    origin = header.origin
    if origin is None:
        return None
    return {
        "session": origin.session,
        "created": origin.created,
        "window": origin.window,
        "changes": {name: list(change) for name, change in origin.changes.items()},
        "placed": origin.T_world_camera is not None,
    }


def _origin_wanted(order: RunOrder) -> dict[str, Any] | None:
    if order.branch_of is None:
        return None
    placed = order.T_world_camera is not None
    return {"session": order.branch_of.stem, "created": "", "window": order.window, "changes": {}, "placed": placed}


def rounded(value: float | None) -> float | None:
    """Return a figure with the digits that are shown: the list is sent where it changed."""
    return None if value is None else float(f"{value:.3g}")


def sparkline(status: NDArray[np.uint8]) -> list[int]:
    """Return up to 64 numbers of `STATUSES`: the worst of each stretch of windows."""
    if len(status) == 0:
        return []
    starts = np.unique(np.linspace(0, len(status), _SPARKS, endpoint=False).astype(np.int64))
    worst = np.maximum.reduceat(_BADNESS[status], starts)
    return [int(number) for number in np.argsort(_BADNESS)[worst]]


def waiting_entry(run: Run) -> dict[str, Any]:
    """Return the entry of a run that has no session yet."""
    order = run.order
    begun = {RunState.RUNNING: "starting", RunState.PAUSED: "starting"}
    return {
        "name": order.name,
        "recording": order.recording.stem,
        "format": "",
        "width": 0,
        "height": 0,
        "duration_s": 0.0,
        "events": 0,
        "windows": 0,
        "tracked_share": None,
        "losses": 0,
        "state": begun.get(run.state, str(run.state)),
        "stages": [str(stage) for stage in Stage if order.demo or stage is not Stage.SIMULATING],
        "stage": str(run.stage),
        "share": run.progress.get("share"),
        "error": run.error,
        "sparkline": [],
        "has_ground_truth": False,
        "created": "",
        "tags": [],
        "bytes": 0,
        "tracked_s": 0.0,
        "events_per_second": None,
        "recording_path": str(order.recording),
        "origin": _origin_wanted(order),
        "kept": order.branch_of is None,
    }
