"""Make the pictures of the documentation: the dashboard in a real browser, at several sizes, dark and light.

    python examples/screenshots.py ADDRESS [--session NAME] [--window K] [--compare NAME] [--out docs/pictures]

ADDRESS is what `dvsviz serve` or `python app.py` prints.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Literal

from playwright.sync_api import Page, sync_playwright

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
SHOTS: dict[str, tuple[int, int, Literal["dark", "light"]]] = {
    "dashboard-dark": (1280, 800, "dark"),
    "dashboard-light": (1280, 800, "light"),
    "dashboard-large": (1920, 1080, "dark"),
    "dashboard-tablet": (1024, 768, "light"),
    "dashboard-tablet-upright": (820, 1180, "dark"),
}
SCENE_S = 8.0
# Keys pressed for further pictures, where the window is one that has a cause to be seen.
WITH_KEYS: dict[str, tuple[Literal["dark", "light"], tuple[str, ...]]] = {
    "landscape": ("dark", ("g", "w")),
    "curves": ("light", ("u",)),
}


def until_shown(page: Page) -> None:
    """Wait for the images, then for the 3-D scene to settle."""
    for _ in range(600):
        if page.evaluate("window.dvsviz ? window.dvsviz.state.shown !== null : false"):
            break
        page.wait_for_timeout(50)
    page.wait_for_timeout(1000 * SCENE_S)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address")
    parser.add_argument("--session")
    parser.add_argument("--window", type=int)
    parser.add_argument("--compare", help="another session of the same recording, for the picture of comparing")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    place = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    address = asked.address
    if asked.session:
        address += f"&session={asked.session}"
    if asked.window is not None:
        address += f"&window={asked.window}"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=place, args=FLAGS)
        for name, (width, height, scheme) in SHOTS.items():
            page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            page.goto(address)
            until_shown(page)
            page.screenshot(path=asked.out / f"{name}.png")
            if name == "dashboard-dark":
                page.keyboard.press("?")
                page.screenshot(path=asked.out / "keys.png")
            print(asked.out / f"{name}.png")
            page.close()
        for name, (scheme, keys) in WITH_KEYS.items():
            page = browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme=scheme)
            page.goto(address)
            until_shown(page)
            for key in keys:
                page.keyboard.press(key)
            page.wait_for_timeout(6000)
            page.screenshot(path=asked.out / f"{name}.png")
            print(asked.out / f"{name}.png")
            page.close()
        if asked.compare:
            page = browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme="dark")
            page.goto(f"{address}&compare={asked.compare}")
            until_shown(page)
            page.screenshot(path=asked.out / "compare.png")
            print(asked.out / "compare.png")
            page.close()
        browser.close()


if __name__ == "__main__":
    main()
