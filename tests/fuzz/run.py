"""Cases run, each in a process of its own that is forked from a warm one, and judged."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import sys
import unicodedata
import warnings
from collections import Counter
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path

from fuzz.cases import Case, make

SECONDS = 60
"""Processor time after which a case is killed; the aim is ten."""
MOST_WAITING = 600
"""Seconds by the clock after which a case is killed, too, if it waits for something."""
ADDRESSES = 6 << 30
"""Bytes of address space, libraries and threads' stacks included; the aim is 1 GB of memory."""
LONGEST = 2000
"""Characters of an error."""
INTERNALS = re.compile(
    r"Traceback|<class|object at 0x|NoneType|Value error,|defect of pkmcal|Warning: |RuntimeWarning"
    r"|libpng|libjpeg|JPEG data|OpenCV\(|\[ ?WARN|\[ERROR|cv::|np\.(float|int)|array\(|dtype|ufunc"
    r"|pydantic|Errno|validation error|\bstr\b|KeyError|IndexError|TypeError|ValueError|imdecode"
)
"""Texts that no user should see."""
INVISIBLE = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Categories of characters that a terminal obeys or does not show."""
ODD_FOLDER_NAME = os.fsdecode(b"a\xff\x1b[31m\n# \xe2\x80\xaeb")
ODD_FOLDERS_EACH = 5
"""One case of so many is in a folder with such a name."""
PROGRESS = re.compile(r"[A-Z].* \(\d+ %, \d+ s(, [\d:]+ left)?\)")
"""Progress output of a long command without a terminal."""
PLACE = re.compile(
    r"\bline \d+|\bcolumn |\bstation\d|\bat station |camera [\w/.]+:"
    r"|\.(yaml|json|csv|xml)(, [\w\[\]{}.-]+|: (legs|the camera)\b)|[\w-]+\.(png|jpg)\b|mechanism '"
)
"""Place of a fault: its line, its column, a file's field, a station, a camera without a file of its
own, or an image's name; or the kind of machine that a command does not take."""

ELSEWHERE = re.compile(r"(^|: )/[\w/.\\\[# -]+(, line \d+|: )")


@dataclass(frozen=True)
class Result:
    """Result of one case.

    code : exit code, negative for a signal. seconds : processor time. kilobytes : memory. faults :
    sentences about pkmcal's violations of the rules. refused : whether an error was reported.
    has_file, has_field : whether the message has the place, as far as there is one.
    """

    case: Case
    code: int
    seconds: float
    kilobytes: int
    out: str
    err: str
    faults: tuple[str, ...]
    refused: bool = False
    has_file: bool = True
    has_field: bool = True


def run(number: int, bases: Path, scratch: Path, keep: bool = False) -> Result:
    """Make a case, run its command, judge its results."""
    odd = number % ODD_FOLDERS_EACH == 0
    place = scratch / (f"case-{number}" + ODD_FOLDER_NAME * odd)
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    try:
        case = make(number, bases, place)
        before = listing(place)
        code, seconds, kilobytes = _forked(case, place, scratch)
        out, err = ((scratch / name).read_bytes().decode("utf-8", "replace") for name in ("1", "2"))
        return judged(case, code, seconds, kilobytes, out, err, before, listing(place))
    finally:
        if not keep:
            shutil.rmtree(place, ignore_errors=True)


