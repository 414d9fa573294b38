"""Our joint solve against SciPy's on the same residuals, from the same start, in one run.

    python benchmarks/solver.py [--configurations 30]

SciPy's trust-region method gets the residual as one dense vector, once with finite
differences and once with our Jacobian, columns scaled. Prints seconds, evaluations, final
cost and the ratio of times; exits with 1 where the answers differ.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.gauge import ThreeCentres
from pkmcal.identify.problem import Problem
from pkmcal.identify.start import start_state
from pkmcal.identify.unknowns import BatchState
from pkmcal.solver import minimise
from test_identify_scene import guess, make_scene


class Flat:
    """The problem as a dense vector function of a step from the start."""

    def __init__(self, problem: Problem, start: BatchState) -> None:
        self.problem, self.start = problem, start
        self.n_own = start.T_base_platform.shape[1] * problem.layout.motion.shape[1]

    def state(self, x: np.ndarray) -> BatchState:
        """Rotation vectors and translations added to the start."""
        na = self.problem.unknowns.count
        own = x[na:].reshape(1, self.start.T_base_platform.shape[1], -1)
        return self.problem.moved(self.start, x[None, :na], own)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """All residuals in one vector."""
        values = self.problem.residuals(self.state(x))
        return np.concatenate([values.value.ravel(), values.shared_value.ravel()])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Our derivatives at the moved state; the step's own curvature is second order."""
        linear = self.problem.linearize(self.state(x))
        _, k, r, na = linear.by_shared.shape
        d = linear.by_own.shape[-1]
        out = np.zeros((k * r + len(linear.shared_by), na + k * d))
        out[: k * r, :na] = linear.by_shared.reshape(-1, na)
        for j in range(k):
            out[j * r : (j + 1) * r, na + j * d : na + (j + 1) * d] = linear.by_own[0, j]
        out[k * r :, :na] = linear.shared_by
        return out


def timed(run):  # noqa: ANN001, ANN201
    """Result and seconds, best of two."""
    best = np.inf
    for _ in range(2):
        begin = time.perf_counter()
        result = run()
        best = min(best, time.perf_counter() - begin)
    return result, best


def main() -> int:
    """Run the comparison; 0 where all three find the same minimum."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--configurations", type=int, default=30)
    count = parser.parse_args().configurations
    rng = np.random.default_rng(0)
    scene = make_scene(rng, configurations=count)
    measurements = scene.measurements(rng)
    assembled = assemble(scene.machine, measurements, ThreeCentres())
    stations = guess(rng, scene.T_camera_base)
    start = batch_of(scene.machine, assembled, start_state(scene.machine, measurements, stations))
    flat = Flat(assembled.problem, start)
    x0 = np.zeros(assembled.problem.unknowns.count + flat.n_own)
    options = {"x_scale": "jac", "xtol": 1e-10, "ftol": 1e-12, "gtol": 1e-10}
    ours, our_time = timed(lambda: minimise(assembled.problem, start))
    rows = [("pkmcal", our_time, int(ours.steps[0]), float(ours.cost[0]))]
    for name, jac in (("scipy, our Jacobian", flat.jacobian), ("scipy, 2-point", "2-point")):
        found, seconds = timed(lambda j=jac: least_squares(flat.residuals, x0, j, **options))
        rows.append((name, seconds, found.nfev, 2 * found.cost))
    lines = [f"{count} configurations, {len(measurements.edges)} edges, {x0.size} unknowns"]
    lines += [
        f"{name:22s}{seconds:9.3f} s{n:6d} steps  cost {cost:.6f}  x {seconds / our_time:.1f}"
        for name, seconds, n, cost in rows
    ]
    sys.stdout.write("\n".join(lines) + "\n")
    same = np.allclose([r[3] for r in rows], rows[0][3], rtol=1e-4)
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
