/*
 */
#include "kinematics.h"
#include "hal.h"
#include "rtapi.h"
#include "rtapi_app.h"

#include "pkmcal_kinematics.c"

/* ---- the machine ---- */

/* LinuxCNC's joint is the reading times this: mm/m or degrees/rad */
static const double JOINT_UNITS[PKMCAL_JOINTS] = {1000, 1000, 1000, 1000, 1000, 1000};

/* ---- what follows is the same for every machine ---- */

static const double MM = 1000.0;                  /* in a metre */
static const double DEGREES = 57.29577951308232;  /* in a radian */

static int component;

/* Whether the platform has this one of omega_x, omega_y, omega_z, tau_x, tau_y, tau_z. */
static int is_free(int coordinate)
{
    int k;
    for (k = 0; k < FREEDOMS; ++k) {
        if (FREE[k] == coordinate) {
            return 1;
        }
    }
    return 0;
}

/* X, Y, Z, A, B, C as a pose: R = Rz(C) Ry(B) Rx(A) of a platform that turns in all directions; of
 * others Rz(C) times the orientation at home. What the platform does not do is as at home. */
static void pose_of_world(const EmcPose *world, pkmcal_pose *pose)
{
    const double t[3] = {world->tran.x / MM, world->tran.y / MM, world->tran.z / MM};
    const double sa = sin(world->a / DEGREES), ca = cos(world->a / DEGREES);
    const double sb = sin(world->b / DEGREES), cb = cos(world->b / DEGREES);
    const double sc = sin(world->c / DEGREES), cc = cos(world->c / DEGREES);
    const double turn[3][3] = {{cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa},
                               {sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa},
                               {-sb, cb * sa, cb * ca}};
    int i, j;
    pkmcal_home(pose);
    for (i = 0; i < 3; ++i) {
        pose->t[i] = is_free(3 + i) ? t[i] : pose->t[i];
        for (j = 0; j < 3; ++j) {
            if (is_free(0) && is_free(1) && is_free(2)) {
                pose->R[i][j] = turn[i][j];
            } else if (is_free(2) && i < 2) {
                const double x = HOME.R[0][j], y = HOME.R[1][j];
                pose->R[i][j] = i == 0 ? cc * x - sc * y : sc * x + cc * y;
            }
        }
    }
}

/* An angle in degrees, of those that differ by whole turns the one nearest to another. */
static double nearest_degrees(double radians, double near)
{
    return DEGREES * nearest(radians, near / DEGREES);
}

/* The inverse of pose_of_world; angles next to those that *world holds. */
static void world_of_pose(const pkmcal_pose *pose, EmcPose *world)
{
    const double(*R)[3] = pose->R;
    world->tran.x = is_free(3) ? MM * pose->t[0] : 0;
    world->tran.y = is_free(4) ? MM * pose->t[1] : 0;
    world->tran.z = is_free(5) ? MM * pose->t[2] : 0;
    if (is_free(0) && is_free(1) && is_free(2)) {
        world->a = nearest_degrees(atan2(R[2][1], R[2][2]), world->a);
        world->b = DEGREES * atan2(-R[2][0], sqrt(R[2][1] * R[2][1] + R[2][2] * R[2][2]));
        world->c = nearest_degrees(atan2(R[1][0], R[0][0]), world->c);
    } else {
        world->a = world->b = 0;
        /* rows of R HOME' */
        world->c = is_free(2) ? nearest_degrees(atan2(dot(R[1], HOME.R[0]), dot(R[0], HOME.R[0])),
                                                world->c)
                              : 0;
    }
    world->u = world->v = world->w = 0;
}

/* How fast the rods' lengths follow their motors at a pose: the sign says which of its two places a
 * slide or crank has. */
static void gains(const pkmcal_pose *pose, const pkmcal_real readings[PKMCAL_JOINTS],
                  pkmcal_real gain[PKMCAL_RODS])
{
    state at;
    int k;
    at.pose = *pose;
    upright(&at);
    for (k = 0; k < PKMCAL_RODS; ++k) {
        double a[3], b[3], u[3], arm[3];
        base_end(&RODS[k], readings, a);
        platform_end(&RODS[k], &at, arm, b);
        direction(a, b, u);
        gain[k] = reading_gain(&RODS[k], readings, u);
    }
}

/* Readings at a pose with all motors on the side on which they are at home: what lies beyond a
 * stretched arm is out of reach, where LinuxCNC would let the joints jump to their other places. */
static pkmcal_status readings_as_at_home(const pkmcal_pose *pose,
                                         pkmcal_real readings[PKMCAL_JOINTS])
{
    pkmcal_real home_readings[PKMCAL_JOINTS], home_gain[PKMCAL_RODS], gain[PKMCAL_RODS];
    pkmcal_status status = pkmcal_inverse(&HOME, home_readings);
    int k;
    if (status == PKMCAL_OK) {
        status = pkmcal_inverse(pose, readings);
    }
    if (status != PKMCAL_OK) {
        return status;
    }
    gains(&HOME, home_readings, home_gain);
    gains(pose, readings, gain);
    for (k = 0; k < PKMCAL_RODS; ++k) {
        if (RODS[k].drive != CONSTANT && !(gain[k] * home_gain[k] > 0)) {
            return PKMCAL_OUT_OF_REACH;
        }
    }
    return PKMCAL_OK;
}

KINEMATICS_TYPE kinematicsType(void)
{
    return KINEMATICS_BOTH;
}

int kinematicsInverse(const EmcPose *world, double *joints, const KINEMATICS_INVERSE_FLAGS *iflags,
                      KINEMATICS_FORWARD_FLAGS *fflags)
{
    pkmcal_real readings[PKMCAL_JOINTS];
    pkmcal_pose pose;
    int k;
    (void)iflags;
    (void)fflags;
    pose_of_world(world, &pose);
    if (readings_as_at_home(&pose, readings) != PKMCAL_OK) {
        return -1;
    }
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        joints[k] = JOINT_UNITS[k] * readings[k];
    }
    return 0;
}

int kinematicsForward(const double *joints, EmcPose *world, const KINEMATICS_FORWARD_FLAGS *fflags,
                      KINEMATICS_INVERSE_FLAGS *iflags)
{
    pkmcal_real readings[PKMCAL_JOINTS];
    pkmcal_pose pose;
    int k;
    (void)fflags;
    (void)iflags;
    for (k = 0; k < PKMCAL_JOINTS; ++k) {
        readings[k] = joints[k] / JOINT_UNITS[k];
    }
    /* from the last pose; from home where there was none */
    pose_of_world(world, &pose);
    if (pkmcal_forward(readings, &pose, 0) != PKMCAL_OK) {
        pkmcal_home(&pose);
        if (pkmcal_forward(readings, &pose, 0) != PKMCAL_OK) {
            return -1;
        }
    }
    world_of_pose(&pose, world);
    return 0;
}

#ifdef KINS_NOT_SWITCHABLE
KINS_NOT_SWITCHABLE
#endif
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsInverse);
EXPORT_SYMBOL(kinematicsForward);
MODULE_LICENSE("GPL");

int rtapi_app_main(void)
{
    component = hal_init("pkmcal_kins");
    if (component < 0) {
        return component;
    }
    return hal_ready(component);
}

void rtapi_app_exit(void)
{
    hal_exit(component);
}
