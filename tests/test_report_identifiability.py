"""The report's section on identifiability: rank, sentences, counts, fixed parameters."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from page_documents import page_blocks, page_section, page_text
from pkmcal.identify.conditions import conditions
from pkmcal.identify.unidentified import explain, observed_legs
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome import Verdict
from pkmcal.report.identifiability import (
    STUB_INFORMATION,
    directions_headline,
    held_text,
    spectrum,
    tied,
)
from test_report_case import case_document, make_case, no_problem
from test_words import heaved, identified, make


def findings_of(scene, *views):
    values, in_view, _ = identified(scene, *views)
    machine = scene.machine.with_values(scene.theta[0])
    estimate = replace(
        make_estimate_stub(), machine=machine, state=scene.state(),
        configurations=np.ones(len(scene.poses[0]), bool),
    )  # fmt: skip
    return explain(values, estimate, in_view, conditions(machine, in_view))


def make_estimate_stub():
    from pkmcal.identify.estimate import Estimate, Statistics
    from pkmcal.identify.scatter import EdgeScatter

    none = np.zeros(0)
    statistics = Statistics(0, 0, 0, 0, 0, 0, 0, 0, 0, "", 1.0)
    empty = load_mechanism("gough-stewart")
    return Estimate(
        empty, make("gough-stewart", n=1).state(), none, none, none, none,
        EdgeScatter(none, none, none), none, none, none, none, statistics, "", no_problem(empty),
    )  # fmt: skip


@pytest.fixture(scope="module")
def apart():
    scene = make("gough-stewart", poses=heaved(load_mechanism("gough-stewart")))
    return findings_of(scene, [1, 2, 3], [4, 5, 6], [4, 5, 6])


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return make_case(tmp_path_factory.mktemp("session"))


def test_the_section_stands_on_the_page(case, apart):
    document = case_document(
        case.session, case.observation, case.estimate, Verdict(True, "Fine."), findings=apart
    )
    text = page_text(page_section(document, "identifiability"))
    assert "The data determine 34 of 42 directions (54 free values less 12 that only place" in text
    assert "No amount of such data would determine 8 directions" in text
    for sentence in (*apart.unidentified, *apart.weak):
        assert sentence.text in text
        assert sentence.advice in text
    assert "The rank above is the test." in text
    for condition in apart.conditions:
        assert condition.text in text
    (counts,) = page_blocks(document, "table", "identifiability")
    for row, condition in zip(counts["rows"], apart.conditions, strict=True):
        assert (row["mark"] == "good") == condition.met
    assert not re.search(r"\bnan\b", text)


def test_a_whole_session_has_nothing_to_list():
    findings = findings_of(make("gough-stewart"))
    table = load_mechanism("gough-stewart").parameters
    assert directions_headline(findings).startswith("The data determine 42 of 42 directions (")
    assert directions_headline(findings).endswith(
        "Each is determined better by the data than by the nominal model."
    )
    assert findings.unidentified == findings.weak == ()
    assert (held_text(findings, table), tied(table)) == ("", "")


def test_the_spectrum_shows_lost_directions_as_stubs(apart):
    drawn = spectrum(apart)
    assert drawn is not None
    bars = next(mark.points for mark in drawn.marks if mark.mark == "bars")
    assert len(bars) == 42
    assert [bar.y > STUB_INFORMATION for bar in bars] == [True] * 34 + [False] * 8
    assert bars[-1].tip == "Direction 42: the data do not determine it"
    assert bars[-1].colour is None
    assert bars[0].colour == "quiet"
    assert "times better than the nominal model" in bars[0].tip
    # the line where data and nominal model have equal information is the tick with 1
    (line,) = (mark for mark in drawn.marks if mark.mark == "rule")
    assert (line.at, "1") in [(tick.at, tick.label) for tick in drawn.y.ticks]


def test_what_was_held_is_stated_with_its_reason(apart):
    table = load_mechanism("gough-stewart").parameters.with_roles(
        ("legs[1].base.center", "legs[2].length.offset"),
        (("legs[3].length.offset", "legs[4].length.offset"),),
    )
    text = held_text(apart, table)
    assert text.startswith("Leg 1 base centre x, leg 1 base centre y, leg 1 base centre z and")
    assert "under fixed, so the nominal model's value counts as exact" in text
    assert (
        tied(table)
        == "Changes together, as one value: leg 3 length offset and leg 4 length offset."
    )


def test_seen_legs_leaves_out_what_was_rejected():
    edges = make("gough-stewart", n=1).measurements(np.random.default_rng(0)).edges
    weights = np.where(edges.leg == 2, 0.1, 1.0)
    assert observed_legs(edges, weights, 3, 7).tolist() == [[j not in (2, 6) for j in range(7)]] * 3
