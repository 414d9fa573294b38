"""Refusals of [A]'s steps: a sentence that names the legs, with [A]'s counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.conditions import Condition, conditions
from pkmcal.identify.methods import four_step_checks as checks
from pkmcal.identify.methods.four_step import four_step
from pkmcal.identify.nominal_joints import nominal_joints
from pkmcal.mechanisms import load_mechanism, machine_from_document
from pkmcal.mechanisms.document import MechanismDocument
from test_four_step_machines import (
    THREE_BY_THREE,
    THREE_BY_TWO,
    make_scene,
    noisy,
    visible_legs,
)
from test_identify_scene import exact


def refused(scene, measurements, code, *facts) -> ResultError:
    """The error of [A]'s method, which has this code and names these facts."""
    with raises(ResultError, code=code) as caught:
        four_step(scene.nominal, measurements)
    for fact in facts:
        assert fact in str(caught.value)
    assert caught.value.next_step
    return caught.value


@pytest.fixture(scope="module")
def hexapod():
    return make_scene("gough-stewart", np.random.default_rng(1), 24)


def test_no_edge_at_all(hexapod):
    none = hexapod.select(np.zeros(len(hexapod.measurements.edges), dtype=bool))
    refused(hexapod, none, "method.no_edges")


@pytest.mark.parametrize("name", ["gough-stewart", "3-rpr", "6-spu-passive"])
def test_a_leg_that_no_station_sees(name):
    scene = make_scene(name, np.random.default_rng(2), 12)
    last = scene.nominal.n_legs
    part = scene.select(scene.measurements.edges.leg != last - 1)
    refused(scene, part, "method.leg_not_visible", f"leg {last} of {last}")


def test_a_leg_seen_in_one_direction_only(hexapod):
    edges = hexapod.measurements.edges
    part = hexapod.select((edges.leg != 2) | (edges.configuration == 5))
    refused(hexapod, part, "method.leg_not_visible", "leg 3 of 6")


def test_a_station_that_sees_two_legs(hexapod):
    edges = hexapod.measurements.edges
    part = hexapod.select((edges.station != 1) | (edges.leg < 2))
    refused(hexapod, part, "method.few_legs", "station 2", "2 base centres (legs 1 and 2)")


def test_stations_that_share_no_or_two_legs(hexapod):
    """Three cameras with three legs each: all of them fixed by their legs, none by the others."""
    three = np.array([[0, 1, 2], [3, 4, 5], [3, 4, 5]])
    code = "method.stations_apart"
    error = refused(hexapod, hexapod.select(visible_legs(hexapod, three)), code)
    assert "legs 1 to 3 can move against those of legs 4 to 6" in error.what
    assert "station 2 sees legs 4 to 6" in error.found
    assert "calibration board" in error.next_step
    refused(hexapod, hexapod.select(visible_legs(hexapod, THREE_BY_THREE)), code)
    two = hexapod.select(
        visible_legs(hexapod, np.array([[0, 1, 2, 3], [0, 1, 4, 5], [0, 1, 4, 5]]))
    )
    refused(hexapod, two, code, "legs 3 and 4", "legs 5 and 6")


def test_one_station_that_sees_four_legs_of_six(hexapod):
    edges = hexapod.measurements.edges
    part = hexapod.select((edges.station == 0) & (edges.leg < 4))
    one = replace(part, n_stations=1, camera_of_station=np.zeros(1, int))
    refused(hexapod, one, "method.leg_not_visible", "leg 5 of 6")


