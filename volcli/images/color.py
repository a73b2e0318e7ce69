"""Colour spaces to linear Rec.709, by OpenImageIO's names.

Colour here is not multiplied by alpha; who divides by it and when is for the callers.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.images.library import error_of, pixels_of
from volcli.srgb import linear_from_srgb

LINEAR = "lin_rec709_scene"
"""OpenImageIO's name for scene-linear light with Rec.709 primaries."""

SRGB = "srgb_rec709_scene"
"""OpenImageIO's name for the same light encoded with the sRGB curve."""


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
    if not space.isprintable():  # a damaged header: OpenImageIO takes text alone
        raise UsageError(
            f"{path}: the name of its colour space is no text; save it as sRGB or as linear Rec.709"
        )
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
            f" ({error_of(converted)}); save it as sRGB or as linear Rec.709"
        )
    return pixels_of(path, converted)
