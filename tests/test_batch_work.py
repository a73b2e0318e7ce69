"""Tasks in a worker, and what a batch makes of outcomes: turns, memory, retries, blame."""

import threading
from pathlib import Path

import numpy as np
import pytest
from commandline import write_ball

from volcli import run
from volcli.batch.expand import Item
from volcli.batch.manifest import Manifest, read_manifest
from volcli.batch.processes import Processes
from volcli.batch.runner import Runner, Settings, Work
from volcli.batch.session import Options, _phases
from volcli.batch.tiles import Canvas, windows
from volcli.batch.volumes import KeptGrids
from volcli.batch.work import Limits, Outcome, Task, Worker
from volcli.config import load_job
from volcli.errors import UsageError
from volcli.estimate import PIXEL, PROCESS, estimate
from volcli.images import read_exr
from volcli.memory import available_memory, held_memory, parse_memory


@pytest.fixture
def ball(tmp_path):
    return write_ball(tmp_path / "ball.npz")


def job_of(volume, output, **fields):
    settings = [("output.image", output), ("camera.resolution", (40, 30)), *fields.items()]
    return load_job(volume, settings)


# -- in a worker ----------------------------------------------------------------------------------


def test_a_task_leaves_the_pictures_and_their_prints(ball, tmp_path):
    job = job_of(ball, tmp_path / "a.png", **{"output.maps": ["depth"]})
    outcome = Worker(Limits()).work(Task("1", job))
    assert outcome.error is None
    assert {p.name for p in outcome.files} == {"a.png", "a.depth.png"}
    for path, printed in outcome.files.items():
        assert printed["bytes"] == path.stat().st_size


def test_what_goes_wrong_is_told_and_never_raised(ball, tmp_path, monkeypatch):
    worker = Worker(Limits())
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 no zip")
    bad = worker.work(Task("1", job_of(tmp_path / "bad.npz", tmp_path / "a.png")))
    assert "bad.npz" in bad.error and not bad.final
    wrong = worker.work(Task("2", job_of(ball, tmp_path / "a.gif")))
    assert "unknown image format" in wrong.error and wrong.final, "to try again is of no use"
    other = worker.work(Task("3", job_of(ball, tmp_path / "a.png"), version="0.0.1"))
    assert "this worker has volcli" in other.error and other.final

    def broken(*arguments, **options):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(run, "render_loaded", broken)
    defect = worker.work(Task("4", job_of(ball, tmp_path / "a.png")))
    assert "unexpected ZeroDivisionError" in defect.error and "in broken" in defect.trace
    monkeypatch.setattr(run, "render_loaded", lambda *a, **o: (_ for _ in ()).throw(MemoryError()))
    assert "out of memory" in worker.work(Task("5", job_of(ball, tmp_path / "a.png"))).error
    assert not (tmp_path / "a.png").exists()


def test_a_volume_that_many_jobs_use_is_read_once(ball, tmp_path, monkeypatch):
    reads = []
    from volcli.grids.dense import DenseVolume

    read = DenseVolume.read_tree
    monkeypatch.setattr(
        DenseVolume, "read_tree", lambda self, *a: reads.append(self.path) or read(self, *a)
    )
    worker = Worker(Limits(memory=2**40))
    for n in range(4):
        job = job_of(ball, tmp_path / f"{n}.png", **{"density.scale": 1.0 + n})
        assert worker.work(Task(str(n), job)).error is None
    assert len(reads) == 1
    write_ball(ball, peak=3.0)  # another volume by the same name
    assert worker.work(Task("5", job_of(ball, tmp_path / "5.png"))).error is None
    assert len(reads) == 2


