"""`volcli batch`: what it prints and refuses, and its contact sheet; `volcli render --frames`."""

import contextlib
import io
import json

import numpy as np
import pytest
from batches import count, write_batch, write_many
from commandline import ROOT, SAMPLES, volcli, write_ball

from volcli.batch.session import Tally
from volcli.batch.work import Worker
from volcli.cli.batch_output import Output
from volcli.estimate import PROCESS
from volcli.images import read_background, read_exr

pytestmark = pytest.mark.needs_jit
BATCHES = sorted((ROOT / "configs" / "batch").glob("*.toml"))


class Here:
    """An engine that does the work itself; those that have others do it are tested elsewhere."""

    def __init__(self, count, limits, on_start):
        self.worker, self.tasks = Worker(limits), []

    def has_room(self, alone):
        return not self.tasks

    def submit(self, task, alone):
        self.tasks.append(task)

    def wait(self, seconds):
        return [self.worker.work(self.tasks.pop())]

    def close(self):
        pass


@pytest.fixture(autouse=True)
def work_here(monkeypatch):
    monkeypatch.setattr("volcli.batch.farm.is_installed", lambda: False)
    monkeypatch.setattr("volcli.batch.session.Processes", Here)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_many(tmp_path, 3)
    return tmp_path


def test_a_line_for_each_job_and_a_summary_go_to_stdout_and_the_rest_to_stderr(folder):
    ran = volcli("batch", "b.toml", "--log", "log.txt")
    assert ran.code == 0
    lines = ran.out.splitlines()
    assert sorted(line.split()[0] for line in lines[:3]) == [f"out/0.{n}.png" for n in (1, 2, 3)]
    assert lines[-2].split()[:5] == ["jobs", "done", "kept", "failed", "left"]
    assert lines[-1].split()[:5] == ["3", "3", "0", "0", "0"]
    log = (folder / "log.txt").read_text()
    assert "3 jobs" in log and "out/0.1.png: done" in log and "done 3" in log
    again = volcli("batch", "b.toml", "--resume", "--log", "log.txt")
    assert again.out.splitlines()[-1].split()[:5] == ["3", "0", "3", "0", "0"]
    assert "3 are done already" in again.err
    assert (folder / "log.txt").read_text().startswith(log), "a log is added to"


def test_quiet_is_the_summary_alone(folder):
    ran = volcli("batch", "b.toml", "--quiet")
    assert len(ran.out.split("\n\n")[0].splitlines()) <= 3
    assert "out/0.1.png" not in ran.out
    assert ran.err == ""


def test_json_is_a_line_for_each_job_and_one_for_the_sum(folder):
    (folder / "out").mkdir()
    (folder / "out" / "0.2.png").mkdir()
    ran = volcli("batch", "b.toml", "--json", "--retries", 0)
    assert ran.code == 6
    *jobs, last = [json.loads(line) for line in ran.out.splitlines()]
    states = {job["job"].rpartition("/")[2]: job["state"] for job in jobs}
    assert states == {"0.1.png": "done", "0.2.png": "failed", "0.3.png": "done"}
    failed = next(job for job in jobs if job["state"] == "failed")
    assert "is a folder" in failed["error"]
    assert last["summary"]["done"] == 2 and last["summary"]["failed"] == 1


def test_a_dry_run_lists_the_jobs_with_their_memory_and_does_nothing(folder):
    ran = volcli("batch", "b.toml", "--dry-run")
    assert ran.code == 0
    assert not (folder / "out").exists()
    assert ran.out.splitlines()[0].split() == ["picture", "volume", "size", "memory", "state"]
    assert ran.out.splitlines()[1].split()[:3] == ["out/0.1.png", "ball.npz", "32x24"]
    assert f"3 jobs, 3 to do; the largest takes about {PROCESS // 10**7}" in ran.out
    assert volcli("batch", "b.toml").code == 0
    (folder / "out" / "0.2.png").unlink()
    states = [
        json.loads(line)["state"]
        for line in volcli("batch", "b.toml", "--dry-run", "--json").out.splitlines()
    ]
    assert states == ["done", "to do", "done"]


