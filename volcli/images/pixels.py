"""Arrays alone: to float32, to integers, to [0, 1]; and which pixels, in words.

Nothing here knows of files or of colour.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def as_float32(values: ArrayLike) -> NDArray[np.float32]:
    """Contiguous float32; what it cannot hold becomes Inf."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)


def quantised(unit: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Values in [0, 1] as the nearest of the integers 0 .. max."""
    return (unit * np.float32(np.iinfo(dtype).max) + np.float32(0.5)).astype(dtype)


def scaled(pixels: NDArray[np.float32]) -> tuple[float, float, NDArray[np.float32]]:
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


def any_channel(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels at which a (..., channels) mask is set."""
    return np.asarray(mask.any(axis=-1))


def counted(bad: NDArray[np.bool_]) -> str:
    """How many pixels of a (height, width) mask are set and which is first, to open a sentence."""
    y, x = np.unravel_index(int(np.argmax(bad)), bad.shape)
    return f"{np.count_nonzero(bad)} of {bad.size} pixels (the first at x={x}, y={y}) are"
