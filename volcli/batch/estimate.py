"""Memory: what a job will take, as far as headers tell, and what there is."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from volcli.errors import UsageError, VolcliError
from volcli.grids import GridHeader
from volcli.plan import Plan, make_plan
from volcli.scene import Volumes, open_volumes
from volcli.schema import Job

PROCESS = 215_000_000
"""Bytes of a worker that holds nothing: Python, NumPy, numba and kernels."""
VOXEL = 7.1
"""Bytes of bricks an active voxel of a float grid, measured (`benchmarks.scaling`)."""
LOADING = 2.0
"""How many times its bricks a grid takes while it is read and built."""
PIXEL = 86.0
"""Bytes a pixel of an EXR while it is written and read back, measured."""

_CGROUPS = Path("/sys/fs/cgroup")
_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


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
        plan = plan_of(job, volumes)
        read = {
            (volume.path, header.label): header
            for volume, header in (
                (volumes.density, plan.density),
                (volumes.color, plan.color),
                (volumes.emission, plan.emission),
            )
            if header is not None
        }
        grids = sum(_bricks(header, path) for (path, _), header in read.items())
    except (VolcliError, OSError):
        return None
    width, height = job.camera.size
    return int(LOADING * grids + PIXEL * (width * height if pixels is None else pixels))


def plan_of(job: Job, volumes: Volumes) -> Plan:
    """The plan of a job's picture, maps or none."""
    wanted = frozenset({"picture"})
    return make_plan(job, volumes.density, wanted, volumes.color, volumes.emission)


def _bricks(header: GridHeader, file: Path) -> float:
    """Bytes of a grid's bricks; where the file does not count voxels, two bytes are one."""
    voxels = file.stat().st_size / 2 if header.active_voxels is None else header.active_voxels
    return voxels * VOXEL * (3 if header.is_vector else 1)


def parse_memory(text: str) -> int:
    """``8GB``, ``500 MB``, ``75%`` (of what there is) to bytes.

    Raises
    ------
    UsageError
        If it is none of these.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(%|[kmgt]?i?b?)\s*", text, re.IGNORECASE)
    if found is not None:
        amount, unit = float(found[1]), found[2].lower()
        if unit == "%":
            count = amount / 100 * available_memory()
        else:
            factor = _UNITS[unit.rstrip("ib")]
            count = amount * (factor if "i" not in unit else 1024 ** round(len(str(factor)) / 3))
        if count >= 1:
            return int(count)
    raise UsageError(f"--memory {text}: give bytes with a unit, such as 8GB, or a share, 75%")


def available_memory() -> int:
    """Bytes that are free to use: the machine's, or what is left of the control group's limit."""
    free = [_left_in_cgroup()]
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        found = re.search(r"MemAvailable:\s*(\d+) kB", meminfo.read_text())
        if found:
            free.append(int(found[1]) * 1024)
    known = [count for count in free if count is not None]
    return min(known) if known else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def held_memory(pid: int) -> int:
    """Bytes that a process holds, without what it shares with files; 0 where that is not known."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text().split()
        return (int(pages[1]) - int(pages[2])) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0  # it has ended, or this system has no such file


def _left_in_cgroup() -> int | None:
    """What the tightest limit of a control group above this process leaves, if there is one."""
    left: list[int] = []
    try:
        groups = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return None
    for line in groups:
        _, kinds, own = line.split(":", 2)
        if kinds == "":
            root, limit, used, cache = _CGROUPS, "memory.max", "memory.current", "inactive_file"
        elif kinds == "memory":  # version 1
            root = _CGROUPS / "memory"
            limit, used = "memory.limit_in_bytes", "memory.usage_in_bytes"
            cache = "total_inactive_file"
        else:
            continue
        group = root / own.lstrip("/")
        while group.is_relative_to(root):
            with suppress(OSError, ValueError):  # no limit here, or a file that is hidden
                stat = dict(
                    line.split(" ", 1) for line in (group / "memory.stat").read_text().splitlines()
                )
                held = int((group / used).read_text()) - int(stat.get(cache, 0))
                left.append(int((group / limit).read_text()) - held)
            group = group.parent
    return min(left, default=None)
