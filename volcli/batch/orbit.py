"""Cameras of many pictures: around a turntable, and one that frames a whole sequence.

A camera is turned as a rigid body about an axis through its target, so ``up`` turns with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from volcli.batch.schema import Orbit
from volcli.camera import Frame, frame_box, make_camera
from volcli.errors import VolumeError
from volcli.estimate import plan_of
from volcli.grids.brick import to_world
from volcli.scene import make_scene, open_volumes, read_grids, scene_box
from volcli.schema import Camera, Job

Floats = NDArray[np.float64]


def is_framed(camera: Camera) -> bool:
    """Whether a part of the camera is chosen by what the volume is."""
    return camera.transforms is None and None in (camera.eye, camera.target)


def on_orbit(camera: Camera, orbit: Orbit, count: int, box: Floats | None) -> list[Camera]:
    """The cameras of a turntable of ``count`` pictures.

    Parameters
    ----------
    box
        (2, 3) world units: the volume. Only for a camera that frames it: all of it is then in
        every picture, and eye and target keep their distance.

    Raises
    ------
    UsageError
        If the camera has no frame (see `camera.make_camera`).
    """
    turns = [_rotation(orbit.vector, math.radians(orbit.degrees) * i / count) for i in range(count)]
    if is_framed(camera):
        assert box is not None, "what frames a volume is asked for only with a volume"
        camera = _framing(camera, box, turns)
    assert camera.eye is not None and camera.target is not None
    target, up = np.array(camera.target), np.array(camera.up)
    away = np.array(camera.eye) - target
    return [
        camera.model_copy(update={"eye": _vector(target + turn @ away), "up": _vector(turn @ up)})
        for turn in turns
    ]


def framing(camera: Camera, box: Floats) -> Camera:
    """The camera with what it leaves open chosen to frame a box."""
    return _framing(camera, box, [np.eye(3)])


def box_of(jobs: Iterable[Job]) -> Floats | None:
    """(2, 3) world units: the box around the volumes of some jobs, as far as they can be read.

    From headers, and from the values of a grid whose header does not say.
    """
    boxes = []
    for job in jobs:
        try:
            box = _box(job)
        except VolumeError:
            continue  # the job itself will say so
        if box is not None and np.isfinite(box).all():
            boxes.append(box)
    if not boxes:
        return None
    return np.array([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])


def _box(job: Job) -> Floats | None:
    """What `scene.scene_box` will find, from the headers."""
    volumes = open_volumes(job)
    plan = plan_of(job, volumes)
    boxes = []
    for header in (plan.density, plan.emission):
        if header is None:
            continue
        if header.active_box is None or header.world_from_index is None:
            grids, _ = read_grids(job, plan, volumes)
            return scene_box(make_scene(job, plan, volumes, grids)[0])
        boxes.append(to_world(np.array(header.active_box), header.world_from_index))
    return np.array([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])


def _framing(camera: Camera, box: Floats, turns: list[Floats]) -> Camera:
    """What frames a box from every side that a camera is turned to."""
    start = make_camera(camera, box)
    fits = []
    for turn in turns:
        frame: Frame = (turn @ start.right, turn @ start.upward, turn @ start.forward)
        fits.append(frame_box(camera, box, start.target, frame))
    chosen = {"target": _vector(start.target), "eye": _vector(start.eye)}
    if camera.eye is None and camera.type != "panorama":
        distance = max(far for _, far in fits)
        chosen["eye"] = _vector(start.target - distance * start.forward)
    if camera.type == "orthographic" and camera.width is None:
        width, height = camera.size
        return camera.model_copy(
            update={**chosen, "width": 2 * max(half for half, _ in fits) * width / height}
        )
    return camera.model_copy(update=chosen)


def _rotation(axis: tuple[float, float, float], angle: float) -> Floats:
    """(3, 3): the rotation by an angle in radians about an axis, right-handed (Rodrigues)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _vector(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
