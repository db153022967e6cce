"""The page around a session: list, door, help, export, sizes; nothing in the console or from elsewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from browser_page import Dashboard
from browser_samples import FAILURES, pose
from playwright.sync_api import Browser, Download, expect

pytestmark = pytest.mark.browser


def test_the_scene_is_drawn_follows_and_has_layers(dashboard_with_scene: Dashboard) -> None:
    dashboard = dashboard_with_scene
    dashboard.enter("barcode", 50)
    frame = dashboard.page.frame_locator("#scene iframe")
    frame.locator("canvas").first.wait_for(timeout=20_000)

    def picture() -> np.ndarray:
        shot = np.frombuffer(dashboard.page.locator("#scene").screenshot(), np.uint8)
        image = cv2.imdecode(shot, cv2.IMREAD_COLOR)
        assert image is not None
        return image[5:-5, 5:-5]

    # Map rings, trajectory, frustum: far more than the flat ground of an empty canvas.
    dashboard.until(lambda: len(np.unique(picture().reshape(-1, 3), axis=0)) > 200, "something is drawn", 30)

    def at_rest() -> bool:
        first = picture()
        dashboard.page.wait_for_timeout(700)
        return bool(np.abs(picture().astype(int) - first).max() < 40)

    dashboard.until(at_rest, "the scene comes to rest", 30)
    before = picture()
    dashboard.run("seek(150)")
    dashboard.until(lambda: np.abs(picture().astype(int) - before).max() > 100, "the camera moves in the scene", 30)
    for layer in ("map", "trajectory", "keyframes", "truth", "frustum"):
        button = dashboard.page.locator(f"[data-layer={layer}]")
        button.click()
        expect(button).to_have_attribute("aria-pressed", "false")
    dashboard.until(
        lambda: len(np.unique(picture().reshape(-1, 3), axis=0)) < 100, "nothing is left of the scene", 30
    )
    # Every key that does something, then nothing was said in the console or fetched from elsewhere.
    dashboard.press("n", "Space", "ArrowRight", "?", "?", "1", "1", "t", "t", "t", "+", "-", "0", "l", "Escape")
    dashboard.page.wait_for_timeout(300)
    assert not dashboard.problems
    assert [url for url in dashboard.requests if not url.startswith((dashboard.base, "blob:", "data:"))] == []


def test_without_webgl_the_rest_works_and_it_is_said(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 50)
    dashboard.page.get_by_role("heading", name="No 3-D scene").wait_for()
    dashboard.run("seek(60)")
    assert dashboard.decoded() == 60
    assert not dashboard.problems


def test_the_timeline_is_not_blank(dashboard: Dashboard) -> None:
    dashboard.enter("barcode")
    colours = dashboard.page.evaluate(
        """() => {
          const canvas = document.getElementById("timeline-lanes");
          const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          const seen = new Set();
          for (let i = 0; i < data.length; i += 4)
            if (data[i + 3] === 255) seen.add((data[i] << 16) + (data[i + 1] << 8) + data[i + 2]);
          return [...seen];
        }"""
    )
    for state_colour in (0x009E73, 0xE69F00, 0xD55E00):
        assert state_colour in colours


def test_a_browser_without_the_token_is_told_what_to_do(flat_chromium: Browser, server: str) -> None:
    context = flat_chromium.new_context()
    page = context.new_page()
    for address in ("#token=wrong", "", "#session=barcode&window=3"):
        page.goto("about:blank")
        page.goto(server.split("#")[0] + address)
        page.get_by_role("heading", name="This page needs its key").wait_for()
        assert "token" not in page.url
        expect(page.locator(".session-list")).to_be_hidden()
    page.get_by_label("Address or token").fill("nonsense")
    page.get_by_role("button", name="Open").click()
    page.get_by_text("This token is not the one of the running server.").wait_for()
    page.get_by_label("Address or token").fill(server)
    page.get_by_role("button", name="Open").click()
    page.locator(".session-list a").first.wait_for()
    expect(page.locator("#door")).to_be_hidden()
    context.close()


def test_the_list_is_filtered_and_walked_by_keyboard(dashboard: Dashboard) -> None:
    dashboard.enter("barcode")
    dashboard.press("/")
    dashboard.page.keyboard.type("gon")
    expect(dashboard.page.locator(".session-list a")).to_have_count(1)
    dashboard.page.keyboard.type("zzz")
    expect(dashboard.page.locator("#session-none")).to_contain_text("gonzzz", use_inner_text=True)
    for _ in "zzz":
        dashboard.press("Backspace")
    dashboard.press("ArrowDown", "Enter")
    dashboard.until(lambda: dashboard.state["session"] == "gone", "the session is opened by keyboard")


def test_a_session_that_does_not_exist_is_said(dashboard: Dashboard) -> None:
    dashboard.page.goto(dashboard.address + "&session=lost-and-gone")
    dashboard.page.get_by_role("heading", name="There is no session called “lost-and-gone”").wait_for()
    dashboard.page.get_by_role("link", name="barcode").click()
    dashboard.until(lambda: dashboard.state["shown"] is not None, "another can be chosen")


def test_help_opens_and_closes(dashboard: Dashboard) -> None:
    dashboard.enter("barcode")
    dashboard.press("?")
    expect(dashboard.page.locator("dialog#help")).to_be_visible()
    expect(dashboard.page.locator("dialog#help")).to_contain_text("next failure", use_inner_text=True)
    dashboard.press("Escape")
    expect(dashboard.page.locator("dialog#help")).to_be_hidden()


def test_the_export_buttons_give_files(dashboard: Dashboard, tmp_path: Path) -> None:
    dashboard.enter("barcode")
    dashboard.press("e")
    downloads: list[Download] = []
    dashboard.page.on("download", lambda download: downloads.append(download))
    listed = dashboard.page.locator("#export-list")
    begins = {"tum": b"", "csv": b"window,start_us", "png": b"\x89PNG", "rrd": b"RRF2"}
    for number, (to, begin) in enumerate(begins.items(), 1):
        dashboard.page.locator(f"[data-export={to}]").click()
        dashboard.until(lambda n=number: len(downloads) == n or "failed" in listed.inner_html(), f"{to} comes", 45)
        assert len(downloads) == number, listed.inner_text()
        assert downloads[-1].suggested_filename == f"barcode.{to}"
        downloads[-1].save_as(tmp_path / to)
        assert (tmp_path / to).read_bytes().startswith(begin)
    rows = [line.split() for line in (tmp_path / "tum").read_text().splitlines() if not line.startswith("#")]
    assert len(rows) > 200
    assert all(len(row) == 8 for row in rows)
    table = [line.split(",") for line in (tmp_path / "csv").read_text().splitlines()]
    assert len(table) == 301
    row = dict(zip(table[0], table[1 + FAILURES[0].worst], strict=True))
    assert (row["window"], row["status"]) == (str(FAILURES[0].worst), "lost")
    assert float(row["x"]) == pytest.approx(pose(FAILURES[0].worst)[0, 3], abs=1e-8)
    texture = cv2.imread(str(tmp_path / "png"), cv2.IMREAD_GRAYSCALE)
    assert texture is not None
    assert (texture.shape, int(texture.max())) == ((180, 240), 230)
    expect(dashboard.page.get_by_role("link", name="save again")).to_have_count(4)


def test_a_loop_stays_inside(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 5)
    dashboard.page.keyboard.down("Shift")
    dashboard.page.mouse.move(*dashboard.timeline_x(0.5))
    dashboard.page.mouse.down()
    dashboard.page.mouse.move(*dashboard.timeline_x(0.52), steps=4)
    dashboard.page.mouse.up()
    dashboard.page.keyboard.up("Shift")
    dashboard.run("play()")
    for _ in range(12):
        dashboard.page.wait_for_timeout(80)
        assert 148 <= dashboard.state["window"] <= 158
    assert dashboard.state["playing"]


def test_the_wheel_zooms_where_the_pointer_is(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 5)
    dashboard.page.mouse.move(*dashboard.timeline_x(0.5))
    for _ in range(4):
        dashboard.page.mouse.wheel(0, -240)
        dashboard.page.wait_for_timeout(40)

    def clicked() -> int:
        # The browser does not wait for the wheel: a click may still come before it.
        dashboard.page.mouse.click(*dashboard.timeline_x(0.9))
        return dashboard.state["window"]

    # Sixteen times closer: 0.9 of the view is 0.4/16 of the session right of its middle.
    dashboard.until(lambda: abs(clicked() - 157) <= 2, "a click lands in the enlarged stretch")
    dashboard.until(lambda: abs(dashboard.state["shown"] - 157) <= 2, "what is there is shown")
    dashboard.press("0")
    dashboard.page.mouse.click(*dashboard.timeline_x(0.9))
    dashboard.until(lambda: abs(dashboard.state["shown"] - 270) <= 1, "the whole session is back")


_OUTSIDE = """() => [...document.querySelectorAll("button, select, canvas, h1, .clock, .failure, .tabs, .empty")]
  .filter((e) => e.checkVisibility({ visibilityProperty: true }) && !e.closest(".sessions, .panel, [hidden]"))
  .filter((e) => {
    const b = e.getBoundingClientRect();
    return b.width && (b.right > innerWidth + 1 || b.bottom > innerHeight + 1 || b.left < -1 || b.top < -1);
  })
  .map((e) => e.id || e.className || e.tagName)"""

_NUMBERS_OUT_OF_VIEW_PX = """() => {
  const panel = document.getElementById("panel-numbers");
  return panel.scrollHeight - panel.clientHeight;
}"""


def test_nothing_overflows_at_any_size(dashboard: Dashboard) -> None:
    page = dashboard
    page.enter("barcode", 106)
    for width, height in ((1280, 800), (1920, 1080), (3840, 2160), (1024, 768), (1024, 1366), (820, 1180)):
        page.page.set_viewport_size({"width": width, "height": height})
        page.page.wait_for_timeout(150)
        page.until(lambda: page.page.evaluate(_OUTSIDE) == [], f"nothing is outside at {width}")
        if width >= 1280:  # on a tablet the numbers scroll
            page.until(lambda: page.page.evaluate(_NUMBERS_OUT_OF_VIEW_PX) <= 2, f"all numbers are seen at {width}")
    schemes: tuple[Literal["dark", "light"], ...] = ("dark", "light")
    for scheme in schemes:
        page.page.emulate_media(color_scheme=scheme)
        background = page.page.evaluate("getComputedStyle(document.body).backgroundColor")
        brightness = sum(map(int, re.findall(r"\d+", background)[:3])) / 3
        assert brightness < 80 if scheme == "dark" else brightness > 180
    assert not page.problems


def test_every_control_has_a_name(dashboard: Dashboard) -> None:
    dashboard.enter("barcode")
    nameless = dashboard.page.evaluate(
        """() => [...document.querySelectorAll("button, select, input, [role=slider], iframe, [role=tab]")]
          .filter((e) => !(e.getAttribute("aria-label") || e.title || e.textContent.trim() || e.labels?.length))
          .map((e) => e.outerHTML)"""
    )
    assert nameless == []
    slider = dashboard.page.get_by_role("slider")
    assert slider.get_attribute("aria-valuemax") == "299"
    assert "window" in (slider.get_attribute("aria-valuetext") or "")
