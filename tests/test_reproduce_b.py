"""``pkmcal reproduce b``: the simulation, its reference values, and when it reports a failure."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pkmcal.control.simulation import End
from pkmcal.geometry.rigid import inverse
from pkmcal.papers import paper_b as expected
from pkmcal.papers.paper_b import (
    CAMERA_BY_HAND_ERRORS,
    CASES,
    CONTROLLED_POPULATION,
    E1,
    E2,
    JOINT,
    MIRROR_VIEW,
    PERSPECTIVE_VIEW,
    PLAIN_REGRESSION,
    REGRESSIONS,
    ROBUST_REGRESSION,
    SCALED_BY_SIMILARITY,
    VIEW_NAMES,
    HexapodByLegs,
    controlled_by_estimates,
    drawn_machine,
    hexapod_with_cylinder_legs,
    measured_hexapod,
    solved,
    table_of,
    views_by_name,
)
from pkmcal.studies import engine

RUNS = 8


@pytest.fixture(scope="module")
def short():
    return engine.run(HexapodByLegs(), RUNS, 2006)


@pytest.fixture(scope="module")
def ran(short):
    return controlled_by_estimates(
        short.values("centres", CONTROLLED_POPULATION, CONTROLLED_POPULATION, ROBUST_REGRESSION),
        2006,
    )


@pytest.fixture(scope="module")
def reproduced(short, ran):
    return table_of(short, ran, 12.5).outcome()


# ------------------------------------------------------------------ the simulation


@pytest.mark.parametrize("view", VIEW_NAMES)
def test_without_noise_every_method_is_exact(view):
    rng = np.random.default_rng(3)
    one = measured_hexapod(
        drawn_machine(rng), views_by_name()[view], CASES["right"], rng, 1e-7, 1e-12
    )
    for centres in solved(one, REGRESSIONS, rng).values():
        assert np.abs(centres - one.centres).max() < 1e-8


@pytest.mark.parametrize("view", VIEW_NAMES)
def test_every_leg_is_seen_in_most_configurations(view):
    rng = np.random.default_rng(3)
    one = measured_hexapod(drawn_machine(rng), views_by_name()[view], CASES["right"], rng)
    edges = one.measurements.edges
    most = 2 * expected.CONFIGURATIONS
    counts = np.bincount(edges.leg, minlength=6)
    assert counts.max() <= most
    assert counts.min() > (0.99 if view == MIRROR_VIEW else 0.5) * most  # front legs hide others
    # limits of the workspace: every reading at an end of its range
    off = np.abs(
        one.measurements.joints[..., None] - hexapod_with_cylinder_legs().joint_ranges
    ).min(axis=-1)
    assert off.max() < 1e-4


def test_cases_are_what_they_say():
    truth = drawn_machine(np.random.default_rng(5))
    right, wrong, shifted, radius = (
        measured_hexapod(truth, views_by_name()[MIRROR_VIEW], CASES[case], np.random.default_rng(6))
        for case in ("right", "20 % wrong", "shifted", "radius")
    )
    off = np.linalg.norm(wrong.measurements.edges.normal - right.measurements.edges.normal, axis=-1)
    assert 0.15 < np.mean(off > 0.02) < 0.25
    # outward: n . A = -R becomes less, the leg looks thicker and so nearer
    edges = shifted.measurements.edges
    distance = np.sum(edges.normal * shifted.centres[edges.leg], axis=-1)
    assert np.median(distance) < -expected.LEG_RADIUS - 5e-5
    assert radius.machine.radii()[0][0] == pytest.approx(1.01 * expected.LEG_RADIUS)
    assert truth.radii()[0][0] == expected.LEG_RADIUS


def test_a_wrong_radius_scales_the_machine(short):
    for view in VIEW_NAMES:
        key = (view, "radius", ROBUST_REGRESSION)
        truth, centres = short.values("truth", *key), short.values("centres", *key)
        scale = np.sum(centres * truth) / np.sum(truth**2)
        assert scale == pytest.approx(1.01, abs=5e-4)
        assert (
            short.of(view, "radius", SCALED_BY_SIMILARITY)["centre"].value
            < short.of(*key)["centre"].value / 2
        )


# ------------------------------------------------------------------ control


def test_what_is_believed_is_what_was_estimated(short, ran):
    given = short.values("centres", CONTROLLED_POPULATION, CONTROLLED_POPULATION, ROBUST_REGRESSION)
    np.testing.assert_allclose(ran.centres[E2], given, atol=1e-12)
    nominal = hexapod_with_cylinder_legs().base_centers()
    apart = np.linalg.norm(nominal[:, None] - nominal, axis=-1)
    for name in (E1, *CAMERA_BY_HAND_ERRORS):
        items = ran.centres[name]
        values = np.linalg.norm(items[:, :, None] - items[:, None], axis=-1)
        np.testing.assert_allclose(values, np.broadcast_to(apart, values.shape), atol=1e-12)
    true = inverse(views_by_name()[PERSPECTIVE_VIEW].T_camera_base)
    believed = inverse(ran.trials["hand"].estimate.view.T_camera_base)
    shift = np.linalg.norm(believed[:, :3, 3] - true[:3, 3], axis=-1)
    # three centimetres by hand, and the residual of fitting the nominal model to the truth
    assert np.abs(shift - CAMERA_BY_HAND_ERRORS["hand"][0]).max() < 5e-3


def test_every_estimate_goes_the_same_way(ran):
    starts = {name: trial.runs.T_base_platform[:, 0] for name, trial in ran.trials.items()}
    for poses in starts.values():
        np.testing.assert_array_equal(poses, starts["true"])
    assert ran.trials["true"].astray.max() == 0


# ------------------------------------------------------------------ what is expected


def test_checks_pass_and_each_can_fail(short, ran):
    names = [check.what for check in expected.checks(short, ran)]
    assert all(check.passed for check in expected.checks(short, ran))

    def spoilt(value, *key, name="centre"):
        own = {**short.of(*key), name: short.of(*key)[name]._replace(value=value)}
        return replace(short, accuracy={**short.accuracy, key: own})

    def trial(name, **change):
        trials = {**ran.trials, name: replace(ran.trials[name], **change)}
        return ran._replace(trials=trials)

    n = len(ran.centres[E2])
    late = replace(ran.trials[E1].runs, end=(*ran.trials[E1].runs.end[1:], End.STUCK))
    broken = [
        (spoilt(2e-3, PERSPECTIVE_VIEW, "right", ROBUST_REGRESSION), ran),
        (spoilt(1e-3, MIRROR_VIEW, "35 % wrong", ROBUST_REGRESSION), ran),
        (spoilt(1e-3, MIRROR_VIEW, "5 % wrong", PLAIN_REGRESSION), ran),
        (spoilt(20e-3, PERSPECTIVE_VIEW, "shifted", ROBUST_REGRESSION), ran),
        (spoilt(1e-3, MIRROR_VIEW, "shifted", JOINT), ran),
        (spoilt(1e-5, PERSPECTIVE_VIEW, "right", ROBUST_REGRESSION, name="depth"), ran),
        (short, trial(E1, runs=late)),
        (short, trial("hand", overshoot=np.full(n, 0.2))),
        (short, trial(E2, astray=np.full(n, 5e-3))),
        (spoilt(5e-3, PERSPECTIVE_VIEW, "radius", ROBUST_REGRESSION), ran),
    ]
    assert len(broken) == len(names)
    for place, (study, runs) in enumerate(broken):
        assert not expected.checks(study, runs)[place].passed, names[place]


def test_figures_of_the_prototype_are_compared(short):
    figures = expected.prototype_figures(short)
    assert len(figures) == len(expected.PROTOTYPE)
    assert [f.key[1] for f in figures if f.held] == ["radius", "radius"]
    assert all(f.tolerable for f in figures if f.held)


# ------------------------------------------------------------------ the table


def test_the_table_has_the_papers_figures(short, reproduced):
    assert reproduced.verdict.usable
    assert len(reproduced.verdict.headline) <= 120
    rows = reproduced.document["table"]
    assert {"eq. 14", "eq. 15", "eq. 16", "Figs. 6, 8", "Fig. 7", "Fig. 8", "Fig. 10"} <= {
        row["claim"].partition(":")[0] for row in rows
    }
    assert sum(row["passed"] is not None for row in rows) == len(reproduced.document["checks"])
    (cad,) = (row for row in rows if "nominal model, right edges" in row["claim"])
    assert cad["paper"] == "12, 8 mm"
    values = [1e3 * short.of(view, "right", ROBUST_REGRESSION)["cad"].value for view in VIEW_NAMES]
    assert cad["here"] == "{:.1f}, {:.1f} mm".format(*values)


def test_numbers_for_programs(short, ran, reproduced):
    document = json.loads(json.dumps(reproduced.document, default=list))
    assert document["paper"]["from_drawing"] == {"mirror": 0.012, "perspective": 0.008}
    entries = {(a["view"], a["case"], a["method"]): a for a in document["accuracy"]}
    assert set(entries) == set(short.samples)
    right = entries[MIRROR_VIEW, "right", JOINT]
    assert right["centre"] == short.of(MIRROR_VIEW, "right", JOINT)["centre"].value
    assert right["runs"] == RUNS // expected.RUNS_A_CASE
    assert document["seconds"]["wall"] == 12.5
    assert document["control"][E2]["astray"] == float(np.median(ran.trials[E2].astray))
