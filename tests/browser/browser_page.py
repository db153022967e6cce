"""A page of the dashboard as a person has it before them, driven in a real browser."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

from browser_samples import BITS, LEFT, LOWER, PITCH, SQUARE, UPPER
from playwright.sync_api import ConsoleMessage, Download, Page, expect

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")

# Reads the bar code off a canvas: the bits, or null where upper and lower row do not complement each other.
_DECODE = """([kind, bits, left, pitch, square, upper, lower]) => {
  const canvas = document.querySelector(`[data-kind=${kind}] canvas`);
  if (canvas.hidden) return null;
  const pen = canvas.getContext("2d");
  const lit = (x, y) => {
    const [r, g, b] = pen.getImageData(x + square / 2, y + square / 2, 1, 1).data;
    return Math.max(r, g, b) > 60;
  };
  let window = 0;
  for (let bit = 0; bit < bits; bit++) {
    const one = lit(left + pitch * bit, upper);
    if (one === lit(left + pitch * bit, lower)) return null;
    if (one) window += 2 ** bit;
  }
  return window;
}"""


def chromium_on_path() -> Path | None:
    """The system's Chromium; None leaves the choice to Playwright, which fails when it has none."""
    found = next((place for place in map(shutil.which, _NAMES) if place), None)
    return Path(found) if found else None


class Dashboard:
    """One page: what is on the screen, and what went wrong in the console."""

    def __init__(self, page: Page, address: str) -> None:
        self.page, self.address = page, address
        self.base = address.split("#")[0]
        self.problems: list[str] = []
        self.requests: list[str] = []
        page.on("console", self._heard)
        page.on("pageerror", lambda e: self.problems.append(str(e)))
        page.on("request", lambda r: self.requests.append(r.url))

    def _heard(self, message: ConsoleMessage) -> None:
        # The 3-D client warns about its own libraries and about software rendering; errors count from everywhere.
        own = "/static/" in message.location["url"]
        if message.type == "error" or (message.type == "warning" and own):
            self.problems.append(message.text)

    def enter(self, session: str | None = None, window: int | None = None) -> None:
        """Open the printed address, at a session and window if wished, and wait for images."""
        address = (
            self.address
            + (f"&session={session}" if session else "")
            + (f"&window={window}" if window is not None else "")
        )
        self.page.goto(address)
        self.until(lambda: self.loaded() and self.state["shown"] is not None, "images are shown")

    def loaded(self) -> bool:
        return bool(self.page.evaluate("Boolean(window.dvsviz)"))

    @property
    def state(self) -> dict[str, Any]:
        return self.page.evaluate("window.dvsviz.state")

    def run(self, script: str) -> Any:
        """Run a line of the script interface and wait for its promise."""
        return self.page.evaluate(f"async () => window.dvsviz.{script}")

    def decoded(self, kind: str = "raw") -> int | None:
        """The window number that a canvas shows, read from its pixels."""
        return self.page.evaluate(_DECODE, [kind, BITS, LEFT, PITCH, SQUARE, UPPER, LOWER])

    def until(self, is_so: Any, what: str, seconds: float = 15.0) -> None:
        end = time.monotonic() + seconds
        while not is_so():
            if time.monotonic() > end:
                raise AssertionError(
                    f"after {seconds:g} s it was not so that {what}; it shows window {self.decoded()}, "
                    f"its state is {self.state}; console: {self.problems}"
                )
            self.page.wait_for_timeout(20)

    def until_shown(self, window: int) -> None:
        """Wait until the page says that it shows a window, and its images are that window's: on a way there and back
        the page passes the window, and the next image is there before it can be read."""
        self.until(
            lambda: self.state["shown"] == window and self.decoded() == window,
            f"window {window} and its images are shown",
        )

    def timeline_x(self, share: float) -> tuple[float, float]:
        """The place on the timeline's curves at a share of the visible time."""
        box = self.page.evaluate(
            """() => {
              const bounds = document.getElementById("timeline").getBoundingClientRect();
              const font = parseFloat(getComputedStyle(document.documentElement).fontSize) * 0.9;
              const left = Math.round(font * (bounds.width < 640 ? 12.5 : 15.2));
              const right = Math.round(font * 3.6);
              return { x: bounds.x + left, y: bounds.y, width: bounds.width - left - right, height: bounds.height };
            }"""
        )
        return box["x"] + share * box["width"], box["y"] + 0.55 * box["height"]

    def save(self, to: str, path: Path) -> Path:
        """Press an export's button and save what comes."""
        downloads: list[Download] = []
        self.page.once("download", lambda download: downloads.append(download))
        expect(self.page.locator("#export-button")).to_be_enabled()
        if self.page.locator("#export-menu").is_hidden():
            self.press("e")
        self.page.locator(f"[data-export={to}]").click()
        newest = self.page.locator("#export-list li").first
        self.until(lambda: downloads or "failed" in (newest.get_attribute("class") or ""), f"{to} comes", 60)
        assert downloads, newest.inner_text()
        downloads[0].save_as(path)
        return path

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)
