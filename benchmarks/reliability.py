"""Whether the tracker knows when it is wrong: true error by confidence, over all sessions of a folder with truth.

    python benchmarks/reliability.py DIR

DIR is the folder of sessions that `make accuracy` leaves (`out/accuracy/sessions`). The poses are those known at the
time; windows before the first refinement have no confidence worth the name and are left out.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from dvsviz.evaluate.evaluate import window_errors
from dvsviz.session.records import STATUSES, Status
from dvsviz.session.store import open_session

_EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0)


def reliability(folder: Path) -> str:
    """Return a Markdown table: error of the poses by bins of confidence."""
    confidence, error = [np.zeros(0)], [np.zeros(0)]
    for path in sorted(folder.glob("*.h5")):
        with open_session(path) as session:
            if session.ground_truth is None or session.header.mean_plane_distance is None:
                continue
            percent = window_errors(session, poses="online").position_percent
            known = np.isfinite(percent) & (session.column("status") != STATUSES.index(Status.INITIALIZING))
            confidence.append(np.asarray(session.column("confidence"))[known])
            error.append(percent[known])
    sure, off = np.concatenate(confidence), np.concatenate(error)
    lines = ["| confidence | windows | median error | 95 % | over 10 % off |", "|---|---|---|---|---|"]
    for low, high in pairwise(_EDGES):
        inside = off[(sure >= low) & ((sure < high) | (high == 1.0))]
        if len(inside):
            middle, most = np.percentile(inside, (50, 95))
            share = 100 * float((inside > 10.0).mean())
            lines.append(
                f"| {low:.1f} to {high:.1f} | {len(inside)} | {middle:.2f} % | {most:.2f} % | {share:.1f} % |"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(reliability(Path(sys.argv[1])))