def test_the_next_volume_is_read_while_one_renders(ball, tmp_path, monkeypatch):
    other = write_ball(tmp_path / "other.npz")
    rendering, read_meanwhile = threading.Event(), threading.Event()
    render, load = run.render_loaded, run.load

    def slow(prepared, *arguments, **options):
        if prepared.job.density.file == ball:
            rendering.set()
            assert read_meanwhile.wait(60), "the other volume is read before this one is done"
        return render(prepared, *arguments, **options)

    def told(prepared, *arguments, **options):
        if prepared.job.density.file == other:
            assert rendering.wait(60)
        loaded = load(prepared, *arguments, **options)
        if prepared.job.density.file == other:
            read_meanwhile.set()
        return loaded

    monkeypatch.setattr(run, "render_loaded", slow)
    monkeypatch.setattr(run, "load", told)
    worker, outcomes = Worker(Limits()), []
    tasks = [
        Task(f, job_of(tmp_path / f"{f}.npz", tmp_path / f"{f}.png")) for f in ("ball", "other")
    ]
    threads = [threading.Thread(target=lambda t=t: outcomes.append(worker.work(t))) for t in tasks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert [o.error for o in outcomes] == [None, None]


def test_a_task_waits_where_memory_is_for_one_alone(ball, tmp_path, monkeypatch):
    at_work, most = [], []

    def counted(self, task):
        at_work.append(task)
        most.append(len(at_work))
        threading.Event().wait(0.05)
        at_work.remove(task)
        return Outcome(task.key)

    monkeypatch.setattr(Worker, "_done", counted)
    for needs, expected in ((600, 1), (300, 2)):
        most.clear()
        worker = Worker(Limits(memory=PROCESS + 1000))
        tasks = [Task(str(n), job_of(ball, tmp_path / "a.png"), needs=needs) for n in range(6)]
        threads = [threading.Thread(target=worker.work, args=(task,)) for task in tasks]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert max(most) == expected
        assert len(most) == 6


def test_grids_are_dropped_the_least_recently_used_first(tmp_path):
    from volcli.plan import make_plan
    from volcli.scene import make_scene, open_volumes, read_grids

    kept = KeptGrids(None)
    jobs = [job_of(write_ball(tmp_path / f"{n}.npz"), tmp_path / "a.png") for n in range(3)]

    def read(job):
        volumes = open_volumes(job)
        plan = make_plan(job, volumes.density, frozenset({"picture"}))
        grids, _ = read_grids(job, plan, volumes, cache=kept)
        assert make_scene(job, plan, volumes, grids)
        return grids.density

    first, second, third = (read(job) for job in jobs)
    assert kept.nbytes == first.nbytes * 3
    assert read(jobs[0]) is first
    kept.shrink(2 * first.nbytes)
    assert read(jobs[0]) is first
    assert read(jobs[1]) is not second, "it was the least recently used"
    kept.shrink(0)
    assert kept.nbytes == 0
    del third


def test_files_are_sent_back_where_they_are_collected_and_nothing_is_written(ball, tmp_path):
    job = job_of(ball, tmp_path / "no folder" / "a.exr", **{"output.maps": ["depth"]})
    outcome = Worker(Limits()).work(Task("1", job, collect=True))
    assert outcome.error is None
    assert not (tmp_path / "no folder").exists()
    assert {p.name for p in outcome.contents} == {"a.exr", "a.depth.exr"}
    assert outcome.report.image == str(tmp_path / "no folder" / "a.exr")
    (tmp_path / "a.exr").write_bytes(outcome.contents[job.output.image])
    _, header = read_exr(tmp_path / "a.exr")
    assert str(job.output.image) in header["volcli:job"]


@pytest.mark.parametrize("samples", [1, 9])
@pytest.mark.parametrize("edge", [1000, 64, 50, 17])
def test_tiles_put_together_are_the_picture_to_the_bit(ball, tmp_path, edge, samples):
    fields = {"color.grid": "Cd", "camera.resolution": (90, 70), "camera.samples": samples}
    job = job_of(ball, tmp_path / "a.exr", **fields)
    worker, canvas = Worker(Limits()), Canvas(job, edge)
    for window in reversed(windows(job, edge)):
        assert not canvas.is_complete
        canvas.put(window, worker.work(Task("", job, window)).part)
    assert canvas.is_complete
    prepared = run.prepare(job)
    whole = run.render_loaded(prepared, run.load(prepared))
    made = canvas.picture()
    assert made.job == whole.job
    assert made.result.evaluations == whole.result.evaluations
    for name in ("radiance", "optical_depth", "transmittance", "opacity", "depth"):
        assert getattr(made.result, name).tobytes() == getattr(whole.result, name).tobytes(), name


# -- memory ---------------------------------------------------------------------------------------


def test_memory_is_written_with_a_unit_or_as_a_share():
    assert parse_memory("8GB") == parse_memory("8 g") == 8 * 10**9
    assert parse_memory("1.5MiB") == 1.5 * 2**20
    assert parse_memory("2GiB") == 2**31
    assert parse_memory("1000000") == 10**6
    assert parse_memory("50%") == pytest.approx(available_memory() / 2, rel=0.2)
    for text in ("", "much", "-1GB", "0", "8 elephants"):
        with pytest.raises(UsageError, match="--memory"):
            parse_memory(text)


def test_the_estimate_grows_with_the_volume_and_the_picture(ball, tmp_path):
    small = estimate(job_of(ball, tmp_path / "a.png"))
    wide = estimate(job_of(ball, tmp_path / "a.png", **{"camera.resolution": (4000, 3000)}))
    assert wide - small == pytest.approx(PIXEL[".png"] * (12e6 - 1200), rel=0.01)
    np.save(tmp_path / "large.npy", np.ones((100, 100, 100), np.float32))
    large = estimate(job_of(tmp_path / "large.npy", tmp_path / "a.png"))
    assert 7e6 < large - small < 25e6
    assert estimate(job_of(tmp_path / "gone.vdb", tmp_path / "a.png")) is None


def test_a_control_groups_limit_counts_where_it_is_tighter_than_the_machine(tmp_path, monkeypatch):
    free = available_memory()
    assert 2**20 < free < 2**50
    monkeypatch.setattr("volcli.memory._CGROUPS", tmp_path)
    lines = Path("/proc/self/cgroup")
    if not lines.exists():
        pytest.skip("there are no control groups here")
    unified = [line for line in lines.read_text().splitlines() if line.startswith("0::")]
    if not unified:
        pytest.skip("there are no control groups of version 2 here")
    group = tmp_path / unified[0][3:].lstrip("/")
    group.mkdir(parents=True, exist_ok=True)
    (group / "memory.max").write_text("3000000\n")
    (group / "memory.current").write_text("2000000\n")
    (group / "memory.stat").write_text("anon 1\ninactive_file 500000\n")
    assert available_memory() == 1_500_000


def test_jobs_that_take_much_memory_come_last_with_fewer_workers(ball, tmp_path):
    def work(needs):
        return Work(Item(job_of(ball, tmp_path / "a.png")), "", needs)

    gigabyte = 10**9
    works = [work(needs * gigabyte) for needs in (0, 1, 3, 7, 0)]
    found = _phases(works, 4, 8 * gigabyte, Options())
    assert [(count, [w.needs // gigabyte for w in share]) for count, share in found] == [
        (4, [0, 1, 0]),
        (2, [3]),
        (1, [7]),
    ]


# -- the batch ------------------------------------------------------------------------------------


class Scripted:
    """An engine whose workers do what they are told to: an outcome for each try of a job."""

    def __init__(self, script, room=2):
        self.script, self.room, self.tasks, self.log = script, room, [], []

    def has_room(self, alone):
        if alone or any(was_alone for _, was_alone in self.tasks):
            return not self.tasks
        return len(self.tasks) < self.room

    def submit(self, task, alone):
        self.tasks.append((task, alone))
        self.log.append((Path(task.key.partition("#")[0]).stem, alone))

    def wait(self, seconds):
        task, alone = self.tasks.pop(0)
        name = Path(task.key.partition("#")[0]).stem
        what = self.script[name].pop(0)
        if what == "death":
            together = [task, *(t for t, _ in self.tasks)]
            self.tasks = []
            return [Outcome(t.key, "died", lost=not alone) for t in together]
        if what == "ok":
            picture = task.job.output.image
            picture.write_bytes(b"")
            prints = {picture: {}}
            return [Outcome(task.key, report=REPORT, files=prints)]
        return [Outcome(task.key, what, final=what == "wrong")]

    def close(self):
        pass


REPORT = run.Report(None, {}, (1, 1), "exact", 1, 1, {}, {}, None, None, None, {}, 0, [])


def played(ball, tmp_path, script, retries=1, room=2):
    """What was told of each job, and the engine with its log."""
    engine, told = Scripted({k: list(v) for k, v in script.items()}, room), []
    works = [Work(Item(job_of(ball, tmp_path / f"{name}.png")), "h") for name in script]
    with Manifest(tmp_path / "m.jsonl") as manifest:
        Runner(
            engine,
            manifest,
            Settings(retries=retries),
            lambda t: told.append((t.work.item.output.stem, t.event)),
        ).run(works)
    return told, engine


def test_a_job_that_fails_is_tried_again_at_the_end(ball, tmp_path):
    script = {"a": ["busy", "ok"], "b": ["ok"], "c": ["ok"], "d": ["ok"]}
    told, engine = played(ball, tmp_path, script)
    assert told[0] == ("a", "retry")
    assert told[-1] == ("a", "done")
    assert [name for name, _ in engine.log] == ["a", "b", "c", "d", "a"]


def test_a_job_fails_once_its_tries_are_used_up_and_a_wrong_one_at_once(ball, tmp_path):
    script = {"a": ["busy"] * 3, "b": ["wrong"], "c": ["ok"]}
    told, _ = played(ball, tmp_path, script, retries=2)
    assert told.count(("a", "retry")) == 2
    assert told.count(("a", "failed")) == 1
    assert ("b", "failed") in told and ("b", "retry") not in told
    events = [e for e in read_manifest(tmp_path / "m.jsonl") if e.get("job") == "a.png"]
    assert [e["attempt"] for e in events] == [1, 2, 3]
    assert [e["again"] for e in events] == [True, True, False]


def test_a_worker_that_dies_costs_only_the_job_that_killed_it(ball, tmp_path):
    """Both jobs at hand are tried again alone: one dies alone too, the other is innocent."""
    script = {"guilty": ["death", "death", "death"], "innocent": ["ok"], "c": ["ok"]}
    told, engine = played(ball, tmp_path, script, retries=1)
    assert ("innocent", "done") in told and ("c", "done") in told
    assert ("innocent", "retry") not in told, "it is charged with nothing"
    assert told.count(("guilty", "retry")) == 1 and ("guilty", "failed") in told
    assert ("innocent", True) in engine.log and ("guilty", True) in engine.log


def test_without_retries_an_innocent_job_is_still_done(ball, tmp_path):
    script = {"guilty": ["death", "death"], "innocent": ["ok"]}
    told, _ = played(ball, tmp_path, script, retries=0)
    assert sorted(told) == [("guilty", "failed"), ("innocent", "done")]


def test_a_process_that_takes_more_than_its_memory_is_ended_and_the_reason_told(tmp_path):
    """The estimate is of headers; this is what watches what processes really hold."""
    if not held_memory(1) and not Path("/proc/self/statm").exists():
        pytest.skip("this system does not tell what a process holds")
    zeros = np.zeros((500, 500, 500), np.float32)
    zeros[1, 2, 3] = 1
    np.savez_compressed(tmp_path / "large.npz", density=zeros)
    engine = Processes(1, Limits(memory=330_000_000), lambda pid: None)
    try:
        engine.submit(Task("1", job_of(tmp_path / "large.npz", tmp_path / "a.png")), True)
        outcomes = []
        while not outcomes:
            outcomes = engine.wait(1.0)
    finally:
        engine.close()
    assert "out of memory: its worker held" in outcomes[0].error
    assert not outcomes[0].lost
    assert not (tmp_path / "a.png").exists()
