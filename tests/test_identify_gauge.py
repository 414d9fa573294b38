"""Gauges: frames change, nothing measurable does, and the covariance follows exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.geometry.rigid import apply as move
from pkmcal.geometry.rigid import perturb, pose_difference
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.covariance import Information, machine_covariance
from pkmcal.identify.gauge import (
    BestFit,
    ThreeCentres,
    alignment,
    carried_errors,
    centre_index,
    changed_frames,
    freedoms,
    generators,
    in_gauge,
    station_generators,
    transformation,
)
from pkmcal.identify.state import estimated_unknowns
from pkmcal.mechanisms.closure import closure
from test_identify_scene import make_scene

GAUGES = [ThreeCentres(), ThreeCentres((1, 3, 5)), BestFit()]


def moved_state(rng, scene, size=0.05):
    e, f = (perturb(np.eye(4), size * rng.normal(size=6)) for _ in range(2))
    return changed_frames(scene.machine.layout, scene.state(), e, f)


@pytest.mark.parametrize("gauge", GAUGES)
def test_constraints_hold_and_nothing_measurable_changes(gauge):
    rng = np.random.default_rng(0)
    scene = make_scene(rng)
    machine = scene.machine
    state = moved_state(rng, scene, 0.2)
    values = in_gauge(machine, state, gauge)
    c = gauge.constraints(machine)
    np.testing.assert_allclose(c @ values.theta, c @ machine.parameters.nominal, atol=1e-14)
    legs = closure(machine.layout, values.theta, scene.joints[0], values.T_base_platform)
    np.testing.assert_allclose(legs.rows.value, 0, atol=1e-13)
    base, _ = centre_index(machine.layout)
    in_view = [move(s.T_camera_base[:, None], s.theta[base]) for s in (state, values)]
    np.testing.assert_allclose(in_view[0], in_view[1], atol=1e-13)
    again = in_gauge(machine, values, gauge)
    np.testing.assert_allclose(again.theta, values.theta, atol=1e-14)


def test_three_centres_as_the_design_states():
    rng = np.random.default_rng(1)
    scene = make_scene(rng)
    base = centre_index(scene.machine.layout)[0]
    d = scene.machine.parameters.nominal[base]
    a = in_gauge(scene.machine, moved_state(rng, scene), ThreeCentres()).theta[base]
    np.testing.assert_allclose(a[0], d[0], atol=1e-14)
    np.testing.assert_allclose(np.cross(a[2] - a[0], d[2] - d[0]), 0, atol=1e-14)
    assert (a[2] - a[0]) @ (d[2] - d[0]) > 0
    normal = np.cross(d[2] - d[0], d[4] - d[0])
    assert (a[4] - a[0]) @ normal == pytest.approx(0, abs=1e-15)


def test_best_fit_is_the_least_squares_fit():
    """No small motion of either frame reduces the distance of the centres from the nominal ones."""
    rng = np.random.default_rng(2)
    scene = make_scene(rng)
    values = in_gauge(scene.machine, moved_state(rng, scene), BestFit())
    nominal = scene.machine.parameters.nominal

    def cost(e, f):
        theta = changed_frames(scene.machine.layout, values, e, f).theta
        return sum(np.sum((theta - nominal)[i] ** 2) for i in centre_index(scene.machine.layout))

    least = cost(np.eye(4), np.eye(4))
    for _ in range(20):
        delta = 1e-4 * rng.normal(size=(2, 6))
        assert cost(*(perturb(np.eye(4), d) for d in delta)) > least


def test_generators_against_small_motions():
    rng = np.random.default_rng(3)
    scene = make_scene(rng)
    state = moved_state(rng, scene)
    y = 1e-6 * rng.normal(size=12)
    e, f = perturb(np.eye(4), y[:6]), perturb(np.eye(4), y[6:])
    after = changed_frames(scene.machine.layout, state, e, f)
    change = generators(scene.machine.layout, state.theta) @ y
    np.testing.assert_allclose(after.theta - state.theta, change, atol=1e-11)
    change = station_generators(state.T_camera_base) @ y
    values = pose_difference(after.T_camera_base, state.T_camera_base)
    np.testing.assert_allclose(values, change, atol=1e-11)


def with_mounts(state, rng):
    """The state with a board on the base and one on the platform."""
    mounts = perturb(np.eye(4), 0.3 * rng.normal(size=(2, 6)))
    return replace(state, T_mount=mounts, on_platform=np.array([False, True]))


def off(state, errors):
    """The state with errors (n,) of parameters, stations and mounts."""
    unknowns = estimated_unknowns(state)
    return replace(
        state,
        theta=state.theta + errors[unknowns.machine],
        T_camera_base=perturb(state.T_camera_base, errors[unknowns.stations].reshape(-1, 6)),
        T_mount=perturb(state.T_mount, errors[unknowns.mounts].reshape(-1, 6)),
    )


def test_errors_are_carried_by_a_finite_frame_change():
    rng = np.random.default_rng(4)
    scene = make_scene(rng)
    machine, state = scene.machine, with_mounts(scene.state(), rng)
    e, f = (perturb(np.eye(4), 0.4 * rng.normal(size=6)) for _ in range(2))
    unknowns = estimated_unknowns(state)
    small = 1e-6 * rng.normal(size=unknowns.count)
    wrong = off(state, small)
    right_after, wrong_after = (changed_frames(machine.layout, s, e, f) for s in (state, wrong))
    carried = carried_errors(machine.layout, state, e, f) @ small
    np.testing.assert_allclose(
        wrong_after.theta - right_after.theta, carried[unknowns.machine], atol=1e-11
    )
    for part, after in ((unknowns.stations, "T_camera_base"), (unknowns.mounts, "T_mount")):
        values = pose_difference(getattr(wrong_after, after), getattr(right_after, after))
        np.testing.assert_allclose(values.ravel(), carried[part], atol=1e-11)


@pytest.mark.parametrize("gauge", GAUGES)
def test_transformation_is_the_derivative_of_apply(gauge):
    """Errors in the gauge, by central differences through the whole of ``in_gauge``."""
    rng = np.random.default_rng(5)
    scene = make_scene(rng)
    machine = scene.machine
    state = in_gauge(machine, with_mounts(scene.state(), rng), gauge)
    unknowns = estimated_unknowns(state)
    s = transformation(machine, state, gauge)
    for _ in range(5):
        d = 1e-6 * rng.normal(size=s.shape[1])
        plus, minus = (in_gauge(machine, off(state, sign * d), gauge) for sign in (1, -1))
        numeric = 0.5 * (plus.theta - minus.theta)
        np.testing.assert_allclose(numeric, (s @ d)[unknowns.machine], atol=1e-12)
        numeric = 0.5 * pose_difference(plus.T_camera_base, minus.T_camera_base).ravel()
        np.testing.assert_allclose(numeric, (s @ d)[unknowns.stations], atol=1e-11)
        numeric = 0.5 * pose_difference(plus.T_mount, minus.T_mount).ravel()
        np.testing.assert_allclose(numeric, (s @ d)[unknowns.mounts], atol=1e-11)
    np.testing.assert_allclose(s @ s, s, atol=1e-10)  # the transformation is idempotent
    np.testing.assert_allclose(gauge.constraints(machine) @ s[unknowns.machine], 0, atol=1e-12)


@pytest.mark.parametrize("first", GAUGES)
@pytest.mark.parametrize("second", GAUGES)
def test_covariance_transformed_equals_covariance_recomputed(first, second):
    """Solved with one gauge's rows and transformed to another, or solved with the other's
    directly.
    """
    rng = np.random.default_rng(6)
    scene = make_scene(rng, configurations=8)
    machine, m = scene.machine, scene.measurements(np.random.default_rng(7))
    values = []
    for rows in (first, second):
        assembled = assemble(machine, m, rows, use_prior=False)
        state = in_gauge(machine, scene.state(), rows)
        info = Information(assembled.problem, batch_of(machine, assembled, state))
        values.append(
            machine_covariance(assembled.problem, machine, state, info.covariance[0], second)
        )
    scale = np.sqrt(np.diag(values[1])) + 1e-9
    np.testing.assert_allclose(
        values[0] / np.outer(scale, scale), values[1] / np.outer(scale, scale), atol=1e-5
    )


def test_end_effector_does_not_depend_on_the_gauge():
    """Readings to pose, and the pose's change between two sets of readings, in any frames."""
    rng = np.random.default_rng(8)
    scene = make_scene(rng)
    poses = []
    for gauge in GAUGES:
        values = in_gauge(scene.machine, scene.state(), gauge)
        machine = scene.machine.with_values(values.theta)
        T = machine.forward(scene.joints[0], values.T_base_platform)
        b = machine.platform_centers()
        points = move(T[:, None], b)
        poses.append(np.linalg.norm(points[1:] - points[:-1], axis=-1))
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-12)
    np.testing.assert_allclose(poses[0], poses[2], atol=1e-12)


def test_fixed_parameters_take_frames_away():
    machine = make_scene(np.random.default_rng(9)).machine
    assert freedoms(machine).shape == (12, 12)
    for fixed, remainder in (
        (("legs[1].base.center.x",), 11),
        (tuple(f"legs[2].platform.center.{a}" for a in "xyz"), 9),
        (tuple(f"legs[{j}].base.center.{a}" for j in (1, 3, 5) for a in "xyz"), 6),
    ):
        held = replace(machine, parameters=machine.parameters.with_roles(fixed=fixed))
        basis = freedoms(held)
        assert basis.shape == (12, remainder)
        shifted = generators(held.layout, held.parameters.nominal) @ basis
        rows = [held.parameters.index(name) for name in fixed]
        np.testing.assert_allclose(shifted[rows], 0, atol=1e-12)


def test_alignment_of_a_state_already_in_the_gauge_is_nothing():
    scene = make_scene(np.random.default_rng(10))
    state = in_gauge(scene.machine, scene.state(), ThreeCentres())
    for transform in alignment(scene.machine, state, ThreeCentres()):
        np.testing.assert_allclose(transform, np.eye(4), atol=1e-13)
