"""Which compiled loop serves a scene, and the memory that it works in.

Packets are two to three times faster, and are taken where the machine has registers for them and no
term of the scene asks for rays one by one; they give the same numbers to rounding.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.lanes import LANES
from volcli.kernels.rays import Density
from volcli.kernels.source import Source
from volcli.kernels.transfer import Transfer

Integrator = Callable[[NDArray[Any], NDArray[Any]], tuple[Any, Any, Any, int]]


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
    packets: bool = LANES > 1,
) -> Integrator:
    """A function of origins and directions, (n, 3) float64 each, that any thread may call.

    It returns (tau, radiance, distance, evaluated): (n,), (n, 3), (n,) float64 and a number. The
    radiance is 0 without ``colour`` and ``emission``, the distance None without ``depth``. What the
    parameters mean is said in `rays.integrate_rays`.

    Parameters
    ----------
    packets
        Whether packets may be used.
    """
    how = (step_voxels, True if nearest else None)  # a term that is out is None, not False

    if packets and transfer is None and colour is None and emission is None:
        from volcli.kernels.packets import integrate_packets, packet_buffer

        def run(rays: Any, distance: Any, tau: Any, light: Any, buffer: Any) -> int:
            return integrate_packets(*rays, density, *how, distance, tau, buffer)

        make_buffer: Callable[[], Any] = packet_buffer
    else:
        from volcli.kernels.rays import integrate_rays
        from volcli.kernels.traversal import segment_buffer

        terms = (transfer, colour, emission, tint if colour or emission else None)

        def run(rays: Any, distance: Any, tau: Any, light: Any, buffer: Any) -> int:
            return integrate_rays(*rays, density, *terms, *how, distance, tau, light, buffer)

        make_buffer = segment_buffer

    kept = threading.local()  # each thread keeps its buffer: memory that is new is slow

    def integrate(origins: NDArray[Any], directions: NDArray[Any]) -> tuple[Any, Any, Any, int]:
        if not hasattr(kept, "buffer"):
            kept.buffer = make_buffer()
        n = len(origins)
        tau, light, distance = np.zeros(n), np.zeros((n, 3)), np.empty(n) if depth else None
        evaluated = run((origins, directions), distance, tau, light, kept.buffer)
        return tau, light, distance, int(evaluated)

    return integrate
