"""The transform of a grid of an OpenVDB file: a type of map by its name, and its doubles.

linear     translation, scale and numbers derived of it, or a matrix
frustum    box, taper, depth, and the linear map behind them: passed over, and refused
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from volcli.grids.vdb_codec import Cursor, Damage

_MAP_DOUBLES = {
    "UniformScaleMap": 15,
    "ScaleMap": 15,
    "UniformScaleTranslateMap": 18,
    "ScaleTranslateMap": 18,
    "TranslationMap": 3,
    "AffineMap": 16,
    "UnitaryMap": 16,
}
_FRUSTUM = "NonlinearFrustumMap"


def read_transform(
    cursor: Cursor, version: int
) -> tuple[str, NDArray[np.float64] | None, str | None]:
    """Return the type of map, its matrix where it is linear, and a refusal where it is not."""
    map_type = cursor.string("the type of a transform")
    if map_type == _FRUSTUM:
        # box, taper, depth, and the linear map behind them
        cursor.take(6 * (8 if version > 220 else 4) + 16, "a frustum transform")
        inner = cursor.string("the type of a transform")
        if inner not in _MAP_DOUBLES:
            raise Damage(cursor.at, f"a frustum transform around an unknown '{inner[:40]}'")
        cursor.take(8 * _MAP_DOUBLES[inner], "a frustum transform")
        return map_type, None, "frustum transform"
    if map_type not in _MAP_DOUBLES:
        return map_type, None, f"transform of type {map_type[:40]!r}"
    size = _MAP_DOUBLES[map_type]
    numbers = np.frombuffer(cursor.take(8 * size, "a transform"), "<f8")
    matrix = np.eye(4)
    if size == 16:
        matrix = numbers.reshape(4, 4).T.copy()  # the file's act on row vectors
    else:
        if "Translat" in map_type:
            matrix[:3, 3], numbers = numbers[:3], numbers[3:]
        if "Scale" in map_type:
            matrix[[0, 1, 2], [0, 1, 2]] = numbers[:3]
    return map_type, matrix, _why_not_a_lattice(matrix)


def _why_not_a_lattice(matrix: NDArray[np.float64]) -> str | None:
    """Why a matrix places no lattice; None where it does."""
    if not np.isfinite(matrix).all():
        return "transform with NaN or Inf"
    if not np.allclose(matrix[3], (0, 0, 0, 1)):
        return "transform with a perspective"
    try:
        with np.errstate(all="ignore"):
            inverse = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return "transform without an inverse"
    return None if np.isfinite(inverse).all() else "transform without an inverse"


def is_known(map_type: str) -> bool:
    """Whether it can be told where a transform of that type ends."""
    return map_type in _MAP_DOUBLES or map_type == _FRUSTUM
