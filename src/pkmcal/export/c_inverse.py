"""Inverse kinematics and its Jacobian in C: closed, or by Gauss-Newton for shared motors."""

from __future__ import annotations

from pkmcal.export.c_linear import solve_text
from pkmcal.export.c_tables import CRANK, FIXED, SLIDER, Tables

_READING = {
    FIXED: """\
    double d[3];
    int i;
    for (i = 0; i < 3; ++i) {
        d[i] = b[i] - BASE[rod][i];
    }
    *reading = sqrt(dot(d, d)) - LENGTH[rod];
    return PKMCAL_OK;
""",
    SLIDER: """\
    double d[3], middle, square, half;
    int i;
    for (i = 0; i < 3; ++i) {
        d[i] = b[i] - BASE[rod][i];
    }
    middle = dot(d, ALONG[rod]);
    square = LENGTH[rod] * LENGTH[rod] - dot(d, d) + middle * middle;
    if (!(square >= 0.0)) {
        return PKMCAL_OUT_OF_REACH;
    }
    half = sqrt(square);
    *reading = middle >= MIDDLE[rod] ? middle - half : middle + half;
    return PKMCAL_OK;
""",
    CRANK: """\
    double d[3], p, s, reach, share, half, first, second;
    int i;
    for (i = 0; i < 3; ++i) {
        d[i] = b[i] - BASE[rod][i];
    }
    p = dot(d, OUTWARD[rod]);
    s = dot(d, SIDEWAYS[rod]);
    reach = sqrt(p * p + s * s);
    share = dot(d, d) + ARM[rod] * ARM[rod] - LENGTH[rod] * LENGTH[rod];
    share /= 2.0 * ARM[rod] * reach;
    if (!(fabs(share) <= 1.0)) {
        return PKMCAL_OUT_OF_REACH;
    }
    half = acos(share);
    first = nearest(atan2(s, p) + half - ANGLE[rod], MIDDLE[rod]);
    second = nearest(atan2(s, p) - half - ANGLE[rod], MIDDLE[rod]);
    *reading = fabs(first - MIDDLE[rod]) <= fabs(second - MIDDLE[rod]) ? first : second;
    return PKMCAL_OK;
""",
}
_NAMES = {FIXED: "telescope", SLIDER: "slider", CRANK: "crank"}

_NEAREST = """\
/* The angle, of those that differ by whole turns, nearest to another one, rad. */
static double nearest(double angle, double near)
{
    const double turn = 6.283185307179586476925;
    return angle - turn * floor((angle - near) / turn + 0.5);
}

"""

_PLAIN = """\
pkmcal_status pkmcal_inverse(const pkmcal_pose *pose, double joints[PKMCAL_JOINTS])
{
    double found[PKMCAL_JOINTS] = {0.0};
    state at = {*pose%(hinges)s};
    int k, rod;
    if (!all_finite(&pose->R[0][0], 9) || !all_finite(pose->t, 3)) {
        return PKMCAL_BAD_INPUT;
    }
    for (rod = 0; rod < PKMCAL_RODS; ++rod) {
        double arm[3], b[3];
        pkmcal_status status;
        if (JOINT[rod] < 0) {
            continue;
        }
        platform_end(rod, &at, arm, b);
        status = rod_reading(rod, b, &found[JOINT[rod]]);
        if (status != PKMCAL_OK) {
            return status;
        }
    }
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        joints[k] = found[k];
    }
    return PKMCAL_OK;
}

"""

_JACOBIAN = """\
pkmcal_status pkmcal_inverse_jacobian(const pkmcal_pose *pose,
                                      double jacobian[PKMCAL_JOINTS][6])
{
    double joints[PKMCAL_JOINTS];
    state at = {*pose%(hinges)s};
    int i, rod;
    const pkmcal_status status = pkmcal_inverse(pose, joints);
    if (status != PKMCAL_OK) {
        return status;
    }
    for (rod = 0; rod < PKMCAL_RODS; ++rod) {
        double a[3], b[3], u[3], arm[3], moment[3], size, gain;
        if (JOINT[rod] < 0) {
            continue;
        }
        base_end(rod, joints, a);
        platform_end(rod, &at, arm, b);
        size = direction(a, b, u);
        gain = reading_gain(rod, joints, u);
        if (!(size > 0.0) || fabs(gain) < 1e-9) {
            return PKMCAL_SINGULAR; /* the twist tells the rate of no reading */
        }
        cross(arm, u, moment);
        for (i = 0; i < 3; ++i) {
            jacobian[JOINT[rod]][i] = moment[i] / gain;
            jacobian[JOINT[rod]][3 + i] = u[i] / gain;
        }
    }
    return PKMCAL_OK;
}

"""

