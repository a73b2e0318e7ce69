"""Outputs that cannot be written: each kind of file on each kind of trouble ends with exit code 4
and its cause, and what was there before is whole.
"""

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import pytest
from commandline import volcli, write_ball

from volcli import leftovers
from volcli.batch.manifest import read_manifest
from volcli.files import write_file
from volcli.images import read_exr, write_exr, write_png

SIZE = ("--size", "16x12")
RAY = ("--pixel", "8,6", *SIZE)
KINDS = {
    "picture, EXR": ("render {ball} -o {out}.exr", *SIZE),
    "picture, PNG": ("render {ball} -o {out}.png", *SIZE),
    "recomposite, EXR": ("recomposite {a} --background 1,0,0 -o {out}.exr",),
    "recomposite, PNG": ("recomposite {a} --background 1,0,0 -o {out}.png",),
    "table, CSV": ("probe {ball} --csv {out}.csv", *RAY),
    "plot, PNG": ("probe {ball} --plot {out}.png", *RAY),
    "plot, SVG": ("probe {ball} --plot {out}.svg", *RAY),
    "page, HTML": ("inspect {a} --html {out}.html",),
    "heat map, PDF": ("inspect {a} --heatmap {out}.pdf",),
    "difference, EXR": ("compare {a} {b} --difference {out}.exr",),
    "difference, PNG": ("compare {a} {b} --difference {out}.png",),
    "contact sheet, PNG": ("batch {batch} --resume --quiet --contact-sheet {out}.png",),
    "manifest, JSON": ("batch {fresh} --quiet --workers 1",),
    "log": ("batch {batch} --resume --quiet --log {out}.log",),
}
"""The command that writes each."""

FULL = "No space left on device"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A volume, two pictures of it, and a batch that is done."""
    folder = tmp_path_factory.mktemp("inputs")
    ball = write_ball(folder / "ball.npz")
    for name, scale in (("a", 1), ("b", 2)):
        command = ("render", ball, "-o", folder / f"{name}.exr", *SIZE, "--density-scale", scale)
        assert volcli(*command).code == 0
    defaults = f'defaults = {{density.file = "{ball}", camera.resolution = [16, 12], '
    sweep = 'output.image = "c{density.scale}.exr"}\nsweep = {density.scale = [1.0]}\n'
    (folder / "batch.toml").write_text(defaults + sweep)
    assert volcli("batch", folder / "batch.toml", "--quiet", "--workers", 1).code == 0
    found = {name: folder / f"{name}.exr" for name in "ab"}
    return {"ball": ball, "batch": folder / "batch.toml", "defaults": defaults, **found}


class Writer:
    """Writes one kind of file into a folder."""

    def __init__(self, kind, folder, inputs, stem="out"):
        words, *self.options = KINDS[kind]
        self.inputs, self.words = inputs, words.split()
        out = next((word for word in self.words if word.startswith("{out}")), None)
        self.path = folder / f"{stem}{'.jsonl' if out is None else out.removeprefix('{out}')}"

    def command(self):
        places = {"out": self.path.with_suffix(""), **self.inputs}
        if "{fresh}" in self.words:  # a batch that was never run, with its manifest here
            fresh = self.inputs["ball"].with_name("fresh.toml")
            image = (
                f'output.image = "{self.path.parent}/m.exr"}}\nsweep = {{density.scale = [1.0]}}'
            )
            fresh.write_text(f'manifest = "{self.path}"\n{self.inputs["defaults"]}{image}\n')
            places["fresh"] = fresh
        return [*(word.format(**places) for word in self.words), *self.options]

    def __call__(self):
        return volcli(*self.command())


def mounted(stack, folder, size):
    """A small disk on a folder, until the stack is closed."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("only the superuser can make a small disk")
    stack.callback(subprocess.run, ["umount", "-l", str(folder)], check=True)


def fill(folder):
    with (folder / "filler").open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass


def failed(ran, path, cause, before):
    """That a command ended as it should, and left the folder as it was."""
    assert ran.code == 4, ran.err
    assert "Traceback" not in ran.err
    last = ran.err.splitlines()[-1]
    assert last.startswith(f"volcli: {path}"[:200])
    assert cause in last, last
    if before is not None:
        assert {p.name: p.read_bytes() for p in path.parent.iterdir()} == before


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_leaves_the_old_file_and_is_named(kind, inputs, tmp_path):
    with ExitStack() as stack:
        mounted(stack, tmp_path, "64k")
        writer = Writer(kind, tmp_path, inputs)
        if "manifest" not in kind:
            writer.path.write_bytes(b"")
        fill(tmp_path)
        before = contents(tmp_path)
        ran = writer()
        if "manifest" in kind:
            before[writer.path.name] = b""
        failed(ran, writer.path, FULL, before)


