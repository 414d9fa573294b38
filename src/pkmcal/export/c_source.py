"""The C source of a machine: its constants, inverse kinematics and Newton's forward kinematics.

The text is put together from the parts that the machine has, so that what is written is what runs:
no crank's formula in a hexapod's file. Formulas: [B] eq. 4 (rods), [C] eq. 2 in the form of the
errata's Model 31 (cranks), [A] eq. 7 (axes); see :mod:`pkmcal.mechanisms.carriers`.
"""

from __future__ import annotations

from pkmcal.export.c_header import CONVENTIONS, HEADER
from pkmcal.export.c_inverse import inverse_text
from pkmcal.export.c_newton import newton_text
from pkmcal.export.c_tables import CRANK, FIXED, SLIDER, Tables
from pkmcal.export.source import Source
from pkmcal.export.text import c_array, c_comment, c_number, sigma_lines

_VECTORS = """\
static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void turned(const pkmcal_pose *pose, const double v[3], double out[3])
{
    int i;
    for (i = 0; i < 3; ++i) {
        out[i] = pose->R[i][0] * v[0] + pose->R[i][1] * v[1] + pose->R[i][2] * v[2];
    }
}

static int all_finite(const double *values, int count)
{
    int k;
    for (k = 0; k < count; ++k) {
        if (!isfinite(values[k])) {
            return 0;
        }
    }
    return 1;
}

"""

_BASE_CASES = {
    FIXED: "a[i] = BASE[rod][i];",
    SLIDER: "a[i] = BASE[rod][i] + joints[JOINT[rod]] * ALONG[rod][i];",
    CRANK: "a[i] = BASE[rod][i] + ARM[rod] * (c * OUTWARD[rod][i] + s * SIDEWAYS[rod][i]);",
}
_CRANK_TURN = """\
    const double turn = joints[JOINT[rod]] + ANGLE[rod];
    const double c = cos(turn), s = sin(turn);
"""


def source_text(source: Source, tables: Tables) -> str:
    """``pkmcal_kinematics.c``."""
    about = [
        *source.header(*CONVENTIONS),
        "",
        "Parameters (sigma: standard deviation of sampling, not of what the model leaves out;"
        " held: by the choice of frames, or by the mechanism file):",
        *sigma_lines(source),
    ]
    parts = (
        c_comment(about),
        f'#include "{HEADER}"\n\n#include <math.h>\n\n',
        constants_text(tables),
        _VECTORS,
        _ends_text(tables),
        _home_text(tables),
        inverse_text(tables),
        newton_text(tables),
    )
    return "".join(parts)


def constants_text(tables: Tables) -> str:
    """The machine's numbers, 17 significant digits each."""
    t, by_rod = tables, "[PKMCAL_RODS]"
    kinds = set(t.kind.tolist())
    legs = ", ".join(map(str, t.leg))
    out = [
        f"#define EQUATIONS {t.n_equations}\n#define UNKNOWNS {t.n_unknowns}\n"
        f"#define FREEDOMS {len(t.freedoms)}\n#define HINGES {t.n_hinges}\n"
        f"#define SIZE {c_number(t.size)} /* m, the machine's size */\n"
        f"#define RADIUS {c_number(t.radius)} /* m, the platform's: makes turns lengths */\n",
        f"/* Rods are legs {legs} of the mechanism file. */\n",
        c_array("double", "BASE", by_rod + "[3]", t.base, _BASE_NOTES[max(kinds)]),
    ]
    if SLIDER in kinds:
        out.append(c_array("double", "ALONG", by_rod + "[3]", t.along, "unit axes, base frame"))
    if CRANK in kinds:
        out += [
            c_array("double", "OUTWARD", by_rod + "[3]", t.outward, "arms at angle 0, unit"),
            c_array("double", "SIDEWAYS", by_rod + "[3]", t.sideways, "arms at angle pi/2, unit"),
            c_array("double", "ARM", by_rod, t.arm, "m"),
            c_array("double", "ANGLE", by_rod, t.angle, "rad, at reading 0"),
        ]
    out.append(_platform_constants(t))
    note = "m: the offset of rods that readings lengthen, else the length"
    out.append(c_array("double", "LENGTH", by_rod, t.length, note))
    out.append(c_array("int", "JOINT", by_rod, t.joint, "column of the reading, -1 without"))
    if t.reads.any() and not t.reads.all():
        note = "1 where the reading lengthens the rod"
        out.append(c_array("int", "READS", by_rod, t.reads, note))
    if kinds != {FIXED}:
        out.append(c_array("double", "MIDDLE", by_rod, t.middle, "mid-range readings"))
    if len(kinds) > 1:
        note = "carrier: 0 fixed, 1 slider, 2 crank"
        out.append(c_array("int", "KIND", by_rod, t.kind, note))
    if t.n_hinges:
        out.append(c_array("int", "HINGE", by_rod, t.hinge, "the bar's hinge, -1 without"))
    out.append(_axes_constants(t))
    return "\n".join(part for part in out if part) + "\n"


