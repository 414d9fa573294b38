/*
 * Machine gough-stewart, exported by pkmcal 0.1.0 from the built-in machine gough-stewart, values
 * 83784bb4.
 * Nominal model only, not calibrated.
 * Frames: as in the mechanism file.
 * Units: m and rad.
 * pose: R and t map platform coordinates to base coordinates, p_base = R p_platform + t.
 * twist: omega_x, omega_y, omega_z (rad/s), tau_x, tau_y, tau_z (m/s): R changes by omega x R, t
 * by tau, both along the base frame's axes.
 * length of a rod = scale * reading + offset, less what a screw adds that the joints turn; a
 * slide's way and a crank's turn are scale * reading. Readings in the order of the machine's
 * columns.
 * C99, math.h alone; no memory is allotted, nothing but the arguments is written, so that all
 * functions can run at once in several threads. Do not compile with -ffast-math.
 *
 * Parameters (sigma: standard deviation of sampling, and of model errors as far as residuals show
 * them; held: by the choice of frames, or by the mechanism file):
 * legs[1].base.center.x = 0.2693 m
 * legs[1].base.center.y = 0.02 m
 * legs[1].base.center.z = 0 m
 * legs[1].platform.center.x = 0.1143 m
 * legs[1].platform.center.y = 0.158 m
 * legs[1].platform.center.z = 0 m
 * legs[1].length.offset = 0 m
 * legs[1].scale = 1
 * legs[1].tubes[1].radius = 0.014 m
 * legs[1].tubes[2].radius = 0.009 m
 * legs[2].base.center.x = 0.2693 m
 * legs[2].base.center.y = -0.02 m
 * legs[2].base.center.z = 0 m
 * legs[2].platform.center.x = 0.1143 m
 * legs[2].platform.center.y = -0.158 m
 * legs[2].platform.center.z = 0 m
 * legs[2].length.offset = 0 m
 * legs[2].scale = 1
 * legs[2].tubes[1].radius = 0.014 m
 * legs[2].tubes[2].radius = 0.009 m
 * legs[3].base.center.x = -0.152 m
 * legs[3].base.center.y = 0.2232 m
 * legs[3].base.center.z = 0 m
 * legs[3].platform.center.x = -0.194 m
 * legs[3].platform.center.y = 0.02 m
 * legs[3].platform.center.z = 0 m
 * legs[3].length.offset = 0 m
 * legs[3].scale = 1
 * legs[3].tubes[1].radius = 0.014 m
 * legs[3].tubes[2].radius = 0.009 m
 * legs[4].base.center.x = -0.1173 m
 * legs[4].base.center.y = 0.2432 m
 * legs[4].base.center.z = 0 m
 * legs[4].platform.center.x = 0.0796 m
 * legs[4].platform.center.y = 0.178 m
 * legs[4].platform.center.z = 0 m
 * legs[4].length.offset = 0 m
 * legs[4].scale = 1
 * legs[4].tubes[1].radius = 0.014 m
 * legs[4].tubes[2].radius = 0.009 m
 * legs[5].base.center.x = -0.1173 m
 * legs[5].base.center.y = -0.2432 m
 * legs[5].base.center.z = 0 m
 * legs[5].platform.center.x = 0.0796 m
 * legs[5].platform.center.y = -0.178 m
 * legs[5].platform.center.z = 0 m
 * legs[5].length.offset = 0 m
 * legs[5].scale = 1
 * legs[5].tubes[1].radius = 0.014 m
 * legs[5].tubes[2].radius = 0.009 m
 * legs[6].base.center.x = -0.152 m
 * legs[6].base.center.y = -0.2232 m
 * legs[6].base.center.z = 0 m
 * legs[6].platform.center.x = -0.194 m
 * legs[6].platform.center.y = -0.02 m
 * legs[6].platform.center.z = 0 m
 * legs[6].length.offset = 0 m
 * legs[6].scale = 1
 * legs[6].tubes[1].radius = 0.014 m
 * legs[6].tubes[2].radius = 0.009 m
 */
#include "pkmcal_kinematics.h"

#include <math.h>

/* sqrt or sqrtf, 0.5 or 0.5F: by the type of numbers that the header names. */
#ifdef PKMCAL_FLOAT
#define MATH(name) name##f
#else
#define MATH(name) name
#endif
#define REAL(number) PKMCAL_NUMBER(number)

/* The square root of the type's epsilon: what is left of numbers that lost half of their digits. */
#define HALF_DIGITS MATH(sqrt)(PKMCAL_EPSILON)

/* What a reading moves: a rod's length; its end on the base, along an axis or about one; nothing,
 * where the rod has none. */
enum { CONSTANT, TELESCOPE, SLIDE, TURN };

/* A rod between a on the base and b on the platform, with q = scale * reading what its motor has
 * moved, and phi the turn of the bar that it ends on, if it ends on one:
 *   a = base, base + q rate (SLIDE), or base + cos(q) arm + sin(q) rate (TURN), base frame;
 *   b = t + R (platform + cos(phi) swing + sin(phi) swing_rate) + floating;
 *   |b - a| = length, or length + q - growth phi (TELESCOPE), with phi the turn about the rod from
 *   the base's axis to the platform's, modulo pi: what a screw adds that the joints turn.
 * What a rod has not is zero. */