def _forked(case: Case, place: Path, scratch: Path) -> tuple[int, float, int]:
    """Exit code, seconds and kilobytes of the case's command, in a process of its own."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        _, status, used = os.wait4(child, 0)
        spent = used.ru_utime + used.ru_stime
        return os.waitstatus_to_exitcode(status), spent, used.ru_maxrss
    code = 99
    try:
        for number in (1, 2):
            file = os.open(scratch / str(number), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.chdir(place)
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(MOST_WAITING)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        # as at a terminal, but every time and not once a place
        warnings.resetwarnings()
        warnings.simplefilter("always")
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)
        code = _command(case.words)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _command(words: tuple[str, ...]) -> int:
    from pkmcal.commands.cli import main

    own = {"read-camera": _read_camera, "look-at": _look_at}
    if words[0] not in own:
        return main(words)
    from pkmcal.errors import PkmcalError

    try:
        own[words[0]](Path(words[1]))
    except PkmcalError as error:
        sys.stderr.write(f"Error: {error}\n")
        return error.exit_code
    return 0


def _read_camera(path: Path) -> None:
    from pkmcal.cameras.files import load_camera

    load_camera(path)


def _look_at(folder: Path) -> None:
    """Requests of the page of `pkmcal view` for every station, without serving it."""
    from pkmcal.session.load import load_session
    from pkmcal.viewing.content import SessionContent
    from pkmcal.viewing.edge_search import edge_search
    from pkmcal.viewing.overlay import overlay_after_gesture
    from pkmcal.viewing.server import session_document
    from pkmcal.web.page import served_page
    from pkmcal.web.session_document import ViewRequest

    content = SessionContent(load_session(folder), None)
    served_page(session_document(content))
    for k, station in enumerate(content.session.stations):
        if station.images:
            content.jpeg(k, 0)
            content.thumbnail(k, 0)
            edges = ViewRequest(station=k, image=0)
            overlay_after_gesture(content, edges)
            edge_search(content, edges)


def listing(place: Path) -> dict[str, tuple[int, ...]]:
    """Contents of a folder, so that everything written, moved or removed is detected."""
    out = {}
    for folder, folders, files in os.walk(place):
        for name in (*folders, *files):
            path = Path(folder, name)
            stat = path.lstat()
            changes = (stat.st_mode, stat.st_ino)
            if name in files:
                changes += (stat.st_size, stat.st_mtime_ns)
            out[str(path.relative_to(place))] = changes
    return out


def judged(case, code, seconds, kilobytes, out, err, before, after) -> Result:
    """The rules of docs/commands.md."""
    faults = []
    if code not in (0, 1, 2):
        faults.append(f"exit code {code}")
    if kilobytes > 1 << 20:
        faults.append(f"{kilobytes >> 10} MB")
    match = INTERNALS.search(out + err)
    if match:
        faults.append(f"internals: {match[0]}")
    hidden = {c for c in out + err if unicodedata.category(c) in INVISIBLE and c != "\n"}
    if hidden:
        faults.append(f"characters that cannot be seen: {sorted(hidden)!a}")
    errors = _errors(case, code, out, err, faults)
    faults += [f"an error of {len(each)} characters" for each in errors if len(each) > LONGEST]
    faults += _written(case, code, before, after)
    refused = bool(errors) and code == 2
    has_file, has_field = True, True
    if refused and case.spoilt:
        text = " ".join(errors)
        # another file that a spoilt session names, such as /etc/passwd, is a file as well
        has_file = any(name in text for name in _files_of(case)) or bool(ELSEWHERE.search(text))
        # loops that are exchanged fit the file, and show in the machine alone
        places = [() if file.endswith(".loops.yaml") else words for file, _, words in case.spoilt]
        if len(places) == 1 and places[0] and "mine.txt" not in text:
            phrases = text.lower()
            has_field = bool(PLACE.search(text)) or any(
                word.strip() and word.strip().lower()[:30] in phrases for word in places[0]
            )
        if not has_file:
            faults.append("no file named")
        if not has_field:
            faults.append("no field, line or column named")
    return Result(
        case, code, seconds, kilobytes, out, err, tuple(faults), refused, has_file, has_field
    )


def _errors(case, code, out, err, faults) -> list[str]:
    """Sentences about the input, however they were reported."""
    lines = [line for line in err.splitlines() if not PROGRESS.fullmatch(line)]
    if len(lines) > 1 or (lines and not lines[0].startswith("Error: ")):
        faults.append(f"on standard error: {err[:200]!r}")
    if "--json" in case.words:
        if lines:
            faults.append("standard error in spite of --json")
        return _in_json(code, out, faults)
    if code != 2:
        return []
    if case.words[0] == "check" and not lines:
        points = re.split(r"\n(?=[✗!·→] |\n)", out)
        return [" ".join(p.split()) for p in points if p.startswith("✗")][1:]
    if not lines:
        faults.append("exit code 2 without an error")
    return [line.removeprefix("Error: ") for line in lines]


def _in_json(code, out, faults) -> list[str]:
    try:
        values = json.loads(out, parse_constant=_refuse)
    except ValueError as error:
        faults.append(f"no JSON: {error}")
        return []
    if values.get("exit_code", code) != code:
        faults.append(f"exit code {code}, but {values['exit_code']} in the JSON")
    if "message" in values:
        return [values["message"]]
    return [value["text"] for value in values.get("findings", ()) if value.get("level") == "wrong"]


def _refuse(constant):
    raise ValueError(constant)


def _files_of(case: Case) -> set[str]:
    """Names of the damaged files, and of files in which their fault may be reported."""
    names = {"mine.txt"}  # of the output folder, which is checked first
    for file, _, _ in case.spoilt:
        path = Path(file)
        names |= {path.name, path.stem}
        if path.parts[0] in ("legs", "hand", "tracker", "later", "board"):
            names |= {"session.yaml", "joints.csv", "images/", "mechanism.yaml", "cameras/"}
            names |= {"poses.csv", "board.yaml", "distances.csv"}
        if path.parts[0] == "models":  # of a model in several files
            names |= {"whole.xml", "robot.urdf"}
    return names


def _written(case: Case, code: int, before, after) -> list[str]:
    """Faults of what was written: outside the output, in part, or over a result in spite of 2."""
    changed = {name for name in {*before, *after} if before.get(name) != after.get(name)}
    outside = sorted(n for n in changed if n != case.out and not n.startswith(f"{case.out}/"))
    if (
        case.words[0] in ("calibrate", "diff") and code != 2
    ):  # what stood there is kept beside it, dated
        retained = re.compile(rf"{re.escape(case.out)}-\d{{4}}-\d\d-\d\dT\d{{4}}(/[^/]+)?")
        outside = [name for name in outside if not retained.fullmatch(name) or name in before]
    faults = []
    if outside:
        faults.append(f"written outside the output: {outside[:5]}")
    remainder = [name for name in after if name.endswith(".part") or ".pkmcal-replacing" in name]
    if remainder:
        faults.append(f"left over: {remainder[:3]}")
    # A study keeps what it has finished, and its lock, whatever comes after.
    inside = {n for n in changed if n.startswith(f"{case.out}/") and "batches" not in n}
    if code == 2 and inside and case.words[0] != "check":
        faults.append(f"refused, but written: {sorted(inside)[:5]}")
    return faults


@dataclass
class Summary:
    """Summary of many results."""

    codes: Counter = field(default_factory=Counter)
    commands: Counter = field(default_factory=Counter)
    spent: Counter = field(default_factory=Counter)
    slowest: list = field(default_factory=list)
    largest: list = field(default_factory=list)
    wrong: list = field(default_factory=list)
    refused: int = 0
    seconds: float = 0.0

    def add(self, result: Result) -> None:
        self.codes[result.code] += 1
        self.commands[result.case.words[0]] += 1
        self.spent[" ".join(result.case.words[:2])] += result.seconds
        self.refused += result.refused
        self.seconds += result.seconds
        self.slowest = sorted([*self.slowest, (result.seconds, str(result.case))])[-3:]
        self.largest = sorted([*self.largest, (result.kilobytes >> 10, str(result.case))])[-3:]
        if result.faults:
            self.wrong.append(result)

    def text(self) -> str:
        count = sum(self.codes.values())
        codes = ", ".join(f"{code}: {n}" for code, n in sorted(self.codes.items()))
        commands = ", ".join(f"{name} {n}" for name, n in self.commands.most_common())
        without = [sum(not getattr(r, of) for r in self.wrong) for of in ("has_file", "has_field")]
        lines = [
            f"{count} cases in {self.seconds:.0f} s ({commands})",
            f"exit codes {codes}; {self.refused} refused with an error",
            f"without file {without[0]}, without field {without[1]}; with faults {len(self.wrong)}",
            ", ".join(f"{name} {n:.0f} s" for name, n in self.spent.most_common(8)),
            *(f"longest {seconds:.1f} s  {case}" for seconds, case in self.slowest[::-1]),
            *(f"largest {size} MB  {case}" for size, case in self.largest[::-1]),
        ]
        return "\n".join(lines)


def warm() -> None:
    """Import and make what commands need, once for all cases, without starting a thread."""
    import gc
    import importlib
    import pkgutil

    import pkmcal
    from pkmcal.commands import cli

    for module in pkgutil.walk_packages(pkmcal.__path__, "pkmcal."):
        if not module.name.endswith("__main__") and "cluster" not in module.name:
            importlib.import_module(module.name)
    for name in ("cv2", "scipy.optimize", "scipy.linalg", "scipy.stats", "rich.console",
                 "rich.table", "rich.markup", "rich.text"):  # fmt: skip
        importlib.import_module(name)
    from pkmcal.files.quantities import unit

    unit("mm")  # reads the definitions of all units
    # Otherwise half of a refusal's time is the import of the command's module.
    with redirect_stdout(StringIO()):
        cli.main(["--help"])
    gc.collect()
    gc.freeze()  # or a case would copy what the collector touches
