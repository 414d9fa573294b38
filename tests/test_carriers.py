"""Cranks, sliders and bars: points, frames, inverse kinematics, motors, ties and faults of files.

Derivatives by parameters and broadcasting are tested for every carrier in test_mechanisms.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.files import parse_yaml, validated_document
from pkmcal.geometry.rigid import apply, inverse, perturb
from pkmcal.mechanisms import MechanismDocument, load_mechanism, machine_from_document
from pkmcal.mechanisms.carriers.bars import Bar, HingedBar
from pkmcal.mechanisms.carriers.contract import base_carriers, by_pose, platform_carriers
from pkmcal.mechanisms.carriers.crank import Crank
from pkmcal.mechanisms.carriers.slider import Slider

BASE = sorted(set(base_carriers().values()), key=lambda c: c.__name__)
PLATFORM = sorted(set(platform_carriers().values()), key=lambda c: c.__name__)
STENCIL = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))


def differences(function, count, step=1e-3):
    """Sixth-order central differences of function(delta (count,)) at zero."""
    return np.stack(
        [
            sum(w * (function(i * by) - function(-i * by)) for i, w in STENCIL) / step
            for by in step * np.eye(count)
        ],
        axis=-1,
    )


def crank(seed, zero=True, n=5):
    """Parameters (n, 13) of cranks; without ``zero`` as a file that does not give it."""
    parameters = np.random.default_rng(seed).normal(size=(n, 13))
    if not zero:
        parameters[:, 10:] = np.nan
    return parameters


# The crank


def test_a_crank_is_the_papers():
    """[C] eq. 1: arm direction (cos alpha cos Q, sin alpha cos Q, -sin Q), Q = q + angle."""
    alpha, q, angle = np.array([0.0, 2.0, 4.7]), 0.7, 0.05
    zero = np.zeros(3)
    axis = np.stack([-np.sin(alpha), np.cos(alpha), zero], axis=-1)
    parameters = np.concatenate(
        [
            np.zeros((3, 3)),
            axis,
            np.tile([0.26, angle, 0.0, 0.14], (3, 1)),
            np.full((3, 3), np.nan),
        ],
        axis=1,
    )
    out = np.stack([np.cos(alpha), np.sin(alpha), zero], axis=-1)
    expected = (0.14 + 0.26 * np.cos(q + angle)) * out - [0, 0, 0.26 * np.sin(q + angle)]
    values = Crank.place(parameters, np.full(3, q))[0]
    np.testing.assert_allclose(values, expected, atol=1e-16)


def test_a_crank_is_model_31s():
    """Errata: e = Rz(psi) Rx(beta) (cos Q, sin Q, 0), so its axis is Rz(psi) Rx(beta) z."""
    rng = np.random.default_rng(0)
    for psi, beta, q in rng.uniform([-3, -2, -1], [3, -1, 1], (20, 3)):
        cp, sp, cb, sb = np.cos(psi), np.sin(psi), np.cos(beta), np.sin(beta)
        turn = np.array([[cp, -sp * cb, sp * sb], [sp, cp * cb, -cp * sb], [0, sb, cb]])
        parameters = np.array([0, 0, 0, *turn[:, 2], 1, 0, 0, 0, np.nan, np.nan, np.nan])
        # v x z is Rz(psi) x for sin(beta) < 0
        expected = turn @ [np.cos(q), np.sin(q), 0]
        np.testing.assert_allclose(Crank.place(parameters, np.array(q))[0], expected, atol=1e-15)


def test_a_cranks_derivatives_without_a_zero_direction():
    parameters, q = crank(1, zero=False), np.linspace(-1, 1, 5)
    by = Crank.by_parameters(parameters, q)
    oracle = differences(lambda d: Crank.place(parameters + np.append(d, np.zeros(3)), q)[0], 10)
    np.testing.assert_allclose(by[..., :10], oracle, atol=1e-10)
    np.testing.assert_array_equal(by[..., 10:], 0.0)


@pytest.mark.parametrize("zero", [True, False])
def test_readings_of_a_crank(zero):
    """The reading put in comes out, and from anywhere the nearest of the elbow's two sides."""
    parameters = crank(2, zero, n=200)
    parameters[:, 6] = np.abs(parameters[:, 6]) + 0.1
    rng = np.random.default_rng(3)
    q, b = rng.uniform(-3, 3, 200), rng.normal(size=(200, 3))
    length = np.linalg.norm(b - Crank.place(parameters, q)[0], axis=1)
    value = Crank.reading(parameters, b, length, q)
    # a rod square to its arm's motion hides the reading: a rounding e of lengths, root of e
    np.testing.assert_allclose(value, q, atol=1e-6)
    assert np.quantile(np.abs(value - q), 0.9) < 1e-12
    # both solutions, whatever the viewing direction
    for near in np.linspace(-3, 3, 7):
        other = Crank.reading(parameters, b, length, np.full(200, near))
        away = np.linalg.norm(b - Crank.place(parameters, other)[0], axis=1)
        np.testing.assert_allclose(away, length, atol=1e-12)
        assert np.abs(other - near).max() <= np.pi
    assert np.isnan(Crank.reading(parameters, b, length + 50, q)).all()


