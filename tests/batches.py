"""Small batches to run as a user does, and what they leave."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from commandline import ROOT, write_ball

MANY = """
[defaults]
density.file = "ball.npz"
camera.resolution = [32, 24]
output.image = "out/{density.scale}.png"
[sweep]
density.scale = [%s]
"""

_SCRIPT = """
import sys
import volcli.batch.farm as farm
from volcli.cli import main
if __name__ == "__main__":
    if sys.argv.pop(1) == "processes":
        farm.is_installed = lambda: False  # as without the extra
    main(sys.argv[1:])
"""


def write_batch(folder, text, name="b.toml"):
    """A batch file in a folder."""
    path = folder / name
    path.write_text(text)
    return path


def write_many(folder, count):
    """A batch of many small jobs of one volume."""
    write_ball(folder / "ball.npz")
    return write_batch(folder, MANY % ", ".join(f"{0.1 * i:.1f}" for i in range(1, count + 1)))


def start(folder, *arguments, engine="processes"):
    """``volcli batch ARGUMENTS`` as a process of its own, in a group of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", _SCRIPT, engine, "batch", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def events(folder, name="b"):
    """The lines of a manifest that are whole."""
    try:
        lines = (folder / f"{name}.manifest.jsonl").read_text().split("\n")
    except FileNotFoundError:
        return []
    found = []
    for line in lines:
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return found


def count(folder, event):
    """How many events of a kind there are."""
    return sum(e["event"] == event for e in events(folder))


def wait_until(condition, process, seconds=120):
    """Wait for a condition while a process runs; whether it came true before the process ended."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it takes too long"
        if process.poll() is not None:
            return condition()
        time.sleep(0.01)
    return True


def leftovers(folder):
    """Temporary files."""
    return [entry.name for entry in Path(folder).iterdir() if entry.name.startswith(".")]
