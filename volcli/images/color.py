"""Colour to linear light and back: the sRGB curve, and other colour spaces to linear Rec.709.

Colour here is not multiplied by alpha; who divides by it and when is for the callers.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from volcli.errors import UsageError
from volcli.images.library import one_line, pixels_of

LINEAR = "lin_rec709_scene"
"""OpenImageIO's name for scene-linear light with Rec.709 primaries."""

SRGB = "srgb_rec709_scene"
"""OpenImageIO's name for the same light encoded with the sRGB curve."""


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


def linear_from_space(
    path: Path, rgb: NDArray[np.float32], space: str, is_integer: bool
) -> NDArray[np.float32]:
    """Unassociated colour in a named space as linear Rec.709; `rgb` itself where it is linear."""
    import OpenImageIO as oiio

    # OpenImageIO calls PNM and PFM alike 'Rec709', though floats there are linear, and takes
    # 'scene_linear' for ACEScg: the type of the pixels decides for these as for files that say
    # nothing.
    if space in ("", "Rec709", "scene_linear", "unknown"):
        space = SRGB if is_integer else LINEAR
    if oiio.equivalent_colorspace(space, LINEAR):
        return rgb
    if oiio.equivalent_colorspace(space, SRGB):
        return linear_from_srgb(rgb).astype(np.float32, copy=False)
    converted = oiio.ImageBufAlgo.colorconvert(
        oiio.ImageBuf(np.ascontiguousarray(rgb)), space, LINEAR
    )
    if converted.has_error:
        raise UsageError(
            f"{path}: colour space '{space}' cannot be converted"
            f" ({one_line(converted.geterror())}); save it as sRGB or as linear Rec.709"
        )
    return pixels_of(path, converted)
