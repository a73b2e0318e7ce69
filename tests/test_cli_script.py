"""The installed script, which ends its process itself: all is printed and the code is right."""

import subprocess
import sys

from commandline import SAMPLES

import volcli

SCRIPT = "from volcli.cli import main; main()"


def script(*arguments, before=""):
    command = [sys.executable, "-c", before + SCRIPT, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_what_is_printed_is_there_when_the_process_has_ended():
    done = script("--version")
    assert (done.returncode, done.stdout) == (0, f"volcli {volcli.__version__}\n")
    assert "--density-scale" in script("render", "--help").stdout


def test_the_code_of_an_error_is_that_of_the_process():
    done = script("info", "gone.vdb")
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.endswith("gone.vdb: no such file\n")


def test_a_reader_that_has_gone_is_no_error():
    command = f"'{sys.executable}' -c '{SCRIPT}' info '{SAMPLES / 'cloud.vdb'}' | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_damaged_volume_does_not_wait_for_kernels(tmp_path):
    """They go on being made ready for longer than this test waits for the process."""
    damaged = tmp_path / "damaged.vdb"
    damaged.write_bytes((SAMPLES / "rotated.vdb").read_bytes()[:-2000])
    endless = "import time, volcli.run; volcli.run._use_kernels = lambda _: time.sleep(600);"
    done = script("render", damaged, "-o", tmp_path / "a.exr", before=endless)
    assert done.returncode == 3
    assert "damaged.vdb" in done.stderr
