"""A session in the browser: the right window is on the screen, however one got there."""

from __future__ import annotations

import numpy as np
import pytest
from browser_page import Dashboard
from browser_samples import FAILURES, WINDOW_US
from playwright.sync_api import expect

pytestmark = pytest.mark.browser


def test_the_printed_address_opens_a_session(dashboard: Dashboard) -> None:
    dashboard.page.goto(dashboard.address)
    dashboard.until(lambda: dashboard.loaded() and dashboard.state["shown"] is not None, "images are shown")
    assert "token" not in dashboard.page.url
    assert dashboard.state["session"] in ("barcode", "gone", "growing")
    dashboard.until(lambda: dashboard.page.locator(".session-list a").count() >= 2, "sessions are listed")
    assert not dashboard.problems


def test_a_session_opens_at_its_first_failure_with_the_right_image(dashboard: Dashboard) -> None:
    dashboard.enter("barcode")
    dashboard.until_shown(FAILURES[0].worst)
    assert dashboard.state["status"] == "lost"
    expect(dashboard.page.locator("#failure-title")).to_have_text(FAILURES[0].message, use_inner_text=True)
    # The velocity of the sample is zero: the warped window shows the same code.
    assert dashboard.decoded("warped") == FAILURES[0].worst


def test_clicks_and_drags_on_the_timeline_seek(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 5)
    for share in (0.25, 0.7, 0.031):
        dashboard.page.mouse.click(*dashboard.timeline_x(share))
        expected = int(share * 300)
        dashboard.until(lambda e=expected: abs(dashboard.state["shown"] - e) <= 1, f"window {expected} is shown")
        dashboard.until_shown(dashboard.state["window"])
    dashboard.page.mouse.move(*dashboard.timeline_x(0.1))
    dashboard.page.mouse.down()
    for share in np.linspace(0.1, 0.9, 60):
        dashboard.page.mouse.move(*dashboard.timeline_x(float(share)))
    dashboard.page.mouse.up()
    assert abs(dashboard.state["window"] - 270) <= 1
    dashboard.until_shown(dashboard.state["window"])


def test_the_script_interface(dashboard: Dashboard) -> None:
    dashboard.enter("gone")
    dashboard.run("open('barcode')")
    dashboard.run("seek(42)")
    assert dashboard.state["shown"] == 42
    assert dashboard.decoded() == 42
    state = dashboard.state
    assert set(state) >= {"session", "windows", "window", "shown", "status", "playing", "speed", "live"}
    assert (state["session"], state["windows"], state["status"], state["live"]) == (
        "barcode",
        300,
        "tracking",
        False,
    )
    dashboard.run("play()")
    assert dashboard.state["playing"] is True
    dashboard.until(lambda: dashboard.state["shown"] > 45, "playing moves on")
    dashboard.run("pause()")
    assert dashboard.state["playing"] is False
    dashboard.until_shown(dashboard.state["window"])
    wrong = dashboard.page.evaluate("window.dvsviz.seek(300).then(() => 'accepted', (e) => e.name)")
    assert wrong == "RangeError"
    missing = dashboard.page.evaluate("window.dvsviz.open('nothing').then(() => 'opened', (e) => e.name)")
    assert missing == "Error"


def test_playing_keeps_the_time_of_the_recording(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 0)
    late = dashboard.page.evaluate(
        """async (window_s) => {
          await window.dvsviz.play();
          const from = performance.now();
          const late = [];
          for (let k = 0; k < 30; k++) {
            await new Promise((resolve) => setTimeout(resolve, 100));
            late.push((performance.now() - from) / 1000 - window.dvsviz.state.window * window_s);
          }
          return late;
        }""",
        WINDOW_US * 1e-6,
    )
    # One window is 30 ms. A busy machine draws late now and then, never slower and slower, and never ahead of time.
    assert min(late) > -0.25
    assert min(late[20:]) < 0.25


def test_speed_and_steps(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 50)
    dashboard.press("]")
    assert dashboard.state["speed"] == 2
    dashboard.press("[", "[")
    assert dashboard.state["speed"] == 0.5
    dashboard.press("ArrowRight", "ArrowRight", "ArrowLeft")
    dashboard.until_shown(51)
    dashboard.press("Shift+ArrowRight")
    dashboard.until_shown(61)
    dashboard.press("Home")
    dashboard.until_shown(0)
    dashboard.press("End")
    dashboard.until_shown(299)
    dashboard.press("Space")
    dashboard.until(lambda: 0 < dashboard.state["window"] < 299, "playing starts again from the beginning")
    dashboard.press("Space")
    assert dashboard.state["playing"] is False


def test_failures_and_keyframes_by_key_and_from_the_list(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 0)
    dashboard.press("n")
    dashboard.until_shown(FAILURES[0].worst)
    dashboard.press("n")
    dashboard.until_shown(FAILURES[1].worst)
    expect(dashboard.page.locator("#failure")).to_contain_text(FAILURES[1].message, use_inner_text=True)
    dashboard.press("n")
    assert dashboard.state["window"] == FAILURES[1].worst
    dashboard.press("p")
    dashboard.until_shown(FAILURES[0].worst)
    dashboard.press("k")
    dashboard.until_shown(123)
    dashboard.press("Shift+K")
    dashboard.until_shown(93)
    dashboard.page.get_by_role("tab", name="Failures 2").click()
    dashboard.page.get_by_role("button", name=FAILURES[1].message).click()
    dashboard.until_shown(FAILURES[1].worst)


