"""The sRGB curve: display values to linear light and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


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
