"""The command line: one file a command; each parses, calls one function and prints.

This is the only place that prints and exits. Results go to stdout; progress, notes and errors to
stderr. Here is the entry point alone, so that even an interrupt while modules load ends in order,
and what makes the process start and end sooner, before anything else is imported.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from types import FrameType

_received: list[int] = []
"""Signals that are to end this process, in the order in which they came."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit; the installed script calls it without arguments."""
    is_script = arguments is None
    try:
        if is_script:
            _end_in_order()
            _print_anywhere()
            _start_sooner()
        from volcli.cli.app import run_app

        code = run_app(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        number = _received[0] if _received else signal.SIGINT
        how = "interrupted" if number == signal.SIGINT else "terminated"
        print(f"volcli: {how}", file=sys.stderr)
        code = 128 + number
    if is_script:
        _end_sooner(code)
    sys.exit(code)


def _end_in_order() -> None:
    """Have SIGTERM and SIGHUP end the process as Ctrl-C does: nothing half-written, workers ended.

    One that is ignored stays ignored, as ``nohup`` wants it.
    """

    def end(number: int, _: FrameType | None) -> None:
        _received.append(number)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)


def _print_anywhere() -> None:
    """Have nothing fail that is printed: where a stream is closed or cannot hold a letter."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123 - for as long as the process
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115, PTH123
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _start_sooner() -> None:
    """Settings of the process that save a tenth of the time of a small picture."""
    # Libraries make some 400,000 objects as they load, all to stay. With Python's own threshold of
    # 700 new ones they are searched for garbage again and again: 80 ms of 900.
    gc.set_threshold(100_000)
    # NumPy's linear algebra starts a thread for each processor (60 ms of their time, and it waits
    # in a loop for work) for matrices that here are 4 x 4. `--threads` is to bind all there are.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _end_sooner(code: int) -> None:
    """End the process at once, rather than take 400,000 objects apart first: 100 ms of 900.

    Nor does the process then wait for a compilation that goes on in a thread after an error.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends already
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # whoever read it has gone; the code says how the work ended
            stream.flush()
    os._exit(code)
