"""Runs that are started, watched, queued and stopped from the page; housekeeping of sessions."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import browser_samples as samples
import pytest
from browser_page import Dashboard
from browser_server import served
from playwright.sync_api import Browser, Page, expect

from dvsviz.geometry.camera import Camera
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings that no session was made of, in a folder of their own."""
    folder = tmp_path_factory.mktemp("offered")
    camera = Camera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5)
    simulate(folder / "wall.h5", seconds=3.0, seed=1, camera=camera)
    lines = [f"{k * 1e-3:.6f} {k % 64} {k % 48} {k % 2}" for k in range(2000)]
    (folder / "plain").mkdir()
    (folder / "plain" / "events.txt").write_text("\n".join(lines))
    return folder


@pytest.fixture
def sessions(tmp_path: Path) -> Path:
    folder = tmp_path / "sessions"
    folder.mkdir()
    recording = samples.write_recording(tmp_path / "barcode.h5", 40)
    samples.write_session(folder / "barcode.h5", recording, 40)
    return folder


@pytest.fixture
def dashboard(flat_chromium: Browser, sessions: Path, folder: Path, tmp_path: Path) -> Iterator[Dashboard]:
    context = flat_chromium.new_context(viewport={"width": 1280, "height": 800}, color_scheme="dark")
    with served(sessions, tmp_path / "cache", "--recordings", str(folder)) as address:
        yield Dashboard(context.new_page(), address)
        context.close()


def choose(page: Page, file: str) -> None:
    page.locator("#track-button").click()
    page.locator("[data-recording]", has_text=file).click()
    page.locator(".estimate").wait_for()


def row(page: Page, name: str):
    return page.locator("#session-list li", has=page.locator(f"a[data-name='{name}']"))


def test_runs_are_started_queued_and_stopped(dashboard: Dashboard, sessions: Path) -> None:
    page = dashboard.page
    dashboard.enter("barcode")
    dashboard.press("r")
    dialog = page.locator("#track")
    page.locator("[data-recording]").first.wait_for()
    files = page.locator("[data-recording] b").all_inner_texts()
    # Those of the folder and of the sessions that are known; the session files beside them are not.
    assert set(files) == {"plain", "wall.h5", "barcode.h5"}
    assert len(files) == 3
    # A guessed calibration is marked; values can be changed, and wrong ones are refused where they stand.
    page.locator("[data-recording]", has_text="plain").click()
    page.locator(".guess").wait_for()
    expect(page.locator(".guess")).to_contain_text("Guessed", use_inner_text=True)
    page.locator("[data-recording]", has_text="wall.h5").click()
    expect(dialog.get_by_label("fx", exact=True)).to_have_value("140")
    expect(page.locator(".guess")).to_have_count(0)
    expect(page.locator(".estimate")).to_contain_text("on disk", use_inner_text=True)
    dialog.get_by_label("fx", exact=True).fill("145")
    expect(page.locator(".run-detail")).to_contain_text("58° across", use_inner_text=True)
    dialog.get_by_label("Window", exact=True).fill("many")
    page.get_by_role("button", name="Start tracking").click()
    expect(page.locator("#track .bad")).to_contain_text("whole number", use_inner_text=True)
    dialog.get_by_label("Window", exact=True).fill("1500")
    dialog.get_by_label("Name").fill("first")
    page.get_by_role("button", name="Start tracking").click()
    # It opens by itself; a second one waits for it and is taken out of the queue.
    dashboard.until(lambda: dashboard.state["session"] == "first", "the run is opened")
    choose(page, "wall.h5")
    dialog.get_by_label("Name").fill("second")
    dialog.get_by_label("Start").fill("5")
    expect(page.get_by_role("button", name="Start tracking")).to_be_disabled()
    dialog.get_by_label("Start").fill("0.5")
    page.get_by_role("button", name="Start tracking").click()
    row(page, "second").locator(".run-line").wait_for()
    expect(row(page, "second")).to_contain_text("waits, 1 before it", use_inner_text=True)
    row(page, "second").get_by_role("button", name="cancel").click()
    dashboard.until(lambda: row(page, "second").count() == 0, "it is gone")
    row(page, "first").locator("a").click()
    dashboard.until(lambda: dashboard.state["live"] and dashboard.state["shown"] is not None, "it tracks", 120)
    line = row(page, "first").locator(".run-line")
    dashboard.until(lambda: "Mev/s" in line.inner_text(), "its speed is shown")
    line.get_by_role("button", name="pause").click()
    dashboard.until(lambda: "paused" in line.inner_text(), "it is paused")
    expect(page.locator("#live-badge")).to_have_text("paused", use_inner_text=True)
    page.locator("#run-pause").click()
    dashboard.until(lambda: "paused" not in line.inner_text(), "it goes on")
    dashboard.until(lambda: not dashboard.state["live"] and dashboard.state["windows"] > 0, "it ends", 60)
    with open_session(sessions / "first.h5") as session:
        assert session.complete and session.header.camera.fx == 145
    assert not dashboard.problems


