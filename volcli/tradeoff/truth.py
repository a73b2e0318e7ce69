"""What every pixel of a picture should be: float64, on the same rays.

Optical depth by the exact rule is right to rounding, and so is a constant colour. Light that varies
is summed by quadrature; there the certified rule is taken, with an error far below what is judged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from volcli.camera import Camera
from volcli.plan import Plan
from volcli.render import PIXEL_ERROR, RenderResult, Scene, Source
from volcli.trace import Floats, trace

ERROR = 1e-10
"""Of light that varies, as a share of the brightest, and of transmittance beside it: certified."""

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
    error_bound
        What the truth itself is off by at most, rounding in float64 apart.
    """

    transmittance: Floats
    radiance: Floats
    brightest: float
    error_bound: float

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
    threads: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Truth:
    """Trace a whole picture in float64.

    Parameters
    ----------
    scene
        With its bounds.
    plan
        Of any rule.
    progress
        Called with rows done and rows in all.
    """
    width, height = camera.resolution
    samples = len(camera.samples)
    assert scene.bounds is not None, "as above"
    varies = isinstance(scene.color, Source) or scene.emission is not None
    allowed = ERROR + 2 * PIXEL_ERROR if varies else None  # what pixels are rounded by is not ours
    best = replace(plan, step_voxels=None, max_error=allowed, target_error=None)
    error = 0.0
    rows = max(1, _RAYS // (width * samples))
    parts = []
    for top in range(0, height, rows):
        progress(top, height)
        rays = camera.rays(slice(top, top + rows), slice(None), camera.samples)
        seen = trace(scene, best, *rays, threads)
        if seen.error_bound is not None:
            error = max(error, float(seen.error_bound.max()) - PIXEL_ERROR)
        parts.append(
            [
                values.reshape(samples, -1, width, values.shape[1]).mean(axis=0)
                for values in (seen.transmittance, seen.radiance)
            ]
        )
    progress(height, height)
    transmittance, radiance = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Truth(transmittance, radiance, scene.bounds.brightest, error)