def test_what_an_earlier_run_has_done_is_done_again_only_if_it_is_asked_for(folder):
    assert volcli("batch", "b.toml").code == 0
    before = (folder / "out" / "0.1.png").stat().st_mtime_ns
    ran = volcli("batch", "b.toml")
    assert ran.code == 2
    assert "--resume does what is missing or changed" in ran.err and "--force" in ran.err
    assert volcli("batch", "b.toml", "--resume").code == 0
    assert (folder / "out" / "0.1.png").stat().st_mtime_ns == before
    assert volcli("batch", "b.toml", "--force").code == 0
    assert (folder / "out" / "0.1.png").stat().st_mtime_ns > before


def test_resume_does_what_is_missing_damaged_or_changed_and_nothing_else(folder):
    assert volcli("batch", "b.toml").code == 0
    out = folder / "out"
    (out / "0.1.png").unlink()
    (out / "0.2.png").write_bytes((out / "0.2.png").read_bytes()[:-1])
    assert volcli("batch", "b.toml", "--resume").code == 0
    assert count(out, "done") == 5
    settings = ("--set", "color.constant=[1,0,0]", "--resume")
    assert volcli("batch", "b.toml", *settings).code == 0
    assert count(out, "done") == 8, "the jobs are others now"
    assert volcli("batch", "b.toml", *settings).code == 0
    assert count(out, "done") == 8
    write_ball(folder / "ball.npz", peak=0.5)
    assert volcli("batch", "b.toml", *settings).code == 0
    assert count(out, "done") == 11, "and so is the volume"


def test_a_missing_frame_is_a_job_that_failed_and_resume_does_it_once_it_is_there(folder):
    for frame in (1, 3):
        write_ball(folder / f"s.{frame:02d}.npz")
    write_batch(
        folder,
        'frames = "1-3"\ndefaults = {density.file = "s.##.npz", camera.resolution = [16, 12], '
        'output.image = "seq/##.png"}',
        "s.toml",
    )
    ran = volcli("batch", "s.toml")
    assert ran.code == 6
    assert "s.02.npz: no such file" in ran.out
    write_ball(folder / "s.02.npz")
    ran = volcli("batch", "s.toml", "--resume", "--json")
    assert ran.code == 0
    done = [json.loads(line).get("job", "") for line in ran.out.splitlines()]
    assert sum(job.endswith("02.png") for job in done) == 1


