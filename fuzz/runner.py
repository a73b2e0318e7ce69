"""Gives cases to processes and watches them: who crashes, hangs, takes too much memory, or fails in
another way than with an error of volcli's has found something.
"""

from __future__ import annotations

import json
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from fuzz.child import MEMORY
from fuzz.mutate import ROOT

SECONDS = 10.0
READY_SECONDS = 240.0
"""A process may have kernels to compile before its first case."""
CASES_PER_PROCESS = 1000
"""So that what one leaves behind in memory is not laid at another's door for long."""


@dataclass(frozen=True)
class Finding:
    """A case that did what none may do."""

    number: int
    what: str


@dataclass
class Tally:
    """What became of the cases."""

    cases: int = 0
    codes: dict[int, int] = field(default_factory=dict)
    peak_bytes: int = 0
    findings: list[Finding] = field(default_factory=list)


def fuzz(
    numbers: Iterable[int],
    *,
    kinds: str = "",
    plant: str | None = None,
    workers: int = 1,
    seconds: float = SECONDS,
    enough: int | None = None,
    progress: Callable[[Tally], None] = lambda tally: None,
) -> Tally:
    """Run cases.

    Parameters
    ----------
    kinds
        Of files, separated by commas; none: all.
    plant
        A check to take out of the reader (`child.plant`).
    seconds
        For one case.
    enough
        So many findings end it.
    """
    tally, lock = Tally(), threading.Lock()
    todo: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in numbers:
        todo.put(number)

    def settle(number: int, told: dict[str, object] | str) -> bool:
        """Count a case; whether to go on."""
        with lock:
            tally.cases += 1
            if isinstance(told, str):
                tally.findings.append(Finding(number, told))
            else:
                code, peak = int(str(told["code"])), int(str(told["peak"]))
                tally.codes[code] = tally.codes.get(code, 0) + 1
                tally.peak_bytes = max(tally.peak_bytes, peak)
                if told["found"]:
                    what = f"{told['command']} of {told['seed']}: {told['found']}"
                    tally.findings.append(Finding(number, what))
                elif peak > MEMORY:
                    tally.findings.append(Finding(number, f"held {peak} bytes"))
            progress(tally)
            return enough is None or len(tally.findings) < enough

    threads = [
        threading.Thread(target=_work, args=(todo, kinds, plant, seconds, settle))
        for _ in range(workers)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return tally


def _work(
    todo: queue.SimpleQueue[int],
    kinds: str,
    plant: str | None,
    seconds: float,
    settle: Callable[[int, dict[str, object] | str], bool],
) -> None:
    """Processes, one after another, until nothing is left to do."""
    going = True
    while going and not todo.empty():
        with tempfile.TemporaryDirectory(prefix="volcli-fuzz-") as folder:
            going = _one_process(todo, Path(folder), kinds, plant, seconds, settle)


def _one_process(
    todo: queue.SimpleQueue[int],
    folder: Path,
    kinds: str,
    plant: str | None,
    seconds: float,
    settle: Callable[[int, dict[str, object] | str], bool],
) -> bool:
    command = [sys.executable, "-m", "fuzz.child", str(folder), "--kinds", kinds]
    command += ["--plant", plant] if plant else []
    child = subprocess.Popen(
        command,
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert child.stdin is not None and child.stdout is not None
    answers: queue.SimpleQueue[str] = queue.SimpleQueue()
    lines = child.stdout
    reader = threading.Thread(target=_forward, args=(lines, answers), daemon=True)
    reader.start()
    try:
        if answers.get(timeout=READY_SECONDS) != "ready\n":
            raise RuntimeError("a sound file is not rendered: mend that first")
        for _ in range(CASES_PER_PROCESS):
            try:
                number = todo.get_nowait()
            except queue.Empty:
                return False
            answer = None
            try:
                child.stdin.write(f"{number}\n")
                child.stdin.flush()
                answer = answers.get(timeout=seconds)
            except OSError:
                answer = ""
            except queue.Empty:
                settle(number, f"no answer in {seconds:g} s")
                return True
            if not answer:
                code = child.wait()
                how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
                return settle(number, f"the process ended: {how}")
            if not settle(number, json.loads(answer)):
                return False
        return True
    finally:
        child.kill()
        child.wait()
        child.stdin.close()
        reader.join()


def _forward(lines: Iterable[str], answers: queue.SimpleQueue[str]) -> None:
    for line in lines:
        answers.put(line)
    answers.put("")
