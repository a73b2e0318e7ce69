"""Progress on stderr: a tqdm bar for each stage of a job; silent where nobody watches."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

_LABELS = {
    "reading": ("reading", "leaves"),
    "compiling": ("compiling kernels (first run)", "kernels"),
    "rendering": ("rendering", "tiles"),
    "writing": ("writing", "files"),
}


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
            from tqdm import tqdm

            self.close()
            label, unit = _LABELS[stage]
            self._stage = stage
            self._bar = tqdm(
                desc=label, unit=f" {unit}", total=total, leave=False, delay=0.2, file=sys.stderr
            )
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
