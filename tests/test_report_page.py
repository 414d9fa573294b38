"""The report's page: its document, no requests to other places, and its scripts in browsers."""

import base64
import hashlib
import json
import pickle
import re
import subprocess
from dataclasses import replace
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from browsers import CHROMIUM, PageParts
from page_documents import page_blocks, page_document, page_section, page_text
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.tool import centres_and_tool, tool_error
from pkmcal.identify.verdict import VERDICT
from pkmcal.measurements import Rejection
from pkmcal.outcome import Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.finding import Finding, Level, doubtful, note, wrong
from pkmcal.report.calibration import DATA_QUESTION, TOOL_QUESTION, report_of
from pkmcal.web.report_page import (
    LONGEST_HEADLINE,
    report_document,
    report_page,
    verdict_lines,
)
from pkmcal.web.tables import leading_number, table_block
from pkmcal.wording import Chance
from test_report_case import Case, calibration, case_document, make_case, report_html

HOSTILE = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return make_case(tmp_path_factory.mktemp("session"))


@pytest.fixture(scope="module")
def page(case) -> str:
    verdict = Verdict(
        True,
        "Good to use.",
        (
            Finding("", Level.WRONG, saved_text="fits"),
            Finding("", Level.DOUBTFUL, saved_text="a little noisy"),
            Finding("", Level.NOTE, saved_text="more poses"),
        ),
    )
    return report_html(
        case.session, case.observation, case.estimate, verdict, timings={"observe": 1.5}
    )


# ------------------------------------------------------------------ the document


def test_page_has_verdict_numbers_and_model_error(page):
    document = page_document(page)
    assert document["verdict"]["headline"] == "Good to use."
    assert document["warnings"] == ["a little noisy"]
    assert document["advice"] == ["more poses"]
    text = page_text(document)
    for expected in ("0.90", "15 of 15", "multiplied by 1.25", "observe", "1.50 s",
                     "three centres: legs 1, 3, 5", "what these data show"):  # fmt: skip
        assert expected in text, expected


def test_page_has_date_and_sources(case):
    noted = replace(case.session, document={"notes": "Machine 2.\nLeg 4 <b>exchanged</b>."})
    fine = Verdict(True, "Fine.")
    value = report_of(calibration(noted, case.observation, case.estimate, fine), digest="3f2a")
    document = page_document(report_page(value, datetime(2026, 3, 4, 15, 2)))
    assert document["origin"] == [
        "4 March 2026, 15:02", f"pkmcal {version('pkmcal')}", "digest of the session 3f2a",
    ]  # fmt: skip
    assert document["notes"] == "Machine 2.\nLeg 4 <b>exchanged</b>."
    certificate = {one["name"]: one["value"] for one in document["certificate"]}
    assert certificate["Digest of the session"] == "3f2a"
    for station in case.session.stations:
        assert station.camera_file in certificate[f"Camera, station {station.name}"]


def test_comparison_is_of_the_same_poses(case):
    """Tolerances, nominal model and result: the tool's position, means over the poses in use."""
    value = report_of(calibration(*vars(case).values(), Verdict(True, "Fine.")))
    machine, estimate = case.session.machine, case.estimate
    tool = centres_and_tool(machine, estimate, case.session.joints)[1]
    root = machine.parameters.free_matrix() * machine.parameters.tolerances_free()
    prior = tool_error(
        machine, estimate.machine, free_of_gauge(machine, root @ root.T),
        estimate.state.T_base_platform[estimate.configurations],
        case.session.joints[estimate.configurations],
    )  # fmt: skip
    assert value.comparison is not None
    marked = {one.label: one.value for one in value.comparison.magnitudes}
    assert marked["Tolerances"] == pytest.approx(1e3 * prior.position.mean(), rel=1e-2)
    assert marked["Calibrated"] == pytest.approx(1e3 * tool.position.mean())
    if "Nominal model" in marked:
        assert marked["Nominal model"] == pytest.approx(1e3 * tool.off_position.mean())


