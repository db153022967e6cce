"""A registration of frames in the dashboard: listed, opened, scrubbed; its pictures, captions and sentence."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from browser_page import Dashboard
from browser_server import served
from playwright.sync_api import Browser, expect

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.registration import (
    RegistrationRecord,
    StoredFrame,
    StoredRun,
    StoredStep,
    write_registration,
)

pytestmark = pytest.mark.browser

COUNT, LOST = 8, 5
# Pixels of a colour on the canvas of a picture.
_COLOURED = """([kind, red, green, blue]) => {
  const canvas = document.querySelector(`[data-kind=${kind}] canvas`);
  if (canvas.hidden) return -1;
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let found = 0;
  for (let i = 0; i < data.length; i += 4)
    found += data[i] === red && data[i + 1] === green && data[i + 2] === blue;
  return found;
}"""
GREEN, ORANGE = [86, 220, 160], [240, 120, 30]


def make_record() -> RegistrationRecord:
    """Eight frames of a camera that goes sideways; frame 5 was lost."""
    camera = Camera(width=160, height=100, fx=150.0, fy=150.0, cx=79.5, cy=49.5)
    Ts = se3.pose(np.eye(3), np.column_stack([0.05 * np.arange(COUNT), np.zeros(COUNT), np.zeros(COUNT)]))
    t_us = np.arange(COUNT, dtype=np.int64) * 100_000
    errors = np.column_stack([np.full((COUNT - 1, 2), 0.01), *[0.01 * np.arange(1, COUNT)] * 2])
    runs = tuple(
        StoredRun(name=name, skip=1, t_us=t_us, Ts_world_camera=Ts, errors=errors, row={"method": name})
        for name in ("kabsch", "epnp")
    )
    grey = cv2.imencode(".jpg", np.full((100, 160), 90, np.uint8))[1].tobytes()
    depth = cv2.imencode(".png", np.full((100, 160), 2000, np.uint16))[1].tobytes()
    rng = np.random.default_rng(1)
    steps = []
    for k in range(1, COUNT):
        b = rng.uniform([20, 20], [140, 80], (30, 2)).astype(np.float32)
        inlier = np.arange(30) < (0 if k == LOST else 20)
        points = np.column_stack([camera.bearings(b[inlier]), np.ones(inlier.sum())]).astype(np.float32) * 2
        reason = "only 0 points agree with one motion" if k == LOST else ""
        steps.append(
            StoredStep(against=k - 1, pixels_a=b + 4, pixels_b=b, is_inlier=inlier, points=points, reason=reason)
        )
    return RegistrationRecord(
        source=Path("frames"),
        camera=camera,
        features="sift",
        runs=runs,
        primary=0,
        frames=(StoredFrame(grey=grey, depth=depth),) * COUNT,
        steps=tuple(steps),
        truth=Trajectory(t_us=t_us, Ts_world_camera=Ts),
        mean_depth=2.0,
    )


def test_a_registration_is_listed_and_scrubbed(flat_chromium: Browser, tmp_path: Path) -> None:
    folder = tmp_path / "sessions"
    write_registration(folder / "flight.h5", make_record())
    with served(folder, tmp_path / "cache") as address:
        page = flat_chromium.new_context(viewport={"width": 1280, "height": 800}).new_page()
        dashboard = Dashboard(page, address)
        dashboard.enter("flight", 2)
        captions = page.locator("#images .caption b").all_inner_texts()
        assert captions == ["pair of frames", "matches", "depth", "errors of all methods"]
        assert page.evaluate(_COLOURED, ["warped", *GREEN]) > 100
        assert page.evaluate(_COLOURED, ["warped", *ORANGE]) > 50
        expect(page.locator("[data-kind=warped] .caption")).to_contain_text("20 of 30 agree", use_inner_text=True)
        expect(page.locator("body")).to_contain_text("kabsch, skip 1: frame 2 against 1", use_inner_text=True)
        dashboard.run(f"seek({LOST})")
        assert dashboard.state["status"] == "lost"
        assert page.evaluate(_COLOURED, ["warped", *GREEN]) == 0
        expect(page.locator("body")).to_contain_text("only 0 points agree", use_inner_text=True)
        dashboard.run("seek(0)")
        assert page.evaluate(_COLOURED, ["warped", *ORANGE]) == 0
        assert not dashboard.problems
        page.context.close()
