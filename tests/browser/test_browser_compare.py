"""Comparing sessions: curves over each other, windows matched by time, a table of differences."""

from __future__ import annotations

import pytest
from browser_page import Dashboard
from browser_samples import FAILURES
from playwright.sync_api import expect

pytestmark = pytest.mark.browser

# Pixels of the compared session's colour on the timeline.
_DASHED = """() => {
  const canvas = document.getElementById("timeline-lanes");
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let found = 0;
  for (let i = 0; i < data.length; i += 4)
    found += Math.abs(data[i] - 0x35) + Math.abs(data[i + 1] - 0xc9) + Math.abs(data[i + 2] - 0xdc) < 30;
  return found;
}"""


def test_a_second_session_is_laid_over_the_first(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 40)
    assert dashboard.page.evaluate(_DASHED) == 0
    dashboard.press("m")
    choice = dashboard.page.get_by_label("Compare with", exact=True)
    assert choice.evaluate("e => e === document.activeElement")
    choice.select_option("gone")
    panel = dashboard.page.locator("#panel-compare")
    panel.locator(".compare-table").wait_for()
    # The poses of both are fetched after the table stands.
    expect(panel.locator(".compare-table")).to_contain_text("0.00 % d")
    rows = {
        row.split("\t")[0]: row.split("\t")[1:] for row in panel.locator(".compare-table").inner_text().split("\n")
    }
    # The same poses: nothing apart, on the 60 windows that both have (and neither lost).
    assert rows["apart"][1].startswith("0.00 % d")
    assert rows["turned"][1].startswith("0.00°")
    assert rows["windows"] == ["300", "60"]
    expect(panel.locator(".compare-now")).to_contain_text("window 40", use_inner_text=True)
    dashboard.until(lambda: dashboard.page.evaluate(_DASHED) > 20, "its curves are drawn")
    dashboard.run(f"seek({FAILURES[0].worst})")  # the other session has ended: its last window stands
    expect(panel.locator(".compare-now")).to_contain_text("window 59", use_inner_text=True)
    dashboard.until(lambda: "&compare=gone" in dashboard.page.url, "the address says it")
    other = Dashboard(dashboard.page.context.new_page(), dashboard.page.url)
    other.page.goto(other.address)
    other.page.locator(".compare-table").wait_for()
    panel.get_by_role("button", name="Take gone away").click()
    dashboard.until(lambda: "compare" not in dashboard.page.url, "the address forgets it")
    dashboard.until(lambda: dashboard.page.evaluate(_DASHED) == 0, "its curves go")
    assert not dashboard.problems
    assert not other.problems


def test_an_address_with_a_question_mark_compares_too(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 40)
    dashboard.page.goto(f"{dashboard.base}?compare=gone#session=barcode&window=12")
    dashboard.page.locator(".compare-table").wait_for()
    dashboard.until(
        lambda: "?" not in dashboard.page.url and "&compare=gone" in dashboard.page.url, "one form is kept"
    )
    assert dashboard.page.get_by_role("tab", name="Compare 2").get_attribute("aria-selected") == "true"
    assert not dashboard.problems


def test_what_cannot_be_compared_is_said(dashboard: Dashboard) -> None:
    dashboard.enter("barcode", 40)
    dashboard.page.evaluate("location.hash = '#session=barcode&window=40&compare=nothing'")
    dashboard.page.locator("#panel-compare [role=alert]").wait_for()
    expect(dashboard.page.locator("#panel-compare")).to_contain_text(
        "there is no session of this name", use_inner_text=True
    )
    dashboard.page.get_by_role("button", name="Compare with gone").click()
    dashboard.page.locator(".compare-table").wait_for()