def test_findings_without_effect_are_remarks(case):
    verdict = Verdict(
        True,
        "Fine.",
        (
            doubtful("edges.leg_seldom_seen", leg=2),
            doubtful("machine.undetermined", what="Open.", advice="Nothing.", matters=False),
            note("machine.undetermined_harmless", what="the size", matters=False),
            note("configurations.few", number=3),
        ),
    )
    document = case_document(*vars(case).values(), verdict)
    assert document["warnings"] == list(verdict.warnings[:1])
    assert document["advice"] == list(verdict.advice[1:])
    assert document["remarks"] == [verdict.findings[1].text, verdict.findings[2].text]


@pytest.mark.parametrize(
    ("finding", "question"),
    [
        (
            wrong("data.rejected_share", names=["edges"], share=0.5, limit=0.4),
            DATA_QUESTION,
        ),
        (doubtful("machine.undetermined", what="Open.", advice="More."), TOOL_QUESTION),
    ],
)
def test_cards_are_marked_by_the_verdict(case, finding, question):
    good = case_document(*vars(case).values(), Verdict(True, "Fine."))
    assert {card["mark"] for card in good["cards"] if card["limit"]} == {"good"}
    usable = finding.level is not Level.WRONG
    document = case_document(*vars(case).values(), Verdict(usable, "Not so fine.", (finding,)))
    cards = {card["question"]: card for card in document["cards"]}
    assert cards[question]["mark"] == finding.level
    assert cards[DATA_QUESTION]["limit"].endswith(f"{100 * VERDICT.too_many_rejected:.0f} %")


@pytest.mark.parametrize(
    ("usable", "options", "tone"),
    [
        (True, {}, "good"),
        (True, {"partial": True}, "partial"),
        (False, {"level": Level.DOUBTFUL}, "partial"),
        (False, {}, "bad"),
        (False, {"neutral": True}, "neutral"),
    ],
)
def test_the_tone_of_a_page_is_that_of_its_sign(usable, options, tone):
    outcome = Outcome("check", "Check", Verdict(usable, "Done."), **options)
    assert report_document(outcome).verdict.tone == tone


def test_sections_of_a_refused_result_are_void(case):
    refused = case_document(*vars(case).values(), Verdict(False, "No."))
    void = {section["name"] for section in refused["sections"] if section["void"]}
    assert {"geometry", "parameters"} <= void
    assert not void & {"residuals", "rejected", "how"}
    assert refused["verdict"]["tone"] == "bad"
    usable = case_document(*vars(case).values(), Verdict(True, "Yes."))
    assert not any(section["void"] for section in usable["sections"])


def test_sections_for_the_metrologist_are_last(page):
    sections = page_document(page)["sections"]
    expert = [section["expert"] for section in sections]
    assert expert == sorted(expert)
    assert {"identifiability", "how"} <= {s["name"] for s in sections if s["expert"]}


def test_parameters_are_sorted_and_filtered_by_their_numbers(page, case):
    (table,) = page_blocks(page_document(page), "table", "parameters")
    names = case.session.machine.parameters.names
    assert tuple(row["name"] for row in table["rows"]) == names
    columns = [column["name"] for column in table["columns"]]
    change, sigma, ratio = (columns.index(name) for name in ("Change", "σ", "Change/σ"))
    for row in table["rows"]:
        if row["values"][sigma] is None:
            assert row["values"][ratio] is None
            continue
        expected = row["values"][change] / row["values"][sigma]
        assert row["values"][ratio] == pytest.approx(expected)
        assert ("significant" in row["tags"]) == (abs(expected) > 3)
    hidden = {one["tag"] for one in table["filters"] if one["hides"]}
    held = [row["name"] for row in table["rows"] if hidden & set(row["tags"])]
    sigmas = np.sqrt(np.diag(case.estimate.covariance))
    assert held == [name for name, s in zip(names, sigmas, strict=True) if s == 0]
    leg = {one["label"]: one["tag"] for one in table["filters"]}["Leg 3"]
    of_leg = [row["name"] for row in table["rows"] if leg in row["tags"]]
    assert of_leg == [name for name in names if name.startswith("legs[3].")]


