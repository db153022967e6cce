"""A session that grows while it is watched."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import browser_samples as samples
import pytest
from browser_page import Dashboard
from browser_server import served
from playwright.sync_api import Browser, expect

from dvsviz.simulate.simulate import simulate

pytestmark = pytest.mark.browser

_BEGINNING = """() => {
  const heading = [...document.querySelectorAll("h2, h1")].find((e) => e.textContent.startsWith("Starting"));
  const list = document.querySelector("ol.steps");
  return heading && list &&
    [heading.textContent, [...list.children].map((step) => [step.querySelector("b").textContent, step.dataset.step])];
}"""


class Growing(threading.Thread):
    """Writes a session window by window, as far as it is let: no faster than it is watched, on any machine."""

    def __init__(self, path: Path, recording: Path) -> None:
        super().__init__()
        self._path, self._recording = path, recording
        self._most, self._changed = 20, threading.Condition()

    def let(self, windows: int) -> None:
        """Let it write so many windows in all."""
        with self._changed:
            self._most = windows
            self._changed.notify()

    def run(self) -> None:
        """Write."""
        samples.write_session(self._path, self._recording, 100, paced=self._pace)

    def _pace(self, window: int) -> None:
        time.sleep(0.03)
        with self._changed:
            self._changed.wait_for(lambda: window < self._most)


@pytest.fixture
def growing(sessions_folder: Path, tmp_path: Path) -> Iterator[Growing]:
    """A session written by another process than the server's."""
    path = sessions_folder / "growing.h5"
    writer = Growing(path, samples.write_recording(tmp_path / "growing.h5", 100))
    writer.start()
    yield writer
    writer.let(100)
    writer.join()
    path.unlink()


def test_the_playhead_follows_a_live_session_until_it_is_moved(dashboard: Dashboard, growing: Growing) -> None:
    dashboard.page.goto(dashboard.address)
    dashboard.until(
        lambda: dashboard.page.locator(".session-list a[data-name=growing]").count() == 1, "it is listed"
    )
    dashboard.run("open('growing')")
    dashboard.until(lambda: dashboard.state["shown"] is not None, "its first images are shown")
    first = dashboard.state
    assert first["live"]
    assert first["following"]
    expect(dashboard.page.locator("#live-badge")).to_be_visible()
    growing.let(40)
    dashboard.until(lambda: dashboard.state["shown"] > first["shown"] + 10, "the playhead follows")
    dashboard.press("ArrowLeft")
    rest = dashboard.state["window"]
    assert not dashboard.state["following"]
    known = dashboard.state["windows"]
    growing.let(60)
    dashboard.until(lambda: dashboard.state["windows"] > known + 5, "windows still come in")
    assert dashboard.state["window"] == rest
    dashboard.until_shown(rest)
    dashboard.page.locator("#follow").click()
    growing.let(80)
    dashboard.until(lambda: dashboard.state["shown"] >= dashboard.state["windows"] - 8, "it follows again")
    growing.let(100)
    dashboard.until(lambda: dashboard.state["windows"] == 100 and not dashboard.state["live"], "its end is seen")
    dashboard.until_shown(99)
    expect(dashboard.page.locator("#live")).to_be_hidden()
    assert not dashboard.problems


def test_a_run_is_seen_from_its_beginning(flat_chromium: Browser, tmp_path: Path) -> None:
    recording, sessions = tmp_path / "wall.h5", tmp_path / "sessions"
    simulate(recording, scene="shapes", motion="handheld", seconds=1.5, seed=4)
    context = flat_chromium.new_context(viewport={"width": 1280, "height": 800})
    with served(sessions, tmp_path / "cache", recording) as address:
        dashboard = Dashboard(context.new_page(), address)
        dashboard.page.goto(address)
        # Before there is a session: what is being done, without an older session in its place.
        # How far it is depends on the machine, so all is read in one look: some steps done, one now, the rest next.
        heading, steps = dashboard.page.wait_for_function(_BEGINNING).json_value()
        assert heading == "Starting “wall”"
        assert [name for name, _ in steps] == ["Read the recording", "Get the tracker ready", "Track"]
        states = [state for _, state in steps]
        assert states.count("now") == 1
        assert states == sorted(states, key=["done", "now", "next"].index)
        assert dashboard.state["session"] == "wall"
        # A slow browser on a quick machine may see it end before it sees it live.
        dashboard.until(lambda: dashboard.state["shown"] is not None, "it tracks", 120)
        known = dashboard.state
        dashboard.until(
            lambda: dashboard.state["windows"] > known["windows"] or not known["live"], "windows come in"
        )
        dashboard.until(lambda: dashboard.state["windows"] and not dashboard.state["live"], "it ends", 60)
        dashboard.until(lambda: dashboard.state["shown"] == dashboard.state["windows"] - 1, "its end is shown")
        expect(dashboard.page.locator(".session-list a")).to_have_count(1)
        assert not dashboard.problems
        context.close()
