"""Which terms a picture needs: a job and the headers of a volume in, a `Plan` out.

A term that is out costs nothing: its grid is never read and the kernels are compiled without it.
Nothing here reads a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

from volcli.grids import GridHeader, Volume, color_grid, density_grid
from volcli.schema import Job


@dataclass(frozen=True)
class Term:
    """One line of the plan.

    Attributes
    ----------
    name, wanted, why
        The term, whether it is evaluated, and the reason.
    grid
        The label of the grid that it reads, or None.
    """

    name: str
    wanted: bool
    why: str
    grid: str | None = None


@dataclass(frozen=True)
class Plan:
    """What is read and evaluated.

    Attributes
    ----------
    density, color
        The grids to read; ``color`` is None where the colour is a constant or not needed.
    depth
        Whether the expected hit distance is evaluated.
    step_voxels
        The midpoint rule's step, or None for the exact rule.
    nearest
        Whether values are those of the nearest voxel.
    terms
        The same for people.
    warnings
        What the user should know of the choices made.
    """

    density: GridHeader
    color: GridHeader | None
    depth: bool
    step_voxels: float | None
    nearest: bool
    terms: tuple[Term, ...]
    warnings: tuple[str, ...]

    @property
    def rule(self) -> str:
        """The rule of integration, for people: ``exact``, ``midpoint 0.5``."""
        return "exact" if self.step_voxels is None else f"midpoint {self.step_voxels:g}"


def make_plan(job: Job, volume: Volume, layers: frozenset[str]) -> Plan:
    """Work out what a job needs of a volume.

    Parameters
    ----------
    layers
        What will be written: of ``picture``, ``transmittance``, ``opacity``, ``optical_depth``,
        ``depth``.

    Raises
    ------
    VolumeError
        If the volume has no grid such as the job asks for.
    """
    density, warnings = density_grid(volume, job.density.grid)
    color = None
    if job.color.grid is not None and "picture" in layers:
        color, notes = color_grid(volume, job.color.grid)
        warnings += notes
    depth = "depth" in layers
    return Plan(
        density=density,
        color=color,
        depth=depth,
        step_voxels=job.quadrature.step_voxels,
        nearest=job.density.interpolation == "nearest",
        terms=tuple(_terms(job, density, color, layers)),
        warnings=tuple(warnings),
    )


def _terms(
    job: Job, density: GridHeader, color: GridHeader | None, layers: frozenset[str]
) -> list[Term]:
    step = job.quadrature.step_voxels
    how = "a cubic in each cell, exact" if step is None else f"sampled every {step:g} voxels"
    if job.density.interpolation == "nearest":
        how = how.replace("a cubic", "a constant")
    terms = [Term("optical depth", True, f"every picture needs it: {how}", density.label)]
    if job.color.grid is None:
        why = "C = c (1 - T) in closed form; no samples"
        terms.append(Term("constant colour", "picture" in layers, why))
    elif color is None:
        terms.append(Term("colour grid", False, "no picture is written", job.color.grid))
    else:
        terms.append(Term("colour grid", True, "color.grid is set", color.label))
    if "depth" in layers:
        terms.append(Term("hit depth", True, "Z of an EXR, or the map, asks for it"))
    else:
        terms.append(Term("hit depth", False, "no EXR and no depth map is written"))
    if job.background.color is not None:
        terms.append(Term("background", True, "one colour"))
    elif job.background.image is not None:
        terms.append(Term("background", True, f"image {job.background.image.name}"))
    else:
        terms.append(Term("background", False, "transparent"))
    return terms
