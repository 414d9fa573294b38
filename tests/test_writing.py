"""Outputs: whole or not at all, and nothing left behind."""

import os
import stat
from pathlib import Path

import pytest

from pkmcal.errors import InputError
from pkmcal.files import check_writable, staged_folder, write_bytes, write_text


def fault(function, *arguments, **keywords):
    """The message of the InputError that a call raises."""
    with pytest.raises(InputError) as caught:
        function(*arguments, **keywords)
    return str(caught.value)


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