def test_downloads_hold_all_parameters(page, case):
    (block,) = page_blocks(page_document(page), "downloads", "parameters")
    contents = {file["name"]: file["content"] for file in block["files"]}
    records = json.loads(contents["parameters.json"])["parameters"]
    assert [one["value"] for one in records] == case.estimate.machine.values.tolist()
    assert len(contents["parameters.csv"].splitlines()) == 1 + len(records)


@pytest.mark.parametrize(
    ("sentences", "points"),
    [(("Short.",), 0), (("Short.", "Also short."), 0), (("Short.", "W" * 300 + ".", "End."), 2),
     (("W" * 300 + ".", "End."), 2)],
)  # fmt: skip
def test_a_verdict_has_two_lines(sentences, points):
    """What is longer stands below them; nothing is lost."""
    headline, explanation, listed = verdict_lines(" ".join(sentences), "Usable")
    assert max(len(headline), len(explanation)) <= LONGEST_HEADLINE
    assert len(listed) == points
    assert [one for one in (headline, explanation, *listed) if one and one != "Usable."] == list(
        sentences
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [("−0.3 ± 0.1", -0.3), ("1\N{NARROW NO-BREAK SPACE}712 edges", 1712), ("1e-09", 1e-9),
     ("1e999", None),
     ("+0.5 %", 0.5), ("–", None), ("leg 3", None), ("", None)],
)  # fmt: skip
def test_cells_are_sorted_by_their_number(text, value):
    assert leading_number(text) == value


@pytest.mark.parametrize(
    ("marks", "marked"),
    [(("good", "good"), 0), ((None, "good"), 1), (("good", "doubtful"), 2), (("wrong",) * 2, 2)],
)
def test_rows_that_are_all_good_have_no_marks(marks, marked):
    marks = [Level(mark) if mark in ("doubtful", "wrong") else mark for mark in marks]
    rows = tuple(Row(f"row {k}", ("1",), mark=mark) for k, mark in enumerate(marks))
    part = Part("part", "Part", tables=(Table("Table", ("", "mm"), rows),))
    outcome = Outcome(command="check", title="Check", verdict=Verdict(True, "Fine."), parts=(part,))
    (table,) = page_blocks(report_document(outcome).model_dump(mode="json"), "table")
    assert sum(row["mark"] is not None for row in table["rows"]) == marked


# ------------------------------------------------------------------ the page


def test_page_asks_for_nothing_outside(page):
    for tag, attributes in PageParts(page).tags:
        assert tag not in ("iframe", "object", "embed", "base")
        for name in ("src", "href", "xlink:href", "srcset", "action"):
            assert (attributes.get(name) or "#").startswith(("#", "data:,"))
    assert "default-src 'none'" in page
    assert "unsafe" not in re.search(r'Content-Security-Policy" content="([^"]+)"', page)[1]
    assert len(page) < 3e6


def test_hostile_names_stay_text(tmp_path):
    case = make_case(tmp_path, n_poses=2, n_stations=2, station=HOSTILE, prefix=HOSTILE)
    observation = replace(case.observation, rejected=(Rejection(0, 0, 0, 0, 0, HOSTILE),))
    hostile = Finding("", Level.DOUBTFUL, saved_text=HOSTILE)
    session = replace(case.session, folder=Path(HOSTILE), findings=(hostile,))
    verdict = Verdict(False, HOSTILE, tuple(Finding("", x, saved_text=HOSTILE) for x in Level))
    estimate = replace(case.estimate, gauge=HOSTILE)
    page = report_html(session, observation, estimate, verdict, timings={HOSTILE: 1.0})
    assert "<script>alert" not in page
    assert not [a for _, a in PageParts(page).tags if "onerror" in a]
    assert page_text(page_document(page)).count("<script>alert('x')") > 10


