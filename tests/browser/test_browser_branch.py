"""Trying again from a window in the page: settings, a camera that is placed, the branch beside its origin."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser_page import Dashboard
from browser_server import served
from playwright.sync_api import Browser, expect

from dvsviz.config import TrackerConfig
from dvsviz.formats.open import open_recording
from dvsviz.geometry.camera import Camera
from dvsviz.pipeline import track
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tried")
    recording = folder / "recordings" / "wall.h5"
    recording.parent.mkdir()
    camera = Camera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5)
    simulate(recording, seconds=1.6, seed=1, camera=camera)
    track(open_recording(recording), TrackerConfig(window=3000), folder / "wall.h5")
    return folder


@pytest.fixture(scope="module")
def address(sessions: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served(sessions, tmp_path_factory.mktemp("cache")) as address:
        yield address


def opened(browser: Browser, address: str) -> Dashboard:
    context = browser.new_context(viewport={"width": 1280, "height": 800}, color_scheme="dark")
    return Dashboard(context.new_page(), address)


def test_a_branch_runs_beside_its_origin_and_is_kept_or_discarded(
    flat_chromium: Browser, address: str, sessions: Path
) -> None:
    dashboard = opened(flat_chromium, address)
    page = dashboard.page
    dashboard.enter("wall", 2)
    page.locator("#try-here").click()
    expect(page.get_by_role("tab", name="Try again")).to_have_attribute("aria-selected", "true")
    go = page.locator("#panel-try .go")
    expect(go).to_have_text("Try again from window 2")
    window = dashboard.state["windows"] // 2
    dashboard.run(f"seek({window})")
    expect(go).to_have_text(f"Try again from window {window}")
    # The settings are those of the session; one is changed, and the camera is put elsewhere by hand.
    settings = page.locator("#panel-try")
    expect(settings.get_by_label("Window", exact=True)).to_have_value("3000")
    settings.get_by_label("Window", exact=True).fill("1500")
    settings.get_by_label("Start from a pose of my own").check()
    seen = page.locator(".trial-seen")
    dashboard.until(lambda: "of the edges" in seen.inner_text(), "the window is seen from there")

    def share() -> float:
        return float(seen.inner_text().split("%")[0].strip())

    before = share()
    for _ in range(8):
        page.get_by_label("+move x").click()
    dashboard.until(lambda: share() < before - 10, "fewer edges lie on the map")
    expect(settings).to_contain_text("0.080 d", use_inner_text=True)
    page.get_by_role("button", name="back to the estimate").click()
    dashboard.until(lambda: abs(share() - before) < 1, "they lie on it again")
    page.get_by_label("+turn z").click()
    dashboard.until(lambda: "1.0°" in settings.inner_text(), "the turn is told")
    # The playhead may go elsewhere: the window that the camera was placed at is the one that is tried.
    dashboard.run("seek(3)")
    expect(go).to_have_text(f"Try again from window {window}")
    go.click()
    branch = page.locator("[data-branch='wall try']")
    branch.wait_for()
    expect(seen).to_be_hidden()
    dashboard.until(lambda: "shown" in (branch.get_attribute("class") or ""), "it is shown beside", 120)
    dashboard.until(lambda: "done" in branch.inner_text(), "it ends", 60)
    dashboard.until(lambda: "position error" in branch.inner_text(), "both errors are told")
    expect(branch).to_contain_text(
        f"from window {window}: window 1500 instead of 3000, pose by hand", use_inner_text=True
    )
    with open_session(sessions / "branches" / "wall try.h5") as tried, open_session(sessions / "wall.h5") as wall:
        origin = tried.header.origin
        assert origin is not None and origin.window == window and origin.T_world_camera is not None
        assert np.array_equal(tried.column("start_us")[:window], wall.column("start_us")[:window])
    # The timeline has its colour where the branch is, and not before.
    tried_pixels = """(share) => {
      const canvas = document.getElementById("timeline-lanes");
      const pen = canvas.getContext("2d", { willReadFrequently: true });
      const x = Math.round(canvas.width * (0.14 + 0.82 * share));
      const data = pen.getImageData(x, 0, 8, canvas.height).data;
      let count = 0;
      for (let i = 0; i < data.length; i += 4)
        if (Math.abs(data[i] - 222) < 12 && Math.abs(data[i + 1] - 165) < 12 && data[i + 2] > 240) count++;
      return count;
    }"""
    dashboard.until(lambda: page.evaluate(tried_pixels, 0.8) > 8, "the branch is drawn")
    assert page.evaluate(tried_pixels, 0.2) == 0
    # It stands under its origin in the list, and can be opened, compared, and kept.
    named = "links => links.map((link) => link.dataset.name)"
    dashboard.until(
        lambda: page.locator("#session-list a").evaluate_all(named) == ["wall", "wall try"], "it is listed"
    )
    branch.get_by_role("link", name="compare").wait_for()
    assert "compare=wall%20try" in (branch.get_by_role("link", name="compare").get_attribute("href") or "")
    branch.get_by_role("link", name="open").click()
    dashboard.until(lambda: dashboard.state["session"] == "wall try", "the branch is opened")
    origin_words = page.locator("#panel-try .origin")
    dashboard.until(
        lambda: f"Branch of wall from window {window}" in origin_words.inner_text(), "its origin is told"
    )
    origin_words.get_by_role("button", name="Keep…").click()
    page.locator("#manage").get_by_label("Name").first.fill("wall better")
    page.locator("#manage").get_by_role("button", name="Keep as a session").click()
    dashboard.until(lambda: dashboard.state["session"] == "wall better", "it is kept")
    assert (sessions / "wall better.h5").exists() and not (sessions / "branches" / "wall try.h5").exists()
    # Another one is tried and discarded.
    dashboard.run("open('wall')")
    dashboard.until(lambda: not go.is_disabled(), "the panel is ready")
    settings.get_by_label("Motion").select_option("rotation")
    go.click()
    branch.wait_for()
    dashboard.until(lambda: "done" in branch.inner_text(), "it ends", 120)
    branch.get_by_role("button", name="discard").click()
    page.locator("#ask").get_by_role("button", name="Discard").click()
    dashboard.until(lambda: branch.count() == 0, "it is gone")
    assert not list((sessions / "branches").glob("*.h5"))
    assert (sessions / "wall.h5").exists() and (sessions / "recordings" / "wall.h5").exists()
    assert not dashboard.problems
    page.context.close()


def test_the_camera_is_dragged_in_the_scene(chromium: Browser, address: str) -> None:
    dashboard = opened(chromium, address)
    page = dashboard.page
    dashboard.enter("wall", 12)
    page.frame_locator("#scene iframe").locator("canvas").first.wait_for(timeout=30_000)
    page.wait_for_timeout(1500)
    page.locator("#try-here").click()
    page.get_by_label("Start from a pose of my own").check()
    panel = page.locator("#panel-try")
    expect(panel).to_contain_text("0.000 d")
    page.wait_for_timeout(1500)
    box = page.locator("#scene").bounding_box()
    assert box is not None

    # The handles lie around the camera: wherever one is caught, the camera follows and the page is told.
    def has_moved() -> bool:
        return "0.000 d and 0.0°" not in panel.inner_text()

    for x, y in [(0.1 + 0.04 * i, 0.5 + 0.06 * j) for j in range(8) for i in range(10)]:
        page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.wait_for_timeout(60)
        page.mouse.down()
        page.mouse.move(box["x"] + x * box["width"] + 30, box["y"] + y * box["height"] - 20, steps=4)
        page.wait_for_timeout(60)
        page.mouse.up()
        if has_moved():
            break
    dashboard.until(has_moved, "the camera follows")
    page.context.close()
