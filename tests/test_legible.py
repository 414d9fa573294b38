"""Names with control characters: spelt out in output and files."""

import json
import re
import unicodedata
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from conftest import run
from export_sources import built, calibration, source_of
from fuzz import bases
from hangprinters import CONFIG, machine_of
from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.errors import InputError, legible
from pkmcal.exporters.contract import exporters
from pkmcal.files import json_text, read_json, read_yaml
from pkmcal.firmware.contract import Firmware
from pkmcal.mechanisms import machine_from_document
from pkmcal.outcome import Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.finding import Finding, Level
from pkmcal.web.report_page import report_page

HOSTILE = "a\x1b[31m\x9b2J\u202eb\u200bc\u2066\x07\x85\u2028\r\nM502\n*/ --> ]]> {{ x }} \\"
INVISIBLE = {"Cc", "Cf", "Cs", "Zl", "Zp"}
COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def invisible(text, keep="\n"):
    return {c for c in text if unicodedata.category(c) in INVISIBLE and c not in keep}


@given(st.text(st.characters(exclude_categories=())))
def test_legible_text_shows_as_it_is(text):
    spelt = legible(text)
    assert not invisible(spelt, keep="")
    assert legible(spelt) == spelt
    assert not invisible(legible(text, keep="\n"))
    if not invisible(text, keep=""):
        assert spelt == text


@given(st.dictionaries(st.text(), st.text(st.characters(exclude_categories=()))))
def test_json_is_legible_and_the_same(tmp_path_factory, texts):
    written = json_text(texts)
    assert not invisible(written)
    halves = any(unicodedata.category(c) == "Cs" for c in "".join(texts.values()))
    if not halves:
        assert json.loads(written) == texts
    assert json.loads(written.encode()) == json.loads(written)


def test_a_terminal_gets_rich_colours_and_no_others(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    with redirect_stdout(StringIO()) as heard:
        out = terminal.out()
        terminal.print_points(out, [(terminal.MARK_SIGNS["wrong"], HOSTILE)])
        terminal.print_files(out, [(HOSTILE, "a file")])
        row = Row(HOSTILE, (HOSTILE,), mark="good")
        terminal.print_table(out, Table(HOSTILE, (HOSTILE, HOSTILE), (row,), legend=HOSTILE))
        out.print(HOSTILE, markup=False)
        out.print(terminal.escaped(HOSTILE))
    text = heard.getvalue()
    assert COLOURS.search(text)
    assert "\x1b[31m\x9b" not in text
    assert not invisible(COLOURS.sub("", text))


def test_progress_is_legible_and_takes_no_markup(monkeypatch, capsys):
    for value in ("1", ""):
        monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.001)
        monkeypatch.setenv("FORCE_COLOR", value)
        monkeypatch.setenv("TTY_COMPATIBLE", value)
        with console.progress() as progress:
            progress.report(f"Measuring {HOSTILE}[/]", 0.5)
    spoken = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
    assert not invisible(spoken, keep="\n\r")


def test_pages_are_legible():
    table = Table(HOSTILE, (HOSTILE, HOSTILE), (Row(HOSTILE, (HOSTILE,)),))
    verdict = Verdict(False, HOSTILE, tuple(Finding("", x, saved_text=HOSTILE) for x in Level))
    parts = (Part("a", HOSTILE, (HOSTILE,), (HOSTILE,), tables=(table,), notes=(HOSTILE,)),)
    page = report_page(Outcome("check", HOSTILE, verdict, HOSTILE, HOSTILE, parts=parts))
    own = invisible(report_page(Outcome("check", "a", Verdict(True, "b"))), keep="\n\t")
    assert invisible(page, keep="\n\t") <= own
    assert legible("\u202e") in page


def named(machine, name):
    """The machine with a name, and with motor steps, which Repetier-Firmware needs."""
    entries = {"name": name, "steps_per_mm": machine.n_legs * (80.0,)}
    return machine_from_document(machine.document.model_copy(update=entries))