typedef struct {
    int drive;
    int joint;                 /* column of the reading */
    int hinge;                 /* of the bar that turns, from 1; 0 without */
    pkmcal_real scale;         /* of the reading */
    pkmcal_real middle;        /* m or rad, q at mid-range, of a SLIDE or TURN */
    pkmcal_real length;        /* m */
    pkmcal_real base[3];       /* m, joint centre, its place at reading 0, or its arm's foot */
    pkmcal_real arm[3];        /* m, from the foot to the end at reading 0, square to the axis */
    pkmcal_real rate[3];       /* m/m or m/rad, how the end moves at reading 0 */
    pkmcal_real platform[3];   /* m, platform frame: joint centre, or the bar's foot on its hinge */
    pkmcal_real hinge_axis[3]; /* unit, platform frame */
    pkmcal_real swing[3];      /* m, platform frame: from the foot to the end at phi = 0 */
    pkmcal_real swing_rate[3]; /* m/rad */
    pkmcal_real floating[3];   /* m, base frame: on a bar that keeps its direction */
    pkmcal_real growth;        /* m/rad, of a screw that the joints turn: lead / (2 pi) */
    pkmcal_real base_axis[3];  /* unit, base frame: the joint's axis; of a screw */
    pkmcal_real platform_axis[3]; /* unit, platform frame */
} rod_data;

/* An equation of a joint's axis: the rod has no part along w, which is the base's axis, the
 * platform's, or for two universal joints, so that the rod does not twist, square to both. */
enum { ON_BASE, ON_PLATFORM, TORSION };

typedef struct {
    int rod; /* from 0 */
    int kind;
    pkmcal_real base[3];     /* unit, base frame */
    pkmcal_real platform[3]; /* unit, platform frame */
} axis_data;

/* ---- the machine ---- */

#define FREEDOMS 6
#define HINGES 0
#define AXES 0
#define SIZE REAL(0.3594120707541285) /* m, the machine's size */
#define RADIUS REAL(0.19500824483994403) /* m, the platform's: makes turns lengths */

/* of omega_x, omega_y, omega_z, tau_x, tau_y, tau_z those that the platform has */
static const int FREE[FREEDOMS] = {0, 1, 2, 3, 4, 5};

static const rod_data RODS[PKMCAL_RODS] = {
    /* leg 1 of the mechanism file */
    {
        TELESCOPE, /* drive */
        0, /* joint */
        0, /* hinge */
        1, /* scale */
        0, /* middle */
        0, /* length */
        {REAL(0.2693), REAL(0.02), 0}, /* base */
        {0, 0, 0}, /* arm */
        {0, 0, 0}, /* rate */
        {REAL(0.1143), REAL(0.158), 0}, /* platform */
        {0, 0, 0}, /* hinge_axis */
        {0, 0, 0}, /* swing */
        {0, 0, 0}, /* swing_rate */
        {0, 0, 0}, /* floating */
        0, /* growth */
        {0, 0, 0}, /* base_axis */
        {0, 0, 0}, /* platform_axis */
    },
    /* leg 2 of the mechanism file */
    {
        TELESCOPE, /* drive */
        1, /* joint */
        0, /* hinge */
        1, /* scale */
        0, /* middle */
        0, /* length */
        {REAL(0.2693), REAL(-0.02), 0}, /* base */
        {0, 0, 0}, /* arm */
        {0, 0, 0}, /* rate */
        {REAL(0.1143), REAL(-0.158), 0}, /* platform */
        {0, 0, 0}, /* hinge_axis */
        {0, 0, 0}, /* swing */
        {0, 0, 0}, /* swing_rate */
        {0, 0, 0}, /* floating */
        0, /* growth */
        {0, 0, 0}, /* base_axis */
        {0, 0, 0}, /* platform_axis */
    },
    /* leg 3 of the mechanism file */
    {
        TELESCOPE, /* drive */
        2, /* joint */
        0, /* hinge */
        1, /* scale */
        0, /* middle */
        0, /* length */
        {REAL(-0.152), REAL(0.2232), 0}, /* base */
        {0, 0, 0}, /* arm */
        {0, 0, 0}, /* rate */
        {REAL(-0.194), REAL(0.02), 0}, /* platform */
        {0, 0, 0}, /* hinge_axis */
        {0, 0, 0}, /* swing */
        {0, 0, 0}, /* swing_rate */
        {0, 0, 0}, /* floating */
        0, /* growth */
        {0, 0, 0}, /* base_axis */
        {0, 0, 0}, /* platform_axis */
    },
    /* leg 4 of the mechanism file */
    {
        TELESCOPE, /* drive */
        3, /* joint */
        0, /* hinge */
        1, /* scale */
        0, /* middle */
        0, /* length */
        {REAL(-0.1173), REAL(0.2432), 0}, /* base */
        {0, 0, 0}, /* arm */
        {0, 0, 0}, /* rate */
        {REAL(0.0796), REAL(0.178), 0}, /* platform */
        {0, 0, 0}, /* hinge_axis */
        {0, 0, 0}, /* swing */
        {0, 0, 0}, /* swing_rate */
        {0, 0, 0}, /* floating */
        0, /* growth */
        {0, 0, 0}, /* base_axis */
        {0, 0, 0}, /* platform_axis */
    },
    /* leg 5 of the mechanism file */
    {
        TELESCOPE, /* drive */
        4, /* joint */
        0, /* hinge */
        1, /* scale */
        0, /* middle */
        0, /* length */
        {REAL(-0.1173), REAL(-0.2432), 0}, /* base */
        {0, 0, 0}, /* arm */
        {0, 0, 0}, /* rate */
        {REAL(0.0796), REAL(-0.178), 0}, /* platform */
        {0, 0, 0}, /* hinge_axis */
        {0, 0, 0}, /* swing */
        {0, 0, 0}, /* swing_rate */
        {0, 0, 0}, /* floating */
        0, /* growth */
        {0, 0, 0}, /* base_axis */
        {0, 0, 0}, /* platform_axis */
    },
    /* leg 6 of the mechanism file */
    {
        TELESCOPE, /* drive */
        5, /* joint */
        0, /* hinge */
        1, /* scale */
        0, /* middle */
        0, /* length */
        {REAL(-0.152), REAL(-0.2232), 0}, /* base */
        {0, 0, 0}, /* arm */
        {0, 0, 0}, /* rate */
        {REAL(-0.194), REAL(-0.02), 0}, /* platform */
        {0, 0, 0}, /* hinge_axis */
        {0, 0, 0}, /* swing */
        {0, 0, 0}, /* swing_rate */
        {0, 0, 0}, /* floating */
        0, /* growth */
        {0, 0, 0}, /* base_axis */
        {0, 0, 0}, /* platform_axis */
    },
};