@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_that_is_read_only_is_named(kind, inputs, tmp_path):
    with ExitStack() as stack:
        mounted(stack, tmp_path, "64k")
        writer = Writer(kind, tmp_path, inputs)
        if "manifest" not in kind:
            writer.path.write_bytes(b"old")
        before = contents(tmp_path)
        subprocess.run(["mount", "-o", "remount,ro", str(tmp_path)], check=True)
        ran = writer()
        failed(ran, writer.path, "", before)
        assert any(text in ran.err for text in ("ead-only", "not writable"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_without_permission_is_named(kind, inputs, tmp_path):
    folder = tmp_path / "closed"
    folder.mkdir()
    writer = Writer(kind, folder, inputs)
    with ExitStack() as stack:
        if os.geteuid():
            folder.chmod(0o555)
            stack.callback(folder.chmod, 0o755)
        else:  # to whom nothing is forbidden but what nobody may change
            command = ["chattr", "+i", str(folder)]
            if shutil.which("chattr") is None or subprocess.run(command).returncode:
                pytest.skip("nothing can be forbidden to the superuser here")
            stack.callback(subprocess.run, ["chattr", "-i", str(folder)], check=True)
        ran = writer()
        failed(ran, writer.path, "", {})
        texts = ("not writable", "not permitted", "Permission denied")
        assert any(text in ran.err for text in texts)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("manifest, JSON", "log")])
def test_a_folder_that_vanishes_while_work_goes_on_is_named(kind, inputs, tmp_path, monkeypatch):
    folder = tmp_path / "gone"
    folder.mkdir()
    writer = Writer(kind, folder, inputs)
    monkeypatch.setattr(leftovers, "_swept_once", shutil.rmtree)
    failed(writer(), writer.path, "No such file or directory", None)
    assert not folder.exists()


@pytest.mark.parametrize("kind", [kind for kind in KINDS if "manifest" not in kind])
def test_a_folder_that_is_not_there_is_named(kind, inputs, tmp_path):
    writer = Writer(kind, tmp_path / "none", inputs)
    failed(writer(), writer.path, "", None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_that_is_too_long_is_named(kind, inputs, tmp_path):
    writer = Writer(kind, tmp_path, inputs, stem="x" * 300)
    failed(writer(), writer.path, "File name too long", {})


KILL = "import os, sys; os.fsync = lambda _: os.kill(os.getpid(), 9); "
KILL += "from volcli.cli import main; main(sys.argv[1:])"
KILLED = ("picture, EXR", "picture, PNG", "table, CSV", "plot, SVG", "page, HTML", "manifest, JSON")


@pytest.mark.parametrize("kind", KILLED)
def test_a_writer_that_is_killed_with_the_file_written_leaves_the_old_one(kind, inputs, tmp_path):
    """What it left goes when the next one writes there."""
    writer = Writer(kind, tmp_path, inputs)
    writer.path.write_bytes(b"" if "manifest" in kind else b"old")
    command = [sys.executable, "-c", KILL, *writer.command()]
    assert subprocess.run(command, capture_output=True).returncode == -9
    if "manifest" in kind:  # it is added to, a line at a time
        assert writer.path.read_bytes().endswith(b"\n")
    else:
        assert writer.path.read_bytes() == b"old"
        assert len(contents(tmp_path)) == 2, "it was killed too early"
    assert writer().code == 0
    assert set(contents(tmp_path)) == {writer.path.name} | ({"m.exr"} & set(contents(tmp_path)))
    if "manifest" in kind:
        assert read_manifest(writer.path)[-1]["event"] == "done"
    else:
        assert writer.path.read_bytes() != b"old"


TWO = {
    "page.html": lambda path, n: write_file(path, bytes([n]) * 300_000),
    "a.exr": lambda path, n: write_exr(
        path, {c: np.full((64, 64), n, np.float32) for c in "RGBA"}, {}
    ),
    "a.png": lambda path, n: write_png(path, np.full((64, 64, 4), n / 2, np.float32), {}),
}


@pytest.mark.parametrize("name", TWO)
def test_of_two_writers_of_one_name_the_file_is_always_one_of_theirs_and_whole(name, tmp_path):
    path, write = tmp_path / name, TWO[name]
    whole = set()
    for number in (1, 2):
        write(path, number)
        whole.add(path.read_bytes())
    assert len(whole) == 2

    def write_often(number):
        for _ in range(40):
            write(path, number)

    seen = set()
    with ThreadPoolExecutor(2) as pool:
        writers = [pool.submit(write_often, number) for number in (1, 2)]
        while not all(writer.done() for writer in writers):
            seen.add(path.read_bytes())
    assert [writer.result() for writer in writers] == [None, None]
    assert seen <= whole
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_log_that_fills_the_disk_does_not_stop_the_pictures(inputs, tmp_path):
    with ExitStack() as stack:
        mounted(stack, tmp_path, "8k")
        (tmp_path / "a.log").write_bytes(bytes(4000))
        fill(tmp_path)
        batch = inputs["batch"].with_name("logged.toml")
        batch.write_text(inputs["batch"].read_text().replace("[1.0]", "[3.0, 4.0]"))
        ran = volcli("batch", batch, "--workers", 1, "--log", tmp_path / "a.log")
    assert ran.code == 4
    assert "the log cannot be written: No space left on device" in ran.err.splitlines()[-1]
    for scale in (3, 4):
        assert read_exr(batch.with_name(f"c{scale}.exr"))[0]["A"].max() > 0
