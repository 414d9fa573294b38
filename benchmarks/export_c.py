"""Time and size of the exported C kinematics, in doubles and in floats, for built-in machines.

    python benchmarks/export_c.py

Times of one call need a C compiler (cc, or CC=...). "warm" starts forward kinematics 0.2 mm and
1 mrad away along each direction, as the controller's last sample would; "home" starts from the home
pose. "off" is how far a warm start ends from the pose, um and urad.
Sizes are code and constants, with -Os, and the stack of forward kinematics, which needs the
compilers arm-none-eabi-gcc (a Cortex-M4F) and avr-gcc (an ATmega2560, whose double is a float).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from pkmcal.calibration.machine_source import load_source
from pkmcal.errors import InputError
from pkmcal.exporters.c import C_SOURCE_FILE, CSource, c_array
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import catalogue

PAIRS = 64
ROUNDS = 300
MAIN = """
#define _POSIX_C_SOURCE 199309L
#include "pkmcal_kinematics.h"
#include <math.h>
#include <stdio.h>
#include <time.h>
#define REAL(number) PKMCAL_NUMBER(number)
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
static void copy(pkmcal_pose *to, const pkmcal_real T[12])
{
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) to->R[i][j] = T[4 * i + j];
        to->t[i] = T[4 * i + 3];
    }
}
int main(void)
{
    static pkmcal_pose start[PAIRS], pose[PAIRS], last[PAIRS];
    double best[3] = {1e9, 1e9, 1e9}, off = 0;
    pkmcal_real q[PKMCAL_JOINTS];
    volatile pkmcal_real sink = 0;
    pkmcal_report report;
    int r, k, i, j, bad = 0;
    for (k = 0; k < PAIRS; ++k) { copy(&start[k], STARTS[k]); copy(&pose[k], POSES[k]); }
    for (r = 0; r < ROUNDS; ++r) {
        double t[4];
        t[0] = now();
        for (k = 0; k < PAIRS; ++k) {
            pkmcal_pose p = start[k];
            bad += pkmcal_forward(READINGS[k], &p, &report) != 0;
            sink += p.t[0];
            last[k] = p;
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
    for (k = 0; k < PAIRS; ++k) {
        for (i = 0; i < 3; ++i) {
            off = fmax(off, fabs(last[k].t[i] - pose[k].t[i]));
            for (j = 0; j < 3; ++j) off = fmax(off, fabs(last[k].R[i][j] - pose[k].R[i][j]));
        }
    }
    for (k = 0; k < 3; ++k) printf("%%10.2f", best[k] / PAIRS * 1e6);
    printf("%%10.2g%%8d\\n", off * 1e6, bad);
    return 0;
}
"""


CORTEX_M4F = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
CONTROLLERS = {
    "Cortex-M4F double": ("arm-none-eabi-", *CORTEX_M4F),
    "Cortex-M4F float": ("arm-none-eabi-", *CORTEX_M4F, "-DPKMCAL_FLOAT"),
    "ATmega2560": ("avr-", "-mmcu=atmega2560"),
}


def main() -> None:
    names = []
    print(f"{'microseconds':24}{'warm':>10}{'home':>10}{'inverse':>10}{'off':>10}{'failed':>8}")
    for name in sorted(catalogue()):
        try:
            CSource().files(load_source(name))
        except InputError:  # more rods than freedoms
            continue
        names.append(name)
        for real, flags in (("double", ()), ("float", ("-DPKMCAL_FLOAT",))):
            with tempfile.TemporaryDirectory() as folder:
                print(f"{name:16}{real:8}{timed(name, Path(folder), flags)}", end="")
    print(f"\n{'bytes':24}{'code':>10}{'data':>10}{'stack':>10}")
    for name in names:
        for controller, (prefix, *flags) in CONTROLLERS.items():
            if shutil.which(f"{prefix}gcc"):
                with tempfile.TemporaryDirectory() as folder:
                    print(f"{name:16}{controller:18}{sizes(name, Path(folder), prefix, flags)}")


def sizes(name: str, folder: Path, prefix: str, flags: list[str]) -> str:
    """Bytes of code, of constants in memory, and of the deepest frames' stack."""
    for file, text in CSource().files(load_source(name)).items():
        (folder / file).write_text(text)
    build = [f"{prefix}gcc", *flags, "-std=c99", "-Os", "-fstack-usage", "-c", C_SOURCE_FILE]
    subprocess.run(build, cwd=folder, check=True)
    command = [f"{prefix}size", "-A", str(Path(C_SOURCE_FILE).with_suffix(".o"))]
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    results = {
        line.split()[0]: int(line.split()[1])
        for line in done.stdout.splitlines()
        if line.startswith(".")
    }
    code = sum(size for section, size in results.items() if section.startswith(".text"))
    data = sum(
        size for section, size in results.items() if section.startswith((".data", ".rodata"))
    )
    frames = [
        int(line.split("\t")[1])
        for line in next(folder.glob("*.su")).read_text().splitlines()
        if line.split("\t")[0].split(":")[-1] in STACKED
    ]
    return f"{code:10}{data:10}{sum(frames):10}"


STACKED = ("pkmcal_forward", "newton", "damped", "improved", "closure")
"""Functions that call one another in forward kinematics, with large frames."""


def timed(name: str, folder: Path, flags: tuple[str, ...]) -> str:
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
    build = [compiler, "-std=c99", "-O2", *flags, "main.c", C_SOURCE_FILE, "-lm", "-o", "timed"]
    subprocess.run(build, cwd=folder, check=True)
    return subprocess.run([folder / "timed"], check=True, capture_output=True, text=True).stdout


def flat(poses: np.ndarray) -> np.ndarray:
    """The upper three rows of poses (n, 4, 4), (n, 12)."""
    return poses[:, :3].reshape(len(poses), 12)


if __name__ == "__main__":
    main()
