"""The dashboard from failure to repair: three planted failures are found, their causes read, one is repaired by a
camera that is moved by hand, and the result is taken along."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from browser_page import Dashboard
from browser_server import served
from playwright.sync_api import Browser, expect

from dvsviz.errors import SessionError
from dvsviz.geometry import se3
from dvsviz.session.records import STATUSES, Status
from dvsviz.session.store import open_session
from dvsviz.simulate.planted import Planted, plant

pytestmark = [pytest.mark.browser, pytest.mark.slow]

# What the page may call each planted failure.
CAUSES = {
    "bare": {"too few events", "too little texture"},
    "stripes": {"a direction that the texture cannot see"},
    "jerk": {"faster than the search"},
}
TRACKED_S = 600.0
# The blow is over after so long.
BLOW_US = 40_000
# After the camera was put right by hand, by steps, it takes so long until the map and the poses agree again.
OVER_US = 250_000
RESTED_S = 1.5
TRACKING = STATUSES.index(Status.TRACKING)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A bare wall, stripes alone, and a blow against the camera."""
    folder = tmp_path_factory.mktemp("recordings")
    paths = [folder / f"{name}.h5" for name in CAUSES]
    for name, path in zip(get_args(Planted), paths, strict=True):
        plant(name, path)
    return paths


@pytest.fixture
def walk(
    flat_chromium: Browser, recordings: list[Path], tmp_path: Path
) -> Iterator[tuple[Dashboard, Callable[[str], Path]]]:
    """A page whose server tracks the three recordings, and where its sessions lie."""
    sessions = tmp_path / "sessions"
    context = flat_chromium.new_context(
        viewport={"width": 1280, "height": 800}, color_scheme="dark", accept_downloads=True
    )
    with served(sessions, tmp_path / "cache", *recordings) as address:
        dashboard = Dashboard(context.new_page(), address)
        dashboard.page.goto(address)
        yield dashboard, lambda name: sessions / f"{name}.h5"
        context.close()


def share(dashboard: Dashboard) -> float:
    """The share of edges, in percent, that lie on the map from the placed camera."""
    return float(dashboard.page.locator(".trial-seen figcaption").inner_text().split("%")[0].strip())


def step(dashboard: Dashboard, name: str) -> float:
    """Move the camera by one step, and return the share of edges on the map from there."""
    picture = dashboard.page.locator(".trial-seen img")
    before = picture.get_attribute("src")
    dashboard.page.get_by_label(name, exact=True).click()
    dashboard.until(lambda: picture.get_attribute("src") != before, "the window is seen from there")
    return share(dashboard)


def rested(dashboard: Dashboard) -> None:
    """Wait until the picture is that of the last of many steps: none comes for a while."""
    picture, seen, since = dashboard.page.locator(".trial-seen img"), None, time.monotonic()
    while time.monotonic() - since < RESTED_S:
        now = picture.get_attribute("src")
        if now != seen:
            seen, since = now, time.monotonic()
        dashboard.page.wait_for_timeout(50)


def is_complete(path: Path) -> bool:
    """Whether a session was written to its end; before it has a header it cannot be opened."""
    if not path.exists():
        return False
    try:
        with open_session(path) as session:
            return session.complete
    except SessionError:
        return False


def turn_until_it_fits(dashboard: Dashboard) -> None:
    """Turn the camera as one who looks at the picture does: on while more edges fit, back where fewer do."""
    best = share(dashboard)
    for axis in "yxz":
        for name, back in ((f"−turn {axis}", f"+turn {axis}"), (f"+turn {axis}", f"−turn {axis}")):
            while (now := step(dashboard, name)) > best:
                best = now
            step(dashboard, back)


