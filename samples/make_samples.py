#!/usr/bin/env python3
"""Make the sample volumes of volcli.

    python3 make_samples.py OUT_DIR [NAME ...]

needs numpy and the OpenVDB Python module (`openvdb`, or `pyopenvdb` as Debian
names it; the latter wants numpy < 2).  Nothing is random from one run to the
next: the seeds are fixed, and so is the UUID of each file.

volcli knows emission and absorption but no scattering, so the light is baked:
each `Cd` grid holds the radiance that leaves a point towards the camera, with
the shadows that the volume casts on itself already in it.

All shapes are written in world units, +Y up, to be seen from +Z.
"""

import hashlib
import sys
import uuid
from pathlib import Path

import numpy as np

try:
    import openvdb as vdb
except ImportError:
    import pyopenvdb as vdb

CREATOR = "volcli samples"
F = np.float32


# ---------------------------------------------------------------- noise


class Noise:
    """Gradient noise in three dimensions, about -0.7 to 0.7, from a seed."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        p = rng.permutation(256).astype(np.int32)
        self.perm = np.concatenate([p, p, p[:2]])
        g = rng.normal(size=(256, 3))
        self.grad = (g / np.linalg.norm(g, axis=1, keepdims=True)).astype(F)

    def __call__(self, p):
        """Noise at the points p, shape (n, 3)."""
        base = np.floor(p)
        f = (p - base).astype(F)
        i = base.astype(np.int32) & 255
        w = f * f * f * (f * (f * F(6) - F(15)) + F(10))
        out = np.zeros(len(p), F)
        perm = self.perm
        for dx in (0, 1):
            hx = perm[i[:, 0] + dx]
            wx = w[:, 0] if dx else 1 - w[:, 0]
            for dy in (0, 1):
                hy = perm[hx + ((i[:, 1] + dy) & 255)]
                wxy = wx * (w[:, 1] if dy else 1 - w[:, 1])
                for dz in (0, 1):
                    g = self.grad[perm[hy + ((i[:, 2] + dz) & 255)]]
                    dot = (
                        g[:, 0] * (f[:, 0] - dx)
                        + g[:, 1] * (f[:, 1] - dy)
                        + g[:, 2] * (f[:, 2] - dz)
                    )
                    out += wxy * (w[:, 2] if dz else 1 - w[:, 2]) * dot
        return out

    # Each octave is turned, so that no lattice plane shows in the sum.
    TURN = np.array([[0.00, 1.20, 0.90], [-1.20, 0.54, -0.72], [-0.90, -0.72, 0.96]], F) * F(4 / 3)

    def fbm(self, p, octaves, gain=0.5):
        """A sum of octaves: soft, of either sign."""
        out, p = np.zeros(len(p), F), F(0.5) * p
        for k in range(octaves):
            p = p @ self.TURN + F(17.3)
            out += F(gain**k) * self(p)
        return out

    def billow(self, p, octaves, gain=0.5):
        """A sum of |octaves|: round bumps with sharp creases between, >= 0."""
        out, p = np.zeros(len(p), F), F(0.5) * p
        for k in range(octaves):
            p = p @ self.TURN + F(31.7)
            out += F(2 * gain**k) * np.abs(self(p))
        return out

    def vector(self, p, octaves, gain=0.5):
        """Three independent fbm fields, shape (n, 3)."""
        far = (F(0), F(101.5), F(-57.25))
        return np.stack([self.fbm(p + o, octaves, gain) for o in far], axis=1)


# ---------------------------------------------------------------- arrays


def smoothstep(lo, hi, x):
    t = np.clip((x - lo) / (hi - lo), 0, 1)
    return t * t * (3 - 2 * t)


def lattice(shape, voxel, origin):
    """World positions of a lattice of uniform voxels, shape + (3,)."""
    axes = [(np.arange(n, dtype=F) * F(voxel) + F(o)) for n, o in zip(shape, origin, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def sphere_union(shape, voxel, origin, spheres, reach):
    """Signed distance to a union of spheres, exact up to `reach` outside."""
    d = np.full(shape, reach, F)
    for cx, cy, cz, r in spheres:
        box = []
        for c, n, o in zip((cx, cy, cz), shape, origin, strict=True):
            lo = max(0, int((c - r - reach - o) / voxel))
            hi = min(n, int((c + r + reach - o) / voxel) + 2)
            box.append((lo, hi))
        if any(hi <= lo for lo, hi in box):
            continue
        x, y, z = (
            (np.arange(lo, hi, dtype=F) * F(voxel) + F(o)) - F(c)
            for (lo, hi), o, c in zip(box, origin, (cx, cy, cz), strict=True)
        )
        near = np.sqrt(x[:, None, None] ** 2 + y[None, :, None] ** 2 + z[None, None, :] ** 2) - F(r)
        sl = tuple(slice(lo, hi) for lo, hi in box)
        np.minimum(d[sl], near, out=d[sl])
    return d


def puffs(rng, parents, count, size, sink, up=0.0, min_radius=0.0):
    """Smaller spheres that sit on the surface of larger ones."""
    out = []
    for cx, cy, cz, r in parents:
        for _ in range(count):
            v = rng.normal(size=3)
            v[1] += up
            v /= np.linalg.norm(v)
            k = r * rng.uniform(*size)
            if k < min_radius:
                continue
            c = np.array([cx, cy, cz]) + v * (r - sink * k)
            out.append((*c, k))
    return out


def shifted(a, su, sv):
    """a[u + su, v + sv] by bilinear interpolation, 0 outside."""
    iu, iv = int(np.floor(su)), int(np.floor(sv))
    fu, fv = F(su - iu), F(sv - iv)
    m = max(abs(iu), abs(iv)) + 1
    p = np.pad(a, m)
    nu, nv = a.shape

    def at(du, dv):
        u, v = m + iu + du, m + iv + dv
        return p[u : u + nu, v : v + nv]

    lo = at(0, 0) * (1 - fv) + at(0, 1) * fv
    hi = at(1, 0) * (1 - fv) + at(1, 1) * fv
    return lo * (1 - fu) + hi * fu


def depth_towards(density, voxel, direction):
    """Integral of density from every voxel to the outside along `direction`.

    Slice after slice from the side of the light; the interpolation of each
    slice softens the shadow a little with distance, as scattering would.
    """
    d = np.asarray(direction, float) / np.linalg.norm(direction)
    axis = int(np.argmax(np.abs(d)))
    u, v = (k for k in range(3) if k != axis)
    a = np.transpose(density, (axis, u, v))
    if d[axis] > 0:
        a = a[::-1]
    su, sv = d[u] / abs(d[axis]), d[v] / abs(d[axis])
    step = F(voxel / abs(d[axis]))
    tau = np.zeros_like(a)
    for i in range(1, len(a)):
        tau[i] = shifted(tau[i - 1] + F(0.5) * step * a[i - 1], su, sv)
        tau[i] += F(0.5) * step * a[i]
    tau[0] = F(0.5) * step * a[0]
    if d[axis] > 0:
        tau = tau[::-1]
    return np.transpose(tau, np.argsort((axis, u, v)))


def hemisphere(n, up=1.0, lowest=0.15):
    """n directions over the upper (up = 1) or lower (up = -1) half of the sphere."""
    k = np.arange(n)
    y = lowest + (1 - lowest) * (k + 0.5) / n
    phi = k * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - y * y)
    return np.stack([r * np.cos(phi), up * y, r * np.sin(phi)], axis=1)


def openness(density, voxel, directions, sigma):
    """Mean transmittance over directions: 1 where the sky is in full view."""
    out = np.zeros_like(density)
    for d in directions:
        out += np.exp(-F(sigma) * depth_towards(density, voxel, d))
    return out / len(directions)


def halved(a):
    """Means of 2 x 2 x 2 blocks: value j belongs to index 2 j + 1/2 of a."""
    n = [k // 2 for k in a.shape]
    return a.reshape(n[0], 2, n[1], 2, n[2], 2).mean(axis=(1, 3, 5), dtype=F)


def dilated(mask, times):
    """Grow a mask to all 26 neighbours: every corner of a trilinear cell."""
    for _ in range(times):
        for axis in range(3):
            m = np.moveaxis(mask, axis, 0)
            grown = m.copy()
            grown[1:] |= m[:-1]
            grown[:-1] |= m[1:]
            mask = np.moveaxis(grown, 0, axis)
    return mask


def blurred(a):
    """One pass of (1, 2, 1) / 4 along the first three axes, edges repeated."""
    for axis in range(3):
        a = np.moveaxis(a, axis, 0)
        up = np.concatenate([a[:1], a[:-1]])
        down = np.concatenate([a[1:], a[-1:]])
        a = np.moveaxis(F(0.25) * (up + down) + F(0.5) * a, 0, axis)
    return a


def quantised(a, steps):
    """Round to 1/steps: such values compress, and half floats hold them exactly."""
    return (np.round(a * F(steps)) / F(steps)).astype(F)


# ---------------------------------------------------------------- files


def linear(voxel, origin):
    """Uniform voxels, index (0, 0, 0) at `origin`."""
    t = vdb.createLinearTransform(voxelSize=voxel)
    t.translate(tuple(float(x) for x in origin))
    return t


def make_grid(name, array, transform, fog=False):
    """A grid of the values of a dense array; what is 0 is inactive background."""
    grid = vdb.Vec3SGrid() if array.ndim == 4 else vdb.FloatGrid()
    grid.copyFromArray(np.ascontiguousarray(array, dtype=F))
    grid.prune((0.0, 0.0, 0.0) if array.ndim == 4 else 0.0)
    grid.name = name
    grid.transform = transform
    grid.saveFloatAsHalf = True
    if fog:
        grid.gridClass = vdb.GridClass.FOG_VOLUME
    grid["creator"] = CREATOR
    return grid


def save(path, grids):
    vdb.write(str(path), grids=grids, metadata={"creator": CREATOR})
    # OpenVDB stamps a random UUID (36 characters at byte 21) on every file;
    # one made from the contents lets a second run give the same bytes.
    data = bytearray(path.read_bytes())
    uuid.UUID(data[21:57].decode())
    data[21:57] = b"0" * 36
    digest = hashlib.sha256(data).digest()
    data[21:57] = str(uuid.UUID(bytes=digest[:16], version=4)).encode()
    path.write_bytes(data)
    print(f"{path}: {len(data) / 1e6:.2f} MB")
    for g in grids:
        lo, hi = g.evalActiveVoxelBoundingBox()
        world = [tuple(round(x, 3) for x in g.transform.indexToWorld(c)) for c in (lo, hi)]
        print(f"  {g.name}: {g.activeVoxelCount()} active voxels, {lo} to {hi}, world {world}")


# ---------------------------------------------------------------- cloud


def cloud():
    shape, voxel, origin = (188, 112, 144), 0.04, (-3.74, -0.1, -2.86)
    rng = np.random.default_rng(11)
    noise = Noise(1)

    main = [
        (0.10, 1.55, 0.00, 1.35),
        (-0.35, 2.55, -0.15, 1.10),
        (0.55, 3.05, -0.10, 0.80),
        (-1.55, 1.10, 0.15, 1.00),
        (1.60, 1.15, 0.00, 1.00),
        (-2.45, 0.65, -0.05, 0.70),
        (2.50, 0.60, 0.25, 0.66),
        (0.55, 0.80, 1.25, 0.90),
        (-0.85, 0.70, 1.35, 0.75),
        (-0.30, 0.95, -1.35, 1.00),
        (1.20, 0.70, -1.45, 0.75),
    ]
    second = puffs(rng, main, 20, (0.28, 0.52), 0.5, up=0.55, min_radius=0.15)
    third = puffs(rng, second, 9, (0.30, 0.52), 0.45, up=0.35, min_radius=0.10)
    d = sphere_union(shape, voxel, origin, main + second + third, 0.6)

    # The condensation level: below it no cloud, but for a ragged fringe.
    p = lattice(shape, voxel, origin)
    near = (np.abs(d) < 0.55).ravel()
    q = p.reshape(-1, 3)[near]
    bumps = np.zeros(d.size, F)
    fine = np.zeros(d.size, F)
    warp = noise.vector(q * F(1.3), 2)
    qw = q + F(0.12) * warp
    bumps[near] = noise.billow(qw * F(2.1), 4, 0.52)
    fine[near] = noise.fbm(qw * F(6.5), 3, 0.6)
    bumps, fine = bumps.reshape(shape), fine.reshape(shape)

    height = p[..., 1]
    d = d - F(0.30) * (bumps - F(0.55)) + F(0.07) * fine
    floor = F(0.12) - height + F(0.10) * bumps + F(0.06) * fine
    d = np.maximum(d, floor)
    soft = F(0.18) + F(0.12) * smoothstep(1.2, 0.0, height)
    density = smoothstep(0.0, 1.0, -d / soft)
    density = quantised(np.where(density < 0.02, 0, density), 32)

    # Light.  `thick` is the extinction that light sees, in 1 / world unit.
    thick = 14.0
    sun = (-0.76, 0.60, 0.36)
    tau = halved(F(thick) * depth_towards(density, voxel, sun))
    # Orders of scattering: each sees less extinction and carries less light.
    direct = sum(b * np.exp(-tau * F(a)) for a, b in ((1.0, 0.50), (0.30, 0.32), (0.06, 0.18)))
    half = halved(density)
    sky = openness(half, 2 * voxel, hemisphere(14), 2.2)
    crease = openness(half, 2 * voxel, hemisphere(10, lowest=-0.5), 5.0)
    ground = openness(half, 2 * voxel, hemisphere(6, -1.0), 2.5)
    warm = np.array([1.00, 0.93, 0.82], F)
    blue = np.array([0.34, 0.53, 0.92], F)
    earth = np.array([0.34, 0.31, 0.27], F)
    light = F(1.05) * direct[..., None] * warm
    light = light + F(0.40) * (sky * (F(0.35) + F(0.65) * crease))[..., None] * blue
    light = light + F(0.10) * ground[..., None] * earth
    light += F(0.03) * blue
    colour = quantised(np.maximum(light, F(1 / 64)), 64) * dilated(half > 0, 1)[..., None]

    mid = [o + 0.5 * voxel for o in origin]
    return [
        make_grid("density", density, linear(voxel, origin), fog=True),
        make_grid("Cd", colour, linear(2 * voxel, mid)),
    ]


# ---------------------------------------------------------------- explosion


def blackbody(kelvin):
    """A glow by temperature: dull red, orange, yellow, near white; linear RGB."""
    t = np.clip(kelvin / F(3000), 0, 1)
    r = smoothstep(0.20, 0.72, t)
    g = smoothstep(0.38, 1.00, t)
    b = smoothstep(0.68, 1.25, t)
    return np.stack([r * F(1.30), g * F(0.95), b * F(0.80)], axis=-1)


def explosion():
    shape, voxel, origin = (108, 116, 108), 0.046, (-2.46, -2.25, -2.46)
    rng = np.random.default_rng(5)
    noise = Noise(2)
    main = [
        (0.00, 0.10, 0.00, 1.15),
        (0.60, 0.75, 0.25, 0.80),
        (-0.70, 0.60, 0.20, 0.80),
        (0.05, 1.10, -0.20, 0.80),
        (-0.45, -0.60, 0.35, 0.75),
        (0.70, -0.50, 0.20, 0.70),
        (0.05, -0.10, 0.85, 0.75),
        (0.00, 0.00, -0.80, 0.80),
    ]
    lobes = puffs(rng, main, 9, (0.30, 0.60), 0.40, up=0.2)
    small = puffs(rng, lobes, 3, (0.35, 0.60), 0.40)
    surface = sphere_union(shape, voxel, origin, main + lobes + small, 0.7)
    core = sphere_union(shape, voxel, origin, main, 2.5)

    p = lattice(shape, voxel, origin)
    near = (surface < 0.68).ravel()
    q = p.reshape(-1, 3)[near]

    def spread(values):
        out = np.zeros(near.size, F)
        out[near] = values
        return out.reshape(shape)

    qw = q + F(0.30) * noise.vector(q * F(1.2), 3)
    bumps = spread(noise.billow(qw * F(1.9), 4, 0.55))
    swirl = spread(noise.fbm(qw * F(1.5) + F(9), 5, 0.6))

    d = surface - F(0.55) * (bumps - F(0.55)) - F(0.15) * swirl
    shell = smoothstep(0.0, 0.20, -d)
    density = quantised(np.where(shell < 0.03, 0, shell), 16)

    # Hot within, and in the creases, which lie deeper than the lobes.
    depth = F(0.7) * core + F(0.75) * (bumps - F(0.60)) + F(0.65) * swirl
    heat = smoothstep(0.27, -0.60, depth)
    inside = density > 0
    temperature = np.where(inside, np.round((300 + 2700 * heat) / 64) * 64, 0).astype(F)
    flame = np.where(inside, quantised(smoothstep(0.30, 0.85, heat), 16), 0)

    # Colour at half the resolution: the glow, and daylight on the soot.
    half = halved(density)
    kelvin = F(300) + F(2700) * halved(heat)
    glow = blackbody(kelvin)
    tau = F(7) * depth_towards(half, 2 * voxel, (-0.55, 0.75, 0.45))
    sky = openness(half, 2 * voxel, hemisphere(10), 3.0)
    soot = np.array([0.105, 0.088, 0.080], F)
    day = (F(0.7) * np.exp(-tau) + F(0.3) * np.exp(-F(0.25) * tau))[..., None]
    day = day * np.array([1.0, 0.92, 0.82], F) + F(0.6) * sky[..., None] * np.array(
        [0.5, 0.6, 0.8], F
    )
    # Fire lights the soot around it.
    fire = half[..., None] * glow
    for _ in range(4):
        fire = blurred(fire)
    light = F(1.1) * glow + soot * (day + F(0.18)) + F(0.30) * fire
    colour = quantised(np.maximum(light, F(1 / 64)), 64) * dilated(half > 0, 1)[..., None]
    mid = [o + 0.5 * voxel for o in origin]
    return [
        make_grid("density", density, linear(voxel, origin), fog=True),
        make_grid("temperature", temperature, linear(voxel, origin)),
        make_grid("flame", flame, linear(voxel, origin)),
        make_grid("Cd", colour, linear(2 * voxel, mid)),
    ]


# ---------------------------------------------------------------- smoke


def colored_smoke():
    shape, voxel, origin = (84, 134, 84), 0.047, (-1.9505, 0.0, -1.9505)
    noise = Noise(3)
    p = lattice(shape, voxel, origin).reshape(-1, 3)
    top = shape[1] * voxel
    h = p[:, 1] / F(top)  # 0 at the floor, 1 at the top

    # The air: slow at the floor, wilder with height; it rolls up as it rises.
    calm = (F(0.10) + F(0.90) * smoothstep(0.02, 0.75, h))[:, None]
    rise = np.array([0, 1, 0], F)
    q = p + F(0.70) * calm * noise.vector(p * F(0.75) - F(3) * rise, 2)
    q = q + F(0.40) * calm * noise.vector(q * F(1.9) + F(5), 2)
    q = q + F(0.20) * calm * noise.vector(q * F(3.8) + F(8), 3)

    hq = np.clip(q[:, 1] / F(top), 0, 1.2)
    plumes = []
    for k in range(3):
        angle = F(2 * np.pi * k / 3 + 0.4) + F(2 * np.pi * 1.15) * hq
        ring = F(0.50) + F(0.36) * hq
        x = q[:, 0] - ring * np.cos(angle)
        z = q[:, 2] - ring * np.sin(angle)
        r = np.sqrt(x * x + z * z)
        radius = F(0.20) + F(0.62) * hq
        plumes.append(r / radius)
    plumes = np.stack(plumes, axis=1)

    strands = noise.billow(q * np.array([3.2, 1.9, 3.2], F), 3, 0.55)
    fade = smoothstep(0.97, 0.62, h) * smoothstep(0.015, 0.05, h)
    each = np.exp(-F(1.6) * plumes**2)
    raw = smoothstep(0.18, 0.85, each.sum(axis=1) * (F(0.10) + F(1.15) * strands))
    raw = raw * fade * (F(1.0) - F(0.45) * smoothstep(0.1, 0.9, h))
    wall = np.max(np.abs(p[:, ::2]), axis=1)
    raw = raw * smoothstep(1.9, 1.6, wall)
    raw = np.where(raw < 0.025, 0, raw)
    density = quantised(raw.reshape(shape), 32)

    dyes = np.array([[0.90, 0.04, 0.42], [0.01, 0.54, 0.58], [1.00, 0.44, 0.03]], F)
    share = np.exp(-F(1.9) * plumes) + F(1e-9)
    share /= share.sum(axis=1, keepdims=True)
    dye = (share @ dyes).reshape((*shape, 3))

    tau = F(4.0) * depth_towards(density, voxel, (-0.35, 0.85, 0.45))
    sky = openness(density, voxel, hemisphere(8), 1.4)
    lit = (
        F(0.95) * (F(0.6) * np.exp(-tau) + F(0.4) * np.exp(-F(0.25) * tau))
        + F(0.32) * sky
        + F(0.08)
    )
    colour = quantised(dye * lit[..., None], 32)
    colour *= dilated(density > 0, 1)[..., None]
    return [
        make_grid("density", density, linear(voxel, origin), fog=True),
        make_grid("Cd", colour, linear(voxel, origin)),
    ]


# ---------------------------------------------------------------- rotated


def rotation(axis, degrees):
    """Rotation matrix for column vectors (Rodrigues)."""
    a = np.asarray(axis, float) / np.linalg.norm(axis)
    t = np.radians(degrees)
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(t) * k + (1 - np.cos(t)) * (k @ k)


def rotated():
    # Drawn in world space, so the bubble is a sphere and the tube is round if
    # and only if the transform (rotated, three voxel sizes, offset) is obeyed.
    shape = (52, 36, 64)
    size = np.array([0.045, 0.0675, 0.036])
    centre = np.array([10.0, 5.0, -3.0])
    turn = rotation((1.0, 2.0, 0.5), 35.0)
    matrix = np.eye(4)  # row vectors: world = index @ matrix
    matrix[:3, :3] = np.diag(size) @ turn.T
    matrix[3, :3] = centre - (np.array(shape) - 1) / 2 @ matrix[:3, :3]

    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    p = index.reshape(-1, 3) @ matrix[:3, :3] + matrix[3, :3] - centre

    # A trefoil knot, thin to thick along its length: no symmetry is left.
    t = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    knot = 0.24 * np.stack(
        [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1
    )
    width = 0.050 + 0.085 * t / (2 * np.pi)
    tube = np.full(len(p), np.inf)
    for c, w in zip(knot, width, strict=True):
        np.minimum(tube, np.linalg.norm(p - c, axis=1) - w, out=tube)
    radius = np.linalg.norm(p, axis=1)
    shell = np.exp(-(((radius - 0.97) / 0.055) ** 2))
    value = np.maximum(smoothstep(0.05, -0.06, tube), 0.10 * shell)
    value = np.where(value < 0.01, 0, value).astype(F).reshape(shape)
    transform = vdb.createLinearTransform(matrix=matrix.tolist())
    return [make_grid("density", quantised(value, 256), transform, fog=True)]


SAMPLES = {
    "cloud": cloud,
    "explosion": explosion,
    "colored_smoke": colored_smoke,
    "rotated": rotated,
}


def main(argv):
    if not argv or argv[0].startswith("-"):
        print(__doc__)
        return 2
    out = Path(argv[0])
    out.mkdir(parents=True, exist_ok=True)
    for name in argv[1:] or SAMPLES:
        save(out / f"{name}.vdb", SAMPLES[name]())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