/* one row at least */
static const axis_data AXIS[AXES + 1] = {
    {0, ON_BASE, {0, 0, 0}, {0, 0, 0}},
};

static const pkmcal_pose HOME = {{{REAL(0.9999999999935725), REAL(-9.538738027025746e-17), REAL(-3.5854207794893586e-06)},
    {REAL(9.538730029697638e-17), 1, REAL(-2.2305302258447904e-17)},
    {REAL(3.5854207794893586e-06), REAL(2.2304960254695947e-17), REAL(0.9999999999935725)}},
    {REAL(6.882556461363615e-05), REAL(-3.063819061092704e-17), REAL(0.3594120707541285)}};

/* m or rad, by the mechanism file */
static const pkmcal_real RANGE[PKMCAL_JOINTS][2] = {
    {REAL(0.345), REAL(0.485)},
    {REAL(0.345), REAL(0.485)},
    {REAL(0.345), REAL(0.485)},
    {REAL(0.345), REAL(0.485)},
    {REAL(0.345), REAL(0.485)},
    {REAL(0.345), REAL(0.485)}
};

/* ---- what follows is the same for every machine ---- */

#define EQUATIONS (PKMCAL_RODS + AXES)
#define UNKNOWNS (FREEDOMS + HINGES)
#define INVERSE_UNKNOWNS (PKMCAL_JOINTS + HINGES)
#define MOST_UNKNOWNS (UNKNOWNS > INVERSE_UNKNOWNS ? UNKNOWNS : INVERSE_UNKNOWNS)

/* Where the platform is, and its bars. */
typedef struct {
    pkmcal_pose pose;
    pkmcal_real hinges[HINGES + 1]; /* rad; C has no arrays of none */
} state;

/* ---- vectors and linear equations ---- */

