"""What every pixel of a picture should be: float64, by the exact rule, on the same rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from volcli.camera import Camera
from volcli.plan import Plan
from volcli.render import RenderResult, Scene
from volcli.trace import Floats, trace

_RAYS = 2**18
"""That are traced at a time."""


@dataclass(frozen=True)
class Truth:
    """The pixels of a picture, the mean over the samples of each.

    Attributes
    ----------
    transmittance
        (h, w, 1), or (h, w, 3) under a tint.
    radiance
        (h, w, 3): the light of the volume alone.
    brightest
        The light that errors of radiance are shares of; see `bounds.brightest_light`.
    """

    transmittance: Floats
    radiance: Floats
    brightest: float

    def errors(self, result: RenderResult) -> Floats:
        """(h, w): how far off each pixel is, the largest of all channels of transmittance, and of
        radiance as a share of the brightest light.
        """
        shape = self.transmittance.shape
        off = np.abs(result.transmittance.reshape(shape) - self.transmittance).max(axis=-1)
        if self.brightest > 0:
            light = np.abs(result.radiance - self.radiance).max(axis=-1) / self.brightest
            off = np.maximum(off, light)
        found: Floats = off
        return found


def true_picture(
    scene: Scene,
    plan: Plan,
    camera: Camera,
    brightest: float,
    threads: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Truth:
    """Trace a whole picture in float64.

    Parameters
    ----------
    plan
        Of any rule.
    progress
        Called with rows done and rows in all.
    """
    width, height = camera.resolution
    samples = len(camera.samples)
    exact = replace(plan, step_voxels=None, max_error=None, target_error=None)
    rows = max(1, _RAYS // (width * samples))
    parts = []
    for top in range(0, height, rows):
        progress(top, height)
        rays = camera.rays(slice(top, top + rows), slice(None), camera.samples)
        seen = trace(scene, exact, *rays, threads)
        parts.append(
            [
                values.reshape(samples, -1, width, values.shape[1]).mean(axis=0)
                for values in (seen.transmittance, seen.radiance)
            ]
        )
    progress(height, height)
    transmittance, radiance = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Truth(transmittance, radiance, brightest)
