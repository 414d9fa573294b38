"""The documentation against the program: links, examples, commands, keys, functions, pictures."""

from __future__ import annotations

import importlib
import re
import shutil
from functools import cache, reduce
from pathlib import Path

import pytest

import pkmcal
from conftest import run
from document_keys import assert_keys
from pkmcal.cameras import camera_models
from pkmcal.cameras.files import load_camera
from pkmcal.commands.cli import COMMANDS_IN_ORDER, command_named
from pkmcal.exporters.contract import exporters
from pkmcal.files import parse_yaml, read_json, validated_document
from pkmcal.firmware.contract import firmwares
from pkmcal.mechanisms import MechanismDocument, load_mechanism, machine_from_document
from pkmcal.outcome.finding import templates
from pkmcal.session.schema import session_schema
from test_cli_camera import boards  # noqa: F401 - a fixture
from test_pose_sessions import make

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "viewer" / "README.md"])
PICTURES = ROOT / "docs" / "pictures"
FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FILES = (".py", ".yaml", ".json", ".csv", ".html")
NAMES = {page.relative_to(ROOT).as_posix(): page for page in PAGES}


def text_of(name: str) -> str:
    return NAMES[name].read_text(encoding="utf-8")


def prose(text: str) -> str:
    """A page without its code blocks."""
    return FENCE.sub("", text)


def blocks(text: str, kind: str) -> list[str]:
    """Code blocks whose opening line is ``kind``, in their order."""
    return [body for info, body in FENCE.findall(text) if info.strip() == kind]


def anchors(text: str) -> set[str]:
    """Anchors that GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", prose(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def quoted(text: str) -> set[str]:
    """Every word between backticks, paths taken apart."""
    spans = re.findall(r"`([^`\n]+)`", text)
    return {word for span in spans for word in re.findall(r"\w+", span)}


# ------------------------------------------------------------------ links and pictures


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_somewhere(name):
    page, text = NAMES[name], text_of(name)
    for link in LINK.findall(prose(text)):
        if link.startswith(("http://", "https://")):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), f"{name}: {link}"
        if anchor:
            assert anchor in anchors(path.read_text(encoding="utf-8")), f"{name}: {link}"


def test_pictures_are_used_small_and_made_by_the_script(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    script = importlib.import_module("pictures")
    there = {path.stem for path in PICTURES.iterdir()}
    display = {Path(link).stem for name in NAMES for link in LINK.findall(text_of(name))
             if link.endswith(".png")}  # fmt: skip
    assert there == display == set(script.PICTURES)
    for path in PICTURES.iterdir():
        assert path.read_bytes().startswith(b"\x89PNG"), path.name
        assert path.stat().st_size <= 200_000, path.name


@pytest.mark.parametrize("name", NAMES)
def test_pages_name_no_place_of_one_computer(name):
    assert not re.search(r"(^|[\s\"'(`])/(home|root|tmp|work|Users)/", text_of(name))


# ------------------------------------------------------------------ examples


@pytest.fixture(scope="module")
def workplace(demo, tmp_path_factory) -> Path:
    """A folder with ``session``, its calibration ``out``, and the machine of docs/machines.md."""
    folder = tmp_path_factory.mktemp("docs")
    (folder / "session").symlink_to(demo.session, target_is_directory=True)
    (folder / "out").symlink_to(demo.calibration, target_is_directory=True)
    (folder / "table.yaml").write_text(blocks(text_of("docs/machines.md"), "yaml machine")[0])
    return folder


@pytest.fixture(scope="module")
def quick_workplace(boards, tmp_path_factory) -> Path:  # noqa: F811 - the fixture
    """A folder with two sessions of a machine by a tracker, ``session`` and ``monday``, the
    calibration ``out`` of the first, and images of a board.
    """
    folder = tmp_path_factory.mktemp("functions")
    make(folder / "session", "gough-stewart")
    make(folder / "monday", "gough-stewart", n=12)
    pkmcal.calibrate(folder / "session").save(folder / "out")
    (folder / "boards").mkdir()
    for name in ("board.yaml", "p0.png", "p1.png", "p2.png", "p3.png"):
        shutil.copy(boards / name, folder / "boards" / name)
    return folder


@pytest.mark.parametrize("name", [n for n in NAMES if blocks(text_of(n), "python runnable")])
def test_examples_run(name, request, monkeypatch, quick_plans, quick_cameras):
    """Blocks of one page share their names, as a reader who types them in would have it."""
    quick = name in ("README.md", "docs/api.md")
    monkeypatch.chdir(request.getfixturevalue("quick_workplace" if quick else "workplace"))
    namespace: dict[str, object] = {}
    for body in blocks(text_of(name), "python runnable"):
        exec(compile(body, name, "exec"), namespace)


def test_every_function_has_an_example():
    entries = text_of("docs/api.md").split("\n::: pkmcal.")[1:]
    examples = {entry.split()[0]: blocks(entry, "python runnable") for entry in entries}
    for name in set(pkmcal.__all__) - {"__version__", "errors", "Machine"}:
        assert any(re.search(rf"\bpkmcal\.{name}\(", body) for body in examples[name]), name


def test_runnable_examples_are_where_readers_look():
    assert {n for n in NAMES if blocks(text_of(n), "python runnable")} >= {
        "README.md", "docs/files.md", "docs/formulation.md", "docs/machines.md",
    }  # fmt: skip


def test_example_files_are_valid(tmp_path):
    session, mechanism, camera = blocks(text_of("docs/files.md"), "yaml")
    validated_document(parse_yaml(session, Path("session.yaml")), session_schema())
    document = parse_yaml(mechanism, Path("mechanism.yaml"))
    document.data["legs"] *= 6  # the page shows one leg
    machine = machine_from_document(validated_document(document, MechanismDocument))
    assert machine.parameters.fixed
    assert machine.parameters.tied
    (tmp_path / "camera.yaml").write_text(camera)
    assert load_camera(tmp_path / "camera.yaml").image_size == (1024, 768)


def test_the_machine_described_from_scratch_works(workplace):
    machine = load_mechanism(workplace / "table.yaml")
    assert (machine.n_legs, machine.n_joints) == (3, 3)
    assert machine.forward_result(machine.inverse(machine.home())).singularity > 0.1


# ------------------------------------------------------------------ what is named exists


def calls(text: str) -> list[tuple[str, str]]:
    """Commands of pkmcal in a page's code, with what follows each on its line."""
    code = re.findall(r"`([^`\n]+)`", prose(text)) + [body for _, body in FENCE.findall(text)]
    call = re.compile(r"(?:^|[\s/])pkmcal +([a-z]+)\b([^\n#]*)")
    return [value for part in code for value in call.findall(part)]