# The slider


def test_readings_of_a_slider():
    rng = np.random.default_rng(4)
    parameters, q, b = rng.normal(size=(100, 6)), rng.normal(size=100), rng.normal(size=(100, 3))
    length = np.linalg.norm(b - Slider.place(parameters, q)[0], axis=1)
    for near in (q, np.full(100, -9.0), np.full(100, 9.0)):
        values = Slider.reading(parameters, b, length, near)
        away = np.linalg.norm(b - Slider.place(parameters, values)[0], axis=1)
        np.testing.assert_allclose(away, length, atol=1e-12)
    np.testing.assert_allclose(Slider.reading(parameters, b, length, q), q, atol=1e-6)
    assert np.isnan(Slider.reading(parameters, b + 9, length * 0, q)).all()


# The bars


def test_a_bar_keeps_its_direction():
    """Errata: A_i = (X + s h cos theta, Y + s h sin theta + t d, Z)."""
    x, y, z, theta, h, d = 0.02, -0.03, -0.4, 0.3, 0.06, 0.05
    T = perturb(np.eye(4), np.array([0, 0, theta, x, y, z]))
    results = Bar.place(np.array([0, -d, 0, -h, 0, 0]), T)[0]
    expected = [x - h * np.cos(theta), y - h * np.sin(theta) - d, z]
    np.testing.assert_allclose(results, expected, atol=1e-16)


def test_a_hinged_bar_turned_back_is_a_bar():
    """Turned back by the platform's rotation, the hinged bar stands as one that keeps its
    direction.
    """
    T = perturb(np.eye(4), np.array([0, 0, 0.3, 0.02, -0.03, -0.4]))
    center, hinge = np.array([0.01, -0.05, 0.02]), np.array([-0.06, 0.01, 0.0])
    turned = HingedBar.place(np.concatenate([center, hinge, [0, 0, 2.0]]), T, np.array(-0.3))[0]
    plain = Bar.place(np.concatenate([center, hinge]), T)[0]
    np.testing.assert_allclose(turned, plain, atol=1e-16)


def test_a_hinged_bars_derivatives_where_it_is_turned():
    rng = np.random.default_rng(5)
    parameters, phi = rng.normal(size=(4, 9)), rng.normal(size=4)
    T = perturb(np.eye(4), rng.normal(size=(4, 6)))
    value = (
        HingedBar.by_parameters(parameters, T, phi),
        by_pose(HingedBar.place(parameters, T, phi)[1]),
        HingedBar.by_internal(parameters, T, phi)[..., None],
    )
    oracles = (
        differences(lambda d: HingedBar.place(parameters + d, T, phi)[0], 9),
        differences(lambda d: HingedBar.place(parameters, perturb(T, d), phi)[0], 6),
        differences(lambda d: HingedBar.place(parameters, T, phi + d)[0], 1),
    )
    for got, oracle in zip(value, oracles, strict=True):
        np.testing.assert_allclose(got, oracle, atol=1e-10)


