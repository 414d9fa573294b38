"""Outputs: whole or not at all, and nothing left behind."""

import errno
import json
import os
import pickle
import shutil
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from faults import raises
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.files import (
    check_own_folder,
    check_writable,
    default_output,
    entries,
    output_lock,
    read_text,
    staged_folder,
    write_bytes,
    write_folder,
    write_text,
)
from pkmcal.files.replacing import COMMITTED_FOLDER


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
    with raises(InputError, code="file.unwritable", where=str(tmp_path / "a")):
        write_bytes(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
    assert everything_in(tmp_path) == ["a"]


def test_check_writable_leaves_no_trace(tmp_path):
    check_writable(tmp_path / "a" / "b")
    check_writable(tmp_path)
    assert everything_in(tmp_path) == []


def test_outputs_cannot_go_below_a_file(tmp_path):
    (tmp_path / "out").touch()
    with raises(InputError, found=f"{tmp_path / 'out'} is a file", expected="a folder"):
        check_writable(tmp_path / "out" / "deeper")


def test_a_folder_that_refuses(tmp_path, monkeypatch):
    def refuse(*_arguments, **_keywords):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with raises(InputError, code="file.unwritable", where=str(tmp_path / "out")) as caught:
        check_writable(tmp_path / "out")
    assert "permissions" in caught.value.next_step


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

    with raises(InputError, code="file.unwritable", where=str(tmp_path)) as caught:
        work()
    assert "a folder stands where a file should go" in caught.value.what
    assert everything_in(tmp_path) == ["b"]


KILLED = """
import itertools, json, os, pickle, shutil, signal, sys
from contextlib import suppress
from pathlib import Path
from pkmcal.api import calibrate
from pkmcal.calibration.results import check_output
from pkmcal.commands import cli
from pkmcal.errors import InputError
from pkmcal.files import read_text, write_folder
from pkmcal.report import calibration as report

session, new, keep, made = map(Path, sys.argv[1:])
found = pickle.loads(made.read_bytes())
calibrate.calibrate_session = lambda *_, **_more: found
out = session / "calibration"
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


def readable():
    # Whether what stands there is read, or said to be unfinished.
    with suppress(InputError):
        read_text(out / "calibration.json")
        return True
    return False


def again_and_again(folder, texts, over):
    # Calibration and page are made once, and written again and again, with less and less time.
    global left
    # The page is cut short: megabytes, copied a hundred times.
    made = {**texts, "report.html": texts["report.html"][:10_000]}
    read = []
    for left in itertools.count():
        shutil.rmtree(out)
        shutil.copytree(old, out)
        child = os.fork()
        if child == 0:
            sys.addaudithook(count_down)
            write_folder(folder, made, over)
            os._exit(0)
        if os.waitpid(child, 0)[1] == 0:
            break
        state = keep / f"{left:03d}"
        shutil.copytree(out, state / "killed")
        read.append(readable())
        shutil.copytree(out, state / "read")
        check_output(out)  # the next command that writes there begins so
        shutil.copytree(out, state / "finished")
        write_folder(out, dict.fromkeys(made, "2"), check_output(out))
        shutil.copytree(out, state / "next")
    shutil.rmtree(out)
    shutil.copytree(old, out)
    write_folder(folder, made, over)
    shutil.copytree(out, new)
    (keep / "old" / "readable").write_text(json.dumps(read))


report.write_folder = again_and_again
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
    readable = json.loads(before.pop("readable"))
    assert not before.items() & after.items()
    assert set(before) - set(after) == {"camera-front.yaml"}
    states = [path for path in sorted(keep.iterdir()) if path.name != "old"]
    finished = []
    for state, read in zip(states, readable, strict=True):
        killed, remeasured = contents_of(state / "killed"), contents_of(state / "read")
        assert remeasured == killed  # whoever reads changes nothing
        visible = {k: v for k, v in killed.items() if not k.startswith(".stage.")}
        # and finds the one or the other, or gets a message
        assert (visible in (before, after)) == read
        assert any((state / "read" / COMMITTED_FOLDER).glob("*")) != read
        # the next run begins with the one or the other, keeps its files and nothing of this one
        visible = contents_of(state / "finished")
        visible = {k: v for k, v in visible.items() if not k.startswith(".stage.")}
        assert visible in (before, after)
        finished.append(visible == after)
        assert contents_of(state / "next") == dict.fromkeys(after, b"2")
    assert finished == sorted(finished)  # old ones, then new ones
    assert 5 < finished.index(True) < len(finished) - 3
    assert {*readable} == {False, True}


def contents_of(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_what_a_killed_run_left_is_in_nobodys_way(tmp_path):
    (tmp_path / ".probe.0123456789ab.part").mkdir()
    assert check_own_folder(tmp_path, ["a"], "a trial") == []
    write_folder(tmp_path, {"a": "1"})
    assert everything_in(tmp_path) == ["a"]


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_what_only_looks_like_a_stage_stays(tmp_path, kind):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a").touch()
    name = tmp_path / ".stage.0123456789ab.part"
    if kind == "file":
        name.touch()
    elif kind == "folder":
        shutil.copytree(tmp_path / "mine", name)
    else:
        name.symlink_to(tmp_path / "mine")
    before = everything_in(tmp_path)
    write_text(tmp_path / "b", "1")
    assert everything_in(tmp_path) == sorted([*before, "b"])


STAGED = """
import sys
from pkmcal.files import staged_file, staged_folder

if sys.argv[2] == "file":
    with staged_file(sys.argv[1]) as part:
        part.write_bytes(b"1")
        print("written", flush=True)
        sys.stdin.read()
else:
    with staged_folder(sys.argv[1]) as stage:
        (stage / "photograph").write_bytes(b"1")
        print("written", flush=True)
        sys.stdin.read()
"""


def begun(path, what="folder"):
    """A process that has written to `path` all that it wants to, and waits."""
    run = subprocess.Popen(
        [sys.executable, "-c", STAGED, path, what],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert run.stdout.readline() == "written\n"
    return run


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs SIGKILL")
@pytest.mark.parametrize("there", [False, True], ids=["new folder", "folder that is there"])
def test_the_next_run_clears_what_a_killed_one_left_and_no_other(tmp_path, there):
    """As after ``pkmcal simulate one`` and Ctrl-\\: ``pkmcal simulate three`` clears it away."""

    def begin(name):
        if there:
            (tmp_path / name).mkdir()
        return begun(tmp_path / name)

    def stages():
        return list(tmp_path.rglob("photograph"))

    killed, alive = begin("one"), begin("two")
    killed.kill()
    killed.communicate()
    assert len(stages()) == 2
    with staged_folder(tmp_path / ("one" if there else "three")) as stage:
        (remainder,) = stages()
        assert ".two." in str(remainder) or "/two/" in remainder.as_posix()
        (stage / "a").write_text("1")
    alive.communicate("")
    assert alive.returncode == 0
    assert stages() == [tmp_path / "two" / "photograph"]
    assert everything_in(tmp_path / "two") == ["photograph"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs SIGKILL")
def test_what_a_killed_save_of_a_file_left_is_cleared_and_no_other(tmp_path):
    killed, alive = begun(tmp_path / "one", "file"), begun(tmp_path / "two", "file")
    killed.kill()
    killed.communicate()
    assert len(list(tmp_path.iterdir())) == 2
    write_text(tmp_path / "three", "3")
    assert sorted(path.name[:4] for path in tmp_path.iterdir()) == [".two", "thre"]
    alive.communicate("")
    assert alive.returncode == 0
    assert everything_in(tmp_path) == ["three", "two"]


def test_of_an_earlier_result_no_file_stays(tmp_path):
    (tmp_path / "mine").write_text("1")
    write_folder(tmp_path, {"a": "1", "b": "1"})
    write_folder(tmp_path, {"b": "2"}, over=["a", "b", "c"])
    assert everything_in(tmp_path) == ["b", "mine"]


# ------------------------------------------------------------------ replacements cut short


OLD, NEW = dict.fromkeys("abc", "old"), {**dict.fromkeys("acd", "new"), "sub/e": "new"}


def texts_of(folder):
    return {name: content.decode() for name, content in contents_of(folder).items()}


def cut_short(folder, monkeypatch):
    """Replace OLD by NEW, and be stopped after the commit and the first move."""
    write_folder(folder, OLD)
    replace, count = Path.replace, iter(range(9))

    def counted(path, target):
        if next(count) == 2:
            raise KeyboardInterrupt
        return replace(path, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", counted)
        with pytest.raises(KeyboardInterrupt):
            write_folder(folder, NEW, over=["b"])
    assert (folder / COMMITTED_FOLDER).is_dir()
    assert "new" in texts_of(folder).values()


@pytest.fixture
def interrupted(tmp_path, monkeypatch):
    """A folder whose files were being replaced when the process ended."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "out"
    cut_short(folder, monkeypatch)
    return folder


def test_a_replacement_cut_short_is_finished_by_the_next_that_writes_there(interrupted):
    with raises(InputError, found=COMMITTED_FOLDER):
        read_text(interrupted / "a")
    assert entries(interrupted) == ["a", "c", "d", "sub"]
    assert texts_of(interrupted) == NEW


def test_a_replacement_cut_short_again_is_finished_all_the_same(interrupted, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", refuse)
        found = f"the rest of them in {COMMITTED_FOLDER}"
        with raises(InputError, code="file.unwritable", found=found):
            entries(interrupted)
    entries(interrupted)
    assert texts_of(interrupted) == NEW


def left_alone(folder):
    """Whether neither readers nor writers follow the contents of COMMITTED_FOLDER, and
    report it.
    """
    before = contents_of(folder.parent)
    for refused in (
        lambda: read_text(folder / "a"),
        lambda: entries(folder),
        lambda: write_folder(folder, {"a": "newer"}),
    ):
        with raises(InputError, found=COMMITTED_FOLDER):
            refused()
    after = {k: v for k, v in contents_of(folder.parent).items() if not k.startswith("cache/")}
    return after.items() <= before.items()


def moved(folder):
    elsewhere = folder.with_name("elsewhere")
    folder.rename(elsewhere)
    return elsewhere


def with_other_content(folder):
    (folder / COMMITTED_FOLDER / "new" / "d").write_text("other")


def with_one_more(folder):
    journal = folder / COMMITTED_FOLDER / "journal"
    journal.write_text(journal.read_text().replace('["b"]', '["b", "a"]'))


def with_a_link_for_a_file(folder):
    (folder.parent / "secret").write_text("new")
    (folder / COMMITTED_FOLDER / "new" / "d").unlink()
    (folder / COMMITTED_FOLDER / "new" / "d").symlink_to(folder.parent / "secret")


def with_a_link_for_a_folder(folder):
    (folder.parent / "home").mkdir()
    (folder.parent / "home" / "e").write_text("mine")
    (folder / "sub").symlink_to(folder.parent / "home")


def with_a_link_for_itself(folder):
    elsewhere = folder.with_name("elsewhere")
    (folder / COMMITTED_FOLDER).rename(elsewhere)
    (folder / COMMITTED_FOLDER).symlink_to(elsewhere)


def unsigned(folder):
    (folder / COMMITTED_FOLDER / "journal").unlink()


CHANGES = (
    moved, with_other_content, with_one_more, with_a_link_for_a_file, with_a_link_for_a_folder,
    with_a_link_for_itself, unsigned,
)  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_a_replacement_that_was_changed_is_not_finished(interrupted, change):
    assert left_alone(change(interrupted) or interrupted)


def test_another_users_replacement_is_not_finished(interrupted, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache" / "another"))
    assert left_alone(interrupted)


def test_where_no_key_can_be_kept_files_are_replaced_all_the_same(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" / "cache"))
    write_folder(tmp_path / "out", OLD)
    write_folder(tmp_path / "out", NEW, over=["b"])
    assert texts_of(tmp_path / "out") == NEW
    cut_short(tmp_path / "again", monkeypatch)
    with raises(InputError, found=COMMITTED_FOLDER):
        entries(tmp_path / "again")


def test_a_reader_waits_for_who_moves_files(interrupted):
    with ThreadPoolExecutor(1) as pool, output_lock(interrupted):
        read = pool.submit(read_text, interrupted / "a")
        time.sleep(0.2)
        assert not read.done()
        entries(interrupted)
    assert read.result() == "new"


def test_the_journals_key_is_the_users_alone(interrupted, tmp_path):
    keys = [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]
    assert [stat.S_IMODE(path.stat().st_mode) for path in keys] == [0o600] * len(keys)
    assert keys


# ------------------------------------------------------------------ links, names, refusals


def test_no_file_goes_through_a_link_in_an_output(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "sub").symlink_to(tmp_path / "home")
    with raises(InputError, code="file.unwritable", where=str(tmp_path / "out")) as caught:
        write_folder(tmp_path / "out", {"a": "1", "sub/b": "1"})
    assert "a link stands where a folder should go" in caught.value.what
    assert everything_in(tmp_path) == ["home", "out", "out/sub"]


def test_a_link_in_a_files_place_is_replaced_and_not_followed(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "out").mkdir()
    for name in "ab":
        (tmp_path / "out" / name).symlink_to(tmp_path / "mine")
    write_folder(tmp_path / "out", {"a": "new"})
    write_text(tmp_path / "out" / "b", "new")
    assert (tmp_path / "mine").read_text() == "mine"
    assert texts_of(tmp_path / "out") == {"a": "new", "b": "new"}
    assert not any(path.is_symlink() for path in (tmp_path / "out").iterdir())


@pytest.mark.parametrize("name", ["../a", "sub/../../a", "/a", "", "."])
def test_no_name_leads_out_of_an_output(tmp_path, name):
    out = tmp_path / "out"
    with raises(InputError, code="file.impossible_name", where=str(out), found=name or "nothing"):
        write_folder(out, {name: "1"})
    assert everything_in(tmp_path) == []


def test_an_output_that_nobody_named_is_no_link(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "calibration").symlink_to(tmp_path / "home")
    with raises(InputError, found=f"a link to {tmp_path / 'home'}"):
        default_output(tmp_path / "calibration")
    assert default_output(tmp_path / "home") == tmp_path / "home"
    write_folder(tmp_path / "calibration", {"a": "1"})  # one that is named may be a link
    assert everything_in(tmp_path / "home") == ["a"]


@pytest.mark.parametrize("there", ["itself", "nothing"])
def test_an_output_that_links_to_nothing_is_refused_before_the_work(tmp_path, there):
    target = "out" if there == "itself" else "nothing"
    (tmp_path / "out").symlink_to(target)
    with raises(InputError, where=str(tmp_path / "out"), found=target, expected="a folder"):
        check_writable(tmp_path / "out" / "deeper")


@pytest.mark.parametrize(
    ("number", "word"),
    [
        (errno.ENOSPC, "Free space"), (errno.EDQUOT, "Free space"), (errno.EROFS, "only be read"),
        (errno.EACCES, "permissions"), (errno.EPERM, "permissions"), (errno.EIO, "another folder"),
    ],
)  # fmt: skip
def test_what_to_do_follows_from_what_was_refused(tmp_path, monkeypatch, number, word):
    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    for write in (write_text, lambda path, text: write_folder(path, {"a": text})):
        with pytest.raises(InputError) as caught:
            write(tmp_path / "out", "1")
        assert word in caught.value.next_step
        assert ("permissions" in caught.value.next_step) == (word == "permissions")
    assert everything_in(tmp_path) == []


# ------------------------------------------------------------------ several at once


AT_ONCE = """
import os, pickle, sys
from dataclasses import replace
from pathlib import Path
from pkmcal.report.calibration import save

out, made = map(Path, sys.argv[1:3])
calibration = pickle.loads(made.read_bytes())
save(calibration, out.with_name("trial"))  # whatever is made once
start, go = os.pipe()
children = []
for number in range(int(sys.argv[3])):
    child = os.fork()
    if child == 0:
        os.close(go)
        os.read(start, 1)  # until all are there
        save(replace(calibration, seed=number), out)
        os._exit(0)
    children.append(child)
os.close(go)
sys.exit(sum(os.waitpid(child, 0)[1] != 0 for child in children))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_of_calibrations_that_end_at_once_none_is_lost(calibrated, tmp_path):
    made, out = tmp_path / "calibrated.pickle", tmp_path / "outputs" / "new"
    made.write_bytes(pickle.dumps(calibrated))
    done = subprocess.run(
        [sys.executable, "-c", AT_ONCE, out, made, "3"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    results = [path for path in out.parent.iterdir() if path.name != "trial"]
    assert sorted(load(path).seed for path in results) == [0, 1, 2]
    assert out in results