static pkmcal_real dot(const pkmcal_real a[3], const pkmcal_real b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const pkmcal_real a[3], const pkmcal_real b[3], pkmcal_real out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void turned(const pkmcal_pose *pose, const pkmcal_real v[3], pkmcal_real out[3])
{
    int i;
    for (i = 0; i < 3; ++i) {
        out[i] = pose->R[i][0] * v[0] + pose->R[i][1] * v[1] + pose->R[i][2] * v[2];
    }
}

/* Unit direction from a to b; returns their distance, m. */
static pkmcal_real direction(const pkmcal_real a[3], const pkmcal_real b[3], pkmcal_real u[3])
{
    pkmcal_real size;
    int i;
    for (i = 0; i < 3; ++i) {
        u[i] = b[i] - a[i];
    }
    size = MATH(sqrt)(dot(u, u));
    for (i = 0; i < 3; ++i) {
        u[i] /= size;
    }
    return size;
}

static int all_finite(const pkmcal_real *values, int count)
{
    int k;
    for (k = 0; k < count; ++k) {
        if (!isfinite(values[k])) {
            return 0;
        }
    }
    return 1;
}

/* Solves m x = v, n of them, x in v's place, with partial pivoting; m is lost. Returns the smallest
 * pivot. */
static pkmcal_real solve(int n, pkmcal_real m[][MOST_UNKNOWNS], pkmcal_real v[])
{
    pkmcal_real least = INFINITY;
    int i, j, k;
    for (k = 0; k < n; ++k) {
        int best = k;
        for (i = k + 1; i < n; ++i) {
            if (MATH(fabs)(m[i][k]) > MATH(fabs)(m[best][k])) {
                best = i;
            }
        }
        if (best != k) {
            const pkmcal_real held = v[k];
            v[k] = v[best];
            v[best] = held;
            for (j = k; j < n; ++j) {
                const pkmcal_real moved = m[k][j];
                m[k][j] = m[best][j];
                m[best][j] = moved;
            }
        }
        if (!(MATH(fabs)(m[k][k]) > 0)) {
            return 0;
        }
        least = MATH(fmin)(least, MATH(fabs)(m[k][k]));
        for (i = k + 1; i < n; ++i) {
            const pkmcal_real factor = m[i][k] / m[k][k];
            for (j = k + 1; j < n; ++j) {
                m[i][j] -= factor * m[k][j];
            }
            v[i] -= factor * v[k];
        }
    }
    for (k = n - 1; k >= 0; --k) {
        for (j = k + 1; j < n; ++j) {
            v[k] -= m[k][j] * v[j];
        }
        v[k] /= m[k][k];
    }
    return least;
}

/* ---- a rod's ends and length ---- */

/* What the rod's motor has moved, m or rad. */
static pkmcal_real joint_value(const rod_data *rod, const pkmcal_real joints[PKMCAL_JOINTS])
{
    return rod->scale * joints[rod->joint];
}

/* The rod's end on the base, m, base frame. */
static void base_end(const rod_data *rod, const pkmcal_real joints[PKMCAL_JOINTS], pkmcal_real a[3])
{
    pkmcal_real by_arm = 0, by_rate = 0;
    int i;
    if (rod->drive == SLIDE) {
        by_rate = joint_value(rod, joints);
    } else if (rod->drive == TURN) {
        by_arm = MATH(cos)(joint_value(rod, joints));
        by_rate = MATH(sin)(joint_value(rod, joints));
    }
    for (i = 0; i < 3; ++i) {
        a[i] = rod->base[i] + by_arm * rod->arm[i] + by_rate * rod->rate[i];
    }
}

/* The rod's length, m. */
static pkmcal_real rod_length(const rod_data *rod, const pkmcal_real joints[PKMCAL_JOINTS])
{
    return rod->drive == TELESCOPE ? rod->length + joint_value(rod, joints) : rod->length;
}

/* The rod's end on the platform: b the point, arm what turns with the platform, m, base frame. */
static void platform_end(const rod_data *rod, const state *at, pkmcal_real arm[3], pkmcal_real b[3])
{
    int i;
    if (HINGES > 0 && rod->hinge > 0) {
        const pkmcal_real phi = at->hinges[rod->hinge - 1], c = MATH(cos)(phi), s = MATH(sin)(phi);
        pkmcal_real own[3];
        for (i = 0; i < 3; ++i) {
            own[i] = rod->platform[i] + c * rod->swing[i] + s * rod->swing_rate[i];
        }
        turned(&at->pose, own, arm);
    } else {
        turned(&at->pose, rod->platform, arm);
    }
    for (i = 0; i < 3; ++i) {
        b[i] = at->pose.t[i] + arm[i] + rod->floating[i];
    }
}

/* What a screw that the joints turn adds to the reading, m, for a rod of a size and direction w.
 * Adds its derivative by the rod's end to w, and by the platform's turn about that end to more. */
static pkmcal_real screw_growth(const rod_data *rod, const state *at, pkmcal_real size,
                                pkmcal_real w[3], pkmcal_real more[3])
{
    const pkmcal_real *v = rod->base_axis;
    const pkmcal_real u[3] = {w[0], w[1], w[2]};
    pkmcal_real n[3], normal[3], by_n[3], by_u[3], s, c, by_s, by_c, along_v, along_n, along_u;
    int i;
    if (rod->growth == 0) {
        return 0;
    }
    turned(&at->pose, rod->platform_axis, n);
    cross(v, n, normal);
    cross(u, v, by_n);
    along_v = dot(u, v);
    along_n = dot(u, n);
    s = dot(u, normal);
    c = dot(v, n) - along_v * along_n;
    by_s = rod->growth * c / (s * s + c * c);
    by_c = -rod->growth * s / (s * s + c * c);
    for (i = 0; i < 3; ++i) {
        by_n[i] = by_s * by_n[i] + by_c * (v[i] - along_v * u[i]);
        by_u[i] = by_s * normal[i] - by_c * (along_n * v[i] + along_v * n[i]);
    }
    along_u = dot(by_u, u);
    for (i = 0; i < 3; ++i) {
        w[i] += (by_u[i] - along_u * u[i]) / size;
    }
    cross(n, by_n, more);
    return rod->growth * MATH(atan)(s / c);
}

/* How fast the rod's end on the platform goes along u with the turn of its bar, m/rad. */
static pkmcal_real hinge_gain(const rod_data *rod, const state *at, const pkmcal_real u[3])
{
    const pkmcal_real phi = at->hinges[rod->hinge - 1], c = MATH(cos)(phi), s = MATH(sin)(phi);
    pkmcal_real own[3], rate[3];
    int i;
    for (i = 0; i < 3; ++i) {
        own[i] = c * rod->swing_rate[i] - s * rod->swing[i];
    }
    turned(&at->pose, own, rate);
    return dot(u, rate);
}

/* How fast the rod's end on the platform goes along u with the reading, m/m or m/rad. */
static pkmcal_real reading_gain(const rod_data *rod, const pkmcal_real joints[PKMCAL_JOINTS],
                                const pkmcal_real u[3])
{
    switch (rod->drive) {
    case TELESCOPE:
        return rod->scale;
    case SLIDE:
        return rod->scale * dot(u, rod->rate);
    case TURN:
        return rod->scale
               * (MATH(cos)(joint_value(rod, joints)) * dot(u, rod->rate)
                  - MATH(sin)(joint_value(rod, joints)) * dot(u, rod->arm));
    default:
        return 0;
    }
}

/* Hinges turned back by the platform's turn about them, so that the bars keep their directions:
 * where an articulated platform stands, about. */
static void upright(state *at)
{
    const pkmcal_pose *p = &at->pose;
    const pkmcal_real axial[3] = {p->R[2][1] - p->R[1][2], p->R[0][2] - p->R[2][0],
                             p->R[1][0] - p->R[0][1]};
    const pkmcal_real real = 1 + p->R[0][0] + p->R[1][1] + p->R[2][2];
    int k;
    for (k = 0; k < PKMCAL_RODS; ++k) {
        if (HINGES > 0 && RODS[k].hinge > 0) {
            at->hinges[RODS[k].hinge - 1] =
                -2 * MATH(atan2)(dot(axial, RODS[k].hinge_axis), real);
        }
    }
}

/* ---- readings at a pose ---- */

/* The angle, of those that differ by whole turns, nearest to another one, rad. */
static pkmcal_real nearest(pkmcal_real angle, pkmcal_real near)
{
    const pkmcal_real turn = REAL(6.283185307179586);
    return angle - turn * MATH(floor)((angle - near) / turn + REAL(0.5));
}

/* The reading at which the rod ends in b: [B] eq. 4; [C] eq. 2 as the errata's Model 31. */
static pkmcal_status rod_reading(const rod_data *rod, const pkmcal_real b[3], pkmcal_real *reading)
{
    pkmcal_real d[3], along, across, square, half, straight, first, second, q;
    int i;
    for (i = 0; i < 3; ++i) {
        d[i] = b[i] - rod->base[i];
    }
    along = dot(d, rod->rate);
    if (rod->drive == TELESCOPE) {
        q = MATH(sqrt)(dot(d, d)) - rod->length;
    } else if (rod->drive == SLIDE) {
        square = rod->length * rod->length - dot(d, d) + along * along;
        if (!(square >= 0)) {
            return PKMCAL_OUT_OF_REACH;
        }
        half = MATH(sqrt)(square);
        q = along >= rod->middle ? along - half : along + half;
    } else {
        across = dot(d, rod->arm);
        square = dot(d, d) + dot(rod->arm, rod->arm) - rod->length * rod->length;
        half = REAL(0.5) * square / MATH(sqrt)(across * across + along * along);
        if (!(MATH(fabs)(half) <= 1)) {
            return PKMCAL_OUT_OF_REACH;
        }
        half = MATH(acos)(half);
        straight = MATH(atan2)(along, across);
        first = nearest(straight + half, rod->middle);
        second = nearest(straight - half, rod->middle);
        q = MATH(fabs)(first - rod->middle) <= MATH(fabs)(second - rod->middle) ? first : second;
    }
    *reading = q / rod->scale;
    return PKMCAL_OK;
}

/* Each motor's mean of what its rods would read by themselves. */
static pkmcal_status own_readings(const state *at, pkmcal_real joints[PKMCAL_JOINTS])
{
    int count[PKMCAL_JOINTS] = {0}, k;
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        joints[k] = 0;
    }
    for (k = 0; k < PKMCAL_RODS; ++k) {
        const rod_data *rod = &RODS[k];
        pkmcal_real arm[3], b[3], u[3], more[3], reading = 0, size;
        if (rod->drive == CONSTANT) {
            continue;
        }
        platform_end(rod, at, arm, b);
        if (rod_reading(rod, b, &reading) != PKMCAL_OK) {
            return PKMCAL_OUT_OF_REACH;
        }
        size = direction(rod->base, b, u);
        joints[rod->joint] += reading + screw_growth(rod, at, size, u, more) / rod->scale;
        ++count[rod->joint];
    }
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        joints[k] = count[k] > 1 ? joints[k] / (pkmcal_real)count[k] : joints[k];
    }
    return PKMCAL_OK;
}

