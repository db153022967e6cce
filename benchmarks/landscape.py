"""How long a contrast landscape takes: for the sensors that there are, on one core.

    python benchmarks/landscape.py [--all] [--json]

A window of random edges moves before a plane; the slice is 33 by 33 cells. Medians of three after a warm-up.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Literal, get_args

import numpy as np

from dvsviz.contrast.landscape import Grid, contrast_landscape, edge_image, map_landscape
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.view.landscape import CELLS, MOST_EVENTS

Kind = Literal["variance", "gradient", "map"]
KINDS: tuple[Kind, ...] = get_args(Kind)


def measure(camera: Camera, events: int, what: Kind) -> tuple[float, float]:
    """Return seconds of the wall's clock and of the processor, medians."""
    rng = np.random.default_rng(1)
    bearings = np.asarray(
        camera.bearings(rng.uniform(0, [camera.width - 1, camera.height - 1], (events, 2))), np.float32
    )
    t_s = np.sort(rng.uniform(0, 0.03, events))
    weights = np.where(rng.random(events) < 0.5, 1, -1).astype(np.float32)
    plane, motion = Plane(normal=np.array([0.0, 0.0, -1.0])), np.array([0.3, -0.2, 0.5, 0.4, 0.1, 0.0])
    grid = Grid.around((1, 3), (1.0, 1.0), CELLS[-1])
    texture = (255 * (rng.random((700, 900)) < 0.05)).astype(np.uint8)
    target = np.array([[250.0, 0, 450], [0, 250.0, 350], [0, 0, 1]])
    took = []
    for _ in range(4):
        start = np.array([time.perf_counter(), time.thread_time()])
        if what == "map":
            map_landscape(bearings, t_s, np.eye(4), motion, plane, edge_image(texture), target, 0.1, grid)
        else:
            contrast_landscape(bearings, t_s, weights, camera, motion, plane, grid, measure=what)
        took.append(np.array([time.perf_counter(), time.thread_time()]) - start)
    wall, processor = np.median(took[1:], axis=0)
    return float(wall), float(processor)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--all", action="store_true", help="50,000 events too, of which the dashboard picks 8,000")
    asked = parser.parse_args()
    cameras = {
        "240x180": Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5),
        "640x480": Camera(width=640, height=480, fx=530.0, fy=530.0, cx=319.5, cy=239.5),
        "1280x720": Camera(width=1280, height=720, fx=1000.0, fy=1000.0, cx=639.5, cy=359.5),
    }
    figures = {}
    for name, camera in cameras.items():
        # The dashboard picks MOST_EVENTS of a window's events; more show what they would cost.
        for events in (MOST_EVENTS, 50_000) if asked.all else (MOST_EVENTS,):
            for what in KINDS:
                wall, processor = measure(camera, events, what)
                figures[f"{name}, {events} events, {what}"] = {"s": round(wall, 3), "cpu_s": round(processor, 3)}
    if asked.json:
        print(json.dumps(figures, indent=2))
    else:
        for name, took in figures.items():
            print(f"{name:38} {took['s']:7.3f} s {took['cpu_s']:7.3f} s of one core")


if __name__ == "__main__":
    main()
