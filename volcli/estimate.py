"""The memory that a job will take at its peak: from the topology of its grids and the size of its
picture, before a value is read.
"""

from __future__ import annotations

from pathlib import Path

from volcli.bounds import BYTES_A_BRICK, BYTES_A_BRICK_OF_SOURCE
from volcli.errors import UsageError, VolcliError
from volcli.grids import GridHeader, Volume
from volcli.grids.census import Census
from volcli.memory import memory_left
from volcli.plan import Plan, make_plan
from volcli.scene import Volumes, open_volumes
from volcli.schema import Job

PROCESS = 245_000_000
"""Bytes of a process that holds nothing: Python, NumPy, numba and kernels. Measured 215 MB, and 290
where kernels are compiled: which it will be is not known before.
"""
PIXEL = {".exr": 82.0, ".png": 104.0}
"""Bytes a pixel while a picture is made, written and read back, measured."""

_AFTER_LOADING = 60_000_000
"""The part of `PROCESS` that is there only once all grids are read."""

_AMPLE = 100
"""A grid takes less than so many times its bytes in the file, hostile files apart."""


def estimate(job: Job, pixels: int | None = None) -> int | None:
    """Bytes that a job takes beside the process itself; None where its volume cannot be read.

    Parameters
    ----------
    pixels
        Of the part that is rendered; None: all of them.
    """
    if job.density.file is None:
        return None
    try:
        volumes = open_volumes(job)
        return needed_memory(job, plan_of(job, volumes), volumes, pixels)
    except (VolcliError, OSError):
        return None


def needed_memory(job: Job, plan: Plan, volumes: Volumes, pixels: int | None = None) -> int:
    """`estimate` of a job that is planned: grids are read one after another, then pixels made.

    Raises
    ------
    VolumeError
        If a file is damaged.
    """
    most = held = 0
    for volume, header in _grids(plan, volumes):
        census = _census(volume, header, volume.path.stat().st_mtime_ns)
        most = max(most, held + census.mapped_bytes + census.loading_bytes - _AFTER_LOADING)
        held += census.grid_bytes + (census.mapped_bytes if census.stays_mapped else 0)
        if plan.max_error is not None:
            dense = header is plan.density
            held += census.bricks * (BYTES_A_BRICK if dense else BYTES_A_BRICK_OF_SOURCE)
    return max(most, held + _picture(job, pixels))


def check_memory(job: Job, plan: Plan, volumes: Volumes) -> None:
    """Refuse a picture that does not fit into memory beside its grids.

    Grids that do not fit by themselves are refused when they are read.

    Raises
    ------
    UsageError
        It says how much is needed.
    """
    left, picture = memory_left(), _picture(job, None)
    files = sum(
        volume.path.stat().st_size if header.file_bytes is None else header.file_bytes
        for volume, header in _grids(plan, volumes)
    )
    if picture + _AMPLE * files < left:
        return  # by far: not worth counting
    needed = needed_memory(job, plan, volumes)
    if picture > left or (needed > left and picture > needed / 2):
        width, height = job.camera.size
        raise UsageError(
            f"a picture of {width}x{height} takes about {picture / 1e9:.1f} GB of memory, with its "
            f"grids {needed / 1e9:.1f} GB, and {max(left, 0) / 1e9:.1f} GB may be taken; make it "
            "smaller (--size), or allow more (--max-memory)"
        )


def plan_of(job: Job, volumes: Volumes) -> Plan:
    """The plan of a job's picture, maps or none."""
    wanted = frozenset({"picture"})
    return make_plan(job, volumes.density, wanted, volumes.color, volumes.emission)


def _picture(job: Job, pixels: int | None) -> int:
    width, height = job.camera.size
    image = job.output.image
    each = PIXEL[".png" if image is not None and image.suffix.lower() == ".png" else ".exr"]
    return int(each * (width * height if pixels is None else pixels))


def _grids(plan: Plan, volumes: Volumes) -> list[tuple[Volume, GridHeader]]:
    """The grids of a plan in the order in which they are read, each once."""
    found: dict[tuple[Path, str], tuple[Volume, GridHeader]] = {}
    for volume, header in (
        (volumes.density, plan.density),
        (volumes.color, plan.color),
        (volumes.emission, plan.emission),
    ):
        if header is not None:
            found.setdefault((volume.path, header.label), (volume, header))
    return list(found.values())


def _census(volume: Volume, header: GridHeader, changed: int) -> Census:
    """What a grid holds, counted once for all jobs that use it."""
    key = (volume.path, header.label, changed)
    if key not in _COUNTED:
        if len(_COUNTED) > 10_000:
            _COUNTED.clear()
        _COUNTED[key] = volume.census(header)
    return _COUNTED[key]


_COUNTED: dict[tuple[Path, str, int], Census] = {}
