"""Kernels made ready beside the reading of a volume: in time, of the right types, and told of."""

import json
import subprocess
import sys
import threading

import numba
import pytest
from commandline import SAMPLES, write_grid

from volcli.warmup import WarmUp

RAMP = "density.ramp.stops=[[0.2, 0], [0.3, 1], [0.8, 1], [0.9, 0]]"
TINT = "density.tint=[1, 0.5, 0.25]"
JOBS = [  # a kernel takes a while to compile: all terms are here, not all combinations
    ("rotated", []),
    ("rotated", ["quadrature.rule=midpoint"]),
    ("rotated", ["density.interpolation=nearest"]),
    ("rotated", ["color.constant=[1, 0, 0]", TINT]),
    ("set", ["density.level_set=fog"]),
    ("cloud", ["color.grid=Cd"]),
    ("explosion", ["color.ramp.grid=temperature"]),
    ("explosion", ["color.ramp.stops=[[0, 0, 0, 0], [1, 1, 1, 1]]"]),
    ("explosion", ["color.blackbody.grid=temperature"]),
    ("explosion", ["emission.blackbody.grid=temperature", RAMP]),
    ("explosion", ["color.grid=Cd", "emission.grid=flame", TINT]),
    ("explosion", ["density.scale=0", "emission.grid=Cd"]),
]

CHECK = """
import importlib, inspect, json, pkgutil, sys
from pathlib import Path
from numba import types, typeof
from numba.core.registry import CPUDispatcher
import volcli.kernels
from volcli.config import load_job
from volcli.kernels import packets, rays
from volcli.run import load, prepare, render_loaded

modules = [importlib.import_module(m.name) for m in
           pkgutil.iter_modules(volcli.kernels.__path__, "volcli.kernels.")]
kernels = {k for m in modules for k in vars(m).values() if isinstance(k, CPUDispatcher)}
calls = []

def versions():
    return {(k.__name__, str(s)) for k in kernels for s in k.signatures}

def recorded(module, name):
    kernel = getattr(module, name)
    names = list(inspect.signature(kernel.py_func).parameters)
    def call(*arguments):
        done = kernel(*arguments)
        given = tuple(typeof(argument) for argument in arguments)
        assert given in kernel.signatures, "not this version was run"
        calls.append((name, [n for n, t in zip(names, given) if t is not types.none]))
        return done
    setattr(module, name, call)

recorded(rays, "integrate_rays")
recorded(packets, "integrate_packets")
out, found = Path(sys.argv[1]), []
for volume, settings in json.loads(sys.argv[2]):
    flags = [("output.image", out), ("camera.resolution", (8, 6))]
    prepared = prepare(load_job(Path(volume), flags, settings))
    for _ in range(2):  # the second time out of the cache
        loaded = load(prepared, cache=out.with_name("cache"))
        loaded.kernels.wait(lambda done, total: None)
        ready = versions()
        calls.clear()
        render_loaded(prepared, loaded)
        late = sorted(versions() - ready)
        plan = prepared.plan
        wanted = {"transfer": plan.transfer, "colour": plan.color is not None,
                  "emission": plan.emission is not None, "tint": plan.tint, "depth": plan.depth,
                  "step_voxels": plan.step_voxels is not None, "nearest": plan.nearest}
        found.append([settings, wanted, len(ready), late, calls[:]])
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(settings, terms wanted, kernels made ready, those made later, calls) of each of the jobs, in
    a process of its own, where no other test has left kernels behind."""
    folder = tmp_path_factory.mktemp("kernels")
    level_set = write_grid(folder / "set.vdb", metadata={"class": ("string", b"level set")})
    paths = [level_set if name == "set" else SAMPLES / f"{name}.vdb" for name, _ in JOBS]
    jobs = [(str(path), settings) for path, (_, settings) in zip(paths, JOBS, strict=True)]
    command = [sys.executable, "-c", CHECK, str(folder / "a.exr"), json.dumps(jobs)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.needs_jit
def test_what_the_thread_makes_ready_is_what_a_picture_needs(made):
    for settings, _, ready, late, _ in made:
        assert ready, "no kernel is ready"
        assert not late, settings


@pytest.mark.needs_jit
def test_a_kernel_is_compiled_with_the_terms_that_the_plan_names_and_without_the_others(made):
    assert len(made) == 2 * len(JOBS)
    for settings, wanted, _, _, calls in made:
        assert len({name for name, _ in calls}) == 1, settings
        # A constant colour and a tint of it are closed forms, after the kernel.
        wanted["tint"] &= wanted["colour"] or wanted["emission"]
        for name, given in calls:
            present = {term: term in given for term in wanted}
            assert present == wanted, (settings, name)


@pytest.mark.needs_jit
def test_an_opacity_alone_and_a_constant_colour_are_one_kernel(made):
    alone = next(calls for settings, _, _, _, calls in made if not settings)
    coloured = next(c for settings, _, _, _, c in made if any("constant" in s for s in settings))
    assert alone[0] == coloured[0]


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