def test_where_a_hinge_begins_changes_no_point():
    rng = np.random.default_rng(6)
    parameters, phi, shift, turn = (rng.normal(size=s) for s in ((4, 9), 4, 4, 4))
    T = perturb(np.eye(4), rng.normal(size=(4, 6)))
    before = HingedBar.place(parameters, T, phi)[0]
    after = HingedBar.place(HingedBar.slid(parameters, shift, turn), T, phi - turn)[0]
    np.testing.assert_allclose(after, before, atol=1e-14)
    oracle = differences(
        lambda d: HingedBar.slid(parameters, np.full(4, d[0]), np.full(4, d[1])), 2
    )
    np.testing.assert_allclose(HingedBar.by_slide(parameters), oracle, atol=1e-10)


# Frames, for every carrier


def example(carrier, seed):
    return np.random.default_rng(seed).normal(size=(4, len(carrier.parameters)))


def changes(seed):
    rng = np.random.default_rng(seed)
    return perturb(np.eye(4), rng.normal(size=6)), perturb(np.eye(4), rng.normal(size=6))


@pytest.mark.parametrize("carrier", BASE)
@pytest.mark.parametrize("zero", [True, False])
def test_base_points_move_with_the_base_frame(carrier, zero):
    parameters, q = example(carrier, 7), np.linspace(-1, 1, 4)
    if not zero and carrier is Crank:
        parameters = crank(7, zero=False, n=4)
    e, f = changes(8)
    after = carrier.place(carrier.reframed(parameters, e, f), q)[0]
    np.testing.assert_allclose(after, apply(e, carrier.place(parameters, q)[0]), atol=1e-14)


@pytest.mark.parametrize("carrier", PLATFORM)
def test_platform_points_move_with_both_frames(carrier):
    parameters, phi = example(carrier, 9), np.linspace(-1, 1, 4)
    T = perturb(np.eye(4), np.random.default_rng(10).normal(size=(4, 6)))
    e, f = changes(11)
    after = carrier.place(carrier.reframed(parameters, e, f), e @ T @ inverse(f), phi)[0]
    np.testing.assert_allclose(after, apply(e, carrier.place(parameters, T, phi)[0]), atol=1e-14)


@pytest.mark.parametrize("carrier", [*BASE, *PLATFORM])
@pytest.mark.parametrize("zero", [True, False])
def test_frames_first_order_and_what_errors_become(carrier, zero):
    parameters = example(carrier, 12)
    n = len(carrier.parameters)
    if not zero and carrier is Crank:
        parameters, n = crank(12, zero=False, n=4), 10

    def shifted(d):
        frames = (perturb(np.eye(4), part) for part in (d[:6], d[6:]))
        return carrier.reframed(parameters, *frames)[..., :n]

    values = carrier.by_frames(parameters)[..., :n, :]
    np.testing.assert_allclose(values, differences(shifted, 12), atol=1e-9)
    e, f = changes(13)
    pad = np.zeros(parameters.shape[-1] - n)
    oracle = differences(
        lambda d: carrier.reframed(parameters + np.append(d, pad), e, f)[..., :n], n, 1e-4
    )
    carried = carrier.carried(parameters, e, f)[..., :n, :n]
    if carrier is Crank and zero:  # fixed nominal values have no errors
        carried, oracle = carried[..., :10, :10], oracle[..., :10, :10]
    np.testing.assert_allclose(np.broadcast_to(carried, oracle.shape), oracle, atol=1e-8)


# Motors, bars and ties of a file

