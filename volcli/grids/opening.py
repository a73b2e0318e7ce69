"""Opening a volume file by its kind: headers are read, voxels are not."""

from __future__ import annotations

import difflib
from pathlib import Path

from volcli.errors import VolumeError
from volcli.grids.tree import Volume


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
    try:
        if path.is_dir():
            raise VolumeError(f"{path}: is a folder; give a volume file (.vdb, .npy or .npz)")
        if path.exists() and not path.is_file():  # a pipe or a device may have no end
            raise VolumeError(f"{path}: is no regular file; give a volume file")
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


def _nearby(path: Path) -> str:
    """A hint at a file of a similar name in the same folder."""
    try:
        names = [p.name for p in path.parent.iterdir() if p.is_file()]
    except OSError:
        return ""
    close = difflib.get_close_matches(path.name, names, n=1, cutoff=0.7)
    return f"; did you mean {path.parent / close[0]}?" if close else ""