def test_the_address_reopens_session_and_window(dashboard: Dashboard) -> None:
    dashboard.enter("barcode")
    dashboard.run("seek(77)")
    dashboard.until(lambda: dashboard.page.url.endswith("#session=barcode&window=77"), "the address bar follows")
    other = Dashboard(dashboard.page.context.new_page(), dashboard.page.url)
    other.page.goto(other.address)
    other.until(lambda: other.loaded() and other.state["shown"] == 77, "the copied address shows the window")
    assert (other.state["session"], other.decoded()) == ("barcode", 77)
    dashboard.page.reload()
    dashboard.until(
        lambda: dashboard.loaded() and dashboard.state["shown"] == 77, "the page comes back where it was"
    )


def test_numbers_beside_the_images_and_one_colour_or_two(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 42)
    text = dashboard.page.locator("#panel-numbers").inner_text()
    assert "position" in text
    assert "truth" in text
    assert "30.0 ms" in text
    assert dashboard.page.locator("[data-kind=raw] .caption").inner_text().split() == ["raw", "1600", "events"] or (
        "600 events" in dashboard.page.locator("[data-kind=raw] .caption").inner_text()
    )
    colours = """() => {
      const canvas = document.querySelector("[data-kind=raw] canvas");
      const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
      let coloured = 0;
      for (let i = 0; i < data.length; i += 4) coloured += Math.abs(data[i] - data[i + 2]) > 40;
      return coloured;
    }"""
    assert dashboard.page.evaluate(colours) > 500
    dashboard.press("c")
    dashboard.until(lambda: dashboard.page.evaluate(colours) == 0, "one colour is left")
    assert dashboard.decoded() == 42


def test_ten_seeks_in_a_row_end_on_the_last(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 0)
    dashboard.page.evaluate("() => { for (let k = 10; k < 200; k += 3) window.dvsviz.seek(k); }")
    dashboard.until_shown(199)


def test_two_tabs_have_two_playheads(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 20)
    other = Dashboard(dashboard.page.context.new_page(), dashboard.address)
    other.enter("barcode", 150)
    dashboard.run("seek(21)")
    other.run("seek(151)")
    assert (dashboard.decoded(), other.decoded()) == (21, 151)


def test_a_session_without_its_recording_says_so(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 5)
    dashboard.page.get_by_role("link", name="gone").click()
    dashboard.until(lambda: dashboard.state["session"] == "gone" and dashboard.state["windows"] == 60, "it opens")
    dashboard.run("seek(10)")
    expect(dashboard.page.locator("[data-kind=raw] .missing")).to_contain_text("recording", use_inner_text=True)
    assert not dashboard.problems


def test_bookmarks_are_kept_in_the_session_and_keyframes_are_jumped_to(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 77)
    dashboard.press("b")
    dashboard.page.keyboard.type("the star leaves; <b>look</b>")
    dashboard.press("Enter")
    panel = dashboard.page.locator("#panel-marks")
    mark = panel.get_by_role("button", name="the star leaves; <b>look</b>")
    mark.wait_for()
    dashboard.press("ArrowRight")  # the note gave the keys back
    dashboard.until_shown(78)
    dashboard.until(lambda: dashboard.page.url.endswith("window=78"), "the address bar follows")
    dashboard.page.reload()
    dashboard.until(lambda: dashboard.loaded() and dashboard.state["shown"] == 78, "the page is back")
    dashboard.page.get_by_role("tab", name="Marks 1").click()
    mark.click()
    dashboard.until_shown(77)
    panel.get_by_role("button", name="2.79 s").click()  # keyframe 3
    dashboard.until_shown(93)
    panel.get_by_role("button", name="Take away the bookmark at window 77").click()
    panel.get_by_text("No bookmarks yet").wait_for()
    assert not dashboard.problems


_GATE = """async () => {
  const { FrameGate } = await import("/static/framegate.js");
  const frames = [], ran = [], hand = {};
  const scene = {
    requestAnimationFrame: (call) => frames.push(call), reportError: (error) => ran.push(String(error)),
    addEventListener: (name, call) => (hand[name] = call),
  };
  const gate = new FrameGate(scene);
  const next = () => frames.splice(0).forEach((call) => call(0));
  const turn = () => new Promise((resolve) => setTimeout(resolve, 20));
  scene.requestAnimationFrame(() => ran.push("first"));
  next();
  await turn();
  gate.hold();
  scene.requestAnimationFrame(() => ran.push("second"));
  scene.cancelAnimationFrame(scene.requestAnimationFrame(() => ran.push("never")));
  const held = frames.length;
  gate.release();
  const released = frames.length;
  next();
  await turn();
  gate.hold();
  scene.requestAnimationFrame(() => ran.push("third"));
  while (!frames.length) await turn();
  next();
  await turn();
  gate.hold();
  scene.requestAnimationFrame(() => ran.push("fourth"));
  const before = frames.length;
  hand.pointermove();
  const inHand = frames.length - before;
  return { ran, held, released, before, inHand };
}"""


def test_frames_of_a_scene_drawn_by_the_processor_wait_for_images_but_not_for_ever(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 3)
    assert dashboard.page.evaluate(_GATE) == {
        "ran": ["first", "second", "third"],
        "held": 0,
        "released": 1,
        "before": 0,
        "inHand": 1,
    }
