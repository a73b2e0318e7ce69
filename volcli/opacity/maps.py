"""An image to maps: what its channels, layers or header say of the opacity of a volume.

An EXR of volcli holds optical depth and transmittance as layers, which no background touches; any
other image has at most alpha, of which the rest follows. What is derived is said in ``source``.

Of a pixel with several samples each layer is a mean of its own, so that T is not exp(-tau) of the
other. Under a tint each layer has three channels; the maps are the means over them.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.images import Channels, read_channels
from volcli.texts import parse_toml

Floats = NDArray[np.float32]

JOB_HEADER = "volcli:job"
"""The header entry that holds the job as TOML."""

MAP_HEADER = "volcli:map"
"""The header entry that names the map in a file that holds nothing else."""

SAME = 1e-6
"""A difference of opacity that is rounding."""

ERRORS = ("error_bound", "error_estimate")
"""The layers that say how far off a pixel may be, or is thought to be."""

NO_ALPHA = "no alpha: opaque"
"""The source of opacity of an image that says nothing of it."""


@dataclass(frozen=True)
class Maps:
    """The maps of one image.

    Attributes
    ----------
    stored
        The image as it is stored.
    opacity, transmittance, optical_depth
        (h, w) float32. Optical depth is +Inf where opacity is 1 and nothing tells more.
    depth
        (h, w) float32, or None: distance along the camera's axis, +Inf where nothing is hit.
    through
        (h, w) or, under a tint, (h, w, 3): what the background is multiplied by.
    source
        Map -> where its values come from, for people: ``layer transmittance.Y``.
    errors
        (h, w) float32 each: those of `ERRORS` that the image has.
    """

    stored: Channels
    opacity: Floats
    transmittance: Floats
    optical_depth: Floats
    depth: Floats | None
    through: Floats
    source: dict[str, str]
    errors: dict[str, Floats] = field(default_factory=dict)

    @property
    def layers(self) -> dict[str, Floats]:
        """The maps that there are, by name."""
        maps = {
            "opacity": self.opacity,
            "transmittance": self.transmittance,
            "optical_depth": self.optical_depth,
        }
        return maps | ({} if self.depth is None else {"depth": self.depth}) | self.errors

    @cached_property
    def job(self) -> dict[str, Any]:
        """The tables of the job that the header holds; empty where it holds none."""
        text = self.stored.attributes.get(JOB_HEADER)
        try:
            tables = parse_toml(str(text)) if text else {}
        except ValueError:
            return {}
        return {name: table for name, table in tables.items() if isinstance(table, dict)}

    @property
    def rule(self) -> str | None:
        """The rule of integration by which volcli made the image, if it says so."""
        rule = self.stored.attributes.get("volcli:rule")
        return None if rule is None else "".join(c for c in str(rule) if c.isprintable())

    @property
    def is_mean(self) -> bool:
        """Whether a pixel is a mean, over samples or over the channels of a tint: then optical
        depth and transmittance are not each other's exponential."""
        samples = self.job.get("camera", {}).get("samples", 1)
        return self.through.ndim == 3 or samples != 1

    @property
    def density_scale(self) -> float | None:
        """The density scale that the image was rendered with, if it says so."""
        scale = self.job.get("density", {}).get("scale")
        try:
            known = isinstance(scale, int | float) and math.isfinite(scale)
        except OverflowError:  # a whole number beyond all
            return None
        return float(scale) if known else None


def read_maps(path: str | os.PathLike[str]) -> Maps:
    """The maps of an EXR of volcli, of a map that volcli wrote, or of any image with alpha.

    Raises
    ------
    UsageError
        The file cannot be read, or has neither alpha nor a map that tells of opacity.
    """
    stored = read_channels(path)
    if MAP_HEADER in stored.attributes:
        return _of_one_map(stored, str(stored.attributes[MAP_HEADER]))
    alpha = stored.find("A", "alpha", *(n for n in stored.planes if n.lower().endswith(".a")))
    tau, transmittance = (_layer(stored, name) for name in ("optical_depth", "transmittance"))
    covered = alpha is None or bool((alpha >= 1 - SAME).all())
    source: dict[str, str] = {}
    if alpha is not None and not (covered and (tau is not None or transmittance is not None)):
        opacity, source["opacity"] = alpha, "alpha"
    elif transmittance is not None:  # alpha is that of the background
        opacity, source["opacity"] = 1 - _mean(transmittance), "1 - transmittance"
        exact = None if tau is None else _opacity_of(_mean(tau))
        if exact is not None and float(np.abs(exact - opacity).max(initial=0)) < SAME:
            opacity, source["opacity"] = exact, "1 - exp(-optical depth)"
    elif tau is not None:
        opacity, source["opacity"] = _opacity_of(_mean(tau)), "1 - exp(-optical depth)"
    elif stored.file_format == "png" and stored.find("R") is not None:
        # volcli leaves alpha out of a PNG whose every pixel is opaque.
        opacity = np.ones(stored.size[::-1], np.float32)
        source["opacity"] = NO_ALPHA
    else:
        raise UsageError(
            f"{stored.path}: no alpha, and no layer of volcli's; it has: "
            f"{', '.join(stored.planes)}; render an .exr, or an image with alpha"
        )
    layers = {name: stored.find(f"{name}.Y") for name in ERRORS}
    errors = {name: layer for name, layer in layers.items() if layer is not None}
    source |= {name: f"layer {name}" for name in errors}
    maps = _completed(stored, opacity, transmittance, tau, stored.find("Z"), source)
    return replace(maps, errors=errors)


