"""The README's picture of the page of `volcli inspect --html`: a browser is shown it.

    python docs/page_picture.py PAGE.html OUT.png ["#layer=opacity&line=1"]

Needs Debian's chromium, or another under one of its names, and playwright (of the extra ``test``).
"""

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main(page: Path, out: Path, view: str = "") -> None:
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        sys.exit(f"no browser; one of {', '.join(BROWSERS)} is needed")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=found, args=["--no-sandbox"])
        shown = browser.new_page(viewport={"width": 1100, "height": 860}, color_scheme="dark")
        shown.goto(f"{page.resolve().as_uri()}{view}")
        shown.wait_for_selector("body[data-ready]")
        box = shown.locator("#canvas").bounding_box()
        assert box is not None
        shown.mouse.move(box["x"] + 0.55 * box["width"], box["y"] + 0.45 * box["height"])
        shown.wait_for_timeout(500)
        shown.screenshot(path=out)
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:4])
