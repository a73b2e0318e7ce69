"""What a job writes: the names of its files, and a rendered picture into them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from volcli import images
from volcli.render import RenderResult, over
from volcli.schema import Job


def outputs(job: Job) -> dict[str, Path]:
    """What the job writes: the picture and, beside it, ``<stem>.<map>.<ext>``; may be nothing."""
    picture = job.output.image
    if picture is None:
        return {}
    files = {"picture": picture}
    for name in job.output.maps:
        files[name] = picture.with_name(f"{picture.stem}.{name}{picture.suffix}")
    return files


def write_outputs(
    files: Mapping[str, Path],
    result: RenderResult,
    background: Any,
    header: Mapping[str, str | int | float],
    *,
    bits: int,
    overwrite: bool,
    on_stage: Callable[[str, int, int], None],
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Write the picture and the maps.

    Parameters
    ----------
    files
        As `outputs` names them.
    background
        What is behind the volume; see `render.over`.
    header
        What is written into each file.
    bits
        Of a channel of a PNG picture.
    on_stage
        Told of the files as they are written.

    Returns
    -------
    What was written of each map, and warnings.

    Raises
    ------
    OutputError, NonFiniteError
        A file cannot be written, or cannot hold what there is.
    """
    layers = {
        "transmittance": result.transmittance,
        "opacity": result.opacity,
        "optical_depth": result.optical_depth,
        "depth": result.depth,
        "error_bound": result.error_bound,
        "error_estimate": result.error_estimate,
    }
    warnings: list[str] = []
    maps: dict[str, dict[str, Any]] = {}
    for done, (name, path) in enumerate(files.items()):
        on_stage("writing", done, len(files))
        if name != "picture":
            values = layers[name]
            assert values is not None, "the plan evaluates what is written"
            low, high = images.write_map(path, values, header, name=name, overwrite=overwrite)
            maps[name] = {"file": str(path)}
            if path.suffix.lower() == ".png":
                maps[name] |= {"black": low, "white": high}
            continue
        picture = over(result, background)
        if path.suffix.lower() == ".png":
            warnings += images.write_png(path, picture, header, bits=bits, overwrite=overwrite)
        else:
            _write_exr(path, result, picture, header, overwrite)
    on_stage("writing", len(files), len(files))
    return maps, warnings


def _write_exr(
    path: Path,
    result: RenderResult,
    picture: Any,
    header: Mapping[str, str | int | float],
    overwrite: bool,
) -> None:
    """A picture with everything that is known of its pixels."""
    channels = {c: picture[..., i] for i, c in enumerate("RGBA")}
    assert result.depth is not None, "the plan evaluates depth for an EXR"
    channels["Z"] = result.depth
    channels |= images.layer_channels("transmittance", result.transmittance)
    channels |= images.layer_channels("optical_depth", result.optical_depth)
    if result.error_bound is not None:
        channels |= images.layer_channels("error_bound", result.error_bound)
    if result.error_estimate is not None:
        channels |= images.layer_channels("error_estimate", result.error_estimate)
    images.write_exr(path, channels, header, overwrite=overwrite)
