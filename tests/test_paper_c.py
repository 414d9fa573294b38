"""[C] IV computed again: its expectations, that each of them can fail, table and command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from conftest import run
from document_keys import assert_keys
from pkmcal.papers import paper_c as expected
from pkmcal.papers.paper_c import (
    BOUND,
    EQ3_AS_PRINTED,
    EQ5_AS_PRINTED,
    EQ5_WHITENED,
    IDENTIFIED_TABLE_2,
    JOINT,
    NOMINAL,
    ROTATION_AXIS_METHOD,
    Deviations,
    H4ByBoard,
    before,
    measured_volume_grid,
    model,
    table_2_of,
    table_2_values,
    table_of,
)
from pkmcal.papers.reproduction import Compared
from pkmcal.studies import engine
from pkmcal.studies.statistics import Summary
from pkmcal.studies.tasks import Sample

RUNS = 15


def study(runs, seed=2003, **setting):
    return engine.run(H4ByBoard(**setting), runs, seed)


@pytest.fixture(scope="module")
def short():
    return study(runs=RUNS)


@pytest.fixture(scope="module")
def reproduced(short):
    return table_of(short).outcome()


# ------------------------------------------------------------------ the simulation


def test_the_simulated_machines():
    truth = H4ByBoard().simulated("design", 2, np.random.default_rng(0))
    assert truth.T_base_platform.shape == (2, 81, 4, 4)
    assert len(np.unique(np.round(truth.T_base_platform[0, :, :3, 3], 6), axis=0)) == 27
    assert truth.count == 71
    machine = model("design")
    values = table_2_values(machine, IDENTIFIED_TABLE_2)
    there = table_2_of(machine, values)
    np.testing.assert_allclose(there[:4], IDENTIFIED_TABLE_2[:4])
    np.testing.assert_allclose(there[4:8], IDENTIFIED_TABLE_2.alpha)
    np.testing.assert_allclose(there[8:], IDENTIFIED_TABLE_2.q0)
    assert np.abs(measured_volume_grid()[:, :3, 3].mean(axis=0) - [0, 0, -0.45]).max() < 1e-12


def test_rods_alone_tilt_the_nacelle():
    """With equal rods the model with rods is a machine of four degrees of freedom."""
    tilt = []
    for rods in (0.0, 3e-4):
        setting = H4ByBoard(deviations=Deviations(rods=rods))
        study = setting.simulated("rods", 1, np.random.default_rng(0))
        tilt.append(np.abs(study.T_base_platform[0, :, 2, :2]).max())
    assert tilt[0] < 1e-9
    assert tilt[1] > 1e-4


# ------------------------------------------------------------------ what is expected


def test_checks_pass_and_each_can_fail(short):
    start = before()
    fine = expected.checks(short, start)
    assert [c.what for c in fine if not c.passed] == []

    def with_accuracy(key, **changes):
        own = short.of(*key)
        changed = {name: own[name]._replace(value=value) for name, value in changes.items()}
        return replace(short, accuracy={**short.accuracy, key: {**own, **changed}})

    def with_values(method, **changes):
        key = ("design", "design", method)
        own = Sample({**short.samples[key].values, **changes})
        return replace(short, samples={**short.samples, key: own})

    drawn = short.values("control_mean", "design", "design", NOMINAL)
    spoilt = [
        (short, start._replace(shift=0.02)),
        (with_values(NOMINAL, control_mean=0.9 * drawn), start),
        (with_values(EQ3_AS_PRINTED, square=np.full((RUNS, 4), 6e-4)), start),
        (with_values(EQ3_AS_PRINTED, rank=np.full(RUNS, 22)), start),
        (with_accuracy(("design", ROTATION_AXIS_METHOD), chi2=1.3), start),
        (with_accuracy(("design", "design", JOINT), larger_shift=2e-4), start),
        (with_accuracy(("calibration", "design", JOINT), chi2=1.1), start),
        (with_accuracy(("rods", "rods", JOINT), larger_shift=2e-4), start),
        (with_accuracy(("design", "calibration", EQ5_AS_PRINTED), larger_turn=7e-4), start),
    ]
    assert len(spoilt) == len(fine)
    for place, (study_, begin) in enumerate(spoilt):
        assert not expected.checks(study_, begin)[place].passed, fine[place].what


def test_every_figure_of_the_prototype_is_compared(short):
    figures = expected.prototype_figures(short)
    assert len(figures) == 2 * 10 + 3
    assert {f.key for f in figures if not f.held} == {
        ("calibration", "design", EQ3_AS_PRINTED), ("rods", "design", JOINT), ("rods",
        "calibration", JOINT),
    }  # fmt: skip
    key, allowed = ("design", "design", EQ3_AS_PRINTED), expected.TOLERANCE
    figure = Compared(key, "larger_shift", Summary(0.07, 0.001), 0.070, 0.0005, allowed)
    assert figure.tolerable
    assert not figure._replace(measured=Summary(0.09, 0.001)).tolerable


@pytest.mark.slow
def test_noise_twice_as_large_is_not_a_reproduction():
    quiet = H4ByBoard()
    loud = study(runs=4, turn=2 * quiet.turn, shift=2 * quiet.shift)
    failed = [c.what for c in expected.checks(loud, before()) if not c.passed]
    assert "figures of the independent prototype" in failed


def test_better_methods_are_better(short):
    """As printed, whitened, joint: and the last is not better than the bound."""
    for kind, printed in (("design", EQ3_AS_PRINTED), ("calibration", EQ5_AS_PRINTED)):
        a = {
            m: short.of(kind, kind, m)["shift"].value for m in (printed, EQ5_WHITENED, JOINT, BOUND)
        }
        assert a[JOINT] < a[printed]
        assert a[EQ5_WHITENED] == pytest.approx(a[JOINT], rel=0.02)
    assert short.of("calibration", "calibration", EQ5_AS_PRINTED)["shift"].value < (
        0.5 * short.of("calibration", "design", EQ3_AS_PRINTED)["shift"].value
    )


def test_another_seed_draws_anew():
    """Draws differ in every batch of every truth, and nothing else is random."""
    setting = H4ByBoard()
    for first, again, other in zip(
        *(engine.batches(setting, 2, s) for s in (1, 1, 2)), strict=True
    ):
        in_view = [setting.draw(batch).T_camera_board for batch in (first, again, other)]
        np.testing.assert_array_equal(in_view[0], in_view[1])
        assert not np.isclose(in_view[0], in_view[2]).all(axis=(-1, -2)).any()
        key = first.generator(1).random(), again.generator(1).random(), other.generator(1).random()
        assert key[0] == key[1] != key[2]


# ------------------------------------------------------------------ terminal, JSON and Markdown


def test_the_command(tmp_path, monkeypatch, reproduced):
    monkeypatch.setattr("pkmcal.api.reproduce.reproduce_paper", lambda _paper, _options: reproduced)
    done = run("reproduce", "c", "-o", tmp_path, "--json")
    assert (done.code, done.err) == (0, "")
    c = done.json["papers"]["c"]
    assert c == json.loads((tmp_path / "paper-c.json").read_text())
    assert_keys("paper-c.json", c)
    assert c["before"]["shift"] == pytest.approx(0.0259, abs=2e-4)
    assert len(c["validation"][f"design, {EQ3_AS_PRINTED}"]["control_rms"]) == 4
    done = run("reproduce", "c", "-o", tmp_path)
    assert max(map(len, done.out.replace(str(tmp_path), "").splitlines())) <= 80
    assert "…" not in done.out
    text = " ".join(done.out.split())
    for words in ("Table 2", "Table 3", "Table 4", "26", "Not reproduced", "paper-c.md"):
        assert words in text, words


def test_the_table_has_the_papers_figures(reproduced):
    assert len(reproduced.verdict.headline) <= 120
    rows = {row["claim"]: row for row in reproduced.document["table"]}
    identified = rows["Table 2: h, arm, R, forearm, eq. 3"]
    assert identified["paper"] == "0.0610, 0.2600, 0.1413, 0.4876 m"
    there, here = (
        np.array([float(x) for x in identified[name].removesuffix(" m").split(", ")])
        for name in ("paper", "here")
    )
    np.testing.assert_allclose(here, there, atol=2e-3)
    assert sum("straightness" in claim for claim in rows) == 3
    assert sum("residuals of the motors, " in claim for claim in rows) == 6
