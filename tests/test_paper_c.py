"""[C] IV computed again: what is expected, that each expectation can fail, page and command."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from conftest import run
from pkmcal.report.reproduction import reproduction_html
from pkmcal.reproduce import Options, reproduce
from pkmcal.reproduce import paper_c_expected as expected
from pkmcal.reproduce.paper_c_simulation import (
    IDENTIFIED,
    Settings,
    grid,
    model,
    simulate,
    table_2_values,
)
from pkmcal.reproduce.paper_c_study import BOUND, DRAWING, EQ3, EQ5, JOINT, WHITENED, study
from pkmcal.reproduce.paper_c_validation import before, table_2_of
from test_report_page import Found, browse

RUNS = 15


@pytest.fixture(scope="module")
def short():
    return study(runs=RUNS)


@pytest.fixture(scope="module")
def found(short):
    from pkmcal.reproduce import paper_c

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_c, "study", lambda *_args, **_options: short)
        yield reproduce("c", Options(runs=RUNS))


@pytest.fixture(scope="module")
def page(found):
    return reproduction_html(found)


def checks_of(s):
    return expected.checks(s, before(model("design"), s.truth))


# ------------------------------------------------------------------ the simulation


def test_the_simulated_machines():
    truth = simulate("design", Settings(), 2, np.random.default_rng(0))
    assert truth.poses.shape == (2, 81, 4, 4)
    assert len(np.unique(np.round(truth.poses[0, :, :3, 3], 6), axis=0)) == 27
    assert truth.n_calibration == 71
    machine = model("design")
    values = table_2_values(machine, IDENTIFIED)
    there = table_2_of(machine, values)
    np.testing.assert_allclose(there[:4], IDENTIFIED[:4])
    np.testing.assert_allclose(there[4:8], IDENTIFIED.alpha)
    np.testing.assert_allclose(there[8:], IDENTIFIED.q0)
    assert np.abs(grid()[:, :3, 3].mean(axis=0) - [0, 0, -0.45]).max() < 1e-12


def test_rods_alone_tilt_the_nacelle():
    """With rods alike the model with rods is a machine of four freedoms."""
    even = simulate("rods", Settings(rods=0.0), 1, np.random.default_rng(0))
    apart = simulate("rods", Settings(rods=3e-4), 1, np.random.default_rng(0))
    tilt = [np.abs(t.poses[0, :, 2, :2]).max() for t in (even, apart)]
    assert tilt[0] < 1e-9
    assert tilt[1] > 1e-4


# ------------------------------------------------------------------ what is expected


def test_checks_pass_and_each_can_fail(short):
    start = before(model("design"), short.truth)
    fine = expected.checks(short, start)
    assert [c.what for c in fine if not c.passed] == []

    def with_accuracy(key, **changes):
        return replace(
            short, accuracy={**short.accuracy, key: short.accuracy[key]._replace(**changes)}
        )

    def with_validation(name, **changes):
        own = short.validation[name]._replace(**changes)
        return replace(short, validation={**short.validation, name: own})

    drawn = short.validation[f"design, {DRAWING}"]
    spoilt = [
        (short, start._replace(shift=0.02)),
        (with_validation(f"design, {DRAWING}", control_mean=0.9 * drawn.control_mean), start),
        (with_validation(f"design, {EQ3}", square=np.full((RUNS, 4), 6e-4)), start),
        (replace(short, ranks={**short.ranks, ("design", EQ3): (22, 20)}), start),
        (replace(short, axis=short.axis._replace(chi2=1.3 * short.axis.chi2)), start),
        (with_accuracy(("design", "design", JOINT), larger_shift=2e-4), start),
        (with_accuracy(("calibration", "design", JOINT), chi2=1.1), start),
        (with_accuracy(("rods", "rods", JOINT), larger_shift=2e-4), start),
        (with_accuracy(("design", "calibration", EQ5), larger_turn=7e-4), start),
    ]
    assert len(spoilt) == len(fine)
    for place, (study_, begin) in enumerate(spoilt):
        assert not expected.checks(study_, begin)[place].passed, fine[place].what


def test_every_figure_of_the_prototype_is_compared(short):
    figures = expected.compared(short)
    assert len(figures) == 2 * 10 + 3
    assert {f.key for f in figures if not f.held} == {
        ("calibration", "design", EQ3), ("rods", "design", JOINT), ("rods", "calibration", JOINT),
    }  # fmt: skip
    figure = expected.Compared(("design", "design", EQ3), "shift", 0.07, 0.001, 0.070)
    assert figure.tolerable
    assert not figure._replace(found=0.09).tolerable


def test_noise_twice_as_large_is_not_a_reproduction():
    noise = Settings(turn=2 * Settings().turn, shift=2 * Settings().shift)
    failed = [c.what for c in checks_of(study(runs=6, settings=noise)) if not c.passed]
    assert "figures of the independent prototype" in failed


def test_better_methods_are_better(short):
    """As printed, whitened, joint: and the last is not better than the bound says."""
    for kind, printed in (("design", EQ3), ("calibration", EQ5)):
        a = {m: short.accuracy[kind, kind, m] for m in (printed, WHITENED, JOINT, BOUND)}
        assert a[JOINT].shift < a[printed].shift
        assert a[WHITENED].shift == pytest.approx(a[JOINT].shift, rel=0.02)
    assert short.accuracy["calibration", "calibration", EQ5].shift < (
        0.5 * short.accuracy["calibration", "design", EQ3].shift
    )


def test_another_seed_draws_anew():
    first, again, other = (study(runs=2, seed=seed).accuracy for seed in (1, 1, 2))
    key = ("design", "design", JOINT)
    assert first[key] == again[key]
    assert first[key] != other[key]


# ------------------------------------------------------------------ terminal, JSON and page


def test_the_command(tmp_path, monkeypatch, found):
    monkeypatch.setattr("pkmcal.reproduce.reproduce", lambda _paper, _options: found)
    done = run("reproduce", "c", "-o", tmp_path, "--json")
    assert (done.code, done.err) == (0, "")
    c = done.json["papers"]["c"]
    assert c == json.loads((tmp_path / "paper-c.json").read_text())
    assert c["before"]["shift"] == pytest.approx(0.0259, abs=2e-4)
    assert len(c["validation"][f"design, {EQ3}"]["control_rms"]) == 4
    done = run("reproduce", "c", "-o", tmp_path)
    assert max(map(len, done.out.replace(str(tmp_path), "").splitlines())) <= 80
    assert "…" not in done.out
    text = " ".join(done.out.split())
    for said in ("Table 2", "Table 3", "Table 4", "26", "Not reproduced", "paper-c.html"):
        assert said in text, said


def test_tables_are_whole(found):
    for part in found.parts:
        for table in part.tables:
            assert all(len(row.cells) + 1 == len(table.columns) for row in table.rows), table.title


def test_the_page_asks_for_nothing_outside(page):
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", page)
    assert "nan" not in re.sub(r'<script type="text/plain".*?</script>', "", page, flags=re.S)


@pytest.mark.parametrize("width", [1280, 390])
def test_the_page_runs_in_a_browser(page, tmp_path, width):
    document, console = browse(page, tmp_path, width)
    root = Found(document).tags[0][1]
    assert root["data-errors"] == ""
    assert root["data-overhang"] == "0"
    assert not re.search(r"ERROR:CONSOLE|Uncaught|Refused", console), console
