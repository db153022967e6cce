"""The whole registration study on simulated flights: circle in two scenes, rectangle and lawnmower, eight frame skips.

`--quick` is a short version (two skips, a part of the first circle, small images). The whole one takes about 40 minutes
of one core and writes frames, tables and plots; see docs/study.md.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import cv2

from dvsviz.registration.frames import open_frames
from dvsviz.registration.methods import SOURCE_METHODS
from dvsviz.registration.plots import write_plots
from dvsviz.registration.study import StudyRun, study
from dvsviz.registration.tables import format_table
from dvsviz.simulate.rgbd import rgbd_camera, simulate_rgbd

FLIGHTS = {
    "circle-1": ("boxes", "circle"),
    "circle-2": ("carpet", "circle"),
    "rectangle": ("carpet", "rectangle"),
    "lawnmower": ("carpet", "lawnmower"),
}
METHODS = ("none", *SOURCE_METHODS, "essential-refined", "homography", "pnp-refined", "kabsch-weighted", "pnp-icp")
# The study skips 20 to 90 frames of 30 a second. No frame between every tenth is ever looked at: none is rendered.
EVERY = 10
SKIPS = (20, 30, 40, 50, 60, 70, 80, 90)

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--quick", action="store_true", help="a short version, for a first look")
parser.add_argument("--out", type=Path, default=Path("study"), help="folder for frames, tables and plots")
parser.add_argument("--flights", nargs="+", choices=list(FLIGHTS), default=list(FLIGHTS))
parser.add_argument("--skips", type=int, nargs="+", choices=SKIPS, default=SKIPS)
parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
parser.add_argument("--features", choices=("sift", "sift-fast", "orb"), default="sift-fast")
parser.add_argument("--drift", action="store_true", help="again with keyframes and loop closure, for four methods")
said = parser.parse_args()

# One thread, and processor time instead of wall time: the same figures on a machine that does other things too.
cv2.setNumThreads(1)
flights = ["circle-1"] if said.quick else said.flights
skips = (20, 40) if said.quick else tuple(said.skips)
camera = rgbd_camera()
if said.quick:
    camera = replace(camera, width=320, height=240, fx=262.5, fy=262.5, cx=159.5, cy=119.5)

for name in flights:
    scene, motion = FLIGHTS[name]
    folder = said.out / ("quick" if said.quick else name)
    if not (folder / "groundtruth.txt").exists():
        begun = time.perf_counter()
        simulate_rgbd(
            folder,
            scene=scene,
            motion=motion,
            seconds=12.0 if said.quick else None,
            rate_hz=30 / EVERY,
            camera=camera,
        )
        print(f"{name}: frames rendered in {time.perf_counter() - begun:.0f} s", flush=True)
    runs: list[StudyRun] = []
    frames = open_frames(folder)
    small = tuple(skip // EVERY for skip in skips)
    runs += study(frames, said.methods, small, features=said.features, clock=time.process_time)
    if said.drift:
        best = ("essential", "kabsch-weighted", "pnp-iterative", "pnp-icp")
        runs += study(frames, best, small[:2], features=said.features, keyframes=True, clock=time.process_time)
        runs += study(frames, best, small[:2], features=said.features, loop_closure=True, clock=time.process_time)
    runs = [replace(run, row=replace(run.row, skip=run.row.skip * EVERY)) for run in runs]
    rows = [run.row for run in runs]
    print(f"\n{name}: {scene}, {motion}\n{format_table(rows)}", flush=True)
    stem = f"{folder.name}-{said.features}"
    (said.out / f"{stem}.csv").write_text(format_table(rows, "csv") + "\n", encoding="utf-8")
    (said.out / f"{stem}.tex").write_text(format_table(rows, "latex") + "\n", encoding="utf-8")
    write_plots(said.out / f"{stem}-plots", frames, runs, title=f"{name} ({said.features})")
print(f"\nwrote {said.out}")
