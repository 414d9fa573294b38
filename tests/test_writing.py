"""Outputs: whole or not at all, and nothing left behind."""

import contextlib
import os
import pickle
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from faults import fault
from pkmcal.calibration.results import check_output
from pkmcal.calibration.saved import load
from pkmcal.errors import InputError
from pkmcal.files import (
    check_own_folder,
    check_writable,
    read_text,
    staged_folder,
    write_bytes,
    write_folder,
    write_text,
)
from pkmcal.files.writing import COMMITTED_FOLDER


def everything_in(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_file_is_written_with_its_folder_and_usual_permissions(tmp_path):
    write_text(tmp_path / "new" / "a.txt", "ä\n")
    assert (tmp_path / "new" / "a.txt").read_bytes() == b"\xc3\xa4\n"
    plain = tmp_path / "plain"
    plain.touch()
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "new" / "a.txt", plain)]
    assert modes[0] == modes[1]
    assert everything_in(tmp_path / "new") == ["a.txt"]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_bytes(tmp_path / "a", b"old")

    def full(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert "No space left" in fault(write_bytes, tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
    assert everything_in(tmp_path) == ["a"]


def test_check_writable_leaves_no_trace(tmp_path):
    check_writable(tmp_path / "a" / "b")
    check_writable(tmp_path)
    assert everything_in(tmp_path) == []


def test_outputs_cannot_go_below_a_file(tmp_path):
    (tmp_path / "out").touch()
    assert f"{tmp_path / 'out'} is a file" in fault(check_writable, tmp_path / "out" / "deeper")


def test_a_folder_that_refuses(tmp_path, monkeypatch):
    def refuse(*_arguments, **_keywords):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    message = fault(check_writable, tmp_path / "out")
    assert "cannot be written (Permission denied)" in message
    assert "Choose another folder" in message


def test_a_new_folder_appears_at_once(tmp_path):
    target = tmp_path / "runs" / "out"
    with staged_folder(target) as stage:
        (stage / "sub").mkdir()
        (stage / "sub" / "a").write_text("1")
        assert not target.exists()
    assert everything_in(target) == ["sub", "sub/a"]
    assert everything_in(tmp_path) == ["runs", "runs/out", "runs/out/sub", "runs/out/sub/a"]


def test_a_standing_folder_keeps_its_other_files(tmp_path):
    (tmp_path / "keep").write_text("mine")
    (tmp_path / "a").write_text("old")
    with staged_folder(tmp_path) as stage:
        (stage / "a").write_text("new")
        assert (tmp_path / "a").read_text() == "old"
    assert everything_in(tmp_path) == ["a", "keep"]
    assert (tmp_path / "a").read_text() == "new"


@pytest.mark.parametrize("exists", [False, True])
def test_an_error_while_staging_changes_nothing(tmp_path, exists):
    target = tmp_path / "out"
    if exists:
        target.mkdir()

    def work():
        with staged_folder(target) as stage:
            (stage / "a").write_text("1")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert everything_in(tmp_path) == (["out"] if exists else [])


def test_a_clash_is_noticed_before_anything_is_moved(tmp_path):
    (tmp_path / "b").mkdir()

    def work():
        with staged_folder(tmp_path) as stage:
            (stage / "a").write_text("1")
            (stage / "b").write_text("2")

    assert "a folder stands where a file should go" in fault(work)
    assert everything_in(tmp_path) == ["b"]


KILLED = """
import itertools, os, pickle, shutil, signal, sys
from pathlib import Path
import pkmcal.calibration.calibrate
from pkmcal.commands import calibrate, cli
from pkmcal.commands import finish as end

session, new, keep, made = map(Path, sys.argv[1:])
found = pickle.loads(made.read_bytes())
pkmcal.calibration.calibrate.calibrate_session = lambda *_, **_more: found
write, out = calibrate.write_outcome, session / "calibration"
old = keep / "old"
shutil.copytree(out, old)


def count_down(event, values):
    # Opens for writing, renames, removals: what changes a folder. Each tells of itself before.
    changes = event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate") or (
        event == "open" and isinstance(values[2], int) and values[2] & (os.O_WRONLY | os.O_RDWR)
    )
    if changes and str(session) in os.path.abspath(str(values[0])):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)


def again_and_again(outcome, folder, files, over):
    # Calibration and page are made once, and written again and again, with less and less time.
    global left
    # The page is cut short: megabytes, copied a hundred times.
    made = end.contents(outcome, files)
    made["report.html"] = made["report.html"][:10_000]
    end.contents = lambda *_: made
    for left in itertools.count():
        shutil.rmtree(out)
        shutil.copytree(old, out)
        child = os.fork()
        if child == 0:
            sys.addaudithook(count_down)
            write(outcome, folder, files, over)
            os._exit(0)
        if os.waitpid(child, 0)[1] == 0:
            break
        shutil.copytree(out, keep / f"{left:03d}")
    shutil.copytree(out, new)


calibrate.write_outcome = again_and_again
sys.exit(cli.main(["calibrate", str(session), "--quiet"]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and SIGKILL")
def test_a_result_is_the_old_or_the_new_wherever_calibrate_is_killed(
    demo, calibrated, session, tmp_path
):
    made = tmp_path / "calibrated.pickle"
    made.write_bytes(pickle.dumps(calibrated))
    out, keep, new = session / "calibration", tmp_path / "killed", tmp_path / "new"
    shutil.copytree(demo.calibration, out)
    for path in out.iterdir():  # an old result that differs in every file, and has one more
        text = path.read_text()[: 10_000 if path.suffix == ".html" else None]
        path.write_text(text.replace("<title>", "<title>Before: ").replace("0.1", "0.2"))
    (out / "camera-front.yaml").write_text("model: pinhole\n")
    done = subprocess.run(
        [sys.executable, "-c", KILLED, session, new, keep, made],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    before, after = contents_of(keep / "old"), contents_of(new)
    assert not before.items() & after.items()
    assert set(before) - set(after) == {"camera-front.yaml"}
    states = [path for path in sorted(keep.iterdir()) if path.name != "old"]
    seen = []
    for state in states:
        again = tmp_path / f"again-{state.name}"
        shutil.copytree(state, again)
        with contextlib.suppress(InputError):
            load(state)  # whoever reads finds one of the two
        visible = {k: v for k, v in contents_of(state).items() if not k.startswith(".stage.")}
        assert visible in (before, after)
        seen.append(visible == after)
        # and the next run is not kept from working, nor keeps anything of this one
        write_folder(again, dict.fromkeys(after, "2"), check_output(again))
        assert contents_of(again) == dict.fromkeys(after, b"2")
    # Old ones, then new ones; some of the new ones were finished by who read them.
    assert seen == sorted(seen)
    assert 5 < seen.index(True) < len(seen) - 3


def contents_of(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_what_a_killed_run_left_is_in_nobodys_way(tmp_path):
    for name in (".stage.0123456789ab.part", ".probe.0123456789ab.part"):
        (tmp_path / name / "new").mkdir(parents=True)
    assert check_own_folder(tmp_path, ["a"], "a trial") == []
    write_folder(tmp_path, {"a": "1"})
    assert everything_in(tmp_path) == ["a"]


STAGED = """
import os, signal, sys
from pkmcal.files import staged_folder

with staged_folder(sys.argv[1]) as stage:
    (stage / "photograph").write_bytes(b"1")
    print("written", flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs SIGKILL")
@pytest.mark.parametrize("there", [False, True], ids=["new folder", "folder that is there"])
def test_the_next_run_clears_what_a_killed_one_left_and_no_other(tmp_path, there):
    """As after ``pkmcal simulate one`` and Ctrl-\\: ``pkmcal simulate three`` clears it away."""

    def begin(name):
        if there:
            (tmp_path / name).mkdir()
        run = subprocess.Popen(
            [sys.executable, "-c", STAGED, tmp_path / name],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert run.stdout.readline() == "written\n"
        return run

    def stages():
        return list(tmp_path.rglob("photograph"))

    killed, alive = begin("one"), begin("two")
    killed.kill()
    killed.communicate()
    assert len(stages()) == 2
    with staged_folder(tmp_path / ("one" if there else "three")) as stage:
        (left,) = stages()
        assert ".two." in str(left) or "/two/" in left.as_posix()
        (stage / "a").write_text("1")
    alive.communicate("")
    assert alive.returncode == 0
    assert stages() == [tmp_path / "two" / "photograph"]
    assert everything_in(tmp_path / "two") == ["photograph"]


def test_of_an_earlier_result_no_file_stays(tmp_path):
    (tmp_path / "mine").write_text("1")
    write_folder(tmp_path, {"a": "1", "b": "1"})
    write_folder(tmp_path, {"b": "2"}, over=["a", "b", "c"])
    assert everything_in(tmp_path) == ["b", "mine"]


def test_a_replacement_that_cannot_be_finished_is_told(tmp_path, monkeypatch):
    write_text(tmp_path / COMMITTED_FOLDER / "new" / "a", "1")

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", refuse)
        assert "cannot be moved to their place (Permission denied)" in fault(
            read_text, tmp_path / "a"
        )
    assert read_text(tmp_path / "a") == "1"
    assert everything_in(tmp_path) == ["a"]
