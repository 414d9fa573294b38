"""Time of the exported C kinematics, one call, for every built-in machine.

    python benchmarks/export_c.py

Needs a C compiler (cc, or CC=...). "warm" starts forward kinematics 0.2 mm and 1 mrad away along
each direction, as the controller's last sample would; "home" starts from the home pose.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from pkmcal.calibration.source import load_source
from pkmcal.export.c import C_SOURCE_FILE, CSource, c_array
from pkmcal.export.samples import samples
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import catalogue

PAIRS = 64
ROUNDS = 300
MAIN = """
#define _POSIX_C_SOURCE 199309L
#include "pkmcal_kinematics.h"
#include <stdio.h>
#include <time.h>
enum { PAIRS = %(pairs)d, ROUNDS = %(rounds)d };
%(readings)s
%(poses)s
%(starts)s
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}
static void copy(pkmcal_pose *to, const double T[12])
{
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) to->R[i][j] = T[4 * i + j];
        to->t[i] = T[4 * i + 3];
    }
}
int main(void)
{
    static pkmcal_pose start[PAIRS], pose[PAIRS];
    double best[3] = {1e9, 1e9, 1e9}, q[PKMCAL_JOINTS];
    volatile double sink = 0;
    pkmcal_report report;
    int r, k, bad = 0;
    for (k = 0; k < PAIRS; ++k) { copy(&start[k], STARTS[k]); copy(&pose[k], POSES[k]); }
    for (r = 0; r < ROUNDS; ++r) {
        double t[4];
        t[0] = now();
        for (k = 0; k < PAIRS; ++k) {
            pkmcal_pose p = start[k];
            bad += pkmcal_forward(READINGS[k], &p, &report) != 0;
            sink += p.t[0];
        }
        t[1] = now();
        for (k = 0; k < PAIRS; ++k) {
            pkmcal_pose p;
            pkmcal_home(&p);
            bad += pkmcal_forward(READINGS[k], &p, &report) != 0;
            sink += p.t[0];
        }
        t[2] = now();
        for (k = 0; k < PAIRS; ++k) {
            bad += pkmcal_inverse(&pose[k], q) != 0;
            sink += q[0];
        }
        t[3] = now();
        for (k = 0; k < 3; ++k) if (t[k + 1] - t[k] < best[k]) best[k] = t[k + 1] - t[k];
    }
    for (k = 0; k < 3; ++k) printf("%%10.2f", best[k] / PAIRS * 1e6);
    printf("%%8d\\n", bad);
    return 0;
}
"""


def main() -> None:
    print(f"{'microseconds':16}{'warm':>10}{'home':>10}{'inverse':>10}{'failed':>8}")
    for name in sorted(catalogue()):
        with tempfile.TemporaryDirectory() as folder:
            print(f"{name:16}{timed(name, Path(folder))}", end="")


def timed(name: str, folder: Path) -> str:
    """The compiled program's line for one machine."""
    source = load_source(name)
    machine = source.machine
    poses, readings = samples(machine, PAIRS)
    motion = machine.layout.motion
    sign = np.random.default_rng(1).choice([-1, 1], (PAIRS, 6))
    away = np.repeat([1e-3, 2e-4], 3) * sign @ motion @ motion.T
    arrays = {
        "readings": c_array("READINGS", "[PAIRS][PKMCAL_JOINTS]", readings),
        "poses": c_array("POSES", "[PAIRS][12]", flat(poses)),
        "starts": c_array("STARTS", "[PAIRS][12]", flat(perturb(poses, away))),
    }
    for file, text in CSource().files(source).items():
        (folder / file).write_text(text)
    (folder / "main.c").write_text(MAIN % {**arrays, "pairs": PAIRS, "rounds": ROUNDS})
    compiler = os.environ.get("CC", "cc")
    build = [compiler, "-std=c99", "-O2", "main.c", C_SOURCE_FILE, "-lm", "-o", "timed"]
    subprocess.run(build, cwd=folder, check=True)
    return subprocess.run([folder / "timed"], check=True, capture_output=True, text=True).stdout


def flat(poses: np.ndarray) -> np.ndarray:
    """The upper three rows of poses (n, 4, 4), (n, 12)."""
    return poses[:, :3].reshape(len(poses), 12)


if __name__ == "__main__":
    main()
