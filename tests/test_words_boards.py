"""Unidentifiable directions of boards on platforms with cranks, sliders and bars: [C]'s machine and
the deltas.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pkmcal.geometry.rigid import perturb, pose_difference
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.covariance import Information, identifiability
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.motions import Situation, sizes
from pkmcal.identify.tool import platform_by_parameters, pose_by_parameters
from pkmcal.identify.unidentified import conventions_held, explain
from pkmcal.identify.verdict import assess
from pkmcal.levels import INSEPARABLE_CORRELATION
from pkmcal.measurements import EdgeSet, Observation
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.parameters import ParameterTable
from pkmcal.report import correlation_plot
from pkmcal.report.identifiability import held_text as held_in_words
from pkmcal.report.identifiability import tied as tied_in_words
from pkmcal.report.parameters import bound_together, grouped, tight_pairs
from pkmcal.solver.search import Stop
from pose_sessions import estimated, measured, papers_poses, upright


@cache
def findings_of(name, model=None, shape=""):
    """Rank test and findings of a session of 40 to 71 poses; shape: straight, of one line."""
    rng = np.random.default_rng(1)
    machine = load_mechanism(name, model=model)
    poses = papers_poses()[:71] if name.startswith("h4") else kit_poses(rng, machine, shape)
    case = measured(machine, poses, rng)
    estimate = estimated(machine, case, rng)
    assembled = assemble(machine, case.measurements, default_gauge(machine))
    state = batch_of(machine, assembled, estimate.state)
    values = identifiability(Information(assembled.problem, state), machine)
    return values, explain(values, estimate, np.ones((1, machine.n_legs), bool)), estimate


def kit_poses(rng, machine, shape):
    if machine.layout.motion.shape[1] == 6:
        size = np.repeat([0.2, 0.05], 3)
        return perturb(np.tile(machine.home(), (40, 1, 1)), size * rng.uniform(-1, 1, (40, 6)))
    x = rng.uniform([-0.06, -0.06, -0.03], [0.06, 0.06, 0.03], (40, 3)) * (
        [0, 0, 1] if shape == "straight" else 1
    )
    return upright(np.c_[x + machine.home()[:3, 3], np.zeros(40)])


def of(findings, start):
    return [s for s in (*findings.unidentified, *findings.weak) if s.text.startswith(start)]


def test_the_half_width_is_never_distinguished_from_the_base():
    values, findings, _ = findings_of("h4")
    assert len(values.unidentified) == 2
    (width,) = of(findings, "Of y of the base joints and of the side bars' joints (half a bar's")
    assert "only the difference is determined: both can shift alike in one way" in width.text
    assert set(width.parameters) == {
        f"legs[{j}].{side}.center.y" for j in range(1, 5) for side in ("base", "platform")
    }
    assert (width.dimensions, width.matters) == (1, False)
    assert ".base." not in width.advice  # either end is enough, the bars are one value


def test_the_turn_about_z_is_found_and_one_number_holds_it():
    _, findings, _ = findings_of("h4")
    (turn,) = of(findings, "The turn of the base frame about z is free")
    assert (turn.dimensions, turn.matters) == (1, False)
    assert '"legs[1].base.axis.x" beside what stands under fixed: in' in turn.advice


def test_what_the_advice_holds_leaves_nothing_open():
    machine = load_mechanism("h4")
    table = machine.parameters
    held = (*table.fixed, "legs[1].base.axis.x", "legs[1].platform.center.y")
    tied = tuple(
        tuple(f"-{n}" if n in against else n for n in group)
        for group, against in zip(table.tied, table.opposed, strict=True)
    )
    rng = np.random.default_rng(1)
    case = measured(machine, papers_poses()[:71], rng)
    estimate = estimated(machine, case, rng)
    machine = replace(machine, parameters=table.with_roles(held, tied))
    assembled = assemble(machine, case.measurements, default_gauge(machine))
    info = Information(assembled.problem, batch_of(machine, assembled, estimate.state))
    values = identifiability(info, machine)
    before = findings_of("h4")[0]
    assert values.unidentified == ()
    assert values.rank == before.rank
    assert values.n_parameters == before.n_parameters - 2


def test_parallelism_is_attributed_to_the_board():
    _, findings, _ = findings_of("h4")
    (tilt,) = of(findings, "How the cranks' axes of legs 1 to 4 are tilted to each other")
    assert "is known from the nominal model only in one way: +1 mm of leg " in tilt.text
    assert any(".base.axis." in name for name in tilt.parameters)
    assert (tilt.weak, tilt.matters) == (True, False)  # readings do not determine it


@pytest.mark.parametrize("name", ["delta", "linear-delta"])
def test_of_both_radii_only_the_difference_is_seen(name):
    _, findings, _ = findings_of(name)
    first = findings.unidentified[0]
    assert first.text.startswith(
        "Of x, y and z of the base joints and of the platform joints, only the difference is "
        "determined, as the difference of base and platform radius"
    )
    assert (first.dimensions, first.matters) == (6, False)
    assert ".base." not in first.advice


def test_poses_on_one_line_confound_sizes():
    _, findings, _ = findings_of("delta", None, "straight")
    (sizes,) = of(findings, "The base radius and the arm length, of all legs alike")
    assert sizes.matters
    assert sizes.moves_platform > 0.1 * findings.by_nominal
    assert set(sizes.parameters) >= {"legs[1].base.arm", "legs[1].base.center.y"}
    whole = findings_of("delta")[1]
    assert all(s.moves_platform < 0.1 * whole.by_nominal for s in common_values(whole))


def common_values(findings):
    every = (*findings.unidentified, *findings.weak)
    return [s for s in every if "of all legs alike, cannot be separated" in s.text]


def test_what_moves_with_hinges_moves_no_platform():
    """Bars that turn on hinges take up what shifts their joints: the centre bar stays."""
    _, findings, estimate = findings_of("h4", "rods")
    (shifts,) = of(findings, "Of x, y and z of the base joints and of the side bars' joints")
    assert shifts.text.count("in eight ways") == 1
    assert not shifts.matters
    machine, poses = estimate.machine, estimate.state.T_base_platform
    by = pose_by_parameters(machine, machine.inverse(poses), poses)
    table, step = machine.parameters, 1e-6
    free = table.free_matrix()
    rng = np.random.default_rng(0)
    joints = machine.inverse(poses)
    before = machine.forward(joints, poses)
    for _ in range(3):
        change = free @ (table.tolerances_free() * rng.normal(size=free.shape[1])) * step
        after = machine.with_values(machine.values + change).forward(joints, before)
        shifted = pose_difference(after, before)
        np.testing.assert_allclose(shifted, by @ change, atol=2e-4 * np.abs(shifted).max())


def test_radii_are_no_business_of_boards():
    """A hexapod by its platform's poses: its tubes are not mentioned."""
    _, findings, _ = findings_of("gough-stewart")
    assert not [s for s in (*findings.unidentified, *findings.weak) if "tube" in s.text]


