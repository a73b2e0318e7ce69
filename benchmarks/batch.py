"""A batch against a shell loop, and a batch that is killed again and again.

    python -m benchmarks.batch [ROUNDS]

The loop is what one writes without `volcli batch`: 40 mixed jobs (four volumes, two rules, two
sizes, PNG and EXR), one `volcli render` after another. The batch does the same jobs with two
workers: plain processes, and, where dask.distributed is installed, a cluster of this machine, which
takes longer to begin. Rounds are interleaved; the ratio is taken round by round.

Then 200 small jobs: the batch is killed (SIGKILL) at 20 random moments and resumed each time. What
is counted at the end is what the manifest and the folder hold.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.common import summary, write_results

SAMPLES = Path(__file__).parents[1] / "samples"

MIXED = f"""
[defaults]
density = {{ file = "{SAMPLES}/*.vdb", scale = 10.0 }}
[[job]]
output.image = "out/{{stem}}_{{density.scale}}_{{camera.resolution}}.exr"
sweep = {{ density.scale = [5.0, 10.0, 20.0], camera.resolution = [[160, 120], [320, 240]] }}
[[job]]
output.image = "out/{{stem}}_{{quadrature.step}}_{{camera.resolution}}.png"
sweep = {{ quadrature.step = [0.5, 1.0], camera.resolution = [[160, 120], [320, 240]] }}
"""

SMALL = f"""
[defaults]
density.file = "{SAMPLES}/rotated.vdb"
camera.resolution = [64, 48]
output.image = "out/{{density.scale}}.png"
[sweep]
density.scale = {[round(0.1 * n, 1) for n in range(1, 201)]}
"""

BATCH = """
import sys
import volcli.batch.farm as farm
from volcli.cli import main
if __name__ == "__main__":
    if sys.argv.pop(1) == "processes":
        farm.is_installed = lambda: False
    main(["batch", *sys.argv[1:]])
"""

WORKERS, KILLS = 2, 20


def batch(folder: Path, engine: str, *arguments: str) -> subprocess.Popen[bytes]:
    """A batch in a folder, as a process."""
    command = [sys.executable, "-c", BATCH, engine, "b.toml", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)


def loop(folder: Path, jobs: list[list[str]]) -> float:
    """Seconds of a shell loop over `volcli render`."""
    volcli = Path(sys.executable).with_name("volcli")
    script = folder / "loop.sh"
    lines = [f"'{volcli}' render {' '.join(job)} --quiet > /dev/null" for job in jobs]
    script.write_text("set -e\n" + "\n".join(lines) + "\n")
    (folder / "out").mkdir()
    begin = time.perf_counter()
    subprocess.run(["sh", script.name], cwd=folder, check=True)
    return time.perf_counter() - begin


def as_renders(folder: Path) -> list[list[str]]:
    """The jobs of a batch as arguments of `volcli render`."""
    from volcli.batch.expand import read_batch

    jobs = []
    for item in read_batch(folder / "b.toml").items:
        job = item.job
        size = "x".join(map(str, job.camera.size))
        step = job.quadrature.step_voxels
        jobs.append(
            [f"'{job.density.file}'", "-o", f"'{item.output}'", "--size", size]
            + ["--density-scale", f"{job.density.scale:g}"]
            + ([] if step is None else ["--step", f"{step:g}"])
        )
    return jobs


def compare(rounds: int) -> dict[str, Any]:
    """Seconds of both, and how many times as long the batch takes."""
    from volcli.batch.farm import is_installed

    engines = ["processes", *(["cluster"] if is_installed() else [])]
    seconds: dict[str, list[float]] = {"loop": [], **{engine: [] for engine in engines}}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "b.toml").write_text(MIXED)
        jobs = as_renders(folder)
        for number in range(-1, rounds):  # one to have kernels compiled and files in memory
            for what, taken in seconds.items():
                shutil.rmtree(folder / "out", ignore_errors=True)
                begin = time.perf_counter()
                if what == "loop":
                    elapsed = loop(folder, jobs)
                else:
                    code = batch(folder, what, "--workers", str(WORKERS), "--quiet").wait()
                    assert code == 0, f"the batch ends with {code}"
                    elapsed = time.perf_counter() - begin
                assert len(list((folder / "out").glob("*.*"))) >= len(jobs)
                print(f"{what}: {elapsed:.1f} s", flush=True)
                if number >= 0:
                    taken.append(elapsed)
    return {
        "jobs": len(jobs),
        "workers": WORKERS,
        "loop": summary(seconds["loop"]),
        **{
            engine: {
                "seconds": summary(seconds[engine]),
                "of_the_loop": summary(
                    [a / b for a, b in zip(seconds[engine], seconds["loop"], strict=True)]
                ),
            }
            for engine in engines
        },
    }


def kill() -> dict[str, Any]:
    """Kill a batch again and again; what is there at the end."""
    moments = random.Random(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "b.toml").write_text(SMALL)
        manifest = folder / "out" / "b.manifest.jsonl"
        kills = 0
        while kills < KILLS:
            begun, until = _count(manifest, "batch"), _count(manifest, "done")
            until += moments.randint(0, 8)
            process = batch(folder, "processes", "--resume", "--quiet")
            while process.poll() is None and (
                _count(manifest, "batch") == begun or _count(manifest, "done") < until
            ):
                time.sleep(0.01)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(moments.random() * 0.1)
            process.kill()
            kills += process.wait() == -signal.SIGKILL
            print(f"killed {kills} times, {_count(manifest, 'done')} done", flush=True)
        code = batch(folder, "processes", "--resume", "--quiet").wait()
        events = _events(manifest)
        times = Counter(e["job"] for e in events if e["event"] == "done")
        pictures = {p.name for p in manifest.parent.glob("*.png")}
        others = {p.name for p in manifest.parent.iterdir()} - pictures - {manifest.name}
        return {
            "jobs": 200,
            "kills": kills,
            "exit_code": code,
            "recorded_as_done": len(times),
            "rendered_again_though_recorded": sum(n > 1 for n in times.values()),
            "pictures": len(pictures),
            "manifest_and_folder_agree": pictures == set(times),
            "temporary_files_left": len(others),
        }


def _events(manifest: Path) -> list[dict[str, Any]]:
    events = []
    with contextlib.suppress(FileNotFoundError):
        for line in manifest.read_text().split("\n"):
            with contextlib.suppress(ValueError):
                events.append(json.loads(line))
    return events


def _count(manifest: Path, event: str) -> int:
    return sum(e["event"] == event for e in _events(manifest))


def main() -> None:
    """Run both, and write ``results/batch.json``."""
    os.environ.pop("PYTHONPATH", None)
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    write_results("batch", {"mixed": compare(rounds), "killed": kill()})


if __name__ == "__main__":
    main()