/* Normal equations of the rods for readings and hinges at a pose. */
static void normal_equations(const pkmcal_real joints[PKMCAL_JOINTS], const state *at,
                             pkmcal_real normal[][MOST_UNKNOWNS],
                             pkmcal_real gradient[INVERSE_UNKNOWNS])
{
    int i, j, k;
    for (i = 0; i < INVERSE_UNKNOWNS; ++i) {
        gradient[i] = 0;
        for (j = 0; j < INVERSE_UNKNOWNS; ++j) {
            normal[i][j] = 0;
        }
    }
    for (k = 0; k < PKMCAL_RODS; ++k) {
        const rod_data *rod = &RODS[k];
        pkmcal_real a[3], b[3], u[3], arm[3], more[3], row[INVERSE_UNKNOWNS] = {0}, value;
        base_end(rod, joints, a);
        platform_end(rod, at, arm, b);
        value = direction(a, b, u);
        value += screw_growth(rod, at, value, u, more) - rod_length(rod, joints);
        if (rod->drive != CONSTANT) {
            row[rod->joint] = -reading_gain(rod, joints, u);
        }
        if (rod->hinge > 0) {
            row[PKMCAL_JOINTS + rod->hinge - 1] = hinge_gain(rod, at, u);
        }
        for (i = 0; i < INVERSE_UNKNOWNS; ++i) {
            gradient[i] += row[i] * value;
            for (j = 0; j < INVERSE_UNKNOWNS; ++j) {
                normal[i][j] += row[i] * row[j];
            }
        }
    }
}

