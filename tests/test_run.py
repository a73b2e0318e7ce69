"""A job from files to files: progress that follows the work, memory, and what is reported."""

import subprocess
import sys

import pytest
from commandline import SAMPLES, write_ball

from volcli.config import load_job
from volcli.run import load, prepare, run


@pytest.fixture
def ball(tmp_path):
    return write_ball(tmp_path / "ball.npz")


def staged(source, out, *settings):
    """What a job told of its progress: for each stage in order, (done, total) as it went on."""
    told = {}

    def on_stage(stage, done, total):
        told.setdefault(stage, []).append((done, total))

    job = load_job(source, [("output.image", out), ("camera.resolution", (150, 100))], settings)
    prepared = prepare(job)
    run(prepared, load(prepared, on_stage), on_stage=on_stage)
    return told


def test_progress_follows_the_work_through_every_stage(tmp_path):
    told = staged(SAMPLES / "rotated.vdb", tmp_path / "a.exr")
    told.pop("compiling", None)  # on the first run alone
    assert list(told) == ["reading density", "rendering", "writing"]
    for stage, reports in told.items():
        done = [d for d, _ in reports]
        assert done == sorted(done), stage
        assert done[-1] == reports[-1][1], f"{stage} ends at its total"
    assert len(told["rendering"]) == 6, "150 x 100 pixels are 3 x 2 tiles"


def test_memory_to_bricks_is_bounded_by_the_bricks():
    """Below three times what is held and 250 MB, in a process of its own."""
    code = """
import sys
from pathlib import Path
from volcli.grids import density_grid, load_density, open_volume
from volcli.run import peak_memory_bytes
volume = open_volume(Path(sys.argv[1]))
grid, _ = load_density(volume, density_grid(volume, None)[0], "error")
print(peak_memory_bytes(), grid.nbytes)
"""
    for name in ("cloud", "explosion"):
        done = subprocess.run(
            [sys.executable, "-c", code, str(SAMPLES / f"{name}.vdb")],
            check=True,
            capture_output=True,
            text=True,
        )
        peak, held = map(int, done.stdout.split())
        assert peak < 3 * held + 250e6


def test_transmittance_is_reported_alike_for_every_format(ball, tmp_path):
    """And so is what is behind: a PNG before a bright sun shows it through dark smoke as an EXR."""
    seen = []
    for name in ("a.exr", "a.png"):
        settings = [("output.image", tmp_path / name), ("density.scale", 30.0)]
        prepared = prepare(load_job(ball, settings))
        seen.append(run(prepared, load(prepared)).transmittance)
    assert seen[0] == seen[1]
    assert seen[0]["min"] < 2.0**-24