DELTA = """\
name: small
motion: translation
legs:
  - base: {joint: crank, center: [0.1, 0.0, 0.0], axis: [0, 1, 0], arm: 0.1, motor: 2}
    platform: {joint: spherical, center: [0.03, 0.0, 0.0]}
    length: {actuated: false, constant: 0.2}
  - base: {joint: slider, center: [0.0, 0.1, 0.0], axis: [0, 0, 2], motor: 1, range: [0.1, 0.4]}
    platform: {joint: spherical, center: [0.0, 0.03, 0.0]}
    length: {actuated: false, constant: 0.2}
  - base: {joint: spherical, center: [0.0, -0.1, 0.0]}
    platform: {joint: spherical, center: [0.0, -0.03, 0.0]}
    length: {actuated: true, offset: 0.05, range: [0.1, 0.3]}
"""


def read(text):
    return machine_from_document(
        validated_document(parse_yaml(text, Path("m.yaml")), MechanismDocument)
    )


def test_motors_are_the_readings_columns():
    machine = read(DELTA)
    assert machine.n_joints == 3
    assert machine.layout.actuated.tolist() == [1, 0, 2]
    np.testing.assert_allclose(machine.joint_ranges, [[0.1, 0.4], [np.nan, np.nan], [0.05, 0.25]])
    T = perturb(np.eye(4), np.array([0, 0, 0, 0.01, 0.02, -0.1]))
    readings = machine.inverse(T[None])[0]
    # the slider's column is the first: 0.2^2 = 0.01^2 + 0.05^2 + (z - q)^2, higher of two
    assert readings[0] == pytest.approx(-0.1 + np.sqrt(0.2**2 - 0.01**2 - 0.05**2), abs=1e-15)
    assert readings[2] == pytest.approx(np.linalg.norm([0.01, 0.09, -0.1]) - 0.05, abs=1e-15)
    np.testing.assert_allclose(machine.forward(readings[None], T)[0], T, atol=1e-12)


def test_what_a_file_leaves_out_is_no_parameter():
    names = read(DELTA).parameters.names
    crank_names = [n.split("base.")[1] for n in names if n.startswith("legs[1].base")]
    expected = [*(f"center.{c}" for c in "xyz"), *(f"axis.{c}" for c in "xyz"), "arm", "angle"]
    assert crank_names == expected
    more = read(DELTA.replace("arm: 0.1", "arm: 0.1, along: 0.01")).parameters
    assert set(more.names) - set(names) == {"legs[1].base.along"}
    kinds = dict(zip(more.names, more.kinds, strict=True))
    assert (kinds["legs[1].base.arm"], kinds["legs[1].base.angle"]) == ("arm", "angle")


def two_rods(second="center: [0.1, 0.0, 0.0], axis: [0, 1, 0], arm: 0.1, along: -0.02"):
    top, first, *rest = DELTA.split("  - ")
    leg = first.replace("arm: 0.1", "arm: 0.1, along: 0.02")
    other = leg.replace("center: [0.1, 0.0, 0.0], axis: [0, 1, 0], arm: 0.1, along: 0.02", second)
    assert "along" in other
    return "  - ".join([top, leg, other, *rest])


def test_legs_on_one_motor_share_axis_and_center():
    machine = read(two_rods())
    assert machine.layout.actuated.tolist() == [1, 1, 0, 2]
    assert machine.layout.shares_motors
    table = machine.parameters
    free = table.free_matrix()
    for field in ("center.x", "center.z"):
        rows = [free[table.index(f"legs[{j}].base.{field}")] for j in (1, 2)]
        np.testing.assert_array_equal(*rows)
        assert rows[0].any()
    arms = [free[table.index(f"legs[{j}].base.arm")] for j in (1, 2)]
    assert not (arms[0] * arms[1]).any()