def test_weak_and_free_are_reported_together():
    """Poses' noise mixes the two; a sentence distinguishes them by the data's information."""
    _, findings, _ = findings_of("linear-delta")
    (lean,) = of(findings, "The tilts of the guides of legs 1 to 3 cannot be separated from their")
    assert lean.weak
    assert lean in findings.weak
    assert "better than the nominal model does" in lean.text
    assert not any(s.weak for s in findings.unidentified)


@pytest.mark.parametrize(
    "case", [("h4",), ("h4", "rods"), ("delta",), ("linear-delta",), ("delta", None, "straight")]
)
def test_no_sentence_speaks_of_tubes_or_images_of_legs(case):
    values, findings, _ = findings_of(*case)
    sentences = (*findings.unidentified, *findings.weak)
    text = " ".join(f"{s.text} {s.advice}" for s in sentences)
    for word in ("tube", "hotograph", "base.arm is", "caliper"):
        assert word not in text
    assert sum(s.dimensions for s in sentences) == len(values.unidentified) + len(values.weak)
    assert len({s.text for s in sentences}) == len(sentences)


def test_sizes_are_columns_of_the_machine():
    machine = load_mechanism("linear-delta")
    names = {
        size.label: size.columns
        for size in sizes(Situation(machine, np.ones((1, 3), bool), machine.home()[None]))
    }
    assert list(names) == ["base radius", "base height", "rod length", "reading scale"]
    centres = machine.values + 1e-3 * names["base radius"].sum(axis=1)
    shifted = np.linalg.norm(machine.with_values(centres).base_centers()[:, :2], axis=1)
    np.testing.assert_allclose(
        shifted - np.linalg.norm(machine.base_centers()[:, :2], axis=1), 1e-3, atol=1e-6
    )


def test_a_search_that_has_not_settled_is_refused():
    _, findings, estimate = findings_of("h4")
    nothing = Observation(
        EdgeSet.empty(), (), np.zeros((0, 2)), np.zeros(0, int), estimate.state.T_camera_base
    )
    assert assess(nothing, estimate, findings).usable
    statistics = replace(estimate.statistics, stopped=Stop.STEPS.value, steps=100)
    unsettled = replace(estimate, statistics=statistics)
    (reason,) = assess(nothing, unsettled, findings).reasons
    assert "had not settled after 100 steps" in reason