def job_of_picture(path: os.PathLike[str]) -> dict[str, Any]:
    """The tables of the job in the header of a picture that volcli rendered.

    Raises
    ------
    UsageError
        The file cannot be read, or its header holds no job.
    """
    stored = read_channels(path)
    text = stored.attributes.get(JOB_HEADER)
    if not text:
        raise UsageError(f"{path}: its header holds no job; give the volume, or a job file")
    try:
        return parse_toml(str(text))
    except ValueError as error:
        raise UsageError(f"{path}: the job in its header is damaged: {error}") from error


def _layer(stored: Channels, name: str) -> Floats | None:
    """A layer of volcli's: (h, w), or (h, w, 3) under a tint; None where there is none."""
    plain = stored.find(f"{name}.Y")
    if plain is not None:
        return plain
    channels = [stored.find(f"{name}.{c}") for c in "RGB"]
    if any(c is None for c in channels):
        return None
    return np.stack(channels, axis=-1)  # type: ignore[arg-type]


def _mean(layer: Floats) -> Floats:
    """(h, w): the mean over channels where there are three."""
    return layer if layer.ndim == 2 else layer.mean(axis=-1, dtype=np.float64).astype(np.float32)


def _completed(
    stored: Channels,
    opacity: Floats,
    transmittance: Floats | None,
    tau: Floats | None,
    depth: Floats | None,
    source: dict[str, str],
) -> Maps:
    """Fill in what follows from opacity."""
    if transmittance is None:
        transmittance, source["transmittance"] = 1 - opacity, "1 - opacity"
    else:
        source["transmittance"] = "layer transmittance"
    if tau is None:
        tau, source["optical_depth"] = _depth_of(opacity), "-log(1 - opacity)"
    else:
        source["optical_depth"] = "layer optical_depth"
    if depth is not None:
        source["depth"] = "channel Z"
    return Maps(stored, opacity, _mean(transmittance), _mean(tau), depth, transmittance, source)


def _of_one_map(stored: Channels, name: str) -> Maps:
    """The maps that one map of volcli's tells; a PNG's values are scaled back."""
    values = _map_values(stored)
    if name == "opacity":
        maps = _completed(stored, values, None, None, None, {"opacity": "the map"})
    elif name == "transmittance":
        maps = _completed(stored, 1 - values, values, None, None, {"opacity": "1 - the map"})
        maps.source["transmittance"] = "the map"
    elif name == "optical_depth":
        opacity = _opacity_of(values)
        maps = _completed(stored, opacity, None, values, None, {"opacity": "1 - exp(-the map)"})
        maps.source["optical_depth"] = "the map"
    else:
        raise UsageError(
            f"{stored.path}: is a map of {name}, which does not tell the opacity; inspect the "
            f"picture, or a map of opacity, transmittance or optical_depth"
        )
    return maps


def values_of_map(stored: Channels) -> tuple[str, Floats] | None:
    """The name and the values of a file that is one map of volcli's; None of any other file."""
    if MAP_HEADER not in stored.attributes:
        return None
    return str(stored.attributes[MAP_HEADER]), _map_values(stored)


def _map_values(stored: Channels) -> Floats:
    """(h, w): the values of a map; those of a PNG scaled back, the mean of those of a tint."""
    low = float(stored.attributes.get("volcli:map_lo", 0.0))
    high = float(stored.attributes.get("volcli:map_hi", 1.0))
    values = _mean(np.stack(list(stored.planes.values()), axis=-1))
    if (low, high) != (0.0, 1.0):
        values = (low + values * np.float64(high - low)).astype(np.float32)
    return values


def _opacity_of(tau: Floats) -> Floats:
    """1 - exp(-tau), as -expm1(-tau): 1 - exp loses all digits where tau is small."""
    opacity = np.negative(tau)
    with np.errstate(over="ignore", invalid="ignore"):
        np.expm1(opacity, out=opacity)
    return np.negative(opacity, out=opacity)


def _depth_of(opacity: Floats) -> Floats:
    """-log(1 - opacity), +Inf where opacity is 1 or more, NaN where it is NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return -np.log1p(-np.minimum(opacity, 1))
