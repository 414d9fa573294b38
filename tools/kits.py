"""Gain of a calibration for kits: deltas half a millimetre off, measured by a webcam or a probe.

python tools/kits.py [MACHINES]      tool error before and after, and in its own deviations
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from kit_sessions import board_kit, flatness, probe_kit, tool

CASES: dict[str, Callable[[Path, int], object]] = {
    "delta, board, 25 configurations": lambda folder, seed: board_kit(folder, "delta", seed),
    "linear delta, board, 25": lambda folder, seed: board_kit(folder, "linear-delta", seed),
    "linear delta, 7 heights": lambda folder, seed: probe_kit(folder, seed),
    "the same, rods measured to 0.02 mm": lambda folder, seed: probe_kit(folder, seed, rods=2e-5),
    "linear delta, 25 heights": lambda folder, seed: probe_kit(folder, seed, 25),
}


def main(machines: int) -> None:
    """One row for each case, root mean squares over the machines, mm."""
    heads = ("tool before", "after", "worst", "sideways", "error/sigma", "bed before", "after")
    print(f"{'':36}" + "".join(f"{head:>12}" for head in heads) + "  usable")
    for title, make in CASES.items():
        rows, usable = [], 0
        for seed in range(machines):
            with tempfile.TemporaryDirectory() as folder:
                kit = make(Path(folder) / "session", seed)
                value = kit.calibrated()
            e = tool(kit, value)
            bed = flatness(kit, kit.nominal), flatness(kit, value.machine)
            rows.append((e.before, e.after, e.after / e.expected, e.sideways, *bed))
            usable += value.verdict.usable
        x = np.array(rows)
        r = np.sqrt(np.mean(x**2, axis=0))
        mm = [r[0], r[1], x[:, 1].max(), r[3]]
        cells = [f"{v * 1e3:12.3f}" for v in mm] + [f"{r[2]:12.2f}"]
        cells += [f"{v * 1e3:12.3f}" for v in r[4:]]
        print(f"{title:36}" + "".join(cells) + f"  {usable} of {machines}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
