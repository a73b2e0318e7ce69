"""Laws that hold of every picture, whatever is in it: of probabilities, of parts, of symmetry.

Volumes are a few voxels of any values under any transform, seen from anywhere. A law that holds of
every rule is tried under each; what is right to rounding is said relatively to the largest density,
since a position that is off by rounding costs as much.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scenes import IDENTITY, View, affine, medium, rotation, shoot

from volcli.render import over

RULES = {
    "exact": {},
    "midpoint": {"step": 0.7},
    "certified": {"max_error": 0.05},
    "nearest": {"nearest": True},
    "nearest, midpoint": {"nearest": True, "step": 0.7},
}

ROUNDED = 3e-7
"""Relative: two results, each rounded to float32, and float64 before."""

PLACED = 1e-12
"""What positions are off by, in voxels, of volumes that are some tens away."""

FEW = settings(max_examples=10)
"""Pictures are dear; the other examples are rules and the pixels of each."""

EVERY = pytest.mark.parametrize("rule", RULES)


@dataclass(frozen=True)
class Look:
    """Where a picture is taken from: a direction, a distance and a point looked at, in voxels."""

    towards: tuple
    distance: float
    target: tuple
    narrow: bool

    def view(self, world):
        """The view in world space of a lattice under a transform."""
        target = np.array(self.target)
        eye = target - self.distance * np.array(self.towards) / np.linalg.norm(self.towards)
        eye, target = ((world @ [*p, 1.0])[:3] for p in (eye, target))
        up = np.zeros(3)
        up[np.argmin(np.abs(target - eye))] = 1.0
        size = 9 * np.cbrt(abs(np.linalg.det(world[:3, :3])))
        lens = {"width": size} if self.narrow else {"fov": 40.0}
        return View(tuple(eye), tuple(target), tuple(up), resolution=(5, 4), **lens)


def within(low, high):
    return st.floats(low, high)


LOOKS = st.builds(
    Look,
    towards=st.tuples(*[within(-1, 1)] * 3).filter(lambda d: np.linalg.norm(d) > 0.1),
    distance=within(8, 40),
    target=st.tuples(*[within(0.3, 2.4)] * 3),
    narrow=st.booleans(),
)
"""From without."""

TURNS = st.builds(
    rotation,
    st.tuples(*[within(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1),
    within(-180, 180),
)

WORLDS = st.builds(
    lambda turn, x, y, z, shear, offset: affine(
        turn @ np.array([[x, shear, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]]), offset
    ),
    TURNS,
    within(0.3, 3),
    within(0.3, 3),
    within(-3, -0.3),
    within(-0.5, 0.5),
    st.tuples(*[within(-20, 20)] * 3),
)
"""Turned, mirrored, sheared, and aside."""

DENSITIES = arrays(np.float32, (3, 4, 3), elements=st.floats(0, 8, width=32))
COLOURS = arrays(np.float32, (3, 4, 3, 3), elements=st.floats(0, 4, width=32))


def see(density, view, rule, scale=1.0, colour=(1.0, 1.0, 1.0)):
    """Render a medium by one of the rules."""
    return shoot(density, view, scale, colour, **RULES[rule])


def allowed(result):
    """What of T each pixel may be off by besides rounding."""
    return 0.0 if result.error_bound is None else result.error_bound.astype(np.float64)


def assert_alike(one, other, thickest, flipped=False):
    """The same picture, to rounding, where ``thickest`` is the largest extinction of a voxel."""
    turn = slice(None, None, -1 if flipped else 1)
    tau = one.optical_depth.astype(np.float64)
    off = allowed(one) + allowed(other)[..., turn] if one.error_bound is not None else 0.0
    if one.error_bound is None:
        np.testing.assert_allclose(
            other.optical_depth[:, turn], tau, rtol=ROUNDED, atol=100 * PLACED * thickest
        )
    for layer in ("transmittance", "opacity"):
        difference = np.abs(getattr(other, layer)[:, turn] - getattr(one, layer).astype(float))
        assert (difference <= off + ROUNDED + 100 * PLACED * thickest).all()


@EVERY
@given(values=DENSITIES, magnitude=st.integers(-37, 36), world=WORLDS, look=LOOKS)
@FEW
def test_transmittance_and_opacity_are_probabilities(rule, values, magnitude, world, look):
    result = see(medium(values, world_from_index=world), look.view(world), rule, 10.0**magnitude)
    for layer in (result.transmittance, result.opacity):
        assert ((layer >= 0) & (layer <= 1)).all()
    assert np.abs(result.transmittance.astype(float) + result.opacity - 1).max() <= 2.0**-23
    assert (result.optical_depth >= 0).all()
    assert (result.radiance >= 0).all() and (result.radiance <= 1).all()
    hit = result.opacity > 0
    far = look.distance + 20
    assert np.isfinite(result.depth[hit]).all()
    scale = np.linalg.norm(world[:3, :3], 2)
    assert (np.abs(result.depth[hit]) <= far * scale * 2).all()
    assert not np.isnan(result.depth).any()


@pytest.mark.parametrize("rule", ["exact", "certified", "nearest"])
@given(values=DENSITIES, axis=st.integers(0, 2), at=st.integers(1, 2), world=WORLDS, look=LOOKS)
@FEW
def test_transmittance_is_the_product_of_that_of_two_parts(rule, values, axis, at, world, look):
    """T(a, c) = T(a, b) T(b, c), the volume cut between two layers of voxels: fields add up."""
    first = np.moveaxis(values, axis, 0).copy()
    second = first.copy()
    first[at:], second[:at] = 0, 0
    view = look.view(world)
    one, two, whole = (
        see(medium(np.moveaxis(v, 0, axis), world_from_index=world), view, rule)
        for v in (first, second, np.moveaxis(values, axis, 0))
    )
    off = allowed(one) + allowed(two) + allowed(whole)
    product = one.transmittance.astype(float) * two.transmittance
    assert (np.abs(whole.transmittance - product) <= off + ROUNDED).all()
    if rule != "certified":
        both = one.optical_depth.astype(float) + two.optical_depth
        np.testing.assert_allclose(whole.optical_depth, both, rtol=ROUNDED, atol=1e-10)


@pytest.mark.parametrize("rule", ["exact", "certified", "nearest"])
@given(values=DENSITIES, look=LOOKS, share=within(0, 1))
@FEW
def test_what_is_before_an_eye_and_what_is_behind_it_make_the_whole(rule, values, look, share):
    """T(a, c) = T(a, b) T(b, c), the ray cut at an eye that stands somewhere on it."""
    far = replace(look.view(IDENTITY), width=1e-3, fov=40.0, resolution=(1, 1))
    eye, target = np.array(far.eye), np.array(far.target)
    there = tuple(eye + (target - eye) * (1 + share * 4 / look.distance - 2 / look.distance))
    ahead = tuple(2 * np.array(there) - eye)
    assume(ahead != there)
    m = medium(values)
    whole, before, behind = (
        see(m, view, rule)
        for view in (
            far,
            replace(far, eye=there, target=ahead),
            replace(far, eye=there, target=far.eye),
        )
    )
    off = allowed(before) + allowed(behind) + allowed(whole)
    product = before.transmittance.astype(float) * behind.transmittance
    assert (np.abs(whole.transmittance - product) <= off + ROUNDED).all()


@EVERY
@given(values=DENSITIES, more=DENSITIES, world=WORLDS, look=LOOKS)
@FEW
def test_more_density_never_raises_transmittance(rule, values, more, world, look):
    view = look.view(world)
    less, thicker = (
        see(medium(v, world_from_index=world), view, rule) for v in (values, values + more)
    )
    off = allowed(less) + allowed(thicker) + 2.0**-24
    assert (thicker.transmittance <= less.transmittance + off).all()
    if rule != "certified":
        assert (thicker.optical_depth >= less.optical_depth * (1 - ROUNDED)).all()


@EVERY
@given(values=DENSITIES, world=WORLDS, look=LOOKS, k=st.floats(-6, 6).map(lambda e: 10.0**e))
@FEW
def test_voxels_k_times_larger_of_1_over_k_the_extinction_are_the_same(
    rule, values, world, look, k
):
    larger = affine(k * np.eye(3)) @ world
    view = look.view(world)
    grown = replace(
        view, eye=tuple(k * np.array(view.eye)), target=tuple(k * np.array(view.target))
    )
    if view.width is not None:
        grown = replace(grown, width=k * view.width)
    one = see(medium(values, world_from_index=world), view, rule)
    other = see(medium(values, world_from_index=larger), grown, rule, 1 / k)
    assert_alike(one, other, 8)


def carried(view, by):
    """A view moved along with the world."""
    eye, target = (tuple((by @ [*p, 1.0])[:3]) for p in (view.eye, view.target))
    return replace(view, eye=eye, target=target, up=tuple(by[:3, :3] @ view.up))


@EVERY
@given(
    values=DENSITIES, world=WORLDS, look=LOOKS, turn=TURNS, by=st.tuples(*[within(-1e3, 1e3)] * 3)
)
@FEW
def test_a_world_that_is_turned_and_moved_with_its_camera_is_the_same(
    rule, values, world, look, turn, by
):
    motion = affine(turn, by)
    view = look.view(world)
    one = see(medium(values, world_from_index=world), view, rule)
    other = see(medium(values, world_from_index=motion @ world), carried(view, motion), rule)
    assert_alike(one, other, 8)


@EVERY
@given(values=DENSITIES, world=WORLDS, look=LOOKS, axis=st.integers(0, 2))
@FEW
def test_a_mirrored_world_is_the_mirrored_picture(rule, values, world, look, axis):
    mirror = np.eye(4)
    mirror[axis, axis] = -1.0
    view = look.view(world)
    one = see(medium(values, world_from_index=world), view, rule)
    other = see(medium(values, world_from_index=mirror @ world), carried(view, mirror), rule)
    assert_alike(one, other, 8, flipped=True)


@pytest.mark.parametrize("rule", ["exact", "certified", "nearest"])
@given(values=DENSITIES, world=WORLDS, look=LOOKS)
@FEW
def test_a_ray_and_its_reverse_see_the_same_transmittance(rule, values, world, look):
    """Not under the midpoint rule, whose last step is the one that is cut."""
    there = replace(look, narrow=True).view(world)
    back = replace(there, eye=tuple(2 * np.array(there.target) - there.eye))
    m = medium(values, world_from_index=world)
    assert_alike(see(m, there, rule), see(m, back, rule), 8, flipped=True)


@EVERY
@given(
    values=DENSITIES,
    colours=COLOURS,
    behind=st.tuples(*[within(0, 4)] * 3),
    magnitude=st.integers(-12, 12),
    world=WORLDS,
    look=LOOKS,
    other=st.booleans(),
)
@FEW
def test_colour_is_within_the_hull_of_the_colours_that_it_mixes(
    rule, values, colours, behind, magnitude, world, look, other
):
    """However dense the medium, on the density's own lattice and on another."""
    place = world @ affine(0.7 * np.eye(3), (0.2, 0.1, 0.3)) if other else world
    low, high = colours.min(axis=(0, 1, 2)), colours.max(axis=(0, 1, 2))
    source = medium(colours, world_from_index=place, background=tuple(low))
    m = medium(values, world_from_index=world)
    result = see(m, look.view(world), rule, 10.0**magnitude, source)
    off = np.asarray(allowed(result))[..., None] * colours.max() + 1e-6 * high + 2.0**-149
    opacity = result.opacity[..., None].astype(float)
    assert (result.radiance <= high * opacity + off).all()
    assert (result.radiance >= low * opacity - off).all()
    picture = over(result, np.float32([*behind, 1.0]))[..., :3]
    ends = np.array([low, high, behind])
    off = off + np.asarray(allowed(result))[..., None] * max(behind) + 1e-6 * ends.max(axis=0)
    assert (picture <= ends.max(axis=0) + off).all()
    assert (picture >= ends.min(axis=0) - off).all()