_BASE_NOTES = {
    FIXED: "m, joint centres on the base, base frame",
    SLIDER: "m, joint centres (of sliders at reading 0), base frame",
    CRANK: "m, joint centres (of cranks the foot of the arm on its axis), base frame",
}


def _platform_constants(t: Tables) -> str:
    by_rod = "[PKMCAL_RODS][3]"
    note = "m, joint centres on the platform, platform frame"
    out = [c_array("double", "PLATFORM", by_rod, t.arm_fixed, note)]
    if t.floating.any():
        out.append(c_array("double", "BAR", by_rod, t.floating, "m, added along the base's axes"))
    if t.n_hinges:
        out.append(c_array("double", "HINGE_COS", by_rod, t.arm_cos, "m, times cos(hinge)"))
        out.append(c_array("double", "HINGE_SIN", by_rod, t.arm_sin, "m, times sin(hinge)"))
        note = "unit, platform frame"
        out.append(c_array("double", "HINGE_AXIS", "[HINGES][3]", t.hinge_axes, note))
    note = "of omega_x, omega_y, omega_z, tau_x, tau_y, tau_z those that the platform has"
    return "\n".join(out) + f"\n/* {note} */\n" + _freedoms(t)


def _freedoms(t: Tables) -> str:
    return f"static const int FREE[FREEDOMS] = {{{', '.join(map(str, t.freedoms))}}};\n"


def _axes_constants(t: Tables) -> str:
    n = len(t.angle_rod)
    if not n:
        return ""
    kinds = set(t.angle_kind.tolist())
    out = [f"#define AXES {n} /* equations of joints' axes, below the rods' */\n"]
    out.append(c_array("int", "AXIS_ROD", "[AXES]", t.angle_rod))
    if kinds & {0, 2}:
        out.append(c_array("double", "BASE_AXIS", "[AXES][3]", t.angle_base, "unit, base frame"))
    if kinds & {1, 2}:
        note = "unit, platform frame"
        out.append(c_array("double", "PLATFORM_AXIS", "[AXES][3]", t.angle_platform, note))
    if len(kinds) > 1:
        note = "0 on the base, 1 on the platform, 2 torsion"
        out.append(c_array("int", "AXIS_KIND", "[AXES]", t.angle_kind, note))
    return "\n".join(out)


def _ends_text(t: Tables) -> str:
    """Functions of a rod's two ends and its length."""
    kinds = sorted(set(t.kind.tolist()))
    loop = "    for (i = 0; i < 3; ++i) {{\n        {}\n    }}\n"
    unused = "" if max(kinds) else "    (void)joints;\n"
    if len(kinds) == 1:
        turn = _CRANK_TURN if kinds[0] == CRANK else ""
        body = turn + "    int i;\n" + unused + loop.format(_BASE_CASES[kinds[0]])
    else:
        turn = ""
        if CRANK in kinds:
            turn = "    double c = 1.0, s = 0.0;\n"
        body = turn + "    int i;\n"
        if CRANK in kinds:
            body += (
                "    if (KIND[rod] == 2) {\n"
                "        const double turn = joints[JOINT[rod]] + ANGLE[rod];\n"
                "        c = cos(turn);\n        s = sin(turn);\n    }\n"
            )
        cases = [
            f"if (KIND[rod] == {k}) {{\n            {_BASE_CASES[k]}\n        }}" for k in kinds
        ]
        body += loop.format(" else ".join(cases))
    base = (
        "/* The rod's end on the base, m, base frame. */\n"
        "static void base_end(int rod, const double joints[PKMCAL_JOINTS], double a[3])\n"
        "{\n" + body + "}\n\n"
    )
    return base + _length_text(t) + _platform_end_text(t)


def _length_text(t: Tables) -> str:
    if t.reads.all():
        value, unused = "joints[JOINT[rod]] + LENGTH[rod]", ""
    elif t.reads.any():
        value, unused = "LENGTH[rod] + (READS[rod] ? joints[JOINT[rod]] : 0.0)", ""
    else:
        value, unused = "LENGTH[rod]", "    (void)joints;\n"
    return (
        "/* The rod's length, m. */\n"
        "static double rod_length(int rod, const double joints[PKMCAL_JOINTS])\n"
        "{\n" + unused + f"    return {value};\n}}\n\n"
    )


