"""Arrays to EXR and PNG files and back: encodings, headers, and writes that succeed whole or not
at all.

Pixels are (height, width[, channels]) arrays, row 0 at the top. Colour is premultiplied and
scene-linear with Rec.709 primaries, float32, except inside PNG files, which hold sRGB with
unassociated alpha. This is the only module that imports OpenImageIO, and it does so inside the
functions that need it. It knows nothing of volumes, jobs or rendering.
"""

import errno
import os
import secrets
import stat
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from volcli.errors import NonFiniteError, OutputError, UsageError

if TYPE_CHECKING:
    import OpenImageIO as oiio

__all__ = [
    "check_output",
    "linear_from_srgb",
    "read_background",
    "read_exr",
    "srgb_from_linear",
    "write_exr",
    "write_map",
    "write_png",
]

Attribute = str | int | float

UNIT_MAPS = ("transmittance", "opacity")
"""Maps whose values lie in [0, 1]; a PNG holds them as they are, every other map scaled."""

CLIP_TOLERANCE = 1e-6
"""How far, in premultiplied colour, a value may leave PNG's range by rounding alone."""

_LINEAR = "lin_rec709_scene"
_SRGB = "srgb_rec709_scene"
_CHROMATICITIES_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_TYPES = {"float32": "float", "uint16": "uint16", "uint8": "uint8"}  # NumPy's to OpenImageIO's
_ROWS_PER_CHECK = 256


def check_output(path: str | os.PathLike[str], *, overwrite: bool = True) -> None:
    """Refuse, before anything is computed, a path that an image cannot be written to.

    What only writing can show (a full disk, a quota) is left to the writers, which report it as
    the same `OutputError`.

    Raises
    ------
    UsageError
        The extension is neither ``.exr`` nor ``.png``.
    OutputError
        The folder is missing, is no folder or is read-only; the path is a folder or a special
        file; or it exists and ``overwrite`` is False.
    """
    path = Path(path)
    if path.suffix.lower() not in (".exr", ".png"):
        raise UsageError(f"{path}: unknown image format '{path.suffix}'; use .exr or .png")
    folder = path.parent
    try:
        folder_mode = _mode(folder)
        mode = _mode(path)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: {_reason(error)}; choose another path") from error
    if folder_mode is None:
        raise OutputError(f"{path}: the folder '{folder}' does not exist; create it first")
    if not stat.S_ISDIR(folder_mode):
        raise OutputError(f"{path}: '{folder}' is not a folder; choose another path")
    if mode is not None:
        if stat.S_ISDIR(mode):
            raise OutputError(f"{path}: is a folder; name a file inside it")
        if not stat.S_ISREG(mode):
            raise OutputError(f"{path}: is not a regular file; choose another path")
        if not overwrite:
            raise OutputError(f"{path}: already exists; use --overwrite or another path")
        if not os.access(path, os.W_OK):
            raise OutputError(f"{path}: is read-only; change its permissions or choose another")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: the folder '{folder}' is not writable; choose another")


