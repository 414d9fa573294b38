"""The viewer's bundle and the schema of its document: what ships is what the sources build."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
from pathlib import Path

import pytest

from pkmcal.web.bundle_files import SCRIPT_FILE, STYLE_FILE, bundle_file
from pkmcal.web.document import schema_text
from viewer_project import VIEWER, WEB, viewer_project

SOURCES = ("package.json", "package-lock.json", "tsconfig.json", "vite.config.js", "src")
FILES = (SCRIPT_FILE, STYLE_FILE)
BUILD_SECONDS = 300


def source_hash() -> str:
    """SHA-256 of the viewer's sources, as viewer/vite.config.js writes it into the bundle."""
    files = [path for name in SOURCES for path in (VIEWER / name, *(VIEWER / name).rglob("*"))]
    names = {path.relative_to(VIEWER).as_posix(): path for path in files if path.is_file()}
    digest = hashlib.sha256()
    for name in sorted(names):
        content = names[name].read_bytes()
        digest.update(f"{name}\n{len(content)}\n".encode() + content)
    return digest.hexdigest()


@pytest.mark.parametrize("name", FILES)
def test_the_bundle_is_built_from_the_sources(name):
    """Otherwise run make viewer, and commit what it changes."""
    assert bundle_file(name).startswith(f"/*! pkmcal viewer; sources sha256 {source_hash()} */\n")


def test_the_schema_is_that_of_the_document():
    assert (WEB / "schema.json").read_text() == schema_text()


def test_the_bundle_can_stand_inside_a_page():
    assert not re.search(r"</script|<!--", bundle_file(SCRIPT_FILE), re.I)
    assert "</style" not in bundle_file(STYLE_FILE).lower()
    assert not re.search(r"@import|url\(", bundle_file(STYLE_FILE))
    assert "eval(" not in bundle_file(SCRIPT_FILE)
    assert "new Function" not in bundle_file(SCRIPT_FILE)


def test_the_lock_file_names_no_registry():
    text = (VIEWER / "package-lock.json").read_text()
    assert '"resolved"' not in text
    assert '"integrity"' in text


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    return viewer_project(tmp_path_factory.mktemp("tree"))


def test_a_build_gives_the_same_bytes(project, tmp_path):
    """Types from the schema, the type checker, the bundle."""
    done = subprocess.run(
        ["npm", "run", "build"], cwd=project, capture_output=True, text=True,
        timeout=BUILD_SECONDS, env={**os.environ, "BUNDLE": str(tmp_path / "bundle")},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    types = Path("src") / "document.ts"
    assert (project / types).read_bytes() == (VIEWER / types).read_bytes()
    for name in FILES:
        assert (tmp_path / "bundle" / name).read_text() == bundle_file(name)
