"""Any image as named channels, with what its file says of how they are stored: what is looked at.

Values are as they are stored (integers scaled to [0, 1], PNG still sRGB-encoded). What they mean is
for the caller; colour of any image, made linear and premultiplied, is for `background`.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.images.library import Failed, attributes_of, check_room, error_of, open_image, reason_of
from volcli.images.read import check_is_file
from volcli.images.store import Attribute

if TYPE_CHECKING:
    import OpenImageIO as oiio

_BITS = {"uint8": 8, "uint16": 16, "uint32": 32}

_BAND = 64
"""Rows read at a time: few enough that taking the channels apart stays in the cache."""

_READERS = 2
"""Threads, each with the file open for itself; each uses OpenImageIO's own threads as well."""


@dataclass(frozen=True)
class Channels:
    """An image file as it is stored.

    Attributes
    ----------
    path, file_format
        The file, and OpenImageIO's name of its format: ``openexr``, ``png``, ...
    planes
        Name -> (h, w) float32, in the file's order: integers scaled to [0, 1].
    sample
        The type of a stored value: ``uint8``, ``uint16``, ``half``, ``float``, ...
    associated
        Whether colour is multiplied by alpha, by the conventions of the format and its header.
    attributes
        The header's strings, ints and floats.
    """

    path: Path
    file_format: str
    planes: dict[str, NDArray[np.float32]]
    sample: str
    associated: bool
    attributes: dict[str, Attribute]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        height, width = next(iter(self.planes.values())).shape
        return width, height

    @property
    def bits(self) -> int | None:
        """Bits of an integer sample; None for floats."""
        return _BITS.get(self.sample)

    def find(self, *names: str) -> NDArray[np.float32] | None:
        """The first of these channels that there is, whatever the case of its name."""
        known = {name.lower(): plane for name, plane in self.planes.items()}
        return next((known[n.lower()] for n in names if n.lower() in known), None)


def read_channels(path: str | os.PathLike[str]) -> Channels:
    """Read all channels of an image (the first part of a multi-part file).

    Raises
    ------
    UsageError
        The file is missing, is no image, is deep or is damaged.
    """
    path = Path(path)
    check_is_file(path)
    try:
        source = open_image(path)
    except (OSError, ValueError, Failed) as error:
        raise UsageError(f"{path}: not a readable image ({reason_of(error)})") from error
    try:
        spec, file_format = source.spec(), source.format_name()
    finally:
        source.close()
    if spec.deep:
        raise UsageError(f"{path}: is a deep image; flatten it first")
    check_room(path, spec)
    planes = [np.empty((spec.height, spec.width), np.float32) for _ in range(spec.nchannels)]
    # Only the lines of an EXR can be had in any order.
    readers = _READERS if file_format == "openexr" and not spec.tile_width else 1
    starts = [spec.height * i // readers for i in range(readers + 1)]
    with ThreadPoolExecutor(readers) as pool:
        parts = [pool.submit(_read_rows, path, planes, *rows) for rows in pairwise(starts)]
        for part in parts:
            part.result()
    return Channels(
        path=path,
        file_format=file_format,
        planes=dict(zip(spec.channelnames, planes, strict=True)),
        sample=str(spec.format),
        associated=not spec.get_int_attribute("oiio:UnassociatedAlpha", 0),
        attributes=attributes_of(spec),
    )


def _read_rows(path: Path, planes: list[NDArray[np.float32]], begin: int, end: int) -> None:
    """Fill rows ``begin`` to ``end`` of the planes."""
    import OpenImageIO as oiio

    source = open_image(path)
    try:
        spec = source.spec()
        if spec.tile_width:
            pixels = source.read_image(0, 0, 0, len(planes), oiio.FLOAT)
            _take_apart(path, source, pixels, planes, 0, spec.height)
            return
        for y in range(begin, end, _BAND):
            last = min(y + _BAND, end)
            pixels = source.read_scanlines(
                0, 0, spec.y + y, spec.y + last, 0, 0, len(planes), oiio.FLOAT
            )
            _take_apart(path, source, pixels, planes, y, last)
    finally:
        source.close()


def _take_apart(
    path: Path,
    source: oiio.ImageInput,
    pixels: NDArray[np.float32] | None,
    planes: list[NDArray[np.float32]],
    begin: int,
    end: int,
) -> None:
    message = error_of(source)
    if pixels is None or message:
        raise UsageError(f"{path}: damaged image ({message or 'no reason given'})")
    rows = pixels.reshape(end - begin, -1, len(planes))
    for i, plane in enumerate(planes):
        plane[begin:end] = rows[..., i]