def srgb_from_linear(linear: ArrayLike) -> NDArray[Any]:
    """Encode linear light in [0, 1] with the exact sRGB curve (IEC 61966-2-1).

    s = 12.92 v where v <= 0.0031308, else 1.055 v^(1/2.4) - 0.055. The shape and float dtype are
    kept; negative values take the linear part.
    """
    v = np.asarray(linear)
    high = 1.055 * np.maximum(v, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(v <= 0.0031308, 12.92 * v, high)


def linear_from_srgb(srgb: ArrayLike) -> NDArray[Any]:
    """Decode sRGB-encoded values to linear light: the inverse of `srgb_from_linear`.

    v = s / 12.92 where s <= 0.04045, else ((s + 0.055) / 1.055)^2.4.
    """
    s = np.asarray(srgb)
    high = ((np.maximum(s, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(s <= 0.04045, s / 12.92, high)


def write_exr(
    path: str | os.PathLike[str],
    channels: Mapping[str, NDArray[Any]],
    attributes: Mapping[str, Attribute],
    *,
    overwrite: bool = True,
) -> None:
    """Write named channels as one float32, zip-compressed, scene-linear EXR.

    Equal input gives equal bytes: no date is added.

    Parameters
    ----------
    path
        The file, ``*.exr``. It appears whole or not at all.
    channels
        Name -> (height, width) array of any real dtype and memory order; all of one shape. Colour
        is ``R G B A``, premultiplied; depth ``Z``; a layer's single channel ``layer.Y``. NaN and
        Inf are stored as they are; what float32 cannot hold becomes Inf.
    attributes
        Header entries. EXR stores floats as float32; an int beyond 32 bits is stored as its
        decimal string; an empty string is left out.

    Raises
    ------
    TypeError
        An attribute is no str, int or float.
    ValueError
        No channels, or channels that differ in shape.
    UsageError, OutputError
        See `check_output`; also when writing or reading back fails.
    """
    path = _checked(path, ".exr", overwrite)
    header = _header(attributes)
    if not channels:
        raise ValueError(f"{path}: no channels to write")
    shapes = {name: np.shape(values) for name, values in channels.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"{path}: channels differ in shape: {shapes}")
    shape = next(iter(shapes.values()))
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"{path}: channels must be (height, width), not {shape}")
    pixels = np.empty((*shape, len(channels)), dtype=np.float32)
    names = sorted(channels, key=_channel_rank)
    with np.errstate(over="ignore"):
        for i, name in enumerate(names):
            pixels[..., i] = channels[name]
    _write(path, "openexr", names, pixels, header, overwrite=overwrite)


def write_png(
    path: str | os.PathLike[str],
    rgba: NDArray[Any],
    attributes: Mapping[str, Attribute],
    *,
    bits: int = 8,
    overwrite: bool = True,
) -> list[str]:
    """Write premultiplied, scene-linear colour as an sRGB PNG with unassociated alpha.

    The file has three channels where every pixel is opaque, else four. Equal input gives equal
    bytes.

    Parameters
    ----------
    rgba
        (height, width, 4), premultiplied, scene-linear, any real dtype and memory order.
    attributes
        Header entries; PNG stores text, so numbers become their decimal strings.
    bits
        8 or 16 bits per channel.

    Returns
    -------
    list of str
        One warning for each kind of value that PNG cannot hold: light where opacity is 0, colour
        above 1 and below 0. Empty where nothing was lost but precision.

    Raises
    ------
    NonFiniteError
        `rgba` holds NaN or Inf.
    TypeError
        An attribute is no str, int or float.
    ValueError
        A wrong shape, or bits other than 8 and 16.
    UsageError, OutputError
        See `check_output`; also when writing or reading back fails.
    """
    path = _checked(path, ".png", overwrite)
    header = _header(attributes, as_text=True)
    if bits not in (8, 16):
        raise ValueError(f"{path}: bits must be 8 or 16, not {bits}")
    pixels = _float32(rgba)
    if pixels.ndim != 3 or pixels.shape[2] != 4 or 0 in pixels.shape:
        raise ValueError(f"{path}: pixels must be (height, width, 4), not {pixels.shape}")
    _refuse(path, _any_channel(~np.isfinite(pixels)), "NaN or infinite")

    alpha = np.clip(pixels[..., 3:], 0, 1)
    straight = np.zeros_like(pixels[..., :3])
    with np.errstate(over="ignore"):
        np.divide(pixels[..., :3], alpha, out=straight, where=alpha > 0)
    codes = np.empty(pixels.shape, dtype=np.uint8 if bits == 8 else np.uint16)
    codes[..., :3] = _quantised(srgb_from_linear(np.clip(straight, 0, 1)), codes.dtype)
    codes[..., 3:] = _quantised(alpha, codes.dtype)
    names = ["R", "G", "B", "A"]
    if (codes[..., 3] == np.iinfo(codes.dtype).max).all():
        names, codes = names[:3], np.ascontiguousarray(codes[..., :3])
    _write(path, "png", names, codes, header, colour_space=_SRGB, overwrite=overwrite)
    return _png_losses(path, pixels, alpha)


def write_map(
    path: str | os.PathLike[str],
    values: NDArray[Any],
    attributes: Mapping[str, Attribute],
    *,
    name: str,
    overwrite: bool = True,
) -> tuple[float, float]:
    """Write one map: EXR as float32 in channel ``Y``, PNG as linear grey of 16 bits.

    EXR, and PNG of a map in `UNIT_MAPS`, hold the values themselves. PNG of any other map is
    scaled over its finite range, and +Inf (a depth where nothing was hit) is white.

    Parameters
    ----------
    values
        (height, width), any real dtype and memory order.
    name
        ``"transmittance"``, ``"opacity"``, ``"optical_depth"``, ``"depth"``, ...; stored as
        ``volcli:map``.

    Returns
    -------
    (float, float)
        (lo, hi): value = lo + pixel (hi - lo), with the pixel in [0, 1]; (0, 1) where values are
        stored unscaled. PNG holds it as ``volcli:map_lo`` and ``volcli:map_hi``.

    Raises
    ------
    NonFiniteError
        PNG only: NaN or -Inf, or +Inf in a map of `UNIT_MAPS`.
    TypeError
        An attribute is no str, int or float.
    ValueError
        A wrong shape, or PNG of a map of `UNIT_MAPS` with values outside [0, 1].
    UsageError, OutputError
        See `check_output`; also when writing or reading back fails.
    """
    path = Path(path)
    attributes = {**attributes, "volcli:map": name}
    if path.suffix.lower() != ".png":
        write_exr(path, {"Y": values}, attributes, overwrite=overwrite)
        return 0.0, 1.0

    path = _checked(path, ".png", overwrite)
    pixels = _float32(values)
    if pixels.ndim != 2 or 0 in pixels.shape:
        raise ValueError(f"{path}: a map must be (height, width), not {pixels.shape}")
    if name in UNIT_MAPS:
        _refuse(path, ~np.isfinite(pixels), "NaN or infinite")
        low, high = float(pixels.min()), float(pixels.max())
        if low < -CLIP_TOLERANCE or high > 1 + CLIP_TOLERANCE:
            raise ValueError(f"{path}: {name} must lie in [0, 1], not in [{low:g}, {high:g}]")
        lo, hi, unit = 0.0, 1.0, np.clip(pixels, 0, 1)
    else:
        _refuse(path, np.isnan(pixels) | np.isneginf(pixels), "NaN or -infinite")
        lo, hi, unit = _scaled(pixels)
    header = _header(
        {**attributes, "volcli:map_lo": lo, "volcli:map_hi": hi},
        as_text=True,
    )
    codes = _quantised(unit, np.dtype(np.uint16))[..., np.newaxis]
    _write(path, "png", ["Y"], codes, header, overwrite=overwrite)
    return lo, hi


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
    pixels, spec, file_format = _read(path)
    if file_format != "openexr":
        raise UsageError(f"{path}: is {file_format}, not EXR; name an .exr that volcli wrote")
    # Copies, so that a caller that keeps one channel does not keep them all.
    channels = {name: pixels[..., i].copy() for i, name in enumerate(spec.channelnames)}
    attributes = {
        a.name: a.value for a in spec.extra_attribs if isinstance(a.value, str | int | float)
    }
    return channels, attributes


def read_background(
    path: str | os.PathLike[str], size: tuple[int, int] | None = None
) -> NDArray[np.float32]:
    """Read any image as premultiplied, scene-linear colour, stretched to `size` where it differs.

    Files that declare no colour space are sRGB if they hold integers and linear if they hold
    floats. Grey becomes equal R, G and B; a missing alpha is 1. Resizing happens in premultiplied
    linear light with a tent filter: it keeps constants and ramps, and stays within the range of
    the pixels that it averages (a sharper filter rings around a sun).

    Parameters
    ----------
    size
        (width, height) in pixels; None keeps the image's own.

    Returns
    -------
    (height, width, 4) float32

    Raises
    ------
    UsageError
        The file is missing or unreadable, has no colour channels, or holds NaN or Inf.
    """
    path = Path(path)
    pixels, spec, _ = _read(path)
    pixels = _upright(path, _display_window(pixels, spec), spec.get_int_attribute("Orientation", 1))
    rgb, alpha = _colour_and_alpha(path, pixels, spec.channelnames)
    bad = _any_channel(~np.isfinite(rgb))
    if alpha is not None:
        bad |= ~np.isfinite(alpha[..., 0])
    if bad.any():
        raise UsageError(f"{path}: {_where(bad)} NaN or infinite; repair the image")

    space = spec.getattribute("oiio:ColorSpace") or ""
    is_integer = str(spec.format) not in ("float", "half", "double")
    unassociated = bool(spec.get_int_attribute("oiio:UnassociatedAlpha", 0))
    if alpha is None:
        rgb = _linear(path, rgb, space, is_integer)
    elif unassociated:
        rgb = _linear(path, rgb, space, is_integer) * alpha
    else:
        # The curve applies to colour, not to colour times alpha.
        scale = alpha.copy()
        scale[alpha <= 0] = 1
        with np.errstate(over="ignore"):
            straight = rgb / scale
        decoded = _linear(path, straight, space, is_integer)
        rgb = rgb if decoded is straight else decoded * scale

    width, height = size if size is not None else (rgb.shape[1], rgb.shape[0])
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :3] = _resized(path, rgb, width, height)
    if alpha is not None:
        rgba[..., 3:] = np.clip(_resized(path, alpha, width, height), 0, 1)
    return rgba


# -- pixels ---------------------------------------------------------------------------------------


def _float32(values: ArrayLike) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)


def _quantised(unit: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Values in [0, 1] as the nearest of the integers 0 .. max."""
    return (unit * np.float32(np.iinfo(dtype).max) + np.float32(0.5)).astype(dtype)


def _scaled(pixels: NDArray[np.float32]) -> tuple[float, float, NDArray[np.float32]]:
    """(lo, hi, values scaled to [0, 1] over their finite range); +Inf is 1."""
    finite = np.isfinite(pixels)
    unit = np.ones_like(pixels)
    if not finite.any():
        return 0.0, 0.0, unit
    lo = float(pixels[finite].min())
    hi = float(pixels[finite].max())
    span = hi - lo if hi > lo else 1.0
    unit[finite] = (pixels[finite].astype(np.float64) - lo) / span
    return lo, hi, unit


def _png_losses(path: Path, pixels: NDArray[np.float32], alpha: NDArray[np.float32]) -> list[str]:
    """What PNG could not hold of (h, w, 4) premultiplied pixels, one line for each kind."""
    rgb = pixels[..., :3]
    transparent = alpha[..., 0] == 0
    # Measured before division by alpha, where rounding at low opacity is not magnified.
    above = _any_channel(rgb > alpha + CLIP_TOLERANCE) & ~transparent
    above |= pixels[..., 3] > 1 + CLIP_TOLERANCE
    below = _any_channel(pixels < -CLIP_TOLERANCE)
    lost = {
        "hold light where opacity is 0, which PNG cannot store": transparent
        & _any_channel(rgb > 0),
        "are brighter than 1 and were clipped": above,
        "are negative and were clipped": below,
    }
    return [
        f"{path}: {np.count_nonzero(mask)} of {mask.size} pixels {what}; write .exr to keep them"
        for what, mask in lost.items()
        if mask.any()
    ]


def _refuse(path: Path, bad: NDArray[np.bool_], what: str) -> None:
    if bad.any():
        raise NonFiniteError(f"{path}: {_where(bad)} {what}; write .exr to look at them")


def _any_channel(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(mask.any(axis=-1))


def _where(bad: NDArray[np.bool_]) -> str:
    y, x = np.unravel_index(int(np.argmax(bad)), bad.shape)
    return f"{np.count_nonzero(bad)} of {bad.size} pixels (the first at x={x}, y={y}) are"


def _display_window(pixels: NDArray[np.float32], spec: "oiio.ImageSpec") -> NDArray[np.float32]:
    """Pixels over the display window: EXR may store a part of it, or more."""
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    width, height = spec.full_width, spec.full_height
    if (x, y, spec.width, spec.height) == (0, 0, width, height):
        return pixels
    canvas = np.zeros((height, width, pixels.shape[2]), dtype=np.float32)
    x0, x1 = np.clip([x, x + spec.width], 0, width)
    y0, y1 = np.clip([y, y + spec.height], 0, height)
    canvas[y0:y1, x0:x1] = pixels[y0 - y : y1 - y, x0 - x : x1 - x]
    return canvas


def _upright(path: Path, pixels: NDArray[np.float32], orientation: int) -> NDArray[np.float32]:
    """Pixels turned as the Exif orientation (1 .. 8, 1 is upright) asks."""
    if orientation == 1:
        return pixels
    import OpenImageIO as oiio

    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
    buffer.orientation = orientation
    return _pixels_of(path, oiio.ImageBufAlgo.reorient(buffer))


def _colour_and_alpha(
    path: Path, pixels: NDArray[np.float32], names: Iterable[str]
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(h, w, 3) colour and (h, w, 1) alpha or None, as they are stored."""
    index = {name.upper(): i for i, name in enumerate(names)}
    if all(name in index for name in "RGB"):
        rgb = pixels[..., [index["R"], index["G"], index["B"]]]
    elif "Y" in index or len(index) == 1:
        rgb = np.repeat(pixels[..., [index.get("Y", 0)]], 3, axis=2)
    else:
        raise UsageError(f"{path}: no channels R, G, B or Y; it has: {', '.join(names)}")
    return rgb, pixels[..., [index["A"]]] if "A" in index else None


def _linear(
    path: Path, rgb: NDArray[np.float32], space: str, is_integer: bool
) -> NDArray[np.float32]:
    """Unassociated colour in a named space as linear Rec.709; `rgb` itself where it is linear."""
    import OpenImageIO as oiio

    # OpenImageIO calls PNM and PFM alike 'Rec709', though floats there are linear, and takes
    # 'scene_linear' for ACEScg: the type of the pixels decides for these as for files that say
    # nothing.
    if space in ("", "Rec709", "scene_linear", "unknown"):
        space = _SRGB if is_integer else _LINEAR
    if oiio.equivalent_colorspace(space, _LINEAR):
        return rgb
    if oiio.equivalent_colorspace(space, _SRGB):
        return linear_from_srgb(rgb).astype(np.float32, copy=False)
    converted = oiio.ImageBufAlgo.colorconvert(
        oiio.ImageBuf(np.ascontiguousarray(rgb)), space, _LINEAR
    )
    if converted.has_error:
        raise UsageError(
            f"{path}: colour space '{space}' cannot be converted"
            f" ({_one_line(converted.geterror())}); save it as sRGB or as linear Rec.709"
        )
    return _pixels_of(path, converted)


def _resized(
    path: Path, pixels: NDArray[np.float32], width: int, height: int
) -> NDArray[np.float32]:
    if pixels.shape[:2] == (height, width):
        return pixels
    import OpenImageIO as oiio

    region = oiio.ROI(0, width, 0, height, 0, 1, 0, pixels.shape[2])
    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
    return _pixels_of(
        path, oiio.ImageBufAlgo.resize(buffer, filtername="triangle", roi=region)
    ).reshape(height, width, pixels.shape[2])


def _pixels_of(path: Path, buffer: "oiio.ImageBuf") -> NDArray[np.float32]:
    import OpenImageIO as oiio

    pixels = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise UsageError(f"{path}: cannot be converted ({_one_line(buffer.geterror())})")
    return pixels


# -- files ----------------------------------------------------------------------------------------


def _mode(path: Path) -> int | None:
    """The st_mode of what `path` leads to, None where there is nothing."""
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return None
    except NotADirectoryError:
        return None  # the folder's own check says so


def _checked(path: str | os.PathLike[str], suffix: str, overwrite: bool) -> Path:
    path = Path(path)
    check_output(path, overwrite=overwrite)
    if path.suffix.lower() != suffix:
        raise UsageError(f"{path}: the extension must be {suffix} here, not {path.suffix}")
    return path


def _header(attributes: Mapping[str, Any], *, as_text: bool = False) -> dict[str, Attribute]:
    """Attributes as the types that the file keeps; others would be dropped without a word."""
    header: dict[str, Attribute] = {}
    for name, value in attributes.items():
        if isinstance(value, bool) or not isinstance(
            value, str | int | float | np.integer | np.floating
        ):
            raise TypeError(
                f"attribute '{name}' must be a str, int or float, not {type(value).__name__}"
            )
        if not isinstance(value, str):
            value = int(value) if isinstance(value, int | np.integer) else float(value)
            if as_text or (isinstance(value, int) and not -(2**31) <= value < 2**31):
                value = str(value)
        header[name] = value
    return header


def _channel_rank(name: str) -> tuple[int, str]:
    """R, G, B, A, Z first, then layers by name: the same order whatever the caller's."""
    order = "RGBAZ"
    return (order.index(name) if name in tuple(order) else len(order), name)


def _one_line(text: str) -> str:
    """The first line of one of OpenImageIO's messages."""
    return text.strip().split("\n")[0].strip() or "no reason given"


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _write(
    path: Path,
    file_format: str,
    names: list[str],
    pixels: NDArray[Any],
    header: Mapping[str, Attribute],
    *,
    colour_space: str = _LINEAR,
    overwrite: bool,
) -> None:
    """Put (h, w, c) pixels into `path`: a temporary file, checked, then moved into place."""
    if path.is_symlink():
        path = path.resolve()  # write the file that the link leads to, as open() would
    # Short, so that a long name of the image does not become one that is too long.
    temporary = path.with_name(f".volcli-{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        # Created here and not by OpenImageIO: exclusively, and with the umask's permissions.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        _encode(temporary, file_format, names, pixels, header, colour_space)
        _check(temporary, names, pixels, header)
        _sync(temporary)
        _move(temporary, path, overwrite)
    except FileExistsError as error:
        raise OutputError(f"{path}: already exists; use --overwrite or another path") from error
    except (OSError, UnicodeError, _Failed) as error:
        reason = _reason(error).replace(str(temporary), path.name)
        raise OutputError(
            f"{path}: could not be written ({reason});"
            f" check the free space and the permissions of '{path.parent}'"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


class _Failed(Exception):
    """What OpenImageIO reported instead of raising."""


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
    spec.attribute("oiio:ColorSpace", colour_space)
    if file_format == "openexr":
        spec.attribute("compression", "zip")
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), _CHROMATICITIES_REC709)
    else:
        spec.attribute("oiio:UnassociatedAlpha", 1)

    output = oiio.ImageOutput.create(file_format)
    if output is None:
        raise _Failed(_one_line(oiio.geterror()))
    # A full disk shows in the message alone for PNG, in the return value alone for others.
    for step in (
        lambda: output.open(str(file), spec),
        lambda: output.write_image(pixels),
        lambda: output.close(),
    ):
        succeeded = step()
        message = output.geterror()
        if not succeeded or message:
            raise _Failed(_one_line(message))


def _check(
    file: Path, names: list[str], pixels: NDArray[Any], header: Mapping[str, Attribute]
) -> None:
    """Read a file back and compare everything with what it was written from."""
    import OpenImageIO as oiio

    source = _open(file)
    try:
        spec = source.spec()
        height, width, count = pixels.shape
        if (spec.height, spec.width) != (height, width) or set(spec.channelnames) != set(names):
            raise _Failed("read back with another size or other channels")
        for name, value in header.items():
            if not _same(spec.getattribute(name), value):
                raise _Failed(f"the header did not keep '{name}'")
        # OpenImageIO sorts the channels of EXR.
        order = [spec.channelnames.index(name) for name in names]
        kind = oiio.TypeDesc(_TYPES[pixels.dtype.name])
        for y in range(0, height, _ROWS_PER_CHECK):
            rows = pixels[y : y + _ROWS_PER_CHECK]
            stored = source.read_scanlines(0, 0, y, y + len(rows), 0, 0, count, kind)
            if stored is None:
                raise _Failed(f"cannot be read back: {_one_line(source.geterror())}")
            stored = stored.reshape(rows.shape)[..., order]
            if stored.tobytes() != rows.tobytes():  # bits, so that NaN equals NaN
                raise _Failed("read back with other pixels")
    finally:
        source.close()


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


def _move(temporary: Path, path: Path, overwrite: bool) -> None:
    """Give the finished file its name; without `overwrite` even where another writer was faster."""
    if overwrite:
        temporary.replace(path)
        return
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        raise
    except OSError as error:  # a file system without hard links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from error
        temporary.replace(path)


def _open(path: Path) -> "oiio.ImageInput":
    import OpenImageIO as oiio

    # Alpha as the file has it: OpenImageIO would premultiply the encoded values in 8 bits.
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise _Failed(_one_line(oiio.geterror()))
    return source


def _read(path: Path) -> tuple[NDArray[np.float32], "oiio.ImageSpec", str]:
    """(h, w, c) float32 pixels as stored, their spec, and the format's name."""
    import OpenImageIO as oiio

    try:
        mode = _mode(path)
        if mode is None:
            raise UsageError(f"{path}: no such file; check the path")
        if stat.S_ISDIR(mode):
            raise UsageError(f"{path}: is a folder; name an image")
        source = _open(path)
    except (OSError, ValueError, _Failed) as error:
        raise UsageError(f"{path}: not a readable image ({_reason(error)})") from error
    try:
        spec = source.spec()
        if spec.deep:
            raise UsageError(f"{path}: is a deep image; flatten it first")
        pixels = source.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        message = source.geterror()
        if pixels is None or message:
            raise UsageError(f"{path}: damaged image ({_one_line(message)})")
        return pixels.reshape(spec.height, spec.width, spec.nchannels), spec, source.format_name()
    finally:
        source.close()
