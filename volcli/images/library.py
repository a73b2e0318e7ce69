"""OpenImageIO's way of opening and of failing: its messages, which it keeps where others raise, as
exceptions and as one line.

What is read or written with it is not decided here.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError

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
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise Failed(one_line(oiio.geterror()))
    return source


def pixels_of(path: Path, buffer: "oiio.ImageBuf") -> NDArray[np.float32]:
    """The (h, w, c) float32 result of one of OpenImageIO's operations on the image at `path`."""
    import OpenImageIO as oiio

    pixels = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise UsageError(f"{path}: cannot be converted ({one_line(buffer.geterror())})")
    return pixels


def one_line(text: str) -> str:
    """The first line of one of OpenImageIO's messages."""
    return text.strip().split("\n")[0].strip() or "no reason given"


def reason_of(error: Exception) -> str:
    """What went wrong, in words, without the path that Python adds."""
    return getattr(error, "strerror", None) or str(error)