@pytest.mark.parametrize("name", sorted(exporters()))
def test_no_name_becomes_a_line_of_an_export(name, tmp_path):
    """All that differs from the export of a plain name are comments and names."""
    if name == "hangprinter":  # none is in the catalogue
        machine = machine_of(CONFIG, tmp_path)
    else:
        is_firmware = isinstance(exporters()[name], Firmware)
        machine = built("linear-delta" if is_firmware else "gough-stewart")
    plain, odd = (
        exporters()[name].files(
            source_of(
                named(machine, text), origin=text, headline=text, session=text, frames=text,
                calibrated=True, T_base_camera={text: np.eye(4)},
                sigma_camera={text: np.full(6, 1e-3)},
            )
        )
        for text in ("plain", HOSTILE)
    )  # fmt: skip
    assert len(plain) == len(odd)
    for before, (file, text) in zip(plain.values(), odd.items(), strict=True):
        assert not invisible(file, keep="")
        assert not invisible(text)
        assert not re.search(r"^\s*M502", text, re.MULTILINE)
        assert code_of(file, text) == code_of(file, before)


def code_of(file, text):
    """Content of a file as a program reads it, without the machine's name."""
    kind = file.rpartition(".")[2]
    if kind in ("c", "h"):
        text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        return re.sub(r'(MACHINE|TESTED) ".*"', r"\1", text)
    if kind in ("xml", "urdf", "sdf", "config"):
        return [element.tag for element in ElementTree.fromstring(text).iter()]
    if kind in ("yaml", "yml"):
        return len(str(yaml.safe_load(text)).split()) > 0 and sorted(map(str, yaml.safe_load(text)))
    if kind == "json":
        return sorted(json.loads(text))
    return [line for line in text.splitlines() if line[:1] not in ("#", ";")]


FOLDERS = ("a\x1b[31mb", "a\nname: b", "a\u202eb", "a\udcffb", "a\udcff\x1b\nname: b\u202e")


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(x, marks=pytest.mark.slow) for x in FOLDERS[:-1]), FOLDERS[-1]],
    ids=ascii,
)
def test_a_session_in_a_folder_of_any_name(tmp_path, quick_plans, name):
    folder = tmp_path / name
    try:
        bases.measured(folder, seed=1, count=14)
    except OSError:
        pytest.skip("this file system has no such names")
    result = folder / "calibration"
    texts = []
    for words in (
        ("calibrate", folder), ("calibrate", folder), ("check", folder, "-o", folder / "check"),
        ("diff", folder / "mechanism.yaml", result), ("export", result, "--to", "c"),
        ("validate", result, folder), ("plan", folder, "-n", 3),
        ("check", folder / "no-such"), ("export", result, "--to", "json", "--json"),
    ):  # fmt: skip
        done = run(*words)
        refused = words[0] == "validate" or words[1].name == "no-such"
        assert done.code in ((2,) if refused else (0, 1)), (words, done)
        texts += [done.out, done.err]
        if "--json" in words:
            assert done.json["exit_code"] == done.code
    assert not invisible("".join(texts))
    assert read_yaml(result / "mechanism.yaml").data["name"] == "gough-stewart"
    assert read_json(result / "calibration.json").data["session"]["folder"]
    for path in folder.rglob("*"):
        if path.suffix in (".yaml", ".json", ".csv", ".c", ".h", ".html"):
            text = path.read_text(encoding="utf-8")
            assert not invisible(text, keep="\n\t") or path.suffix == ".html", path
            assert name not in text or path.suffix == ".html"


def test_a_calibration_is_found_beside_a_session_of_any_name(tmp_path):
    place = calibration(tmp_path / "a\x1bb", built("gough-stewart"))
    made = run("export", place, "--to", "ros", "--json")
    assert made.code == 0
    assert {Path(file).suffix for file in made.json["files"]} >= {".yaml"}


@pytest.mark.parametrize("name", ["a\x1b[31mb", "a\nfixed: []\n#", "a\u202eb"])
def test_a_printers_file_of_any_name(tmp_path, name):
    import printers

    (tmp_path / f"{name}.cfg").write_text(printers.calibrated_cfg())
    made = run("new", tmp_path / "session", "--printer", tmp_path / f"{name}.cfg")
    assert made.code == 0
    assert not invisible(made.out + made.err)
    for path in (tmp_path / "session").iterdir():
        assert not invisible(path.read_text())
    assert read_yaml(tmp_path / "session" / "mechanism.yaml").data["fixed"]
    assert run("check", tmp_path / "session").code == 0


def test_errors_of_libraries_are_legible():
    assert str(InputError(HOSTILE, where=HOSTILE, found=HOSTILE)).isprintable()
    done = run("calibrate", "\x1b[31mred", "--no\u202esuch")
    assert done.code == 2
    assert not invisible(done.out + done.err)