def _platform_end_text(t: Tables) -> str:
    hinged = bool(t.n_hinges)
    member = "    double hinges[HINGES]; /* rad */\n" if hinged else ""
    own, before, after = "PLATFORM[rod]", "", ""
    if hinged:
        own = "own"
        before = _HINGED_ARM
        after = _HINGE_RATE
    extra = " + BAR[rod][i]" if t.floating.any() else ""
    return _PLATFORM_END % {"member": member, "before": before, "own": own, "extra": extra} + after


_PLATFORM_END = """\
/* Where the platform is. */
typedef struct {
    pkmcal_pose pose;
%(member)s} state;

/* The rod's end on the platform: b the point, arm what turns with the platform, m, base frame. */
static void platform_end(int rod, const state *at, double arm[3], double b[3])
{
    int i;
%(before)s    turned(&at->pose, %(own)s, arm);
    for (i = 0; i < 3; ++i) {
        b[i] = at->pose.t[i] + arm[i]%(extra)s;
    }
}

"""

_HINGED_ARM = """\
    const double c = HINGE[rod] < 0 ? 1.0 : cos(at->hinges[HINGE[rod]]);
    const double s = HINGE[rod] < 0 ? 0.0 : sin(at->hinges[HINGE[rod]]);
    double own[3];
    for (i = 0; i < 3; ++i) {
        own[i] = PLATFORM[rod][i] + c * HINGE_COS[rod][i] + s * HINGE_SIN[rod][i];
    }
"""

_HINGE_RATE = """\
/* Hinges turned back by the platform's turn about them, so that the bars keep their directions:
 * where an articulated platform stands, about. */
static void upright(state *at)
{
    const pkmcal_pose *p = &at->pose;
    const double axial[3] = {p->R[2][1] - p->R[1][2], p->R[0][2] - p->R[2][0],
                             p->R[1][0] - p->R[0][1]};
    const double real = 1.0 + p->R[0][0] + p->R[1][1] + p->R[2][2];
    int k;
    for (k = 0; k < HINGES; ++k) {
        at->hinges[k] = -2.0 * atan2(dot(axial, HINGE_AXIS[k]), real);
    }
}

/* Derivative of the rod's end on the platform by its hinge, m/rad. */
static void hinge_rate(int rod, const state *at, double out[3])
{
    const double c = cos(at->hinges[HINGE[rod]]), s = sin(at->hinges[HINGE[rod]]);
    double own[3];
    int i;
    for (i = 0; i < 3; ++i) {
        own[i] = c * HINGE_SIN[rod][i] - s * HINGE_COS[rod][i];
    }
    turned(&at->pose, own, out);
}

"""


def _home_text(t: Tables) -> str:
    rows = ",\n         ".join(
        "{" + ", ".join(c_number(v) for v in row) + "}" for row in t.home[:3, :3]
    )
    shift = ", ".join(c_number(v) for v in t.home[:3, 3])
    return (
        "void pkmcal_home(pkmcal_pose *pose)\n{\n"
        "    static const pkmcal_pose home = {\n"
        f"        {{{rows}}},\n        {{{shift}}}\n    }};\n"
        "    *pose = home;\n}\n\n" + _RANGE % _ranges(t) + _STATUS
    )


def _ranges(t: Tables) -> str:
    bounds = [
        "{"
        + ", ".join(
            c_number(v) if v == v else "-HUGE_VAL" if k == 0 else "HUGE_VAL"
            for k, v in enumerate(row)
        )
        + "}"
        for row in t.ranges.tolist()
    ]
    return ",\n        ".join(bounds)


_RANGE = """\
int pkmcal_out_of_range(const double joints[PKMCAL_JOINTS])
{
    static const double range[PKMCAL_JOINTS][2] = {
        %s
    };
    /* a reading on its limit is within, by its last digits */
    const double slack = 1e-12;
    int k;
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        if (!(joints[k] >= range[k][0] - slack && joints[k] <= range[k][1] + slack)) {
            return k + 1;
        }
    }
    return 0;
}

"""

_STATUS = """\
const char *pkmcal_status_text(pkmcal_status status)
{
    switch (status) {
    case PKMCAL_OK:
        return "ok";
    case PKMCAL_NOT_CONVERGED:
        return "no convergence: begin nearer to the pose";
    case PKMCAL_SINGULAR:
        return "singular: the platform is not held by its rods";
    case PKMCAL_OUT_OF_REACH:
        return "out of reach";
    case PKMCAL_BAD_INPUT:
        return "bad input: not finite, or no rotation";
    }
    return "unknown status";
}

"""
