"""Batches as processes of their own that are killed, interrupted and starved, and go on."""

import contextlib
import os
import random
import signal
import subprocess
from collections import Counter

import numpy as np
import pytest
from batches import count, events, leftovers, start, wait_until, write_batch, write_many
from commandline import write_ball

from volcli.batch.expand import read_batch
from volcli.images import read_exr

pytestmark = pytest.mark.needs_jit


def ended(process, seconds=180):
    """What a process printed, and its exit code."""
    out, err = process.communicate(timeout=seconds)
    return process.returncode, out, err


def agree(folder, batch):
    """That manifest and folder say the same: every job done, once, and its file whole."""
    done = Counter((e["job"], e["hash"]) for e in events(folder) if e["event"] == "done")
    assert set(done.values()) == {1}, "nothing that was recorded was rendered again"
    expected = {item.output for item in read_batch(batch).items}
    assert {folder / job for job, _ in done} == expected
    assert {p for p in folder.iterdir() if p.suffix != ".jsonl"} == expected, "and no leftovers"
    for path in expected:
        assert path.read_bytes()[-8:] == b"IEND\xaeB\x60\x82"


def test_killed_at_random_moments_and_resumed_each_time_all_is_done_and_nothing_twice(tmp_path):
    batch, out = write_many(tmp_path, 40), tmp_path / "out"
    moments = random.Random(7)
    killed = 0
    for _ in range(5):
        until = count(out, "done") + moments.randint(0, 6)
        process = start(tmp_path, batch, "--resume")
        begun = count(out, "batch")
        if wait_until(
            lambda n=until, b=begun: count(out, "batch") > b and count(out, "done") >= n, process
        ):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(moments.random() * 0.05)
        process.kill()
        killed += process.wait() == -signal.SIGKILL
        process.communicate()
    assert killed >= 3
    code, _, err = ended(start(tmp_path, batch, "--resume"))
    assert code == 0, err
    agree(out, batch)


def test_a_worker_that_is_killed_is_replaced_and_everything_is_done(tmp_path):
    batch, out = write_many(tmp_path, 30), tmp_path / "out"
    process = start(tmp_path, batch, "--workers", 2)
    assert wait_until(lambda: count(out, "done") > 5, process)
    os.kill(next(e["pid"] for e in events(out) if e["event"] == "worker"), signal.SIGKILL)
    code, _, err = ended(process)
    assert code == 0, err
    agree(out, batch)
    assert count(out, "worker") == 3


def test_a_job_that_needs_more_memory_than_there_is_fails_alone(tmp_path):
    write_ball(tmp_path / "a.npz")
    write_ball(tmp_path / "c.npz")
    zeros = np.zeros((500, 500, 500), np.float32)
    zeros[1, 2, 3] = 1
    np.savez_compressed(tmp_path / "b.npz", density=zeros)
    batch = write_batch(
        tmp_path,
        'defaults = {density.file = "*.npz", camera.resolution = [32, 24], '
        'output.image = "out/{stem}.png"}',
    )
    code, out, err = ended(start(tmp_path, batch, "--workers", 1, "--memory", "700MB"))
    assert code == 6, err
    assert "needs about" in out
    assert sorted(p.name for p in (tmp_path / "out").glob("*.png")) == ["a.png", "c.png"]


def test_ctrl_c_ends_cleanly_and_resume_goes_on(tmp_path):
    batch, out = write_many(tmp_path, 40), tmp_path / "out"
    process = start(tmp_path, batch)
    assert wait_until(lambda: count(out, "done") > 5, process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to workers too
    code, printed, err = ended(process)
    assert code == 130
    assert "Traceback" not in err
    assert "interrupted" in err
    assert "left" in printed, "the summary says what is left"
    assert 5 < count(out, "done") < 40
    assert count(out, "failed") == 0
    assert leftovers(out) == []
    code, _, err = ended(start(tmp_path, batch, "--resume"))
    assert code == 0, err
    agree(out, batch)


def test_of_fifty_jobs_three_fail_with_their_reasons_and_the_rest_is_done(tmp_path):
    for frame in range(1, 51):
        write_ball(tmp_path / f"s.{frame:04d}.npz")
    corrupt, missing = tmp_path / "s.0007.npz", tmp_path / "s.0013.npz"
    corrupt.write_bytes(corrupt.read_bytes()[:5000])
    np.savez(missing, heat=np.ones((4, 4, 4), np.float32), fuel=np.ones((4, 4, 4), np.float32))
    (tmp_path / "out" / "0021.exr").mkdir(parents=True)
    batch = write_batch(
        tmp_path,
        'defaults = {density.file = "s.$F4.npz", camera.resolution = [32, 24], '
        'output.image = "out/####.exr"}',
    )
    code, out, err = ended(start(tmp_path, batch))
    assert code == 6, err
    assert "3 of 50 jobs failed" in err
    reasons = {line.split()[0]: line for line in out.splitlines() if "  failed: " in line}
    assert "not a readable NumPy file" in reasons["out/0007.exr"]
    assert "no grid named 'density'" in reasons["out/0013.exr"]
    assert "is a folder" in reasons["out/0021.exr"]
    assert len(reasons) == 3
    assert count(tmp_path / "out", "done") == 47
    for frame in set(range(1, 51)) - {7, 13, 21}:
        assert read_exr(tmp_path / "out" / f"{frame:04d}.exr")[0]["A"].max() > 0.3


def test_two_batches_of_one_manifest_do_not_run_at_once(tmp_path):
    batch, out = write_many(tmp_path, 20), tmp_path / "out"
    first = start(tmp_path, batch)
    assert wait_until(lambda: count(out, "done") > 0, first)
    first.send_signal(signal.SIGSTOP)  # for as long as the second takes to begin
    code, _, err = ended(start(tmp_path, batch, "--resume"))
    first.send_signal(signal.SIGCONT)
    assert code == 4
    assert "another batch is at work on it" in err
    assert ended(first)[0] == 0
    agree(out, batch)


def test_a_full_disk_fails_jobs_and_what_is_written_is_whole(tmp_path):
    small, folder = tmp_path / "out", tmp_path / "jobs"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(small)]
    try:
        if subprocess.run(mount, capture_output=True).returncode != 0:
            pytest.skip("only the superuser can make a small disk")
    except FileNotFoundError:
        pytest.skip("there is no mount here")
    try:
        folder.mkdir()
        write_ball(folder / "ball.npz")
        batch = write_batch(
            folder,
            'defaults = {density.file = "ball.npz", camera.resolution = [64, 48], '
            'output.image = "../out/{density.scale}.exr"}\n'
            f"sweep = {{density.scale = {[float(n) for n in range(1, 21)]}}}",
        )
        code, _, err = ended(start(folder, batch, "--retries", 0))
        assert code in (4, 6), err  # the manifest may be what finds no room
        assert leftovers(small) == []
        done = sorted(small.glob("*.exr"))
        assert 0 < len(done) < 20
        for path in done:
            read_exr(path)
        subprocess.run(["mount", "-o", "remount,size=5m", str(small)], check=True)
        code, _, err = ended(start(folder, batch, "--resume"))
        assert code == 0, err
        assert len(sorted(small.glob("*.exr"))) == 20
        assert count(small, "done") >= 20
    finally:
        subprocess.run(["umount", str(small)], check=True)
