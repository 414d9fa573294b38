"""Pictures of the tutorial and of what can go wrong: the pages that the commands themselves write.

The tutorial's session is the one that its reader makes; the wrong ones are of
benchmarks/wrong_sessions.py, number 1.
"""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

import pkmcal
from pkmcal.calibration.calibrate import Calibration
from pkmcal.checks import pictures
from pkmcal.checks.check import check_session
from pkmcal.judge.validate import validate_calibration
from pkmcal.outcome import Outcome, Part, Verdict
from pkmcal.outcome.blocks.images import Images
from pkmcal.report import calibration, validation
from pkmcal.web.report_page import report_page

HERE = Path(__file__).resolve().parents[1]
HELD_OUT = 6
"""Configurations that the tutorial leaves out."""
NUMBER = 1
"""Number of the wrong sessions."""


@cache
def session(work: Path) -> Path:
    """The tutorial's session, made by its command where it is not there yet."""
    folder = work / "session"
    if not folder.exists():
        command = [sys.executable, "-m", "pkmcal", "simulate", str(folder), "--seed", "1"]
        subprocess.run(command, check=True, capture_output=True)
    return folder


@cache
def calibrated(folder: Path, holdout: int = 0) -> Calibration:
    """Its calibration."""
    return pkmcal.calibrate(folder, holdout=holdout)


def images(work: Path) -> str:
    """The first image of each station."""
    shots = [sorted(folder.iterdir())[0] for folder in sorted((session(work) / "images").iterdir())]
    figures = "".join(
        "<figure><img src='data:image/png;base64,"
        f"{base64.b64encode(path.read_bytes()).decode()}'>"
        f"<figcaption>{path.parent.name} / {path.stem}</figcaption></figure>"
        for path in shots
    )
    return (
        "<style>.row { display: flex; gap: 10px; padding: 6px } .row figure { margin: 0; flex: 1 }"
        " .row img { width: 100%; border-radius: 6px } .row figcaption { font-size: 14px;"
        f" color: #58626d }}</style><div class='row'>{figures}</div>"
    )


def report(work: Path) -> str:
    """The report, whole."""
    return report_page(calibration.outcome_of(calibrated(session(work), HELD_OUT)))


def report_part(work: Path, name: str) -> str:
    """One section of the report."""
    return _only(calibration.outcome_of(calibrated(session(work), HELD_OUT)), name)


def confirmed(work: Path) -> str:
    """Results of `pkmcal validate` on the held-out configurations."""
    out = work / "out"
    if not (out / "calibration.json").exists():
        calibration.save(calibrated(session(work), HELD_OUT), out)
    return report_page(validation.outcome_of(validate_calibration(out, session(work))))


def laid_over(folder: Path) -> str:
    """The nominal model over the first station's first image, at the rough and at the localized
    pose.
    """
    check = check_session(folder)
    if check.look is None:
        sys.exit(f"{folder}: nothing to look at")
    few = replace(check.look, stations=check.look.stations[:1])
    (block,) = (one for one in pictures.with_pictures(few).blocks if isinstance(one, Images))
    first = block.images[0]
    # the pose by hand to the left
    poses = tuple(
        first.model_copy(update={"overlays": (one,), "caption": one.title})
        for one in reversed(first.overlays)
    )
    pair = Images(images=poses, size="figure", legs=block.legs)
    return parts_page(Part("pair", "", blocks=(pair,)), style="main h2 { display: none; }")


def wrong(work: Path, kind: str, name: str, spoil: Callable[[Path], None] | None = None) -> Path:
    """A session with the wrong fact of that name, or spoilt by hand."""
    module = _wrong_sessions()
    right = module.simulated(kind, NUMBER, work)
    folder = work / name.replace(" ", "-") / f"{kind}-{NUMBER}"
    if not folder.exists():
        shutil.copytree(right, folder)
        if spoil:
            spoil(folder)
        else:
            module.FACTS[name].make(folder, np.random.default_rng(NUMBER))
    return folder


def numbered_from_another_leg(folder: Path) -> None:
    """Each leg's readings two columns on, a third round the machine."""

    def change(values: np.ndarray) -> None:
        values[:] = np.roll(values, -2, axis=1)

    _wrong_sessions().readings(folder, change)


def two_columns_exchanged(folder: Path) -> None:
    """The readings of the first two legs under each other's heading."""

    def change(values: np.ndarray) -> None:
        values[:, :2] = values[:, [1, 0]]

    _wrong_sessions().readings(folder, change)


def _wrong_sessions() -> ModuleType:
    sys.path.insert(0, str(HERE / "benchmarks"))
    import wrong_sessions

    return wrong_sessions


def _only(outcome: Outcome, name: str) -> str:
    return parts_page(*(part for part in outcome.parts if part.name == name))


def parts_page(*parts: Part, style: str = "") -> str:
    """Sections of a report alone, without head, contents and verdict."""
    opened = tuple(replace(part, expert=False) for part in parts)
    outcome = Outcome(command="", title="", verdict=Verdict(True, ""), parts=opened)
    own = (
        "<style>.report { display: block; padding-top: 12px !important; }"
        " .top, .contents, .verdict { display: none !important; }"
        f" {style}</style>"
    )
    # instead of the policy, which allows no other style
    policy = r'<meta http-equiv="Content-Security-Policy"[^>]*>'
    return re.sub(policy, own, report_page(outcome))
