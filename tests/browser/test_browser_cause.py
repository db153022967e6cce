"""Seeing the cause: images to choose from, the landscape of the objective, the causes explained."""

from __future__ import annotations

import pytest
from browser_page import Dashboard
from browser_samples import FAILURES
from playwright.sync_api import expect

pytestmark = pytest.mark.browser

_LIT = """(kind) => {
  const canvas = document.querySelector(`[data-kind=${kind}] canvas`);
  if (!canvas || canvas.hidden || canvas.dataset.window === undefined) return -1;
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let lit = 0;
  for (let i = 0; i < data.length; i += 4) lit += Math.max(data[i], data[i + 1], data[i + 2]) > 60;
  return lit;
}"""


# The heat map's canvas has a size and stays inside the scene's place, words and legend too.
_INSIDE = """() => {
  const box = document.getElementById("scene").getBoundingClientRect();
  return [...document.querySelectorAll("#landscape canvas, .landscape-says, .landscape-bar")].every((e) => {
    const b = e.getBoundingClientRect();
    return b.left >= box.left - 1 && b.right <= box.right + 1 && b.top >= box.top - 1 && b.bottom <= box.bottom + 1;
  }) && document.querySelector("#landscape canvas").getBoundingClientRect().height > 150;
}"""


def lit(dashboard: Dashboard, kind: str = "raw") -> int:
    """Pixels of an image that are not background; -1 where it is not shown."""
    return dashboard.page.evaluate(_LIT, kind)


def test_images_are_chosen_and_kept(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 40)
    expect(dashboard.page.locator("#images .cell")).to_have_count(4)
    dashboard.press("i")
    menu = dashboard.page.locator("#kinds-menu")
    for name in ("residual", "true motion", "true pose on map"):
        menu.get_by_label(name, exact=False).first.check()
    menu.get_by_label("texture").uncheck()
    dashboard.press("Escape")
    expect(menu).to_be_hidden()
    for kind in ("residual", "truth", "aligned"):
        dashboard.until(lambda k=kind: lit(dashboard, k) > 0, f"{kind} is drawn")
    expect(dashboard.page.locator("[data-kind=texture]")).to_have_count(0)
    # The estimate stands still and the truth moves: the true motion moves the code's squares.
    assert dashboard.decoded("warped") == 40
    # 7 keys for what is shown: the sixth is the last.
    dashboard.press("6")
    assert dashboard.page.locator("#images .cell:visible").get_attribute("data-kind") == "aligned"
    dashboard.press("6")
    dashboard.page.reload()
    dashboard.until(lambda: dashboard.loaded() and lit(dashboard, "aligned") > 0, "the choice is remembered")
    expect(dashboard.page.locator("#images .cell")).to_have_count(6)
    assert not dashboard.problems


def test_events_are_gathered_for_longer_and_shorter(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 40)
    one = lit(dashboard)
    dashboard.press(".")
    dashboard.until(lambda: lit(dashboard) > one, "two windows show two numbers")  # 40 and 41 differ in one bit
    assert dashboard.page.locator("#gathered").evaluate("e => e.selectedOptions[0].text") == "2 windows"
    dashboard.page.locator("#gathered").select_option(label="5 ms")
    dashboard.until(lambda: 0 < lit(dashboard) < 0.4 * one, "a sixth of the window's events is left")
    dashboard.page.locator("#gathered").select_option(label="this window")
    dashboard.until(lambda: lit(dashboard) == one, "one window again")
    dashboard.press("x")
    dashboard.until(lambda: 0.5 * one < lit(dashboard) < 0.8 * one, "two of three events are on")
    dashboard.press("x")
    dashboard.until(lambda: 0.2 * one < lit(dashboard) < 0.5 * one, "one of three is off")
    assert not dashboard.problems


