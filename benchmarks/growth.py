"""Growth of each step of a calibration with the number of configurations.

    OPENBLAS_NUM_THREADS=1 python benchmarks/growth.py [--sizes 100 300 1000 3000 10000]

Two kinds of sessions: simulated edges of a hexapod's legs from three cameras, without images; and
an H4's table of poses, from its files to the page, the whole of `pkmcal calibrate`. Processor
seconds, each size in a process of its own, with its peak memory. The exponent is the slope of log
time over log size from ``FROM`` configurations on. Exits with 1 if one is above ``MOST``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from solver import most_megabytes

import pkmcal
from pkmcal.calibration.outlier_explanations import outlier_explanations
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import identifiability
from pkmcal.identify.gauge import ThreeCentres
from pkmcal.identify.start import start_state
from pkmcal.solver.search import minimise
from test_identify_scene import guess, make_scene
from test_pose_sessions import make

FROM = 300
"""Configurations from which on what does not depend on their number hardly counts."""
SOON = 0.02
"""Seconds at the largest size below which a step's exponent is not estimated."""
MOST = 1.2
"""Exponent above which a step fails: it would become quadratic one day; n log n, and a cache that
is full, stay below."""

Step = tuple[str, Callable[[], Any]]


def of_edges(count: int) -> Iterator[Step]:
    """The steps after the images of a hexapod's legs."""
    rng = np.random.default_rng(0)
    scene = make_scene(rng, configurations=count)
    measurements, machine = scene.measurements(rng), scene.machine
    begin = start_state(machine, measurements, guess(rng, scene.T_camera_base))
    made: dict[str, Any] = {}

    def assembled() -> None:
        made["assembled"] = assemble(machine, measurements, ThreeCentres())

    def solved() -> None:
        minimise(made["assembled"].problem, batch_of(machine, made["assembled"], begin))

    def estimated() -> None:
        made["estimate"] = bundle(machine, measurements, begin)

    def report() -> None:
        info = made["estimate"].linearized.info
        identifiability(info, made["estimate"].machine)

    yield "edges: assemble", assembled
    yield "edges: solve", solved
    yield "edges: joint estimate, robust", estimated
    yield "edges: what the data tell", report


def of_table(count: int) -> Iterator[Step]:
    """The whole of ``pkmcal calibrate`` on an H4's table of poses."""
    with tempfile.TemporaryDirectory() as folder:
        session, out = Path(folder) / "session", Path(folder) / "out"
        make(session, "h4", n=count)
        made: dict[str, Any] = {}

        def loaded() -> None:
            made["session"] = pkmcal.load_session(session)

        def calibrated() -> None:
            made["result"] = pkmcal.calibrate(made["session"])

        def report() -> None:
            result = made["result"]
            list(outlier_explanations(result.session, result.measurements, result.estimate))

        yield "table: load", loaded
        yield "table: calibrate", calibrated
        yield "table: of it, what was outvoted", report
        yield "table: report and files", lambda: made["result"].save(out)
        yield "table: read back", lambda: pkmcal.load_result(out)


KINDS: dict[str, Callable[[int], Iterator[Step]]] = {"edges": of_edges, "table": of_table}


def measured(kind: str, count: int) -> dict[str, float]:
    """Processor seconds of each step, and the greatest memory in MB, of this process."""
    results: dict[str, float] = {}
    for name, work in KINDS[kind](count):
        begin = time.process_time()
        work()
        results[name] = time.process_time() - begin
    results[f"{kind}: MB"] = most_megabytes()
    return results


def main() -> int:
    """Print the table; 0 where nothing grows faster than MOST."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 300, 1000, 3000, 10000])
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        sys.stdout.write("\n" + json.dumps(measured(options.one[0], int(options.one[1]))))
        return 0
    sizes = sorted(options.sizes)
    head = "".join(f"{n:>10,}" for n in sizes)
    sys.stdout.write(f"{'processor seconds':34s}{head}  exponent\n")
    linear = True
    for kind in KINDS:
        columns: list[dict[str, float]] = []
        for count in sizes:
            words = [sys.executable, __file__, "--one", kind, str(count)]
            done = subprocess.run(words, env=os.environ, capture_output=True, text=True, check=True)
            columns.append(json.loads(done.stdout.splitlines()[-1]))
        for name in columns[0]:
            values = [column[name] for column in columns]
            line = f"{name:34s}" + "".join(f"{value:10.4g}" for value in values)
            large = [(n, v) for n, v in zip(sizes, values, strict=True) if n >= FROM]
            if len(large) > 1 and large[-1][1] > SOON:
                slope = float(np.polyfit(*np.log(np.array(large).T), 1)[0])
                linear &= slope <= MOST
                line += f"{slope:10.2f}"
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
    return 0 if linear else 1


if __name__ == "__main__":
    raise SystemExit(main())
