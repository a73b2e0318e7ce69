"""What is in a volume file, as plain data: the content of `volcli info`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.grids import GridHeader, Tree, Volume, open_volume
from volcli.grids.brick import to_world
from volcli.grids.build import build
from volcli.grids.values import settle_nonfinite


def describe(path: Path, *, stats: bool = False, reader: str = "volcli") -> dict[str, Any]:
    """Headers of all grids, and with ``stats`` what their values are.

    Returns
    -------
    ``file``, ``format``, and ``grids``: for each grid its label, type, class, voxels and box as the
    file declares them, voxel size and transform; with ``stats`` those counted, and the range of the
    values and the memory as bricks. Everything is of the kinds that JSON has.

    Raises
    ------
    VolumeError
        If the file cannot be read.
    """
    volume = open_volume(path, reader)
    version = getattr(volume, "version", None)
    grids = []
    for header in volume.headers:
        grid = _headers(header)
        if stats and header.refusal is None:
            grid |= _stats(volume, header)
        grids.append(grid)
    kind = f"OpenVDB file version {version}" if version else path.suffix.lstrip(".")
    return {"file": str(path), "format": kind, "grids": grids}


def _headers(header: GridHeader) -> dict[str, Any]:
    matrix = header.world_from_index
    size = None if matrix is None else np.linalg.norm(matrix[:3, :3], axis=0).tolist()
    box = None
    if header.active_box is not None:
        box = [list(header.active_box[0]), list(header.active_box[1])]
    return {
        "grid": header.label,
        "type": header.value_type,
        "class": header.grid_class,
        "voxels": header.active_voxels,
        "box": box,
        "world_box": None
        if box is None or matrix is None
        else to_world(np.array(box), matrix).tolist(),
        "voxel_size": size,
        "transform": header.map_type,
        "world_from_index": None if matrix is None else matrix.tolist(),
        "background": _plain(header.background),
        "stored": header.stored,
        "refusal": header.refusal,
    }


def _stats(volume: Volume, header: GridHeader) -> dict[str, Any]:
    """What only the values tell: of the active voxels and tiles, but for NaN, Inf and memory."""
    tree = volume.read_tree(header)
    active = np.unpackbits(tree.leaf_masks, axis=1, bitorder="little").astype(bool)
    voxels = tree.leaf_values[active.reshape(tree.leaf_values.shape[:4])].astype(np.float64)
    tiles = tree.tile_values[tree.tile_active].astype(np.float64)
    weights = tree.tile_widths[tree.tile_active].astype(np.float64) ** 3
    values = np.concatenate([voxels, tiles])
    finite = values[np.isfinite(values)]
    grid = build(settle_nonfinite(tree, str(volume.path), "zero")[0], header)
    box = None if grid.is_empty else grid.active_box.tolist()
    return {
        "voxels": len(voxels) + int(weights.sum()),
        "leaves": len(tree.leaf_origins),
        "tiles": len(tree.tile_origins),
        "box": box,
        "world_box": None if box is None else grid.world_box().tolist(),
        "min": float(finite.min()) + 0.0 if finite.size else None,  # 0 rather than -0
        "max": float(finite.max()) + 0.0 if finite.size else None,
        "mean": _mean(voxels, tiles, weights),
        "nonfinite": _count_nonfinite(tree),
        "negative": int(np.count_nonzero(values < 0)),
        "memory_bytes": grid.nbytes,
    }


def _plain(value: Any) -> Any:
    """A value or a vector as JSON can hold it: None where it is not known, or NaN or Inf."""
    if value is None:
        return None
    plain = np.asarray(value)
    return plain.tolist() if np.isfinite(plain).all() else None


def _mean(
    voxels: NDArray[np.float64], tiles: NDArray[np.float64], weights: NDArray[np.float64]
) -> float | list[float] | None:
    """The mean over active voxels, a tile counting for as many as it covers; None if not finite."""
    count = len(voxels) + weights.sum()
    if count == 0:
        return None
    total = voxels.sum(axis=0) + np.tensordot(weights, tiles, axes=(0, 0))
    mean = total / count
    return mean.tolist() if np.isfinite(mean).all() else None


def _count_nonfinite(tree: Tree) -> int:
    return sum(int(np.count_nonzero(~np.isfinite(p))) for p in (tree.leaf_values, tree.tile_values))
