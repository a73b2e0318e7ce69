"""Volume files in, `BrickGrid`s out: opening a file by its kind, and choosing and reading a grid.

open_volume(path)          a `Volume`: headers are read, voxels are not
density_grid, color_grid   which grid a job means
load_density, load_color   that grid as bricks, fit to be rendered
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from pathlib import Path

from volcli.errors import VolumeError
from volcli.grids.brick import BrickGrid
from volcli.grids.build import build
from volcli.grids.tree import GridHeader, Progress, Tree, Volume
from volcli.grids.values import clamp_negative, settle_nonfinite

__all__ = [
    "BrickGrid",
    "GridHeader",
    "Progress",
    "Tree",
    "Volume",
    "color_grid",
    "density_grid",
    "load_color",
    "load_density",
    "open_volume",
]

DENSITY = "density"
"""The name by which a file says which of its grids is the density."""

_Reading = Callable[[Volume, GridHeader, str, Progress | None], tuple[BrickGrid, list[str]]]

LEVEL_SET = "level set"
"""The class of grids that hold distances to a surface."""


def open_volume(path: Path, reader: str = "volcli") -> Volume:
    """Open a volume file: header and metadata only.

    Parameters
    ----------
    path
        ``.vdb``, ``.npy`` or ``.npz``; a file with another ending is looked into.
    reader
        ``volcli`` or ``openvdb``; of use for ``.vdb`` alone.

    Raises
    ------
    VolumeError
        If there is no such file, or it is no volume.
    """
    if path.is_dir():
        raise VolumeError(f"{path}: is a folder; give a volume file (.vdb, .npy or .npz)")
    try:
        with path.open("rb") as file:
            start = file.read(8)
    except FileNotFoundError as error:
        raise VolumeError(f"{path}: no such file{_nearby(path)}") from error
    except OSError as error:
        raise VolumeError(f"{path}: cannot be read: {error.strerror or error}") from error
    if path.suffix.lower() in (".npy", ".npz"):
        from volcli.grids.dense import open_dense

        return open_dense(path)
    if start.startswith(b"NanoVDB"):
        raise VolumeError(
            f"{path}: is a NanoVDB file; volcli reads OpenVDB: convert it with nanovdb_convert"
        )
    if path.suffix.lower() != ".vdb" and not start.startswith(b" BDV"):
        raise VolumeError(f"{path}: is not a volume; volcli reads .vdb, .npy and .npz")
    if reader == "openvdb":
        from volcli.grids.pyopenvdb import open_openvdb

        return open_openvdb(path)
    from volcli.grids.vdb import open_vdb

    return open_vdb(path)


def density_grid(volume: Volume, name: str | None) -> tuple[GridHeader, list[str]]:
    """The grid that is the density, and what the user should know of the choice.

    Without a name it is the grid named ``density``, else the only scalar grid there is.

    Raises
    ------
    VolumeError
        If there is no such grid, the choice is not clear, or the grid cannot be a density.
    """
    notes: list[str] = []
    if name is not None or any(h.name == DENSITY for h in volume.headers):
        header = _named(volume, name or DENSITY, "scalar", notes)
    else:
        scalars = [h for h in volume.headers if not h.is_vector and h.refusal is None]
        if len(volume.headers) == 1 or len(scalars) == 1:
            header = scalars[0] if scalars else volume.headers[0]
            notes.append(f"{volume.path}: no grid named 'density'; rendering '{header.label}'")
        elif scalars:
            raise VolumeError(
                f"{volume.path}: no grid named 'density', and {len(scalars)} scalar grids; choose "
                f"one with --grid; it has: {_listed(volume)}"
            )
        else:
            raise VolumeError(f"{volume.path}: no scalar grid to render; it has: {_listed(volume)}")
    _must_read(volume, header)
    others = [h for h in volume.headers if _may_be_density(h) and h is not header]
    instead = (
        f"choose another with --grid: {', '.join(h.label for h in others)}"
        if others
        else "give a volume with a fog density"
    )
    if header.is_vector:
        raise VolumeError(
            f"{volume.path}: grid '{header.label}' is {header.value_type}, and a density is a "
            f"scalar; {instead}"
        )
    if header.grid_class == LEVEL_SET:
        raise VolumeError(
            f"{volume.path}: grid '{header.label}' is a level set (distances to a surface), not a "
            f"fog volume; convert it with OpenVDB's sdfToFogVolume or Houdini's Convert VDB, or "
            f"{instead}"
        )
    return header, notes


def color_grid(volume: Volume, name: str) -> tuple[GridHeader, list[str]]:
    """The grid that is the colour, and what the user should know of the choice.

    Raises
    ------
    VolumeError
        If there is no such grid, or it is not a grid of three components.
    """
    notes: list[str] = []
    header = _named(volume, name, "vec3", notes)
    _must_read(volume, header)
    if not header.is_vector:
        vectors = [h.label for h in volume.headers if h.is_vector and h.refusal is None]
        instead = (
            f"choose another with --color-grid: {', '.join(vectors)}"
            if vectors
            else "there is none in the file; give one colour with --color R,G,B"
        )
        raise VolumeError(
            f"{volume.path}: grid '{header.label}' is {header.value_type}, and a colour is vec3; "
            f"{instead}"
        )
    return header, notes


def load_density(
    volume: Volume,
    header: GridHeader,
    nonfinite: str,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> tuple[BrickGrid, list[str]]:
    """Read a grid as a density (values below 0 become 0), with warnings on what was changed.

    Parameters
    ----------
    nonfinite
        What NaN and Inf are: ``error``, or ``zero``.
    cache
        A folder that keeps bricks from one load to the next.

    Raises
    ------
    VolumeError
        If the file is damaged, or holds NaN or Inf and ``nonfinite`` is ``error``.
    """
    return _load(_read_density, volume, header, nonfinite, progress, cache)


def load_color(
    volume: Volume,
    header: GridHeader,
    nonfinite: str,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> tuple[BrickGrid, list[str]]:
    """Read a grid as a colour. Values below 0 are kept; the model is linear in them.

    Parameters, and what is raised, are those of `load_density`.
    """
    return _load(_read_color, volume, header, nonfinite, progress, cache)


def _load(
    read: _Reading,
    volume: Volume,
    header: GridHeader,
    nonfinite: str,
    progress: Progress | None,
    cache: Path | None,
) -> tuple[BrickGrid, list[str]]:
    """A grid by way of the cache, if there is one."""
    if cache is None:
        return read(volume, header, nonfinite, progress)
    from volcli.grids.cache import through_cache

    settings = (type(volume).__name__, read.__name__, nonfinite)
    return through_cache(
        cache,
        volume.path,
        header.label,
        settings,
        lambda: read(volume, header, nonfinite, progress),
    )


def _read_density(
    volume: Volume, header: GridHeader, nonfinite: str, progress: Progress | None
) -> tuple[BrickGrid, list[str]]:
    where = f"{volume.path}: grid '{header.label}'"
    tree, notes = settle_nonfinite(volume.read_tree(header, progress), where, nonfinite)
    tree, clamped = clamp_negative(tree, where)
    grid = build(tree, header)
    if grid.is_empty:
        clamped.append(f"{where}: is empty; there is nothing to see but the background")
    elif float(grid.background) > 0:
        clamped.append(
            f"{where}: is {float(grid.background):g} outside its voxels; cut at its active box"
        )
    return grid, notes + clamped


def _read_color(
    volume: Volume, header: GridHeader, nonfinite: str, progress: Progress | None
) -> tuple[BrickGrid, list[str]]:
    where = f"{volume.path}: grid '{header.label}'"
    tree, notes = settle_nonfinite(volume.read_tree(header, progress), where, nonfinite)
    return build(tree, header), notes


def _named(volume: Volume, name: str, kind: str, notes: list[str]) -> GridHeader:
    """The grid of that label; of several grids of one name the first, with a note."""
    for header in volume.headers:
        if header.label == name:
            return header
    same = [h for h in volume.headers if h.name == name]
    if same:
        others = ", ".join(h.label for h in same[1:])
        notes.append(
            f"{volume.path}: {len(same)} grids are named '{name}'; taking '{same[0].label}' "
            f"(there is also {others})"
        )
        return same[0]
    fit = [h for h in volume.headers if h.is_vector == (kind == "vec3") and h.refusal is None]
    labels = {h.label.lower(): h.label for h in fit}
    close = difflib.get_close_matches(name.lower(), labels, n=1, cutoff=0.5)
    meant = f"; did you mean '{labels[close[0]]}'?" if close else ""
    raise VolumeError(f"{volume.path}: no {kind} grid '{name}'; it has: {_listed(volume)}{meant}")


def _must_read(volume: Volume, header: GridHeader) -> None:
    if header.refusal is not None:
        others = [h.label for h in volume.headers if h.refusal is None]
        instead = f"the file also has: {', '.join(others)}" if others else "give another volume"
        raise VolumeError(
            f"{volume.path}: grid '{header.label}' cannot be rendered: {header.refusal}; {instead}"
        )


def _may_be_density(header: GridHeader) -> bool:
    return not header.is_vector and header.refusal is None and header.grid_class != LEVEL_SET


def _listed(volume: Volume) -> str:
    return ", ".join(f"{h.label} ({h.refusal or h.value_type})" for h in volume.headers) or (
        "no grids"
    )


def _nearby(path: Path) -> str:
    """A hint at a file of a similar name in the same folder."""
    try:
        names = [p.name for p in path.parent.iterdir() if p.is_file()]
    except OSError:
        return ""
    close = difflib.get_close_matches(path.name, names, n=1, cutoff=0.7)
    return f"; did you mean {path.parent / close[0]}?" if close else ""
