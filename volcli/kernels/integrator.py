"""Which compiled loop serves a scene, and the memory that it works in.

Packets are two to three times faster, and are taken where the machine has registers for them and no
term of the scene asks for rays one by one; they give the same numbers to rounding.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.bounds import Bounds
from volcli.kernels.lanes import LANES
from volcli.kernels.rays import Density
from volcli.kernels.source import Source
from volcli.kernels.transfer import Transfer


class Traced(NamedTuple):
    """What rays see.

    Attributes
    ----------
    tau
        (n,) float64: optical depth.
    radiance
        (n, 3) float64: the light of sources that vary from point to point; 0 without one.
    distance
        (n,) float64: the expected hit distance, +inf where nothing can be hit; None if not wanted.
    error
        (n,) float64: what transmittance, and radiance as a share of the brightest, is off by at
        most; None where nobody asked for less than all.
    evaluated
        Cells, or samples, or parts taken as a whole.
    """

    tau: NDArray[np.float64]
    radiance: NDArray[np.float64]
    distance: NDArray[np.float64] | None
    error: NDArray[np.float64] | None
    evaluated: int


Integrator = Callable[[NDArray[Any], NDArray[Any]], Traced]


def _in_step(
    density: Density,
    colour: Source | None,
    step_voxels: float | None,
    bounds: Bounds | None,
    estimate: bool,
    tint: tuple[float, float, float] | None,
) -> bool:
    """Whether packets can see the colour, if there is one (`packet_light`).

    (On one lattice its bricks are those of the density: grids begin at root cells.)
    """
    if colour is None:
        return True
    return (
        step_voxels is None
        and bounds is None
        and not estimate
        and tint is None
        and colour.table is None
        and colour.scale > 0
        and colour.same_lattice is not None
        and density.skip_background
    )


def make_integrator(
    density: Density,
    *,
    transfer: Transfer | None = None,
    colour: Source | None = None,
    emission: Source | None = None,
    tint: tuple[float, float, float] | None = None,
    step_voxels: float | None,
    nearest: bool,
    depth: bool,
    bounds: Bounds | None = None,
    estimate: bool = False,
    packets: bool = LANES > 1,
) -> Integrator:
    """A function of origins and directions, (n, 3) float64 each, that any thread may call.

    What the parameters mean is said in `rays.integrate_rays`.

    Parameters
    ----------
    bounds
        What the rule may use instead of cells, and the error that it may make; None: exact.
    estimate
        Whether the error of radiance is to be estimated; of the exact rule, without bounds.
    packets
        Whether packets may be used.
    """
    how = (step_voxels, True if nearest else None)  # a term that is out is None, not False
    if not (colour or emission or bounds):
        tint = None  # then it is for the caller, as the constant colour is

    if (
        packets
        and transfer is None
        and emission is None
        and _in_step(density, colour, step_voxels, bounds, estimate, tint)
    ):
        from volcli.kernels.packets import integrate_packets, packet_buffer

        def run(rays: Any, distance: Any, error: Any, tau: Any, light: Any, buffer: Any) -> int:
            if bounds is None:  # then nothing is off, by any estimate
                error = None
            return integrate_packets(
                *rays, density, colour, *how, bounds, tint, distance, error, tau, light, *buffer
            )

        def make_buffer() -> Any:
            return packet_buffer(bounds, colour)

    else:
        from volcli.kernels.rays import integrate_rays
        from volcli.kernels.traversal import segment_buffer

        terms = (transfer, colour, emission, tint)
        guess = True if estimate else None

        def run(rays: Any, distance: Any, error: Any, tau: Any, light: Any, buffer: Any) -> int:
            return integrate_rays(
                *rays, density, *terms, *how, bounds, guess, distance, error, tau, light, buffer
            )

        make_buffer = segment_buffer

    kept = threading.local()  # each thread keeps its buffer: memory that is new is slow

    def integrate(origins: NDArray[Any], directions: NDArray[Any]) -> Traced:
        if not hasattr(kept, "buffer"):
            kept.buffer = make_buffer()
        n = len(origins)
        tau, light, distance = np.zeros(n), np.zeros((n, 3)), np.empty(n) if depth else None
        error = np.zeros(n) if bounds is not None or estimate else None
        evaluated = run((origins, directions), distance, error, tau, light, kept.buffer)
        return Traced(tau, light, distance, error, int(evaluated))

    return integrate
