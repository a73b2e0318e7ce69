"""What tradeoff makes of measurements, the truth they are held to, and the order of midpoint."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from scenes import (
    IDENTITY,
    Medium,
    View,
    affine,
    plan_for,
    random_colours,
    random_values,
    rotation,
    tree_of,
    truth,
)

from volcli.render import PIXEL_ERROR, Scene, Source, render
from volcli.schema import Quadrature
from volcli.tradeoff import measure as measuring
from volcli.tradeoff.advice import advise, cheapest, front, observed_order
from volcli.tradeoff.measure import Errors, Measured, Refused, measure, with_bounds
from volcli.tradeoff.report import COLUMNS, Tradeoff, as_csv, as_data, reasons, rows
from volcli.tradeoff.settings import MAX_ERRORS, STEPS, Setting, settings
from volcli.tradeoff.truth import true_picture

VIEW = View(eye=(12.0, 9.0, 15.0), target=(3.1, 3.2, 2.9), resolution=(7, 5))


def row(seconds, error, quadrature=None, rms=None, own=False):
    """A measurement; ``seconds`` are those of its rounds, or their median."""
    times = seconds if isinstance(seconds, tuple) else (seconds,) * 5
    rms = error / 3 if rms is None else rms
    return Measured(
        Setting(quadrature or Quadrature(), own),
        Errors(error, error, rms, rms),
        None,
        100,
        times,
        0.0,
        0.0,
    )


def midpoint(step):
    return Quadrature(rule="midpoint", step=step)


# -- what is measured -----------------------------------------------------------------------------


def test_every_rule_is_measured_with_a_range_of_steps_and_errors():
    names = [one.name for one in settings(None)]
    assert names[0] == "exact"
    assert names[1 : 1 + len(STEPS)] == [f"midpoint {step:g}" for step in STEPS]
    assert names[1 + len(STEPS) :] == [f"certified {error:g}" for error in MAX_ERRORS]
    assert not any(one.own for one in settings(None))


@pytest.mark.parametrize(
    ("quadrature", "name", "added"),
    [
        (midpoint(3.0), "midpoint 3", 1),
        (midpoint(2.0), "midpoint 2", 0),
        (Quadrature(rule="midpoint"), "midpoint 0.5", 0),
        (Quadrature(max_error=0.005), "certified 0.005", 1),
        (Quadrature(max_error=0.0), "exact", 0),
    ],
    ids=lambda value: str(value) if isinstance(value, str) else "",
)
def test_the_users_own_setting_is_among_them_once_and_marked(quadrature, name, added):
    found = settings(quadrature)
    assert len(found) == len(settings(None)) + added
    assert [one.name for one in found if one.own] == [name]
    values = [one.value for one in found if one.family == "midpoint"]
    assert values == sorted(values, reverse=True)


def test_the_plan_of_a_setting_has_its_rule_and_no_other():
    plan = plan_for(step=2.0)
    for one in settings(Quadrature(max_error=0.005)):
        assert one.plan(plan).rule == one.name


# -- the truth ------------------------------------------------------------------------------------


def scene_of(density, scale, color=(1.0, 0.5, 0.25), tint=None):
    return with_bounds(Scene(density.grid, scale, color, tint=tint), plan_for())[0]


@pytest.mark.parametrize("scale", [0.05, 1.0, 30.0])
def test_the_truth_agrees_with_an_independent_one(scale):
    density = Medium(tree_of_values(3))
    scene = scene_of(density, scale)
    found = true_picture(scene, plan_for(), VIEW.camera, 1)
    tau, _, _ = truth(density, VIEW, scale)
    np.testing.assert_allclose(found.transmittance[..., 0], np.exp(-tau), atol=1e-9)
    light = -np.expm1(-tau)[..., None] * np.array(scene.color)
    np.testing.assert_allclose(found.radiance, light, atol=1e-9)
    assert found.brightest == 1.0


def test_the_truth_of_a_tint_is_by_channel():
    density, tint = Medium(tree_of_values(4)), (1.0, 0.5, 0.1)
    scene = scene_of(density, 0.7, tint=tint)
    found = true_picture(scene, plan_for(), VIEW.camera, 1)
    tau, _, _ = truth(density, VIEW, 0.7)
    through = np.exp(-tau[..., None] * np.array(tint))
    np.testing.assert_allclose(found.transmittance, through, atol=1e-9)
    np.testing.assert_allclose(found.radiance, (1 - through) * np.array(scene.color), atol=1e-9)


@pytest.mark.parametrize("scale", [0.05, 1.0, 30.0])
@pytest.mark.parametrize("same_lattice", [True, False])
def test_the_truth_of_light_that_varies_agrees_with_an_independent_one(scale, same_lattice):
    density = Medium(tree_of_values(3))
    lattice = affine(0.7 * rotation((1, 2, 3), 20.0), (0.3, -0.2, 0.4))
    colour = Medium(tree_of_values(5, colour=True), IDENTITY if same_lattice else lattice)
    scene = scene_of(density, scale, Source(colour.grid))
    found = true_picture(scene, plan_for(), VIEW.camera, 1)
    assert 0 < found.error_bound <= 1e-10
    tau, light, _ = truth(density, VIEW, scale, colour)
    np.testing.assert_allclose(found.transmittance[..., 0], np.exp(-tau), atol=1e-9)
    np.testing.assert_allclose(found.radiance, light, atol=1e-9)


def test_the_truth_of_a_pixel_is_the_mean_of_its_samples():
    density = Medium(tree_of_values(5))
    samples = np.array([[0.25, 0.25], [0.75, 0.5], [0.5, 0.75]])
    camera = replace(VIEW.camera, samples=samples)
    found = true_picture(scene_of(density, 1.0), plan_for(), camera, 1)
    lattice = density.lattice()
    means = []
    for one in samples:
        origins, directions = camera.rays(slice(None), slice(None), one[None])
        tau, _, _ = reference.trace_all(origins, directions, lattice, 1.0)
        means.append(np.exp(-tau))
    np.testing.assert_allclose(found.transmittance.reshape(-1), np.mean(means, axis=0), atol=1e-9)


def test_a_picture_taken_in_bands_is_that_taken_at_once(monkeypatch):
    scene = scene_of(Medium(tree_of_values(6)), 1.0)
    whole = true_picture(scene, plan_for(), VIEW.camera, 1)
    monkeypatch.setattr("volcli.tradeoff.truth._RAYS", 15)
    seen = []
    bands = true_picture(
        scene, plan_for(), VIEW.camera, 1, lambda done, total: seen.append((done, total))
    )
    np.testing.assert_array_equal(whole.transmittance, bands.transmittance)
    assert seen == [(0, 5), (2, 5), (4, 5), (5, 5)]


def test_errors_are_of_transmittance_and_of_light_as_a_share_of_the_brightest():
    density = Medium(tree_of_values(7))
    colour = Medium(tree_of_values(8, colour=True))
    scene = scene_of(density, 0.6, Source(colour.grid, scale=5.0))
    exact = true_picture(scene, plan_for(), VIEW.camera, 1)
    brightest = exact.brightest
    # What is largest of all that is stored, times 5.
    assert brightest == pytest.approx(5 * colour.tree.leaf_values.max(), rel=1e-6)
    result = render(scene, plan_for(step=1.3), VIEW.camera, threads=1)
    off = exact.errors(result)
    through = np.abs(result.transmittance - exact.transmittance[..., 0])
    light = np.abs(result.radiance - exact.radiance).max(axis=-1) / brightest
    np.testing.assert_allclose(off, np.maximum(through, light))
    assert (light > through).any()
    assert (through > light).any()


def tree_of_values(seed, colour=False):
    shape = (7, 6, 7)
    return tree_of(random_colours(seed, shape) if colour else random_values(seed, shape))


# -- measuring ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured():
    scene = scene_of(Medium(tree_of_values(9)), 0.8)
    plan, camera = plan_for(), VIEW.camera
    exact = true_picture(scene, plan, camera, 1)
    chosen = [
        Setting(Quadrature()),
        Setting(midpoint(1.0)),
        Setting(Quadrature(max_error=0.01)),
        Setting(midpoint(1e-9)),
    ]
    told = []
    found = measure(scene, plan, camera, exact, chosen, 5, 0.25, 1, lambda *at: told.append(at))
    return scene, exact, found, told


def test_each_setting_is_timed_in_every_round(measured):
    _, _, found, told = measured
    for one in found[:3]:
        assert len(one.seconds) == 5
        assert min(one.seconds) <= one.median <= max(one.seconds)
        assert one.compile_seconds >= 0
    assert [one.setup_seconds for one in found[:3]] == [0, 0, 0.25]
    assert min(found[2].seconds) > 0.25, "what it takes beforehand is counted"
    assert told == [(n, 24) for n in range(1, 25)]


def test_the_errors_of_a_setting_are_those_of_its_picture(measured):
    scene, exact, found, _ = measured
    result = render(scene, plan_for(step=1.0), VIEW.camera, threads=1)
    off = exact.errors(result)
    assert found[1].errors.largest == off.max()
    assert found[1].errors.mean == pytest.approx(off.mean())
    assert found[1].errors.rms == pytest.approx(np.sqrt((off**2).mean()))
    assert found[1].evaluations == result.evaluations
    assert found[0].errors.largest < PIXEL_ERROR


def test_a_certified_picture_is_no_farther_off_than_it_says(measured):
    _, _, found, _ = measured
    exact, midway, certified, _ = found
    assert exact.error_bound is midway.error_bound is None
    assert certified.errors.largest <= certified.error_bound <= 0.01


def test_a_setting_that_is_refused_is_left_out_with_the_reason(measured):
    *_, refused = measured[2]
    assert isinstance(refused, Refused)
    assert "samples a ray" in refused.reason


def test_rounds_take_turns(monkeypatch):
    order = []

    scene = scene_of(Medium(tree_of_values(9)), 0.8)
    exact = true_picture(scene, plan_for(), VIEW.camera, 1)

    def counted(scene, plan, camera, threads=None):
        order.append(plan.rule)
        return render(scene, plan, camera, threads=threads)

    monkeypatch.setattr(measuring, "render", counted)
    chosen = [Setting(Quadrature()), Setting(midpoint(1.0)), Setting(midpoint(2.0))]
    measure(scene, plan_for(), VIEW.camera, exact, chosen, 5, 0.0, 1)
    assert len(order) == 3 * 6
    for first in range(0, 18, 3):
        assert set(order[first : first + 3]) == {"exact", "midpoint 1", "midpoint 2"}


def test_times_of_a_small_picture_are_scaled_but_for_what_is_made_once():
    one = Measured(Setting(Quadrature()), Errors(0, 0, 0, 0), None, 1, (1.2, 2.2), 0.2, 0.0)
    assert one.scaled(10.0).seconds == pytest.approx((10.2, 20.2))


# -- what follows ---------------------------------------------------------------------------------

points = st.lists(
    st.tuples(st.floats(1e-3, 1e3), st.floats(1e-9, 1.0)), min_size=1, max_size=12
).map(lambda pairs: [row(seconds, error) for seconds, error in pairs])


@given(points)
def test_on_the_front_is_what_no_other_is_as_good_as(measured):
    best = front(measured)

    def beats(one, other):
        as_good = one.median <= other.median and one.errors.largest <= other.errors.largest
        better = one.median < other.median or one.errors.largest < other.errors.largest
        return as_good and better

    for one in measured:
        beaten = any(beats(other, one) for other in measured)
        assert beaten != any(
            (one.median, one.errors.largest) == (b.median, b.errors.largest) for b in best
        )
    assert [b.median for b in best] == sorted(b.median for b in best)


@given(points, st.floats(1e-9, 1.0))
def test_the_cheapest_meets_its_target_and_is_as_fast_as_any_that_does(measured, target):
    found = cheapest(measured, target)
    good = [m for m in measured if m.errors.largest <= target]
    if found is None:
        assert not good
        return
    assert found.errors.largest <= target
    assert found.median <= 1.1 * min(m.median for m in good)


def test_among_those_that_are_as_fast_the_most_accurate_is_taken():
    fast, nearly, slow = row(1.0, 1e-3), row(1.05, 1e-4), row(1.3, 1e-6)
    assert cheapest([fast, nearly, slow], 1e-2) is nearly
    assert cheapest([slow, nearly, fast], 1e-2) is nearly
    disturbed = row((1.0, 7.0, 8.0, 9.0, 9.0), 1e-3)
    assert cheapest([disturbed, nearly, slow], 1e-2) is nearly, "its quickest round counts"


def test_errors_below_rounding_are_the_same_and_the_faster_is_taken():
    exact, certified = row(1.0, 3e-8), row(1.05, 2e-8)
    assert cheapest([certified, exact], 1e-2) is exact


@pytest.mark.parametrize("seed", range(20))
def test_noise_of_a_quiet_machine_does_not_change_the_advice(seed):
    times = {8.0: 0.05, 4.0: 0.06, 2.0: 0.09, 1.0: 0.15, 0.5: 0.27, 0.25: 0.51}
    rng = np.random.default_rng(seed)

    def noisy(seconds):
        return tuple(seconds * (1 + 0.02 * rng.random(5)))

    found = [row(noisy(t), 1e-2 * h * h, midpoint(h)) for h, t in times.items()]
    found.append(row(noisy(0.3), 3e-8))
    assert [cheapest(found, e).setting.name for e in (0.1, 0.01, 1e-3, 1e-6)] == [
        "midpoint 2",
        "midpoint 1",
        "exact",
        "exact",
    ]


def test_a_budget_buys_the_most_accurate_that_it_pays_for():
    fast, middle, slow = row(1.0, 1e-2), row(2.0, 1e-3), row(4.0, 1e-4)
    found = [slow, fast, middle]
    assert advise(found, None, 2.5) is middle
    assert advise(found, None, 100.0) is slow
    assert advise(found, None, 0.5) is None
    assert advise(found, 5e-3, 2.5) is middle
    assert advise(found, 5e-4, 2.5) is None
    assert advise(found, 1.0, 100.0) is fast


def test_the_order_is_the_slope_of_the_error_over_the_step():
    found = [row(1.0, 1.0, midpoint(h), rms=0.3 * h**1.7) for h in (4.0, 1.0, 0.5, 0.25)]
    order = observed_order([*found, row(1.0, 1e-8)])
    assert order.order == pytest.approx(1.7)
    assert order.steps == (1.0, 0.5, 0.25)


def test_the_order_is_not_taken_from_rounding():
    found = [row(1.0, 1.0, midpoint(h), rms=1e-4 * h**2 + 2e-8) for h in (1.0, 0.5, 0.25, 1e-3)]
    assert observed_order(found).steps == (1.0, 0.5, 0.25)
    assert observed_order(found[:2]) is None


@pytest.mark.needs_jit
def test_the_order_of_midpoint_is_2_on_a_smooth_volume():
    # A paraboloid, 1 - r^2, over 64 voxels: its slope ends at the sphere, as that of a cloud does.
    x = np.linspace(-1, 1, 64)
    r2 = x[:, None, None] ** 2 + x[:, None] ** 2 + x**2
    density = Medium(tree_of(np.clip(1 - r2, 0, None)))
    view = View((90.0, 70.0, 130.0), (31.5, 31.5, 31.5), fov=30.0, resolution=(100, 75))
    scene = scene_of(density, 0.2)
    exact = true_picture(scene, plan_for(), view.camera)
    chosen = [Setting(midpoint(step)) for step in STEPS]
    found = measure(scene, plan_for(), view.camera, exact, chosen, 1)
    order = observed_order(found)
    assert order.steps == (1.0, 0.7, 0.5, 0.333, 0.25, 0.125)
    assert 1.9 <= order.order <= 2.1


# -- as data --------------------------------------------------------------------------------------


@pytest.fixture
def example():
    return Tradeoff(
        "a.vdb",
        (800, 600),
        (160, 120),
        1,
        5,
        2,
        0.0,
        (
            row(1.0, 3e-8),
            row(0.2, 1e-2, midpoint(2.0), own=True),
            row(0.4, 2e-2, midpoint(1.0)),
            Refused(Setting(Quadrature(max_error=0.1)), "cannot be bounded"),
            Refused(Setting(Quadrature(max_error=0.01)), "cannot be bounded"),
        ),
        ("a warning",),
    )


def test_data_has_every_setting_with_its_errors_and_times(example):
    data = json.loads(json.dumps(as_data(example), allow_nan=False))
    assert [one["rule"] for one in data["settings"]][:2] == ["exact", "midpoint 2"]
    assert data["front"] == ["midpoint 2", "exact"]
    assert data["own"] == "midpoint 2"
    assert data["settings"][1]["seconds"] == [0.2] * 5
    assert data["settings"][1]["step_voxels"] == 2.0
    assert data["settings"][3]["refused"] == "cannot be bounded"
    assert data["settings"][3]["largest_error"] is None
    assert data["order"] is None
    assert data["warnings"] == ["a warning"]


def test_the_table_of_a_spreadsheet_says_the_same(example):
    read = list(csv.DictReader(io.StringIO(as_csv(example).decode())))
    assert tuple(read[0]) == COLUMNS
    data = as_data(example)["settings"]
    for line, one in zip(read, data, strict=True):
        for name in COLUMNS:
            assert line[name] == ("" if one[name] is None else str(one[name]))


def test_the_printed_table_marks_the_front_and_the_users_own(example):
    named = [line[0] for line in rows(example)]
    assert named == [
        "exact *",
        "midpoint 2 * (yours)",
        "midpoint 1",
        "certified 0.1",
        "certified 0.01",
    ]
    assert reasons(example) == ["left out: certified 0.1, certified 0.01: cannot be bounded"]
