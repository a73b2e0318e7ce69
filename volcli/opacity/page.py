"""One HTML file to look at images with: it needs no network and nothing beside it.

The markup, the style and the script are the three files ``page.*`` beside this module. Here they
are put together with the data of the images: planes of numbers, not pictures of them, so that the
page shows the value under the cursor and puts the volume before any background.

A plane is packed so that it shrinks by half: the bytes of all numbers apart, first those of lowest
order, each less the one before (modulo 256), deflated by zlib, in base64. Optical depth and depth
are float32; colour is float16, premultiplied and linear, without its background. Transmittance and
opacity follow from optical depth, or are planes of their own where they do not.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.files import write_file
from volcli.opacity.background import radiance_of
from volcli.opacity.colormap import shades
from volcli.opacity.maps import Maps

COLORMAPS = ("viridis", "magma", "inferno", "cividis", "turbo", "gray")
"""Those that the page offers; one that is asked for joins them."""

_LEVEL = 4  # of zlib: the next ones take twice the time for 2 %
_LARGEST_HALF = 65504.0


def write_page(
    path: Path, images: Sequence[Maps], *, colormap: str = "viridis", overwrite: bool = True
) -> None:
    """Write a page that shows images; of several, two at a time with a wipe between them.

    Raises
    ------
    UsageError
        The images differ in size.
    OutputError
        The file cannot be written.
    """
    first = images[0]
    for other in images[1:]:
        if other.stored.size != first.stored.size:
            raise UsageError(
                f"{other.stored.path}: is {_size(other)}, and {first.stored.path} {_size(first)}; "
                f"a page shows images of one size"
            )
    names = list(dict.fromkeys((colormap, *COLORMAPS)))
    width, height = first.stored.size
    data = {
        "width": width,
        "height": height,
        "colormaps": {name: _text(shades(name).tobytes()) for name in names},
        "images": [_image(maps) for maps in images],
    }
    title = ", ".join(maps.stored.path.name for maps in images)
    page = _part("html")
    for mark, text in (
        ("STYLE", _part("css")),
        ("SCRIPT", _part("js")),
        ("TITLE", _escaped(title)),
        # "</script>" in a file's name would end the data.
        ("DATA", json.dumps(data, allow_nan=False).replace("<", "\\u003c")),
    ):
        page = page.replace(f"/*{mark}*/", text)
    write_file(path, page.encode(), overwrite=overwrite)


def _image(maps: Maps) -> dict[str, Any]:
    """The packed planes of one image, and what the page says of it."""
    radiance = radiance_of(maps)
    planes = {"optical_depth": packed(maps.optical_depth)}
    if maps.is_mean:  # else both follow from optical depth
        planes["transmittance"] = packed(maps.transmittance)
        planes["opacity"] = packed(maps.opacity)
    if maps.through.ndim == 3:
        for i, name in enumerate(("through_red", "through_green", "through_blue")):
            planes[name] = packed(maps.through[..., i])
    if maps.depth is not None:
        planes["depth"] = packed(maps.depth)
    if radiance is not None:
        half = np.clip(radiance, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16)
        for i, name in enumerate(("red", "green", "blue")):
            planes[name] = packed(half[..., i])
    about = [maps.stored.path.name, f"{maps.stored.file_format}, {maps.stored.sample}"]
    if maps.rule is not None:
        about.append(f"rule {maps.rule}")
    if maps.density_scale is not None:
        about.append(f"density scale {maps.density_scale:g}")
    return {"name": maps.stored.path.name, "about": " · ".join(about), "planes": planes}


def packed(plane: NDArray[Any]) -> str:
    """A (h, w) plane of little-endian numbers as the page takes it; see the top of this module."""
    little = np.ascontiguousarray(plane, plane.dtype.newbyteorder("<"))
    by_order = little.view(np.uint8).reshape(-1, little.itemsize).T
    deltas = np.diff(by_order.reshape(-1), prepend=np.uint8(0))
    return _text(zlib.compress(deltas.tobytes(), _LEVEL))


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _part(kind: str) -> str:
    return files("volcli.opacity").joinpath(f"page.{kind}").read_text(encoding="utf-8")


def _size(maps: Maps) -> str:
    return "x".join(map(str, maps.stored.size))


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
