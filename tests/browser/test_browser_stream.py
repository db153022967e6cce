"""A stream tracked in the dashboard: its figures are shown, its break is said, it goes on when it is there again,
its images are shown while it runs and when it has ended."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser_page import Dashboard
from browser_server import served
from playwright.sync_api import Browser

from dvsviz.formats.open import open_recording
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stream") / "wall.h5"
    simulate(path, scene="shapes", motion="handheld", seconds=4.0, seed=2)
    return path


class Replaying:
    """`dvsviz replay` as a user starts it, at a port that may be said."""

    def __init__(self, recording: Path, port: int = 0) -> None:
        command = [sys.executable, "-m", "dvsviz", "replay", str(recording), "--listen", str(port)]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        assert self.process.stdout is not None
        found = re.search(r":(\d+)\s*$", self.process.stdout.readline())
        assert found is not None
        self.port = int(found[1])

    def end(self) -> None:
        self.process.terminate()
        self.process.wait(20)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def replaying(wall: Path) -> Iterator[list[Replaying]]:
    started = [Replaying(wall)]
    yield started
    for one in started:
        one.end()


def _seconds(dashboard: Dashboard) -> float:
    """Return how long the header says that the session is, in seconds."""
    found = re.search(r"\d+×\d+ · (\d+\.\d) s · .* events", dashboard.page.locator("#subtitle").inner_text())
    assert found is not None, dashboard.page.locator("#subtitle").inner_text()
    return float(found[1])


def test_a_stream_is_watched_breaks_off_and_goes_on(
    flat_chromium: Browser, replaying: list[Replaying], wall: Path, tmp_path: Path
) -> None:
    sessions, record, port = tmp_path / "sessions", tmp_path / "stream.h5", replaying[0].port
    where = f"aedat4+tcp://127.0.0.1:{port}"
    context = flat_chromium.new_context(viewport={"width": 1280, "height": 800})
    with served(sessions, tmp_path / "cache", "--live", where, "--record", str(record)) as address:
        dashboard = Dashboard(context.new_page(), address)
        dashboard.page.goto(address)
        dashboard.until(lambda: dashboard.page.locator(".session-list a").count() == 1, "it is listed", 60)
        dashboard.until(
            lambda: re.search(
                r"Mev/s · pose after .* ms · median .*, 95 % .* ms · .*% of the events used",
                dashboard.page.locator("#live-text").inner_text(),
            ),
            "its figures are shown",
            60,
        )
        place = dashboard.page.locator("#live-pose")
        number = r"[−\d]+\.\d\d"
        dashboard.until(
            lambda: re.fullmatch(rf"camera at {number}, {number}, {number} d", place.text_content() or ""),
            "its pose",
            30,
        )
        dashboard.until(
            lambda: "was lost" in dashboard.page.locator("#live-text").inner_text(), "its end is said", 60
        )
        # Another stream at once: it is waited for ten seconds only.
        replaying[0].end()
        replaying.append(Replaying(wall, port))
        # The header says how long the session is by now: longer than what the first stream sent, so the second is in.
        dashboard.until(lambda: _seconds(dashboard) > 4.5, "it goes on", 60)
        # Images come with the recording that grows, and are there when it is whole.
        raw = dashboard.page.locator("[data-kind=raw]")
        dashboard.until(lambda: raw.locator("canvas").is_visible(), "images are shown while it runs", 60)
        assert dashboard.state["live"]
        replaying[1].end()
        dashboard.until(lambda: not dashboard.state["live"], "it has ended", 90)
        assert place.text_content() == ""
        dashboard.until(lambda: raw.locator("canvas").is_visible(), "its images are shown", 60)
        assert not dashboard.problems
    context.close()
    (path,) = sessions.glob("live-*.h5")
    with open_session(path) as session:
        assert session.complete
        ends, starts = session.column("end_us")[:-1], session.column("start_us")[1:]
        assert (starts - ends).max() > 300_000
    sent = open_recording(wall).events.count
    assert sent < open_recording(record).events.count <= 2 * sent
