"""Progress on stderr: a tqdm bar for each stage of a job; silent where nobody watches."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

_UNITS = {
    "reading": "leaves",
    "calibrating": "steps",
    "rendering": "tiles",
    "writing": "files",
    "truth": "rows",
    "measuring": "pictures",
}
_COMPILING = "compiling"
_WAIT_SECONDS = 0.2
"""A stage that is over sooner shows no bar."""


class Bars:
    """Called as ``bars(stage, done, total)``; a bar opens with its stage and closes at its end."""

    def __init__(self, quiet: bool) -> None:
        self._silent = quiet or not sys.stderr.isatty()
        self._stage: str | None = None
        self._bar: Any = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        if self._silent:
            return
        if stage != self._stage:
            self.close()
            self._stage = stage
            self._bar = _open(stage, total)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        """Take the bar that is open off the screen."""
        if self._bar is not None:
            self._bar.close()
        self._bar, self._stage = None, None

    def __enter__(self) -> Bars:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _open(stage: str, total: int) -> Any:
    from tqdm import tqdm

    if stage == _COMPILING:  # one step that cannot be counted: say it before it starts
        text = "compiling kernels (first run of this kind on this machine) ..."
        return tqdm(desc=text, total=total, leave=False, bar_format="{desc}", file=sys.stderr)
    unit = _UNITS[stage.partition(" ")[0]]
    return tqdm(
        desc=stage, unit=f" {unit}", total=total, leave=False, delay=_WAIT_SECONDS, file=sys.stderr
    )
