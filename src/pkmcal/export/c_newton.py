"""Forward kinematics in C: Newton's method on the closure, damped where it leads nowhere."""

from __future__ import annotations

from pkmcal.export.c_linear import solve_text
from pkmcal.export.c_tables import Tables

_ANCHORS = """\
/* What the readings alone decide: the rods' ends on the base, and their lengths, m. */
typedef struct {
    double a[PKMCAL_RODS][3];
    double length[PKMCAL_RODS];
} anchors;

static void anchor(const double joints[PKMCAL_JOINTS], anchors *out)
{
    int rod;
    for (rod = 0; rod < PKMCAL_RODS; ++rod) {
        base_end(rod, joints, out->a[rod]);
        out->length[rod] = rod_length(rod, joints);
    }
}

"""

_CLOSURE = """\
/* A row of the closure, that a point moves along w: by the platform's freedoms, turns in RADIUS. */
static void set_row(const double moment[3], const double w[3], double row[UNKNOWNS])
{
    double by_twist[6];
    int k;
    for (k = 0; k < 3; ++k) {
        by_twist[k] = moment[k] / RADIUS;
        by_twist[3 + k] = w[k];
    }
    for (k = 0; k < FREEDOMS; ++k) {
        row[k] = by_twist[FREE[k]];
    }
%(clear)s}

/* The closure, m: |b - a| - length of each rod%(and_axes)s, with derivatives.
 * Returns the sum of squares, and the largest in *error. */
static double closure(const anchors *base, const state *at, double value[EQUATIONS],
                      double rows[EQUATIONS][UNKNOWNS], double *error)
{
    double arm[PKMCAL_RODS][3], cost = 0.0;
    int k, rod;
    for (rod = 0; rod < PKMCAL_RODS; ++rod) {
        double b[3], u[3], moment[3];
        platform_end(rod, at, arm[rod], b);
        value[rod] = direction(base->a[rod], b, u) - base->length[rod];
        cross(arm[rod], u, moment);
        set_row(moment, u, rows[rod]);
%(hinge)s    }
%(axes)s    *error = 0.0;
    for (k = 0; k < EQUATIONS; ++k) {
        cost += value[k] * value[k];
        *error = fmax(*error, fabs(value[k]));
    }
    return cost;
}

"""

_HINGE = """\
        if (HINGE[rod] >= 0) {
            double rate[3];
            hinge_rate(rod, at, rate);
            rows[rod][FREEDOMS + HINGE[rod]] = dot(u, rate);
        }
"""
_CLEAR = """\
    for (k = FREEDOMS; k < UNKNOWNS; ++k) {
        row[k] = 0.0;
    }
"""

_AXES = """\
    for (k = 0; k < AXES; ++k) {
        axis_row(base, at, k, arm[AXIS_ROD[k]], &value[PKMCAL_RODS + k], rows[PKMCAL_RODS + k]);
    }
"""

_AXIS_ROW = """\
/* The equation of an axis, m: the rod's line has no part along w. */
static void axis_row(const anchors *base, const state *at, int axis, const double arm[3],
                     double *value, double row[UNKNOWNS])
{
    const int rod = AXIS_ROD[axis];
    double b[3], line[3], moment[3], w[3], unused[3];
    int i;
    platform_end(rod, at, unused, b);
    for (i = 0; i < 3; ++i) {
        line[i] = b[i] - base->a[rod][i];
    }
%(kinds)s    *value = dot(line, w);
}

"""

_SET = """\
    cross(arm, w, moment);
    set_row(moment, w, row);
"""
_ADD = """\
    cross(arm, w, moment);
    for (i = 0; i < 3; ++i) {
        moment[i] += more[i];
    }
    set_row(moment, w, row);
"""
_KINDS = {
    0: """\
    for (i = 0; i < 3; ++i) {
        w[i] = BASE_AXIS[axis][i]; /* revolute on the base: the rod is square to it */
    }
""" + _SET,
    1: """\
    double more[3];
    turned(&at->pose, PLATFORM_AXIS[axis], w); /* revolute on the platform */
    cross(w, line, more);
""" + _ADD,
    2: """\
    double n[3], around[3], more[3];
    turned(&at->pose, PLATFORM_AXIS[axis], n); /* both universal: the rod does not twist */
    cross(BASE_AXIS[axis], n, w);
    cross(line, BASE_AXIS[axis], around);
    cross(n, around, more);
""" + _ADD,
}  # fmt: skip

