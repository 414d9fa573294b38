"""The viewer's project with what npm installs for it, for tests that build or use it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
VIEWER, WEB = ROOT / "viewer", ROOT / "src" / "pkmcal" / "web"
INSTALL_SECONDS = 120


def viewer_project(folder: Path) -> Path:
    """A copy of the viewer's project with its dependencies, in a folder; without Node, or without
    those and without a registry, the test is skipped.
    """
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("NO NODE: the viewer was not built again (install Node 20.19 or newer)")
    copy = folder / "viewer"
    shutil.copytree(VIEWER, copy, ignore=shutil.ignore_patterns("node_modules"))
    (copy.parent / "src" / "pkmcal" / "web").mkdir(parents=True)
    shutil.copy(WEB / "schema.json", copy.parent / "src" / "pkmcal" / "web")
    if all((VIEWER / "node_modules" / name).is_dir() for name in ("vite", "axe-core")):
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
