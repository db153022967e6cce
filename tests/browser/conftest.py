"""Chromium and the real server, started once for all browser tests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import browser_samples as samples
import pytest
from browser_page import FLAGS, Dashboard, chromium_on_path
from playwright.sync_api import Browser, Playwright, sync_playwright

START_S = 60.0
PROGRAM = [sys.executable, "-m", "dvsviz", "serve"]


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="session")
def chromium(playwright: Playwright) -> Iterator[Browser]:
    """The browser as people have it, 3-D drawn in software."""
    browser = playwright.chromium.launch(executable_path=chromium_on_path(), args=FLAGS)
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def flat_chromium(playwright: Playwright) -> Iterator[Browser]:
    """A browser without WebGL, quicker by seconds a page: for all that is not about the 3-D scene."""
    browser = playwright.chromium.launch(executable_path=chromium_on_path(), args=[*FLAGS, "--disable-3d-apis"])
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def sessions_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions")
    recordings = tmp_path_factory.mktemp("recordings")
    here = samples.write_recording(recordings / "barcode.h5", 300)
    samples.write_session(folder / "barcode.h5", here, 300)
    gone = samples.write_recording(recordings / "gone.h5", 60)
    samples.write_session(folder / "gone.h5", gone, 60, with_truth=False)
    gone.unlink()
    return folder


@pytest.fixture(scope="session")
def server(sessions_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address that the real program prints."""
    with served(sessions_folder, tmp_path_factory.mktemp("cache")) as address:
        yield address


class served:
    """The program as a user starts it, stopped as a user stops it."""

    def __init__(self, folder: Path, cache: Path) -> None:
        environment = {**os.environ, "DVSVIZ_CACHE": str(cache), "PYTHONUNBUFFERED": "1"}
        command = [*PROGRAM, "--sessions", str(folder), "--no-browser", "--port", "0"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        )
        self.said: list[str] = []

    def __enter__(self) -> str:
        address: list[str] = []
        ready = threading.Event()

        def read() -> None:
            for line in self.process.stdout or ():
                self.said.append(line)
                if re.match("http", line):
                    address.append(line.strip())
                    ready.set()
            ready.set()

        self.readers = [
            threading.Thread(target=read, daemon=True),
            threading.Thread(target=lambda: self.said.extend(self.process.stderr or ()), daemon=True),
        ]
        for reader in self.readers:
            reader.start()
        ready.wait(START_S)
        if not address:
            self.process.kill()
            raise AssertionError(f"the server printed no address: {self.said}")
        return address[0]

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for reader in self.readers:
            reader.join(5)
        for stream in (self.process.stdout, self.process.stderr):
            if stream:
                stream.close()


def _page(browser: Browser, address: str) -> Iterator[Dashboard]:
    context = browser.new_context(
        viewport={"width": 1280, "height": 800}, color_scheme="dark", accept_downloads=True
    )
    yield Dashboard(context.new_page(), address)
    context.close()


@pytest.fixture
def dashboard(flat_chromium: Browser, server: str) -> Iterator[Dashboard]:
    yield from _page(flat_chromium, server)


@pytest.fixture
def dashboard_with_scene(chromium: Browser, server: str) -> Iterator[Dashboard]:
    yield from _page(chromium, server)
