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
 */
#ifndef PKMCAL_KINEMATICS_H
#define PKMCAL_KINEMATICS_H

#include <float.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- the machine ---- */

#define PKMCAL_JOINTS 6 /* readings: joint 1 m, joint 2 m, joint 3 m, joint 4 m, joint 5 m, joint 6 m */
#define PKMCAL_RODS 6
/* 1 where several rods share a motor or a bar: readings are then found by iteration. */
#define PKMCAL_COUPLED 0

/* ---- what follows is the same for every machine ---- */

/* Newton's steps at most; -DPKMCAL_MOST_STEPS=8 bounds the time of a call. */
#ifndef PKMCAL_MOST_STEPS
#define PKMCAL_MOST_STEPS 60
#endif

/* The type of all numbers: double; float with -DPKMCAL_FLOAT, or with this line not a comment:
#define PKMCAL_FLOAT
 * On controllers that count in floats alone (Cortex-M4F) it is many times faster, and right to some
 * micrometres of a machine of 1 m. Tolerances follow PKMCAL_EPSILON, so that a double that is a
 * float (AVR) is one here too. */
#ifdef PKMCAL_FLOAT
typedef float pkmcal_real;
#define PKMCAL_EPSILON FLT_EPSILON
#define PKMCAL_NUMBER(number) number##F
#else
typedef double pkmcal_real;
#define PKMCAL_EPSILON DBL_EPSILON
#define PKMCAL_NUMBER(number) number
#endif

typedef struct {
    pkmcal_real R[3][3]; /* columns: the platform's axes along the base's */
    pkmcal_real t[3];    /* m, the platform's origin in the base frame */
} pkmcal_pose;

typedef enum {
    PKMCAL_OK = 0,
    PKMCAL_NOT_CONVERGED = 1, /* the limit of steps was reached */
    PKMCAL_SINGULAR = 2,      /* the platform is not held: a pose is not one of many */
    PKMCAL_OUT_OF_REACH = 3,  /* no pose near the start, or no reading, closes the machine */
    PKMCAL_BAD_INPUT = 4      /* not finite, or a start that is no rotation */
} pkmcal_status;

/* Of bad input 0 steps and an error without end. */
typedef struct {
    int steps;         /* Newton's */
    pkmcal_real error; /* m, of the rod that fits worst */
    pkmcal_real pivot; /* smallest of the last step: tenths in a good pose, 0 in a singular one */
} pkmcal_report;

/* The pose that forward kinematics may start from where no better one is known. */
void pkmcal_home(pkmcal_pose *pose);

/* Readings at a pose; where a motor has two, the one nearest to mid-range. The pose should be one
 * that the machine can take: where its rods and axes allow only some, that is not checked. */
pkmcal_status pkmcal_inverse(const pkmcal_pose *pose, pkmcal_real joints[PKMCAL_JOINTS]);

/* The pose at readings, in the assembly of the start: the last pose, or home. *pose is the start
 * and becomes the result where PKMCAL_OK is returned; else it stays. report may be NULL, and is
 * written in any case. */
pkmcal_status pkmcal_forward(const pkmcal_real joints[PKMCAL_JOINTS], pkmcal_pose *pose,
                             pkmcal_report *report);

#if !PKMCAL_COUPLED
/* Readings' rates are rates = jacobian twist at a pose ([B] eq. 6-7). */
pkmcal_status pkmcal_inverse_jacobian(const pkmcal_pose *pose,
                                      pkmcal_real jacobian[PKMCAL_JOINTS][6]);
#endif

/* 0 where all readings are within the mechanism file's ranges; else which is not, from 1. */
int pkmcal_out_of_range(const pkmcal_real joints[PKMCAL_JOINTS]);

/* What a status means, in words. */
const char *pkmcal_status_text(pkmcal_status status);

#ifdef __cplusplus
}
#endif

#endif
