"""OpenImageIO's way of opening and of failing: its messages, which it keeps where others raise, as
exceptions and as one line.

What is read or written with it is not decided here.
"""

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.memory import MemoryLimit, reserve

if TYPE_CHECKING:
    import OpenImageIO as oiio


class Failed(Exception):
    """What OpenImageIO reported instead of raising."""


def open_image(path: Path) -> "oiio.ImageInput":
    """An image file, opened, with alpha as it is stored; raises `Failed`."""
    import OpenImageIO as oiio

    # Alpha as the file has it: OpenImageIO would premultiply the encoded values in 8 bits.
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(name_of(path), config)
    if source is None:
        raise Failed(error_of(oiio) or "no reason given")
    try:
        "".join(source.spec().channelnames).encode()  # what is no text comes as half of a letter
    except UnicodeError as error:
        source.close()
        raise Failed("the names of its channels are no text") from error
    return source


def name_of(path: Path) -> str:
    """A path as OpenImageIO takes it, UTF-8 whatever the locale is; raises `Failed`."""
    try:
        return os.fsencode(path).decode()
    except UnicodeDecodeError as error:
        raise Failed("its name is not UTF-8, as OpenImageIO needs it") from error


def check_room(path: Path, spec: "oiio.ImageSpec") -> None:
    """Refuse an image whose pixels do not fit into memory: its header can say anything.

    Raises
    ------
    UsageError
        It says how much is needed.
    """
    try:
        reserve(4 * spec.width * spec.height * spec.nchannels, "its pixels")
    except MemoryLimit as error:
        raise UsageError(f"{path}: {spec.width}x{spec.height} image: {error}") from error


def attributes_of(spec: "oiio.ImageSpec") -> dict[str, str | int | float]:
    """Text and numbers of a header, without what is said to be text and is none."""
    found: dict[str, str | int | float] = {}
    for attribute in spec.extra_attribs:
        with suppress(UnicodeDecodeError):
            if isinstance(attribute.value, str | int | float):
                found[attribute.name] = attribute.value
    return found


def error_of(failed: Any) -> str:
    """The first line of what OpenImageIO, or a part of it, reports; empty where it reports nothing.

    It may quote a damaged file, and then is no text.
    """
    try:
        text = failed.geterror()
    except UnicodeDecodeError as error:
        text = error.object.decode("utf-8", "replace")
    return one_line(text) if text else ""


def pixels_of(path: Path, buffer: "oiio.ImageBuf") -> NDArray[np.float32]:
    """The (h, w, c) float32 result of one of OpenImageIO's operations on the image at `path`."""
    import OpenImageIO as oiio

    pixels = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise UsageError(f"{path}: cannot be converted ({error_of(buffer)})")
    return pixels


def one_line(text: str) -> str:
    """The first line of one of OpenImageIO's messages."""
    return text.strip().split("\n")[0].strip() or "no reason given"


def reason_of(error: Exception) -> str:
    """What went wrong, in words, without the path that Python adds."""
    return getattr(error, "strerror", None) or str(error)
