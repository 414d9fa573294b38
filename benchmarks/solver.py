"""Speed of the joint solve: beside SciPy and Ceres, by size, in studies, and beside another
version.

    OPENBLAS_NUM_THREADS=1 python benchmarks/solver.py [--configurations 30 300 3000]
        [--against ../other/src]

First beside SciPy's trust-region method on the same residuals, from the same start: as one dense
vector, once with our Jacobian and once with finite differences, columns scaled.

Then beside Ceres in C++ (``benchmarks/ceres``), where that can be built: the same problem, written
to a file, solved to the same cost, one thread each, alternating, the least processor seconds of
each.

Then, each in a process of its own: the solve and the whole robust estimate of a hexapod seen by
three cameras, and the joint estimates of [A] 4.3 as in a study. Processor seconds, with wall
seconds beside them, and the peak memory. With ``--against`` the same is done with another version's
``src``, alternating, and ratios are printed. Times are the best of several repeats. Exits with 1 if
results differ.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import BATCH, bundle
from pkmcal.identify.gauge import ThreeCentres
from pkmcal.identify.methods.four_step import solve_from_centres
from pkmcal.identify.methods.leg_axes import centres_from_axes
from pkmcal.identify.problem import Problem
from pkmcal.identify.start import start_state
from pkmcal.identify.unknowns import BatchState
from pkmcal.papers import paper_a
from pkmcal.solver.search import STEP_TOLERANCE, minimise
from pkmcal.studies.engine import batches
from test_identify_scene import guess, make_scene

RUNS = 25
"""Runs of a study that are solved at once, as its own batches."""
REPEATS = 3
AS_LOW = 1e-9
"""Relative difference of costs between us and Ceres."""
OURS = (("pkmcal", "solve"), ("pkmcal, as a round", "solve-nearly"))
"""Ours, to the end, and as near as the rounds of an estimate are solved, which is as near as Ceres
comes with its own tolerances."""
CERES = (
    ("Ceres, block an edge", "1e10", "edge"),
    ("Ceres, block a view", "1e10", "view"),
)
"""Settings of Ceres: first trust region, and the blocks of residuals. Its default region, 1e4,
takes eight times the steps."""
MANY = 1000
"""Configurations from which on a measurement is not repeated within a process."""
SAME = 1e-6
"""Relative difference of costs, and of stated deviations: what is left of a search, and half of the
digits of a normal matrix."""


class Flat:
    """The problem as a dense vector function of a step from the start."""

    def __init__(self, problem: Problem, start: BatchState) -> None:
        self.problem, self.start = problem, start
        self.n_own = start.T_base_platform.shape[1] * problem.layout.motion.shape[1]

    def state(self, x: np.ndarray) -> BatchState:
        """Rotation vectors and translations added to the start."""
        na = self.problem.unknowns.count
        own = x[na:].reshape(1, self.start.T_base_platform.shape[1], -1)
        return self.problem.retract(self.start, x[None, :na], own)

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


def timed(work: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """Result, processor seconds and wall-clock seconds, the best of several."""
    result, best = None, np.full(2, np.inf)
    for _ in range(repeats):
        begin = time.process_time(), time.perf_counter()
        result = work()
        best = np.minimum(best, np.subtract((time.process_time(), time.perf_counter()), begin))
    return result, float(best[0]), float(best[1])


def most_megabytes() -> float:
    """The greatest memory of this program alone; getrusage counts that of who started it, too."""
    status = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM"))


def session(count: int) -> tuple[Any, Any, Any, Problem, BatchState]:
    """A hexapod's machine, measurements and start, and the problem that they make."""
    rng = np.random.default_rng(0)
    scene = make_scene(rng, configurations=count)
    measurements = scene.measurements(rng)
    assembled = assemble(scene.machine, measurements, ThreeCentres())
    state = start_state(scene.machine, measurements, guess(rng, scene.T_camera_base))
    start = batch_of(scene.machine, assembled, state)
    return scene.machine, measurements, state, assembled.problem, start


