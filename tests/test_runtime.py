"""The process and what is around it: signals, streams, homes, folders, letters, processors."""

import json
import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time

import numba
import numpy as np
import pytest
from commandline import SAMPLES, write_ball

from volcli.images import read_exr, write_exr
from volcli.kernels import compiler

SCRIPT = "from volcli.cli import main; main()"
KILLS = int(os.environ.get("VOLCLI_KILLS", "8"))
"""How often a render is killed; a hundred take two minutes."""

SMALL = ("--size", "16x12", "--quiet")


def start(*arguments, **options):
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [sys.executable, "-c", SCRIPT, *map(str, arguments)]
    return subprocess.Popen(command, **{**streams, "text": True, **options})


def ended(process):
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def environment(**changes):
    """This process' environment with changes; None: not set."""
    found = {**os.environ, **{name: value for name, value in changes.items() if value is not None}}
    return {name: value for name, value in found.items() if changes.get(name, "") is not None}


# -- signals --------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("seconds", [0.35, 0.8, 1.6])
def test_a_signal_ends_a_render_in_order_at_any_moment(tmp_path, number, seconds):
    out = tmp_path / "a.exr"
    out.write_text("old")
    render = start("render", SAMPLES / "cloud.vdb", "-o", out, "--size", "1400x1400", "--quiet")
    time.sleep(seconds)
    render.send_signal(number)
    code, _, err = ended(render)
    if code == -number:  # Python itself had not started yet
        assert out.read_text() == "old"
        return
    assert code in (128 + number, 0), err
    assert "Traceback" not in err
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
    if code:
        assert err.endswith("interrupted\n" if number == signal.SIGINT else "terminated\n")
        assert out.read_bytes() == b"old"
    else:
        read_exr(out)


@pytest.mark.parametrize(
    ("number", "command"),
    [
        (signal.SIGINT, "inspect {picture} --html {out}.html --heatmap {out}.png"),
        (signal.SIGTERM, "compare {picture} {picture} --difference {out}.exr"),
        (signal.SIGINT, "probe {cloud} --pixel 8,6 --csv {out}.csv --plot {out}.svg"),
        (signal.SIGTERM, "info {cloud} --stats"),
        (signal.SIGTERM, "render {cloud} -o {out}.exr --size 64x48 --cache {out}"),
    ],
    ids=lambda value: str(value).split()[0],
)
def test_a_signal_ends_the_other_commands_in_order_too(tmp_path, number, command):
    picture, folder = tmp_path / "in.exr", tmp_path / "out"
    write_exr(picture, dict.fromkeys("RGBA", np.full((48, 64), 0.5, np.float32)), {})
    folder.mkdir()
    places = {"picture": picture, "cloud": SAMPLES / "cloud.vdb", "out": folder / "a"}
    running = start(*command.format(**places).split())
    time.sleep(random.Random(command).uniform(0.4, 1.2))
    running.send_signal(number)
    code, _, err = ended(running)
    assert code in (0, 128 + number), err
    assert "Traceback" not in err
    assert [p for p in folder.rglob("*") if p.name.startswith(".")] == []


@pytest.mark.needs_jit
def test_killed_at_random_moments_an_image_is_the_old_one_or_the_new_and_nothing_is_left(tmp_path):
    out = tmp_path / "a.exr"
    arguments = ("render", write_ball(tmp_path / "ball.npz"), "-o", out, "--size", "300x300")
    moments = random.Random(4)
    assert ended(start(*arguments, "--quiet"))[0] == 0  # compiles
    begin = time.perf_counter()
    assert ended(start(*arguments, "--quiet"))[0] == 0
    whole = time.perf_counter() - begin
    killed = 0
    for scale in range(1, KILLS + 1):
        render = start(*arguments, "--quiet", "--density-scale", scale)
        # Most of them late, where files are written.
        time.sleep(whole * (1 - 0.5 * moments.random() ** 2))
        render.kill()
        killed += render.wait() == -signal.SIGKILL
        render.communicate()
        channels, _ = read_exr(out)
        assert channels["A"].shape == (300, 300)
    assert killed, "each was faster than it was meant to live"
    assert ended(start(*arguments, "--quiet"))[0] == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "ball.npz"]


