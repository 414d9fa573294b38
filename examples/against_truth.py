"""A calibration of a simulated session beside its truth: how wrong it is, and how wrong it says.

    python against_truth.py SESSION CALIBRATION

The session is one that ``pkmcal simulate`` or ``pkmcal demo`` wrote; its truth.json knows the
machine, which no calibration reads.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

import pkmcal
from pkmcal.simulation import load_truth


def cell(values: np.ndarray, unit: str, summary: Callable[[np.ndarray], float] = np.mean) -> str:
    """Mean, or another summary, of the finite values; a dash without any."""
    finite = values[np.isfinite(values)]  # a machine has no pose at readings that it cannot take
    return f"{summary(finite):.3f} {unit}" if finite.size else "–"


def main() -> int:
    """Print the errors of the nominal model and of the calibrated machine."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("calibration", type=Path)
    words = parser.parse_args()
    try:
        result = pkmcal.load_result(words.calibration)
        nominal = pkmcal.load_session(words.session).machine
        truth = load_truth(words.session)
    except pkmcal.errors.PkmcalError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{'':10}{'joint centres':>16}{'platform, mean':>16}{'at most':>16}{'turned':>16}")
    for name, machine in (("drawing", nominal), ("calibrated", result.machine)):
        off = pkmcal.compare(machine, truth.machine, truth.joints)
        position, turn = 1e3 * off.position, np.degrees(off.orientation)
        cells = cell(1e3 * off.centre, "mm"), cell(position, "mm"), cell(position, "mm", np.max)
        print(f"{name:10}" + "".join(f"{text:>16}" for text in (*cells, cell(turn, "°"))))
        if missed := int(np.sum(np.isnan(position))):
            print(f"{'':10}without a pose at {missed} of {len(position)} readings")
    stated = result.tool_error(truth.T_base_platform).position
    print(f"stated: platform to {cell(1e3 * stated, 'mm')}, one standard deviation")
    return 0


if __name__ == "__main__":
    sys.exit(main())