_DIRECTION = """\
/* Unit direction from a to b; returns their distance, m. */
static double direction(const double a[3], const double b[3], double u[3])
{
    double size;
    int i;
    for (i = 0; i < 3; ++i) {
        u[i] = b[i] - a[i];
    }
    size = sqrt(dot(u, u));
    for (i = 0; i < 3; ++i) {
        u[i] /= size;
    }
    return size;
}

"""

_SHARED = """\
#define INVERSE_UNKNOWNS (PKMCAL_JOINTS + HINGES)

/* Normal equations of the rods for readings and hinges at a pose; returns sum of squares, m^2. */
static double normal_equations(const double joints[PKMCAL_JOINTS], const state *at,
                               double normal[INVERSE_UNKNOWNS][INVERSE_UNKNOWNS],
                               double gradient[INVERSE_UNKNOWNS])
{
    double cost = 0.0;
    int i, k, rod;
    for (i = 0; i < INVERSE_UNKNOWNS; ++i) {
        gradient[i] = 0.0;
        for (k = 0; k < INVERSE_UNKNOWNS; ++k) {
            normal[i][k] = 0.0;
        }
    }
    for (rod = 0; rod < PKMCAL_RODS; ++rod) {
        double a[3], b[3], u[3], arm[3], row[INVERSE_UNKNOWNS] = {0.0}, value;
        base_end(rod, joints, a);
        platform_end(rod, at, arm, b);
        value = direction(a, b, u) - rod_length(rod, joints);
        if (JOINT[rod] >= 0) {
            row[JOINT[rod]] = -reading_gain(rod, joints, u);
        }
%(hinge)s        cost += value * value;
        for (i = 0; i < INVERSE_UNKNOWNS; ++i) {
            gradient[i] += row[i] * value;
            for (k = 0; k < INVERSE_UNKNOWNS; ++k) {
                normal[i][k] += row[i] * row[k];
            }
        }
    }
    return cost;
}

/* Each motor's mean of what its rods would read by themselves. */
static pkmcal_status first_readings(const state *at, double joints[PKMCAL_JOINTS])
{
    int count[PKMCAL_JOINTS] = {0}, k, rod;
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        joints[k] = 0.0;
    }
    for (rod = 0; rod < PKMCAL_RODS; ++rod) {
        double arm[3], b[3], reading = 0.0;
        if (JOINT[rod] < 0) {
            continue;
        }
        platform_end(rod, at, arm, b);
        if (rod_reading(rod, b, &reading) != PKMCAL_OK) {
            return PKMCAL_OUT_OF_REACH;
        }
        joints[JOINT[rod]] += reading;
        ++count[JOINT[rod]];
    }
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        joints[k] /= count[k];
    }
    return PKMCAL_OK;
}

/* Several rods a motor: readings and hinges that fit all rods best, by Gauss-Newton. */
pkmcal_status pkmcal_inverse(const pkmcal_pose *pose, double joints[PKMCAL_JOINTS])
{
    double found[PKMCAL_JOINTS], normal[INVERSE_UNKNOWNS][INVERSE_UNKNOWNS];
    double step[INVERSE_UNKNOWNS], largest = 1.0;
    state at = {*pose%(hinges)s};
    int k, steps;
    pkmcal_status status;
    if (!all_finite(&pose->R[0][0], 9) || !all_finite(pose->t, 3)) {
        return PKMCAL_BAD_INPUT;
    }
%(upright)s    status = first_readings(&at, found);
    for (steps = 0; status == PKMCAL_OK && steps < 15 && largest > 1e-15; ++steps) {
        normal_equations(found, &at, normal, step);
        if (!(solve_inverse(normal, step) > 0.0) || !all_finite(step, INVERSE_UNKNOWNS)) {
            return PKMCAL_SINGULAR;
        }
        largest = 0.0;
        for (k = 0; k < INVERSE_UNKNOWNS; ++k) {
            largest = fmax(largest, fabs(step[k]));
        }
        for (k = 0; k < PKMCAL_JOINTS; ++k) {
            found[k] -= step[k];
        }
%(move)s    }
    for (k = 0; status == PKMCAL_OK && k < PKMCAL_JOINTS; ++k) {
        joints[k] = found[k];
    }
    return status;
}

"""

