"""The report's page: its text, no requests to other places, and its scripts in browsers."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from datetime import datetime
from html.parser import HTMLParser
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from pkmcal.measurements import Rejection
from pkmcal.outcome import Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.finding import Finding, Level
from pkmcal.pages.page import page_html
from pkmcal.report.calibration import report_of
from test_report_case import Case, calibration, make_case, report_html

HOSTILE = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>"
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


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


class PageParts(HTMLParser):
    """Tags, attributes and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self._texts: list[str] = []
        self.feed(text)
        self.text = "".join(self._texts)

    def updatepos(self, i, j):
        """Line numbers are not needed; counting lines in megabytes takes longer than all else."""
        return j

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self._texts.append(data)


# ------------------------------------------------------------------ the page


def test_page_has_verdict_numbers_and_model_error(page):
    text = PageParts(page).text
    for expected in ("Good to use.", "a little noisy", "more poses", "0.90", "15 of 15",
                     "multiplied by 1.25", "observe", "1.50 s", "three centres: legs 1, 3, 5",
                     "what these data show"):  # fmt: skip
        assert expected in text, expected


def test_page_has_date_and_sources(case):
    noted = replace(case.session, document={"notes": "Machine 2.\nLeg 4 <b>exchanged</b>."})
    fine = Verdict(True, "Fine.")
    value = report_of(calibration(noted, case.observation, case.estimate, fine), digest="3f2a")
    html = page_html(value, datetime(2026, 3, 4, 15, 2))
    text = PageParts(html).text
    assert "4 March 2026, 15:02" in text
    assert f"pkmcal {version('pkmcal')}" in text
    assert "digest of the session 3f2a" in text
    assert "Leg 4 <b>exchanged</b>." in text
    assert "<h3>Notes</h3>" in html
    assert "<h3>Notes</h3>" not in report_html(case.session, case.observation, case.estimate, fine)


