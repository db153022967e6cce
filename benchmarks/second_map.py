"""A second map after a loss: how much of what was lost has poses in the end, and how good they are.

    python benchmarks/second_map.py [--out DIR] [--seeds N ...] [--scene shapes] [--markdown FILE]

A hand covers the lens for a second, in which the camera goes 1.7 m along the wall; 4 s later it walks back. *lost* is
told while it happens, *without a pose* is what is left of it at the recording's end. Position and rotation are RMSE of
the refined poses of all windows that have one, after Sim(3) alignment.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from dvsviz.evaluate.evaluate import evaluate
from dvsviz.formats.open import open_recording
from dvsviz.pipeline import track
from dvsviz.session.records import STATUSES, Status
from dvsviz.session.store import open_session
from dvsviz.simulate.cover import Cover
from dvsviz.simulate.scenes import SceneName
from dvsviz.simulate.simulate import simulate
from dvsviz.simulate.suite_scenes import away_and_back

SECONDS, DARK_S, BACK_S = 11.0, (3.0, 4.0), (8.0, 10.0)
_LOST = [STATUSES.index(Status.LOST), STATUSES.index(Status.RELOCALIZING)]


def row(out: Path, scene: SceneName, seed: int) -> str:
    """Return one line of the table."""
    path, session_path = out / f"{scene}_{seed}.h5", out / "sessions" / f"{scene}_{seed}.h5"
    session_path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        motion = away_and_back(np.random.default_rng([seed, 100]), DARK_S, BACK_S)
        simulate(path, scene=scene, motion=motion, seconds=SECONDS, seed=seed, cover=Cover(intervals=(DARK_S,)))
    summary = track(open_recording(path), None, session_path, force=True)
    with open_session(session_path) as session:
        start_us, end_us = (np.asarray(session.column(name), np.int64) for name in ("start_us", "end_us"))
        lost = np.isin(session.column("status"), _LOST)
        posed = np.isin(start_us, session.trajectory().t_us)
        s = (end_us - start_us) * 1e-6
        found = evaluate(session)
        said = next((e.text for e in session.log if e.text.startswith("maps joined")), "never joined")
        online = evaluate(session, poses="online")
    return (
        f"| {scene}, seed {seed} | {s[lost].sum():.1f} s | {s[~posed].sum():.1f} s "
        f"| {found.position_rmse_percent_of_distance:.2f} % | {found.rotation_rmse_deg:.2f}° "
        f"| {online.position_rmse_percent_of_distance:.2f} %, {online.rotation_rmse_deg:.2f}° "
        f"| {summary['real_time_factor']:.1f} | {said} |"
    )


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/second_map"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--scene", default="shapes")
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    lines = [
        "| recording | lost | without a pose | position | rotation | online | rtf | the log |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for seed in args.seeds:
        lines.append(row(args.out, args.scene, seed))
        sys.stderr.write(lines[-1] + "\n")
    text = "\n".join(lines) + "\n"
    if args.markdown is not None:
        args.markdown.write_text(text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
