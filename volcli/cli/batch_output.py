"""What `volcli batch` shows: a bar, a line for each job, a summary, a log, a contact sheet."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any

from volcli.cli.table import in_bytes, say, say_json, table, terminal_width
from volcli.errors import OutputError

if TYPE_CHECKING:
    from volcli.batch.expand import Item
    from volcli.batch.runner import Told
    from volcli.batch.session import Tally


class Output:
    """Shows a batch as it runs; ``tell``, ``advance`` and ``begin`` are for `session.run_batch`.

    Raises
    ------
    OutputError
        If the log cannot be written.
    """

    def __init__(self, tally: Tally, *, quiet: bool, as_json: bool, log: Path | None) -> None:
        self._tally, self._quiet, self._json = tally, quiet, as_json
        self._bar: Any = None
        self._traced = False
        self._begun = time.monotonic()
        self._log: IO[str] | None = None
        self._log_failed: OutputError | None = None
        if log is not None:
            try:
                self._log = log.open("a", encoding="utf-8", buffering=1)
            except OSError as error:
                raise _not_logged(log, error) from error

    def __enter__(self) -> Output:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close_bar()
        if error is not None:
            self._record(f"ended by {type(error).__name__}: {error}")
        if self._log is not None:
            self._log.close()
        if error is None and self._log_failed is not None:
            raise self._log_failed

    def note(self, text: str) -> None:
        """Say what the user should know, on stderr."""
        self._record(text)
        if not self._quiet:
            with self._beside_bar():
                warn(text)

    def begin(self, tally: Tally) -> None:
        """Open the bar; its tasks are jobs, or tiles of them."""
        kept = f", {len(tally.kept)} are done already" if tally.kept else ""
        self._record(f"{tally.total} jobs{kept}")
        if tally.kept and not self._quiet:
            warn(f"{tally.total} jobs{kept}")
        if self._quiet or not sys.stderr.isatty() or not tally.tasks:
            return
        from tqdm import tqdm

        jobs = tally.total - len(tally.kept)
        unit = " jobs" if tally.tasks == jobs else " tiles"
        self._bar = tqdm(total=tally.tasks, unit=unit, smoothing=0.1, file=sys.stderr, leave=False)

    def advance(self, count: int) -> None:
        """Move the bar."""
        if self._bar is not None:
            self._bar.update(count)

    def tell(self, told: Told) -> None:
        """One line for a job that is done or has failed; a note for one that is tried again."""
        name = shown(told.work.item.output)
        if told.event == "retry":
            self.note(f"{name}: {told.error}; trying again")
            return
        self._record(f"{name}: {told.event}{': ' if told.error else ''}{told.error}")
        if told.trace:
            self._record(told.trace)
        for warning in told.report.warnings if told.report is not None else ():
            self.note(warning)
        with self._beside_bar():
            if self._json:
                say_json(_as_json(told))
            elif self._quiet:
                pass  # the summary says what failed
            elif told.report is None:
                say(f"{name}  failed: {told.error}")
            else:
                seconds = told.report.seconds
                say(
                    f"{name}  {sum(seconds.values()):.2f} s (load {seconds['load']:.2f}, render "
                    f"{seconds['render']:.2f}, write {seconds['write']:.2f})"
                )
            if told.trace and self._log is None and not self._traced:
                print(told.trace, file=sys.stderr)  # one is enough to find a defect
                self._traced = True

    def summary(self, manifest: Path) -> None:
        """A table of what became of the jobs."""
        self._close_bar()
        tally, seconds = self._tally, time.monotonic() - self._begun
        if not tally.total:
            return
        left = tally.total - len(tally.kept) - len(tally.done) - len(tally.failed)
        peak = max((t.report.peak_memory_bytes for t in tally.done if t.report), default=0)
        numbers = {
            "jobs": tally.total,
            "done": len(tally.done),
            "kept": len(tally.kept),
            "failed": len(tally.failed),
            "left": left,
            "seconds": round(seconds, 2),
            "peak_memory_bytes": peak,
        }
        self._record(", ".join(f"{name} {value}" for name, value in numbers.items()))
        if self._json:
            say_json({"summary": {**numbers, "manifest": str(manifest)}})
            return
        rate = len(tally.done) / seconds if seconds > 0 else 0.0
        row = [str(numbers[name]) for name in ("jobs", "done", "kept", "failed", "left")]
        row += [f"{seconds:.1f} s", f"{rate:.2g}", in_bytes(peak) if peak else "-"]
        head = ("jobs", "done", "kept", "failed", "left", "time", "jobs/s", "peak memory")
        say("\n" + table(head, [row], terminal_width()))
        if tally.failed:
            rows = [(shown(told.work.item.output), told.error) for told in tally.failed]
            say("\n" + table(("failed", "reason"), rows))

    def contact_sheet(self, path: Path, items: Sequence[Item]) -> None:
        """All pictures on one."""
        from volcli.images.contact_sheet import Picture, write_contact_sheet

        good = {item.output for item in self._tally.kept}
        good |= {told.work.item.output for told in self._tally.done}
        pictures = [
            Picture(
                item.output.stem, item.output if item.output in good else None, item.job.camera.size
            )
            for item in items
        ]
        for warning in write_contact_sheet(path, pictures):
            self.note(warning)
        if not self._json:
            say(f"\n{path}  contact sheet of {len(pictures)} pictures")

    def _record(self, text: str) -> None:
        if self._log is None:
            return
        try:
            self._log.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")
        except OSError as error:  # the pictures are worth more: they go on, and it is an error then
            self._log_failed = _not_logged(Path(self._log.name), error)
            with suppress(OSError):  # what could not be written is still in its buffer
                self._log.close()
            self._log = None
            self.note(str(self._log_failed))

    def _beside_bar(self) -> Any:
        """Takes the bar off the screen while lines are printed."""
        from tqdm import tqdm

        return tqdm.external_write_mode(file=sys.stderr)

    def _close_bar(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _not_logged(log: Path, error: OSError) -> OutputError:
    return OutputError(f"{log}: the log cannot be written: {error.strerror or error}")


def warn(text: str) -> None:
    """Say a line on stderr."""
    print(f"volcli: {text}", file=sys.stderr)


def shown(path: Path) -> str:
    """A path as short as it can be from where the user stands."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative


def _as_json(told: Told) -> dict[str, Any]:
    row: dict[str, Any] = {"job": str(told.work.item.output), "state": told.event}
    if told.report is None:
        return {**row, "error": told.error}
    report = told.report
    if report.error_bound is not None:
        row["error_bound"] = report.error_bound
    if report.error_estimate is not None:
        row["error_estimate"] = report.error_estimate
    return {
        **row,
        "size": report.size,
        "seconds": report.seconds,
        "transmittance": report.transmittance,
        "peak_memory_bytes": report.peak_memory_bytes,
        "warnings": report.warnings,
    }