/* Several rods a motor or a bar: readings and hinges that fit all rods best, by Gauss-Newton. */
static pkmcal_status common_readings(state *at, pkmcal_real joints[PKMCAL_JOINTS])
{
    pkmcal_real normal[INVERSE_UNKNOWNS][MOST_UNKNOWNS], step[INVERSE_UNKNOWNS], largest = 1;
    int k, steps;
    for (steps = 0; steps < 15 && largest > 4 * PKMCAL_EPSILON; ++steps) {
        normal_equations(joints, at, normal, step);
        if (!(solve(INVERSE_UNKNOWNS, normal, step) > 0)
            || !all_finite(step, INVERSE_UNKNOWNS)) {
            return PKMCAL_SINGULAR;
        }
        largest = 0;
        for (k = 0; k < INVERSE_UNKNOWNS; ++k) {
            largest = MATH(fmax)(largest, MATH(fabs)(step[k]));
        }
        for (k = 0; k < PKMCAL_JOINTS; ++k) {
            joints[k] -= step[k];
        }
        for (k = 0; k < HINGES; ++k) {
            at->hinges[k] -= step[PKMCAL_JOINTS + k];
        }
    }
    return PKMCAL_OK;
}

pkmcal_status pkmcal_inverse(const pkmcal_pose *pose, pkmcal_real joints[PKMCAL_JOINTS])
{
    pkmcal_real found[PKMCAL_JOINTS];
    state at;
    int k;
    pkmcal_status status;
    if (!all_finite(&pose->R[0][0], 9) || !all_finite(pose->t, 3)) {
        return PKMCAL_BAD_INPUT;
    }
    at.pose = *pose;
    upright(&at);
    status = own_readings(&at, found);
    if (PKMCAL_COUPLED && status == PKMCAL_OK) {
        status = common_readings(&at, found);
    }
    for (k = 0; status == PKMCAL_OK && k < PKMCAL_JOINTS; ++k) {
        joints[k] = found[k];
    }
    return status;
}

#if !PKMCAL_COUPLED
pkmcal_status pkmcal_inverse_jacobian(const pkmcal_pose *pose,
                                      pkmcal_real jacobian[PKMCAL_JOINTS][6])
{
    pkmcal_real joints[PKMCAL_JOINTS];
    state at;
    int i, k;
    const pkmcal_status status = pkmcal_inverse(pose, joints);
    if (status != PKMCAL_OK) {
        return status;
    }
    at.pose = *pose;
    for (k = 0; k < PKMCAL_RODS; ++k) {
        const rod_data *rod = &RODS[k];
        pkmcal_real a[3], b[3], u[3], arm[3], moment[3], more[3] = {0, 0, 0}, size, gain;
        if (rod->drive == CONSTANT) {
            continue;
        }
        base_end(rod, joints, a);
        platform_end(rod, &at, arm, b);
        size = direction(a, b, u);
        gain = reading_gain(rod, joints, u);
        screw_growth(rod, &at, size, u, more);
        if (!(size > 0) || MATH(fabs)(gain) < HALF_DIGITS) {
            return PKMCAL_SINGULAR; /* the twist tells the rate of no reading */
        }
        cross(arm, u, moment);
        for (i = 0; i < 3; ++i) {
            jacobian[rod->joint][i] = (moment[i] + more[i]) / gain;
            jacobian[rod->joint][3 + i] = u[i] / gain;
        }
    }
    return PKMCAL_OK;
}
#endif

/* ---- the closure: what is left of the rods' and axes' equations ---- */

/* What the readings alone decide: the rods' ends on the base, and their lengths, m. */
typedef struct {
    pkmcal_real a[PKMCAL_RODS][3];
    pkmcal_real length[PKMCAL_RODS];
} anchors;

/* A row of the closure, that a point moves along w: by the platform's freedoms, turns in RADIUS. */
static void set_row(const pkmcal_real moment[3], const pkmcal_real w[3], pkmcal_real row[UNKNOWNS])
{
    pkmcal_real by_twist[6];
    int k;
    for (k = 0; k < 3; ++k) {
        by_twist[k] = moment[k] / RADIUS;
        by_twist[3 + k] = w[k];
    }
    for (k = 0; k < FREEDOMS; ++k) {
        row[k] = by_twist[FREE[k]];
    }
    for (k = FREEDOMS; k < UNKNOWNS; ++k) {
        row[k] = 0;
    }
}

/* The equation of an axis, m: line . w, with line the rod from a to b ([A] eq. 7; errata, 3-UPU). */
static pkmcal_real axis_row(const axis_data *axis, const pkmcal_real line[3],
                            const pkmcal_real arm[3], const state *at, pkmcal_real row[UNKNOWNS])
{
    pkmcal_real n[3], w[3], moment[3], more[3], around[3];
    int i;
    turned(&at->pose, axis->platform, n);
    for (i = 0; i < 3; ++i) {
        w[i] = axis->kind == ON_BASE ? axis->base[i] : n[i];
        more[i] = 0;
    }
    if (axis->kind == ON_PLATFORM) {
        cross(n, line, more);
    } else if (axis->kind == TORSION) {
        cross(axis->base, n, w);
        cross(line, axis->base, around);
        cross(n, around, more);
    }
    cross(arm, w, moment);
    for (i = 0; i < 3; ++i) {
        moment[i] += more[i];
    }
    set_row(moment, w, row);
    return dot(line, w);
}

