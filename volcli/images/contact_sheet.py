"""Many images on one, each with its name below it: a contact sheet.

Transparent parts show a checkerboard, and an image that is not there shows a cross.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.images.background import read_background
from volcli.images.library import pixels_of
from volcli.images.write import write_png

WIDTH, HEIGHT = 240, 180
"""Pixels that an image and its margin have, without its name."""

_MARGIN, _LINE, _LETTER = 8, 22, 14
_PAPER, _CHECKS, _CROSS, _INK = 0.008, (0.05, 0.09), (0.5, 0.02, 0.02), (0.6, 0.6, 0.6)
_CHECK = 8
_LETTERS_IN_A_LINE = 30


@dataclass(frozen=True)
class Picture:
    """An image of the sheet; ``file`` is None where there is none to show."""

    name: str
    file: Path | None
    size: tuple[int, int]


def write_contact_sheet(
    path: Path,
    pictures: Sequence[Picture],
    progress: Callable[[int], None] = lambda done: None,
) -> list[str]:
    """Write a PNG with all pictures, in rows that are read like text.

    Returns
    -------
    list of str
        A warning for each image that is there and cannot be read.

    Raises
    ------
    OutputError
        If the sheet cannot be written.
    """
    columns = max(1, min(len(pictures), math.ceil(math.sqrt(len(pictures) * 4 / 3))))
    rows = max(1, -(-len(pictures) // columns))
    cell = (HEIGHT + _LINE, WIDTH)
    sheet = np.full((rows * cell[0], columns * cell[1], 3), _PAPER, np.float32)
    warnings = []
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        top, left = row * cell[0], column * cell[1]
        try:
            thumbnail = _thumbnail(picture)
        except UsageError as error:
            warnings.append(str(error))
            thumbnail = _crossed(picture.size)
        height, width = thumbnail.shape[:2]
        y, x = top + (HEIGHT - height) // 2, left + (WIDTH - width) // 2
        sheet[y : y + height, x : x + width] = thumbnail
        progress(number + 1)
    sheet = _named(path, sheet, pictures, columns, cell)
    opaque = np.ones((*sheet.shape[:2], 1), np.float32)
    # Fires are brighter than a sheet can be; the pictures themselves keep what is clipped here.
    write_png(path, np.dstack([np.clip(sheet, 0, 1), opaque]), {"Software": "volcli"})
    return warnings


def _fitted(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of a thumbnail."""
    room = WIDTH - 2 * _MARGIN, HEIGHT - 2 * _MARGIN
    scale = min(room[0] / size[0], room[1] / size[1])
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _thumbnail(picture: Picture) -> NDArray[np.float32]:
    if picture.file is None:
        return _crossed(picture.size)
    width, height = _fitted(picture.size)
    rgba = read_background(picture.file, (width, height))
    y, x = np.indices((height, width)) // _CHECK
    checks = np.where((x + y) % 2 == 0, *_CHECKS)[..., None]
    return (rgba[..., :3] + (1 - rgba[..., 3:]) * checks).astype(np.float32)


def _crossed(size: tuple[int, int]) -> NDArray[np.float32]:
    width, height = _fitted(size)
    cross = np.full((height, width, 3), _PAPER, np.float32)
    y, x = np.indices((height, width))
    slope = height / width
    for line in (y - slope * x, y - (height - 1 - slope * x)):
        cross[np.abs(line) < 1.5] = _CROSS
    cross[[0, -1]] = cross[:, [0, -1]] = _CROSS
    return cross


def _named(
    path: Path,
    sheet: NDArray[np.float32],
    pictures: Sequence[Picture],
    columns: int,
    cell: tuple[int, int],
) -> NDArray[np.float32]:
    """The sheet with a name below each picture, cut in its middle where it is too long."""
    import OpenImageIO as oiio

    buffer = oiio.ImageBuf(np.ascontiguousarray(sheet))
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        name = picture.name
        if len(name) > _LETTERS_IN_A_LINE:
            half = _LETTERS_IN_A_LINE // 2
            name = f"{name[: half - 1]}...{name[-half + 2 :]}"
        oiio.ImageBufAlgo.render_text(
            buffer,
            column * cell[1] + cell[1] // 2,
            row * cell[0] + HEIGHT + _LETTER - _MARGIN // 2,
            name,
            _LETTER,
            "",
            _INK,
            "center",
            "baseline",
        )
    return pixels_of(path, buffer)