# ------------------------------------------------------------------- what is held, and why


def test_what_the_calibration_model_holds_is_convention():
    _, findings, estimate = findings_of("h4")
    assert set(findings.conventional) == set(estimate.machine.parameters.fixed)
    text = held_in_words(findings, estimate.machine.parameters)
    assert "are held by convention" in text
    assert "held by the model" not in text
    assert text.startswith("Crank axis distance of legs 1 to 4,")
    assert "hinge z of legs 1 to 4" in text
    assert "Of the heights of base joints and platform only the sum counts" in text


def test_ties_are_reported_once_with_their_signs():
    _, _, estimate = findings_of("h4")
    assert tied_in_words(estimate.machine.parameters) == (
        "Changes together, as one value: platform centre y of legs 1 to 4 (by opposite amounts); "
        "hinge x of legs 1 to 4 (by opposite amounts)."
    )


def test_pairs_that_a_finding_names_are_not_repeated():
    _, findings, estimate = findings_of("h4")
    pairs = {(i, j) for i, j, _ in tight_pairs(estimate)}
    names = estimate.machine.parameters.names
    turning = [(names[i], names[j]) for i, j in pairs if "axis" in names[i] and "axis" in names[j]]
    assert turning
    assert not [text for text in bound_together(estimate, findings) if text.count("base axis") > 1]


@pytest.mark.parametrize("name", ["h4", "linear-delta", "gough-stewart"])
def test_what_the_picture_of_correlations_states_fits_the_sentences_on_pairs(name):
    _, _, estimate = findings_of(name)
    table, text = estimate.machine.parameters, bound_together(estimate)
    part = correlation_plot.section(estimate)
    cells = next(mark for mark in part.blocks[0].marks if mark.mark == "cells")
    closest = float(re.search(r", ([+−]\d\.\d\d)\.", part.text[0])[1].replace("−", "-"))
    assert bool(text) == (abs(closest) > INSEPARABLE_CORRELATION)
    for i, j, rho in tight_pairs(estimate)[:1]:
        assert (
            f"{table.in_words(table.names[i])} and {table.in_words(table.names[j])}" in part.text[0]
        )
        assert closest == pytest.approx(rho, abs=0.005)
        assert table.in_words(table.names[j]) in text[0]
    # of a tie, one stands for all: another name of it would have a correlation of one
    again = {table.in_words(x) for group in table.tied for x in group[1:]}
    assert not again & set(cells.columns)


def test_a_sum_that_alone_is_known_is_named_though_its_parts_correlate_fully():
    _, _, estimate = findings_of("linear-delta")
    (i, j, rho), *_ = tight_pairs(estimate)
    names = estimate.machine.parameters.names
    assert (names[i], names[j]) == ("legs[2].base.center.y", "legs[2].platform.center.y")
    assert rho == pytest.approx(-1)
    assert "their sum is known far better than each alone" in bound_together(estimate)[0]


def test_the_design_models_assumptions_are_no_conventions():
    _, findings, estimate = findings_of("h4", "design")
    assert not any(".axis." in name for name in findings.conventional)
    assert findings.also_conventional > 0  # the heights' sum among them
    text = held_in_words(findings, estimate.machine.parameters)
    assert "held by the model that the mechanism file describes" in text
    assert "of which with a camera and a board only the sum is determined" in text


def test_a_held_arm_is_no_convention():
    machine = load_mechanism("delta")
    poses = upright(np.c_[np.random.default_rng(0).uniform(-0.03, 0.03, (12, 3)), np.zeros(12)])
    poses[:, 2, 3] -= 0.22
    table = machine.parameters
    held = {}
    for names in (("legs[1].base.arm",), ("legs[1].base.center.x",)):
        one = replace(machine, parameters=table.with_roles(names, ()))
        held[names[0]] = conventions_held(one, platform_by_parameters(one, poses))
    assert held["legs[1].base.arm"] == ((), 0)
    assert held["legs[1].base.center.x"] == (("legs[1].base.center.x",), 0)


def test_names_for_people():
    table: ParameterTable = load_mechanism("h4").parameters
    names = tuple(n for n in table.names if n.endswith(("angle", "hinge.y")))
    assert grouped(table, names) == ["crank angle of legs 1 to 4", "hinge y of legs 1 to 4"]
    assert table.in_words("legs[2].base.arm") == "leg 2 arm length"
    assert table.in_words("legs[2].length.constant") == "leg 2 rod length"
    assert grouped(table, ("legs[1].base.arm", "legs[2].base.arm")) == [
        "leg 1 arm length",
        "leg 2 arm length",
    ]
