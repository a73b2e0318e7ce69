"""OpenVDB's own library as a reader, for comparison: slower, and not to be had from PyPI.

The library's Python module (``openvdb``, or ``pyopenvdb`` as it was called) may crash beside the
NumPy that volcli needs and on damaged files. It is therefore never imported here:
``_openvdb_worker.py`` runs under an interpreter that has it and hands arrays back through a
temporary folder. ``vdb`` is the reader that volcli uses unless told otherwise.

Which grids can be read is up to the library: the build in Debian 12 knows float, bool and vec3s.
Grids are in the library's order, which is by name; a linear transform is what the library makes of
four points, so its last bits may differ from those in the file; a header has no background, since
the library would have to read the whole grid to know it. Tiles that are inactive and hold
another value than the background are found only where leaves or active values are near (in the
same 4096^3, or in the box of these).
"""

from __future__ import annotations

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from volcli.errors import VolumeError
from volcli.grids.census import Census
from volcli.grids.tree import GridHeader, Progress, Tree, unique_labels
from volcli.grids.vdb import declared_box, declared_count, open_vdb
from volcli.memory import memory_left

INTERPRETER_VARIABLE = "VOLCLI_OPENVDB_PYTHON"
"""Environment variable: the Python interpreter that has OpenVDB's module."""

_WORKER = Path(__file__).with_name("_openvdb_worker.py")
_WORKER_FAILED = 3
_LEAST_MEMORY = 256_000_000  # bytes that the library takes by itself
_PROBE = """
try:
    import openvdb as module
except ImportError:
    import pyopenvdb as module
module.read
import numpy
"""
_PROBE_SECONDS = 60
_WORKER_SECONDS = {"headers": 60, "tree": 1800}  # damaged files have kept the library busy
_TREE_ARRAYS = tuple(Tree.__dataclass_fields__)


def open_openvdb(path: str | Path) -> OpenVDBFile:
    """Open a file with OpenVDB's own library: read its headers, and none of its voxels.

    Raises
    ------
    VolumeError
        If no interpreter has the library, or the library cannot read the file.
    """
    return OpenVDBFile(Path(path))