def test_failures_are_found_understood_repaired_and_taken_along(
    walk: tuple[Dashboard, Callable[[str], Path]], tmp_path: Path
) -> None:
    dashboard, session_of = walk
    page = dashboard.page
    listed = page.locator("#session-list li")
    dashboard.until(lambda: all(is_complete(session_of(name)) for name in CAUSES), "all are tracked", TRACKED_S)
    dashboard.until(lambda: listed.count() == 3 and listed.locator(".run-line").count() == 0, "the page says so")

    for name, words in CAUSES.items():
        dashboard.run(f"open('{name}')")
        dashboard.press("Home")
        dashboard.until(lambda: dashboard.state["shown"] == 0, "the beginning is shown")
        with open_session(session_of(name)) as session:
            failures = session.failures
        assert failures
        # N goes to the worst window of each in turn, P back; the sentence under the scene and why? tell its cause.
        found = set()
        for failure in failures:
            dashboard.press("n")
            dashboard.until(lambda w=failure.worst: dashboard.state["shown"] == w, f"{failure.worst} is shown")
            expect(page.locator("#failure-title")).to_have_text(failure.message)
            dashboard.press("w")
            heading = page.locator("#panel-failures .explanation h3")
            cause = heading.text_content() or ""
            expect(page.locator("#failure-detail")).to_contain_text(cause)
            found.add(cause)
        assert found & words, (name, found)
        if failures[-1].worst < dashboard.state["windows"] - 1:
            dashboard.press("End", "p")
            dashboard.until(
                lambda w=failures[-1].worst: dashboard.state["shown"] == w, "P goes to the last failure"
            )

    # The blow: when it is over the camera is put where the edges fit, and tracked on from there.
    with open_session(session_of("jerk")) as session:
        failure = next(f for f in session.failures if f.cause == "too_fast")
        before, t_us = session.column("status"), session.column("start_us")
        trusted = int(np.flatnonzero(before[: failure.start] == TRACKING)[-1])
        window = int(np.searchsorted(t_us, t_us[failure.start] + BLOW_US))
        truth = session.ground_truth
    assert truth is not None
    at = truth.at(t_us[[trusted, window]]).rotations
    turned_deg = np.degrees(se3.log_so3(at[0].T @ at[1]))
    dashboard.run(f"seek({window})")
    page.locator("#try-here").click()
    page.get_by_label("Start from a pose of my own").check()
    expect(page.locator(".trial-seen")).to_contain_text("of the edges")
    poor = share(dashboard)
    # As one who sees what the camera sees: to the right by so many steps of a degree, then until it fits.
    for axis, deg in zip("xyz", turned_deg, strict=True):
        for _ in range(abs(round(deg))):
            page.get_by_label(f"{'+' if deg > 0 else '−'}turn {axis}", exact=True).click()
    rested(dashboard)
    turn_until_it_fits(dashboard)
    assert share(dashboard) > poor + 10
    go = page.locator("#panel-try .go")
    expect(go).to_have_text(f"Try again from window {window}")
    go.click()
    branch = page.locator("[data-branch='jerk try']")
    expect(branch).to_contain_text("done", timeout=1000 * TRACKED_S)
    expect(branch).to_contain_text("position error")
    rows: dict[str, list[str]] = {}

    def has_rows() -> bool:
        texts = branch.locator("tr").all_inner_texts()
        rows.update({cells[0]: cells[1:] for cells in (row.split("\t") for row in texts)})
        return "tracked" in rows

    dashboard.until(has_rows, "the table is drawn")
    origin_share, branch_share = (float(cell.split("%")[0]) for cell in rows["tracked"])
    assert branch_share > origin_share
    repaired = session_of("branches/jerk try")
    with open_session(repaired) as session:
        status, t_us, poses = session.column("status"), session.column("start_us"), len(session.trajectory())
    # Before, nothing was tracked from here on; now the blow is got over and the rest is tracked to its end.
    assert not np.any(before[window:] == TRACKING)
    over = t_us > t_us[window] + OVER_US
    assert np.count_nonzero(over) >= 5
    assert np.all(status[over] == TRACKING)

    # It is taken along as a trajectory and for rerun.
    branch.get_by_role("link", name="open").click()
    dashboard.until(lambda: dashboard.state["session"] == "jerk try", "the branch is opened")
    tum = dashboard.save("tum", tmp_path / "repaired.tum")
    assert np.loadtxt(tum).shape == (poses, 8)
    rrd = dashboard.save("rrd", tmp_path / "repaired.rrd")
    rerun = str(Path(sys.executable).parent / "rerun")
    verified = subprocess.run([rerun, "rrd", "verify", str(rrd)], capture_output=True, text=True, timeout=120)
    assert verified.returncode == 0, verified.stdout + verified.stderr
    assert not dashboard.problems
