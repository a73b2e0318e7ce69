"""Batches on dask.distributed: a real scheduler with real workers on the loopback interface."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from batches import count, events, start, wait_until, write_batch, write_many
from commandline import ROOT, SAMPLES, volcli, write_ball

from volcli.batch.farm import Farm, _cluster
from volcli.batch.work import Limits, Task
from volcli.config import load_job
from volcli.images import read_exr

pytest.importorskip("distributed", reason="the extra 'farm' is not installed")
pytestmark = pytest.mark.needs_jit

TURNTABLE = f"""
orbit = {{ frames = 8 }}
[defaults]
density = {{ file = "{SAMPLES / "rotated.vdb"}", scale = 5.0 }}
camera.resolution = [160, 120]
output.image = "out/####.exr"
output.maps = ["depth"]
"""


class Cluster:
    """A scheduler and two workers, each a process."""

    def __init__(self, folder):
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        where = folder / "scheduler.json"

        def dask(kind, *arguments):
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments],
                cwd=folder,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )

        local = ("--host", "127.0.0.1", "--no-dashboard")
        self.scheduler = dask("scheduler", *local, "--port", "0", "--scheduler-file", str(where))
        options = (*local, "--no-nanny", "--nthreads", "2", "--scheduler-file", str(where))
        self.workers = [
            dask("worker", *options, "--local-directory", str(folder / name)) for name in "ab"
        ]
        end = time.monotonic() + 60
        while not where.exists() or not where.read_text().strip():
            assert time.monotonic() < end and self.scheduler.poll() is None
            time.sleep(0.05)
        self.file, self.address = where, json.loads(where.read_text())["address"]

    def close(self):
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path):
    folder = tmp_path / "cluster"
    folder.mkdir()
    cluster = Cluster(folder)
    yield cluster
    cluster.close()


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """The turntable as plain processes of this machine render it."""
    folder = tmp_path_factory.mktemp("local")
    process = start(folder, write_batch(folder, TURNTABLE))
    assert process.wait(180) == 0, process.communicate()[1]
    process.communicate()
    return folder / "out"


def same_pictures(folder, local):
    """That the pictures of two folders are equal to the bit."""
    names = sorted(p.name for p in local.glob("*.exr"))
    assert sorted(p.name for p in folder.glob("*.exr")) == names
    assert len(names) == 16
    for name in names:
        ours, theirs = read_exr(folder / name)[0], read_exr(local / name)[0]
        assert set(ours) == set(theirs)
        for channel, values in ours.items():
            assert values.tobytes() == theirs[channel].tobytes(), (name, channel)


def test_one_of_two_workers_is_killed_half_way_and_all_is_done_to_the_bit(tmp_path, cluster, local):
    batch, out = write_batch(tmp_path, TURNTABLE), tmp_path / "out"
    process = start(tmp_path, batch, "--scheduler", cluster.address, engine="cluster")

    def at_work():
        return {e["worker"] for e in events(out) if e["event"] == "done"}

    # Half-way is when both have had a part in it; on a busy machine one may be long in starting.
    assert wait_until(lambda: len(at_work()) == 2 or count(out, "done") >= 12, process)
    both = len(at_work()) == 2
    cluster.workers[0].kill()
    cluster.workers[0].wait()
    _, err = process.communicate(timeout=180)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    same_pictures(out, local)
    if not both:
        pytest.skip("one worker was so late that the other did it all but alone")


def test_pictures_are_sent_back_and_tiles_put_together_to_the_bit(tmp_path, cluster, local):
    batch, out = write_batch(tmp_path, TURNTABLE), tmp_path / "out"
    for option in (["--collect"], ["--tile", "64"], ["--collect", "--tile", "50"]):
        ran = volcli("batch", batch, "--scheduler", cluster.file, "--force", *option)
        assert ran.code == 0, ran.err
        same_pictures(out, local)
        for path in out.glob("*.exr"):
            path.unlink()


def test_a_scheduler_that_goes_away_ends_the_batch_and_resume_goes_on(tmp_path, cluster):
    batch, out = write_many(tmp_path, 60), tmp_path / "out"
    process = start(tmp_path, batch, "--scheduler", cluster.address, engine="cluster")
    assert wait_until(lambda: count(out, "done") >= 5, process)
    cluster.scheduler.kill()
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "the scheduler has gone away" in err
    assert "Traceback" not in err
    done = count(out, "done")
    assert 5 <= done < 60
    process = start(tmp_path, batch, "--resume")
    _, err = process.communicate(timeout=180)
    assert process.returncode == 0, err
    assert count(out, "done") == 60


def test_a_cluster_of_this_machine_survives_the_death_of_a_worker(tmp_path):
    """What --workers is where the extra is installed."""
    batch, out = write_many(tmp_path, 60), tmp_path / "out"
    process = start(tmp_path, batch, "--workers", 2, engine="cluster")
    assert wait_until(lambda: count(out, "done") > 5, process)
    pids = [e["pid"] for e in events(out) if e["event"] == "worker"]
    assert len(pids) == 2
    os.kill(pids[0], signal.SIGKILL)
    _, err = process.communicate(timeout=180)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert count(out, "done") == 60
    assert len(list(out.glob("*.png"))) == 60


def test_a_worker_that_takes_more_than_its_memory_is_replaced_and_the_next_task_is_done(tmp_path):
    zeros = np.zeros((500, 500, 500), np.float32)
    zeros[1, 2, 3] = 1
    np.savez_compressed(tmp_path / "large.npz", density=zeros)
    write_ball(tmp_path / "ball.npz")
    farm = Farm(None, 1, Limits(memory=480_000_000), lambda pid: None)
    try:
        errors = {}
        for name in ("large", "ball"):
            settings = [("output.image", tmp_path / f"{name}.png"), ("camera.resolution", (32, 24))]
            farm.submit(Task(name, load_job(tmp_path / f"{name}.npz", settings)), alone=True)
            while name not in errors:
                errors |= {o.key: o.error for o in farm.wait(1.0)}
    finally:
        farm.close()
    assert "ran out of memory" in errors["large"]
    assert errors["ball"] is None
    assert (tmp_path / "ball.png").exists() and not (tmp_path / "large.png").exists()


def test_a_cluster_of_this_machine_ends_with_the_batch(tmp_path):
    batch, out = write_many(tmp_path, 60), tmp_path / "out"
    for end, code in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        process = start(tmp_path, batch, "--resume", engine="cluster")
        before = count(out, "done")
        assert wait_until(lambda n=before: count(out, "done") > n + 3, process)
        (os.killpg if end == signal.SIGINT else os.kill)(process.pid, end)
        _, err = process.communicate(timeout=60)
        assert process.returncode == code, err
        assert "Traceback" not in err
        pids = [e["pid"] for e in events(out) if e["event"] == "worker"]
        deadline = time.monotonic() + 30
        while any(is_running(pid) for pid in pids):
            assert time.monotonic() < deadline, "a worker outlives its batch"
            time.sleep(0.1)


def is_running(pid):
    """Whether a process is at work: neither gone nor a zombie that nobody waits for."""
    try:
        with open(f"/proc/{pid}/stat") as file:  # noqa: PTH123
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_where_no_scheduler_answers_is_told_in_a_line(tmp_path, monkeypatch):
    monkeypatch.setattr("volcli.batch.farm._ANSWER_SECONDS", 1)
    batch = write_many(tmp_path, 2)
    ran = volcli("batch", batch, "--scheduler", "tcp://127.0.0.1:9")
    assert ran.code == 2
    assert "--scheduler tcp://127.0.0.1:9: no scheduler answers there" in ran.err
    ran = volcli("batch", batch, "--scheduler", "nonsense://x", "--resume")
    assert ran.code == 2
    monkeypatch.setattr("volcli.batch.farm._FILE_SECONDS", 0.2)
    ran = volcli("batch", batch, "--scheduler", tmp_path / "none.json", "--resume")
    assert ran.code == 2
    assert "no scheduler has written its address there" in ran.err
    monkeypatch.setattr("volcli.batch.farm.is_installed", lambda: False)
    ran = volcli("batch", batch, "--scheduler", "tcp://127.0.0.1:9", "--resume")
    assert ran.code == 2
    assert "pip install 'volcli[farm]'" in ran.err


def test_workers_take_no_profiles_for_which_an_interpreter_can_stand_still():
    from distributed import Client

    with _cluster(1, Limits()) as cluster, Client(cluster) as client:
        (regular,) = client.run(lambda dask_worker: list(dask_worker.periodic_callbacks)).values()
    assert "heartbeat" in regular and not any("profile" in name for name in regular)
