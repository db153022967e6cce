"""A session of 100,000 windows, 20 minutes of sensor time: how long it takes to open, and what it costs the server.

    python benchmarks/long_session.py [--windows 100000] [--seeks 30] [--keep FILE] [--json]

Session and recording are written by the real writers: a window of 12 ms every 12 ms, a keyframe every 30, a map
revision every 200. Then the real program serves them, and a real browser opens the page on them. Clocks are inside the
page: from the order to open the session, in a page that shows a short one, to the images of its first window, with
timeline and curves drawn; the same from the navigation to an address that names it; from a turn of the wheel over the
timeline to the frame that shows it zoomed; from a click to its images. The server's memory is its largest since it
began (`VmHWM`), of the process that serves.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "browser"))
import browser_samples as samples
from browser_page import FLAGS, Dashboard, chromium_on_path
from browser_server import served

from dvsviz.events.events import Events
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.session.header import SessionHeader
from dvsviz.session.records import MapRevision, TrackerUpdates
from dvsviz.session.store import SessionWriter

_WINDOW_US = 12_000
_EVENTS = 200

# From the order to open the session to its first images: its timeline and curves are drawn by then.
_OPEN = """async () => {
  const from = performance.now();
  await window.dvsviz.open("long");
  return performance.now() - from;
}"""

# From a click on the timeline to its images.
_CLICK = """async ([x, y]) => {
  const box = document.getElementById("timeline");
  const from = performance.now();
  const shown = new Promise((resolve) => {
    addEventListener("dvsviz-shown", ({ detail }) => resolve(detail.at), { once: true });
  });
  const options = { clientX: x, clientY: y, pointerId: 1, button: 0, bubbles: true, isPrimary: true };
  box.setPointerCapture = () => {};
  box.dispatchEvent(new PointerEvent("pointerdown", options));
  box.dispatchEvent(new PointerEvent("pointerup", options));
  return (await shown) - from;
}"""

# From a turn of the wheel to the second frame after it: the first one draws.
_WHEEL = """async ([x, y, by]) => {
  const from = performance.now();
  const options = { clientX: x, clientY: y, deltaY: by, bubbles: true, cancelable: true };
  document.getElementById("timeline").dispatchEvent(new WheelEvent("wheel", options));
  await new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
  return performance.now() - from;
}"""

# Pixels of the timeline that are neither empty nor its most frequent colour: curves and lanes are drawn.
_DRAWN = """() => {
  const canvas = document.getElementById("timeline-lanes");
  const pixels = new Uint32Array(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.buffer);
  const counts = new Map();
  for (const value of pixels) counts.set(value, (counts.get(value) ?? 0) + 1);
  return pixels.length - Math.max(...counts.values());
}"""


def write(folder: Path, windows: int) -> Path:
    """Write recording and session; return the session's path."""
    rng = np.random.default_rng(1)
    recording = folder / "long.h5"
    with RecordingWriter(recording, camera=samples.CAMERA) as writer:
        for window in track(range(windows), "recording"):
            writer.append(
                Events(
                    t_us=samples.FIRST_US + _WINDOW_US * window + np.arange(_EVENTS) * (_WINDOW_US // _EVENTS),
                    x_px=rng.integers(0, samples.CAMERA.width, _EVENTS).astype(np.uint16),
                    y_px=rng.integers(0, samples.CAMERA.height, _EVENTS).astype(np.uint16),
                    is_positive=rng.integers(0, 2, _EVENTS).astype(bool),
                )
            )
    header = replace(
        samples.header(recording, windows),
        events=_EVENTS * windows,
        last_us=samples.FIRST_US + _WINDOW_US * windows,
    )
    (folder / "sessions").mkdir()
    samples.write_session(folder / "sessions" / "short.h5", recording, 300)
    return write_session(folder / "sessions" / "long.h5", header, windows)


def write_session(path: Path, header: SessionHeader, windows: int) -> Path:
    """Write a session with keyframes, growing maps and failures."""
    first = samples.updates(3).map_revisions[0]
    with SessionWriter.create(path, header) as writer:
        for window in track(range(windows), "session"):
            result = samples.result(window)
            writer.append(
                replace(
                    result,
                    start_us=samples.FIRST_US + _WINDOW_US * window,
                    end_us=samples.FIRST_US + _WINDOW_US * (window + 1),
                    first_event=_EVENTS * window,
                    end_event=_EVENTS * (window + 1),
                    map_revision=window // 200 if window > 2 else -1,
                )
            )
            updates = samples.updates(window)
            revisions: tuple[MapRevision, ...] = ()
            if window % 200 == 3:
                revisions = (replace(first, revision=window // 200, window=window),)
            writer.add(
                TrackerUpdates(
                    keyframes=updates.keyframes,
                    map_revisions=revisions,
                    failures=updates.failures,
                    log=updates.log,
                )
            )
        writer.close({"windows": windows})
    return path


def largest_mb(pid: int) -> float:
    """Largest resident memory of a process, MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3


def measure(page: Page, dashboard: Dashboard, windows: int, seeks: int) -> dict[str, Any]:
    """Open the session by the page's address, zoom and seek."""
    rng = np.random.default_rng(2)
    dashboard.enter("short")
    page.frame_locator("#scene iframe").locator("canvas").first.wait_for(timeout=30_000)
    page.wait_for_timeout(4000)
    opened_ms = page.evaluate(_OPEN)
    page.goto("about:blank")
    dashboard.enter("long")
    entered_ms = page.evaluate("performance.now()")
    drawn = int(page.evaluate(_DRAWN))
    state = dashboard.state
    if state["windows"] != windows or drawn < 1000:
        raise SystemExit(f"the page is not whole: {state}, {drawn} pixels drawn")
    clicks, wheels = [], []
    for _ in range(seeks):
        x, y = dashboard.timeline_x(float(rng.uniform(0.02, 0.98)))
        clicks.append(page.evaluate(_CLICK, [x, y]))
        page.wait_for_timeout(200)
        # In twice, out twice: at the end all is in view again.
        wheels += [page.evaluate(_WHEEL, [x, y, by]) for by in (-300, -300, 300, 300)]
        page.wait_for_timeout(200)
    return {
        "windows": windows,
        "first_click_ms": round(clicks[0], 1),
        "open_to_images_ms": round(opened_ms, 1),
        "navigation_to_images_ms": round(entered_ms, 1),
        "click_median_ms": round(float(np.median(clicks)), 1),
        "click_p95_ms": round(float(np.percentile(clicks, 95)), 1),
        "wheel_median_ms": round(float(np.median(wheels)), 1),
        "wheel_p95_ms": round(float(np.percentile(wheels, 95)), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--windows", type=int, default=100_000)
    parser.add_argument("--seeks", type=int, default=30)
    parser.add_argument(
        "--keep", type=Path, help="write recording and session to this folder, or take them from it"
    )
    parser.add_argument("--picture", type=Path, help="save what the page shows")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.keep or Path(scratch)
        folder.mkdir(exist_ok=True)
        if not (folder / "sessions" / "long.h5").exists():
            write(folder, asked.windows)
        figures: dict[str, Any] = {"session_mb": round((folder / "sessions" / "long.h5").stat().st_size / 1e6, 1)}
        running = served(folder / "sessions", folder / "cache")
        with running as address, sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium_on_path(), args=FLAGS)
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            dashboard = Dashboard(page, address)
            figures |= measure(page, dashboard, asked.windows, asked.seeks)
            if asked.picture:
                page.screenshot(path=asked.picture)
            browser.close()
            figures["server_largest_mb"] = round(largest_mb(running.process.pid), 1)
            if dashboard.problems:
                raise SystemExit(f"the console complains: {dashboard.problems}")
    if asked.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:22} {value}")


if __name__ == "__main__":
    main()
