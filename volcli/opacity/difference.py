"""Two images, channel by channel: how much they differ, where most, and how different they look.

Images of one encoding are compared as they are stored; of a PNG and an EXR the PNG is made linear
and premultiplied first. Before a background, both are put behind it (`background.recomposite`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from volcli.errors import UsageError
from volcli.files import write_figure
from volcli.images import (
    Channels,
    flip,
    linear_from_srgb,
    read_background,
    read_channels,
    write_exr,
)
from volcli.opacity.background import Background, behind_of, recomposite
from volcli.opacity.heatmap import drawn, reduced
from volcli.opacity.maps import Floats, read_maps, values_of_map


@dataclass(frozen=True)
class Pair:
    """Two images that can be compared.

    Attributes
    ----------
    a, b
        Name -> (h, w) float32: the channels that both have, in one encoding.
    encoding
        ``as stored``, ``linear, premultiplied`` or ``before one background``.
    encoded
        Whether colour is sRGB-encoded.
    """

    a: Mapping[str, Floats]
    b: Mapping[str, Floats]
    encoding: str
    encoded: bool

    @property
    def has_colour(self) -> bool:
        """Whether both have R, G and B."""
        return all(c in self.a for c in "RGB")

    def colours(self) -> tuple[Floats, Floats]:
        """(h, w, 3) each, linear."""
        both = (np.stack([image[c] for c in "RGB"], axis=-1) for image in (self.a, self.b))
        if self.encoded:
            both = (linear_from_srgb(colour).astype(np.float32) for colour in both)
        first, second = both
        return first, second


def read_pair(a: Path, b: Path, *, background: Background | None = None) -> Pair:
    """Read two images to compare.

    Parameters
    ----------
    background
        What both are put before: ``transparent``, a linear colour or an image; None: they are
        compared as they are.

    Raises
    ------
    UsageError
        One cannot be read, they differ in size, or no channel is in both.
    """
    if background is not None:
        images = [_before(path, background) for path in (a, b)]
        encoding, encoded = "before one background", False
    else:
        stored = [read_channels(path) for path in (a, b)]
        encoded = all(_is_encoded(image) for image in stored)
        mixed = not encoded and any(_is_encoded(image) for image in stored)
        encoding = "linear, premultiplied" if mixed else "as stored"
        images = [_linear(i) if _is_encoded(i) and mixed else _named(i) for i in stored]
    sizes = [next(iter(image.values())).shape[::-1] for image in images]
    if sizes[0] != sizes[1]:
        first, second = ("x".join(map(str, size)) for size in sizes)
        raise UsageError(f"{b}: is {second}, and {a} is {first}; compare images of one size")
    shared = [name for name in images[0] if name in images[1]]
    if not shared:
        raise UsageError(
            f"{a} and {b} share no channel; they have {', '.join(images[0])}, and "
            f"{', '.join(images[1])}"
        )
    return Pair(
        {name: images[0][name] for name in shared},
        {name: images[1][name] for name in shared},
        encoding,
        encoded,
    )


def compare(pair: Pair) -> dict[str, Any]:
    """The differences of two images, as plain data.

    Returns
    -------
    ``encoding``; ``channels``: for each ``max``, ``mean``, ``rmse`` of the absolute difference over
    the pixels that are finite in both, ``psnr`` in dB (None where the images are the same) with the
    ``peak`` it refers to (the largest value of the first image, at least 1), ``at``: x and y of
    the largest difference with the values ``a`` and ``b`` there, and ``unmatched``: how many pixels
    are finite in one image and not in the other, or not finite in different ways; ``flip``: its
    ``kind``, ``mean`` and ``max``, or None without colour or where colour is not finite.
    """
    channels = {name: _channel(pair.a[name], pair.b[name]) for name in pair.a}
    seen = None
    if pair.has_colour:
        colours = pair.colours()
        if all(np.isfinite(colour).all() for colour in colours):
            errors, kind = flip(*colours)
            seen = {"kind": kind, "mean": float(errors.mean(dtype=np.float64))}
            seen |= {"max": float(errors.max())}
    return {"encoding": pair.encoding, "channels": channels, "flip": seen}


def _channel(a: Floats, b: Floats) -> dict[str, Any]:
    finite = np.isfinite(a) & np.isfinite(b)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    unmatched = ~finite & ~same
    difference = np.zeros(a.shape, np.float64)
    np.subtract(b, a, out=difference, where=finite, dtype=np.float64)
    np.abs(difference, out=difference)
    count = max(int(np.count_nonzero(finite)), 1)
    rmse = float(np.sqrt(np.square(difference).sum() / count))
    peak = max(1.0, float(np.abs(a, where=finite, out=np.zeros_like(a)).max()))
    where = unmatched if unmatched.any() else difference
    y, x = (int(i) for i in np.unravel_index(int(np.argmax(where)), a.shape))
    return {
        "max": float(difference.max()),
        "mean": float(difference.sum() / count),
        "rmse": rmse,
        "psnr": 20 * float(np.log10(peak / rmse)) if rmse > 0 else None,
        "peak": peak,
        "at": [x, y],
        "a": _plain(a[y, x]),
        "b": _plain(b[y, x]),
        "unmatched": int(np.count_nonzero(unmatched)),
    }


def _plain(value: np.float32) -> float | str:
    """A number, or the name of what JSON has no number for."""
    return float(value) if np.isfinite(value) else str(value)


def write_difference(
    path: Path, pair: Pair, title: str, *, colormap: str = "magma", overwrite: bool = True
) -> None:
    """Write the difference: an EXR of B - A in each channel, or a figure (.png, .svg, .pdf).

    The figure shows the largest absolute difference of R, G, B and A, or of all channels where
    there is no colour, on a logarithmic scale.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with np.errstate(invalid="ignore"):
        differences = {name: pair.b[name] - pair.a[name] for name in pair.a}
    if path.suffix.lower() == ".exr":
        write_exr(path, differences, {"volcli:difference": title}, overwrite=overwrite)
        return
    from matplotlib.colors import LogNorm

    names = [c for c in "RGBA" if c in differences] if pair.has_colour else list(differences)
    largest = np.max([np.abs(differences[name]) for name in names], axis=0)
    shown = reduced(largest)
    high = float(shown.max(where=np.isfinite(shown), initial=0)) or 1.0
    height, width = largest.shape
    figure, _ = drawn(
        np.ma.masked_array(shown, ~np.isfinite(shown) | (shown <= 0)),
        (width, height),
        colormap=colormap,
        norm=LogNorm(high * 1e-4, high),
        label=f"largest |B - A| of {', '.join(names)}",
        title=title,
        missing="the same",
        extend="min",
    )
    write_figure(path, figure, overwrite=overwrite)


def _is_encoded(image: Channels) -> bool:
    """Whether an image holds sRGB-encoded colour: integers that are no map."""
    return image.bits is not None and values_of_map(image) is None


def _named(image: Channels) -> dict[str, Floats]:
    """The channels of an image; of a map of volcli's, its values under its name."""
    found = values_of_map(image)
    return dict(image.planes) if found is None else {found[0]: found[1]}


def _linear(image: Channels) -> dict[str, Floats]:
    pixels = read_background(image.path)
    return {c: pixels[..., i] for i, c in enumerate("RGBA")}


def _before(path: Path, background: Background) -> dict[str, Floats]:
    maps = read_maps(path)
    pixels = recomposite(maps, behind_of(background, maps.stored.size))
    return {c: pixels[..., i] for i, c in enumerate("RGBA")}
