"""A plan, its grids and a camera to arrays: the flow of an image.

Tiles of rays are shared out among threads (the kernels release the interpreter lock); each writes
its own part of the image. Nothing here reads or writes files.
"""

from __future__ import annotations

import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from volcli.bounds import SceneBounds, brightest_light
from volcli.camera import Camera
from volcli.errors import NonFiniteError, UsageError
from volcli.grids import BrickGrid, Progress
from volcli.grids.brick import to_world
from volcli.plan import Plan
from volcli.tables import ColorTable, TransferTable

if TYPE_CHECKING:
    from volcli.kernels.integrator import Integrator

Floats = NDArray[np.float32]

MAX_STEPS = 10_000_000
"""Samples of the midpoint rule along one ray at most: beyond, a picture would never be done."""

Window = tuple[int, int, int, int]
"""A rectangle of an image's pixels: left, top, width, height."""

PIXEL_ERROR = 2.0**-23
"""What rounding to float32 changes at most in a transmittance or a share of the brightest light,
and all rounding before it, which is in float64."""

TILE = 64
"""Edge of a tile in pixels: its rays share bricks, and there are enough tiles for all threads."""


@dataclass(frozen=True)
class Source:
    """Radiance, or emission, that varies from point to point.

    Attributes
    ----------
    grid
        A grid of three channels, or one of one channel with a table.
    table
        The colour of a value of a grid of one channel; None where there are three.
    scale
        What the values of a grid of three channels are multiplied by.
    """

    grid: BrickGrid
    table: ColorTable | None = None
    scale: float = 1.0


@dataclass(frozen=True)
class Scene:
    """What is rendered.

    Attributes
    ----------
    density
        The density grid.
    scale
        Extinction per unit of density, 1 / world unit.
    color
        A source of radiance, or one radiance (r, g, b).
    emission
        A source of radiance per world unit, 0 outside its grid's support; or None.
    tint
        Factors (r, g, b) of the extinction, or None.
    transfer
        Density by the value of the grid, before ``scale``; None: the value itself.
    bounds
        What the grids are at most and at least, brick by brick; needed where an error is allowed.
    """

    density: BrickGrid
    scale: float
    color: Source | tuple[float, float, float]
    emission: Source | None = None
    tint: tuple[float, float, float] | None = None
    transfer: TransferTable | None = None
    bounds: SceneBounds | None = None


@dataclass(frozen=True)
class RenderResult:
    """A rendered image, without its background.

    Attributes
    ----------
    radiance
        (h, w, 3) float32: light of the volume alone, so premultiplied.
    optical_depth, transmittance, opacity
        (h, w) float32: tau, exp(-tau) and 1 - exp(-tau), each rounded once from float64. Under a
        tint (h, w, 3), a channel each: tint_c tau, ...
    depth
        (h, w) float32: the expected hit distance along the camera's axis (of a panorama: along the
        ray), world units, +inf where nothing can be hit; None when the plan leaves it out. A tint
        leaves it as it is.

    error_bound
        (h, w) float32: no farther than this are transmittance and opacity (each channel of them)
        from what they would be without ``Plan.max_error``, nor is radiance, as a share of the
        brightest light that the scene can show; rounding included. None where nothing was allowed.
    error_estimate
        (h, w) float32: what radiance is estimated to be off by, by the exact rule, as a share of
        the brightest light; rounding included. No bound. None where nobody asked.

    Of a pixel with several samples each is the mean over them. For optical depth that is what lies
    behind the pixel on average (mass over area), no longer -log of the mean transmittance, which
    the other layer gives. Depth is weighted with each sample's opacity, the probability that it
    hits.

    evaluations
        Cells, or samples of the midpoint rule.
    compile_seconds, render_seconds
        Time to have the kernel ready, and to run it.
    """

    radiance: Floats
    optical_depth: Floats
    transmittance: Floats
    opacity: Floats
    depth: Floats | None
    error_bound: Floats | None
    error_estimate: Floats | None
    evaluations: int
    compile_seconds: float
    render_seconds: float

    @property
    def alpha(self) -> Floats:
        """(h, w) float32: opacity, the mean over its channels where there are three."""
        if self.opacity.ndim == 2:
            return self.opacity
        return self.opacity.mean(axis=-1, dtype=np.float64).astype(np.float32)


