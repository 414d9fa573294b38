"""Sessions from other people: no command changes anything outside its output.

A home folder is beside sessions with links of every kind into it, and with fake unfinished work of
pkmcal. Every command runs on them, and the whole tree is compared before and after.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import urllib.request
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from conftest import run
from faults import replaced
from kit_sessions import BOARD, TOUCH, probe_kit
from pkmcal.files import csv_text, read_csv, yaml_text

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
PART = "0123456789ab.part"
UNFINISHED = ".pkmcal-replacing"


def tracked(folder, seed=0):
    """A session of a delta printer whose tool a tracker measured: quickly calibrated."""
    kit = probe_kit(folder, seed, n=19)
    table = read_csv(folder / "joints.csv")
    rng = np.random.default_rng(seed)
    points = kit.truth.forward(table.values)[:, :3, 3] + TOUCH * rng.normal(size=(19, 3))
    (folder / "poses.csv").write_text(csv_text(("x", "y", "z"), table.names, points))
    return folder


def tree(root, but=()):
    """Everything below a folder, links not followed: kind, rights, target or content, and when a
    file was changed last.
    """
    out = {}
    for folder, folders, files in os.walk(root):
        folders[:] = [name for name in folders if Path(folder, name) not in but]
        for path in {Path(folder, name) for name in (*folders, *files)} - {*but}:
            values = path.lstat()
            if path.is_symlink():
                content = str(path.readlink())
            elif stat.S_ISREG(values.st_mode):
                content = hashlib.sha256(path.read_bytes()).hexdigest(), values.st_mtime_ns
            else:
                content = ""
            out[str(path.relative_to(root))] = stat.S_IFMT(values.st_mode), values.st_mode, content
    return out


@pytest.fixture(scope="module")
def world(demo, tmp_path_factory):
    """A home, a tracker's session with its calibration, another one, and one with images."""
    root = tmp_path_factory.mktemp("world")
    session = tracked(root / "tracked")
    tracked(root / "later", seed=1)
    (session / "board.yaml").write_text(yaml_text(BOARD))
    assert run("calibrate", session).code == 0
    shutil.copytree(demo.session, root / "photographed")
    (root / "home" / ".ssh").mkdir(parents=True)
    (root / "home" / "empty").mkdir()
    for name in (".ssh/authorized_keys", ".bashrc", "x"):
        (root / "home" / name).write_text("mine\n")
    shutil.copytree(session / "calibration", root / "home" / "earlier")
    return root


@pytest.fixture
def home(world, tmp_path, monkeypatch):
    """A copy of it all, with the caches elsewhere; we stand in the stranger's session."""
    shutil.copytree(world, tmp_path / "world")
    monkeypatch.chdir(tmp_path / "world" / "tracked")
    monkeypatch.setenv("BROWSER", "true")
    return tmp_path / "world" / "home"


def sessions(home):
    return [home.parent / name for name in ("tracked", "later", "photographed")]


def with_the_issues_example(home):
    """Unfinished work that would replace one file of the home folder, and remove another."""
    for folder in sessions(home):
        (folder / "photos").symlink_to(home)
        new, gone = (folder / UNFINISHED / word / "photos" for word in ("new", "gone"))
        (new / ".ssh").mkdir(parents=True)
        (new / ".ssh" / "authorized_keys").write_text("theirs\n")
        gone.mkdir(parents=True)
        (gone / "x").touch()


def with_unfinished_results(home):
    """Links in the results, where commands read and write."""
    with_the_issues_example(home)
    for folder in sessions(home)[:2]:
        for name in RESULTS:
            shutil.copytree(folder / UNFINISHED, folder / name / UNFINISHED)
            (folder / name / "photos").symlink_to(home)
        shutil.rmtree(folder / UNFINISHED)


def with_links(home):
    """Links under the names of outputs, and fake work of another process."""
    tracked, later, imaged = sessions(home)
    empty = home / "empty"
    for name in RESULTS:
        if name != "calibration":
            (tracked / name).symlink_to(empty)
            (later / name).symlink_to(empty)
    (later / "calibration").symlink_to(empty)
    (tracked / "calibration" / "mechanism.yaml").unlink()
    (tracked / "calibration" / "mechanism.yaml").symlink_to(home / "x")
    (imaged / "calibration").symlink_to(home / "earlier")
    # the folder in which the earlier result would be kept
    when = datetime.fromtimestamp((tracked / "calibration" / "calibration.json").stat().st_mtime)
    (tracked / f"calibration-{when:%Y-%m-%dT%H%M}").symlink_to(empty)
    (tracked / "mine").mkdir()
    (tracked / "mine" / "batches").symlink_to(empty)
    (tracked / "named" / "batches").mkdir(parents=True)
    (tracked / "named" / "batches" / "lock").symlink_to(home / "new")
    (tracked / "board.pdf").symlink_to(home / ".bashrc")
    # files that are read, and one that is written to
    for folder, name in ((tracked, "joints.csv"), (imaged, "session.yaml")):
        shutil.move(folder / name, home / name)
        (folder / name).symlink_to(home / name)
    # a station's name, which is part of files' names
    replaced(home / "session.yaml", "station1:", "../../../home/station1:")
    station = imaged / "images" / "station2"
    shutil.move(station, home / "images")
    station.symlink_to(home / "images")
    for place in (*sessions(home), tracked / "calibration"):
        for name in ("calibration", "stage", "session.yaml", "probe"):
            (place / f".{name}.{PART}").symlink_to(home)
        (place / f".x.{PART}").mkdir()
        (place / f".x.{PART}" / "held").symlink_to(home / "new")
        (place / f".y.{PART}").symlink_to(home / "new")


