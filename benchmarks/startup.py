"""Time of a whole process, from its start to the written EXR: ``python -m benchmarks.startup``.

A sample at two sizes, so that what is timed is mostly starting; in rounds that take turns with an
interpreter that does nothing, and with one that imports numba alone. Then the same with an empty
cache of kernels, as on the first run on a machine. Bytecode is always compiled, as pip leaves it.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common import summary, write_results

SAMPLE = Path(__file__).parents[1] / "samples" / "cloud.vdb"
SIZES = ("200x150", "800x600")
ROUNDS = 11
COLD_ROUNDS = 3

SCRIPT = "from volcli.cli import main; main()"


@dataclass(frozen=True)
class Ran:
    """A process: its seconds from start to end, those that it kept a processor busy, its output."""

    seconds: float
    busy_seconds: float
    printed: str


def start(code: str, folder: Path, *arguments: str) -> Ran:
    """Run a program in an interpreter of its own."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    env = clean | {"PYTHONPYCACHEPREFIX": str(folder / "bytecode"), "XDG_CACHE_HOME": str(folder)}
    env.pop("NUMBA_CACHE_DIR", None)
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=env)
    seconds, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Ran(seconds, busy, done.stdout)


def picture(folder: Path, size: str) -> dict[str, float]:
    """Seconds of one picture: to the end of the process, busy, to the file, and of each part."""
    out = folder / "out.exr"
    begin = time.time_ns()
    arguments = ["render", str(SAMPLE), "-o", str(out), "--size", size, "--json"]
    ran = start(SCRIPT, folder, *arguments)
    # When the file was given its name: the last thing that happens to it.
    written = (out.stat().st_ctime_ns - begin) * 1e-9
    parts = json.loads(ran.printed)["seconds"]
    totals = {"whole": ran.seconds, "busy": ran.busy_seconds, "written": written}
    return {**totals, **parts, "start": written - sum(parts.values())}


def medians(rounds: list[dict[str, float]]) -> dict[str, Any]:
    """Summaries of the totals, medians of the parts."""
    totals = ("written", "whole", "busy")
    return {name: summary([r[name] for r in rounds]) for name in totals} | {
        "parts": {
            name: statistics.median(r[name] for r in rounds)
            for name in rounds[0]
            if name not in totals
        }
    }


def main() -> None:
    """Time warm starts, then cold ones."""
    warm: dict[str, list[dict[str, float]]] = {size: [] for size in SIZES}
    others: dict[str, list[float]] = {"interpreter": [], "import numba": []}
    cold = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        picture(folder, SIZES[0])  # compiles bytecode and kernels
        for _ in range(ROUNDS):
            for size in SIZES:
                warm[size].append(picture(folder, size))
            others["interpreter"].append(start("", folder).seconds)
            others["import numba"].append(start("import numba", folder).seconds)
        for _ in range(COLD_ROUNDS):
            with tempfile.TemporaryDirectory(dir=folder) as empty:
                (Path(empty) / "bytecode").symlink_to(folder / "bytecode")
                cold.append(picture(Path(empty), SIZES[0]))
    results = {
        "volume": SAMPLE.name,
        "warm": {size: medians(rounds) for size, rounds in warm.items()},
        "cold": {SIZES[0]: medians(cold)},
        "beside": {name: summary(seconds) for name, seconds in others.items()},
    }
    for size, row in results["warm"].items():
        print(f"{size}: {row['written']['median']:.2f} s to the EXR, {row['parts']}")
    print(f"cold: {results['cold'][SIZES[0]]['written']['median']:.2f} s")
    write_results("startup", results)


if __name__ == "__main__":
    main()
