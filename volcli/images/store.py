"""A file whole or not at all: pixels and a header are encoded into a temporary file, read back and
compared, and only then moved into place.

Pixels and header arrive as the file is to hold them; what they mean is for `write`.
"""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import OutputError
from volcli.files import linked, move_into_place, not_written
from volcli.images.color import LINEAR
from volcli.images.library import Failed, error_of, name_of, open_image, reason_of
from volcli.leftovers import temporary_name

Attribute = str | int | float
"""What a header may hold under a name."""

_CHROMATICITIES_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_TYPES = {"float32": "float", "uint16": "uint16", "uint8": "uint8"}  # NumPy's to OpenImageIO's
_ROWS_PER_CHECK = 256
_ROOM = 1 << 20  # bytes: more than a writer that found no room leaves


def write_whole(
    path: Path,
    file_format: str,
    names: list[str],
    pixels: NDArray[Any],
    header: Mapping[str, Attribute],
    *,
    colour_space: str = LINEAR,
    overwrite: bool,
) -> None:
    """Put (h, w, c) pixels into `path`: a temporary file, checked, then moved into place."""
    path = linked(path)
    temporary = temporary_name(path)
    try:
        # Created here and not by OpenImageIO: exclusively, and with the umask's permissions.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        _encode(temporary, file_format, names, pixels, header, colour_space)
        _check(temporary, names, pixels, header)
        _sync(temporary)
        move_into_place(temporary, path, overwrite)
    except FileExistsError as error:
        raise OutputError(f"{path}: already exists; use --overwrite or another path") from error
    except (OSError, UnicodeError, Failed) as error:
        reason = reason_of(error).replace(str(temporary), path.name)
        if isinstance(error, Failed):
            reason = _refusal(temporary) or reason
        raise not_written(path, reason) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def header_of(attributes: Mapping[str, Any], *, as_text: bool = False) -> dict[str, Attribute]:
    """Attributes as the types that the file keeps; others would be dropped without a word."""
    header: dict[str, Attribute] = {}
    for name, value in attributes.items():
        if isinstance(value, bool) or not isinstance(
            value, str | int | float | np.integer | np.floating
        ):
            raise TypeError(
                f"attribute '{name}' must be a str, int or float, not {type(value).__name__}"
            )
        if isinstance(value, str):  # a path whose bytes are no text in this locale may be UTF-8
            value = value.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
        else:
            value = int(value) if isinstance(value, int | np.integer) else float(value)
            if as_text or (isinstance(value, int) and not -(2**31) <= value < 2**31):
                value = str(value)
        header[name] = value
    return header


def _encode(
    file: Path,
    file_format: str,
    names: list[str],
    pixels: NDArray[Any],
    header: Mapping[str, Attribute],
    colour_space: str,
) -> None:
    import OpenImageIO as oiio

    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, oiio.TypeDesc(_TYPES[pixels.dtype.name]))
    spec.channelnames = tuple(names)
    if file_format == "openexr":
        # Without one, OpenImageIO adds the time of day; an empty one it leaves out.
        spec.attribute("DateTime", "")
    for name, value in header.items():
        spec.attribute(name, value)
    if file_format == "openexr":
        # What OpenImageIO makes of oiio:ColorSpace, for which it reads OpenColorIO's configuration
        # first: 30 ms of the 90 that a small picture takes to write.
        spec.attribute("colorInteropID", colour_space)
        spec.attribute("compression", "zip")
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), _CHROMATICITIES_REC709)
    else:
        spec.attribute("oiio:ColorSpace", colour_space)
        spec.attribute("oiio:UnassociatedAlpha", 1)

    output = oiio.ImageOutput.create(file_format)
    if output is None:
        raise Failed(error_of(oiio) or "no reason given")
    # A full disk shows in the message alone for PNG, in the return value alone for others.
    for step in (
        lambda: output.open(name_of(file), spec),
        lambda: output.write_image(pixels),
        lambda: output.close(),
    ):
        succeeded = step()
        message = error_of(output)
        if not succeeded or message:
            raise Failed(message or "no reason given")


def _check(
    file: Path, names: list[str], pixels: NDArray[Any], header: Mapping[str, Attribute]
) -> None:
    """Read a file back and compare everything with what it was written from."""
    import OpenImageIO as oiio

    source = open_image(file)
    try:
        spec = source.spec()
        height, width, count = pixels.shape
        if (spec.height, spec.width) != (height, width) or set(spec.channelnames) != set(names):
            raise Failed("read back with another size or other channels")
        for name, value in header.items():
            if not _same(spec.getattribute(name), value):
                raise Failed(f"the header did not keep '{name}'")
        # OpenImageIO sorts the channels of EXR.
        order = [spec.channelnames.index(name) for name in names]
        kind = oiio.TypeDesc(_TYPES[pixels.dtype.name])
        for y in range(0, height, _ROWS_PER_CHECK):
            rows = pixels[y : y + _ROWS_PER_CHECK]
            stored = source.read_scanlines(0, 0, y, y + len(rows), 0, 0, count, kind)
            if stored is None:
                raise Failed(f"cannot be read back: {error_of(source)}")
            stored = stored.reshape(rows.shape)[..., order]
            if stored.tobytes() != rows.tobytes():  # bits, so that NaN equals NaN
                raise Failed("read back with other pixels")
    finally:
        source.close()


def _refusal(file: Path) -> str | None:
    """Why the system takes no more of a file; None where it does.

    OpenImageIO says of a full disk that it could not write, or what it then could not read.
    """
    try:
        with file.open("ab", buffering=0) as more:
            more.write(bytes(_ROOM))
    except OSError as error:
        return error.strerror
    return None


def _same(stored: Any, written: Attribute) -> bool:
    if isinstance(written, str):
        return (stored or "") == written
    if isinstance(written, float):
        with np.errstate(over="ignore"):
            return isinstance(stored, float) and bool(
                np.array_equal(np.float32(stored), np.float32(written), equal_nan=True)
            )
    return stored == written


def _sync(file: Path) -> None:
    descriptor = os.open(file, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
