"""Cameras of a NeRF ``transforms.json`` to the cameras of jobs.

The file holds frames, each with a ``transform_matrix``: camera to world, for a camera that looks
along -Z with +Y up (OpenGL's and Blender's). Matrices are taken as they are stored, in the volume's
world units; ``scale``, ``offset`` and ``aabb_scale`` (instant-ngp's way into its unit cube) and
``applied_transform`` (nerfstudio's note of what the matrices already contain) are not applied. A
frame's own intrinsics win over those of the file:

* ``fl_x``, ``fl_y``, ``cx``, ``cy`` in pixels of a picture of ``w`` x ``h``, the corner of whose
  first pixel is 0,0 (instant-ngp, nerfstudio), or
* ``camera_angle_x``, the horizontal field of view in radians (the synthetic scenes of NeRF).

A picture of another size than the file's shows the same width; its pixels keep their shape, so that
of another aspect it shows more or less above and below.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from volcli.errors import UsageError
from volcli.schema import Camera, Job
from volcli.texts import parse_json, read_text

LARGEST = 1 << 26
"""Bytes of a transforms.json: a hundred thousand frames."""

SYNTHETIC_SIZE = (800, 800)
"""Width and height of the pictures of NeRF's synthetic scenes, whose files do not name it."""

RIGID = 1e-3
"""How far the axes of a camera may be from unit length and right angles: files are rounded."""

_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
"""Values of ``camera_model`` that are a pinhole where no distortion is given."""

_DISTORTIONS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "is_fisheye")

Floats = NDArray[np.float64]


def each_camera(job: Job) -> tuple[Job, ...]:
    """The pictures that a job asks for: itself, or one for each frame of ``camera.transforms``.

    Each has a camera of its own, written out, so that it needs the file no more. With
    ``camera.frame = "all"`` the number of a frame goes before the suffix of its output:
    ``out.exr`` becomes ``out.0000.exr``.

    Raises
    ------
    UsageError
        If the file or the frame is not there, or the frame's camera is not a pinhole.
    """
    path = job.camera.transforms
    if path is None:
        return (job,)
    document = _read(path)
    count = len(document["frames"])
    if job.camera.frame != "all":
        number = job.camera.frame or 0
        if number >= count:
            raise UsageError(
                f"{path}: there is no frame {number} (camera.frame); it has {count}, the first is 0"
            )
        return (_with_camera(job, path, document, number),)
    image = job.output.image
    digits = max(4, len(str(count - 1)))
    jobs = []
    for number in range(count):
        one = _with_camera(job, path, document, number)
        if image is not None:
            named = image.with_name(f"{image.stem}.{number:0{digits}d}{image.suffix}")
            one = one.model_copy(update={"output": job.output.model_copy(update={"image": named})})
        jobs.append(one)
    return tuple(jobs)


def _with_camera(job: Job, path: Path, document: Mapping[str, Any], number: int) -> Job:
    frame = {**document, **document["frames"][number]}
    try:
        camera = _camera(frame, job.camera)
    except _Wrong as wrong:
        raise UsageError(f"{path}: frame {number}: {wrong}") from wrong
    return job.model_copy(update={"camera": camera})


class _Wrong(Exception):
    """What is wrong with a frame."""


def _read(path: Path) -> dict[str, Any]:
    """The file's object, with a list of objects under ``frames``."""
    try:
        document = parse_json(read_text(path, LARGEST))
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such file (camera.transforms); check the path") from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # of UTF-8, and of JSON
        raise UsageError(f"{path}: is not JSON: {error}") from error
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise UsageError(f"{path}: has no list of 'frames'; give a NeRF transforms.json")
    if not frames:
        raise UsageError(f"{path}: its list of 'frames' is empty; there is no camera in it")
    return dict(document)


def _camera(frame: Mapping[str, Any], job: Camera) -> Camera:
    """The camera of a frame (its own entries over the file's), for the rest of a job's camera."""
    _refuse_lenses(frame)
    pose = _pose(frame)
    size = _size(frame)
    if size is None and job.resolution is None and "fl_x" in frame:
        raise _Wrong(
            "fl_x is in pixels of a picture of unknown size; give camera.resolution (--size), or "
            "w and h in the file"
        )
    width, height = size or job.resolution or SYNTHETIC_SIZE
    focal = _focal(frame, width)
    principal = (
        _number(frame, "cx") if "cx" in frame else width / 2,
        _number(frame, "cy") if "cy" in frame else height / 2,
    )
    wanted = job.resolution or (width, height)
    scale = wanted[0] / width
    _, upward, backward, eye = pose
    reach = max(1.0, float(np.abs(eye).max()))  # so that eye - target keeps its digits
    with np.errstate(over="ignore"):  # Inf is refused below
        target = eye - reach * backward
    try:
        return Camera(
            eye=_triple(eye),
            target=_triple(target),
            up=_triple(upward),
            focal=(focal[0] * scale, focal[1] * scale),
            principal=(
                principal[0] * scale,
                wanted[1] / 2 + (principal[1] - height / 2) * scale,
            ),
            resolution=wanted,
            samples=job.samples,
        )
    except ValidationError as error:  # of what overflows
        problem = error.errors()[0]
        raise _Wrong(f"its {problem['loc'][0]} is out of range: {problem['msg']}") from error


