"""Simulated delta printers calibrated by heights, with one kind of error or all: right, refused or
wrong.

    python benchmarks/printers.py [--seed 0] [--rounds 1] [--tolerance 2] [--wrong-height 0.5]

A round is 40 printers: 7, 10, 19 and 37 points; errors of the radius (1.5 mm), the rods (0.5 mm
together, 0.1 mm each), the towers (0.4 degrees), of all of these or of none; end switches that are
off (1 mm) equally, or each by itself (standard deviations, normal). The printer's size and the
probe's noise (5 to 20 um) are drawn too. A session is made of the printer's files by ``pkmcal new
--printer``. Points are the centre and rings around it: with a single ring, a wrong radius moves the
centre alone.

right : accepted, and as good as stated: the bed over the probed disc is flat, and the radius right,
    within three of their standard deviations.
wrong : accepted, and not so.
refused : with its reason.

The radius is that of the circle whose chords are as long as the towers' mean distance; its
deviation is from the covariance of the towers.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from heights import Truth, calibrated, exported, moved

import printers
from pkmcal.arrays import Array
from pkmcal.calibration.calibrate import Calibration
from pkmcal.errors import PkmcalError

RINGS = {7: (6,), 10: (9,), 19: (6, 12), 37: (6, 12, 18)}
"""Points of each ring about the centre, by how many there are in all."""
ERRORS = ("radius", "rods", "towers", "switches", "all")
RADIUS_ERROR, ROD_ERROR, OWN_ROD_ERROR, SWITCH_ERROR = 1.5, 0.5, 0.1, 1.0
"""mm, standard deviations."""
TOWER_ERROR = 0.4
"""degrees, the same."""
MOST_DEVIATIONS = 3.0
"""Standard deviations by which a right result is off at most."""


def drawn(rng: np.random.Generator, error: str, *, uneven: bool) -> tuple[Truth, float]:
    """A printer with one kind of error, or all, and the size (mm) of its bed."""
    radius = rng.uniform(90, 140)
    rod = radius * rng.uniform(2.0, 2.4)
    describe = printers.Settings(
        round(radius, 2), rod=(round(rod, 2),) * 3, endstop=(round(1.2 * rod, 2),) * 3
    )
    wrong = {name: float(error in (name, "all")) for name in ERRORS}  # switches always are
    ends = SWITCH_ERROR * (rng.normal(size=3) if uneven else np.full(3, rng.normal()))
    built = replace(
        describe,
        radius=describe.radius + wrong["radius"] * RADIUS_ERROR * rng.normal(),
        angle=tuple(np.array(describe.angle) + wrong["towers"] * TOWER_ERROR * rng.normal(size=3)),
        rod=tuple(
            np.array(describe.rod)
            + wrong["rods"] * (ROD_ERROR * rng.normal() + OWN_ROD_ERROR * rng.normal(size=3))
        ),
    )
    right = replace(
        built,
        endstop=tuple(describe.homed + ends - np.sqrt(np.square(built.rod) - built.radius**2)),
    )
    return Truth(describe, right, printers.machine(built, endstops=tuple(ends))), 0.8 * radius


def places(n: int, reach: float, turn: float) -> Array:
    """Points (n, 2) mm of a bed: the centre and rings, turned by an angle."""
    out = [np.zeros((1, 2))]
    for ring, count in enumerate(RINGS[n], start=1):
        a = turn + 2 * np.pi * np.arange(count) / count
        out.append(reach * ring / len(RINGS[n]) * np.column_stack([np.cos(a), np.sin(a)]))
    return np.concatenate(out)


def tower_radius(centres: Array) -> tuple[float, Array]:
    """Radius of a circle with the mean distance of three towers (3, 2) as its chord, and its
    derivative (3, 2).
    """
    by = np.zeros((3, 2))
    total = 0.0
    for one, other in ((0, 1), (1, 2), (2, 0)):
        direction = centres[one] - centres[other]
        apart = float(np.linalg.norm(direction))
        total += apart
        by[one] += direction / apart
        by[other] -= direction / apart
    return total / 3 / np.sqrt(3), by / 3 / np.sqrt(3)


def radius_deviations(truth: Truth, calibration: Calibration) -> float:
    """Error of the radius in its standard deviations."""
    machine = calibration.machine
    table = machine.parameters
    radius, by = tower_radius(machine.base_centers()[:, :2])
    row = np.zeros(len(table))
    for leg in range(3):
        for axis, name in enumerate("xy"):
            row[table.index(f"legs[{leg + 1}].base.center.{name}")] = by[leg, axis]
    true = tower_radius(truth.machine.base_centers()[:, :2])[0]
    return (radius - true) / float(np.sqrt(row @ calibration.estimate.covariance @ row))


def judged(
    rng: np.random.Generator, n: int, error: str, uneven: bool, tolerance: float, wrong: float
) -> tuple[str, str]:
    """One printer: right, wrong or refused, and the figures or the reason. wrong : mm by which one
    of the heights is.
    """
    truth, reach = drawn(rng, error, uneven=uneven)
    readings = printers.felt(
        truth.machine, places(n, reach, rng.uniform(0, 1)), rng.uniform(0.005, 0.02), rng
    )
    readings[int(rng.integers(n))] += wrong
    try:
        value = calibrated(truth.says, readings, centre_tolerance=tolerance)
    except PkmcalError as fault:
        return "refused", str(fault)
    bed = value.identification.bed
    if not value.verdict.usable or bed is None:
        return "refused", " ".join(value.verdict.reasons)
    bent = moved(truth, exported(value), 1e3 * bed.radius)[1]
    flat, radius = bent / (1e6 * bed.sigma), radius_deviations(truth, value)
    good = flat <= MOST_DEVIATIONS and abs(radius) <= MOST_DEVIATIONS
    return (
        "right" if good else "wrong",
        f"bed {bent:6.1f} um, {flat:5.2f} deviations; radius {radius:5.2f} deviations",
    )


def main() -> None:
    """Every printer in a line, and how many came out how."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--seed", type=int, default=0, help="of the first round")
    parser.add_argument("--rounds", type=int, default=1, help="of 40 printers each")
    parser.add_argument("--tolerance", type=float, default=0.0, help="of centres, mm")
    parser.add_argument("--wrong-height", type=float, default=0.0, help="mm, of one in each")
    options = parser.parse_args()
    every = Counter[str]()
    for seed in range(options.seed, options.seed + options.rounds):
        for n in RINGS:
            of_points = Counter[str]()
            for number, error in enumerate(ERRORS):
                for uneven in (False, True):
                    rng = np.random.default_rng([seed, n, number, int(uneven)])
                    stated_edge_noise, figures = judged(
                        rng, n, error, uneven, options.tolerance, options.wrong_height
                    )
                    of_points[stated_edge_noise] += 1
                    switches = "uneven" if uneven else "even"
                    print(f"{n:3d} points, {error:8} {switches:6} {stated_edge_noise:7} {figures}")
            print(f"{n:3d} points: {dict(of_points)}", flush=True)
            every += of_points
    total = sum(every.values())
    shares = ", ".join(
        f"{kind} {number} ({100 * number / total:.0f} %)" for kind, number in every.items()
    )
    print(f"{total} printers: {shares}")


if __name__ == "__main__":
    main()