/* The closure, m: |b - a| - length of each rod, then the axes' equations, with derivatives.
 * Returns the sum of squares, and the largest in *error. */
static pkmcal_real closure(const anchors *base, const state *at, pkmcal_real value[EQUATIONS],
                           pkmcal_real rows[EQUATIONS][MOST_UNKNOWNS], pkmcal_real *error)
{
    pkmcal_real arm[PKMCAL_RODS][3], b[PKMCAL_RODS][3], cost = 0;
    int i, k;
    for (k = 0; k < PKMCAL_RODS; ++k) {
        pkmcal_real u[3], moment[3], more[3] = {0, 0, 0};
        platform_end(&RODS[k], at, arm[k], b[k]);
        value[k] = direction(base->a[k], b[k], u);
        value[k] += screw_growth(&RODS[k], at, value[k], u, more) - base->length[k];
        cross(arm[k], u, moment);
        for (i = 0; i < 3; ++i) {
            moment[i] += more[i];
        }
        set_row(moment, u, rows[k]);
        if (HINGES > 0 && RODS[k].hinge > 0) {
            rows[k][FREEDOMS + RODS[k].hinge - 1] = hinge_gain(&RODS[k], at, u);
        }
    }
    for (k = 0; k < AXES; ++k) {
        const int rod = AXIS[k].rod;
        pkmcal_real line[3];
        for (i = 0; i < 3; ++i) {
            line[i] = b[rod][i] - base->a[rod][i];
        }
        value[PKMCAL_RODS + k] = axis_row(&AXIS[k], line, arm[rod], at, rows[PKMCAL_RODS + k]);
    }
    *error = 0;
    for (k = 0; k < EQUATIONS; ++k) {
        cost += value[k] * value[k];
        *error = MATH(fmax)(*error, MATH(fabs)(value[k]));
    }
    return cost;
}

/* ---- steps of the platform ---- */

/* Largest element of R'R - I that passes for rounding: of R in six digits, or in floats. */
#define ROTATION_SLACK (REAL(1e-6) + 64 * PKMCAL_EPSILON)

