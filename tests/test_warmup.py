"""Kernels made ready beside the reading of a volume: in time, of the right types, and told of."""

import json
import subprocess
import sys
import threading

import numba
import pytest
from commandline import SAMPLES

from volcli.warmup import WarmUp

JOBS = [
    ("rotated", []),
    ("rotated", ["quadrature.rule=midpoint"]),
    ("rotated", ["density.interpolation=nearest"]),
    ("cloud", ["color.grid=Cd"]),
]

CHECK = """
import importlib, json, pkgutil, sys
from pathlib import Path
from numba.core.registry import CPUDispatcher
import volcli.kernels
from volcli.config import load_job
from volcli.run import load, prepare, render_loaded

def versions():
    modules = [importlib.import_module(m.name) for m in
               pkgutil.iter_modules(volcli.kernels.__path__, "volcli.kernels.")]
    kernels = {k for m in modules for k in vars(m).values() if isinstance(k, CPUDispatcher)}
    return {(k.__name__, str(s)) for k in kernels for s in k.signatures}

out, jobs = Path(sys.argv[1]), json.loads(sys.argv[2])
for volume, settings in jobs:
    flags = [("output.image", out), ("camera.resolution", (8, 6))]
    prepared = prepare(load_job(Path(volume), flags, settings))
    loaded = load(prepared)
    loaded.kernels.wait(lambda done, total: None)
    ready = versions()
    assert ready, "no kernel is ready"
    render_loaded(prepared, loaded)
    assert versions() == ready, (settings, versions() - ready)
"""


def test_what_the_thread_makes_ready_is_what_a_picture_needs(tmp_path):
    """In a process of its own, where no other test has left kernels behind."""
    jobs = json.dumps([(str(SAMPLES / f"{name}.vdb"), settings) for name, settings in JOBS])
    command = [sys.executable, "-c", CHECK, str(tmp_path / "a.exr"), jobs]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.needs_jit
def test_a_compilation_is_told_of_for_as_long_as_it_is_waited_for():
    told, heard = [], threading.Event()

    def compiling(done, total):
        told.append((done, total))
        heard.set()

    def use_kernels():
        numba.njit(lambda x: x + 1)(1)
        assert heard.wait(60)

    WarmUp(use_kernels).wait(compiling)
    assert told == [(0, 1), (1, 1)]


def test_nothing_is_told_where_there_is_nothing_to_compile():
    told = []
    kernels = WarmUp(lambda: None)
    for _ in range(2):  # every picture of a job waits
        kernels.wait(lambda *report: told.append(report))
    assert not told


def test_what_goes_wrong_in_the_thread_is_raised_where_kernels_are_waited_for():
    kernels = WarmUp(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        kernels.wait(lambda done, total: None)