def test_too_few_legs_at_once(hexapod):
    """Every leg is visible often, but never three of them in one configuration."""
    edges = hexapod.measurements.edges
    pair = edges.configuration % 3
    part = hexapod.select((edges.leg // 2) == pair)
    refused(hexapod, part, "method.few_legs_at_once", "2 at most", "three or more")


@pytest.mark.parametrize(
    ("name", "motion", "legs", "expected"),
    [
        ("3-rpr", "planar", 3, "expected two or more, [A] 3.5"),
        ("gough-stewart", "schoenflies", 4, "expected two or more, not one above the other, [A]"),
    ],
)
def test_too_few_legs_at_once_where_the_platform_cannot_tilt(name, motion, legs, expected):
    fields = {**load_mechanism(name).document.model_dump(by_alias=True), "motion": motion}
    fields["legs"] = fields["legs"][:legs]
    machine = machine_from_document(MechanismDocument.model_validate(fields))
    rng, n = np.random.default_rng(3), 24
    steps = rng.uniform(-1, 1, (n, 6)) * np.repeat([0.2, 0.05], 3)
    poses = perturb(machine.home(), steps @ machine.layout.motion @ machine.layout.motion.T)
    scene = make_scene(machine, rng, joints=machine.inverse(poses))
    edges = scene.measurements.edges
    part = scene.select(edges.leg == edges.configuration % legs)
    refused(scene, part, "method.few_legs_at_once", "1 at most", expected)


def test_legs_that_are_never_seen_together(hexapod):
    """Two halves of the platform, each by three legs at once: their places stay free."""
    edges = hexapod.measurements.edges
    part = hexapod.select((edges.leg // 3) == edges.configuration % 2)
    refused(
        hexapod,
        part,
        "method.legs_apart",
        "legs 1 to 3 can move against those of legs 4 to 6",
    )
    with_bridge = hexapod.select(
        ((edges.leg // 3) == edges.configuration % 2) | (edges.configuration > 15)
    )
    four_step(hexapod.nominal, with_bridge)


def test_images_of_one_configuration_by_several_stations_are_at_once(hexapod):
    """The printed form, which uses each image alone, refuses what the corrected form accepts."""
    rng = np.random.default_rng(3)
    scene = make_scene("gough-stewart", rng, 24)
    keep = visible_legs(scene, THREE_BY_TWO)
    part = scene.select(keep)
    guess = scene.truth.T_camera_base
    values = four_step(scene.nominal, part, T_camera_base_guess=guess)
    np.testing.assert_allclose(values.theta, scene.truth.theta, atol=1e-8)
    with raises(ResultError, code="method.few_legs_at_once", found="2 at most"):
        four_step(scene.nominal, part, T_camera_base_guess=guess, form="printed")


def test_a_passive_leg_without_three_others():
    scene = make_scene("6-spu-passive", np.random.default_rng(4), 12)
    edges = scene.measurements.edges
    alone = edges.configuration % 2 == 0
    part = scene.select(np.where(alone, edges.leg == 6, edges.leg < 6))
    refused(scene, part, "method.joint_unidentifiable", "leg 7", "seen in 0 configurations")


def test_a_passive_leg_that_does_not_turn():
    """Heave with a leg in the middle: its joints could lie anywhere along it."""
    nominal = exact("6-spu-passive")
    low, high = nominal.joint_ranges.T
    heave = low + (high - low) * np.linspace(0.2, 0.8, 24)[:, None]
    rng = np.random.default_rng(5)
    scene = make_scene(nominal, rng, joints=heave)
    refused(scene, noisy(scene.measurements, rng), "method.leg_one_direction", "leg 7 of 7")


def test_lengths_that_the_distances_do_not_determine():
    """A platform that only shifts with parallel legs: a common length is free (errata)."""
    scene = make_scene("constant-legs", np.random.default_rng(6), 12)
    legs = nominal_joints(scene.nominal)
    # a parallelogram: all legs parallel in every configuration, platform and base congruent
    rng = np.random.default_rng(7)
    u = np.array([0.0, 0, 1]) + 0.3 * rng.normal(size=(12, 3))
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    from pkmcal.identify.methods.leg_axes import Axes

    k = np.arange(12)
    u = np.broadcast_to(u[None, :, None], (1, 12, 6, 3)).copy()
    axes = Axes(0 * k, k, np.ones((12, 6), dtype=bool), u, 0 * u, np.zeros((1, 12, 6)))
    with raises(ResultError, code="method.lengths_unidentifiable"):
        checks.lengths_are_fixed(
            scene.nominal,
            axes,
            np.ones(1, dtype=bool),
            legs.base[None],
            np.eye(4)[None, None],
            legs.rod[None] + 0.4,
        )


def test_a_length_that_collapsed_is_reported():
    nominal = exact("constant-legs")
    legs = nominal_joints(nominal)
    q0 = np.where(np.arange(6) == 2, 0.001, legs.rod)[None]
    with raises(ResultError, code="method.length_collapsed", found="1 mm") as caught:
        checks.not_collapsed(legs, q0[0])
    assert caught.value.what.startswith("leg 3 ")
    checks.not_collapsed(legs, legs.rod)


# the paper's counts ------------------------------------------------------------------------


def by_equation(name, in_view) -> dict[str, Condition]:
    values = conditions(load_mechanism(name), np.asarray(in_view, dtype=bool))
    return {c.equation: c for c in values}


def test_counts_of_the_papers_own_example():
    """[A] 4.1: three stations, four legs each, are sufficient by (12)."""
    visible = np.zeros((3, 6), dtype=bool)
    for s in range(3):
        visible[s, [(2 * s + k) % 6 for k in range(4)]] = True
    value = by_equation("gough-stewart", visible)
    assert (value["[A] 11, 12"].needed, value["[A] 11, 12"].available) == (12, 18)
    assert (value["[A] 15"].needed, value["[A] 15"].available) == (6, 18)
    assert (value["[A] 17"].needed, value["[A] 17"].available) == (12, 18)
    assert all(c.met for c in value.values())
    visible[:, 3:] = False
    value = by_equation("gough-stewart", visible)
    assert not value["[A] 3.3"].met
    assert "legs 4 to 6" in value["[A] 3.3"].text
    assert (value["[A] 11, 12"].available, value["[A] 11, 12"].met) == (4, False)


def test_counts_of_a_planar_machine():
    """(10) corrected: 1 + 2 (n - 2) = 3 for three legs, where the paper prints 4."""
    value = by_equation("3-rpr", [[1, 1, 1]])
    assert (value["[A] 10, 12"].needed, value["[A] 10, 12"].available) == (3, 3)
    assert (value["[A] 17"].needed, value["[A] 17"].available) == (3, 3)
    assert all(c.met for c in value.values())
    assert not by_equation("3-rpr", [[1, 1, 0], [0, 1, 1]])["[A] 10, 12"].met


def test_counts_with_revolute_axes():
    """(11): 3 + 2 r of three centres and axes; (12): 3 + 3 + 6 products of one station."""
    value = by_equation("3-rps", [[1, 1, 1]])["[A] 11, 12"]
    assert (value.needed, value.available, value.met) == (9, 12, True)
    value = by_equation("3-rps", [[1, 1, 0], [0, 1, 1]])["[A] 11, 12"]
    assert (value.needed, value.available, value.met) == (9, 2 * (1 + 1 + 2), False)


def test_counts_of_a_passive_leg():
    value = by_equation("6-spu-passive", [[1, 1, 1, 1, 1, 1, 1]])
    assert (value["[A] 15"].needed, value["[A] 17"].needed) == (6, 12)
    assert (value["[A] 19"].needed, value["[A] 19"].available) == (3, 6)
    value = by_equation("6-spu-passive", [[1, 1, 1, 1, 1, 1, 0], [1, 1, 0, 0, 0, 0, 1]])
    assert (value["[A] 19"].available, value["[A] 19"].met) == (2, False)
    assert "passive leg 7" in value["[A] 19"].text


def test_counts_are_necessary_at_most(hexapod):
    """Errata, A 12: enough equations by the count, and the stations still share too few legs."""
    two = np.array([[0, 1, 2, 3], [0, 1, 4, 5], [0, 1, 4, 5]])
    visible = np.zeros((3, 6), dtype=bool)
    visible[np.arange(3)[:, None], two] = True
    assert all(c.met for c in conditions(hexapod.nominal, visible))
    refused(hexapod, hexapod.select(visible_legs(hexapod, two)), "method.stations_apart")