def test_page_asks_for_nothing_outside(page):
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\((?!#)", page)
    for tag, attributes in PageParts(page).tags:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        for name in ("src", "href", "xlink:href", "srcset", "action"):
            inside = "data:" if "download" in attributes else "data:image/jpeg;base64,"
            assert (attributes.get(name) or "#").startswith(("#", inside))
    assert "default-src 'none'" in page
    assert len(page) < 5e6


def test_hostile_names_stay_text(tmp_path):
    case = make_case(tmp_path, n_poses=2, n_stations=2, station=HOSTILE, prefix=HOSTILE)
    observation = replace(case.observation, rejected=(Rejection(0, 0, 0, 0, 0, HOSTILE),))
    hostile = Finding("", Level.DOUBTFUL, saved_text=HOSTILE)
    session = replace(case.session, folder=Path(HOSTILE), findings=(hostile,))
    verdict = Verdict(False, HOSTILE, tuple(Finding("", x, saved_text=HOSTILE) for x in Level))
    estimate = replace(case.estimate, gauge=HOSTILE)
    page = report_html(session, observation, estimate, verdict, timings={HOSTILE: 1.0})
    value = PageParts(page)
    assert "<script>alert" not in page
    assert not [a for tag, a in value.tags if "onerror" in a or tag == "img"]
    assert sum(tag == "script" for tag, _ in value.tags) == 6
    assert value.text.count("<script>alert('x')") > 10


@pytest.mark.parametrize(
    ("marks", "bold"),
    [(("good", "good"), 0), ((None, "good"), 1), (("good", "doubtful"), 1), (("wrong",) * 2, 0)],
)
def test_a_row_stands_out_where_others_do_not(marks, bold):
    marks = [Level(mark) if mark in ("doubtful", "wrong") else mark for mark in marks]
    rows = tuple(Row(f"row {k}", ("1",), mark=mark) for k, mark in enumerate(marks))
    part = Part("part", "Part", tables=(Table("Table", ("", "mm"), rows),))
    outcome = Outcome(command="check", title="Check", verdict=Verdict(True, "Fine."), parts=(part,))
    assert page_html(outcome).count(' marked"') == bold


def test_a_page_without_a_single_edge(case):
    none = case.observation.edges.select(np.zeros(0, int))
    estimate = replace(
        case.estimate,
        edge_residuals=np.zeros((0, 2)),
        edge_weights=np.zeros(0),
        configurations=np.zeros(5, bool),
    )
    page = report_html(
        case.session,
        replace(case.observation, edges=none),
        estimate,
        Verdict(False, "Nothing seen."),
    )
    assert "Do not use" in page
    assert "nothing in use" in page
    assert "nan" not in re.sub(r'<script type="text/plain".*?</script>', "", page, flags=re.S)


def test_an_image_that_is_gone_is_stated(tmp_path):
    case = make_case(tmp_path, n_poses=4, n_stations=2)
    next(tmp_path.glob("*.png")).unlink()
    page = report_html(case.session, case.observation, case.estimate, Verdict(True, "Fine."))
    assert "the file could not be read" in page


# ------------------------------------------------------------------ in a browser

PROBE = """<script>
const seen = [];
addEventListener("error", (event) => seen.push(event.message));
addEventListener("unhandledrejection", (event) => seen.push(String(event.reason)));
addEventListener("securitypolicyviolation", (event) => seen.push("blocked " + event.blockedURI));
setInterval(() => {
  const root = document.documentElement;
  root.dataset.errors = seen.join("; ");
  root.dataset.overhang = root.scrollWidth - root.clientWidth;
}, 50);
</script>"""


def browse(page: str, folder: Path, width: int) -> tuple[str, str]:
    """The page's document after its scripts ran, and the console's output."""
    if CHROMIUM is None:
        message = "NO CHROMIUM: the report was not opened in a browser (apt install chromium)"
        pytest.skip(message)
    file = folder / "page.html"
    file.write_text(page.replace("<style>", PROBE + "<style>", 1), encoding="utf-8")
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
         "--no-first-run", f"--user-data-dir={folder / 'profile'}", "--enable-logging=stderr",
         "--v=0", f"--window-size={width},900", "--virtual-time-budget=20000", "--dump-dom",
         file.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


OPENED = """
  document.querySelector('th[data-sort="2"] button').click();
  document.querySelector(".enlarge").click();"""
LED = """
  const tell = document.documentElement.dataset;
  const plot = document.getElementById("plot-photographed");
  const width = () => plot.querySelector(".main-svg").getAttribute("width");
  const wait = setInterval(() => {
    if (plot.dataset.drawn !== "yes") return;
    clearInterval(wait);
    document.querySelector("#residuals a").dispatchEvent(new MouseEvent("click"));
    tell.bar = location.hash;
    plot.emit("plotly_click", { points: [{ customdata: "#image-1-2" }] });
    tell.point = location.hash;
    tell.screen = width();
    dispatchEvent(new Event("beforeprint"));
    tell.paper = width();
    tell.low = plot.querySelector(".main-svg").getAttribute("height")
      / parseFloat(plot.style.getPropertyValue("--tall"));
    tell.light = getComputedStyle(document.documentElement).getPropertyValue("--ink");
    dispatchEvent(new Event("afterprint"));
    setInterval(() => {
      tell.again = width();
      tell.printed = [...document.querySelectorAll(".in-space img.printed")]
        .map((image) => image.naturalWidth).join();
    }, 100);
  }, 50);"""


def fine(document: str, console: str) -> dict[str, str | None]:
    """The page's log; nothing failed and nothing exceeds its width."""
    root = PageParts(document).tags[0][1]
    assert root["data-errors"] == ""
    assert root["data-overhang"] == "0"
    assert not re.search(r"ERROR:CONSOLE|Uncaught|Refused", console), console
    return root


def loaded(page: str, *acts: str) -> str:
    """The page with a script that runs as soon as it is loaded."""
    did = "\n".join(f'addEventListener("load", () => {{{act}\n}});' for act in acts)
    return page.replace("</body>", f"<script>{did}</script></body>")


def test_page_runs_in_a_browser(page, tmp_path):
    """On a phone: plots have their size, the table sorts, an image opens; a bar's link and a plot's
    point lead to their image; on paper, plots are as wide as it, and light.
    """
    document, console = browse(loaded(page, OPENED, LED), tmp_path, 390)
    root = fine(document, console)
    tags = PageParts(document).tags
    assert any(a.get("id") == "plot-space" and a.get("data-drawn") == "yes" for _, a in tags)
    assert any(tag == "canvas" for tag, _ in tags)
    changes = [abs(float(v.split()[2])) for v in re.findall(r'data-values="([^"]+)"', document)]
    assert len(changes) == 60
    assert changes == sorted(changes, reverse=True)
    assert sum(a.get("class") == "shot" for tag, a in tags if tag == "svg") == 15 + 1
    dialog = document[document.index('<dialog id="large"') :]
    assert dialog[: dialog.index(">")].endswith('open=""')
    display = dialog[: dialog.index("</dialog>")]
    assert display.count("<svg") == 1
    large = re.search(r'data-large="([^"]+)"', page)
    assert large is not None
    assert f"base64,{large[1]}" in display
    assert str(root["data-bar"]).startswith("#image-")
    assert root["data-point"] == "#image-1-2"
    assert root["data-paper"] == "672"
    assert float(str(root["data-low"])) == pytest.approx(0.78)  # as the style has it on paper
    assert root["data-screen"] == root["data-again"] != "672"
    assert root["data-light"] == "#1a1e24"
    # plots in space have an image for paper, at twice the resolution of a screen
    assert root["data-printed"] == ",".join(["1344"] * page.count('class="panel in-space"'))


INSPECTED = """
  const tell = document.documentElement.dataset;
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  const buttons = document.querySelectorAll(".enlarge");
  const $ = (query) => document.querySelector(query);
  const caption = () => $(".large-caption").textContent;
  const picture = () => $(".inspected svg");
  const box = () => picture().getAttribute("viewBox").split(" ").map(Number);
  const key = (name) => picture().dispatchEvent(
    new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true }));
  (async () => {
    buttons[0].click();
    await wait(200);
    tell.first = caption();
    tell.whole = JSON.stringify(box());
    const host = $(".inspected").getBoundingClientRect();
    const part = (from, size, share) => Math.round(from + share * size);  // a wheel's are whole
    const at = {
      clientX: part(host.left, host.width, 0.7), clientY: part(host.top, host.height, 0.4),
    };
    const under = () => {  // pixel of the image under the pointer
      const point = new DOMPoint(at.clientX, at.clientY);
      const { x, y } = point.matrixTransform(picture().getScreenCTM().inverse());
      return [x, y];
    };
    const before = under();
    const turn = { deltaY: -900, cancelable: true, bubbles: true, ...at };
    $(".inspected").dispatchEvent(new WheelEvent("wheel", turn));
    tell.under = JSON.stringify([before, under()]);
    tell.near = JSON.stringify(box());
    for (let k = 0; k < 9; k += 1) $(".inspected").dispatchEvent(new WheelEvent("wheel", turn));
    tell.pixel = host.width / box()[2];
    tell.sharp = getComputedStyle(picture().querySelector("image")).imageRendering;
    const hidden = (query) => getComputedStyle(picture().querySelector(query)).display === "none";
    key("e");
    tell.edges = hidden(".edge");
    key("n");
    tell.crosses = [hidden(".cross"), hidden(".ring")].join();
    const gamma = $(".inspector-gamma input");
    gamma.value = 0.45;
    gamma.dispatchEvent(new Event("input"));
    tell.gamma = picture().querySelector("feFuncG").getAttribute("exponent");
    key("ArrowRight");
    tell.second = caption();
    const exponent = () => picture().querySelector("feFuncG").getAttribute("exponent");
    tell.again = [hidden(".edge"), exponent()].join();
    tell.fitted = JSON.stringify(box());
    key("ArrowLeft"); key("ArrowLeft");
    tell.last = caption();
    tell.captions = JSON.stringify([...buttons].map((one) =>
      one.parentNode.querySelector("figcaption").innerText.replace("\\n", " · ")));
  })();"""


def test_enlarged_images_are_inspected(page, tmp_path):
    """The wheel zooms about the pointer down to single pixels; keys switch layers and images."""
    document, console = browse(loaded(page, INSPECTED), tmp_path, 1280)
    root = {name: str(value) for name, value in fine(document, console).items()}
    captions = json.loads(root["data-captions"])
    shown = [root[f"data-{name}"] for name in ("first", "second", "last")]
    assert shown == [captions[0], captions[1], captions[-1]]
    before, after = json.loads(root["data-under"])
    np.testing.assert_allclose(after, before, atol=0.05)
    whole, near, fitted = (json.loads(root[f"data-{n}"]) for n in ("whole", "near", "fitted"))
    assert near[2] == pytest.approx(whole[2] * np.exp(-1.8), rel=1e-3)
    assert fitted == pytest.approx(whole)
    assert float(root["data-pixel"]) == pytest.approx(80, rel=1e-3)
    assert root["data-sharp"] == "pixelated"
    assert root["data-edges"] == "true"
    assert root["data-crosses"] == "true,false"
    assert root["data-gamma"] == "0.45"
    assert root["data-again"] == "true,0.45"


@pytest.mark.slow
def test_the_browser_test_sees_errors(page, tmp_path):
    """And a page whose script fails has its text and its tables, on a wide screen as well."""
    broken = page.replace('"use strict";', 'fetch("https://example.org/x"); missing();', 1)
    document, console = browse(broken, tmp_path, 1280)
    root = PageParts(document).tags[0][1]
    assert root["data-overhang"] == "0"
    assert "missing is not defined" in root["data-errors"]
    assert "blocked https://example.org" in root["data-errors"]
    assert "missing is not defined" in console
