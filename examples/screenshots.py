"""Make the pictures of the documentation: the dashboard in a real browser, at several sizes, dark and light.

    python examples/screenshots.py ADDRESS [--session NAME] [--window K] [--compare NAME] [--report FILE.html]
        [--only PICTURE …] [--out docs/pictures]

ADDRESS is what `dvsviz serve` or `python app.py` prints; sessions with failures are made by `planted_failures.py`.
"""

from __future__ import annotations

import argparse
import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from PIL import Image
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
SCENE_COLOURS = 200
# Keys pressed for further pictures, where the window is one that has a cause to be seen.
WITH_KEYS: dict[str, tuple[Literal["dark", "light"], tuple[str, ...]]] = {
    "landscape": ("dark", ("g", "w")),
    "curves": ("light", ("u",)),
    "failures": ("light", ("w",)),
}


def placed(page: Page) -> None:
    """Try again from here with a camera that was turned a little."""
    page.keyboard.press("y")
    page.get_by_label("Start from a pose of my own").check()
    for name in ("−turn y", "−turn y"):
        page.wait_for_timeout(1500)
        page.get_by_label(name, exact=True).click()
    page.locator("#panel-try .placed").scroll_into_view_if_needed()


def until_shown(page: Page) -> None:
    """Wait for the images, then for the 3-D scene to settle."""
    for _ in range(600):
        if page.evaluate("window.dvsviz ? window.dvsviz.state.shown !== null : false"):
            break
        page.wait_for_timeout(50)
    # Drawn in software, the scene takes its time: until it is more than an empty ground.
    scene = page.locator("#scene")
    for _ in range(60):
        page.wait_for_timeout(1000)
        drawn = Image.open(io.BytesIO(scene.screenshot())).convert("RGB")
        if len(drawn.getcolors(1 << 24) or []) > SCENE_COLOURS:
            break
    page.wait_for_timeout(1000 * SCENE_S)


def photograph(page: Page, path: Path) -> None:
    """Save what is on the screen, with a palette of 256 colours: a third of the size, and nobody sees it."""
    whole = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    whole.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1000} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address")
    parser.add_argument("--session")
    parser.add_argument("--window", type=int)
    parser.add_argument("--compare", help="another session of the same recording, for the picture of comparing")
    parser.add_argument("--report", type=Path, help="what `dvsviz report` wrote, for its picture")
    parser.add_argument("--only", nargs="+", default=[], help="these pictures only")
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

        def picture(
            name: str,
            scheme: Literal["dark", "light"],
            act: Callable[[Page], object] | None = None,
            *,
            at: str = address,
            size: tuple[int, int] = (1280, 800),
        ) -> None:
            if asked.only and name not in asked.only:
                return
            page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
            page.goto(at)
            if at.startswith("http"):
                until_shown(page)
            if act is not None:
                act(page)
                if page.locator("#landscape").is_visible():
                    page.locator("#landscape canvas[data-cells='33']").wait_for(timeout=120_000)
                page.wait_for_timeout(6000)
            photograph(page, asked.out / f"{name}.png")
            page.close()

        for name, (width, height, scheme) in SHOTS.items():
            picture(name, scheme, size=(width, height))
        picture("keys", "dark", lambda page: page.keyboard.press("?"))
        for name, (scheme, keys) in WITH_KEYS.items():
            picture(name, scheme, lambda page, keys=keys: [page.keyboard.press(key) for key in keys])
        picture("try-again", "dark", placed)
        if asked.compare:
            picture("compare", "dark", at=f"{address}&compare={asked.compare}")
        if asked.report:
            picture("report", "light", at=asked.report.resolve().as_uri(), size=(1000, 1300))
        browser.close()


if __name__ == "__main__":
    main()
