"""Image files to arrays as they are stored: an EXR's channels and header, any image's pixels.

No value is changed here; making colour of them is for `background`.
"""

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.images.library import Failed, attributes_of, check_room, error_of, open_image, reason_of
from volcli.images.paths import mode_of
from volcli.images.store import Attribute

if TYPE_CHECKING:
    import OpenImageIO as oiio


def read_exr(
    path: str | os.PathLike[str],
) -> tuple[dict[str, NDArray[np.float32]], dict[str, Attribute]]:
    """Read the channels and the header of an EXR (the first part of a multi-part file).

    Returns
    -------
    channels : dict
        Name -> (height, width) float32: the file's data window.
    attributes : dict
        The header's strings, ints and floats.

    Raises
    ------
    UsageError
        The file is missing, is no EXR, is deep or is damaged.
    """
    path = Path(path)
    pixels, spec, file_format = read_stored(path)
    if file_format != "openexr":
        raise UsageError(f"{path}: is {file_format}, not EXR; name an .exr that volcli wrote")
    # Copies, so that a caller that keeps one channel does not keep them all.
    channels = {name: pixels[..., i].copy() for i, name in enumerate(spec.channelnames)}
    return channels, attributes_of(spec)


def read_stored(path: Path) -> tuple[NDArray[np.float32], "oiio.ImageSpec", str]:
    """(h, w, c) float32 pixels as stored, their spec, and the format's name."""
    import OpenImageIO as oiio

    check_is_file(path)
    try:
        source = open_image(path)
    except (OSError, ValueError, Failed) as error:
        raise UsageError(f"{path}: not a readable image ({reason_of(error)})") from error
    try:
        spec = source.spec()
        if spec.deep:
            raise UsageError(f"{path}: is a deep image; flatten it first")
        check_room(path, spec)
        pixels = source.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        message = error_of(source)
        if pixels is None or message:
            raise UsageError(f"{path}: damaged image ({message or 'no reason given'})")
        return pixels.reshape(spec.height, spec.width, spec.nchannels), spec, source.format_name()
    finally:
        source.close()


def check_is_file(path: Path) -> None:
    """Refuse a path that leads to nothing, to a folder or to a pipe, before it is opened.

    Raises
    ------
    UsageError
        Saying which.
    """
    try:
        mode = mode_of(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: not a readable image ({reason_of(error)})") from error
    if mode is None:
        raise UsageError(f"{path}: no such file; check the path")
    if stat.S_ISDIR(mode):
        raise UsageError(f"{path}: is a folder; name an image")
    if not stat.S_ISREG(mode):  # it may have no end
        raise UsageError(f"{path}: is no regular file; name an image")