WRONG = {
    "resume and force": ("--resume --force", 2, "exclude each other"),
    "workers of a cluster": ("--scheduler x --workers 2", 2, "--workers is for this machine"),
    "memory of a cluster": ("--scheduler x --memory 1GB", 2, "--memory is for this machine"),
    "collect from here": ("--collect", 2, "--collect is for --scheduler"),
    "memory as a word": ("--memory much", 2, "--memory much: give bytes with a unit"),
    "workers 0": ("--workers 0", 2, "--workers"),
    "tile 0": ("--tile 0", 2, "--tile"),
    "sheet as EXR": ("--contact-sheet a.exr", 2, "--contact-sheet a.exr: must be a .png"),
    "sheet nowhere": ("--contact-sheet no/a.png", 4, "the folder 'no' does not exist"),
    "log nowhere": ("--log no/a.txt", 4, "no/a.txt: the log cannot be written"),
    "a bad setting": ("--set density.scale=-1", 2, "--set density.scale=-1: must be"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_told_in_a_line_and_nothing_is_begun(folder, wrong):
    arguments, code, message = WRONG[wrong]
    ran = volcli("batch", "b.toml", *arguments.split())
    assert ran.code == code
    assert message in ran.err
    assert len(ran.err.splitlines()) == 1
    assert not (folder / "out").exists()


def test_a_contact_sheet_shows_every_picture_and_a_cross_for_what_failed(folder):
    (folder / "out" / "0.2.png").mkdir(parents=True)
    ran = volcli("batch", "b.toml", "--contact-sheet", "sheet.png", "--retries", 0)
    assert ran.code == 6
    sheet = read_background(folder / "sheet.png")
    assert sheet.shape == (2 * 202, 2 * 240, 4)
    cells = [sheet[:180, :240], sheet[:180, 240:], sheet[202:382, :240], sheet[202:382, 240:]]
    red = [bool((cell[..., 0] > 5 * cell[..., 1] + 0.1).any()) for cell in cells]
    assert red == [False, True, False, False]
    middle = [float(cell[90, 120, 1]) for cell in cells]
    assert middle[2] > middle[0] > 0.05, "the denser ball is the brighter"
    assert cells[3].max() - cells[3][..., :3].min() > 0.9, "nothing but paper"
    assert np.ptp(cells[3][..., :3]) < 1e-6
    names = [sheet[184:200, :240], sheet[184:200, 240:]]
    assert all(np.ptp(name[..., 0]) > 0.3 for name in names), "there is a name below each"


def test_the_bar_counts_jobs_and_is_gone_at_the_end(folder):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    with contextlib.redirect_stderr(screen):
        tally = Tally(total=2, tasks=2)
        with Output(tally, quiet=False, as_json=False, log=None) as output:
            output.begin(tally)
            output.advance(1)
            output.note("a note")
            output.advance(1)
    shown = screen.getvalue()
    assert "1/2" in shown and "jobs/s" in shown.replace(" ", "")
    assert "a note" in shown
    assert shown.split("\r")[-1].strip() == ""


@pytest.mark.parametrize("path", BATCHES, ids=lambda path: path.stem)
def test_each_batch_of_the_configs_runs(path, tmp_path):
    """In small, and with its outputs elsewhere."""
    text = path.read_text(encoding="utf-8")
    text = text.replace("../../out", str(tmp_path)).replace("../../samples", str(SAMPLES))
    ran = volcli(
        "batch",
        write_batch(tmp_path, text),
        *("--set", "camera.resolution=[24,18]", "--set", "camera.samples=1"),
    )
    assert ran.code == 0, ran.err
    assert len(list(tmp_path.rglob("*.png")) + list(tmp_path.rglob("*.exr"))) > 3


# -- volcli render --frames -----------------------------------------------------------------------


@pytest.fixture
def frames(folder):
    for frame in range(1, 5):
        write_ball(folder / f"s.{frame:04d}.npz", peak=frame)
    return folder


def test_frames_are_rendered_one_by_one(frames):
    ran = volcli(
        "render", "s.####.npz", "-o", "a.{frame}.exr", "--frames", "1-4x2", "--size", "16x12"
    )
    assert ran.code == 0, ran.err
    assert sorted(p.name for p in frames.glob("*.exr")) == ["a.1.exr", "a.3.exr"]
    assert "a.1.exr  picture 16x12" in ran.out
    assert "--eye and --target keep it still" in ran.err
    thin, thick = (read_exr(frames / f"a.{n}.exr")[0]["A"].max() for n in (1, 3))
    assert thin < thick


def test_a_frame_that_fails_does_not_stop_the_others(frames):
    (frames / "s.0002.npz").write_bytes(b"PK broken")
    arguments = ("render", "s.$F4.npz", "-o", "%04d.png", "--size", "16x12", "--frames")
    ran = volcli(*arguments, "1-3,9")
    assert ran.code == 6
    assert "frame 2: s.0002.npz" in ran.err and "frame 9: s.0009.npz: no such file" in ran.err
    assert ran.err.splitlines()[-1] == "volcli: 2 of 4 frames failed: 2, 9"
    assert sorted(p.name for p in frames.glob("*.png")) == ["0001.png", "0003.png"]
    assert volcli(*arguments, "2").code == 3, "of one frame it is that frame's own"
    assert volcli(*arguments, "3-1").code == 2
    same = volcli("render", "s.$F4.npz", "-o", "one.png", "--frames", "1-3")
    assert same.code == 2 and "two jobs write it" in same.err
