"""A session that grows while it is watched."""

from __future__ import annotations

import threading
from pathlib import Path

import browser_samples as samples
import pytest
from browser_page import Dashboard
from browser_server import served
from playwright.sync_api import Browser

from dvsviz.simulate.simulate import simulate

pytestmark = pytest.mark.browser

_STEPS = "list => [...list.children].map(step => [step.querySelector('b').textContent, step.dataset.step])"


@pytest.fixture
def growing(sessions_folder: Path, tmp_path: Path):
    """A session written window by window by another thread of another process than the server's."""
    recording = samples.write_recording(tmp_path / "growing.h5", 100)
    path = sessions_folder / "growing.h5"
    writer = threading.Thread(target=samples.write_session, args=(path, recording, 100), kwargs={"delay_s": 0.06})
    writer.start()
    yield writer
    writer.join()
    path.unlink()


def test_the_playhead_follows_a_live_session_until_it_is_moved(
    dashboard: Dashboard, growing: threading.Thread
) -> None:
    dashboard.page.goto(dashboard.address)
    dashboard.until(
        lambda: dashboard.page.locator(".session-list a[data-name=growing]").count() == 1, "it is listed"
    )
    dashboard.run("open('growing')")
    dashboard.until(lambda: dashboard.state["shown"] is not None, "its first images are shown")
    first = dashboard.state
    assert first["live"]
    assert first["following"]
    assert dashboard.page.locator("#live-badge").is_visible()
    dashboard.until(lambda: dashboard.state["shown"] > first["shown"] + 10, "the playhead follows")
    dashboard.press("ArrowLeft")
    rest = dashboard.state["window"]
    assert not dashboard.state["following"]
    known = dashboard.state["windows"]
    dashboard.until(lambda: dashboard.state["windows"] > known + 5, "windows still come in")
    assert dashboard.state["window"] == rest
    dashboard.until_shown(rest)
    dashboard.page.locator("#follow").click()
    dashboard.until(lambda: dashboard.state["shown"] >= dashboard.state["windows"] - 8, "it follows again")
    growing.join()
    dashboard.until(lambda: dashboard.state["windows"] == 100 and not dashboard.state["live"], "its end is seen")
    dashboard.until_shown(99)
    assert dashboard.page.locator("#live").is_hidden()
    assert not dashboard.problems


def test_a_run_is_seen_from_its_beginning(flat_chromium: Browser, tmp_path: Path) -> None:
    recording, sessions = tmp_path / "wall.h5", tmp_path / "sessions"
    simulate(recording, scene="shapes", motion="handheld", seconds=1.5, seed=4)
    context = flat_chromium.new_context(viewport={"width": 1280, "height": 800})
    with served(sessions, tmp_path / "cache", recording) as address:
        dashboard = Dashboard(context.new_page(), address)
        dashboard.page.goto(address)
        # Before there is a session: what is being done, without an older session in its place.
        dashboard.page.get_by_role("heading", name="Starting “wall”").wait_for()
        # How far it is depends on the machine, so all steps are read in one look: some done, one now, the rest next.
        steps = dashboard.page.locator("ol.steps").evaluate(_STEPS)
        assert [name for name, _ in steps] == ["Read the recording", "Get the tracker ready", "Track"]
        states = [state for _, state in steps]
        assert states.count("now") == 1
        assert states == sorted(states, key=["done", "now", "next"].index)
        assert dashboard.state["session"] == "wall"
        dashboard.until(lambda: dashboard.state["live"] and dashboard.state["shown"] is not None, "it tracks", 120)
        known = dashboard.state["windows"]
        dashboard.until(lambda: dashboard.state["windows"] > known, "windows come in")
        dashboard.until(lambda: dashboard.state["windows"] and not dashboard.state["live"], "it ends", 60)
        dashboard.until(lambda: dashboard.state["shown"] == dashboard.state["windows"] - 1, "its end is shown")
        assert dashboard.page.locator(".session-list a").count() == 1
        assert not dashboard.problems
        context.close()