def against_scipy(count: int) -> bool:
    """Print the comparison; False where the three do not find the same minimum."""
    _, measurements, _, problem, start = session(count)
    flat = Flat(problem, start)
    x0 = np.zeros(problem.unknowns.count + flat.n_own)
    options = {"x_scale": "jac", "xtol": 1e-10, "ftol": 1e-12, "gtol": 1e-10}
    ours, our_time, _ = timed(lambda: minimise(problem, start), REPEATS)
    rows = [("pkmcal", our_time, int(ours.steps[0]), float(ours.cost[0]))]
    for name, jac in (("scipy, our Jacobian", flat.jacobian), ("scipy, 2-point", "2-point")):
        item, seconds, _ = timed(lambda j=jac: least_squares(flat.residuals, x0, j, **options), 1)
        rows.append((name, seconds, item.nfev, 2 * item.cost))
    say(f"{count} configurations, {len(measurements.edges)} edges, {x0.size} unknowns")
    for name, seconds, n, cost in rows:
        say(f"{name:22s}{seconds:9.3f} s{n:6d} steps  cost {cost:.6f}  x {seconds / our_time:.1f}")
    return bool(np.allclose([r[3] for r in rows], rows[0][3], rtol=1e-4))


def dumped(problem: Problem, start: BatchState) -> dict[str, np.ndarray]:
    """The arrays of benchmarks/ceres/README.md: legs between two joints with two tubes each."""
    layout, blocks, data, u = problem.layout, problem.blocks, problem.data, problem.unknowns
    theta, radius = problem.theta(start)[0], np.array(layout.radius)
    leg = np.concatenate([layout.a_index, layout.b_index, radius], axis=1)
    rod = np.stack([layout.rod, layout.scale], axis=1)
    rows, columns = np.nonzero(problem.prior)
    sigma = np.empty(u.count)
    sigma[columns] = 1 / problem.prior[rows, columns]
    k, g = np.nonzero(blocks.present)
    of_leg, station = np.broadcast_to(blocks.leg, blocks.present.shape)[k, g], blocks.station[k, g]
    tube = np.argmax(radius[of_leg] == blocks.radius[k, g][:, None], axis=1)
    index = [k, station, of_leg, tube, blocks.side[k, g, 0], blocks.column[k, g, 0]]
    return {
        "T_base_platform": start.T_base_platform[0],
        "T_camera_base": start.T_camera_base[0],
        "legs": theta[leg],
        "rods": theta[rod],
        "drawn_legs": problem.nominal[leg],
        "drawn_rods": problem.nominal[rod],
        "leg_tolerances": sigma[u.machine][leg],
        "rod_tolerances": sigma[u.machine][rod],
        "shifts": start.columns[0],
        "shift_sigma": sigma[u.effects][:1],
        "readings": data.joints[0],
        "reading_noise": problem.joint_noise,
        "edge_index": np.stack(index, axis=1),
        "edge_basis": data.basis[0, k, g, 0],
        "edge_whiten": data.whiten[0, k, g],
        "edge_shift": data.shift[0, k, g],
    }


def dump(count: int, path: Path) -> None:
    """Write a hexapod's problem to a file, in the format of benchmarks/ceres/README.md."""
    *_, problem, start = session(count)
    with path.open("wb") as file:
        file.write(b"pkmcal least squares 1\n")
        for name, array in dumped(problem, start).items():
            file.write(" ".join([name, *map(str, array.shape)]).encode() + b"\n")
            file.write(np.ascontiguousarray(array, dtype="<f8").tobytes())


