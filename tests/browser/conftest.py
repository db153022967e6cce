"""Chromium and the real server, started once for all browser tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import browser_samples as samples
import pytest
from browser_page import FLAGS, Dashboard, chromium_on_path
from browser_server import served
from playwright.sync_api import Browser, Playwright, expect, sync_playwright

# As long as `Dashboard.until` waits: a busy machine is no failure.
expect.set_options(timeout=15_000)


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