def test_a_page_without_a_single_edge(case):
    none = case.observation.edges.select(np.zeros(0, int))
    estimate = replace(
        case.estimate,
        edge_residuals=np.zeros((0, 2)),
        edge_weights=np.zeros(0),
        configurations=np.zeros(5, bool),
    )
    document = case_document(
        case.session,
        replace(case.observation, edges=none),
        estimate,
        Verdict(False, "Nothing seen."),
    )
    assert document["verdict"]["stamp"] == "Do not use"
    assert not re.search(r"\bnan\b", page_text(document))


# ------------------------------------------------------------------ in a browser

PROBE = """
const faults = [];
addEventListener("error", (event) => { if (event.message) faults.push(event.message); });
addEventListener("unhandledrejection", (event) => faults.push(String(event.reason)));
addEventListener("securitypolicyviolation", (event) => faults.push(`blocked ${event.blockedURI}`));
addEventListener("load", async () => {
  const out = document.documentElement.dataset;
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  await wait(500);
  ACT
  out.faults = faults.join("; ");
  out.overhang = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  out.paper = getComputedStyle(document.body).backgroundColor;
  out.done = "yes";
  parent.postMessage({ ...out }, "*");
});
"""
FRAME = """<!doctype html><html lang="en"><title>Frame</title>
<iframe src="page.html" width="WIDTH" height="860"></iframe>
<script>addEventListener("message", (event) => {
  Object.assign(document.documentElement.dataset, event.data);
});</script></html>"""
"""Browsers have no window as narrow as a phone."""
DARK = "--blink-settings=preferredColorScheme=0"


def browse_report(page: str, folder: Path, width: int, act: str, *options: str) -> dict[str, str]:
    """Data that a script in the page leaves on its root element; nothing fails, or is too wide."""
    if CHROMIUM is None:
        pytest.skip("NO CHROMIUM: the report was not opened in a browser (apt install chromium)")
    script = PROBE.replace("ACT", act)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = page.replace("script-src ", f"script-src 'sha256-{digest}' ", 1)
    page = page.replace('<div id="viewer">', f'<script>{script}</script><div id="viewer">', 1)
    (folder / "page.html").write_text(page, encoding="utf-8")
    (folder / "frame.html").write_text(FRAME.replace("WIDTH", str(width)), encoding="utf-8")
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader",
         "--disable-background-networking", "--no-first-run", "--enable-logging=stderr", "--v=0",
         f"--user-data-dir={folder / 'profile'}", "--window-size=1500,900",
         "--virtual-time-budget=60000", "--dump-dom", *options, (folder / "frame.html").as_uri()],
        capture_output=True, text=True, timeout=240, check=True,
    )  # fmt: skip
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not re.findall(r"ERROR:CONSOLE|Uncaught|Refused", "\n".join(console)), console
    root = PageParts(done.stdout).tags[0][1]
    data = {name.removeprefix("data-"): value or "" for name, value in root.items()}
    assert data.get("done") == "yes", data
    assert (data["faults"], data["overhang"]) == ("", "0")
    return data


ACTED = """
  const $ = (query) => document.querySelector(query);
  const rows = () => [...document.querySelectorAll("#parameters tbody tr")];
  const button = (text) => [...document.querySelectorAll("#parameters button")]
    .find((one) => one.textContent === text);
  const cells = (k) => rows().map((row) => row.cells[k].textContent);
  const plotted = () => $("#parameters .plot .area > svg").getAttribute("width");
  out.first = rows().length;
  out.screen = plotted();
  dispatchEvent(new Event("beforeprint"));
  out.printed = rows().length;
  out.sheet = plotted();
  out.sections = document.querySelectorAll("details:not([open])").length;
  dispatchEvent(new Event("afterprint"));
  out.restored = rows().length;
  out.again = plotted();
  button("Leg 3").click();
  out.legs = JSON.stringify([...new Set(cells(0))]);
  button("Leg 3").click();
  $("#parameters .more").click();
  button("Change").click();
  out.changes = JSON.stringify(cells(4));
  button("Nominal").click();
  out.nominal = JSON.stringify(cells(2));
  let copied = "";
  document.execCommand = () => { copied = document.activeElement.value; return true; };
  Object.defineProperty(navigator, "clipboard", { value: undefined });
  button("TSV").click();
  await wait(50);
  out.tsv = copied;
  button("YAML").click();
  await wait(50);
  out.yaml = copied;
  location.hash = "#how";
  await wait(300);
  out.opened = $("#how details").open && $("#how dl") !== null;
  rows()[0].dispatchEvent(new PointerEvent("pointerover", { bubbles: true }));
  out.selected = document.querySelectorAll("#parameters tr.hovered").length;
  const levels = ["good", "note", "doubtful", "wrong"];
  const frames = levels.flatMap((level) => ["sign", "limit"].map((name) => {
    const one = document.createElement("span");
    one.className = `${name} ${level}`;
    $(".card").append(one);
    const style = getComputedStyle(one);
    return `${style.padding} ${style.borderWidth}`;
  }));
  out.frames = [...new Set(frames)].join("; ");
"""


