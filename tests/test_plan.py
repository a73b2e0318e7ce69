"""A plan tells what is evaluated, and how often: here the kernels, run as Python, are counted.

Which grids are read is tested in `test_scene`; which kernels are compiled, in `test_warmup`.
"""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

COUNT = """
import json, sys
from collections import Counter
from pathlib import Path
from volcli.config import load_job
from volcli.kernels import integrator, light, rules
from volcli.run import load, prepare, render_loaded

calls, terms = Counter(), {}

def counted(module, name, term, each=1):
    function = getattr(module, name)
    def call(*arguments):
        calls[term(arguments) if callable(term) else term] += each
        return function(*arguments)
    setattr(module, name, call)

def source(arguments):
    return "colour" if arguments[0] is terms["colour"] else "emission"

def transfer(arguments):
    return "transfer" if arguments[0] is not None else "none"

counted(rules, "cubic", "optical depth")
counted(rules, "value_in", "optical depth")
counted(rules, "linear_piece", "transfer")
counted(rules, "transferred", transfer)
counted(rules, "source_at", source)
counted(light, "source_at", source)
counted(light, "hit_weights", "hit depth", 4)

make = integrator.make_integrator

def kept(density, **given):
    terms.update(given)
    return make(density, **given)

integrator.make_integrator = kept

found = []
for settings in json.loads(sys.argv[2]):
    flags = [("camera.resolution", (2, 2)), ("camera.type", "orthographic"), ("camera.width", 3.7),
             ("camera.eye", (4.2, 4.3, -9)), ("camera.target", (5.3, 3.1, 0))]
    prepared = prepare(load_job(Path(sys.argv[1]), flags, settings), writes=False)
    calls.clear()
    rendered = render_loaded(prepared, load(prepared), threads=1)
    plan = {t.name: t.evaluations for t in prepared.plan.terms if t.wanted and t.evaluations}
    seen = {name: calls[name] / rendered.result.evaluations for name in plan}
    others = sorted(set(+calls) - set(plan) - {"none"})
    found.append([settings, plan, seen, others])
print(json.dumps(found))
"""

LINE = "[[-1, 0, 0, 0], [2, 1, 1, 1]]"  # no kink is met on the way
MIDPOINT = "quadrature.rule=midpoint"
ALL = [
    "density.ramp.stops=[[-1, 0], [2, 1]]",
    "color.grid=Cd",
    f"emission.ramp.stops={LINE}",
    "emission.ramp.grid=heat",
]
JOBS = [
    [],
    ["color.grid=Cd"],
    [f"color.ramp.stops={LINE}"],
    ["emission.grid=Cd"],
    ["density.scale=0.01", f"emission.ramp.stops={LINE}", "emission.ramp.grid=heat"],
    ALL,
    [MIDPOINT],
    [MIDPOINT, *ALL],
]


def test_the_terms_of_a_plan_are_evaluated_as_often_as_it_says(tmp_path):
    """In thin cells on one lattice, which are not cut."""
    rng = np.random.default_rng(1)
    np.savez(
        tmp_path / "a.npz",
        density=np.full((9, 9, 9), 1e-3, np.float32),
        heat=rng.random((9, 9, 9), np.float32),
        Cd=rng.random((9, 9, 9, 3), np.float32),
    )
    done = subprocess.run(
        [sys.executable, "-c", COUNT, str(tmp_path / "a.npz"), json.dumps(JOBS)],
        capture_output=True,
        text=True,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    )
    assert done.returncode == 0, done.stderr
    for settings, plan, seen, others in json.loads(done.stdout):
        if MIDPOINT in settings:  # a distance is part of the sum, with no sample of its own
            assert (plan.pop("hit depth"), seen.pop("hit depth")) == (1, 0)
        assert seen == pytest.approx(plan), settings
        assert not [name for name in others if name != "hit depth"], settings
