"""Rays of a scene by a rule, in float64 and not yet pixels: what one rule is held to another by."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from volcli.grids.threads import in_threads, threads_limited_to
from volcli.plan import Plan
from volcli.render import PIXEL_ERROR, Scene, make_integrator

Floats = NDArray[np.float64]

_CHUNK = 1024
"""Rays that a thread takes at a time."""


@dataclass(frozen=True)
class RayResult:
    """What a rule makes of n rays.

    Attributes
    ----------
    optical_depth
        (n,).
    transmittance
        (n, 1), or (n, 3) under a tint.
    radiance
        (n, 3): the light of the volume alone.
    error_bound
        (n,): what each is certified to be off by at most, float32 included; None of a rule that
        certifies nothing.
    evaluations
        Cells, samples, or parts taken as a whole.
    """

    optical_depth: Floats
    transmittance: Floats
    radiance: Floats
    error_bound: Floats | None
    evaluations: int


def trace(
    scene: Scene, plan: Plan, origins: Floats, directions: Floats, threads: int | None = None
) -> RayResult:
    """What the rule of a plan makes of rays, (n, 3) float64 each.

    Parameters
    ----------
    threads
        Default: the processors that this process may use. The result does not depend on it.
    """
    integrate = make_integrator(scene, plan)
    nothing = np.empty((0, 3))
    integrate(nothing, nothing)  # compiles

    def one_chunk(first: int) -> RayResult:
        rays = slice(first, first + _CHUNK)
        tau, light, _, error, evaluations = integrate(origins[rays], directions[rays])
        tinted = tau[:, None] * (1.0 if scene.tint is None else np.array(scene.tint))
        if isinstance(scene.color, tuple):
            light = light - np.expm1(-tinted) * np.array(scene.color)
        bound = None if error is None else error + PIXEL_ERROR
        return RayResult(tau, np.exp(-tinted), light, bound, evaluations)

    with threads_limited_to(threads):
        chunks = list(in_threads(one_chunk, range(0, len(origins), _CHUNK)))
    joined = {
        field.name: np.concatenate([getattr(chunk, field.name) for chunk in chunks])
        for field in fields(RayResult)
        if isinstance(getattr(chunks[0], field.name), np.ndarray)
    }
    return RayResult(
        optical_depth=joined["optical_depth"],
        transmittance=joined["transmittance"],
        radiance=joined["radiance"],
        error_bound=joined.get("error_bound"),
        evaluations=sum(chunk.evaluations for chunk in chunks),
    )


def errors(result: RayResult, truth: RayResult, brightest: float) -> Floats:
    """(n,): how far off each ray is, the largest of all channels of transmittance and of radiance,
    the latter as a share of the brightest light (`bounds.brightest_light`).
    """
    off = np.abs(result.transmittance - truth.transmittance).max(axis=1)
    if brightest > 0:
        light = np.abs(result.radiance - truth.radiance).max(axis=1) / brightest
        off = np.maximum(off, light)
    found: Floats = off
    return found
