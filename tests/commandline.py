"""Runs the command line as a user does, in this process, and writes small volumes for it."""

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from vdbwriter import Grid, write_vdb

from volcli.cli import main

ROOT = Path(__file__).parents[1]
SAMPLES = ROOT / "samples"
VOLUMES = ROOT.parent / "shared" / "volumes"
"""Files of other programs, beside the checkout; tests that use them skip where they are absent."""


@dataclass(frozen=True)
class Ran:
    """What a command left: its exit code, and what it printed."""

    code: int
    out: str
    err: str


def volcli(*arguments):
    """Run ``volcli ARGUMENTS``."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(a) for a in arguments])
        except SystemExit as end:
            code = end.code
    return Ran(code, out.getvalue(), err.getvalue())


def write_ball(path, peak=1.0):
    """A soft ball of radius 3 around (4, 4, 4) as a dense file, with a colour grid beside it."""
    axes = np.indices((9, 9, 9)) - 4.0
    density = peak * np.clip(1 - np.sqrt((axes**2).sum(axis=0)) / 3.5, 0, None)
    color = np.full((9, 9, 9, 3), (1.0, 0.5, 0.25))
    np.savez(path, density=density.astype(np.float32), Cd=color.astype(np.float32))
    return path


def write_grid(path, **grid):
    """A .vdb file of one grid, of one leaf that is 1 everywhere unless ``grid`` says otherwise."""
    full = np.ones((8, 8, 8, 3) if grid.get("value_type", "").startswith("vec3") else (8, 8, 8))
    leaves = {(0, 0, 0): (full, np.ones((8, 8, 8), bool))}
    write_vdb(path, [Grid(**{"leaves": leaves, **grid})])
    return path
