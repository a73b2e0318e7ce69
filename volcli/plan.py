"""Which terms a picture needs: a job and the headers of its volumes in, a `Plan` out.

A term that is out costs nothing: its grid is never read and the kernels are compiled without it.
Nothing here reads a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from volcli.errors import VolumeError
from volcli.grids import GridHeader, Volume, density_grid, source_grid
from volcli.schema import Job
from volcli.sources import Color, Emission

NODES = 4
"""Points of a cell at which a source that varies is evaluated, by the exact rule: Gauss nodes."""


@dataclass(frozen=True)
class Term:
    """One line of the plan.

    Attributes
    ----------
    name, wanted, why
        The term, whether it is evaluated, and the reason.
    grid
        The label of the grid that it reads, or None.
    bytes_read
        What the volume file holds of that grid, by the file's own offsets; 0 where another term
        reads it already; None where the file does not say.
    evaluations
        How often the term is evaluated in a cell (by the midpoint rule: in a step). A cell is cut
        in parts, each evaluated as often: where its optical depth is above 0.5
        (`kernels.cell.MAX_TAU`), unless that is all that is asked for; where planes of a source's
        own lattice cross it; where a value passes a stop of ``density.ramp``, or a kink of a table
        of colours.
    """

    name: str
    wanted: bool
    why: str
    grid: str | None = None
    bytes_read: int | None = 0
    evaluations: int = 0


@dataclass(frozen=True)
class Plan:
    """What is read and evaluated.

    Attributes
    ----------
    density, color, emission
        The grids to read. Density is None where nothing absorbs; color where the colour is a
        constant or not needed; emission where there is none.
    tint, transfer, level_set
        Whether extinction is by channel; whether density is a function of the grid's values;
        whether the grid is a level set, read as fog.
    depth
        Whether the expected hit distance is evaluated.
    step_voxels
        The midpoint rule's step, or None for the exact rule.
    max_error
        What the exact rule may be off by, to be certified; None: by nothing but rounding.
    target_error
        What the midpoint rule should be off by, where a pilot is still to choose its step
        (`volcli.calibrate`); None where there is nothing to choose.
    nearest
        Whether values are those of the nearest voxel.
    estimate
        Whether what the exact rule is off by is estimated.
    terms
        The same for people.
    warnings
        What the user should know of the choices made.
    """

    density: GridHeader | None
    color: GridHeader | None
    emission: GridHeader | None
    tint: bool
    transfer: bool
    level_set: bool
    depth: bool
    step_voxels: float | None
    max_error: float | None
    target_error: float | None
    nearest: bool
    estimate: bool
    terms: tuple[Term, ...]
    warnings: tuple[str, ...]

    @property
    def rule(self) -> str:
        """The rule of integration, for people: ``exact``, ``midpoint 0.5``, ``certified 0.01``; and
        ``calibrated 0.01`` as long as it is not chosen."""
        if self.target_error is not None:
            return f"calibrated {self.target_error:.3g}"
        if self.max_error is not None:
            return f"certified {self.max_error:g}"
        return "exact" if self.step_voxels is None else f"midpoint {self.step_voxels:g}"


def make_plan(
    job: Job,
    volume: Volume,
    layers: frozenset[str],
    color_volume: Volume | None = None,
    emission_volume: Volume | None = None,
) -> Plan:
    """Work out what a job needs of its volumes.

    Parameters
    ----------
    volume, color_volume, emission_volume
        The files of the density, and of the colour and the emission where those are others.
    layers
        What will be written: of ``picture``, ``transmittance``, ``opacity``, ``optical_depth``,
        ``depth``.

    Raises
    ------
    VolumeError
        If a volume has no grid such as the job asks for.
    """
    color_volume, emission_volume = color_volume or volume, emission_volume or volume
    warnings: list[str] = []
    density = color = emission = None
    if job.density.scale > 0:
        density = _density(job, volume, warnings)
    if density is not None and "picture" in layers:
        color = _source("color", job.color, job, color_volume, warnings)
    if job.emission.wanted and "picture" in layers:
        emission = _source("emission", job.emission, job, emission_volume, warnings)
    files = (volume.path, color_volume.path, emission_volume.path)
    return Plan(
        density=density,
        color=color,
        emission=emission,
        tint=job.density.tint is not None and density is not None,
        transfer=job.density.ramp is not None and density is not None,
        level_set=job.density.level_set is not None,
        depth="depth" in layers,
        step_voxels=job.quadrature.step_voxels,
        max_error=job.quadrature.max_error or None,  # 0 is exact
        target_error=job.quadrature.target_error or None,
        nearest=job.density.interpolation == "nearest",
        estimate="error_estimate" in layers,
        terms=tuple(_terms(job, layers, (density, color, emission), files)),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def source_key(name: str, part: Color | Emission) -> tuple[str, str | None, str] | None:
    """(field, grid, kind) of the grid that a source reads: ``color.ramp.grid``, its value, and what
    the grid must be (see `source_grid`); None where it reads none. A grid of None is the density's.
    """
    if part.ramp is not None:
        return f"{name}.ramp.grid", part.ramp.grid, "scalar"
    if part.blackbody is not None:
        return f"{name}.blackbody.grid", part.blackbody.grid, "scalar"
    if part.grid is None:
        return None
    if isinstance(part, Color):
        return f"{name}.grid", part.grid, "vec3"
    return f"{name}.grid", part.grid, "any" if part.constant is None else "scalar"


def _density(job: Job, volume: Volume, warnings: list[str]) -> GridHeader:
    level_set = job.density.level_set is not None
    try:
        header, notes = density_grid(volume, job.density.grid, level_set)
    except VolumeError as error:
        if job.emission.wanted and job.density.grid is None:
            hint = "emission alone needs none: density.scale = 0"
            raise VolumeError(f"{error}; {hint}") from error
        raise
    warnings += notes
    return header


def _source(
    name: str, part: Color | Emission, job: Job, volume: Volume, warnings: list[str]
) -> GridHeader | None:
    """The grid of a source, or None for a constant."""
    wanted = source_key(name, part)
    if wanted is None:
        return None
    key, grid, kind = wanted
    if grid is None:
        header, notes = density_grid(volume, job.density.grid, level_set=True)
    else:
        header, notes = source_grid(volume, grid, kind, key)
    warnings += notes
    return header


# -- for people -----------------------------------------------------------------------------------


def _terms(
    job: Job,
    layers: frozenset[str],
    grids: tuple[GridHeader | None, GridHeader | None, GridHeader | None],
    files: tuple[Path, Path, Path],
) -> list[Term]:
    """The terms; ``grids`` and ``files`` are those of density, colour and emission."""
    density, color, emission = grids
    read: set[tuple[Path, str]] = set()

    def reads(name: str, why: str, header: GridHeader, file: Path, evaluations: int) -> Term:
        if (file, header.label) in read:
            return Term(name, True, f"{why}; read once", header.label, 0, evaluations)
        if header is not density or job.density.level_set is None:  # its distances are not kept
            read.add((file, header.label))
        return Term(name, True, why, header.label, header.file_bytes, evaluations)

    nodes = NODES if job.quadrature.step_voxels is None else 1
    terms = []
    if density is None:
        terms.append(Term("optical depth", False, "density.scale is 0: nothing absorbs"))
    else:
        why = f"every picture needs it: {_how(job)}"
        if job.density.level_set is not None:
            why += "; a level set, as fog"
        terms.append(reads("optical depth", why, density, files[0], 1))
        if job.density.ramp is not None:
            terms.append(Term("transfer", True, "density.ramp is set", evaluations=1))
        if job.density.tint is not None:
            terms.append(Term("tint", True, "one optical depth, three exponentials"))
    if color is not None:
        why = f"{_named(job.color, 'color')} is set"
        terms.append(reads("colour", why, color, files[1], nodes))
    else:
        terms.append(_unread_color(job, density, layers))
    if emission is not None:
        why = f"{_named(job.emission, 'emission')} is set"
        terms.append(reads("emission", why, emission, files[2], nodes))
    else:
        why = "no picture is written" if job.emission.wanted else "nothing in the job"
        terms.append(Term("emission", False, why))
    if "depth" in layers:
        why = "Z of an EXR, or the map, asks for it"
        terms.append(Term("hit depth", True, why, evaluations=nodes))
    else:
        terms.append(Term("hit depth", False, "no EXR and no depth map is written"))
    if job.quadrature.max_error:
        why = (
            f"off by at most {job.quadrature.max_error:g}, pixel by pixel: transmittance, and "
            "radiance as a share of the brightest; not optical depth or hit depth"
        )
        terms.append(Term("error bound", True, why))
    else:
        terms.append(Term("error bound", False, "quadrature.max_error allows none"))
    if "error_estimate" in layers:
        why = "the map asks for it: of radiance, from the samples of each cell and an embedded rule"
        terms.append(Term("error estimate", True, why))
    else:
        terms.append(Term("error estimate", False, "no map asks for it"))
    if job.background.color is not None:
        terms.append(Term("background", True, "one colour"))
    elif job.background.image is not None:
        terms.append(Term("background", True, f"image {job.background.image.name}"))
    else:
        terms.append(Term("background", False, "transparent"))
    return terms


def _how(job: Job) -> str:
    step = job.quadrature.step_voxels
    if step is not None:
        return f"sampled every {step:g} voxels"
    if job.quadrature.target_error:
        return "sampled at the longest step that a pilot finds good enough, or exact"
    if job.quadrature.max_error:
        return "cell by cell, or larger parts as one where their bounds allow it"
    if job.density.interpolation == "nearest":
        return "a constant in each cell, exact"
    if job.density.ramp is not None:
        return "a cubic in each cell, cut at the stops of density.ramp"
    return "a cubic in each cell, exact"


def _unread_color(job: Job, density: GridHeader | None, layers: frozenset[str]) -> Term:
    """The term of a colour that reads no grid."""
    wanted = source_key("color", job.color)
    if wanted is None and density is not None:
        why = "C = c (1 - T) in closed form; no samples"
        return Term("colour", "picture" in layers, why)
    why = "no picture is written" if density is not None else "density.scale is 0: nothing is hit"
    return Term("colour", False, why, None if wanted is None else wanted[1])


def _named(part: Color | Emission, name: str) -> str:
    """The field that says what a source is: ``color.ramp``, ``color.grid``."""
    key = source_key(name, part)
    assert key is not None
    return key[0] if key[0].count(".") == 1 else key[0].removesuffix(".grid")
