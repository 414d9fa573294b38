"""The header of a machine's C source, and its self-test."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.export.c_tables import Tables
from pkmcal.export.source import Source
from pkmcal.export.text import c_array, c_comment
from pkmcal.geometry.rigid import perturb

HEADER, SOURCE, SELFTEST = "pkmcal_kinematics.h", "pkmcal_kinematics.c", "pkmcal_selftest.c"

CONVENTIONS = (
    "Units: m and rad.",
    "pose: R and t map platform coordinates to base coordinates, p_base = R p_platform + t.",
    "twist: omega_x, omega_y, omega_z (rad/s), tau_x, tau_y, tau_z (m/s): R changes by omega x R,"
    " t by tau, both along the base frame's axes.",
    "length of a rod = reading + offset. Readings in the order of the machine's columns.",
    "C99, math.h alone; no memory is allotted, nothing but the arguments is written, so that all"
    " functions can run at once in several threads. Do not compile with -ffast-math.",
)

_HEADER = """\
#ifndef PKMCAL_KINEMATICS_H
#define PKMCAL_KINEMATICS_H

#ifdef __cplusplus
extern "C" {
#endif

#define PKMCAL_JOINTS %(joints)d /* readings: %(names)s */
#define PKMCAL_RODS %(rods)d

/* Newton's steps at most; -DPKMCAL_MOST_STEPS=8 bounds the time of a call. */
#ifndef PKMCAL_MOST_STEPS
#define PKMCAL_MOST_STEPS 60
#endif

typedef struct {
    double R[3][3]; /* columns: the platform's axes along the base's */
    double t[3];    /* m, the platform's origin in the base frame */
} pkmcal_pose;

typedef enum {
    PKMCAL_OK = 0,
    PKMCAL_NOT_CONVERGED = 1, /* the limit of steps was reached */
    PKMCAL_SINGULAR = 2,      /* the platform is not held: a pose is not one of many */
    PKMCAL_OUT_OF_REACH = 3,  /* no pose near the start, or no reading, closes the machine */
    PKMCAL_BAD_INPUT = 4      /* not finite, or a start that is no rotation */
} pkmcal_status;

typedef struct {
    int steps;    /* Newton's */
    double error; /* m, of the rod that fits worst */
    double pivot; /* smallest of the last step: some tenths in a good pose, 0 in a singular one */
} pkmcal_report;

/* The pose that forward kinematics may start from where no better one is known. */
void pkmcal_home(pkmcal_pose *pose);

/* Readings at a pose; of a crank's or slider's two the one nearest to mid-range. The pose should be
 * one that the machine can take: where its rods and axes allow only some, that is not checked. */
pkmcal_status pkmcal_inverse(const pkmcal_pose *pose, double joints[PKMCAL_JOINTS]);

/* The pose at readings, in the assembly of the start: the last pose, or home. *pose is the start
 * and becomes the result where PKMCAL_OK is returned; else it stays. report may be NULL. */
pkmcal_status pkmcal_forward(const double joints[PKMCAL_JOINTS], pkmcal_pose *pose,
                             pkmcal_report *report);
%(jacobian)s
/* 0 where all readings are within the mechanism file's ranges; else which is not, from 1. */
int pkmcal_out_of_range(const double joints[PKMCAL_JOINTS]);

/* What a status means, in words. */
const char *pkmcal_status_text(pkmcal_status status);

#ifdef __cplusplus
}
#endif

#endif
"""

_JACOBIAN = """
/* Readings' rates are rates = jacobian twist at a pose ([B] eq. 6-7). */
pkmcal_status pkmcal_inverse_jacobian(const pkmcal_pose *pose,
                                      double jacobian[PKMCAL_JOINTS][6]);
"""

_SELFTEST = """\
#include "pkmcal_kinematics.h"

#include <math.h>
#include <stdio.h>

%(tables)s
static double pose_difference(const pkmcal_pose *a, const pkmcal_pose *b)
{
    double largest = 0.0;
    int i, j;
    for (i = 0; i < 3; ++i) {
        largest = fmax(largest, fabs(a->t[i] - b->t[i]));
        for (j = 0; j < 3; ++j) {
            largest = fmax(largest, fabs(a->R[i][j] - b->R[i][j]));
        }
    }
    return largest;
}

