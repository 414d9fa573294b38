"""Memory and time of a whole calibration by the number of images.

    OPENBLAS_NUM_THREADS=1 python benchmarks/memory.py [--photographs 500 2000 6000] [--parts]
        [--size 480x360] [--stations 3] [--keep FOLDER]

Thirty configurations of a hexapod are simulated, seen from each of a few places, and repeated under
other names: hard links to the images, and readings with the stated noise about the true ones, so
the session stays consistent. (The renderer's shading has the same effect on the edges in every
repeat; of hundreds it may be reported as another lens, and the result refused; costs are the same.)
``pkmcal calibrate``, with all files that it writes, runs on each size in a process of its own:
processor seconds, wall seconds and peak memory, beside those of a process that only imports its
modules, and the exponents of their growth. ``--parts`` prints the same by step instead: memory at
the end of a step, and its peak (Linux only).
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

BASE = 30
"""Configurations that are rendered."""
EXACT = 1e-12
"""Noise (m) of the rendered configurations' readings; each repeat adds what the session states."""

IMPORTS = (
    "import cv2, scipy.optimize, scipy.special, scipy.ndimage, pkmcal.commands.calibrate,"
    " pkmcal.calibration.calibrate, pkmcal.report.calibration"
)
PARTS = """
import sys, time, resource
from pkmcal.calibration.calibrate import calibrate
from pkmcal.api.result import Result
from pkmcal.report.calibration import outcome_of
def status(key):
    for line in open("/proc/self/status"):
        if line.startswith(key):
            return int(line.split()[1]) / 1024
def told(text, _share):
    now = time.process_time(), time.perf_counter()
    if told.text != text:
        if told.text is not None:
            used = [b - a for a, b in zip(told.at, now)]
            print(f"  {told.text:44} {used[0]:8.1f} {used[1]:8.1f} {status('VmRSS'):8.0f}"
                  f" {status('VmHWM'):8.0f}", flush=True)
        open("/proc/self/clear_refs", "w").write("5")
        told.text, told.at = text, now
told.text, told.at = None, (0.0, 0.0)
told("Loading", 0)
found = calibrate(sys.argv[1], progress=told)
told("Putting the report together", 0)
outcome = outcome_of(found)
told("Writing it", 0)
files = Result.contents_of(outcome, ["report.html", "mechanism.yaml", "calibration.json"])
told("", 0)
print({name: len(text) for name, text in files.items()})
"""


class Cost(NamedTuple):
    """Costs of one process: processor seconds, seconds by the clock, greatest memory in MB."""

    processor: float
    clock: float
    memory: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--photographs", type=int, nargs="*", default=[500, 2000, 6000])
    parser.add_argument("--stations", type=int, default=3)
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--parts", action="store_true")
    parser.add_argument("--keep", type=Path, help="of sessions, to be used again")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        base = folder / f"base-{args.stations}-{args.size}"
        if not base.exists():
            simulated(base, args.stations, args.size)
        sessions = []
        for count in args.images:
            configurations = max(count // args.stations, 2)
            session = folder / f"{base.name}-{configurations}"
            if not session.exists():
                repeated(base, session, configurations)
            sessions.append((configurations * args.stations, session))
        if args.parts:
            print(f"  {'step':44} {'cpu (s)':>8} {'clock':>8} {'MB then':>8} {'MB most':>8}")
            for images, session in sessions:
                print(f"{images} images", flush=True)
                subprocess.run([sys.executable, "-c", PARTS, str(session)], check=False)
            return
        alone = cost([sys.executable, "-c", IMPORTS])
        print("photographs  processor (s)  clock (s)  largest memory (MB)")
        print(f"{'imports':>11}  {alone.processor:13.1f}  {alone.clock:9.1f}  {alone.memory:19.0f}")
        costs: list[Cost] = []
        for images, session in sessions:
            command = [sys.executable, "-m", "pkmcal", "calibrate", str(session), "--quiet"]
            costs.append(cost([*command, "-o", str(folder / "calibration")]))
            shutil.rmtree(folder / "calibration", ignore_errors=True)
            print(f"{images:11}  {costs[-1].processor:13.1f}  {costs[-1].clock:9.1f}"
                  f"  {costs[-1].memory:19.0f}", flush=True)  # fmt: skip
        if len(costs) > 1:
            size = np.log([images for images, _ in sessions])
            for name in ("processor", "memory"):
                value = np.log([getattr(one, name) for one in costs])
                print(f"{name} grows like the {np.polyfit(size, value, 1)[0]:.2f}th power")


def simulated(folder: Path, stations: int, size: str) -> None:
    """The rendered session, its readings exact."""
    command = [sys.executable, "-m", "pkmcal", "simulate", str(folder), "--size", size, "--shared",
               "--stations", str(stations), "--configurations", str(BASE),
               "--joint-noise", str(EXACT), "--seed", "1"]  # fmt: skip
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def repeated(base: Path, folder: Path, configurations: int, noise: float = 3e-6) -> None:
    """The session with its configurations repeated under other names, in turns."""
    from pkmcal.files import csv_text, read_csv

    table = read_csv(base / "joints.csv")
    stage = folder.with_name(folder.name + ".part")
    shutil.rmtree(stage, ignore_errors=True)
    shutil.copytree(
        base, stage, ignore=shutil.ignore_patterns("images", "truth.json", "joints.csv")
    )
    words = (base / "session.yaml").read_text(encoding="utf-8")
    stated, changes = re.subn(r"noise: [-+.e0-9]+", f"noise: {noise:.1e}", words)
    if changes != 1:
        raise SystemExit("session.yaml of the simulated session states its noise in another way")
    (stage / "session.yaml").write_text(stated, encoding="utf-8")
    names = [f"{k:06d}" for k in range(configurations)]
    rng = np.random.default_rng(configurations)
    values = table.values[np.arange(configurations) % len(table.names)]
    values = values + rng.normal(scale=noise, size=values.shape)
    text = csv_text(table.columns, names, values)
    (stage / "joints.csv").write_text(text, encoding="utf-8")
    for station in sorted((base / "images").iterdir()):
        place = stage / "images" / station.name
        place.mkdir(parents=True)
        for k, name in enumerate(names):
            os.link(station / f"{table.names[k % len(table.names)]}.png", place / f"{name}.png")
    stage.rename(folder)


def cost(command: list[str]) -> Cost:
    """Costs of a process; its exit code does not matter."""
    begin = time.perf_counter()
    with subprocess.Popen(command) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    clock = time.perf_counter() - begin
    if process.returncode not in (0, 1):
        print(f"{' '.join(command)}: exit code {process.returncode}", file=sys.stderr)
    return Cost(used.ru_utime + used.ru_stime, clock, used.ru_maxrss / 1024)


if __name__ == "__main__":
    main()