def test_the_landscape_follows_the_playhead(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 50)
    dashboard.press("g")
    canvas = dashboard.page.locator("#landscape canvas")

    def stands_at(window: int) -> bool:
        return (canvas.get_attribute("data-window"), canvas.get_attribute("data-cells")) == (str(window), "33")

    # The first landscape may wait for its kernels to be compiled.
    dashboard.until(lambda: stands_at(50), "the landscape of window 50 is there", 60)
    legend = dashboard.page.locator(".landscape-marks")
    for mark in ("estimate", "prior", "truth", "summit"):
        expect(legend).to_contain_text(mark, use_inner_text=True)
    # The window's weakest direction is what is shown first.
    axes = dashboard.page.locator(".landscape-bar select")
    assert [axes.nth(i).evaluate("e => e.selectedOptions[0].text") for i in (1, 2)] == [
        "rotation about x",
        "motion along y",
    ]
    dashboard.run("seek(60)")
    dashboard.until(lambda: stands_at(60), "the fine landscape follows", 60)
    axes.first.select_option("map")
    axes.nth(1).select_option(label="motion along y")  # the other axis gives way
    assert axes.nth(2).evaluate("e => e.selectedOptions[0].text") != "motion along y"
    dashboard.until(
        lambda: "How well the window lies on the map" in dashboard.page.locator(".landscape-note").inner_text(),
        "the landscape of the map score comes",
    )
    dashboard.run("seek(1)")
    dashboard.page.locator(".landscape-hint", has_text="there is no map yet at this window").wait_for()
    dashboard.press("g")
    expect(dashboard.page.locator("#landscape")).to_be_hidden()
    dashboard.press("ArrowRight")
    dashboard.until_shown(2)
    assert not dashboard.problems


def test_without_the_recording_the_landscape_says_why(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 5)
    dashboard.page.get_by_role("link", name="gone").click()
    dashboard.until(lambda: dashboard.state["session"] == "gone" and dashboard.state["windows"] == 60, "it opens")
    dashboard.press("g")
    dashboard.page.get_by_text("No landscape here: the recording is not there any more").wait_for()
    assert not dashboard.problems


def test_curves_are_chosen_and_drawn(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 50)
    dashboard.press("u")
    menu = dashboard.page.locator("#curves-menu")
    for name in ("occupied", "x d", "yaw", "roll"):
        menu.get_by_label(name, exact=False).first.check()
    menu.get_by_label("overlap").uncheck()
    dashboard.press("Escape")
    # The code has 16 squares of 100 pixels; more rows make the timeline higher.
    curves = """(set) => fetch(`/api/sessions/barcode/columns?start=0&set=${set}`)
      .then((answer) => answer.arrayBuffer())
      .then((buffer) => buffer.byteLength)"""
    # Pixels are counted window by window, in the background.
    dashboard.until(lambda: dashboard.page.evaluate(curves, "pixels") > 300 * 4, "all windows are counted")
    assert dashboard.page.evaluate(curves, "pose") > 12 * 300 * 4

    def height() -> float:
        box = dashboard.page.locator(".bottom").bounding_box()
        return 0.0 if box is None else box["height"]

    dashboard.until(lambda: height() > 250, "the timeline is higher")
    low = height()
    dashboard.page.locator("#bottom-grip").focus()
    dashboard.press("ArrowUp", "ArrowUp")
    dashboard.until(lambda: height() > low + 40, "it is higher still")
    dashboard.page.mouse.click(*dashboard.timeline_x(0.5))
    dashboard.until_shown(dashboard.state["window"])
    dashboard.page.reload()
    dashboard.until(lambda: dashboard.loaded() and dashboard.state["shown"] is not None, "the page is back")
    dashboard.press("u")
    expect(menu.get_by_label("roll")).to_be_checked()
    menu.get_by_role("button", name="As at first").click()
    expect(menu.get_by_label("roll")).not_to_be_checked()
    assert not dashboard.problems


def test_causes_are_explained_and_filtered(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", FAILURES[1].worst)
    dashboard.press("w")
    panel = dashboard.page.locator("#panel-failures")
    expect(panel.locator(".explanation")).to_contain_text("farther than the search reaches", use_inner_text=True)
    dashboard.press("Enter")  # the button has the focus: it hides what it showed
    expect(panel.locator(".explanation")).to_have_count(0)
    panel.get_by_role("button", name="Why: too little texture").click()
    expect(panel.locator(".explanation")).to_contain_text("150 edge pixels", use_inner_text=True)
    panel.get_by_label("Cause", exact=True).select_option("too_fast")
    expect(panel.locator(".failure-row")).to_have_count(1)
    dashboard.press("p")
    dashboard.page.locator("#failure-why").click()
    expect(panel.locator(".explanation")).to_contain_text("Told from", use_inner_text=True)
    dashboard.run("seek(50)")
    expect(dashboard.page.locator("#failure-why")).to_be_hidden()
    panel.get_by_role("button", name=f"Landscape at its worst window, {FAILURES[0].worst}").click()
    dashboard.until_shown(FAILURES[0].worst)
    expect(dashboard.page.locator("#landscape")).to_be_visible()
    for width, height in ((1280, 800), (3840, 2160), (1024, 1366)):
        dashboard.page.set_viewport_size({"width": width, "height": height})
        dashboard.until(lambda: dashboard.page.evaluate(_INSIDE), f"the landscape has its place at {width}", 5)
    assert not dashboard.problems