/* Makes R a rotation to the last digit, which it must be but for rounding. */
static int tidy(pkmcal_real R[3][3])
{
    pkmcal_real gram[3][3], out[3][3];
    int i, j, k;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            gram[i][j] = R[0][i] * R[0][j] + R[1][i] * R[1][j] + R[2][i] * R[2][j];
            if (!(MATH(fabs)(gram[i][j] - (i == j ? 1 : 0)) < ROTATION_SLACK)) {
                return 0;
            }
        }
    }
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            pkmcal_real sum = 0;
            for (k = 0; k < 3; ++k) {
                sum += R[i][k] * ((k == j ? REAL(1.5) : 0) - REAL(0.5) * gram[k][j]);
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

/* Turns the platform's axes by the rotation vector w, rad, about the base's (Rodrigues). */
static void rotate(pkmcal_real R[3][3], const pkmcal_real w[3])
{
    const pkmcal_real angle2 = dot(w, w);
    pkmcal_real s, c;
    int i, j;
    if (angle2 < REAL(1e-8)) {
        s = 1 - angle2 / 6;
        c = REAL(0.5) - angle2 / 24;
    } else {
        const pkmcal_real angle = MATH(sqrt)(angle2), half = MATH(sin)(REAL(0.5) * angle) / angle;
        s = MATH(sin)(angle) / angle;
        c = 2 * half * half;
    }
    for (j = 0; j < 3; ++j) {
        const pkmcal_real v[3] = {R[0][j], R[1][j], R[2][j]};
        pkmcal_real once[3], twice[3];
        cross(w, v, once);
        cross(w, once, twice);
        for (i = 0; i < 3; ++i) {
            R[i][j] = v[i] + s * once[i] + c * twice[i];
        }
    }
}

/* The state moved back by a share of Newton's step. */
static void move(const state *from, const pkmcal_real step[UNKNOWNS], pkmcal_real share, state *to)
{
    pkmcal_real twist[6] = {0};
    int k;
    *to = *from;
    for (k = 0; k < FREEDOMS; ++k) {
        twist[FREE[k]] = -share * step[k];
    }
    for (k = 0; k < 3; ++k) {
        twist[k] /= RADIUS;
        to->pose.t[k] += twist[3 + k];
    }
    if (FREE[0] < 3) {
        rotate(to->pose.R, twist);
    }
    for (k = 0; k < HINGES; ++k) {
        to->hinges[k] -= share * step[FREEDOMS + k];
    }
}

/* The largest share, up to 1, of a step that turns by less than half a radian and shifts by less
 * than the machine's size. */
static pkmcal_real allowed(const pkmcal_real step[UNKNOWNS])
{
    pkmcal_real largest = 0;
    int k;
    for (k = 0; k < UNKNOWNS; ++k) {
        const pkmcal_real half = REAL(0.5);
        const pkmcal_real limit = k >= FREEDOMS ? half : FREE[k] < 3 ? half * RADIUS : SIZE;
        largest = MATH(fmax)(largest, MATH(fabs)(step[k]) / limit);
    }
    return largest > 1 ? 1 / largest : 1;
}

/* ---- the pose at readings ---- */

/* Rounding: of a length it is some PKMCAL_EPSILON times the machine's size. */
#define CLOSED (2 * PKMCAL_EPSILON * SIZE)   /* m, some units in the last place of a length */
#define NEARLY (256 * PKMCAL_EPSILON * SIZE) /* m, good enough where no step makes it better */
#define LEAST_SHARE REAL(0.1)   /* of Newton's step; where it still overshoots, it is damped */
#define LEAST_PIVOT HALF_DIGITS /* below it not half of a step's digits would be right */
#define FIRST_DAMPING REAL(1e-4)
#define LAST_DAMPING REAL(1e6)  /* shifts of less than a thousandth of what is missing */
#define AT_REST REAL(1e-6)      /* share of the squares: a step that saves less leads nowhere */

/* Where the iteration is: the state, and the closure there. */
typedef struct {
    state at;
    pkmcal_real value[EQUATIONS];
    pkmcal_real rows[EQUATIONS][MOST_UNKNOWNS];
    pkmcal_real cost;  /* m^2, sum of squares of value */
    pkmcal_real error; /* m, largest of value */
} iterate;

/* Goes on by a share of a step, where that makes the closure better; else returns 0. */
static int improved(const anchors *base, const pkmcal_real step[UNKNOWNS], pkmcal_real share,
                    iterate *now)
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
static int newton(const anchors *base, iterate *now, pkmcal_real *pivot)
{
    pkmcal_real rows[EQUATIONS][MOST_UNKNOWNS], step[UNKNOWNS], share;
    int i, k;
    for (i = 0; i < UNKNOWNS; ++i) {
        step[i] = now->value[i];
        for (k = 0; k < UNKNOWNS; ++k) {
            rows[i][k] = now->rows[i][k];
        }
    }
    *pivot = solve(UNKNOWNS, rows, step);
    if (!(*pivot > LEAST_PIVOT)) {
        return 0;
    }
    for (share = allowed(step); share > LEAST_SHARE; share *= REAL(0.5)) {
        if (improved(base, step, share, now)) {
            return 1;
        }
    }
    return 0;
}

/* One step of Levenberg's and Marquardt's method, for starts from which Newton's leads nowhere. */
static int damped(const anchors *base, iterate *now)
{
    pkmcal_real lambda;
    int i, j, k;
    for (lambda = FIRST_DAMPING; lambda < LAST_DAMPING; lambda *= 10) {
        pkmcal_real normal[UNKNOWNS][MOST_UNKNOWNS], step[UNKNOWNS];
        for (i = 0; i < UNKNOWNS; ++i) {
            step[i] = 0;
            for (k = 0; k < EQUATIONS; ++k) {
                step[i] += now->rows[k][i] * now->value[k];
            }
            for (j = 0; j < UNKNOWNS; ++j) {
                normal[i][j] = 0;
                for (k = 0; k < EQUATIONS; ++k) {
                    normal[i][j] += now->rows[k][i] * now->rows[k][j];
                }
            }
            normal[i][i] *= 1 + lambda;
        }
        if (solve(UNKNOWNS, normal, step) > 0 && improved(base, step, allowed(step), now)) {
            return 1;
        }
    }
    return 0;
}

pkmcal_status pkmcal_forward(const pkmcal_real joints[PKMCAL_JOINTS], pkmcal_pose *pose,
                             pkmcal_report *report)
{
    iterate now;
    anchors base;
    pkmcal_real pivot = 0, before;
    int k, steps = 0, moved = 1;
    pkmcal_status status = PKMCAL_NOT_CONVERGED;
    if (report) {
        report->steps = 0;
        report->error = INFINITY;
        report->pivot = 0;
    }
    now.at.pose = *pose;
    if (!all_finite(joints, PKMCAL_JOINTS) || !all_finite(pose->t, 3)
        || !tidy(now.at.pose.R)) {
        return PKMCAL_BAD_INPUT;
    }
    upright(&now.at);
    for (k = 0; k < PKMCAL_RODS; ++k) {
        base_end(&RODS[k], joints, base.a[k]);
        base.length[k] = rod_length(&RODS[k], joints);
    }
    now.cost = closure(&base, &now.at, now.value, now.rows, &now.error);
    do {
        ++steps;
        before = now.cost;
        moved = newton(&base, &now, &pivot);
        if (!moved && now.error > NEARLY) {
            moved = damped(&base, &now);
        }
        if (now.error > NEARLY && now.cost > (1 - AT_REST) * before) {
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

/* ---- what else a controller asks ---- */

void pkmcal_home(pkmcal_pose *pose)
{
    *pose = HOME;
}

int pkmcal_out_of_range(const pkmcal_real joints[PKMCAL_JOINTS])
{
    int k;
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        /* a reading on its limit is within, by its last digits */
        const pkmcal_real slack = 64 * PKMCAL_EPSILON;
        const pkmcal_real low = RANGE[k][0] - slack * (MATH(fabs)(RANGE[k][0]) + SIZE);
        const pkmcal_real high = RANGE[k][1] + slack * (MATH(fabs)(RANGE[k][1]) + SIZE);
        if (!(joints[k] >= low && joints[k] <= high)) {
            return k + 1;
        }
    }
    return 0;
}

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
