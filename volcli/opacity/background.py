"""Another background behind a picture that is already rendered: C = C_volume + T c_background.

An EXR of volcli holds the volume's transmittance beside the picture, so the light that came through
from the old background can be taken away again.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import UsageError
from volcli.images import linear_from_srgb, read_background, write_exr, write_png
from volcli.opacity.maps import NO_ALPHA, Floats, Maps, read_maps

Background = tuple[float, float, float] | Path | str
"""A linear colour, an image, or ``transparent``."""


def radiance_of(maps: Maps) -> Floats | None:
    """(h, w, 3): the light of the volume alone, premultiplied and linear; None without colour.

    Where a background was rendered, it is taken away: what the header's job names, times the
    transmittance.

    Raises
    ------
    UsageError
        The background was an image that can no longer be read.
    """
    planes = [maps.stored.find(name) for name in "RGB"]
    if any(plane is None for plane in planes):
        return None
    colour = np.stack(planes, axis=-1)  # type: ignore[arg-type]
    if not maps.stored.associated:
        return (linear_from_srgb(colour) * maps.opacity[..., None]).astype(np.float32)
    behind = _rendered_background(maps)
    if behind is None:
        return colour
    return colour - _channels(maps.through) * behind[..., :3]


def recomposite(maps: Maps, background: NDArray[np.float32] | None) -> Floats:
    """(h, w, 4): the picture before another background, premultiplied and linear.

    Parameters
    ----------
    background
        (4,) or (h, w, 4), premultiplied and linear; None: nothing is behind the volume.

    Raises
    ------
    UsageError
        The image has no colour or no transparency left, or its background was an image that can no
        longer be read.
    """
    if maps.source["opacity"] == NO_ALPHA:
        raise UsageError(
            f"{maps.stored.path}: has no alpha, so nothing of what is behind can be changed; "
            f"render an .exr"
        )
    radiance = radiance_of(maps)
    if radiance is None:
        raise UsageError(f"{maps.stored.path}: has no channels R, G and B to put before another")
    picture = np.dstack([radiance, maps.opacity])
    if background is not None:
        behind = np.asarray(background, np.float32)
        picture[..., :3] += _channels(maps.through) * behind[..., :3]
        picture[..., 3] += maps.transmittance * behind[..., 3]
    return picture


def _channels(through: Floats) -> Floats:
    """(h, w, 1) or (h, w, 3)."""
    return through[..., None] if through.ndim == 2 else through


def behind_of(background: Background, size: tuple[int, int]) -> NDArray[np.float32] | None:
    """A background as premultiplied, linear colour: (4,), (h, w, 4), or None for ``transparent``.

    Raises
    ------
    UsageError
        An image cannot be read.
    """
    if background == "transparent":
        return None
    if isinstance(background, tuple):
        return np.array([*background, 1.0], np.float32)
    return read_background(background, size)


def write_recomposite(
    image: Path, output: Path, background: Background, *, bits: int = 8, overwrite: bool = True
) -> list[str]:
    """Read an image, put another background behind it, and write it; returns warnings.

    An EXR keeps every other channel and the header, whose job names the new background, so that
    this too can be taken away again.

    Raises
    ------
    UsageError, OutputError, NonFiniteError
        See `recomposite`; the result cannot be written, or PNG cannot hold it.
    """
    import tomli_w

    maps = read_maps(image)
    picture = recomposite(maps, behind_of(background, maps.stored.size))
    job: dict[str, Any] = {**maps.job, "background": _as_table(background)}
    header = {k: v for k, v in maps.stored.attributes.items() if k.startswith("volcli:")}
    header |= {"Software": "volcli", "volcli:job": tomli_w.dumps(job)}
    if output.suffix.lower() == ".png":
        return write_png(output, picture, header, bits=bits, overwrite=overwrite)
    channels = {c: picture[..., i] for i, c in enumerate("RGBA")}
    kept = {n: plane for n, plane in maps.stored.planes.items() if n not in channels}
    if not any(name.startswith("transmittance.") for name in kept):
        kept["transmittance.Y"] = maps.transmittance
    write_exr(output, channels | kept, header, overwrite=overwrite)
    return []


def _as_table(background: Background) -> dict[str, Any]:
    """A background as the table of a job."""
    if background == "transparent":
        return {}
    if isinstance(background, tuple):
        return {"color": list(background)}
    return {"image": str(Path(background).absolute())}


def _rendered_background(maps: Maps) -> Floats | None:
    """(4,) or (h, w, 4): what the picture was rendered over; None: nothing."""
    wanted = maps.job.get("background", {})
    if "color" in wanted:
        with suppress(TypeError, ValueError, OverflowError):  # the header may hold anything
            color = np.array([*wanted["color"], 1.0], np.float32)
            if color.shape == (4,) and np.isfinite(color).all():
                return color
        raise UsageError(
            f"{maps.stored.path}: the job in its header is damaged: background.color is no colour"
        )
    if "image" not in wanted:
        return None
    try:
        return read_background(Path(str(wanted["image"])), maps.stored.size)
    except UsageError as error:
        raise UsageError(
            f"{maps.stored.path}: was rendered over {wanted['image']}, which is needed to take "
            f"that away: {error}"
        ) from error
