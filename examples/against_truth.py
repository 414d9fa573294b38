"""A calibration of a simulated session beside its truth: how wrong it is, and how wrong it says.

    python against_truth.py SESSION CALIBRATION

The session is one that ``pkmcal simulate`` or ``pkmcal demo`` wrote; its truth.json knows the
machine, which no calibration reads.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

import pkmcal
from pkmcal.simulation import load_truth


def main() -> int:
    """Print the errors of the drawing and of the calibrated machine."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("calibration", type=Path)
    words = parser.parse_args()
    try:
        result = pkmcal.load_result(words.calibration)
        drawing = pkmcal.load_session(words.session).machine
        truth = load_truth(words.session)
    except pkmcal.errors.PkmcalError as error:
        print(error, file=sys.stderr)
        return 2
    print("            joint centres  platform, mean  at most   turned")
    for name, machine in (("drawing", drawing), ("calibrated", result.machine)):
        off = pkmcal.compare(machine, truth.machine, truth.joints)
        millimetres = 1e3 * np.array([off.centre.mean(), off.position.mean(), off.position.max()])
        told = "  ".join(f"{v:10.3f} mm" for v in millimetres)
        print(f"{name:10}{told}  {np.degrees(off.orientation.mean()):.4f}°")
    stated = result.tool_error(truth.T_base_platform)
    print(f"stated: platform to {1e3 * stated.position.mean():.3f} mm, one standard deviation")
    return 0


if __name__ == "__main__":
    sys.exit(main())
