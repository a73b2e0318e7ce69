"""Looking at large images: ``python -m benchmarks.inspect``.

A sample is rendered at 4096 x 4096, and `volcli inspect` reads it in processes of its own. Its page
at 2048 x 2048 is shown in a headless browser: how long it takes to unpack, and how long each change
takes to be drawn (without a GPU where there is none).
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import summary, write_results

SAMPLE = Path(__file__).parents[1] / "samples" / "cloud.vdb"
VIEW = ["--color-grid", "Cd", "--density-scale", "4", "--eye", "0,1.7,5", "--target", "0,1.75,0"]
ROUNDS = 7
BROWSERS = ("chromium", "chromium-browser", "google-chrome")

CHANGES = {
    "another part": "update({ x: 900 + 3 * k })",
    "the range": "update({ layer: 'opacity', high: 0.5 + k / 200 })",
    "the highlight": "update({ from: 0.2, to: 0.3 + k / 200 })",
    "the line": "update({ line: 1, iso: 0.2 + k / 200 })",
    "the zoom": "update({ zoom: 1 + k / 60 })",
}
"""What is changed sixty times in a row, by the page's own function."""

TIMED = """async (change) => {
    const step = new Function('k', 'update', change), times = [];
    for (let k = 0; k < 60; k++) {
        step(k, update);
        await new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)));
        times.push(Number(document.getElementById('canvas').dataset.drawMs));
    }
    return times;
}"""


def volcli(*arguments: str) -> str:
    """Run a command in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.inspect", "--volcli", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def inspect(image: Path) -> tuple[float, float, int]:
    """Seconds, busy seconds and peak bytes of `volcli inspect` of an image."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    peak = int(volcli("inspect", str(image), "--json").splitlines()[-1])
    seconds, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, busy, peak


def show(page: Path) -> dict[str, Any] | None:
    """Seconds to unpack a page, and milliseconds to draw each change; None without a browser."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        return None
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=found, args=["--no-sandbox"])
        shown = browser.new_page(viewport={"width": 1280, "height": 900})
        begin = time.perf_counter()
        shown.goto(page.as_uri())
        shown.wait_for_selector("body[data-ready]")
        unpacked = time.perf_counter() - begin
        drawn = {name: shown.evaluate(TIMED, change) for name, change in CHANGES.items()}
        browser.close()
    return {
        "unpack_seconds": unpacked,
        "draw_milliseconds": {
            name: {"median": statistics.median(times), "95 %": sorted(times)[57 - 1]}
            for name, times in drawn.items()
        },
    }


def main() -> None:
    """Render, read, show."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for edge in (4096, 2048):
            size = ["--size", f"{edge}x{edge}", "-o", str(folder / f"{edge}.exr"), "--quiet"]
            volcli("render", str(SAMPLE), *VIEW, *size)
        rounds = [inspect(folder / "4096.exr") for _ in range(ROUNDS)]
        volcli("inspect", str(folder / "2048.exr"), "--html", str(folder / "page.html"))
        results = {
            "seconds": summary([seconds for seconds, _, _ in rounds]),
            "busy_seconds": summary([busy for _, busy, _ in rounds]),
            "peak_bytes": max(peak for _, _, peak in rounds),
            "page_bytes": (folder / "page.html").stat().st_size,
            "page": show(folder / "page.html"),
        }
    print(json.dumps(results, indent=2))
    write_results("inspect", results)


def one_command(arguments: list[str]) -> None:
    """What a process of its own does: a command, and then its peak memory as the last line."""
    from volcli.cli.app import run_app
    from volcli.run import peak_memory_bytes

    code = run_app(arguments)
    print(peak_memory_bytes(), flush=True)
    os._exit(code)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--volcli"]:
        one_command(sys.argv[2:])
    else:
        main()
