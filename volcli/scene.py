"""From a job and its plan to a `Scene`: volumes opened, the grids of the plan read, tables made.

What is read is what the plan names, a grid that several terms use once. Nothing here renders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from volcli.bounds import scene_bounds
from volcli.grids import (
    BrickGrid,
    Cache,
    GridHeader,
    Progress,
    Volume,
    density_of_source,
    empty_grid,
    load_density,
    load_source,
    open_volume,
)
from volcli.plan import Plan
from volcli.render import Scene, Source
from volcli.schema import Job
from volcli.sources import Color, Emission
from volcli.tables import ColorTable, source_table, transfer_table

DIM = 0.01
"""Emission outside its voxels is worth a warning from this part of the brightest on."""


@dataclass(frozen=True)
class Volumes:
    """The files of a job's density, colour and emission: most often one."""

    density: Volume
    color: Volume
    emission: Volume


@dataclass(frozen=True)
class Grids:
    """The grids of a plan; one that is of use twice is one object."""

    density: BrickGrid
    color: BrickGrid | None
    emission: BrickGrid | None


def open_volumes(job: Job) -> Volumes:
    """Open what a job names: headers alone.

    Raises
    ------
    VolumeError
        A file is missing, or is no volume.
    """
    assert job.density.file is not None, "checked before"
    density = open_volume(job.density.file, job.density.reader)
    opened = {job.density.file.resolve(): density}
    for part in (job.color, job.emission):
        if part.file is not None and part.file.resolve() not in opened:
            opened[part.file.resolve()] = open_volume(part.file, job.density.reader)
    color, emission = (
        density if part.file is None else opened[part.file.resolve()]
        for part in (job.color, job.emission)
    )
    return Volumes(density, color, emission)


def read_grids(
    job: Job,
    plan: Plan,
    volumes: Volumes,
    progress: Callable[[GridHeader], Progress] = lambda header: lambda done, total: None,
    cache: Cache | None = None,
) -> tuple[Grids, list[str]]:
    """Read the grids that a plan names, with warnings on what was changed in their values.

    A grid that is a source and the density too is read once, as a source: see `density_of_source`.
    (Not a level set, which as fog is another grid.)

    Parameters
    ----------
    progress
        Gives what is called while a grid is read.
    cache
        What keeps bricks from one load to the next.

    Raises
    ------
    VolumeError
        A file is damaged, or holds NaN or Inf where the job does not accept them.
    """
    warnings: list[str] = []
    read: dict[tuple[Path, str], BrickGrid] = {}
    transfer = None if job.density.ramp is None else transfer_table(job.density.ramp).at

    def source(volume: Volume, header: GridHeader) -> BrickGrid:
        key = (volume.path, header.label)
        if key not in read:
            read[key], notes = load_source(
                volume, header, job.density.nonfinite, progress(header), cache
            )
            warnings.extend(notes)
        return read[key]

    sources = [
        (volume.path, header.label)
        for volume, header in ((volumes.color, plan.color), (volumes.emission, plan.emission))
        if header is not None
    ]
    if plan.density is None:
        assert plan.emission is not None, "a job without both is refused"
        density = empty_grid(plan.emission)
    elif not plan.level_set and (volumes.density.path, plan.density.label) in sources:
        grid = source(volumes.density, plan.density)
        density, notes = density_of_source(grid, volumes.density, plan.density, transfer)
        warnings += notes
    else:
        density, notes = load_density(
            volumes.density,
            plan.density,
            job.density.nonfinite,
            progress(plan.density),
            cache,
            level_set=plan.level_set,
            transfer=transfer,
        )
        warnings += notes
        if plan.level_set and density.is_empty:
            warnings.append(
                f"{volumes.density.path}: grid '{plan.density.label}' is nowhere below 0, and so "
                f"has no inside; density.level_set is for distances to a surface"
            )
    color = None if plan.color is None else source(volumes.color, plan.color)
    emission = None if plan.emission is None else source(volumes.emission, plan.emission)
    return Grids(density, color, emission), list(dict.fromkeys(warnings))


def make_scene(
    job: Job,
    plan: Plan,
    volumes: Volumes,
    grids: Grids,
    table: Callable[..., ColorTable] = source_table,
    threads: int | None = None,
) -> tuple[Scene, list[str]]:
    """The scene of a job, and warnings on what it shows.

    Parameters
    ----------
    table
        Makes the colours of a scalar grid's values; see `tables.source_table`.
    threads
        That make the bounds of grids, where the plan allows an error. Default: the processors that
        this process may use.

    Raises
    ------
    UsageError, VolumeError
        A ramp without a range, or a temperature below 0 K.
    """
    color: Source | tuple[float, float, float] = job.color.value
    emission, notes = None, []
    if grids.color is not None and plan.color is not None:
        where = f"{volumes.color.path}: grid '{plan.color.label}'"
        color = _source(job.color, "color", grids.color, where, table)
    if grids.emission is not None and plan.emission is not None:
        where = f"{volumes.emission.path}: grid '{plan.emission.label}'"
        emission = _source(job.emission, "emission", grids.emission, where, table)
        notes = _outside(emission, where)
    scene = Scene(
        density=grids.density,
        scale=job.density.scale,
        color=color,
        emission=emission,
        tint=job.density.tint if plan.tint else None,
        transfer=None if job.density.ramp is None else transfer_table(job.density.ramp),
    )
    if plan.max_error is not None:
        scene = replace(scene, bounds=scene_bounds(scene, plan.nearest, threads))
    return scene, notes


def scene_box(scene: Scene) -> NDArray[np.float64] | None:
    """(2, 3) world units: the box around what absorbs and what emits; None where there is none."""
    grids = [scene.density, *([] if scene.emission is None else [scene.emission.grid])]
    boxes = [grid.world_box() for grid in grids if not grid.is_empty]
    if not boxes:
        return None
    return np.array([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])


def _source(
    part: Color | Emission,
    name: str,
    grid: BrickGrid,
    where: str,
    table: Callable[..., ColorTable],
) -> Source:
    if grid.arrays.atlas.ndim == 3:
        return Source(grid, None, part.strength)
    active = grid.active_range
    assert active is not None, "sources are loaded with it"
    if active[0] == active[1]:  # a mask is 1 wherever it is active: then its outside counts
        outside = float(grid.background)
        active = min(active[0], outside), max(active[1], outside)
    return Source(grid, table(part, name, active, grid.field_range, where))


def _outside(emission: Source, where: str) -> list[str]:
    """A warning where emission would fill all space, were it not cut."""
    value = emission.grid.background
    if emission.table is None:
        outside, brightest = float(np.abs(value).max()), emission.grid.brightest
    else:
        outside = float(emission.table.at(value).max())
        brightest = float(emission.table.colors.max())
    if outside <= DIM * brightest:
        return []
    return [f"{where}: emits outside its voxels too; cut at its active box"]