def _refuse_lenses(frame: Mapping[str, Any]) -> None:
    model = frame.get("camera_model", "PINHOLE")
    if model not in _PINHOLES:
        raise _Wrong(f"camera_model {model!r} is not a pinhole, and only those are rendered")
    for key in _DISTORTIONS:
        value = frame.get(key, False)
        if value is True or (value is not False and _number(frame, key) != 0):
            raise _Wrong(
                f"{key} = {value}: lenses that distort are not rendered; give the cameras of "
                f"undistorted images, or set it to 0"
            )


def _size(frame: Mapping[str, Any]) -> tuple[int, int] | None:
    """Width and height of the picture that the intrinsics are of, or None."""
    if "w" not in frame and "h" not in frame:
        return None
    sides = []
    for key in ("w", "h"):
        side = _number(frame, key)
        if side != round(side) or not 1 <= side <= 65536:
            raise _Wrong(f"{key} = {side:g}: must be a whole number of pixels, 1 to 65536")
        sides.append(round(side))
    return sides[0], sides[1]


def _focal(frame: Mapping[str, Any], width: int) -> tuple[float, float]:
    """Focal lengths across and down, in pixels of a picture of that width."""
    if "fl_x" in frame:
        across = _number(frame, "fl_x")
        down = _number(frame, "fl_y") if "fl_y" in frame else across
        for key, length in (("fl_x", across), ("fl_y", down)):
            if not length > 0:
                raise _Wrong(f"{key} = {length:g}: must be above 0")
        return across, down
    if "camera_angle_x" not in frame:
        raise _Wrong("has no focal length; give camera_angle_x, or fl_x")
    angle = _number(frame, "camera_angle_x")
    if not 0 < angle < math.pi:
        raise _Wrong(f"camera_angle_x = {angle:g}: must be between 0 and pi, in radians")
    across = width / 2 / math.tan(angle / 2)
    return across, across


def _pose(frame: Mapping[str, Any]) -> Floats:
    """(4, 3): the camera's +X, +Y and +Z in the world, and its position.

    A rigid matrix has three unit vectors at right angles, right-handed.
    """
    rows = frame.get("transform_matrix")
    if not _is_matrix(rows):
        raise _Wrong("transform_matrix must be 4 rows of 4 finite numbers")
    matrix = np.array(rows, np.float64)
    axes, eye = matrix[:3, :3].T, matrix[:3, 3]
    lengths = np.linalg.norm(axes, axis=1)
    if np.abs(lengths - 1).max() > RIGID:
        shown = ", ".join(f"{length:.6g}" for length in lengths)
        raise _Wrong(
            f"transform_matrix scales the camera: its axes have the lengths {shown}, not 1; divide "
            f"each of its first three columns by its length"
        )
    cosines = np.abs((axes @ axes.T)[np.triu_indices(3, 1)])
    if cosines.max() > RIGID:
        raise _Wrong(
            f"transform_matrix shears the camera: its axes are not at right angles (cosine "
            f"{cosines.max():.3g}); volcli takes rigid matrices"
        )
    if np.linalg.det(axes) < 0:
        raise _Wrong("transform_matrix mirrors the camera; negate one of its first three columns")
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > RIGID:
        raise _Wrong("transform_matrix must end in the row 0, 0, 0, 1")
    return np.vstack([axes, eye])


def _is_matrix(rows: Any) -> bool:
    """Whether it is 4 rows (or the first 3 of them) of 4 finite numbers."""
    return (
        isinstance(rows, list)
        and len(rows) in (3, 4)
        and all(isinstance(row, list) and len(row) == 4 for row in rows)
        and all(_is_finite(value) for row in rows for value in row)
    )


def _is_finite(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:  # a whole number of more than 308 digits
        return False


def _number(frame: Mapping[str, Any], key: str) -> float:
    if key not in frame:
        raise _Wrong(f"has no {key}")
    if not _is_finite(frame[key]):
        raise _Wrong(f"{key} must be a finite number")
    return float(frame[key])


def _triple(vector: Floats) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