_MOVE = """\
/* Turns the platform's axes by the rotation vector w, rad, about the base's (Rodrigues). */
static void rotate(double R[3][3], const double w[3])
{
    const double angle2 = dot(w, w);
    double s, c;
    int i, j;
    if (angle2 < 1e-8) {
        s = 1.0 - angle2 / 6.0;
        c = 0.5 - angle2 / 24.0;
    } else {
        const double angle = sqrt(angle2), half = sin(0.5 * angle) / angle;
        s = sin(angle) / angle;
        c = 2.0 * half * half;
    }
    for (j = 0; j < 3; ++j) {
        const double v[3] = {R[0][j], R[1][j], R[2][j]};
        double once[3], twice[3];
        cross(w, v, once);
        cross(w, once, twice);
        for (i = 0; i < 3; ++i) {
            R[i][j] = v[i] + s * once[i] + c * twice[i];
        }
    }
}

/* The state moved back by a share of Newton's step. */
static void move(const state *from, const double step[UNKNOWNS], double share, state *to)
{
    double twist[6] = {0.0};
    int k;
    *to = *from;
    for (k = 0; k < FREEDOMS; ++k) {
        twist[FREE[k]] = -share * step[k];
    }
%(turn)s    for (k = 0; k < 3; ++k) {
        to->pose.t[k] += twist[3 + k];
    }
%(hinges)s}

/* The largest share, up to 1, of a step that turns by less than half a radian and shifts by less
 * than the machine's size. */
static double allowed(const double step[UNKNOWNS])
{
    double largest = 0.0;
    int k;
    for (k = 0; k < UNKNOWNS; ++k) {
        const int turns = k >= FREEDOMS || FREE[k] < 3;
        const double limit = turns ? 0.5%(unit)s : SIZE;
        largest = fmax(largest, fabs(step[k]) / limit);
    }
    return largest > 1.0 ? 1.0 / largest : 1.0;
}

"""

_TURN = """\
    for (k = 0; k < 3; ++k) {
        twist[k] /= RADIUS;
    }
    rotate(to->pose.R, twist);
"""
_MOVE_HINGES = """\
    for (k = 0; k < HINGES; ++k) {
        to->hinges[k] -= share * step[FREEDOMS + k];
    }
"""

_TIDY = """\
/* Makes R a rotation to the last digit, which it must be but for rounding. */
static int tidy(double R[3][3])
{
    double gram[3][3], out[3][3];
    int i, j, k;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            gram[i][j] = R[0][i] * R[0][j] + R[1][i] * R[1][j] + R[2][i] * R[2][j];
            if (!(fabs(gram[i][j] - (i == j ? 1.0 : 0.0)) < 1e-6)) {
                return 0;
            }
        }
    }
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            double sum = 0.0;
            for (k = 0; k < 3; ++k) {
                sum += R[i][k] * ((k == j ? 1.5 : 0.0) - 0.5 * gram[k][j]);
            }
            out[i][j] = sum;
        }
    }
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            R[i][j] = out[i][j];
        }
    }
    return 1;
}

"""