@pytest.mark.parametrize(("width", "dark"), [(1440, False), (390, True)])
def test_page_works_in_a_browser(page, tmp_path, width, dark):
    """The table is cut, filtered, sorted and copied; a link opens a section; a leg is selected."""
    root = browse_report(page, tmp_path, width, ACTED, *((DARK,) if dark else ()))
    (table,) = page_blocks(page_document(page), "table", "parameters")
    free = [row for row in table["rows"] if "held" not in row["tags"]]
    assert len(free) > 30
    assert [int(root[name]) for name in ("first", "printed", "restored")] == [12, len(free), 12]
    assert root["sections"] == "0"  # all are open on paper
    assert root["again"] == root["screen"] != root["sheet"]  # plots have the paper's width
    assert json.loads(root["legs"]) == ["3"]
    changes = [abs(leading_number(text)) for text in json.loads(root["changes"])]
    assert changes == sorted(changes, reverse=True)
    nominal = [leading_number(text) for text in json.loads(root["nominal"])]
    assert nominal == sorted(nominal, reverse=True)
    assert min(nominal) < 0 < max(nominal)
    lines = [line.split("\t") for line in root["tsv"].splitlines()]
    assert lines[0][0] == "Name"
    assert {line[0] for line in lines[1:]} == {row["name"] for row in free}
    assert root["yaml"].count("- ") == len(free)
    assert root["opened"] == "true"
    assert int(root["selected"]) > 1  # all rows of the leg
    assert root["frames"] == "0px 0px"  # signs and limits of all levels have none
    assert root["paper"] == ("rgb(20, 23, 27)" if dark else "rgb(244, 245, 247)")


def test_sections_lead_from_the_contents(page):
    document = page_document(page)
    assert page_section(document, "parameters")["menu"] == "Parameters"
    assert len({section["name"] for section in document["sections"]}) == len(document["sections"])


@pytest.mark.parametrize(
    ("probability", "text"),
    [
        (0.975, "98 %"),
        (0.12, "12 %"),
        (0.05, "1 in 20"),
        (1 / 254, "1 in 250"),
        (1 / 25_400, "1 in 25\N{NARROW NO-BREAK SPACE}000"),
        (3e-7, "< 1 in 10⁶"),
        (4e-8, "≪ 1 in 10⁶"),
        (0.0, "≪ 1 in 10⁶"),
        (float("nan"), "–"),
    ],
)
def test_a_probability_is_words_with_its_number(probability, text):
    chance = Chance(probability)
    assert chance == text
    copied = pickle.loads(pickle.dumps(chance))
    assert (copied, repr(copied.value)) == (text, repr(probability))
    rows = (Row("leg 1", (chance,)),)
    block = table_block(Table("", ("Test", "By chance"), rows, hints=("", "Of noise alone.")))
    assert block.columns[1].form == "chance"
    assert block.columns[1].hint == "Of noise alone."
    assert block.rows[0].values[1] == (None if np.isnan(probability) else probability)
