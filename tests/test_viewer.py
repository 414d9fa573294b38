"""The viewer's bundle and the schema of its document: what ships is what the sources build."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from pkmcal.web.bundle_files import SCRIPT_FILE, STYLE_FILE, bundle_file
from pkmcal.web.document import schema_text

ROOT = Path(__file__).resolve().parents[1]
VIEWER, WEB = ROOT / "viewer", ROOT / "src" / "pkmcal" / "web"
SOURCES = ("package.json", "package-lock.json", "tsconfig.json", "vite.config.js", "src")
FILES = (SCRIPT_FILE, STYLE_FILE)
INSTALL_SECONDS, BUILD_SECONDS = 120, 300


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
    """A copy of the viewer's project with its dependencies; without Node, or without those and
    without a registry, the tests are skipped.
    """
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("NO NODE: the viewer was not built again (install Node 20.19 or newer)")
    copy = tmp_path_factory.mktemp("tree") / "viewer"
    shutil.copytree(VIEWER, copy, ignore=shutil.ignore_patterns("node_modules"))
    (copy.parent / "src" / "pkmcal" / "web").mkdir(parents=True)
    shutil.copy(WEB / "schema.json", copy.parent / "src" / "pkmcal" / "web")
    if (VIEWER / "node_modules" / "vite").is_dir():
        (copy / "node_modules").symlink_to(VIEWER / "node_modules", target_is_directory=True)
        return copy
    install = [npm, "ci", "--ignore-scripts", "--prefer-offline", "--fetch-retries=0",
               "--fetch-timeout=10000"]  # fmt: skip
    try:
        done = subprocess.run(
            install, cwd=copy, capture_output=True, text=True, timeout=INSTALL_SECONDS
        )
    except subprocess.TimeoutExpired:
        pytest.skip("NO REGISTRY: npm ci takes too long; the viewer was not built again")
    assert "EUSAGE" not in done.stderr, (
        "package-lock.json does not fit package.json: " + done.stderr
    )
    if done.returncode:
        pytest.skip(f"NO REGISTRY: the viewer was not built again: {done.stderr[-300:]}")
    return copy


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
