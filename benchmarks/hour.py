"""An hour before a wall: how often the tracker says that it is lost while it is not, and what so long a run costs.

    python benchmarks/hour.py [--out DIR] [--minutes 10] [--seeds 1 2 3 4 5 6] [--json FILE]

Each seed is a recording of its own: another wall, another hand. Shapes and posters by turns. Recordings and sessions
stay in DIR. An *alarm* is a failure with lost windows whose worst window was less than 5 % of the plane's distance off
as it was known then; *silent* windows were called tracking while they were more than 10 % off.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

from dvsviz.config import TrackerConfig
from dvsviz.evaluate.evaluate import evaluate, window_errors
from dvsviz.formats.open import open_recording
from dvsviz.pipeline import track
from dvsviz.session.records import STATUSES, Status
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate

_RIGHT_PERCENT = 5.0
_OFF_PERCENT = 10.0
_LOST = [STATUSES.index(Status.LOST), STATUSES.index(Status.RELOCALIZING)]


def piece(folder: Path, minutes: float, seed: int) -> dict[str, Any]:
    """Simulate and track one recording; return what is told of it."""
    scene = "shapes" if seed % 2 else "poster"
    path = folder / f"{scene}_{seed}_{minutes:g}min.h5"
    if not path.exists():
        simulate(path, scene=scene, motion="handheld", seconds=60 * minutes, seed=seed)
    out = folder / "sessions" / path.name
    out.parent.mkdir(exist_ok=True)
    recording = open_recording(path)
    summary = track(recording, TrackerConfig(), out, force=True)
    with open_session(out) as session:
        status = np.asarray(session.column("status"))
        percent = window_errors(session).position_percent
        off = [percent[f.worst] for f in session.failures if np.isin(status[f.start : f.end], _LOST).any()]
        refined, online = evaluate(session), evaluate(session, poses="online")
        tracking = status == STATUSES.index(Status.TRACKING)
        return {
            "recording": path.stem,
            "events": recording.events.count,
            "seconds": round(recording.duration_s, 1),
            "windows": len(status),
            "tracked_share": round(float(summary["tracked_share"]), 5),
            "losses": len(off),
            "alarms": int(sum(value < _RIGHT_PERCENT for value in off)),
            "silent": int((tracking & (percent > _OFF_PERCENT)).sum()),
            "refined_percent": round(float(refined.position_rmse_percent_of_distance or np.nan), 3),
            "online_percent": round(float(online.position_rmse_percent_of_distance or np.nan), 3),
            "rtf": round(float(summary["real_time_factor"]), 2),
            "largest_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/hour"))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5, 6])
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    rows = []
    # Each in a process of its own: the largest memory is that of one run.
    spawn = multiprocessing.get_context("spawn")
    for seed in asked.seeds:
        with spawn.Pool(1) as pool:
            rows.append(pool.apply(piece, (asked.out, asked.minutes, seed)))
        print(json.dumps(rows[-1]), flush=True)
    minutes = sum(row["seconds"] for row in rows) / 60
    alarms, losses, silent = (sum(row[name] for row in rows) for name in ("alarms", "losses", "silent"))
    print(
        f"{minutes:.1f} min: {losses} losses, {alarms} of them alarms, {silent} windows silently off",
        file=sys.stderr,
    )
    if asked.json:
        asked.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
