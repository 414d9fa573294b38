"""[B] 14 for all legs at once: exact on exact edges, true deviations, and no leg lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pkmcal
from faults import raises
from pkmcal.cameras import camera_models
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import apply, look_at, perturb, register
from pkmcal.identify.covariance import Identifiability
from pkmcal.identify.gauge import BestFit, centre_index, generators, transformation
from pkmcal.identify.methods import linear
from pkmcal.identify.methods.estimates import linear_estimate
from pkmcal.identify.methods.linear_together import base_together
from pkmcal.identify.unidentified import Identification
from pkmcal.identify.verdict import assess
from pkmcal.measurements import Measurements, Observation
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from test_identify_scene import exact

NOMINAL = exact("gough-stewart")
STATION = look_at(
    np.array([0.01, -0.02, 0.06]), np.array([0.01, -0.02, 0.4]), np.array([0, -1.0, 0])
)
MIRROR = camera_models()["unified"](
    (640, 480), np.array([149.0, 149.2, 319.8, 240.2, 0.9, 0, 0, 0, 0])
)
"""Hyperbolic: it sees down to 17 degrees below its horizon."""


def true_machine(rng, share=1.0):
    """Machine with errors as large as the prior sigmas."""
    table = NOMINAL.parameters
    off = share * table.tolerances_free() * rng.normal(size=table.free_matrix().shape[1])
    return NOMINAL.with_values(table.nominal + table.free_matrix() @ off)


def measured_lines(machine, rng, noise, configurations=12, shading=0.0):
    """Edges in the mirror; shading (px) of each side of a tube by Student's t."""
    spread = np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.04])
    poses = perturb(machine.home(), rng.uniform(-1, 1, (configurations, 6)) * spread)
    edges, joints = simulate_edges(machine, STATION[None], MIRROR, poses, noise, rng)
    line = (edges.leg * 2 + edges.tube) * 2 + edges.side
    pixels = shading * rng.standard_t(4, size=line.max() + 1)[line, None]
    edges = shifted(edges, pixels)
    return Measurements(edges, joints, 3e-6, 1, np.zeros(1, dtype=int), shaded=True)


def shifted(edges, pixels):
    """Edges that lie outwards by some pixels (N, 1)."""
    shifted = edges.normal + (edges.basis @ (edges.shift * pixels)[..., None])[..., 0]
    shifted /= np.linalg.norm(shifted, axis=-1, keepdims=True)
    basis = edges.basis - shifted[..., None] * (shifted[:, None] @ edges.basis)
    return replace(edges, normal=shifted, basis=basis)


def missed(value, truth):
    """Root mean square (m) of what base centres (L, 3) miss, laid on the truth."""
    return float(np.sqrt(np.mean((value - apply(register(truth, value), truth)) ** 2)))


def leg_by_leg(measurements):
    """The paper's own: each leg alone, then the scale (16)."""
    value = linear.centres(NOMINAL, measurements, "robust").centres[0]
    return value / linear.procrustes_scale(value, NOMINAL.base_centers())


def together(measurements):
    return NOMINAL.with_values(base_together(NOMINAL, measurements).theta).base_centers()


@pytest.fixture(scope="module")
def scenes():
    """Machines, cameras and tubes with errors of their stated standard deviations, each once."""
    made = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        machine = true_machine(rng)
        noise = EdgeNoise(outward=0.3 * rng.normal(), wrong=0.03)
        made.append((machine, measured_lines(machine, rng, noise, shading=0.05)))
    return made


def test_exact_edges_give_the_base_and_the_edge_shift():
    """With a weak prior and exact radii the data alone decide."""
    rng = np.random.default_rng(1)
    truth = true_machine(rng)
    radii = truth.parameters.of_kind("radius")
    tolerance = np.ones(len(truth.values))
    tolerance[radii] = 1e-9
    nominal = NOMINAL.values.copy()
    nominal[radii] = truth.values[radii]
    table = replace(NOMINAL.parameters, nominal=nominal, tolerance=tolerance)
    machine = replace(NOMINAL, parameters=table, values=nominal)
    sharp = EdgeNoise(shift=1e-6, tilt=1e-6, outward=0.2)
    measurements = measured_lines(truth, rng, sharp)
    stated = replace(measurements.edges, covariance=1e6 * measurements.edges.covariance)
    measurements = replace(measurements, edges=stated, shaded=False)
    value = base_together(machine, measurements)
    base = machine.with_values(value.theta).base_centers()
    # the shift counts to first order, and what is known of it beforehand draws a little
    assert missed(base, truth.base_centers()) < 1e-6
    assert value.edge_shift[0] == pytest.approx(0.2, abs=1e-4)
    alone = linear.centres(machine, measurements, "robust").centres[0]
    assert missed(alone, truth.base_centers()) > 1e-3


def test_better_than_leg_by_leg(scenes):
    """Radii and shading of single legs, which no scale absorbs, are weighted against the prior."""
    errors = np.array(
        [
            [missed(f(m), machine.base_centers()) for f in (together, leg_by_leg)]
            for machine, m in scenes
        ]
    )
    drawn = [missed(NOMINAL.base_centers(), machine.base_centers()) for machine, _ in scenes]
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert rms[0] < 0.8 * rms[1]
    assert rms[0] < 0.7 * np.sqrt(np.mean(np.square(drawn)))