def available_threads() -> int:
    """The processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def render(
    scene: Scene,
    plan: Plan,
    camera: Camera,
    *,
    threads: int | None = None,
    window: Window | None = None,
    progress: Progress | None = None,
) -> RenderResult:
    """Render an image.

    Parameters
    ----------
    scene, plan, camera
        What, how and from where.
    threads
        Default: the processors that this process may use. The image does not depend on it.
    window
        The part of the image to render; its pixels are, to the bit, those of the whole image.
    progress
        Called with tiles done and tiles in all.

    Raises
    ------
    NonFiniteError
        If a pixel is NaN or Inf, naming the first.
    UsageError
        If the midpoint rule's step is so short that a ray would take more than `MAX_STEPS`.
    """
    _check_step(scene, plan)
    left, top, width, height = window or (0, 0, *camera.resolution)

    def layer(value: float, *channels: int) -> Floats:
        return np.full((height, width, *channels), value, np.float32)

    tint = None if scene.tint is None else np.array(scene.tint)
    channels = () if tint is None else (3,)
    tau, transmittance, opacity = (layer(value, *channels) for value in (0, 1, 0))
    light = layer(0, 3)
    depth = layer(np.inf) if plan.depth else None
    bound = None if plan.max_error is None else layer(PIXEL_ERROR)
    doubt = layer(PIXEL_ERROR) if plan.estimate else None
    brightest = brightest_light(scene, plan.nearest, threads) if plan.estimate else 0.0
    constant = np.array(scene.color) if isinstance(scene.color, tuple) else None

    begin = time.perf_counter()
    integrate = make_integrator(scene, plan, estimate=plan.estimate)
    nothing = np.empty((0, 3))
    integrate(nothing, nothing)  # compiles
    compiled = time.perf_counter()

    def one_tile(corner: tuple[int, int]) -> int:
        rows = slice(corner[0], min(corner[0] + edge, height))
        columns = slice(corner[1], min(corner[1] + edge, width))
        shape = (samples, *light[rows, columns].shape[:2])
        origins, directions = camera.rays(
            slice(top + rows.start, top + rows.stop),
            slice(left + columns.start, left + columns.stop),
            camera.samples,
        )
        ray_tau, ray_light, ray_distance, ray_error, evaluations = integrate(origins, directions)
        ray_opacity = ray_hit = -np.expm1(-ray_tau)
        if tint is not None:
            ray_tau = ray_tau[:, None] * tint
            ray_opacity = -np.expm1(-ray_tau)
        if constant is not None:
            ray_light = ray_light + ray_opacity.reshape(len(ray_light), -1) * constant
        with np.errstate(over="ignore"):  # beyond float32 it is Inf, and reported as such
            tau[rows, columns] = _mean(ray_tau.reshape(*shape, *channels))
            light[rows, columns] = _mean(ray_light.reshape(*shape, 3))
        transmittance[rows, columns] = _mean(np.exp(-ray_tau).reshape(*shape, *channels))
        opacity[rows, columns] = _mean(ray_opacity.reshape(*shape, *channels))
        if depth is not None:
            assert ray_distance is not None, "the plan asked for it"
            ray_depth = ray_distance * camera.depth_per_distance(directions)
            depth[rows, columns] = _mean_depth(ray_depth.reshape(shape), ray_hit.reshape(shape))
        if bound is not None:
            assert ray_error is not None, "as above"
            bound[rows, columns] = _upwards(_mean(ray_error.reshape(shape)) + PIXEL_ERROR)
        if doubt is not None and brightest > 0:
            assert ray_error is not None, "as above"
            share = _mean(ray_error.reshape(shape)) / brightest
            doubt[rows, columns] = _upwards(share + PIXEL_ERROR)
        return evaluations

    evaluations = 0
    samples = len(camera.samples)
    edge = max(1, TILE // (math.isqrt(samples - 1) + 1))  # of about as many rays for any samples
    tiles = [(y, x) for y in range(0, height, edge) for x in range(0, width, edge)]
    if not (scene.density.is_empty and (scene.emission is None or scene.emission.grid.is_empty)):
        pool = ThreadPoolExecutor(threads or available_threads())
        try:
            for done, count in enumerate(pool.map(one_tile, tiles), start=1):
                evaluations += count
                if progress is not None:
                    progress(done, len(tiles))
        finally:  # an interrupt does not wait for the tiles that are still to come
            pool.shutdown(wait=True, cancel_futures=True)
    result = RenderResult(
        radiance=light,
        optical_depth=tau,
        transmittance=transmittance,
        opacity=opacity,
        depth=depth,
        error_bound=bound,
        error_estimate=doubt,
        evaluations=evaluations,
        compile_seconds=compiled - begin,
        render_seconds=time.perf_counter() - compiled,
    )
    _check_finite(result, left, top)
    return result


def _upwards(values: NDArray[Any]) -> Floats:
    """To float32, to a number that is not smaller."""
    rounded = values.astype(np.float32)
    return np.where(rounded < values, np.nextafter(rounded, np.float32(np.inf)), rounded)


def _sum(values: NDArray[Any]) -> NDArray[Any]:
    """The sum over the first axis, from the first to the last whatever the shape of the tile.

    np.sum chooses its order by the shape, and with it the last bit.
    """
    total: NDArray[Any] = np.cumsum(values, axis=0)[-1]
    return total


def _mean(values: NDArray[Any]) -> NDArray[Any]:
    """The mean over the first axis, the samples of a pixel."""
    return values[0] if len(values) == 1 else _sum(values) / len(values)


def _mean_depth(depth: NDArray[Any], opacity: NDArray[Any]) -> NDArray[Any]:
    """The mean over the first axis, weighted with the probability of a hit; +inf where it is 0."""
    if len(depth) == 1:
        one: NDArray[Any] = depth[0]
        return one
    hit = opacity > 0
    total = _sum(opacity)
    weight = opacity / np.where(total > 0, total, 1.0)
    mean = _sum(np.multiply(weight, depth, out=np.zeros_like(depth), where=hit))
    return np.where(hit.any(axis=0), mean, np.inf)


def over(result: RenderResult, background: Floats | None) -> Floats:
    """(h, w, 4) float32, premultiplied: the picture, C + T c_background.

    Parameters
    ----------
    background
        (h, w, 4), or (4,), premultiplied; None: nothing is behind the volume.

    Raises
    ------
    NonFiniteError
        If a pixel is beyond what float32 can hold.
    """
    picture: Floats = np.dstack([result.radiance, result.alpha])
    if background is None:
        return picture
    behind = np.asarray(background, np.float32)
    if result.transmittance.ndim == 2:
        seen: Floats = result.transmittance[..., None]
    else:
        seen = np.dstack([result.transmittance, 1 - result.alpha])
    with np.errstate(over="ignore"):  # as above
        picture = picture + seen * behind
    finite = np.isfinite(picture).all(axis=-1)
    if not finite.all():
        y, x = (int(v) for v in np.argwhere(~finite)[0])
        raise NonFiniteError(
            f"{int((~finite).sum())} pixels over the background are NaN or Inf, the first at "
            f"x={x}, y={y}; give a darker background"
        )
    return picture


def make_integrator(scene: Scene, plan: Plan, *, estimate: bool = False) -> Integrator:
    """A function of origins and directions to `kernels.integrator.Traced`.

    Parameters
    ----------
    estimate
        Whether the error of the exact rule's radiance is to be estimated.
    """
    from volcli.kernels import integrator
    from volcli.kernels.rays import Density
    from volcli.kernels.transfer import Transfer

    grid, transfer = scene.density, scene.transfer
    outside = float(grid.background if transfer is None else transfer.at(grid.background))
    interpolation = "nearest" if plan.nearest else "linear"
    return integrator.make_integrator(
        Density(
            grid.arrays,
            grid.local_from_world,
            grid.support(interpolation),
            float(scene.scale),
            outside == 0 and scene.emission is None,
        ),
        transfer=None if transfer is None else Transfer(transfer.knots, transfer.values),
        colour=_kernel_source(scene.color, grid, interpolation),
        emission=_kernel_source(scene.emission, grid, interpolation),
        tint=scene.tint,
        step_voxels=plan.step_voxels,
        nearest=plan.nearest,
        depth=plan.depth,
        bounds=_kernel_bounds(scene, plan),
        estimate=estimate,
    )


def _kernel_bounds(scene: Scene, plan: Plan) -> Any:
    """The bounds as the kernels take them, with what of the error is left to them."""
    from volcli.kernels.bounds import Bounds

    if plan.max_error is None:
        return None
    assert scene.bounds is not None, "made where a plan allows an error"
    made = scene.bounds
    return Bounds(
        made.density,
        made.least,
        made.finest,
        made.boxes,
        made.colour,
        made.emission,
        plan.max_error - 2 * PIXEL_ERROR,
        made.brightest,
        made.contrast,
    )


def _kernel_source(
    source: Source | tuple[float, float, float] | None, density: BrickGrid, interpolation: str
) -> Any:
    """A source as the kernels take it; None for a constant, which they need not know."""
    from volcli.kernels.source import Source as KernelSource
    from volcli.kernels.source import Table

    if not isinstance(source, Source):
        return None
    grid, table = source.grid, source.table
    brightest = source.scale * grid.brightest if table is None else float(table.colors.max())
    same = np.array_equal(density.world_from_index, grid.world_from_index)
    return KernelSource(
        grid.arrays,
        None if table is None else Table(table.knots, table.colors, table.kinks, table.bends),
        source.scale if table is None else None,
        grid.local_from_world,
        grid.support(interpolation),
        True if same else None,
        density.origin - grid.origin,
        brightest,
    )


def _check_step(scene: Scene, plan: Plan) -> None:
    grids = [scene.density, *([] if scene.emission is None else [scene.emission.grid])]
    grids = [grid for grid in grids if not grid.is_empty]
    if plan.step_voxels is None or not grids:
        return
    voxel_from_world = np.linalg.inv(scene.density.world_from_index)
    rim = np.array([[-1], [1]])
    boxes = [
        to_world(grid.active_box + rim, voxel_from_world @ grid.world_from_index) for grid in grids
    ]  # in voxels of the density, as steps are
    extent = np.max(boxes, axis=0)[1] - np.min(boxes, axis=0)[0]
    longest = float(np.linalg.norm(extent))
    if longest / plan.step_voxels > MAX_STEPS:
        raise UsageError(
            f"--step {plan.step_voxels:g}: up to {longest / plan.step_voxels:.0e} samples a ray; "
            f"give at least {1.1 * longest / MAX_STEPS:.1e} voxels, or none: exact is faster"
        )


def _check_finite(result: RenderResult, left: int, top: int) -> None:
    tau = result.optical_depth.reshape(*result.radiance.shape[:2], -1)
    bad = ~np.isfinite(tau).all(axis=-1) | ~np.isfinite(result.radiance).all(axis=-1)
    if result.depth is not None:
        bad |= np.isnan(result.depth)
    if bad.any():
        y, x = (int(v) for v in np.argwhere(bad)[0])
        error = NonFiniteError(
            f"{int(bad.sum())} pixels are NaN or Inf, the first at x={left + x}, y={top + y} "
            f"(optical depth {tau[y, x].max():g}); a smaller density.scale may help"
        )
        error.pixel = (left + x, top + y)
        raise error
    for part in (result.transmittance, result.opacity):
        assert ((part >= 0) & (part <= 1)).all(), "transmittance is a probability"
