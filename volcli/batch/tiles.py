"""A large picture in tiles, each rendered by itself, and put together again.

A pixel does not depend on the tile it is in, so that the whole is, bit for bit, the picture that
one process would have rendered.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from volcli.errors import VolcliError
from volcli.render import RenderResult, Window
from volcli.run import Rendered
from volcli.schema import Job


def windows(job: Job, edge: int) -> list[Window]:
    """The tiles of a job's picture, of so many pixels a side, but for the last in a row."""
    width, height = job.camera.size
    return [
        (x, y, min(edge, width - x), min(edge, height - y))
        for y in range(0, height, edge)
        for x in range(0, width, edge)
    ]


class Canvas:
    """The tiles of one picture as they come in."""

    def __init__(self, job: Job, edge: int) -> None:
        self._size = job.camera.size
        self._open = set(windows(job, edge))
        self._layers: dict[str, Any] = {}
        self._latest: Rendered | None = None
        self._sums: dict[str, float] = {}
        self._evaluations = 0

    @property
    def is_complete(self) -> bool:
        """Whether every tile is in."""
        return not self._open

    def put(self, window: Window, part: Rendered) -> None:
        """Put a tile in its place.

        Raises
        ------
        VolcliError
            It was rendered by another rule than the others. Each of them chooses for the whole
            picture, and machines of one kind choose the same.
        """
        if self._latest is not None and part.rule != self._latest.rule:
            raise VolcliError(
                f"tiles chose different rules, {self._latest.rule} and {part.rule}, as machines of "
                "different kinds may; give the picture a quadrature.step"
            )
        left, top, width, height = window
        for field in fields(RenderResult):
            values = getattr(part.result, field.name)
            if not isinstance(values, np.ndarray):
                continue
            if field.name not in self._layers:
                shape = (self._size[1], self._size[0], *values.shape[2:])
                self._layers[field.name] = np.empty(shape, values.dtype)
            self._layers[field.name][top : top + height, left : left + width] = values
        for name, seconds in part.seconds.items():
            self._sums[name] = self._sums.get(name, 0.0) + seconds
        self._evaluations += part.result.evaluations
        self._latest = part
        self._open.discard(window)

    def picture(self) -> Rendered:
        """The whole picture; its seconds are those of all tiles together."""
        assert self._latest is not None and self.is_complete
        result = replace(
            self._latest.result,
            **self._layers,
            evaluations=self._evaluations,
            compile_seconds=self._sums["compile"],
            render_seconds=self._sums["render"],
        )
        return replace(self._latest, result=result, seconds=self._sums)
