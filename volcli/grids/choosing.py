"""Which grid of a volume a job means, by its name and by what it is to be: density or source.

Looks at headers alone.
"""

from __future__ import annotations

import difflib

from volcli.errors import VolumeError
from volcli.grids.tree import GridHeader, Volume

DENSITY = "density"
"""The name by which a file says which of its grids is the density."""

LEVEL_SET = "level set"
"""The class of grids that hold distances to a surface."""


def density_grid(
    volume: Volume, name: str | None, level_set: bool = False
) -> tuple[GridHeader, list[str]]:
    """The grid that is the density, and what the user should know of the choice.

    Without a name it is the grid named ``density``, else the only scalar grid there is.

    Parameters
    ----------
    level_set
        Whether a level set will do, to be taken as fog.

    Raises
    ------
    VolumeError
        If there is no such grid, the choice is not clear, or the grid cannot be a density.
    """
    notes: list[str] = []
    if name is not None or any(h.name == DENSITY for h in volume.headers):
        header = _named(volume, name or DENSITY, "scalar", "", notes)
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
    if header.grid_class == LEVEL_SET and not level_set:
        raise VolumeError(
            f"{volume.path}: grid '{header.label}' is a level set (distances to a surface), not a "
            f"fog volume; take it as fog with --set density.level_set=fog, or {instead}"
        )
    return header, notes


def source_grid(volume: Volume, name: str, kind: str, key: str) -> tuple[GridHeader, list[str]]:
    """The grid of a source of light, and what the user should know of the choice.

    Parameters
    ----------
    kind
        What it must be: ``vec3``, ``scalar``, or ``any``.
    key
        The field of the job that names it, for messages: ``color.ramp.grid``.

    Raises
    ------
    VolumeError
        If there is no such grid, or it is of another kind.
    """
    notes: list[str] = []
    header = _named(volume, name, kind, f" for {key}", notes)
    _must_read(volume, header)
    if kind == "any" or header.is_vector == (kind == "vec3"):
        return header, notes
    fit = [h.label for h in volume.headers if _fits(h, kind)]
    if fit:
        instead = f"choose another{' with --color-grid' * (key == 'color.grid')}: {', '.join(fit)}"
    else:
        instead = "there is none in the file"
        if key == "color.grid":
            instead += "; give one colour with --color R,G,B, or a colour by value (color.ramp)"
    raise VolumeError(
        f"{volume.path}: grid '{header.label}' is {header.value_type}, and {key} is {kind}; "
        f"{instead}"
    )


def _named(volume: Volume, name: str, kind: str, use: str, notes: list[str]) -> GridHeader:
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
    labels = {h.label.lower(): h.label for h in volume.headers if _fits(h, kind)}
    close = difflib.get_close_matches(name.lower(), labels, n=1, cutoff=0.5)
    meant = f"; did you mean '{labels[close[0]]}'?" if close else ""
    what = "grid" if kind == "any" else f"{kind} grid"
    raise VolumeError(f"{volume.path}: no {what} '{name}'{use}; it has: {_listed(volume)}{meant}")


def _fits(header: GridHeader, kind: str) -> bool:
    return header.refusal is None and (kind == "any" or header.is_vector == (kind == "vec3"))


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
