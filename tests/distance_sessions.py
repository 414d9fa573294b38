"""Sessions of delta printers with heights of the bed and distances on a printed part."""

from __future__ import annotations

import numpy as np

import printers
from pkmcal.firmware.session import write_printer_session

CALIPER = 0.02
"""mm."""


def marks():
    """Places (13, 2) mm of a printed part's marks: a star of two rings and its middle."""
    a = np.deg2rad(np.arange(0, 360, 60))
    ring = np.column_stack([np.cos(a), np.sin(a)])
    return np.concatenate([np.zeros((1, 2)), 40 * ring, 75 * ring])


PAIRS = [(0, k) for k in range(1, 13)] + [(k, k + 3) for k in (1, 2, 3, 7, 8, 9)]
"""The middle to all others, and across."""


def write(folder, true, rng, *, describe=None, noise=0.015, places=13, caliper=CALIPER, pairs=None):
    """A session of heights and of distances of a true machine, mm; the marks' names.

    The part is printed at places by the firmware's own account, so the true marks are elsewhere.
    """
    describe = describe or printers.Settings()
    readings = printers.felt(true, printers.bed(places), noise, rng)
    (folder / "printer.cfg").write_text(printers.printer_cfg(describe, readings))
    (folder / "part.yaml").write_text(part(true, rng, describe, caliper, pairs))
    write_printer_session(folder / "kit", folder / "printer.cfg", part=folder / "part.yaml")
    return folder / "kit"


def part(true, rng, describe, caliper=CALIPER, pairs=None, shrinkage=0.0):
    """File of a printed part, as calipers measure it outside and inside."""
    at = np.column_stack([marks(), np.full(len(marks()), 0.2)])
    there = 1e3 * true.forward(1e-3 * describe.carriages(at))[:, :3, 3] * (1 - shrinkage)
    lines = ["unit: mm", f"noise: {caliper}", f"shrinkage: {shrinkage}", "marks:"]
    lines += [f"  m{k:02d}: [{x!r}, {y!r}, {z!r}]" for k, (x, y, z) in enumerate(at.tolist())]
    lines.append("distances:")
    for a, b in PAIRS if pairs is None else pairs:
        apart = float(np.linalg.norm(there[b] - there[a]) + caliper * rng.normal())
        both = f"outside: {apart + 4.8!r}, inside: {apart - 4.8!r}"
        lines.append(f"  - {{between: [m{a:02d}, m{b:02d}], {both}}}")
    return "\n".join(lines) + "\n"


def stretch(true, value):
    """Size of the bed by a calibrated machine relative to the commanded one, minus one."""
    xy = printers.bed(30)
    T = np.broadcast_to(np.eye(4), (30, 4, 4)).copy()
    T[:, :2, 3] = 1e-3 * xy
    there = true.forward(value.inverse(T))[:, :2, 3]
    plane = np.column_stack([1e-3 * xy, np.ones(30)])
    slope = np.linalg.lstsq(plane, there, rcond=None)[0]
    return np.trace(slope[:2]) / 2 - 1
