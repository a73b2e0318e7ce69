"""What is in a volume file, as plain data: the content of `volcli info`."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.columns import column_depths
from volcli.errors import VolumeError
from volcli.grids import GridHeader, Tree, Volume, density_grid, open_volume
from volcli.grids.brick import to_world
from volcli.grids.build import build
from volcli.grids.choosing import LEVEL_SET
from volcli.grids.values import settle_nonfinite
from volcli.opacity.findings import SOLID, THIN, scale_advice


def describe(path: Path, *, stats: bool = False, reader: str = "volcli") -> dict[str, Any]:
    """Headers of all grids, and with ``stats`` what their values are.

    Returns
    -------
    ``file``, ``format``, and ``grids``: for each grid its label, type, class, voxels and box as the
    file declares them, voxel size, transform, background, and what it can be ``used`` for or why
    not (``refusal``); with ``stats`` those counted, the range of the values, how many are NaN, Inf
    and below 0, the memory as bricks, and of a density the ``optical_depth`` through its box at
    scale 1 with ``advice`` where that would look empty or solid. Everything is of the kinds that
    JSON has.

    Raises
    ------
    VolumeError
        If the file cannot be read.
    """
    volume = open_volume(path, reader)
    version = getattr(volume, "version", None)
    density = _density(volume)
    grids = []
    for header in volume.headers:
        grid = _headers(header)
        if stats and header.refusal is None:
            tree = volume.read_tree(header)
            grid |= _stats(tree, header)
            grid |= _thickness(tree, header) if header is density else {}
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
        "use": _use(header),
        "refusal": header.refusal,
    }


def _use(header: GridHeader) -> str | None:
    """What a grid can be in a picture; None where it cannot be read.

    Emission can be of any grid, and colour by value of any scalar one.
    """
    if header.refusal is not None:
        return None
    if header.is_vector:
        return "colour"
    return "density (as fog)" if header.grid_class == LEVEL_SET else "density"


def _density(volume: Volume) -> GridHeader | None:
    """The grid that is rendered where none is named; None where the file does not make it clear."""
    try:
        return density_grid(volume, None)[0]
    except VolumeError:
        return None


def _stats(tree: Tree, header: GridHeader) -> dict[str, Any]:
    """What only the values tell: of the active voxels and tiles, but for NaN, Inf and memory."""
    active = np.unpackbits(tree.leaf_masks, axis=1, bitorder="little").astype(bool)
    voxels = tree.leaf_values[active.reshape(tree.leaf_values.shape[:4])].astype(np.float64)
    tiles = tree.tile_values[tree.tile_active].astype(np.float64)
    weights = tree.tile_widths[tree.tile_active].astype(np.float64) ** 3
    values = np.concatenate([voxels, tiles])
    finite = values[np.isfinite(values)]
    grid = build(settle_nonfinite(tree, header.label, "zero")[0], header)
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
        "nan": _count(tree, np.isnan),
        "inf": _count(tree, np.isinf),
        "negative": int(np.count_nonzero(values < 0)),
        "memory_bytes": grid.nbytes,
    }


def _thickness(tree: Tree, header: GridHeader) -> dict[str, Any]:
    """Optical depth through the box at scale 1, and advice where a picture would show nothing, or
    nothing but an outline; None where that cannot be told from the values alone."""
    found: dict[str, Any] = {"optical_depth": None, "advice": None}
    matrix = header.world_from_index
    if matrix is None or tree.background > 0:
        return found
    depths = column_depths(tree, matrix)
    if not len(depths):
        return found
    least, median, most = (float(q) for q in np.percentile(depths, [25, 50, 99]))
    if not math.isfinite(least + median + most):
        return found
    found["optical_depth"] = {"25": least, "50": median, "99": most}
    if most < THIN or least > SOLID:
        looks = "empty" if most < THIN else "solid"
        found["advice"] = f"at scale 1 it looks {looks}: {scale_advice(1.0, median)}"
    return found


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


def _count(tree: Tree, test: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> int:
    return sum(int(np.count_nonzero(test(p))) for p in (tree.leaf_values, tree.tile_values))
