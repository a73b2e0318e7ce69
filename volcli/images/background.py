"""Any image as premultiplied, scene-linear colour of a given size: what a render is put over.

Window, orientation, channels, colour space, alpha and size are settled here, in that order.
"""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.images.color import linear_from_space
from volcli.images.library import pixels_of
from volcli.images.pixels import any_channel, counted
from volcli.images.read import read_stored

if TYPE_CHECKING:
    import OpenImageIO as oiio


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
    pixels, spec, _ = read_stored(path)
    pixels = _upright(path, _display_window(pixels, spec), spec.get_int_attribute("Orientation", 1))
    rgb, alpha = _colour_and_alpha(path, pixels, spec.channelnames)
    bad = any_channel(~np.isfinite(rgb))
    if alpha is not None:
        bad |= ~np.isfinite(alpha[..., 0])
    if bad.any():
        raise UsageError(f"{path}: {counted(bad)} NaN or infinite; repair the image")

    space = spec.getattribute("oiio:ColorSpace") or ""
    is_integer = str(spec.format) not in ("float", "half", "double")
    unassociated = bool(spec.get_int_attribute("oiio:UnassociatedAlpha", 0))
    if alpha is None:
        rgb = linear_from_space(path, rgb, space, is_integer)
    elif unassociated:
        rgb = linear_from_space(path, rgb, space, is_integer) * alpha
    else:
        # The curve applies to colour, not to colour times alpha.
        scale = alpha.copy()
        scale[alpha <= 0] = 1
        with np.errstate(over="ignore"):
            straight = rgb / scale
        decoded = linear_from_space(path, straight, space, is_integer)
        rgb = rgb if decoded is straight else decoded * scale

    width, height = size if size is not None else (rgb.shape[1], rgb.shape[0])
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :3] = _resized(path, rgb, width, height)
    if alpha is not None:
        rgba[..., 3:] = np.clip(_resized(path, alpha, width, height), 0, 1)
    return rgba


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
    return pixels_of(path, oiio.ImageBufAlgo.reorient(buffer))


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


def _resized(
    path: Path, pixels: NDArray[np.float32], width: int, height: int
) -> NDArray[np.float32]:
    if pixels.shape[:2] == (height, width):
        return pixels
    import OpenImageIO as oiio

    region = oiio.ROI(0, width, 0, height, 0, 1, 0, pixels.shape[2])
    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
    return pixels_of(
        path, oiio.ImageBufAlgo.resize(buffer, filtername="triangle", roi=region)
    ).reshape(height, width, pixels.shape[2])