def test_a_file_that_a_killed_writer_left_is_removed_by_the_next_and_one_in_use_is_not(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path; from volcli import leftovers\n"
        "leftovers.temporary_name(Path(sys.argv[1])).touch()\n"
        "if sys.argv[2:]: print('ready', flush=True); sys.stdin.read()\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    out = tmp_path / "a.exr"
    subprocess.run([sys.executable, "-c", code, str(out)], timeout=60)
    alive = subprocess.Popen(
        [sys.executable, "-c", code, str(out), "wait"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert alive.stdout.readline() == b"ready\n"
        (left,) = tmp_path.iterdir()
        assert f"-{alive.pid}-" in left.name, "the file of the one that is dead is gone"
        assert ended(start("render", SAMPLES / "rotated.vdb", "-o", out, *SMALL))[0] == 0
        assert left.exists()
    finally:
        alive.kill()
        alive.communicate()
    out.unlink()
    assert ended(start("render", SAMPLES / "rotated.vdb", "-o", out, *SMALL))[0] == 0
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


# -- streams and terminals ------------------------------------------------------------------------


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_streams_that_are_closed_are_no_error(tmp_path, closed):
    out = tmp_path / "a.exr"
    arguments = f"render '{SAMPLES / 'rotated.vdb'}' -o '{out}' --size 16x12"
    command = f"'{sys.executable}' -c '{SCRIPT}' {arguments} {closed}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    read_exr(out)


@pytest.mark.parametrize("arguments", ["info --stats --json", "probe --pixel 8,6 --json", "--help"])
def test_a_reader_that_goes_away_is_no_error(arguments):
    """As `| head -c 1` does."""
    command, *options = arguments.split()
    source = [] if command == "--help" else [SAMPLES / "rotated.vdb"]
    running = start(command, *source, *options)
    running.stdout.close()
    err = running.stderr.read()
    assert running.wait(timeout=120) == 0, err
    assert "Traceback" not in err
    assert "Broken" not in err


@pytest.mark.parametrize("arguments", ["info --stats", "render --explain", "probe --pixel 8,6"])
def test_results_that_a_full_disk_does_not_take_are_an_error_of_the_output(arguments):
    if not os.path.exists("/dev/full"):  # noqa: PTH110
        pytest.skip("there is no /dev/full here")
    command, *options = arguments.split()
    with open("/dev/full", "w") as full:  # noqa: PTH123
        code, _, err = ended(start(command, SAMPLES / "rotated.vdb", *options, stdout=full))
    assert code == 4, err
    assert "stdout: cannot be written (No space left on device)" in err
    assert "Traceback" not in err


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_letters_that_the_locale_does_not_have_are_written_in_another_way(tmp_path, encoding):
    file = write_ball(tmp_path / "nuée-雲.npz")
    where = environment(PYTHONIOENCODING=encoding, LC_ALL="C", PYTHONUTF8="0")
    out = tmp_path / "bild-雲.exr"
    code, said, err = ended(start("render", file, "-o", out, "--size", "16x12", env=where))
    assert code == 0, err
    assert "bild-" in said
    assert [p.name for p in tmp_path.glob("*.exr")] == ["bild-雲.exr"]
    assert "nuée-雲.npz" in read_exr(out)[1]["volcli:job"]
    code, _, err = ended(start("info", file, "--stats", env=where))
    assert code == 0, err


@pytest.mark.parametrize("columns", ["1", "40", "100000"])
def test_a_terminal_of_any_width_will_do(columns):
    where = environment(COLUMNS=columns)
    for arguments in (["info", "--stats"], ["render", "--explain"], ["probe", "--pixel", "8,6"]):
        command, *options = arguments
        code, said, err = ended(start(command, SAMPLES / "rotated.vdb", *options, env=where))
        assert code == 0, err
        assert said


# -- homes and caches -----------------------------------------------------------------------------


def render_json(out, **changes):
    code, said, err = ended(
        start(
            "render", SAMPLES / "rotated.vdb", "-o", out, *SMALL, "--json",
            env=environment(**changes),
        )
    )  # fmt: skip
    assert code == 0, err
    return json.loads(said), err


@pytest.mark.needs_jit
def test_kernels_are_kept_elsewhere_with_one_warning_where_their_folder_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "tmp").mkdir()
    places = {"NUMBA_CACHE_DIR": str(tmp_path / "file"), "TMPDIR": str(tmp_path / "tmp")}
    report, err = render_json(tmp_path / "a.exr", **places)
    (warning,) = report["warnings"]
    assert "cannot be written; kernels are kept in" in warning
    assert err.count("cannot be written") == 1
    (folder,) = (tmp_path / "tmp").iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert list(folder.rglob("*.nbc"))


@pytest.mark.needs_jit
def test_kernels_are_not_taken_from_a_folder_that_others_can_write_to(tmp_path):
    """They would be run."""
    (tmp_path / "file").write_text("in the way")
    theirs = tmp_path / "tmp" / f"volcli-kernels-{os.geteuid()}"
    theirs.mkdir(parents=True)
    theirs.chmod(0o777)
    places = {"NUMBA_CACHE_DIR": str(tmp_path / "file"), "TMPDIR": str(tmp_path / "tmp")}
    report, _ = render_json(tmp_path / "a.exr", **places)
    assert "kernels are compiled for each run" in report["warnings"][0]
    assert list(theirs.iterdir()) == []


@pytest.mark.needs_jit
def test_where_all_but_the_outputs_folder_is_read_only_there_is_one_warning(tmp_path):
    """Site-packages, home and caches on a disk that is read-only."""
    out = tmp_path / "out" / "a.exr"
    kernels = tmp_path / "out" / f"volcli-kernels-{os.geteuid()}"
    kernels.mkdir(mode=0o700, parents=True)
    known = compiler._cache_folder()
    shutil.copytree(known, kernels / known.name)  # or they would be compiled once more
    script = "from volcli.cli import main; main()"
    command = [sys.executable, "-c", script, "render", str(SAMPLES / "rotated.vdb"), "-o", str(out)]
    inside = (
        f"mount --bind {shlex.quote(str(out.parent))} {shlex.quote(str(out.parent))} && "
        "mount -o remount,bind,ro / && exec " + shlex.join([*command, *SMALL, "--json"])
    )
    where = environment(NUMBA_CACHE_DIR=None, XDG_CACHE_HOME=None, HOME="/", TMPDIR=str(out.parent))
    try:
        done = subprocess.run(
            ["unshare", "-m", "sh", "-c", inside], capture_output=True, text=True, env=where
        )
    except FileNotFoundError:
        pytest.skip("there is no unshare here")
    if "unshare" in done.stderr or "mount:" in done.stderr:
        pytest.skip("only the superuser can make a disk read-only")
    assert done.returncode == 0, done.stderr
    (warning,) = json.loads(done.stdout)["warnings"]
    assert "cannot be written; kernels are kept in" in warning
    assert done.stderr.count("\n") == 1
    read_exr(out)


def test_without_a_home_a_picture_is_rendered(tmp_path):
    report, err = render_json(tmp_path / "a.exr", HOME=None, XDG_CACHE_HOME=None)
    assert report["image"] == str(tmp_path / "a.exr")
    assert "Traceback" not in err


# -- processors and memory ------------------------------------------------------------------------


def take_one_processor():
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def test_one_processor_and_more_threads_than_processors_give_the_same_picture(tmp_path):
    pictures = []
    for threads in (1, 64):
        out = tmp_path / f"{threads}.exr"
        command = ["render", SAMPLES / "rotated.vdb", "-o", out, *SMALL, "--threads", threads]
        assert ended(start(*command, preexec_fn=take_one_processor))[0] == 0
        pictures.append(read_exr(out)[0])
    for name, values in pictures[0].items():
        assert values.tobytes() == pictures[1][name].tobytes()


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="kernels are not compiled")
def test_an_address_space_that_is_too_small_is_told_and_never_a_crash(tmp_path):
    def little():
        resource.setrlimit(resource.RLIMIT_DATA, (700_000_000,) * 2)

    out = tmp_path / "a.exr"
    command = ["render", SAMPLES / "rotated.vdb", "-o", out, "--size", "6000x6000", "--quiet"]
    code, _, err = ended(start(*command, preexec_fn=little))
    assert code == 2, err
    assert "a picture of 6000x6000 takes about 3.0 GB of memory" in err
    assert "--size" in err
    assert not out.exists()
