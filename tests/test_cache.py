"""The user's cache folder: its contents, and that nothing depends on it."""

import os
import subprocess
import sys

import numpy as np
import pytest

from pkmcal.files import (
    digest_of,
    remember,
    remember_arrays,
    remembered,
    remembered_arrays,
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def test_what_is_kept_is_read_again(folder):
    assert remembered("a") is None
    remember("a", b"first")
    remember("a", b"second")
    assert remembered("a") == b"second"
    retained = [path.name for path in folder.rglob("*") if path.is_file()]
    assert retained == ["a"]  # nothing half written is left beside it


def test_a_cache_that_cannot_be_written_changes_nothing(folder, monkeypatch):
    blocked = folder / "file"
    blocked.write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    remember("a", b"b")
    assert remembered("a") is None


def test_arrays_are_read_again(folder):
    arrays = {"a.b": np.arange(6.0).reshape(2, 3), "mask": np.array([True, False])}
    remember_arrays("a", arrays)
    again = remembered_arrays("a")
    assert again.keys() == arrays.keys()
    assert all(np.array_equal(again[key], arrays[key]) for key in arrays)
    assert remembered_arrays("b") is None


@pytest.mark.parametrize("damage", [b"", b"PK", b"no archive", None])
def test_a_damaged_file_counts_as_absent(folder, damage):
    remember_arrays("a", {"x": np.arange(1000.0)})
    (path,) = folder.rglob("a.npz")
    whole = path.read_bytes()
    path.write_bytes(whole[:100] + bytes(60) + whole[160:] if damage is None else damage)
    assert remembered_arrays("a") is None


def test_the_oldest_arrays_are_removed(folder):
    noise = np.random.default_rng(0).integers(0, 2**62, 1000)
    for age, name in enumerate("abc"):
        remember_arrays(name, {"x": noise})
        (path,) = folder.rglob(f"{name}.npz")
        os.utime(path, (age, age))
    assert remembered_arrays("b") is not None  # and counts as used just now
    remember_arrays("d", {"x": noise}, most_bytes=20_000)
    assert sorted(path.stem for path in folder.rglob("*.npz")) == ["b", "d"]


def test_a_digest_follows_values_and_types():
    parts = [np.zeros(3), np.zeros(3, dtype=int), np.zeros((3, 1)), np.array([0, 0, 1.0]), [0], "0"]
    assert len({digest_of(part) for part in parts}) == len(parts)
    assert digest_of(np.zeros(3), "a") == digest_of(np.zeros(3), "a")


@pytest.mark.parametrize("name", ["numpy", "scipy", "opencv-contrib-python-headless"])
def test_a_digest_follows_the_versions_of_packages(name, tmp_path):
    """In a process that finds another version of one package first."""
    other = tmp_path / f"{name.replace('-', '_')}-0.dist-info"
    other.mkdir()
    (other / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0\n")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r});"
        "from pkmcal.files import digest_of; print(digest_of('a'))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    digest = done.stdout.strip()
    assert len(digest) == len(digest_of("a"))
    assert digest != digest_of("a")
