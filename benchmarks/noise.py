"""Sessions with a wrong stated noise of the readings: detection, and accuracy of the machine.

    OPENBLAS_NUM_THREADS=1 python benchmarks/noise.py [--runs N] [--stations N] [--configurations N]

Hexapods (gough-stewart) with simulated edges of 0.1 px, seen by the demonstration's camera from
several places; the true and the stated noise of the readings differ. For each pair:

- told: share of the sessions in which the stated noise is contradicted, and the estimated factor
  (median);
- tool: true error of the platform's joints at given readings (root mean square over sessions), and
  the stated one; z is their ratio, 1 for honest standard deviations.
"""

from __future__ import annotations

import argparse

import numpy as np

from pkmcal.identify.bundle import bundle
from pkmcal.identify.start import start_state
from pkmcal.identify.tool import platform_by_parameters
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import load_mechanism
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.simulation import Settings, draw_truth

CASES = ((3e-6, 3e-6), (3e-6, 3e-3), (3e-6, 3e-8), (3e-4, 3e-4), (3e-4, 3e-6), (3e-4, 3e-2))
"""True noise of a reading and the stated one, m."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--stations", type=int, default=3)
    parser.add_argument("--configurations", type=int, default=15)
    parser.add_argument("--cases", type=int, nargs="*", default=list(range(len(CASES))))
    args = parser.parse_args()
    nominal, camera = load_mechanism("gough-stewart"), default_camera()
    print(f"{args.runs} sessions, {args.stations} x {args.configurations} images")
    print("true, stated (um)   told  factor   tool (mm)  stated    z")
    for true_noise, stated in (CASES[k] for k in args.cases):
        rows, factors, off, sigma, z = [], [], [], [], []
        for seed in range(args.runs):
            settings = Settings(stations=args.stations, configurations=args.configurations)
            truth = draw_truth(nominal, (camera,) * args.stations, settings, seed)
            rng = np.random.default_rng(1000 + seed)
            edges, joints = simulate_edges(
                truth.machine, truth.T_camera_base, camera, truth.T_base_platform, EdgeNoise(),
                rng, images=truth.images, joint_noise=true_noise,
            )  # fmt: skip
            given = Measurements(
                edges, joints, stated, args.stations, np.zeros(args.stations, dtype=int)
            )
            rough = np.stack([place.T_camera_base() for place in truth.rough])
            fit = bundle(nominal, given, start_state(nominal, given, rough))
            by = platform_by_parameters(fit.machine, fit.state.T_base_platform)
            error = by @ (fit.machine.values - truth.machine.values)
            covariance = by @ fit.covariance @ by.T
            factors.append(fit.statistics.reading_scale)
            rows.append(factors[-1] != 1)
            off.append(error @ error)
            sigma.append(np.trace(covariance))
            values, vectors = np.linalg.eigh(covariance)
            above_limit = values > 1e-8 * values[-1]
            z.append(
                np.sum((vectors.T @ error)[above_limit] ** 2 / values[above_limit])
                / above_limit.sum()
            )
        off, sigma, z = (1e3 * np.sqrt(np.mean(x)) for x in (off, sigma, z))
        print(
            f"{true_noise * 1e6:7g} {stated * 1e6:7g}    {100 * np.mean(rows):4.0f} %"
            f" {np.median(factors):8.3g}"
            f"  {off:8.4f} {sigma:8.4f} {z / 1e3:6.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
