"""Cameras: pixels to rays, the samples within a pixel, and the framing chosen when none is given.

World space is right-handed. A camera looks along -Z of its own frame with +X to the right and +Y
up; pixel centres lie at +0.5, row 0 is the top of the image, the field of view is vertical. A
panorama is seen from inside: what is to the right of the target is to the right of it in the
picture, the upper edge is +Y, and left and right edge meet behind the eye.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from volcli import schema
from volcli.errors import UsageError

Floats = NDArray[np.float64]

Frame = tuple[Floats, Floats, Floats]
"""Unit vectors to the right, upward and forward."""

FRAMING_MARGIN = 1.05
"""How much larger than the volume's box the automatic frame is."""

CENTRE = np.array([[0.5, 0.5]])
"""(1, 2): the one sample of a pixel that has one."""

_PARALLEL = 1e-9
"""The sine of the smallest angle between ``up`` and the view that still makes a frame."""

_PLACED = 1e-3
"""What places along rays may be off by, in voxels, before it is worth a warning."""


@dataclass(frozen=True)
class Camera:
    """A camera with its frame worked out.

    Attributes
    ----------
    type
        ``perspective``, ``orthographic`` or ``panorama``, as in `schema.Camera`.
    eye, target, up
        (3,) world units, as asked for or as chosen.
    right, upward, forward
        (3,) unit vectors: the camera's +X, +Y and -Z.
    pixel
        Width and height of a pixel: at distance 1 of a perspective camera, world units of an
        orthographic one; a panorama has none, (0, 0).
    principal
        Where the axis meets the picture, in pixels from its left and from its top.
    resolution
        (width, height) in pixels.
    samples
        (n, 2): where in a pixel its rays go through, as parts of its width and height.
    """

    type: str
    eye: Floats
    target: Floats
    up: Floats
    right: Floats
    upward: Floats
    forward: Floats
    pixel: tuple[float, float]
    principal: tuple[float, float]
    resolution: tuple[int, int]
    samples: Floats

    def rays(
        self,
        rows: slice | NDArray[np.int64],
        columns: slice | NDArray[np.int64],
        samples: Floats = CENTRE,
    ) -> tuple[Floats, Floats]:
        """Origins and unit directions of pixels, sample by sample, row by row.

        Parameters
        ----------
        rows, columns
            Of the picture, or their numbers.
        samples
            (n, 2): where in each pixel, as parts of its width and height; by default its centre.

        Returns
        -------
        tuple
            (n x rows x columns, 3) each.
        """
        width, height = self.resolution
        x = np.arange(width)[columns] + samples[:, :1]
        y = np.arange(height)[rows] + samples[:, 1:]
        rays = np.empty((2, len(samples), y.shape[1], x.shape[1], 3))
        if self.type == "panorama":
            rays[0] = self.eye
            rays[1] = self._around(x, y)
            origins, directions = rays.reshape(2, -1, 3)
            return origins, directions
        x = (x - self.principal[0]) * self.pixel[0]
        y = (self.principal[1] - y) * self.pixel[1]
        for axis in range(3):
            right = (x * self.right[axis])[:, None]
            across = right + (y * self.upward[axis])[:, :, None]
            if self.type == "perspective":
                rays[0, ..., axis] = self.eye[axis]
                rays[1, ..., axis] = across + self.forward[axis]
            else:
                rays[0, ..., axis] = across + self.eye[axis]
                rays[1, ..., axis] = self.forward[axis]
        if self.type == "perspective":  # the frame is orthonormal: the length needs no sum of axes
            rays[1] /= np.sqrt(1.0 + (x * x)[:, None] + (y * y)[:, :, None])[..., None]
        origins, directions = rays.reshape(2, -1, 3)
        return origins, directions

    def _around(self, x: Floats, y: Floats) -> Floats:
        """(n, rows, columns, 3): unit directions of a panorama through x and y, in pixels.

        Longitude, 2 pi (x / width - 1/2), grows from forward to the right; latitude,
        pi (1/2 - y / height), upward.
        """
        longitude = 2 * math.pi * (x / self.resolution[0] - 0.5)[:, None, :, None]
        latitude = math.pi * (0.5 - y / self.resolution[1])[:, :, None, None]
        level = np.cos(longitude) * self.forward + np.sin(longitude) * self.right
        return np.cos(latitude) * level + np.sin(latitude) * self.upward

    def warnings(self, voxel_from_world: Floats) -> list[str]:
        """What the user should know of a camera so far away that float64 has too few digits.

        Parameters
        ----------
        voxel_from_world
            (3, 4): of it and of the eye are the sums that are rounded.
        """
        matrix = np.abs(voxel_from_world)
        sums = matrix[:, :3] @ np.abs(self.eye) + matrix[:, 3]
        off = float(sums.max() * np.finfo(np.float64).eps)
        if off <= _PLACED:
            return []
        return [
            f"camera: rays are placed to {off:.1g} voxels only, as float64 holds them so far away; "
            "bring the eye nearer to the volume, and both nearer to the world's origin"
        ]

    def depth_per_distance(self, directions: Floats) -> Floats:
        """(n,): depth per unit of distance along each ray.

        Depth is measured along the camera's axis; a panorama has none, and depth is distance.
        """
        if self.type == "panorama":
            return np.ones(len(directions))
        # Not a matrix product, whose last bit depends on how many rays there are.
        x, y, z = (directions[:, axis] * self.forward[axis] for axis in range(3))
        return x + y + z