def test_names_for_all_legs_and_opposite_signs():
    table = read(two_rods()).parameters
    tied = table.with_roles(
        (), (("legs[*].base.arm",), ("legs[1].base.along", "-legs[2].base.along"))
    )
    free = tied.free_matrix()
    # three axes of two turns each, two ties, and none of the motors' here
    assert free.shape[1] == len(table) - 3 - 2
    a, b = (free[table.index(f"legs[{j}].base.along")] for j in (1, 2))
    np.testing.assert_array_equal(a, -b)
    np.testing.assert_array_equal(
        free[table.index("legs[1].base.arm")], free[table.index("legs[2].base.arm")]
    )
    assert tied.opposed[1] == ("legs[2].base.along",)
    held = table.with_roles(("legs[*].platform.center",)).fixed
    assert len(held) == 12


def test_signs_of_ties_that_share_names():
    names = [f"legs[{j}].length.{f}" for j, f in ((1, "constant"), (2, "constant"), (3, "offset"))]
    table = read(DELTA).parameters
    free = table.with_roles((), ((names[0], f"-{names[1]}"), (names[2], f"-{names[1]}")))
    rows = [free.free_matrix()[table.index(n)] for n in names]
    np.testing.assert_array_equal(rows[0], rows[2])
    np.testing.assert_array_equal(rows[0], -rows[1])
    wrong = table.with_roles((), ((names[0], names[1]), (names[0], f"-{names[1]}")))
    with raises(InputError, code="mechanism.tied_to_opposite", found=", ".join(names[:2])):
        wrong.free_matrix()


def test_an_axis_that_stays_horizontal():
    """A component that is nominally zero can be fixed: one rotation remains."""
    table = read(DELTA).parameters
    free = table.with_roles(("legs[1].base.axis.z",)).free_matrix()
    rows = free[[table.index(f"legs[1].base.axis.{c}") for c in "xyz"]]
    assert np.count_nonzero(rows.any(axis=0)) == 1
    np.testing.assert_allclose(np.abs(rows).sum(axis=1), [1, 0, 0], atol=1e-15)
    with raises(InputError, expected="the whole axis, 'legs[1].base.axis'"):
        table.with_roles(("legs[1].base.axis.y",))


# Models

MODELS = """\
fixed: ['legs[*].base.axis']
models:
  free: {}
  alike: {tied: [['legs[1].length.constant', 'legs[2].length.constant']]}
  other: {mechanism: delta}
"""