def test_a_full_disk_is_warned_of(dashboard: Dashboard) -> None:
    page = dashboard.page

    def full(route) -> None:
        answer = route.fetch()
        body = answer.json()
        if body.get("estimate"):
            body["estimate"]["free_bytes"] = 1000
        route.fulfill(response=answer, json=body)

    page.route("**/api/recordings/*", full)
    dashboard.enter("barcode")
    choose(page, "wall.h5")
    expect(page.locator(".estimate.bad")).to_contain_text("The disk is too full", use_inner_text=True)


def test_a_session_is_renamed_tagged_resumed_and_deleted(
    dashboard: Dashboard, sessions: Path, tmp_path: Path
) -> None:
    page = dashboard.page
    shutil.copy(sessions / "barcode.h5", sessions / "copy.h5")
    dashboard.enter("copy", 7)

    def manage(name: str) -> None:
        page.get_by_role("button", name=f"More about {name}", exact=True).click()

    manage("copy")
    dialog = page.locator("#manage")
    dialog.get_by_label("Name").first.fill("../barcode")
    dialog.get_by_role("button", name="Rename").click()
    dashboard.until(lambda: "cannot be" in dialog.locator(".bad").inner_text(), "a path is refused")
    dialog.get_by_label("Name").first.fill("barcode")
    dialog.get_by_role("button", name="Rename").click()
    dashboard.until(lambda: "already" in dialog.locator(".bad").inner_text(), "the taken name is refused")
    dialog.get_by_label("Name").first.fill("Wand <b>2</b>")
    dialog.get_by_role("button", name="Rename").click()
    dashboard.until(lambda: "cannot be" in dialog.locator(".bad").inner_text(), "markup is refused")
    dialog.get_by_label("Name").first.fill("Wand 2")
    dialog.get_by_role("button", name="Rename").click()
    dashboard.until(lambda: dashboard.state["session"] == "Wand 2", "the page follows the new name")
    dashboard.until(lambda: dashboard.state["shown"] == 7, "at the same window")
    dashboard.until(lambda: row(page, "Wand 2").count() == 1, "it is listed")
    manage("Wand 2")
    dialog.get_by_label("Tags").first.fill("night, handheld")
    dialog.get_by_role("button", name="Save tags").click()
    dashboard.until(lambda: "handheld" in row(page, "Wand 2").inner_text(), "tags are listed")
    page.locator("#filter").fill("night")
    expect(page.locator("#session-list a")).to_have_count(1)
    page.locator("#filter").fill("")
    manage("Wand 2")
    dialog.get_by_role("button", name="Delete…").click()
    page.get_by_role("button", name="Keep it").click()
    assert (sessions / "Wand 2.h5").exists()
    dialog.get_by_role("button", name="Delete…").click()
    page.locator("#ask").get_by_role("button", name="Delete").click()
    dashboard.until(lambda: dashboard.state["session"] == "barcode", "another session is shown")
    assert not (sessions / "Wand 2.h5").exists()
    assert (tmp_path / "barcode.h5").exists(), "the recording stays"
    # Refusals are answers with an error code: the browser notes each in its console.
    assert all("409" in problem for problem in dashboard.problems)