static double joint_difference(const double a[PKMCAL_JOINTS], const double b[PKMCAL_JOINTS])
{
    double largest = 0.0;
    int k;
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        largest = fmax(largest, fabs(a[k] - b[k]));
    }
    return largest;
}

int main(void)
{
    double inverse_error = 0.0, forward_error = 0.0;
    int failed = 0, k;
    for (k = 0; k < PAIRS; ++k) {
        double joints[PKMCAL_JOINTS];
        pkmcal_pose pose = STARTS[k];
        if (pkmcal_inverse(&POSES[k], joints) != PKMCAL_OK) {
            ++failed;
        } else {
            inverse_error = fmax(inverse_error, joint_difference(joints, READINGS[k]));
        }
        if (pkmcal_forward(READINGS[k], &pose, NULL) != PKMCAL_OK) {
            ++failed;
        } else {
            forward_error = fmax(forward_error, pose_difference(&pose, &POSES[k]));
        }
        failed += pkmcal_out_of_range(READINGS[k]) != 0;
    }
    printf("inverse kinematics: largest difference %%.1e (m, rad)\\n", inverse_error);
    printf("forward kinematics: largest difference %%.1e (m, elements of R)\\n", forward_error);
    if (failed > 0 || !(inverse_error < LIMIT) || !(forward_error < LIMIT)) {
        printf("FAIL: %%d calls did not return what they should\\n", failed);
        return 1;
    }
    printf("PASS: %%d reference poses of %(machine)s\\n", PAIRS);
    return 0;
}
"""


def header_text(source: Source, tables: Tables) -> str:
    """``pkmcal_kinematics.h``."""
    units = source.machine.joint_units
    legs = [f"joint {k + 1} {unit}" for k, unit in enumerate(units)]
    body = _HEADER % {
        "joints": tables.n_joints,
        "rods": tables.n_rods,
        "names": ", ".join(legs),
        "jacobian": "" if tables.shared else _JACOBIAN,
    }
    return c_comment(source.header(*CONVENTIONS)) + body


def selftest_text(source: Source, poses: Array, joints: Array) -> str:
    """``pkmcal_selftest.c``: reference poses (n, 4, 4) and readings (n, m), with starts nearby."""
    n = len(poses)
    starts = perturb(poses, 0.02 * source.machine.layout.motion.sum(axis=1))
    parts = [
        f"#define PAIRS {n}",
        "#define LIMIT 1e-10 /* m and rad; a few digits above the rounding of a double */",
        "",
        c_array("double", "READINGS", "[PAIRS][PKMCAL_JOINTS]", joints),
        _poses("POSES", poses),
        _poses("STARTS", starts),
    ]
    # a machine's name may hold anything; in a string it must not end it
    name = "".join(c for c in source.machine.name if c.isalnum() or c in " -_.")
    about = (
        "Self-test: reference pairs of readings and poses, computed by pkmcal. Compile and run:",
        "cc -std=c99 -O2 pkmcal_selftest.c pkmcal_kinematics.c -lm && ./a.out",
    )
    body = _SELFTEST % {"tables": "\n".join(parts), "machine": name}
    return c_comment([*source.header(), *about]) + body


def _poses(name: str, poses: Array) -> str:
    flat = np.concatenate([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]], axis=1)
    rows = c_array("double", name, "[PAIRS]", flat).replace("const double", "const pkmcal_pose")
    out: list[str] = []
    for line in rows.splitlines():
        if line.startswith("    {"):
            numbers = line.strip().strip("{},").split(", ")
            r = ", ".join("{" + ", ".join(numbers[3 * i : 3 * i + 3]) + "}" for i in range(3))
            comma = "," if line.endswith(",") else ""
            line = "    {{" + r + "}, {" + ", ".join(numbers[9:]) + "}}" + comma
        out.append(line)
    return "\n".join(out) + "\n"