def test_models_of_a_file(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text(DELTA + "home: {position: [0, 0, -0.1]}\n" + MODELS)
    own = load_mechanism(path).parameters
    free = load_mechanism(path, model="free").parameters
    same = load_mechanism(path, model="alike")
    assert len(own.fixed) == 6
    assert free.fixed == ()
    assert same.parameters.free_matrix().shape[1] == free.free_matrix().shape[1] - 1
    # what was chosen is what a written file holds
    assert same.to_document()["tied"] == [["legs[1].length.constant", "legs[2].length.constant"]]
    assert load_mechanism(path, model="other").name == "delta"
    with pytest.raises(InputError) as caught:
        load_mechanism(path, model="alik")
    assert str(caught.value) == (
        "m.yaml: mechanism 'small' has no model of this name; found alik, expected alike. Name a "
        "model under models in the mechanism file, with what it fixes and ties."
    )


def test_a_model_that_is_another_file_has_no_roles(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text(DELTA + "models: {other: {mechanism: delta, fixed: ['legs[1].base.arm']}}\n")
    with raises(InputError, where="m.yaml, line 13, models.other") as caught:
        load_mechanism(path)
    assert "'fixed' and 'tied'" in caught.value.what


# Faults of files


BARS = """\
  - base: {joint: spherical, center: [0.0, 0.2, 0.0]}
    platform: {joint: bar, center: [0.0, 0.02, 0.0], hinge: [0.0, 0.01, 0.0], bar: 1}
    length: {actuated: true, range: [0.1, 0.3]}
  - base: {joint: spherical, center: [0.0, -0.2, 0.0]}
    platform: {joint: bar, center: [0.0, 0.02, 0.0], hinge: [0.0, 0.02, 0.0], bar: 1}
    length: {actuated: true, range: [0.1, 0.3]}
"""


@pytest.mark.parametrize(
    ("old", "new", "facts"),
    [
        (
            "axis: [0, 1, 0]",
            "axis: [0, 0, 1]",
            {
                "where": "m.yaml, line 4, legs[1].base.axis",
                "expected": "zero: [x, y, z], the arm's direction at angle 0",
            },
        ),
        (
            "arm: 0.1",
            "arm: 0.1, zero: [0, 2, 0]",
            {
                "where": "m.yaml, line 4, legs[1].base.zero",
                "expected": "the arm's direction at angle 0, across the axis",
            },
        ),
        (
            "length: {actuated: false, constant: 0.2}",
            "length: {actuated: true, range: [0.1, 0.2]}",
            {
                "where": "m.yaml, line 6, legs[1].length",
                "expected": "length: {actuated: false, constant: the rod's length in metres}",
            },
        ),
        (
            "motor: 2",
            "motor: 3",
            {
                "where": "m.yaml, line 3, legs",
                "expected": "motors numbered from 1 in the order of the readings' columns",
            },
        ),
        (
            "range: [0.1, 0.4]",
            "range: [0.4, 0.1]",
            {
                "where": "m.yaml, line 7, legs[2].base.range",
                "found": "[0.4, 0.1]",
                "expected": "two increasing readings [min, max]",
            },
        ),
        (
            "motion: translation\n",
            "motion: translation\ntied: [['legs[1].base.arm']]\n",
            {
                "where": "m.yaml, line 3, tied[1]",
                "found": "['legs[1].base.arm']",
                "expected": "at least 2",
            },
        ),
        (
            "motion: translation\n",
            "motion: translation\nfixed: ['legs[*].base.radial']\n",
            {
                "where": "m.yaml, line 3, fixed[1]",
                "found": "'legs[*].base.radial'",
                "expected": "a name such as 'legs[1].base.angle'",
            },
        ),
        (
            DELTA[-1:],
            "\n" + BARS,
            {
                "where": "m.yaml, line 17, legs[5].platform.hinge",
                "found": "(0.0, 0.02, 0.0)",
                "expected": "(0.0, 0.01, 0.0)",
            },
        ),
        (
            "motion: translation",
            "motion: spatial",
            {
                "code": "mechanism.not_held",
                "where": "m.yaml, line 3, legs",
                "found": "3 equations for 6 freedoms",
                "expected": "one equation a leg with a length, one a revolute joint, one a pair "
                "of universal joints with axes; 6 for motion: spatial",
            },
        ),
    ],
)
def test_faults_of_driven_legs(tmp_path, old, new, facts):
    (tmp_path / "m.yaml").write_text(
        new.join(DELTA.rsplit(old, 1) if old == "\n" else DELTA.split(old, 1))
    )
    with raises(InputError, **facts):
        load_mechanism(tmp_path / "m.yaml")


@pytest.mark.parametrize(
    ("text", "where", "expected"),
    [
        (
            two_rods("center: [0.1, 0.01, 0.0], axis: [0, 1, 0], arm: 0.1, along: -0.02"),
            "m.yaml, line 7, legs[2].base.center",
            "(0.1, 0.0, 0.0)",
        ),
        (
            DELTA.replace("translation", "spatial") + BARS,
            "m.yaml, line 14, legs[4].platform.joint",
            "motion: schoenflies, or joint: hinged-bar with an axis and two rods a motor",
        ),
        (
            DELTA + BARS.replace("bar,", "hinged-bar, axis: [0, 0, 1],"),
            "m.yaml, line 14, legs[4].platform.joint",
            "motion: spatial, or joint: bar",
        ),
    ],
)
def test_faults_of_motors_and_bars(tmp_path, text, where, expected):
    (tmp_path / "m.yaml").write_text(text)
    with raises(InputError, where=where, expected=expected):
        load_mechanism(tmp_path / "m.yaml")
