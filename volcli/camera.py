"""Cameras: pixels to rays. Perspective and orthographic, and the framing chosen when none is given.

World space is right-handed. A camera looks along -Z of its own frame with +X to the right and +Y
up; pixel centres lie at +0.5, row 0 is the top of the image, the field of view is vertical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from volcli import schema
from volcli.errors import UsageError

Floats = NDArray[np.float64]

FRAMING_MARGIN = 1.05
"""How much larger than the volume's box the automatic frame is."""

_PARALLEL = 1e-9
"""The sine of the smallest angle between ``up`` and the view that still makes a frame."""


@dataclass(frozen=True)
class Camera:
    """A camera with its frame worked out.

    Attributes
    ----------
    eye, target, up
        (3,) world units, as asked for or as chosen.
    right, upward, forward
        (3,) unit vectors: the camera's +X, +Y and -Z.
    half_height
        Half the image's height: tan(fov / 2) for a perspective camera, world units for an
        orthographic one.
    perspective
        Whether rays spread from the eye; else they are parallel.
    resolution
        (width, height) in pixels.
    """

    eye: Floats
    target: Floats
    up: Floats
    right: Floats
    upward: Floats
    forward: Floats
    half_height: float
    perspective: bool
    resolution: tuple[int, int]

    def rays(self, rows: slice, columns: slice) -> tuple[Floats, Floats]:
        """Origins and unit directions, (n, 3) each, of a rectangle of pixels, row by row."""
        width, height = self.resolution
        pixel = 2.0 * self.half_height / height
        x = (np.arange(width)[columns] + 0.5 - width / 2) * pixel
        y = (height / 2 - (np.arange(height)[rows] + 0.5)) * pixel
        rays = np.empty((2, len(y), len(x), 3))
        for axis in range(3):
            across = x * self.right[axis] + (y * self.upward[axis])[:, None]
            if self.perspective:
                rays[0, ..., axis] = self.eye[axis]
                rays[1, ..., axis] = across + self.forward[axis]
            else:
                rays[0, ..., axis] = across + self.eye[axis]
                rays[1, ..., axis] = self.forward[axis]
        if self.perspective:  # the frame is orthonormal, so the length needs no sum over axes
            rays[1] /= np.sqrt(1.0 + x * x + (y * y)[:, None])[..., None]
        origins, directions = rays.reshape(2, -1, 3)
        return origins, directions

    def axial(self, directions: Floats) -> Floats:
        """(n,): the part along the camera's axis of a unit of distance along each ray."""
        return directions @ self.forward


def make_camera(job: schema.Camera, box: Floats) -> Camera:
    """Work out a camera from a job; what the job leaves out is chosen to frame ``box``.

    Parameters
    ----------
    job
        Eye and target may be absent: the target becomes the middle of the box, the eye is put in
        front of it (on +Z, or where +Z is ``up``, on +X) so that the whole box is in the picture.
    box
        (2, 3) world units: the volume.

    Raises
    ------
    UsageError
        If the eye is the target, or ``up`` lies along the view.
    """
    up = np.array(job.up, np.float64)
    corners = np.array(
        [[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    target = box.mean(axis=0) if job.target is None else np.array(job.target, np.float64)
    if job.eye is not None:
        eye = np.array(job.eye, np.float64)
        forward = target - eye
        if not forward.any():
            raise UsageError(
                f"camera: eye {_show(eye)} is the same point as the target; move one of them"
            )
    else:
        eye = None
        along_z = np.abs(up[:2]).max() < 0.5 * np.abs(up[2])
        forward = np.array([-1.0, 0.0, 0.0]) if along_z else np.array([0.0, 0.0, -1.0])
    forward = forward / np.abs(forward).max()
    forward /= np.linalg.norm(forward)
    upright = up / np.abs(up).max()  # first, or the square of a tiny up would be 0
    right = np.cross(forward, upright / np.linalg.norm(upright))
    if np.linalg.norm(right) < _PARALLEL:
        raise UsageError(
            f"camera: up {_show(up)} lies along the view direction {_show(forward)}; "
            f"choose another up"
        )
    right /= np.linalg.norm(right)
    upward = np.cross(right, forward)

    width, height = job.resolution
    aspect = width / height
    away = corners - target
    x, y, z = np.abs(away @ right), np.abs(away @ upward), away @ -forward
    if job.type == "orthographic":
        fit = FRAMING_MARGIN * max(float(y.max()), float(x.max()) / aspect) or 1.0
        half_height = job.width / aspect / 2 if job.width is not None else fit
        distance = float(z.max()) + half_height
    else:
        half_height = math.tan(math.radians(job.fov) / 2)
        need = np.maximum(y, x / aspect) * FRAMING_MARGIN / half_height + z
        distance = float(need.max()) or 1.0
    if eye is None:
        eye = target - distance * forward
    return Camera(
        eye=eye,
        target=target,
        up=up,
        right=right,
        upward=upward,
        forward=forward,
        half_height=half_height,
        perspective=job.type == "perspective",
        resolution=(width, height),
    )


def _show(vector: Floats) -> str:
    return "(" + ", ".join(f"{v:g}" for v in vector) + ")"