_SHARED_HINGE = """\
        if (HINGE[rod] >= 0) {
            double rate[3];
            hinge_rate(rod, at, rate);
            row[PKMCAL_JOINTS + HINGE[rod]] = dot(u, rate);
        }
"""
_SHARED_MOVE = """\
        for (k = 0; k < HINGES; ++k) {
            at.hinges[k] -= step[PKMCAL_JOINTS + k];
        }
"""


def inverse_text(t: Tables) -> str:
    """Everything for readings at a pose."""
    hinges = ", {0.0}" if t.n_hinges else ""
    parts = [_NEAREST if CRANK in t.kind else "", _readings_text(t), _DIRECTION, _gain_text(t)]
    if t.shared:
        fill = {
            "hinges": hinges,
            "hinge": _SHARED_HINGE if t.n_hinges else "",
            "move": _SHARED_MOVE if t.n_hinges else "",
            "upright": "    upright(&at);\n" if t.n_hinges else "",
        }
        parts += [solve_text("solve_inverse", "INVERSE_UNKNOWNS"), _SHARED % fill]
        parts[-2] = "#define INVERSE_UNKNOWNS (PKMCAL_JOINTS + HINGES)\n\n" + parts[-2]
        parts[-1] = parts[-1].partition("\n\n")[2]
    else:
        parts += [_PLAIN % {"hinges": hinges}, _JACOBIAN % {"hinges": hinges}]
    return "".join(parts)


def _readings_text(t: Tables) -> str:
    """Functions for the reading that puts a rod's end within its length of b."""
    kinds = sorted({k for k, j in zip(t.kind.tolist(), t.joint.tolist(), strict=True) if j >= 0})
    head = "static pkmcal_status {}(int rod, const double b[3], double *reading)\n{{\n"
    about = "/* The reading at which the rod ends in b. */\n"
    if len(kinds) == 1:
        return about + head.format("rod_reading") + _READING[kinds[0]] + "}\n\n"
    out = "".join(head.format(_NAMES[k] + "_reading") + _READING[k] + "}\n\n" for k in kinds)
    cases = "".join(
        f"    case {k}:\n        return {_NAMES[k]}_reading(rod, b, reading);\n" for k in kinds[1:]
    )
    rest = f"    default:\n        return {_NAMES[kinds[0]]}_reading(rod, b, reading);\n"
    choose = "    switch (KIND[rod]) {\n" + cases + rest + "    }\n}\n\n"
    return out + about + head.format("rod_reading") + choose


_GAINS = {
    FIXED: "return 1.0;",
    SLIDER: "return dot(u, ALONG[rod]);",
    CRANK: (
        "return ARM[rod] * (cos(joints[JOINT[rod]] + ANGLE[rod]) * dot(u, SIDEWAYS[rod])\n"
        "                       - sin(joints[JOINT[rod]] + ANGLE[rod]) * dot(u, OUTWARD[rod]));"
    ),
}


def _gain_text(t: Tables) -> str:
    """How fast a reading lets the rod's far end go along u."""
    kinds = sorted({k for k, j in zip(t.kind.tolist(), t.joint.tolist(), strict=True) if j >= 0})
    if len(kinds) == 1:
        body = f"    {_GAINS[kinds[0]]}\n"
    else:
        body = "".join(
            f"    if (KIND[rod] == {k}) {{\n        {_GAINS[k]}\n    }}\n" for k in kinds
        )
        body += "    return 1.0;\n"
    names = ("rod", "joints", "u")
    unused = [f"    (void){name};\n" for name in names if f"{name}" not in _words(body)]
    return (
        "/* How far the rod's end on the platform goes along u with the reading, m/m or m/rad. */\n"
        "static double reading_gain(int rod, const double joints[PKMCAL_JOINTS],\n"
        "                           const double u[3])\n{\n" + "".join(unused) + body + "}\n\n"
    )


def _words(text: str) -> set[str]:
    return set("".join(c if c.isalnum() or c == "_" else " " for c in text).split())
