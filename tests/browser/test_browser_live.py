"""A session that grows while it is watched."""

from __future__ import annotations

import threading
from pathlib import Path

import browser_samples as samples
import pytest
from browser_page import Dashboard

pytestmark = pytest.mark.browser


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