def test_a_leg_that_is_lost_alone_is_not_lost_together():
    """A third of wrong edges in twelve images: legs collapse towards the mirror one by one."""
    alone, both = [], []
    for seed in range(4):
        rng = np.random.default_rng(50 + seed)
        machine = true_machine(rng)
        measurements = measured_lines(machine, rng, EdgeNoise(wrong=0.4), shading=0.05)
        alone.append(missed(leg_by_leg(measurements), machine.base_centers()))
        both.append(missed(together(measurements), machine.base_centers()))
    assert max(alone) > 10e-3
    assert max(both) < 2e-3


def test_one_side_of_a_tube_two_pixels_off():
    """A highlight's border along a whole tube: its leg alone is put a centimetre off."""
    rng = np.random.default_rng(5)
    machine = true_machine(rng)
    measurements = measured_lines(machine, rng, EdgeNoise())
    edges = measurements.edges
    off = (edges.leg == 2) & (edges.tube == 0) & (edges.side == 1)
    measurements = replace(measurements, edges=shifted(edges, -2.0 * off[:, None]))
    assert missed(leg_by_leg(measurements), machine.base_centers()) > 3e-3
    assert missed(together(measurements), machine.base_centers()) < 1.5e-3


def chi2(values, value, covariance, machine):
    """Sum of squares of an error by its covariance (P, P), frames taken out of both, and how many
    numbers it holds.
    """
    layout = machine.layout
    keep = np.concatenate([i.ravel() for i in centre_index(layout)] + [layout.rod[layout.rod >= 0]])
    frames = np.linalg.qr(generators(layout, value)[keep])[0]
    project = np.eye(len(keep)) - frames @ frames.T
    error = project @ (value - values)[keep]
    spread, axes = np.linalg.eigh(project @ covariance[np.ix_(keep, keep)] @ project)
    above_limit = spread > 1e-9 * spread[-1]
    return np.sum((axes.T @ error)[above_limit] ** 2 / spread[above_limit]), int(above_limit.sum())


def test_deviations_are_true_for_base_platform_and_lengths(scenes):
    """Standard deviations match the errors; nominal parameters keep their prior sigmas."""
    squares, shifts, count = [], [], 0
    for machine, measurements in scenes:
        estimate = linear_estimate(NOMINAL, measurements)
        values = _laid_on(machine, estimate.machine)
        square, numbers = chi2(values, estimate.state.theta, estimate.covariance, estimate.machine)
        squares.append(square)
        count += numbers
        shifts.append(estimate.state.columns[EDGE_SHIFT][0] / 0.3)
    assert count == 12 * 30
    # within four deviations of a mean square of one
    assert np.sum(squares) / count == pytest.approx(1, abs=4 * np.sqrt(2 / count))


def _laid_on(machine, value):
    """Values (P,) of the machine in the frames that fit its centres to the estimated ones."""
    values = machine.values.copy()
    for index, old, new in zip(
        centre_index(machine.layout),
        (machine.base_centers(), machine.platform_centers()),
        (value.base_centers(), value.platform_centers()),
        strict=True,
    ):
        values[index] = apply(register(old, new), old)
    return values


def test_verdict_states_how_far_the_method_goes(scenes):
    """Base joints by edges, by the nominal model and by both: figures, and the better method."""
    machine, measurements = scenes[0]
    estimate = linear_estimate(NOMINAL, measurements)
    observation = Observation(
        measurements.edges,
        (),
        np.zeros((0, 2)),
        np.zeros(0, dtype=int),
        estimate.state.T_camera_base,
    )
    information = Identifiability(0, 0, 0, (), (), np.zeros(0), np.zeros((0, 0)))
    verdict = assess(observation, estimate, Identification(information, (), (), 1.0), "linear")
    assert not verdict.usable
    (base,) = verdict.of("estimate.base_only")
    both, edges, nominal = (
        1e3 * base.facts[name] for name in ("sigma", "edges_sigma", "nominal_sigma")
    )
    assert both < min(edges, nominal)
    # of 18 coordinates with 2 mm each, six are frames
    assert nominal == pytest.approx(2 * np.sqrt(12 / 18), rel=0.05)
    n = len(estimate.covariance)
    keep = transformation(estimate.machine, estimate.state, BestFit())[:n, :n]
    spread = np.diag(keep @ estimate.covariance @ keep.T)[centre_index(machine.layout)[0].ravel()]
    assert both == pytest.approx(1e3 * np.sqrt(spread.mean()), rel=0.05)


def test_few_legs_are_reported():
    machine = true_machine(np.random.default_rng(0))
    measurements = measured_lines(machine, np.random.default_rng(0), EdgeNoise())
    edges = measurements.edges
    few = replace(measurements, edges=edges.select(edges.leg < 2))
    with raises(ResultError, code="method.few_legs", found="2 legs at one of them"):
        base_together(NOMINAL, few)


def test_joints_that_move_are_reported():
    machine = pkmcal.load_mechanism("6-rus")
    measurements = measured_lines(NOMINAL, np.random.default_rng(0), EdgeNoise())
    with raises(ResultError, code="method.other_joints") as caught:
        base_together(machine, measurements)
    assert "'6-rus'" in caught.value.found
