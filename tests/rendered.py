"""Rendered sessions, made once: shared by the workers of a run, and kept for the next run.

An image costs a tenth of a second, a session of images seconds. Nominal model, camera, settings and
the code that renders determine the content of a session, so these name the folder that keeps it; a
change of any of them renders anew.
"""

from __future__ import annotations

import fcntl
import hashlib
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pkmcal
from pkmcal.cameras.files import camera_text
from pkmcal.mechanisms import mechanism_text
from pkmcal.simulation import Settings, simulate_session

CACHE = Path(__file__).parents[1] / ".pytest_cache" / "rendered"
BOARD_SESSION = ("--board", "--stations", "2", "--configurations", "4", "--size", "640x480")
"""Options of a session whose two stations observe a board on the base."""
RENDERING = ("simulation", "mechanisms", "geometry", "cameras", "boards")
"""Packages whose code determines the content of an image."""


def once(folder: Path, make: Callable[[Path], object]) -> Path:
    """The folder, filled by ``make`` if it is empty; other workers wait meanwhile."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            part = folder.with_name(f"{folder.name}.new")
            shutil.rmtree(part, ignore_errors=True)
            make(part)
            part.rename(folder)
    return folder


def rendered(folder: Path, machine, camera, settings: Settings, seed: int = 0) -> Path:
    """A simulated session in ``folder``, as :func:`simulate_session` writes it; with its truth."""
    cameras = camera if isinstance(camera, tuple) else (camera,)
    parts = [mechanism_text(machine), *map(camera_text, cameras), repr(settings), str(seed)]
    key = hashlib.sha256("\n".join([_code(), *parts]).encode()).hexdigest()[:24]
    retained = once(
        CACHE / _code() / key,
        lambda part: simulate_session(part, machine, camera, settings, seed=seed),
    )
    shutil.copytree(retained, folder)
    return folder


def by_command(folder: Path, *words: str) -> Path:
    """A session in ``folder`` as ``pkmcal simulate`` writes it with these words, truth included."""
    from conftest import run

    package = Path(pkmcal.__file__).parent
    parts = [_code(), (package / "commands" / "simulate.py").read_text(), *words]
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:24]

    def make(part: Path) -> None:
        done = run("simulate", part, *words)
        assert done.code == 0, done.err

    shutil.copytree(once(CACHE / _code() / key, make), folder)
    return folder


@cache
def _code() -> str:
    """The digest of the code that renders; sessions of older code are let go."""
    package = Path(pkmcal.__file__).parent
    files = sorted(path for name in RENDERING for path in (package / name).rglob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]
    if CACHE.is_dir():
        for old in CACHE.iterdir():
            if old.is_dir() and old.name != digest:
                shutil.rmtree(old, ignore_errors=True)
    return digest