def sample_positions(count: int) -> Floats:
    """(count, 2): the Hammersley points of a pixel, as parts of its width and height.

    Each of ``count`` equal columns, and each of as many rows, holds one point, in its middle: the
    columns from left to right, the rows in the order of the radical inverse in base 2 of the
    column's number (van der Corput's sequence; Hammersley 1960). For a power of 2 each of the
    count rectangles of any partition into 2^a x 2^b holds one, and 4 are a rotated grid. The points
    are the same for every pixel, their mean is the pixel's centre, and 1 is the centre itself.
    """
    bits = (count - 1).bit_length()
    inverse = [int(f"{column:0{bits}b}"[::-1], 2) for column in range(count)]
    row = np.argsort(np.argsort(inverse))
    return (np.column_stack([np.arange(count), row]) + 0.5) / count


def make_camera(job: schema.Camera, box: Floats) -> Camera:
    """Work out a camera from a job; what the job leaves out is chosen to frame ``box``.

    Parameters
    ----------
    job
        Eye and target may be absent: the target becomes the middle of the box, the eye is put in
        front of it (on +Z, or where +Z is ``up``, on +X) so that the whole box is in the picture.
        The eye of a panorama is put in the middle of the box, and what it then looks at is
        straight ahead (-Z, or -X). Cameras of ``transforms`` have been read before
        (`volcli.transforms`).
    box
        (2, 3) world units: the volume.

    Raises
    ------
    UsageError
        If the eye is the target, or ``up`` lies along the view.
    """
    up = np.array(job.up, np.float64)
    eye = None if job.eye is None else np.array(job.eye, np.float64)
    target = box.mean(axis=0) if job.target is None else np.array(job.target, np.float64)
    ahead = _ahead(up)
    if job.type == "panorama":
        eye = box.mean(axis=0) if eye is None else eye
        if job.target is None and (eye == target).all():
            target = eye + ahead * max(1.0, float(np.abs(box).max()))
    if eye is None:
        forward = ahead
    else:
        forward = target - eye
        if not forward.any():
            raise UsageError(
                f"camera: eye {_show(eye)} is the same point as the target; move one of them"
            )
    right, upward, forward = _frame(forward, up)

    width, height = job.size
    pixel = (0.0, 0.0)
    if job.type != "panorama":
        half_height, distance = frame_box(job, box, target, (right, upward, forward))
        pixel = (2.0 * half_height / height,) * 2
    if job.focal is not None:
        pixel = (1.0 / job.focal[0], 1.0 / job.focal[1])
    if eye is None:
        eye = target - distance * forward
    return Camera(
        type=job.type,
        eye=eye,
        target=target,
        up=up,
        right=right,
        upward=upward,
        forward=forward,
        pixel=pixel,
        principal=job.principal or (width / 2, height / 2),
        resolution=(width, height),
        samples=sample_positions(job.samples),
    )


def _ahead(up: Floats) -> Floats:
    """Where a camera looks that was told neither eye nor target: -Z, or where Z is up, -X."""
    along_z = np.abs(up[:2]).max() < 0.5 * np.abs(up[2])
    return np.array([-1.0, 0.0, 0.0]) if along_z else np.array([0.0, 0.0, -1.0])


def _frame(forward: Floats, up: Floats) -> Frame:
    """Unit vectors to the right, upward and forward."""
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
    return right, np.cross(right, forward), forward


def frame_box(job: schema.Camera, box: Floats, target: Floats, frame: Frame) -> tuple[float, float]:
    """(half the picture's height, distance of an eye that sees the whole box).

    The height is that at distance 1 of a perspective camera, world units of an orthographic one.
    """
    corners = np.array(
        [[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    away = corners - target
    right, upward, forward = frame
    x, y, z = np.abs(away @ right), np.abs(away @ upward), away @ -forward
    aspect = job.size[0] / job.size[1]
    if job.type == "orthographic":
        fit = FRAMING_MARGIN * max(float(y.max()), float(x.max()) / aspect) or 1.0
        half_height = job.width / aspect / 2 if job.width is not None else fit
        return half_height, float(z.max()) + half_height
    fov = schema.DEFAULT_FOV if job.fov is None else job.fov
    half_height = math.tan(math.radians(fov) / 2)
    need = np.maximum(y, x / aspect) * FRAMING_MARGIN / half_height + z
    return half_height, float(need.max()) or 1.0


def _show(vector: Floats) -> str:
    return "(" + ", ".join(f"{v:g}" for v in vector) + ")"
