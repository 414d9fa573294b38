"""Ten real calibrations of a four-belt machine by its belts' lengths: scatter against sigma.

    OPENBLAS_NUM_THREADS=1 python benchmarks/maslow.py FILE [--model NAME] [--noise M]
        [--every-row]

FILE is ``ten-runs.txt`` of the Maslow frames' measurements, or its folder: runs of rows ``{bl:…,
br:…, tr:…, tl:…}``, mm, four rows per waypoint. Each run becomes a session of readings alone with
the catalogue's four-belt machine, with a prior sigma of half a metre, and is calibrated as by
`pkmcal calibrate`. For each coordinate of the anchors, with bl = (0, 0) and br.y = 0:

- spread: standard deviation over the runs. The waypoints, and with them the errors of the model
  there (belts that stretch, hooks that are no points), are the same in all runs: these do not
  scatter.
- sigma: root mean square of the stated standard deviations, which cover these errors as other
  waypoints would show them.
- again: sigma times the share of the residuals that is not the same in all runs, which should equal
  the spread.

Also the prediction: residuals of every fifth waypoint for the machine by the others.

--every-row : use rows as independent measurements, to see the sigma that would follow.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path

import numpy as np

from pkmcal.calibration.calibrate import Calibration, calibrate_session
from pkmcal.files import csv_text, yaml_text
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.session.load import load_session

BELTS = ("bl", "br", "tr", "tl")
NOISE = 1e-3
"""m, a person's statement of a belt's noise; the data determine the actual one."""
APART = 1e-6
"""m, a stated noise so small that no two rows are of one pose."""
LOOSE = 0.5
"""m, prior sigma of the nominal anchors: the frame is some three metres wide."""


def runs_of(path: Path) -> list[np.ndarray]:
    """Lengths (n, 4) m of each run."""
    path = path / "ten-runs.txt" if path.is_dir() else path
    runs: list[list[list[float]]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if re.match(r"\s*Run\b", line):
            runs.append([])
        actual_names = dict(re.findall(r"(\w+):\s*([\d.]+)", line))
        if set(BELTS) <= set(actual_names):
            runs[-1].append([1e-3 * float(actual_names[belt]) for belt in BELTS])
    return [np.array(run) for run in runs if run]


def calibrated(lengths: np.ndarray, model: str, noise: float) -> Calibration:
    """One run's calibration, by way of a session on disk."""
    nominal = load_mechanism("four-belt")
    text = mechanism_text(nominal).replace("center: 0.02", f"center: {LOOSE}")
    document = {
        "pkmcal": 1,
        "mechanism": "mechanism.yaml",
        "joints": {"file": "joints.csv", "noise": noise},
    }
    with tempfile.TemporaryDirectory() as name:
        folder, names = Path(name), [f"{k:03d}" for k in range(len(lengths))]
        (folder / "mechanism.yaml").write_text(text, encoding="utf-8")
        (folder / "joints.csv").write_text(csv_text(BELTS, names, lengths), encoding="utf-8")
        (folder / "session.yaml").write_text(yaml_text(document), encoding="utf-8")
        return calibrate_session(load_session(folder, model))


def residuals(calibration: Calibration, lengths: np.ndarray) -> np.ndarray:
    """Lengths less those of the poses that fit them best, (n, 4) m."""
    machine = calibration.machine
    return lengths - machine.inverse(machine.forward_result(lengths).T_base_platform)


def anchors(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """(br.x, tr.x, tr.y, tl.x, tl.y) and their standard deviations, m, by the result's frame."""
    machine = calibration.machine
    names = [
        f"legs[{leg}].base.center.{axis}"
        for leg, axes in ((2, "x"), (3, "xy"), (4, "xy"))
        for axis in axes
    ]
    at = [machine.parameters.index(name) for name in names]
    return machine.values[at], np.sqrt(np.diag(calibration.estimate.covariance)[at])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--model", default="anchors")
    parser.add_argument("--noise", type=float, default=NOISE)
    parser.add_argument("--every-row", action="store_true")
    args = parser.parse_args()
    noise = APART if args.every_row else args.noise
    values, sigmas, residual, ahead = [], [], [], []
    for number, lengths in enumerate(runs_of(args.file), start=1):
        result = calibrated(lengths, args.model, noise)
        value, sigma = anchors(result)
        values.append(value)
        sigmas.append(sigma)
        used = result.session.joints
        scale = result.estimate.statistics.reading_scale
        rest = residuals(result, used)
        if not args.every_row:  # the rows' poses are the same in all runs
            residual.append(rest)
            poses = np.arange(len(used))
            for fold in range(5):
                others = calibrated(used[poses % 5 != fold], args.model, noise)
                ahead.append(residuals(others, used[poses % 5 == fold]))
        print(
            f"run {number}: {len(lengths)} rows, {len(used)} poses, residuals"
            f" {1e3 * np.sqrt(np.mean(rest**2)):.2f} mm, readings scatter by"
            f" {1e3 * scale * noise:.2f} mm; anchors"
            f" {' '.join(f'{1e3 * v:.2f}' for v in value)} mm",
            flush=True,
        )
    spread = np.std(values, axis=0, ddof=1)
    sigma = np.sqrt(np.mean(np.square(sigmas), axis=0))
    print(f"\n{'mm':8}{'spread':>8}{'sigma':>8}{'ratio':>8}{'again':>8}")
    again = np.full(len(sigma), np.nan)
    if residual:
        common = np.mean(residual, axis=0)
        differ = np.mean((np.array(residual) - common) ** 2) * len(residual) / (len(residual) - 1)
        again = sigma * np.sqrt(differ / np.mean(np.square(residual)))
    for name, *row in zip(
        ("br.x", "tr.x", "tr.y", "tl.x", "tl.y"), spread, sigma, again, strict=True
    ):
        s, stated, own = (1e3 * x for x in row)
        print(f"{name:8}{s:8.2f}{stated:8.2f}{s / stated:8.2f}{own:8.2f}")
    if ahead:
        rms = 1e3 * np.sqrt(np.mean(np.square(np.concatenate(ahead))))
        print(f"waypoints that the calibration did not see: residuals {rms:.2f} mm")


if __name__ == "__main__":
    main()