def ceres() -> Path | None:
    """The C++ program, built where it is not; None where it cannot be."""
    root = Path(__file__).resolve().parents[1]
    try:
        done = subprocess.run(
            ["make", "-s", "-C", str(root / "benchmarks" / "ceres")],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        say("no Ceres: there is no make")
        return None
    if done.returncode:
        reasons = [line for line in done.stderr.splitlines() if "error" in line]
        say(f"no Ceres: {reasons[0] if reasons else 'it cannot be built'}")
        return None
    return root / "build" / "ceres" / "solve"


def against_ceres(program: Path, count: int) -> bool:
    """Print the comparison; False where costs differ."""
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dump"
        dump(count, path)
        for _ in range(REPEATS):
            for name, *options in CERES:
                words = [str(program), str(path), *options, str(REPEATS if count < MANY else 1)]
                _keep_best(results, name, words, {})
            for name, what in OURS:
                words = [sys.executable, __file__, "--one", what, str(count)]
                _keep_best(results, name, words, {})
    ours, best = results["pkmcal"], min(results[name]["cpu"] for name, *_ in CERES)
    same = True
    for name, m in results.items():
        off = m["answer"] / ours["answer"] - 1
        same &= abs(off) < AS_LOW
        say(
            f"{count:6d} {name:24s}{m['cpu']:10.4f} s{m['steps']:4.0f} steps{m['MB']:7.0f} MB"
            f"  cost {off:+.0e}  x {m['cpu'] / best:.2f}"
        )
    return same


def _keep_best(
    results: dict[str, dict[str, float]], name: str, words: list[str], environment: dict[str, str]
) -> None:
    """The best of what a command measured so far, kept under a name."""
    done = subprocess.run(
        words, env={**os.environ, **environment}, capture_output=True, text=True, check=True
    )
    now, before = json.loads(done.stdout), results.get(name, {})
    results[name] = {key: min(x, before.get(key, np.inf)) for key, x in now.items()}


def measured(what: str, count: int) -> dict[str, float]:
    """One measurement in this process: seconds, steps, an answer to compare, megabytes."""
    if what == "study":
        work, answer, per = study(count)
    else:
        machine, measurements, state, problem, start = session(count)
        per = 1
        if what.startswith("solve"):
            tolerance = BATCH.nearly_solved if what == "solve-nearly" else STEP_TOLERANCE

            def work() -> Any:
                return minimise(problem, start, tolerance=tolerance)

            def answer(value: Any) -> tuple[float, float]:
                return value.steps[0], value.cost[0]
        else:

            def work() -> Any:
                return bundle(machine, measurements, state)

            def answer(value: Any) -> tuple[float, float]:
                return value.statistics.steps, float(np.sum(np.diag(value.covariance)))

    result, cpu, wall = timed(work, REPEATS if count < MANY else 1)
    steps, value = answer(result)
    return {
        "cpu": cpu / per,
        "wall": wall / per,
        "steps": float(steps),
        "answer": float(value),
        "MB": most_megabytes(),
    }


def study(runs: int) -> tuple[Callable[[], Any], Callable[[Any], tuple[float, float]], int]:
    """The joint estimates of [A] 4.3 from the four steps' answers."""
    setting = paper_a.HexapodByAxes(batch=runs)
    data = setting.draw(batches(setting, runs, seed=0)[0])
    axes = paper_a.measured_axes(data)
    steps = solve_from_centres(
        data.machine, axes, *centres_from_axes(axes, paper_a.STATIONS), "corrected"
    )
    start = paper_a.Start(paper_a.parameters_of(data.machine, steps), steps.T_camera_base)

    def answer(value: paper_a.Fitted) -> tuple[float, float]:
        return value.extra["steps"].mean(), value.sigma["parameters"].mean()

    return lambda: paper_a.joint_from_readings(data, start), answer, runs


def in_turns(what: str, count: int, sources: list[Path]) -> list[dict[str, float]]:
    """The best of several measurements with each version's source, in turns."""
    best: dict[str, dict[str, float]] = {}
    words = [sys.executable, __file__, "--one", what, str(count)]
    for _ in range(REPEATS):
        for source in sources:
            _keep_best(best, str(source), words, {"PYTHONPATH": str(source)})
    return list(best.values())


def say(line: str) -> None:
    """Print a line at once: the next may take minutes."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Run all comparisons; 0 where answers agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--configurations", type=int, nargs="+", default=[30])
    parser.add_argument("--against", type=Path)
    parser.add_argument("--dump", nargs=2, metavar=("CONFIGURATIONS", "FILE"))
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.dump:
        dump(int(options.dump[0]), Path(options.dump[1]))
        return 0
    if options.one:
        sys.stdout.write(json.dumps(measured(options.one[0], int(options.one[1]))))
        return 0
    same = against_scipy(options.configurations[0])
    program = ceres()
    for count in options.configurations if program else ():
        same &= against_ceres(program, count)
    sources = [Path(__file__).resolve().parents[1] / "src"]
    sources += [options.against.resolve()] if options.against else []
    work = [(what, n) for n in options.configurations for what in ("solve", "bundle")]
    for what, count in [*work, ("study", RUNS)]:
        value = in_turns(what, count, sources)
        for name, m in zip(("this", "other"), value, strict=False):
            say(
                f"{what:7s}{count:6d} {name:6s}{m['cpu']:10.4f} s of the processor"
                f"{m['wall']:10.4f} s{m['steps']:7.2f} steps{m['MB']:7.0f} MB"
            )
        if len(value) > 1:
            say(f"{'':20s}x {value[1]['cpu'] / value[0]['cpu']:.2f}")
            same &= bool(np.isclose(value[0]["answer"], value[1]["answer"], rtol=SAME))
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
