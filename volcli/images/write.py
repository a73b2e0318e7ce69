"""Colour, channels and maps to EXR and PNG: what values become in each format, what is lost.

How a file is made to appear whole or not at all is in `store`.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import NonFiniteError
from volcli.images.color import SRGB
from volcli.images.paths import checked_path
from volcli.images.pixels import any_channel, as_float32, counted, quantised, scaled
from volcli.images.store import Attribute, header_of, write_whole
from volcli.srgb import srgb_from_linear

UNIT_MAPS = ("transmittance", "opacity")
"""Maps whose values lie in [0, 1]; a PNG holds them as they are, every other map scaled."""

CLIP_TOLERANCE = 1e-6
"""How far, in premultiplied colour, a value may leave PNG's range by rounding alone."""


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
    path = checked_path(path, ".exr", overwrite)
    header = header_of(attributes)
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
    write_whole(path, "openexr", names, pixels, header, overwrite=overwrite)


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
    path = checked_path(path, ".png", overwrite)
    header = header_of(attributes, as_text=True)
    if bits not in (8, 16):
        raise ValueError(f"{path}: bits must be 8 or 16, not {bits}")
    pixels = as_float32(rgba)
    if pixels.ndim != 3 or pixels.shape[2] != 4 or 0 in pixels.shape:
        raise ValueError(f"{path}: pixels must be (height, width, 4), not {pixels.shape}")
    _refuse(path, any_channel(~np.isfinite(pixels)), "NaN or infinite")

    alpha = np.clip(pixels[..., 3:], 0, 1)
    straight = np.zeros_like(pixels[..., :3])
    with np.errstate(over="ignore"):
        np.divide(pixels[..., :3], alpha, out=straight, where=alpha > 0)
    codes = np.empty(pixels.shape, dtype=np.uint8 if bits == 8 else np.uint16)
    codes[..., :3] = quantised(srgb_from_linear(np.clip(straight, 0, 1)), codes.dtype)
    codes[..., 3:] = quantised(alpha, codes.dtype)
    names = ["R", "G", "B", "A"]
    if (codes[..., 3] == np.iinfo(codes.dtype).max).all():
        names, codes = names[:3], np.ascontiguousarray(codes[..., :3])
    write_whole(path, "png", names, codes, header, colour_space=SRGB, overwrite=overwrite)
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

    A map of three channels, of a medium that filters colour, is ``R``, ``G`` and ``B`` in both.

    EXR, and PNG of a map in `UNIT_MAPS`, hold the values themselves. PNG of any other map is
    scaled over its finite range, and +Inf (a depth where nothing was hit) is white.

    Parameters
    ----------
    values
        (height, width) or (height, width, 3), any real dtype and memory order.
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
        write_exr(path, layer_channels("", values), attributes, overwrite=overwrite)
        return 0.0, 1.0

    path = checked_path(path, ".png", overwrite)
    pixels = as_float32(values)
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)) or 0 in pixels.shape:
        raise ValueError(f"{path}: a map must be (height, width[, 3]), not {pixels.shape}")
    if name in UNIT_MAPS:
        _refuse(path, _any_of(~np.isfinite(pixels)), "NaN or infinite")
        low, high = float(pixels.min()), float(pixels.max())
        if low < -CLIP_TOLERANCE or high > 1 + CLIP_TOLERANCE:
            raise ValueError(f"{path}: {name} must lie in [0, 1], not in [{low:g}, {high:g}]")
        lo, hi, unit = 0.0, 1.0, np.clip(pixels, 0, 1)
    else:
        _refuse(path, _any_of(np.isnan(pixels) | np.isneginf(pixels)), "NaN or -infinite")
        lo, hi, unit = scaled(pixels)
    header = header_of(
        {**attributes, "volcli:map_lo": lo, "volcli:map_hi": hi},
        as_text=True,
    )
    codes = quantised(unit, np.dtype(np.uint16))
    names = ["R", "G", "B"] if codes.ndim == 3 else ["Y"]
    codes = codes.reshape(*pixels.shape[:2], len(names))
    write_whole(path, "png", names, codes, header, overwrite=overwrite)
    return lo, hi


def layer_channels(layer: str, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The channels of an EXR's layer: ``layer.Y`` of (h, w), ``layer.R`` ... of (h, w, 3).

    Without a name of the layer they are ``Y``, or ``R`` ...
    """
    prefix = f"{layer}." if layer else ""
    if np.ndim(values) == 2:
        return {f"{prefix}Y": values}
    return {f"{prefix}{c}": values[..., i] for i, c in enumerate("RGB")}


def _any_of(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w): where a mask (h, w[, channels]) is set."""
    return any_channel(mask) if mask.ndim == 3 else mask


def _channel_rank(name: str) -> tuple[int, str]:
    """R, G, B, A, Z first, then layers by name: the same order whatever the caller's."""
    order = "RGBAZ"
    return (order.index(name) if name in tuple(order) else len(order), name)


def _png_losses(path: Path, pixels: NDArray[np.float32], alpha: NDArray[np.float32]) -> list[str]:
    """What PNG could not hold of (h, w, 4) premultiplied pixels, one line for each kind.

    Of light it says how much, as a part of all the light in the picture.
    """
    rgb = pixels[..., :3]
    transparent = alpha[..., 0] == 0
    # Measured before division by alpha, where rounding at low opacity is not magnified.
    above = any_channel(rgb > alpha + CLIP_TOLERANCE) & ~transparent
    above |= pixels[..., 3] > 1 + CLIP_TOLERANCE
    beyond = np.maximum(rgb - alpha, 0).sum(axis=-1, dtype=np.float64)
    light = np.maximum(rgb, 0).sum(dtype=np.float64)

    def part(mask: NDArray[np.bool_]) -> str:
        lost = beyond[mask].sum() / light if light > 0 else 0.0
        return "less than 0.1 %" if lost < 1e-3 else f"{100 * lost:.3g} %"

    lost = {
        "hold light where opacity is 0, which PNG cannot store ({} of the picture's light)": (
            transparent & any_channel(rgb > 0)
        ),
        "are brighter than 1 and were clipped ({} of the picture's light)": above,
        "are negative and were clipped": any_channel(pixels < -CLIP_TOLERANCE),
    }
    return [
        f"{path}: {np.count_nonzero(mask)} of {mask.size} pixels "
        f"{what.format(part(mask)) if '{}' in what else what}; write .exr to keep them"
        for what, mask in lost.items()
        if mask.any()
    ]


def _refuse(path: Path, bad: NDArray[np.bool_], what: str) -> None:
    if bad.any():
        raise NonFiniteError(f"{path}: {counted(bad)} {what}; write .exr to look at them")