class OpenVDBFile:
    """A file read by OpenVDB's own library, satisfying `volcli.grids.tree.Volume`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise VolumeError(f"{path}: no such file")
        found = self._read_headers()
        labels = unique_labels([item["name"] for item in found])
        self.headers: tuple[GridHeader, ...] = tuple(map(_header, found, labels))

    def read_tree(self, header: GridHeader, progress: Progress | None = None) -> Tree:
        """Read the leaves and tiles of one grid.

        Raises
        ------
        VolumeError
            If the grid is refused (``header.refusal``), or the library fails or crashes.
        """
        where = f"{self.path}: grid '{header.label}'"
        if not any(header.label == known.label for known in self.headers):
            raise VolumeError(f"{self.path}: no grid '{header.label}'")
        if header.refusal is not None:
            raise VolumeError(f"{where}: not supported: {header.refusal}")
        with tempfile.TemporaryDirectory(prefix="volcli-") as folder:
            _run_worker(where, "tree", self.path, Path(folder), header.label)
            arrays = {key: np.load(Path(folder) / f"{key}.npy") for key in _TREE_ARRAYS}
        for key in ("background", "leaf_values", "tile_values"):
            if arrays[key].dtype == np.bool_:
                arrays[key] = arrays[key].astype(np.uint8)
        count = len(arrays["leaf_origins"])
        if progress is not None and count:
            progress(count, count)
        return Tree(**arrays)

    def census(self, header: GridHeader) -> Census:
        """How much a grid holds, as our own reader counts it.

        Raises
        ------
        VolumeError
            As `read_tree`.
        """
        own = open_vdb(self.path)
        for known in own.headers:
            if known.label == header.label:
                return own.census(known)
        raise VolumeError(f"{self.path}: no grid '{header.label}'")

    def _read_headers(self) -> list[dict[str, Any]]:
        """Ask for all headers; if that fails, for one at a time.

        One grid of a type that the library does not know makes it refuse the whole file. Then our
        own reader says which grids there are.
        """
        with tempfile.TemporaryDirectory(prefix="volcli-") as name:
            folder = Path(name)
            try:
                _run_worker(str(self.path), "headers", self.path, folder)
            except _LibraryError as error:
                try:
                    labels = [header.label for header in open_vdb(self.path).headers]
                except VolumeError:
                    raise error from None
                names = folder / "names.json"
                names.write_text(json.dumps(labels), encoding="utf-8")
                _run_worker(str(self.path), "headers", self.path, folder, str(names))
            return json.loads((folder / "headers.json").read_text(encoding="utf-8"))


class _LibraryError(VolumeError):
    """The library itself said no."""


def _header(found: dict[str, Any], label: str) -> GridHeader:
    if "refusal" in found:
        return GridHeader(
            name=found["name"],
            label=label,
            value_type="unknown",
            grid_class="unknown",
            map_type="unknown",
            world_from_index=None,
            refusal=f"OpenVDB's library: {found['refusal']}",
        )
    metadata = {key: _tupled(value) for key, value in found["metadata"].items()}
    matrix = found["world_from_index"]
    packing = str(metadata.get("file_compression", ""))
    return GridHeader(
        name=found["name"],
        label=label,
        value_type=found["value_type"],
        grid_class=found["grid_class"],
        map_type=found["map_type"],
        world_from_index=None if matrix is None else np.array(matrix),
        active_voxels=declared_count(metadata),
        active_box=declared_box(metadata),
        stored=", ".join(filter(None, ("half" if found["half"] else "", packing))),
        metadata=metadata,
        refusal="frustum transform" if matrix is None else None,
    )


def _tupled(value: Any) -> Any:
    return tuple(map(_tupled, value)) if isinstance(value, list) else value


def _run_worker(where: str, task: str, path: Path, out: Path, *rest: str) -> None:
    """Run the worker to its end; raise what it reports, or that it crashed."""
    command = [find_interpreter(), "-I", str(_WORKER), task, str(path.resolve()), str(out), *rest]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=_environment(),
            timeout=_WORKER_SECONDS[task],
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise VolumeError(
            f"{where}: no answer from OpenVDB's library in {error.timeout:g} s"
        ) from error
    if done.returncode == 0:
        return
    if done.returncode == _WORKER_FAILED and (out / "error.txt").is_file():
        message = (out / "error.txt").read_text(encoding="utf-8")
        raise _LibraryError(f"{where}: OpenVDB's library: {message}")
    if done.returncode < 0:
        ended = f"was killed by {signal.Signals(-done.returncode).name}"
    else:
        ended = f"ended with {done.returncode}"
    said = done.stderr.decode(errors="replace").strip().splitlines()
    raise VolumeError(f"{where}: OpenVDB's library {ended}" + (f": {said[-1]}" if said else ""))


def find_interpreter() -> str:
    """Return the path of an interpreter that has OpenVDB's module.

    Raises
    ------
    VolumeError
        If there is none.
    """
    chosen = os.environ.get(INTERPRETER_VARIABLE)
    if chosen:
        if not _has_openvdb(chosen):
            raise VolumeError(f"{INTERPRETER_VARIABLE}={chosen}: this interpreter has no openvdb")
        return chosen
    for candidate in (sys.executable, "/usr/bin/python3", shutil.which("python3")):
        if candidate and _has_openvdb(candidate):
            return candidate
    raise VolumeError(
        "no interpreter with openvdb found: install python3-openvdb or set " + INTERPRETER_VARIABLE
    )


@functools.lru_cache(maxsize=16)
def _has_openvdb(interpreter: str) -> bool:
    try:
        done = subprocess.run(
            [interpreter, "-I", "-c", _PROBE],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=_environment(),
            timeout=_PROBE_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _environment() -> dict[str, str]:
    """The environment without what would lead the other interpreter to this one's packages, and
    with the memory that it may take: the library believes what a file says of its sizes.
    """
    return {"VOLCLI_MEMORY": str(max(memory_left(), _LEAST_MEMORY))} | {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PYTHON", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__"))
    }
