"""Taking a session along from the page: each file comes, is what it says, and stands on its own."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from browser_page import Dashboard
from browser_samples import FAILURES, FIRST_US, WINDOW_US
from playwright.sync_api import Browser, Page, expect

pytestmark = pytest.mark.browser


@pytest.fixture
def alone(chromium: Browser) -> Iterator[tuple[Page, list[str], list[str]]]:
    """A page without any network, what its console complains of, and what it asks for."""
    context = chromium.new_context(viewport={"width": 1240, "height": 900}, offline=True, color_scheme="light")
    page = context.new_page()
    problems: list[str] = []
    asked: list[str] = []
    page.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: problems.append(str(e)))
    page.on("request", lambda r: asked.append(r.url))
    yield page, problems, asked
    context.close()


def test_a_report_shows_each_failure_with_pictures_and_needs_no_network(
    dashboard: Dashboard, alone: tuple[Page, list[str], list[str]], tmp_path: Path
) -> None:
    dashboard.enter("barcode")
    file = dashboard.save("report", tmp_path / "barcode.report.html")
    page, problems, asked = alone
    page.goto(file.as_uri())
    expect(page.locator("h1")).to_have_text("barcode", use_inner_text=True)
    expect(page.locator(".failure")).to_have_count(len(FAILURES))
    for number, failure in enumerate(FAILURES, 1):
        text = page.locator(f"#failure-{number}").inner_text()
        assert failure.message in text
        assert f"worst {failure.worst}" in text
        assert "What to do" in text
    expect(page.locator(".failure img")).to_have_count(3 * len(FAILURES))
    drawn = "[...document.images].every((i) => i.complete && i.naturalWidth === 240 && i.naturalHeight === 180)"
    page.wait_for_function(drawn)
    # Links of the numbered bands lead to their failures; the page is no wider than the window, nor is it on a tablet.
    page.locator(".chart .mark").first.click()
    assert page.url.endswith("#failure-1")
    for width in (1240, 760):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    light = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.emulate_media(color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") != light
    assert not problems
    assert {address.split(":")[0] for address in asked} <= {"file", "data"}
    assert not dashboard.problems


def test_the_scene_as_a_page_plays_without_a_server(
    dashboard: Dashboard, alone: tuple[Page, list[str], list[str]], tmp_path: Path
) -> None:
    dashboard.enter("barcode")
    file = dashboard.save("scene", tmp_path / "barcode.scene.html")
    page, problems, asked = alone
    page.goto(file.as_uri())
    page.locator("canvas").first.wait_for(timeout=20_000)
    colours = 0
    for _ in range(120):  # the first frame of a software renderer takes its time
        page.wait_for_timeout(250)
        image = cv2.imdecode(_bytes(page.screenshot()), cv2.IMREAD_COLOR_RGB)
        assert image is not None
        colours = int((abs(image.astype(int) - (0, 158, 115)).sum(axis=2) < 40).sum())
        if colours > 100:
            break
    assert colours > 100, "the tracked path is drawn in its colour"
    assert not problems
    assert {address.split(":")[0] for address in asked} <= {"file", "data", "blob"}


def test_the_video_of_the_visible_range_is_that_range(dashboard: Dashboard, tmp_path: Path) -> None:
    dashboard.enter("barcode", 100)
    dashboard.press("+", "+", "+")
    dashboard.press("e")
    with dashboard.page.expect_request("**/export") as asking:
        file = dashboard.save("webm", tmp_path / "x.webm")
    wanted = asking.value.post_data_json
    start, end = wanted["start_s"], wanted["end_s"]
    assert 0.0 < end - start < 9.0 / 4
    assert dashboard.page.locator("#export-stretch").inner_text().endswith("as the timeline shows")
    film = cv2.VideoCapture(str(file))
    count = 0
    while film.read()[0]:
        count += 1
    assert count == math.ceil((end - start) * 25 - 1e-6)
    assert not dashboard.problems


def test_an_export_that_is_stopped_says_so_and_the_next_one_is_made(dashboard: Dashboard, tmp_path: Path) -> None:
    dashboard.enter("barcode")
    dashboard.press("e")
    dashboard.page.locator("[data-export=webm]").click()
    stop = dashboard.page.get_by_role("button", name="Stop video of barcode")
    stop.click()
    row = dashboard.page.locator("#export-list .failed")
    row.wait_for()
    expect(row).to_contain_text("stopped", use_inner_text=True)
    expect(stop).to_have_count(0)
    table = pq.read_table(dashboard.save("parquet", tmp_path / "x.parquet"))
    assert table.num_rows == 300
    assert table["start_us"][7].as_py() == FIRST_US + 7 * WINDOW_US
    assert not dashboard.problems


def test_the_command_that_opens_rerun_is_there_to_copy(dashboard: Dashboard, tmp_path: Path) -> None:
    dashboard.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    dashboard.enter("gone")
    dashboard.save("rrd", tmp_path / "gone.rrd")
    dashboard.page.get_by_role("button", name="copy").click()
    # The button says so for a moment only: what counts is what can be pasted.
    dashboard.until(
        lambda: re.fullmatch(r"rerun gone\.rrd.*", dashboard.page.evaluate("navigator.clipboard.readText()")),
        "it is copied",
    )
    assert not dashboard.problems


def test_a_click_opens_reruns_viewer_at_the_window_of_the_page(dashboard_with_scene: Dashboard) -> None:
    """The real viewer of the installed rerun; drawn in software and small, or it takes half a minute."""
    page = dashboard_with_scene.page
    dashboard_with_scene.enter("gone", 41)
    dashboard_with_scene.press("e")
    link = page.locator("#export-rerun")
    expect(link).to_contain_text("at window 41")
    with page.expect_popup() as opening:
        link.click()
    viewer = opening.value
    loaded: list[str] = []
    viewer.on("requestfinished", lambda request: loaded.append(request.url))
    viewer.set_viewport_size({"width": 320, "height": 240})
    page.close()
    end = time.monotonic() + 90
    while not viewer.evaluate("Boolean(window.rerun)"):
        said = viewer.locator("#stage").inner_text() if viewer.locator(".failed").count() else "nothing"
        assert time.monotonic() < end and said == "nothing", f"the viewer said {said}"
        viewer.wait_for_timeout(200)
    state = _fields(bytes(viewer.evaluate("Array.from(window.rerun.viewer_state())")))
    recording = _fields(state[3][0])
    cursor = _fields(recording[3][0])
    assert _fields(cursor[1][0])[1] == [b"window"]
    assert _fields(cursor[3][0])[1] == [41]
    assert recording[5] == [1], "it is paused there"
    assert viewer.title() == "gone · window 41 · rerun"
    assert not [a for a in loaded if not a.startswith((dashboard_with_scene.base, "blob:", "data:"))]


def _fields(message: Any) -> dict[int, list[Any]]:
    """Return the fields of a protocol buffer by number: of rerun's `GetStateResponse` and of what it holds."""
    found: dict[int, list[Any]] = {}
    at = 0

    def number() -> int:
        nonlocal at
        value, shift = 0, 0
        while True:
            byte, at = message[at], at + 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(message):
        key = number()
        value: Any = number()
        if key & 7 == 2:
            at, value = at + value, message[at : at + value]
        found.setdefault(key >> 3, []).append(value)
    return found


def _bytes(png: bytes) -> np.ndarray:
    return np.frombuffer(png, dtype=np.uint8)
