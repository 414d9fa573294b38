"""Calibration log of a Maslow 4 as a session: its belts' lengths at unknown positions.

The log has ``CLBM:[{bl:2960.58, br:3150.08, tr:3067.72, tl:3049.85},...]``, lengths in mm along the
plane, of the belts to the bottom left, bottom right, top right and top left anchor, and anchors as
``$/Maslow_tlX=...``; the bottom left one is the origin, and the bottom right one at y = 0. Batches
repeat the positions of earlier ones. Semantics: the firmware's print_calibration_data.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import csv_text, quoted, read_text
from pkmcal.firmware.cables import check_millimetres
from pkmcal.mechanisms import catalogue
from pkmcal.starter import session_texts
from pkmcal.starter.sources import SessionTexts, StarterSource

BELTS = ("bl", "br", "tr", "tl")
"""Belts in the order of the built-in machine's legs."""
SUGGESTED_BELT_NOISE = "1 mm"
LARGEST_FRAME = 20.0
"""Longest belt and largest coordinate of an anchor, m."""
FEWEST_BELT_POSITIONS = 4
ANCHOR_NAMES = ("tlX", "tlY", "trX", "trY", "brX")
UNKNOWN_ANCHOR_SIGMA = "0.5"
"""Standard deviation of the built-in machine's anchors for a log without any, m: the belts decide.
"""
_START = re.compile(r"CLBM:\[")
_POSITION = re.compile(r"\{([^{}\n]*)\}")
_LENGTH = re.compile(r"\b(bl|br|tr|tl)[ \t]*:[ \t]*([-+.0-9eE]+)")
_ANCHOR = re.compile(rf"Maslow_({'|'.join(ANCHOR_NAMES)})[ \t]*[=:][ \t]*([-+.0-9eE]+)")
_CENTER = re.compile(r"base: \{joint: revolute, center: \[[^\[\]]*\]\}")
_CENTER_SIGMA = re.compile(r"(?<=^tolerance: \{center: )[^,}]*", re.MULTILINE)
_HOME = re.compile(r"^home: .*$", re.MULTILINE)
_RANGE = re.compile(r"range: \[[^\[\]]*\]")
_NOISE = re.compile(r"^  noise: .*$", re.MULTILINE)


@final
class MaslowLog(StarterSource):
    """Calibration log of a Maslow 4: a whole session."""

    title: ClassVar = "a Maslow's log"
    recognised: ClassVar = "the lines CLBM:[...] of a Maslow 4's calibration log"

    def claims(self, text: str, path: Path) -> bool:
        """Whether a text has belts' lengths as a Maslow 4 prints them."""
        del path
        return _START.search(text) is not None

    def read(
        self, text: str, path: Path, unit: str | None, given: Mapping[str, float]
    ) -> SessionTexts:
        """Complete session. Raises InputError for logs without usable positions."""
        del unit, given
        return _session_texts(text, path.name)


def _session_texts(text: str, label: str) -> SessionTexts:
    """Texts by name of a complete session, without images. Raises InputError for other logs."""
    lengths, anchors = belt_lengths(text, label), _anchors(text, label)
    texts = session_texts("four-belt", "readings")
    mechanism = read_text(catalogue()["four-belt"])
    if anchors is not None:
        places = iter(anchors.tolist())
        mechanism = _CENTER.sub(
            lambda _: "base: {{joint: revolute, center: [{:.6g}, {:.6g}, 0.0]}}".format(
                *next(places)
            ),
            mechanism,
        )
        x, y = anchors.mean(axis=0)
        mechanism = _HOME.sub(f"home: {{position: [{x:.4g}, {y:.4g}, 0.0]}}", mechanism)
    else:
        mechanism = _CENTER_SIGMA.sub(UNKNOWN_ANCHOR_SIGMA, mechanism)
    longest = 1.1 * float(lengths.max())
    texts["mechanism.yaml"] = _RANGE.sub(f"range: [0.1, {longest:.2f}]", mechanism)
    texts["session.yaml"] = _NOISE.sub(f"  noise: {SUGGESTED_BELT_NOISE}", texts["session.yaml"])
    names = [f"{k + 1:04d}" for k in range(len(lengths))]
    texts["joints.csv"] = csv_text([f"{belt} [mm]" for belt in BELTS], names, 1e3 * lengths)
    return texts


def belt_lengths(text: str, label: str) -> Array:
    """Belts' lengths (n, 4), m, at the different positions of a log, in the order of BELTS.

    Raises InputError for a position without four lengths, and for too few positions.
    """
    out: dict[tuple[float, ...], None] = {}
    for number, line in enumerate(text.splitlines(), 1):
        start = _START.search(line)
        for position in _POSITION.findall(line[start.end() :] if start else ""):
            given = dict(_LENGTH.findall(position))
            values = [_number(given.get(belt, "")) for belt in BELTS]
            if not all(0 < value <= LARGEST_FRAME for value in values):
                raise InputError(
                    "a position of the log has not four lengths",
                    where=f"{label}, line {number}",
                    found=quoted(position),
                    expected=f"{', '.join(BELTS)} in mm, up to {1e3 * LARGEST_FRAME:g}",
                )
            out[tuple(values)] = None
    if len(out) < FEWEST_BELT_POSITIONS:
        raise InputError(
            "the log has too few positions",
            where=label,
            found=len(out),
            expected=f"{FEWEST_BELT_POSITIONS} different ones or more",
        )
    lengths = np.array(list(out))
    check_millimetres(1e3 * float(lengths.max()), label)
    return lengths


def _anchors(text: str, label: str) -> Array | None:
    """Anchors (4, 2), m, in the order of BELTS; None for a log without them. Raises InputError for
    a log with some of their coordinates alone.
    """
    given = {name: _number(value) for name, value in _ANCHOR.findall(text)}
    if not given:
        return None
    if missing := [name for name in ANCHOR_NAMES if name not in given]:
        raise InputError(
            "the log does not give all anchors",
            where=label,
            found=f"no {', '.join(missing)}",
            expected=f"all of {', '.join(ANCHOR_NAMES)}, or none",
        )
    check_millimetres(1e3 * max(map(abs, given.values())), f"{label}, the anchors")
    if not all(abs(value) <= LARGEST_FRAME for value in given.values()):
        raise InputError(
            "an anchor of the log has no place",
            where=label,
            found=", ".join(f"{name} = {1e3 * value:g}" for name, value in given.items()),
            expected="coordinates in mm",
        )
    return np.array(
        [
            [0.0, 0.0],
            [given["brX"], 0.0],
            [given["trX"], given["trY"]],
            [given["tlX"], given["tlY"]],
        ]
    )


def _number(text: str) -> float:
    """Millimetres of a text, in m; NaN for what is no number."""
    try:
        return 1e-3 * float(text)
    except ValueError:
        return np.nan
