"""The manifest: true at any moment, and a job is done where it and the folder say the same."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from commandline import write_ball

from volcli.batch.identity import file_print, job_hash
from volcli.batch.manifest import Manifest, Record, read_manifest
from volcli.config import load_job
from volcli.errors import OutputError
from volcli.leftovers import remove_leftovers

HASH = "0123"


@pytest.fixture
def picture(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(b"a picture")
    return path


@pytest.fixture
def manifest(tmp_path, picture):
    """A manifest in which that picture is done."""
    path = tmp_path / "b.manifest.jsonl"
    with Manifest(path) as manifest:
        manifest.begin(1)
        manifest.worker(123)
        manifest.done(picture, HASH, {picture: file_print(picture)}, seconds={"load": 1.0})
    return path


def is_done(manifest, picture, content=HASH, **more):
    return Record(manifest).is_done(picture, content, {"picture": picture, **more})


def test_a_job_is_done_where_the_manifest_and_the_folder_say_the_same(manifest, picture):
    assert is_done(manifest, picture)
    assert not is_done(manifest, picture, content="other")
    assert not is_done(manifest, picture, depth=picture.with_name("a.depth.png")), "a new map"
    assert not is_done(manifest, picture.with_name("b.png"))


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p.unlink(),
        lambda p: p.write_bytes(b"a pict"),
        lambda p: p.write_bytes(b"another p"),
        lambda p: (p.unlink(), p.mkdir()),
    ],
    ids=["gone", "cut", "changed", "a folder"],
)
def test_a_picture_that_is_not_what_was_written_is_not_done(manifest, picture, change):
    change(picture)
    assert not is_done(manifest, picture)


def test_a_picture_that_was_touched_or_copied_and_not_changed_is_done(manifest, picture):
    os.utime(picture, (1, 1))
    assert is_done(manifest, picture)


def test_a_folder_may_be_moved_with_its_manifest(manifest, picture, tmp_path):
    there = tmp_path / "there"
    there.mkdir()
    moved = [shutil.move(p, there / p.name) for p in (manifest, picture)]
    assert is_done(*moved)


def test_what_was_last_said_of_a_job_holds(manifest, picture):
    with Manifest(manifest) as again:
        again.failed(picture, HASH, "no space", attempt=1)
        assert not again.is_done(picture, HASH, {"picture": picture})
    assert not is_done(manifest, picture)


@pytest.mark.parametrize("cut", [*range(40), 50, 80, 100, 101, 150, 202, 250, 301, 302, 303])
def test_a_cut_at_any_byte_costs_the_last_line_at_most_and_is_written_over_well(tmp_path, cut):
    path = tmp_path / "m.jsonl"
    with Manifest(path) as manifest:
        for n in range(3):
            manifest.done(tmp_path / f"{n}.png", HASH, {})
    whole = path.read_bytes()
    cut = min(cut, len(whole))
    path.write_bytes(whole[:cut])
    with Manifest(path) as manifest:
        manifest.done(tmp_path / "last.png", HASH, {})
    left = read_manifest(path)
    lines = whole[:cut].count(b"\n") + (cut > 0 and whole[cut : cut + 1] == b"\n")
    assert len(left) == lines + 1
    assert left[-1]["job"] == "last.png"


def test_a_second_process_cannot_open_a_manifest_that_is_open(manifest):
    code = f"""
from pathlib import Path
from volcli.batch.manifest import Manifest
try:
    Manifest(Path({str(manifest)!r}))
except Exception as error:
    print(type(error).__name__, error)
"""
    command = [sys.executable, "-c", code]
    with Manifest(manifest):
        told = subprocess.run(command, capture_output=True, text=True, timeout=60).stdout
        assert told.startswith("OutputError") and "another batch is at work" in told
    assert subprocess.run(command, capture_output=True, text=True, timeout=60).stdout == ""


def test_a_file_that_is_no_manifest_is_left_alone(tmp_path):
    path = tmp_path / "smoke.vdb"
    path.write_bytes(b"\x20\x42\x44\x56 volume")
    with pytest.raises(OutputError, match="is no manifest"):
        Manifest(path)
    assert path.read_bytes() == b"\x20\x42\x44\x56 volume"
    with pytest.raises(OutputError, match="cannot be written"):
        Manifest(tmp_path / "smoke.vdb" / "b.jsonl")


def test_a_full_disk_is_an_error_of_the_output(manifest, monkeypatch):
    with Manifest(manifest) as again:

        def full(file, data):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(OutputError, match="No space left"):
            again.begin(1)


def test_lines_of_others_and_nonsense_are_passed_over(manifest, picture):
    with manifest.open("ab") as file:
        file.write(b'\x00\x00\n[1, 2]\n{"event": "done", "job": [1]}\n{"job": "a.png"}\n\xff\n')
    assert is_done(manifest, picture)


def test_the_hash_of_a_job_changes_with_its_fields_and_its_inputs_and_with_nothing_else(tmp_path):
    volume = write_ball(tmp_path / "ball.npz")
    job = load_job(volume, [("output.image", tmp_path / "a.png")])
    first = job_hash(job)
    assert job_hash(job) == first
    assert job_hash(load_job(volume, [("output.image", tmp_path / "b.png")])) != first
    (tmp_path / "a.png").write_bytes(b"the output is no input")
    assert job_hash(job) == first
    write_ball(volume, peak=2.0)
    second = job_hash(job)
    assert second != first
    data = volume.read_bytes()
    volume.write_bytes(data[:100] + b"\x01" + data[101:])
    assert job_hash(job) != second
    volume.unlink()
    assert job_hash(job) not in (first, second)


def test_the_hash_of_a_job_changes_with_the_version(tmp_path, monkeypatch):
    job = load_job(write_ball(tmp_path / "ball.npz"))
    first = job_hash(job)
    monkeypatch.setattr("volcli.__version__", "9.9", raising=False)
    assert job_hash(job) != first


def test_temporary_files_of_dead_workers_are_removed_and_no_others(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    mine, dead, foreign = os.getpid(), ended.pid, 999_999_999
    for name in (f".volcli-{mine}-ab", f".volcli-{dead}-ab.exr", f".volcli-{foreign}-ab.png"):
        (tmp_path / name).touch()
    old = tmp_path / ".volcli-999999998-cd.exr"
    old.touch()
    os.utime(old, (1, 1))
    (tmp_path / f".volcli-{dead}.txt").touch()
    assert remove_leftovers([tmp_path, tmp_path / "gone"], {mine, dead}) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [f".volcli-{mine}-ab", f".volcli-{foreign}-ab.png", f".volcli-{dead}.txt"]
    )


def test_each_line_says_when_and_where(manifest):
    lines = [json.loads(line) for line in manifest.read_text().splitlines()]
    assert [line["event"] for line in lines] == ["batch", "worker", "done"]
    assert all({"time", "host"} <= set(line) for line in lines)
    assert lines[2]["job"] == "a.png", "relative, so that the folder may be moved"
