"""How long a seek takes in the browser: from the click to the images on the screen, and to the 3-D scene drawn.

    python benchmarks/seek.py ADDRESS [--session NAME] [--seeks 60] [--json]

ADDRESS is what `dvsviz serve` prints. Clocks are inside the page. A seek is a real click on the timeline; the images
count when they were decoded and painted, the scene when the first frame with another camera matrix was drawn and read
back (software rendering is so included). Run it once beside an idle server and once while a recording is tracked.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "browser"))
from browser_page import FLAGS, Dashboard, chromium_on_path

# Inside the frame of the 3-D scene: a frame's matrices are summed up; a frame with another sum shows another pose.
_WATCH_SCENE = """() => {
  if (!location.pathname.startsWith("/viser/")) return;
  let sum = 0, frame = 0, gl = null;
  const proto = WebGL2RenderingContext.prototype;
  const matrix = proto.uniformMatrix4fv;
  proto.uniformMatrix4fv = function (where, transpose, values, ...rest) {
    for (let i = 0; i < 16; i++) sum += values[i] * (i + 1);
    gl = this;
    if (!frame) frame = setTimeout(() => {
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      (parent.sceneFrames ??= []).push({ sum, at: performance.timeOrigin + performance.now() });
      sum = 0;
      frame = 0;
    });
    return matrix.call(this, where, transpose, values, ...rest);
  };
}"""

# One seek: a click at a place of the timeline, then the clock of the paint and of the first other scene.
_SEEK = """async ([x, y, patience]) => {
  const box = document.getElementById("timeline");
  const frames = (window.sceneFrames ??= []);
  const before = frames.at(-1)?.sum;
  const was = window.dvsviz.state.window;
  frames.length = 0;
  const from = performance.timeOrigin + performance.now();
  const painted = new Promise((resolve) => {
    addEventListener("dvsviz-shown", ({ detail }) => resolve(detail), { once: true });
  });
  const options = { clientX: x, clientY: y, pointerId: 1, button: 0, bubbles: true, isPrimary: true };
  box.setPointerCapture = () => {};
  box.dispatchEvent(new PointerEvent("pointerdown", options));
  box.dispatchEvent(new PointerEvent("pointerup", options));
  if (window.dvsviz.state.window === was) return null;
  const shown = await Promise.race([painted, new Promise((resolve) => setTimeout(resolve, 10_000, null))]);
  if (!shown) throw new Error("no image came within 10 s");
  const images = performance.timeOrigin + shown.at - from;
  while (performance.timeOrigin + performance.now() - from < patience) {
    await new Promise((resolve) => setTimeout(resolve, 10));
    const moved = frames.find(({ sum, at }) => at > from && Math.abs(sum - before) > 1e-7);
    if (moved) return { images, scene: moved.at - from, right: shown.window === window.dvsviz.state.window };
  }
  return { images, scene: null, right: shown.window === window.dvsviz.state.window };
}"""


def measure(page: Page, dashboard: Dashboard, seeks: int, seed: int) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    images, scene, wrong, unmoved, unmoving = [], [], 0, 0, 0
    while len(images) < seeks:
        if unmoving > 50:
            raise SystemExit("clicks do not move the playhead: does the session hold enough windows?")
        x, y = dashboard.timeline_x(float(rng.uniform(0.02, 0.98)))
        took = page.evaluate(_SEEK, [x, y, 3000])
        if took is None:  # the click fell on the window that was shown
            unmoving += 1
            page.wait_for_timeout(50)
            continue
        unmoving = 0
        images.append(took["images"])
        wrong += not took["right"]
        if took["scene"] is None:
            unmoved += 1
        else:
            scene.append(took["scene"])
        page.wait_for_timeout(int(rng.uniform(250, 500)))
    return {
        "seeks": seeks,
        "wrong_window": wrong,
        "scene_not_seen_to_move": unmoved,
        "images_median_ms": round(float(np.median(images)), 1),
        "images_p95_ms": round(float(np.percentile(images, 95)), 1),
        "scene_median_ms": round(float(np.median(scene)), 1) if scene else None,
        "scene_p95_ms": round(float(np.percentile(scene, 95)), 1) if scene else None,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address")
    parser.add_argument("--session")
    parser.add_argument("--seeks", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_on_path(), args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(f"({_WATCH_SCENE})()")
        dashboard = Dashboard(page, asked.address)
        dashboard.enter(asked.session)
        page.frame_locator("#scene iframe").locator("canvas").first.wait_for(timeout=30_000)
        page.wait_for_timeout(4000)
        measure(page, dashboard, 5, asked.seed + 1)  # warms caches and shaders
        figures = {"session": dashboard.state["session"], **measure(page, dashboard, asked.seeks, asked.seed)}
        browser.close()
    if asked.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:24} {value}")


if __name__ == "__main__":
    main()