def commands(out):
    """Every command that reads a session or a calibration: where results go unless named, and in a
    folder that is named.
    """
    here, later, imaged = Path(), Path("../later"), Path("../photographed")
    yield "check", here
    yield "check", imaged, "-o", out / "check", "--pictures", out / "pictures"
    yield "calibrate", here
    yield "calibrate", here, "-o", out / "calibration"
    yield "calibrate", later
    for name in ("validate", "watch"):
        yield name, "calibration", later
        yield name, out / "calibration", later, "-o", out / name
    yield "diff", "calibration", out / "calibration", "-o", out / "diff"
    yield "diff", out / "calibration", "calibration"
    yield "plan", here, "-n", 2
    yield "plan", here, "-n", 2, "-o", out / "plan"
    yield "export", "calibration", "--to", "json"
    yield "export", out / "calibration", "--to", "json", "-o", out / "json"
    yield "servo", "3-rpr", "--runs", 1, "--duration", 0.1
    for folder in ("study", "mine", "named"):
        if os.path.lexists(folder):
            yield "study", "3-rpr", "--runs", 2, "-o", folder
    yield "board", "board.yaml"
    yield "new", here


def view(session):
    """The page of ``pkmcal view`` got, and a pose saved, unless the session is refused."""
    words = [sys.executable, "-m", "pkmcal", "view", str(session), "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as server:
        line = json.loads(server.stdout.readline())
        if url := line.get("url"):
            pose = np.eye(4)
            pose[:3, 3] = 0.0, 0.0, 1.0
            body = json.dumps({"station": 0, "image": 0, "pose": pose.tolist()}).encode()
            for request in (url, urllib.request.Request(f"{url}save", body)):
                try:
                    urllib.request.urlopen(request, timeout=60).read()
                except urllib.error.HTTPError as error:
                    error.close()
            server.send_signal(signal.SIGINT)
        server.wait(60)


HOSTILE = (
    with_the_issues_example,
    pytest.param(with_unfinished_results, marks=pytest.mark.slow),
    with_links,
)
RESULTS = (
    "calibration", "validation", "watch", "plan", "diff", "export-json", "servo", "study",
)  # fmt: skip
"""Folders of results where no other one is named."""


@pytest.mark.parametrize("prepare", HOSTILE)
def test_no_command_changes_anything_outside_its_output(home, tmp_path, quick_plans, prepare):
    prepare(home)
    root = home.parent
    # what commands may write: results inside a session, by their own names, where no link stands
    outputs = {folder / name for folder in sessions(home) for name in (*RESULTS, "board.pdf")}
    outputs = {path for path in outputs if not path.is_symlink()}
    before = tree(root, outputs)
    ends = {words: run(*words) for words in commands(tmp_path / "out")}
    assert {w: end for w, end in ends.items() if end.code not in (0, 1, 2)} == {}
    after = tree(root, outputs)
    added = after.keys() - before.keys()
    assert {name: after.get(name) for name in before} == before
    # an earlier result that is kept stands beside its place, without what its links lead to
    copies = [path for path in (root / "tracked").glob("calibration-*/*") if not path.is_symlink()]
    assert not any(path.read_bytes() == b"mine\n" for path in copies)
    assert {name for name in added if not name.startswith("tracked/calibration-")} == set()


@pytest.mark.parametrize("prepare", [None, with_the_issues_example, with_links])
def test_the_page_writes_into_a_sessions_own_file_alone(home, prepare):
    if prepare:
        prepare(home)
    root, own = home.parent, Path("photographed") / "session.yaml"
    before = tree(root)
    view(root / "photographed")
    after = tree(root)
    assert {name for name in before if before[name] != after.get(name)} == (
        set() if prepare else {str(own)}
    )
    assert after.keys() == before.keys()