_FORWARD = """\
#define CLOSED (1e-14 * SIZE) /* m, some units in the last place of a length */
#define NEARLY (1e-12 * SIZE) /* m, good enough where no step makes it better */
#define LEAST_SHARE 0.1       /* of Newton's step; where it still overshoots, it is damped */
#define LEAST_PIVOT 1e-9      /* below it not six digits of a step would be right */
#define FIRST_DAMPING 1e-4
#define AT_REST 1e-6 /* share of the squares: a step that saves less leads nowhere */
#define LAST_DAMPING 1e6 /* shifts of less than a thousandth of what is missing */

/* Where the iteration is: the state, and the closure there. */
typedef struct {
    state at;
    double value[EQUATIONS];
    double rows[EQUATIONS][UNKNOWNS];
    double cost;  /* m^2, sum of squares of value */
    double error; /* m, largest of value */
} iterate;

/* Goes on by a share of a step, where that makes the closure better; else returns 0. */
static int improved(const anchors *base, const double step[UNKNOWNS], double share, iterate *now)
{
    iterate trial;
    move(&now->at, step, share, &trial.at);
    trial.cost = closure(base, &trial.at, trial.value, trial.rows, &trial.error);
    if (!(trial.cost < now->cost)) {
        return 0;
    }
    *now = trial;
    return 1;
}

/* One step of Newton's method, or half of it, and so on; returns 0 where none is better. */
static int newton(const anchors *base, iterate *now, double *pivot)
{
    double rows[EQUATIONS][UNKNOWNS], step[UNKNOWNS], share;
    int i, k;
    for (i = 0; i < UNKNOWNS; ++i) {
        step[i] = now->value[i];
        for (k = 0; k < UNKNOWNS; ++k) {
            rows[i][k] = now->rows[i][k];
        }
    }
    *pivot = solve(rows, step);
    if (!(*pivot > LEAST_PIVOT)) {
        return 0;
    }
    for (share = allowed(step); share > LEAST_SHARE; share *= 0.5) {
        if (improved(base, step, share, now)) {
            return 1;
        }
    }
    return 0;
}

/* One step of Levenberg's and Marquardt's method, for starts from which Newton's leads nowhere. */
static int damped(const anchors *base, iterate *now)
{
    double lambda;
    int i, j, k;
    for (lambda = FIRST_DAMPING; lambda < LAST_DAMPING; lambda *= 10.0) {
        double normal[UNKNOWNS][UNKNOWNS], step[UNKNOWNS];
        for (i = 0; i < UNKNOWNS; ++i) {
            step[i] = 0.0;
            for (k = 0; k < EQUATIONS; ++k) {
                step[i] += now->rows[k][i] * now->value[k];
            }
            for (j = 0; j < UNKNOWNS; ++j) {
                normal[i][j] = 0.0;
                for (k = 0; k < EQUATIONS; ++k) {
                    normal[i][j] += now->rows[k][i] * now->rows[k][j];
                }
            }
            normal[i][i] *= 1.0 + lambda;
        }
        if (solve(normal, step) > 0.0 && improved(base, step, allowed(step), now)) {
            return 1;
        }
    }
    return 0;
}

pkmcal_status pkmcal_forward(const double joints[PKMCAL_JOINTS], pkmcal_pose *pose,
                             pkmcal_report *report)
{
    iterate now;
    anchors base;
    double pivot = 0.0, before;
    int steps = 0, moved = 1;
    pkmcal_status status = PKMCAL_NOT_CONVERGED;
    now.at.pose = *pose;
    if (!all_finite(joints, PKMCAL_JOINTS) || !all_finite(pose->t, 3)
        || !tidy(now.at.pose.R)) {
        return PKMCAL_BAD_INPUT;
    }
%(upright)s    anchor(joints, &base);
    now.cost = closure(&base, &now.at, now.value, now.rows, &now.error);
    do {
        ++steps;
        before = now.cost;
        moved = newton(&base, &now, &pivot);
        if (!moved && now.error > NEARLY) {
            moved = damped(&base, &now);
        }
        if (now.error > NEARLY && now.cost > (1.0 - AT_REST) * before) {
            moved = 0;
        }
    } while (moved && now.error > CLOSED && steps < PKMCAL_MOST_STEPS);
    if (now.error < NEARLY) {
        status = pivot > LEAST_PIVOT ? PKMCAL_OK : PKMCAL_SINGULAR;
    } else if (!moved) {
        status = PKMCAL_OUT_OF_REACH;
    }
    if (status == PKMCAL_OK) {
        *pose = now.at.pose;
    }
    if (report) {
        report->steps = steps;
        report->error = now.error;
        report->pivot = pivot;
    }
    return status;
}
"""


def newton_text(t: Tables) -> str:
    """Everything for the pose at readings."""
    hinged, axes = bool(t.n_hinges), bool(len(t.angle_rod))
    turns = any(k < 3 for k in t.freedoms)
    fill = {
        "clear": _CLEAR if hinged else "",
        "and_axes": ", then the axes' equations" if axes else "",
        "hinge": _HINGE if hinged else "",
        "axes": _AXES if axes else "",
        "turn": _TURN if turns else "",
        "hinges": _MOVE_HINGES if hinged else "",
        "unit": " * (k < FREEDOMS ? RADIUS : 1.0)" if turns else "",
    }
    closure = _CLOSURE % fill
    if axes:
        first, rest = closure.split("/* The closure, m:")
        closure = first + _axis_text(t) + "/* The closure, m:" + rest
    moving = _MOVE % fill
    if not turns:
        moving = moving[moving.index("/* The state moved back") :]
    start = "    upright(&now.at);\n" if hinged else ""
    parts = (solve_text("solve", "UNKNOWNS"), _ANCHORS, closure, moving, _TIDY)
    return "".join(parts) + _FORWARD % {"upright": start}


def _axis_text(t: Tables) -> str:
    kinds = sorted(set(t.angle_kind.tolist()))
    if len(kinds) == 1:
        return _AXIS_ROW % {"kinds": _KINDS[kinds[0]]}
    cases: list[str] = []
    for k in kinds:
        body = "".join(f"    {line}\n" for line in _KINDS[k].splitlines())
        cases.append(f"if (AXIS_KIND[axis] == {k}) {{\n{body}    }}")
    return _AXIS_ROW % {"kinds": "    " + " else ".join(cases) + "\n"}
