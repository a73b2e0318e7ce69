"""Runs commands of volcli on damaged files, one after another, in a process with little memory.

    python -m fuzz.child FOLDER    numbers of cases on stdin, what became of each on stdout

Started by `runner`. ``--plant NAME`` takes a check out of the reader first, so that a test can see
the harness find that it is missing.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import resource
import shutil
import sys
import warnings
from pathlib import Path

from fuzz.mutate import ROOT, Case, case, seeds
from volcli.grids.vdb_codec import Cursor
from volcli.run import peak_memory_bytes

MEMORY = 3 * 2**30
BALL = str(ROOT / "samples" / "rotated.vdb")
SMALL = ["--size", "8x6", "--threads", "1", "--quiet"]
KEPT = ("samples", "configs", "batch", "sound.exr")
FAILURES = {0, 2, 3, 4, 5}
"""Exit codes that a damaged file may end with: an image, or an error that says what is wrong."""


def commands(made: Case, file: Path, out: Path) -> list[list[str]]:
    """What reads a file of that kind."""
    kind, name = made.seed.kind, str(file)
    rendered = ["render", BALL, "-o", str(out), *SMALL]
    # No picture: each kind of job has kernels to compile, which takes longer than a case may.
    explained = ["--explain", "--json", "--set", "output.image=", *SMALL]
    if kind in ("vdb", "npy", "npz"):
        return [
            ["render", name, "-o", str(out), *SMALL, "--set", "density.nonfinite=zero"],
            [*rendered, *colored_by(name)],
            ["info", name, "--stats"],
            ["info", name, "--stats", "--json"],
        ]
    if kind in ("exr", "png"):
        return [
            ["inspect", name, "--html", str(out.with_suffix(".html"))],
            ["inspect", name, "--json"],
            ["compare", name, str(out.parent / "sound.exr"), "--difference", str(out)],
            ["recomposite", name, "-o", str(out), "--background", "1,0.5,0"],
            ["probe", name, "--pixel", "1,1", "--json"],
            [*rendered, "--background", name],
        ]
    if kind == "batch":
        return [["batch", name, "--dry-run"]]
    if kind == "json":
        return [["render", BALL, *explained, "--set", f"camera.transforms={name}"]]
    return [["render", name, *explained]]


def colored_by(name: str) -> list[str]:
    """Flags that take the colour from a file."""
    return ["--set", f"color.file={name}", "--color-grid", "density"]


def run(made: Case, folder: Path) -> dict[str, object]:
    """One case: the worst of what its commands did."""
    suffix = {"job": "toml", "batch": "toml"}.get(made.seed.kind, made.seed.kind)
    file, out = folder / f"case.{suffix}", folder / "out.exr"
    file.write_bytes(made.raw)
    told: dict[str, object] = {"number": made.number, "seed": made.seed.name, "found": ""}
    chosen = commands(made, file, out)
    # One of its commands, so that all are tried over many cases.
    command = chosen[made.number % len(chosen)]
    code, said = _volcli(command)
    told |= {"code": code, "command": command[0]}
    if code not in FAILURES or "Traceback" in said:
        told["found"] = said[-3000:]
    elif "fit into memory" in said and "may be taken" not in said:
        # Allocated as the file asked, where it is to be refused before.
        told["found"] = said[-3000:]
    elif code and said.count("\n") > 40:
        told["found"] = f"{said.count(chr(10))} lines for one error"
    for path in folder.iterdir():
        if path.name not in KEPT:
            path.unlink()
    told["peak"] = peak_memory_bytes()
    return told


def _volcli(command: list[str]) -> tuple[int, str]:
    from volcli.cli import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(command)
        except SystemExit as end:
            return int(end.code or 0), err.getvalue()
    raise AssertionError("main exits")


def plant(name: str) -> None:
    """Take a check out of the reader."""
    from volcli.grids import vdb

    if name == "need":  # lengths and counts are believed
        Cursor.need = lambda *_: None  # type: ignore[method-assign]
    elif name == "endless":  # a count is walked through, however large
        Cursor.need = _wait_for_ever  # type: ignore[method-assign]
    elif name == "memory":  # what a file asks for is allocated before it is checked
        Cursor.need = _allocate  # type: ignore[method-assign]
    elif name == "crash":
        vdb.read_tree = lambda *_: os.abort()
    else:
        raise ValueError(f"no such check: {name}")


_NEED = Cursor.need


def _wait_for_ever(self: object, size: int, what: str) -> None:
    while size > 10**6:
        pass


def _allocate(self: Cursor, size: int, what: str) -> None:
    if size > 10**6:
        b"\1" * size
    _NEED(self, size, what)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--plant")
    parser.add_argument("--kinds", default="")
    asked = parser.parse_args()
    kinds = tuple(asked.kinds.split(",")) if asked.kinds else ()
    warnings.simplefilter("ignore")
    # Jobs name their volumes relative to themselves: ../samples
    folder = asked.folder / "work"
    shutil.copytree(ROOT / "configs", folder, ignore=shutil.ignore_patterns("*.toml"))
    (asked.folder / "samples").symlink_to(ROOT / "samples")
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    # What is loaded and compiled once is not laid at the first case's door.
    sound = ["render", BALL, "-o", str(folder / "sound.exr"), *SMALL]
    vector = folder / "vector.vdb"
    vector.write_bytes(next(seed.raw for seed in seeds() if "vec3s_224_0" in seed.name))
    code, said = 0, ""
    for command in (sound, [*sound, *colored_by(str(vector))]):
        code, said = (code, said) if code else _volcli(command)
    answers.write("ready\n" if code == 0 else said)
    if asked.plant:
        plant(asked.plant)
    for line in sys.stdin:
        answers.write(json.dumps(run(case(int(line), kinds), folder)) + "\n")


if __name__ == "__main__":
    main()