def test_commands_named_exist():
    listed = run("--help").out.partition("Commands:")[2].strip("\n").partition("\n\n")[0]
    above_limit = set(re.findall(r"^  (\w+) ", listed, re.MULTILINE))
    assert {"demo", "new", "check", "calibrate"} <= above_limit
    assert {command for command, _ in calls(text_of("README.md"))} >= {"demo", "new", "check"}
    for name in NAMES:
        assert {command for command, _ in calls(text_of(name))} <= above_limit, name
    explained = re.findall(r"^## pkmcal (\w+)", text_of("docs/commands.md"), re.MULTILINE)
    assert above_limit <= set(explained)


def test_options_named_exist():
    values = cache(lambda command: run(command, "--help").out)
    for name in NAMES:
        for command, rest in calls(text_of(name)):
            for option in re.findall(r"(?<!\S)--[a-z-]+", rest):
                assert option in values(command), f"{name}: {command} {option}"


def test_every_format_is_listed():
    """Formats of exports and firmwares of delta printers, wherever a user reads their names."""
    sections = re.split(r"^## ", text_of("docs/commands.md"), flags=re.MULTILINE)
    for command, function, names in (
        ("export", pkmcal.export, exporters()),
        ("new", pkmcal.new, [one.name for one in firmwares()]),
    ):
        section = next(one for one in sections if one.startswith(f"pkmcal {command} "))
        texts = {"the page": section, "the help": run(command, "--help").out}
        texts["the docstring"] = function.__doc__ or ""
        if command == "export":
            texts["docs/export.md"] = text_of("docs/export.md").partition("\n## ")[0]
        for place, text in texts.items():
            assert not set(names) - set(re.findall(r"\w+", text)), f"{command}: {place}"


@pytest.mark.parametrize("name", NAMES)
def test_functions_named_exist(name):
    package = Path(importlib.import_module("pkmcal").__path__[0])
    modules = {p.stem for p in package.iterdir() if p.suffix == ".py" or p.is_dir()}
    for span in re.findall(r"`([\w.]+)`", prose(text_of(name))):
        first, *rest = span.removeprefix("pkmcal.").split(".")
        if not rest or first not in modules or span.endswith(FILES):
            continue
        assert _exists(f"pkmcal.{first}", rest), f"{name}: {span}"


def message_codes() -> set[str]:
    """Codes of all sentences, and whatever in the program looks like the code of an error."""
    package = Path(pkmcal.__file__).parent
    areas = [path.stem for path in (package / "outcome" / "sentences").glob("*.toml")]
    codes = {code for area in areas for code in templates(area)}
    for path in package.rglob("*.py"):
        codes |= set(re.findall(r'"([a-z]+\.[a-z_.]+)"', path.read_text(encoding="utf-8")))
    return codes


def test_answers_to_maintainers_exist():
    """Dotted names of its tables: a function, the code of a finding, or a file."""
    text = "\n".join(re.findall(r"^\|.*", text_of("CONTRIBUTING.md"), re.MULTILINE))
    named, codes = re.findall(r"`(\w+\.[\w.]+)`", text), message_codes()
    assert len(named) > 100
    for span in named:
        first, *rest = span.split(".")
        is_code = any(code.startswith(span) for code in codes)
        assert is_code or span.endswith(FILES) or _exists(f"pkmcal.{first}", rest), span


def _exists(module: str, names: list[str]) -> bool:
    try:
        here = importlib.import_module(module)
    except ImportError:
        return False
    if not names or reduce(lambda o, n: getattr(o, n, None), names, here) is not None:
        return True
    return _exists(f"{module}.{names[0]}", names[1:])


def test_codes_of_troubles_exist():
    """Codes in first cells: of a sentence, or of an error; one with an asterisk begins one."""
    codes = message_codes()
    cells = re.findall(r"^\| (`[a-z].*?) \|", text_of("docs/troubles.md"), re.MULTILINE)
    named = re.findall(r"`([a-z_.*]+)`", " ".join(cells))
    assert len(named) > 40
    for code in named:
        start = code.removesuffix("*")
        assert code in codes or (start != code and any(c.startswith(start) for c in codes)), code


def schema_keys(schema: dict) -> set[str]:
    """Property names anywhere in a JSON schema."""
    parts = [schema, *schema.get("$defs", {}).values()]
    return {key for part in parts for key in part.get("properties", {})}


@pytest.mark.parametrize(
    "schema",
    [session_schema(), MechanismDocument, *(m.schema for m in camera_models().values())],
    ids=lambda s: s.__name__,
)
def test_keys_of_files_are_explained(schema):
    keys = schema_keys(schema.model_json_schema(by_alias=True))
    assert keys
    assert keys <= quoted(text_of("docs/files.md"))


FREE = {"mechanism", "session", "versions", "timings", "facts"}
"""Parts of calibration.json whose keys are names, or those of another file or of a finding."""


def written_keys(value: object, free: set[str]) -> set[str]:
    """Keys anywhere in a JSON value, but for the inside of ``free`` ones."""
    if isinstance(value, dict):
        inner = (written_keys(v, free) for k, v in value.items() if k not in free)
        return set(value).union(*inner)
    if isinstance(value, list):
        return set().union(*(written_keys(v, free) for v in value[:3]))
    return set()


def test_keys_of_a_calibration_are_explained(demo):
    document = read_json(demo.calibration / "calibration.json").data
    keys = written_keys(document, FREE)
    assert {"parameters", "sigma", "noise_scale", "T_base_camera"} <= keys
    assert_keys("calibration.json", document)
    assert keys <= quoted(text_of("docs/files.md"))


def test_keys_of_a_truth_are_explained(demo):
    document = read_json(demo.session / "truth.json").data
    keys = set(document)
    for group in ("stations", "configurations"):
        entry = next(iter(document[group].values()))
        assert_keys(f"truth.json: {group}", entry)
        keys |= set(entry)
    assert keys <= quoted(text_of("docs/files.md"))


def test_options_that_commands_share_are_theirs():
    """Options that docs/commands.md states for all commands, or for some: --json, and --quiet."""
    options = {
        name: {word for one in command_named(name).params for word in one.opts}
        for name in COMMANDS_IN_ORDER
    }
    assert [name for name in options if "--json" not in options[name]] == []
    quiet = [name for name in options if "--quiet" in options[name]]
    assert re.findall(r"`--quiet` of `(\w+)`", text_of("docs/commands.md")) == quiet
